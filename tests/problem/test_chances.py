"""Conditions on probabilities: closed forms, both spreads, both methods, files, simulations, what is refused."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import unassessed
from scipy.stats import norm

import covocp as co

T, START, NOISE = 2.0, 0.01, 0.02
SPREAD = np.sqrt(START + NOISE * T)


def pushed(measured=False, **chance):
    """As far as it pays, by a control that knows nothing: x(T) is at its limit."""
    ocp = co.Problem(T, "pushed")
    x, u = ocp.state("x", initial=0.0, variance=START), ocp.control("u")
    ocp.dynamics(x, u, noise=NOISE)
    if measured:
        ocp.measurement("m", x, noise=0.01)
        ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=-x)
    ocp.chance(x, **{"upper": 1.0, "probability": 0.9, "at": "final", "name": "wall", **chance})
    return ocp


def regulated(**chance):
    """A closed loop whose spread has to be kept inside."""
    ocp = co.Problem(T, "regulated")
    x, u = ocp.state("x", initial=0.0, variance=0.04), ocp.control("u")
    ocp.dynamics(x, u, noise=ocp.parameter("density", 0.1))
    ocp.measurement("m", x, noise=0.02)
    ocp.minimize_expected(running=u**2 - 0.5 * x, terminal_weight={x: 0.1})
    ocp.chance(x, **{"lower": -1.0, "upper": 0.8, "probability": 0.95, "name": "wall", **chance})
    return ocp


@pytest.mark.parametrize("measured", [False, True])
@pytest.mark.parametrize("p", [0.3, 0.9, 1 - 1e-9])
def test_open_loop_keeps_the_closed_form_whatever_is_measured(measured, p):
    solution = co.solve(pushed(measured, probability=p), intervals=4)
    end = 1.0 - norm.isf(1 - p) * SPREAD
    assert solution["x"][-1] == pytest.approx(end, abs=1e-6)
    assert solution.cost == pytest.approx(end**2 / (2 * T) - end, abs=1e-6)
    (wall,) = solution.chances
    assert wall.deviation == pytest.approx(SPREAD, rel=1e-7)
    assert 1 - wall.reached == pytest.approx(1 - p, rel=1e-4)
    assert wall.met
    assert wall.margin == pytest.approx(0.0, abs=1e-6)
    assert "wall" in str(solution)


def test_both_formulations_and_both_methods_agree():
    cost = co.solve(pushed(True), intervals=4).cost
    for options in ({"covariances": "states"}, {"covariances": "eliminated"}, {"method": "gradient"}):
        assert co.solve(pushed(True), intervals=4, **options).cost == pytest.approx(cost, rel=1e-4), options


def test_the_largest_variance_that_two_limits_allow():
    ocp = co.Problem(1.0)
    v = ocp.decision("v", guess=0.1, lower=0.0, upper=10.0)
    x, u = ocp.state("x", initial=None, variance=v, guess=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.chance(x, lower=-1.0, upper=3.0, probability=0.9, name="band")
    ocp.minimize(running=u**2, terminal=-v)
    solution = co.solve(ocp, intervals=4)
    assert float(solution["v"]) == pytest.approx((2.0 / norm.isf(0.05)) ** 2, rel=1e-5)
    assert solution["x"] == pytest.approx(np.ones(5), abs=1e-2)


def test_several_rows_share_the_risk():
    ocp = pushed(probability=0.5)
    x = ocp.states[0].symbol
    ocp.chance(ca.vertcat(x, -x), upper=[1.2, 2.0], probability=0.9, joint=True, at="final", name="both")
    solution = co.solve(ocp, intervals=4)
    found = {q.name: q for q in solution.chances}
    end = 1.2 - norm.isf(0.05) * SPREAD
    assert solution["x"][-1] == pytest.approx(end, abs=1e-6)
    assert found["both[0]"].asked == pytest.approx(0.95)
    assert found["both[0]"].reached == pytest.approx(0.95, abs=1e-6)
    other = norm.sf((2.0 + end) / SPREAD)
    assert found["both"].reached == pytest.approx(0.95 - other, abs=1e-6)
    assert "together" in str(ocp)
    assert "Boole" in str(ocp)


def test_closed_loop_reaches_it_by_its_own_covariances_and_in_20000_runs():
    ocp = regulated()
    assert "free, for X in 'wall'" in str(ocp)
    solution = co.solve(ocp, intervals=30)
    x, s = solution["x"], np.sqrt(solution.loop.X[:, 0, 0])
    shares = norm.cdf((0.8 - x) / s) - norm.cdf((-1.0 - x) / s)
    (wall,) = solution.chances
    assert wall.reached == pytest.approx(shares.min(), abs=1e-12)
    assert wall.reached == pytest.approx(0.95, abs=1e-5)
    runs = co.simulate(solution, runs=20000, seed=5)
    share = runs.chances["wall"]
    assert share.band[0] <= 0.95 <= share.band[1]
    assert share.met
    assert share.always < share.least
    assert "met within the band" in str(runs)
    doubled = co.evaluate(solution, truth={"density": 0.2})
    assert doubled.chances[0].reached < 0.95
    assert not doubled.chances[0].met
    s = np.sqrt(doubled.loop.X[:, 0, 0])
    shares = norm.cdf((0.8 - x) / s) - norm.cdf((-1.0 - x) / s)
    assert doubled.chances[0].reached == pytest.approx(shares.min(), abs=1e-12)
    assert "NOT MET" in str(doubled)


def test_controls_scatter_in_a_closed_loop():
    ocp = regulated(probability=0.8)
    ocp.chance(ocp.controls[0].symbol, upper=1.0, probability=0.9, smallest=1e-3, name="actuator")
    solution = co.solve(ocp, intervals=20)
    C, Xhat, u = solution.loop.gain[:, 0, 0], solution.loop.Xhat[:, 0, 0], solution["u"]
    shares = norm.cdf((1.0 - u)[1:] / np.maximum(np.abs(C) * np.sqrt(Xhat), 1e-300)[1:])
    found = next(q for q in solution.chances if q.name == "actuator")
    assert found.reached == pytest.approx(shares.min(), rel=1e-9)
    assert found.met
    runs = co.simulate(solution, runs=2000, seed=1)
    assert runs.chances["actuator"].met


def test_open_loop_meets_it_in_20000_runs_and_the_error_of_the_filter_would_not():
    solution = co.solve(pushed(True), intervals=4)
    runs = co.simulate(solution, runs=20000, seed=2)
    share = runs.chances["wall"]
    assert share.band[0] <= 0.9 <= share.band[1]
    assert share.predicted == pytest.approx(0.9, abs=1e-4)
    error = np.sqrt(solution["E"][-1].item())
    assert norm.cdf(norm.isf(0.1) * error / SPREAD) < 0.8  # what E in its place would have kept


def test_a_nonlinear_expression_is_said_to_miss_it():
    ocp = co.Problem(1.0, "bent")
    x, u = ocp.state("x", initial=0.0, variance=0.25), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.chance(ca.exp(x), upper=1.0 + norm.isf(0.05) * 0.5, probability=0.95, at="final", name="bent")
    ocp.minimize(running=u**2, terminal=-0.01 * x)
    solution = co.solve(ocp, intervals=4)
    assert solution.chances[0].met  # to first order
    runs = co.simulate(solution, runs=20000, seed=3)
    share = runs.chances["bent"]
    truth = norm.cdf((np.log(1.0 + norm.isf(0.05) * 0.5) - solution["x"][-1]) / 0.5)
    assert truth < 0.9
    assert share.end_band[0] <= truth <= share.end_band[1]
    assert not share.met
    assert "NOT MET by bent" in str(runs)


def test_rows_together_are_counted_together():
    ocp = pushed()
    x = ocp.states[0].symbol
    ocp.chance(ca.vertcat(x, -x), upper=[0.9, -0.3], probability=0.5, joint=True, name="both", at="final")
    solution = co.solve(ocp, intervals=4)
    runs = co.simulate(solution, runs=4000, seed=4)
    end = runs.terminal("x") + solution["x"][-1]
    assert runs.chances["both"].end == pytest.approx(((end <= 0.9) & (end >= 0.3)).mean())
    assert set(runs.chances) == {"wall", "both"}


def test_time_margin_and_deviation_are_those_of_the_least_probability():
    """x = -t/4 goes away from a wall at 0.3 while s = 0.4 sqrt(t) grows.

    The distance in deviations is least at t = 1.2, the margin at (2 q 0.4)^2 = 1.05, q the quantile; at t = 0 nothing
    scatters. A wall that is far away is never reached: there the probability is one, and the margin tells.
    """
    ocp = co.Problem(4.0)
    x, u = ocp.state("x", initial=0.0, variance=0.0), ocp.control("u")
    ocp.dynamics(x, u, noise=0.16)
    ocp.minimize(running=(u + 0.25) ** 2)
    ocp.chance(x, upper=0.3, probability=0.9, name="near")
    ocp.chance(x, upper=100.0, probability=0.9, name="far")
    near, far = co.solve(ocp, intervals=80, progress=False).chances
    assert near.time == pytest.approx(1.2)
    s = 0.4 * np.sqrt(1.2)
    assert near.deviation == pytest.approx(s, rel=1e-6)
    assert near.reached == pytest.approx(norm.cdf((0.3 + 0.25 * 1.2) / s), rel=1e-4)
    assert near.margin == pytest.approx(0.3 + 0.25 * 1.2 - norm.isf(0.1) * s, rel=1e-3)
    assert (far.reached, far.time) == (1.0, pytest.approx(1.05))


def test_limits_that_the_error_of_the_filter_alone_passes_are_named():
    """Of a linear system E is that of every nominal; the value at the end is prescribed, in the middle at best."""

    def steered(**limits):
        ocp = co.Problem(3.0)
        x, v = ocp.state("x", initial=0.0, final=1.0, variance=0.04), ocp.state("v", initial=0.0, variance=0.01)
        u = ocp.control("u")
        ocp.dynamics(x, v)
        ocp.dynamics(v, u, noise=0.05)
        ocp.measurement("position", x, noise=0.02)
        ocp.minimize_expected(running=0.1 * u**2, terminal_weight={x: 1.0, v: 1.0})
        if limits:
            ocp.chance(x, at="final", probability=0.95, name="tight", **limits)
        return ocp

    s = np.sqrt(unassessed(steered(), intervals=10).loop.E[-1, 0, 0])
    for limits, wider in (
        ({"lower": 0.98, "upper": 1.02}, norm.isf(0.025) * s - 0.02),
        ({"upper": 1.1}, norm.isf(0.05) * s - 0.1),
    ):
        with pytest.raises(co.SolveError, match=r"no feedback takes X below E.*'tight'") as caught:
            co.solve(steered(**limits), intervals=10, progress=False)
        said = float(str(caught.value).split("would have to be ")[1].split(" wider")[0])
        assert said == pytest.approx(wider, rel=5e-3)


def test_files_keep_what_is_reached(tmp_path):
    solution = co.solve(pushed(), intervals=4)
    for name in ("one.npz", "one.json"):
        solution.save(tmp_path / name)
        assert co.load(tmp_path / name).chances == solution.chances
        assert co.load(tmp_path / name, problem=pushed()).chances == solution.chances


def test_attitudes_scatter_by_their_tangents():
    ocp = co.Problem(1.0, "turn")
    u = ocp.control("u", 3)
    attitude = ocp.attitude("q", initial=np.eye(3), rate=u, variance=1e-4, noise=1e-4)
    ocp.chance(attitude.cosine([0, 0, 1], [0.0, 0.6, 0.8]), upper=0.95, probability=0.9, at="final", name="zone")
    ocp.minimize(running=ca.sumsqr(u - ca.DM([-0.5, 0, 0])))
    solution = co.solve(ocp, intervals=10)
    (zone,) = solution.chances
    # At an angle a the cosine moves by sin(a) for each radian: the deviation is that of one axis.
    angle = np.arccos(0.95 - norm.isf(0.1) * zone.deviation)
    assert zone.deviation == pytest.approx(np.sin(angle) * np.sqrt(2e-4), rel=1e-6)
    assert zone.reached == pytest.approx(0.9, abs=1e-5)


@pytest.mark.parametrize(
    ("chance", "said"),
    [
        ({"probability": 1.0}, "inside \\(0, 1\\)"),
        ({"probability": 0.0}, "inside \\(0, 1\\)"),
        ({"probability": -0.1}, "inside \\(0, 1\\)"),
        ({"probability": 1.3}, "inside \\(0, 1\\)"),
        ({"probability": np.nan}, "probability"),
        ({"upper": None}, "has no limit"),
        ({"upper": 1.0, "lower": 1.0}, "are equal"),
        ({"upper": 1.0, "lower": 2.0}, "wall"),
        ({"upper": 1.0, "lower": 0.0, "probability": 0.05}, "too small for two limits"),
        ({"at": "middle"}, "unknown place"),
        ({"at": 1.5}, "at='path', 'initial' or 'final'\n"),  # no instants are offered, which are refused
        ({"smallest": -1.0}, "smallest"),
        ({"joint": "yes"}, "joint"),
    ],
)
def test_wrong_chances_are_refused(chance, said):
    with pytest.raises(co.ProblemError, match=said):
        pushed(**chance)


def test_what_does_not_scatter_is_refused():
    ocp = pushed()
    u = ocp.controls[0].symbol
    with pytest.raises(co.ProblemError, match="contains the integral"):
        ocp.chance(ocp.integral(u**2, name="effort"), upper=1.0, probability=0.9)
    ocp.chance(u, upper=1.0, probability=0.9, name="actuator")
    with pytest.raises(co.ProblemError, match="Nothing in 'actuator' scatters"):
        ocp.statement()
    measured = pushed(True)
    with pytest.raises(co.ProblemError, match="contains the matrix 'E'"):
        measured.chance(measured.states[0].symbol + measured.matrices[0].matrix, upper=1.0, probability=0.9)
    known = co.Problem(1.0)
    x, u = known.state("x", initial=0.0), known.control("u")
    known.dynamics(x, u)
    known.chance(x, upper=1.0, probability=0.9)
    known.minimize(running=u**2)
    with pytest.raises(co.ProblemError, match="nothing in the system is uncertain"):
        known.statement()
    with pytest.raises(co.SolveError, match="wall"):
        co.solve(pushed(lower=0.9, probability=0.9999), intervals=4)
