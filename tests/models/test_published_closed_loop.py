"""Published and recomputed values of the closed loop: 6.12, Mars entry 7.2, and what a solution says of itself."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from problems import graded, solve
from read_again import printed

import covocp as co
from covocp.models import mars_entry, unknown_lag

RADIUS = 11.0951e6  # ft
GRADED = graded(240)


@cache
def combined():
    return solve(unknown_lag.steering(), grid=GRADED, tolerance=1e-9)


@cache
def classical():
    return solve(unknown_lag.steering(), grid=GRADED, nominal="deterministic")


# --- 6.12 -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("design", "values"),
    [
        (combined, [1.286758, 0.740389, 0.021014, 2.027146, 0.719375, 0.646544, 4.310046]),
        (classical, [1.000000, 1.504062, 0.150444, 2.504062, 1.353619, 1.014567, 3.499117]),
    ],
)
def test_recomputed_rows_of_6_12(design, values):
    """Energy, matrix terms, of which feedback, J, X11(T), E11(T), E22(T), to 1e-5 and the digits given."""
    found = design()
    loop = found.loop
    actual = [
        loop.cost["running"] + loop.cost["terminal"],
        loop.cost["deviations at the end"] + loop.cost["deviations on the way"],
        loop.cost["deviations on the way"],
        loop.expected_cost,
        *(loop.X[-1, 0, 0], loop.E[-1, 0, 0], loop.E[-1, 1, 1]),
    ]
    np.testing.assert_allclose(actual, values, rtol=1e-5, atol=0.5e-6)
    assert found.cost == pytest.approx(values[3], abs=0.6e-6)
    assert found.cost_terms["deviations"] == pytest.approx(values[1], rel=1e-5)
    assert found["x"][-1] == pytest.approx(1.0, abs=1e-7)
    o = found.optimality
    assert o.cost_identity < 1e-8
    assert o.cross_covariance < 1e-5
    assert o.conservation < 1e-11
    np.testing.assert_allclose(loop.E[:, 1, 1] + loop.Xhat[:, 1, 1], 5.0, rtol=1e-9)


def test_recomputed_control_of_6_12():
    """At t = 0, 1, ..., 10, to the digits given, but for what the flat minimum leaves open."""
    table = [-0.00457, -0.00931, -0.01699, -0.02964, -0.05035, -0.08302, -0.12982, -0.17866, -0.14853, 0.35177, 3.07667]
    np.testing.assert_allclose(combined().at(np.arange(11.0))["u"], table, atol=6e-5)


def test_published_values_of_6_12():
    """2.02 against 2.51, E22(T) 4.42 against 3.37: right to one or two digits; the classical design costs 24 % more."""
    assert combined().cost == pytest.approx(2.02, abs=0.01)
    assert classical().cost == pytest.approx(2.51, abs=0.01)
    assert classical().cost / combined().cost - 1 == pytest.approx(0.24, abs=0.005)
    # printed: 1.31, 0.71, 0.69, 4.42 and 3.37
    assert combined().cost_terms["running"] == pytest.approx(1.31, abs=0.03)
    assert combined().cost_terms["deviations"] == pytest.approx(0.71, abs=0.04)
    assert combined()["E"][-1, 1, 1] == pytest.approx(4.42, abs=0.12)
    assert classical()["E"][-1, 1, 1] == pytest.approx(3.37, abs=0.14)


def test_shape_of_the_combined_design():
    """Small and negative first, then a late push; below the minimum-energy trajectory, so that b is not learnt."""
    t, u = combined().t, combined()["u"]
    assert (u[t < 8.5] < 0).all()
    assert (u[t > 9] > 0).all()
    assert (combined()["x"][1:-1] < classical()["x"][1:-1]).all()
    assert np.trapezoid(combined()["x"], t) < 0.5 * np.trapezoid(classical()["x"], t)
    assert combined()["E"][-1, 1, 1] > classical()["E"][-1, 1, 1]


@pytest.mark.parametrize("weight", [0.1, 1.0, 10.0])
def test_the_best_input_for_identification_is_a_bad_nominal(weight):
    """3 of the specification, end: worse than either design, the worse the better it identifies."""
    learning = solve(unknown_lag.problem(weight=weight, final=1.0), intervals=100)
    found = co.evaluate(unknown_lag.steering(), nominal=learning)
    assert found.violations == {}
    assert found["E"][-1, 1, 1] < classical()["E"][-1, 1, 1] - 0.5
    assert found.cost > classical().cost + 0.2 > combined().cost + 0.2


@pytest.mark.parametrize("start", [-3.0, 2.0, lambda s: 10 * np.sin(9 * s)])
def test_minimum_of_6_12_is_unique(start):
    """From several starts."""
    grid = graded(40)
    found = solve(unknown_lag.steering(), grid=grid, guess={"u": start})
    assert found.cost == pytest.approx(2.027146, abs=5e-6)


# --- Mars -------------------------------------------------------------------------------------------------------------

OPTIMUM = 5.7667749e-4


def rms(solution):
    """Range and altitude [ft], velocity [ft/s], path angle [rad]."""
    return [solution.deviation(n)[-1] * f for n, f in (("theta", RADIUS), ("h", 1.0), ("v", 1.0), ("gamma", 1.0))]


@cache
def mars(intervals):
    """From the constant lift-to-drag ratio; the finer mesh from the coarser one."""
    guess = None if intervals == 183 else mars(183)
    return solve(mars_entry.problem(), intervals=intervals, guess=guess)


def test_constant_lift_to_drag_ratio():
    """The reference row to the digits given: J, 5952 and 16973 ft, 28.76 ft/s, 0.0077; rms of the control 1.2e-3."""
    found = co.evaluate(mars_entry.problem(), nominal=mars_entry.reference(), intervals=183)
    assert found.cost == pytest.approx(6.57123e-4, abs=0.6e-9)
    assert (np.abs(np.subtract(rms(found), [5952, 16973, 28.76, 0.0077])) <= [0.5, 0.5, 0.005, 0.5e-4]).all()
    control = np.sqrt(2 * found.loop.cost["deviations on the way"] / (0.1 * 915))
    assert control == pytest.approx(1.2e-3, abs=0.5e-4)
    assert found.cost_terms["running"] == 0  # regularization holds u at 1/2
    assert set(found.violations) == {"final value of h", "final value of theta"}  # 29620 ft, not 29600
    assert found.violations["final value of h"] == pytest.approx(20, abs=0.5)
    o = found.optimality
    assert o.cost_identity < 1e-6
    assert o.cross_covariance < 1e-4
    assert o.conservation < 1e-7
    assert found.semidefinite


@pytest.mark.parametrize(("intervals", "error"), [(183, 1e-6), (366, 2e-7)])
def test_regularised_optimum(intervals, error):
    """J = 5.7667749e-4, which is given to 1e-8; on intervals of 5 s and of 2.5 s."""
    found = mars(intervals)
    assert found.cost == pytest.approx(OPTIMUM, rel=error)
    assert found.loop.expected_cost == pytest.approx(OPTIMUM, rel=error)
    assert found.cost_terms["deviations"] == pytest.approx(5.424501e-4, rel=1e-5)
    np.testing.assert_allclose(rms(found), [4213.9, 16358.4, 9.472, 0.00264], rtol=1e-3)
    assert found.deviation("theta")[-1] * RADIUS == pytest.approx(4213.9, abs=0.1)
    assert found.deviation("h")[-1] == pytest.approx(16358.4, abs=0.1)
    ratio = found["lift_to_drag"]
    np.testing.assert_allclose([ratio.min(), ratio.max()], [0.303, 0.793], atol=0.6e-3)
    assert found.semidefinite
    o = found.optimality
    assert o.cost_identity < error
    assert o.conservation < 1e-7
    assert found.stats["classical_cost"] == pytest.approx(6.571015e-4, rel=1e-5)
    assert found.violations == {}


def test_covariances_of_mars_stay_positive_semidefinite():
    """Scaled by the deviations: E, Xhat, their sum, and S, at all nodes."""
    found = mars(183)
    for matrices in (found["E"], found.loop.Xhat, found.loop.X, found["S"]):
        size = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2).clip(1e-300))
        scaled = matrices / size[:, :, None] / size[:, None, :]
        rank = np.linalg.eigvalsh(np.where(size[:, :, None] * size[:, None, :] > 1e-290, scaled, 0.0))
        assert rank.min() > -1e-7


def test_classical_design_of_mars_by_both_methods():
    """The nominal of the regularization alone, which the reference almost meets: u = 1/2 but for the miss of 20 ft."""
    found = [
        solve(mars_entry.problem(), method=m, intervals=183, nominal="deterministic") for m in ("ipopt", "gradient")
    ]
    for solution in found:
        np.testing.assert_allclose(solution["lift_to_drag"], 0.5, atol=2e-4)
        # the steps of 5 s that the nominal was found with are halved where covariances are added
        np.testing.assert_allclose([solution["h"][-1], solution["theta"][-1]], [29600.0, 0.5983], rtol=1e-5)
        assert solution.cost == pytest.approx(6.571015e-4, rel=1e-5)
    assert found[0].cost == pytest.approx(found[1].cost, rel=1e-6)


# --- spurious stationary points ---------------------------------------------------------------------------------------


def two_wells():
    """A cost with a good end near 0 and a bad one near -2.1; the start lies between them."""
    ocp = co.Problem(2.0, name="two wells")
    x = ocp.state("x", initial=-0.9, variance=0.02)
    u = ocp.control("u", lower=-2, upper=2)
    ocp.dynamics(x, u, noise=0.01)
    ocp.measurement("m", x, noise=0.02)
    ocp.minimize_expected(running=0.5 * u**2, terminal=1 - ca.cos(3 * x) + 0.2 * x**2)
    return ocp


def test_a_stationary_point_above_the_classical_design_is_reported():
    with pytest.warns(co.CovocpWarning, match="spurious stationary point") as caught:
        bad = solve(two_wells(), intervals=20, guess={"u": lambda s: np.full_like(s, -0.6)})
    assert bad["x"][-1] < -1.5
    assert bad.converged
    assert bad.optimality.stationarity < 1e-6
    assert bad.cost > bad.stats["classical_cost"] + 0.5
    text = str(caught[0].message)
    for part in ("nominal='deterministic'", f"{bad.cost:.8g}", f"{bad.stats['classical_cost']:.8g}"):
        assert part in text
    # what it advises; warnings are errors here
    good = solve(two_wells(), intervals=20, guess=solve(two_wells(), intervals=20, nominal="deterministic"))
    assert good.stats["classical_cost"] == pytest.approx(bad.stats["classical_cost"], rel=1e-9)
    assert good.cost < good.stats["classical_cost"]


@pytest.mark.parametrize("decay", [1.0, 2.0])
def test_no_false_alarm(decay):
    """Linear and quadratic: both designs are the same, on a coarse mesh too."""
    ocp = co.Problem(3.0, name="linear")
    x = ocp.state("x", initial=0.0, final=1.0, variance=0.1)
    u = ocp.control("u")
    ocp.dynamics(x, -decay * x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 1.0})
    found = solve(ocp, intervals=20)
    assert found.stats["classical_cost"] == pytest.approx(found.cost, rel=1e-9)
    assert solve(ocp, intervals=20, nominal="deterministic")["x"][-1] == pytest.approx(1.0, abs=1e-9)


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["npz", "json"])
@pytest.mark.parametrize("design", [combined, classical])
def test_a_closed_loop_survives_a_file(tmp_path, kind, design):
    """Covariances, gains, both costs, identities; with its problem the effect of a truth, without it words."""
    found, truth = design(), {"terminal_weight": 2.0}
    path = found.save(tmp_path / f"loop.{kind}")
    loaded = co.load(path)
    for name in ("E", "Xhat", "Z", "gain", "X"):
        np.testing.assert_array_equal(getattr(loaded.loop, name), getattr(found.loop, name))
    assert loaded.loop.cost == found.loop.cost
    assert loaded.loop.other_cost == found.loop.other_cost
    assert loaded.cost_terms == found.cost_terms
    assert loaded.optimised == found.optimised
    assert loaded.stats.get("classical_cost") == found.stats.get("classical_cost")
    assert loaded.optimality.as_dict() == pytest.approx(found.optimality.as_dict())
    for name in ("K", "C"):
        np.testing.assert_array_equal(loaded.gains[name], found.gains[name])
    np.testing.assert_array_equal(loaded.covariance("x", "b"), found.covariance("x", "b"))
    assert printed(loaded, alone=True) == str(found)
    with pytest.raises(co.CovocpError, match="problem"):
        co.evaluate(loaded, truth=truth)
    problem = unknown_lag.steering()
    whole = co.load(path, problem=problem)
    other = unknown_lag.steering(process_noise=2.0, measurement_noise=0.5)
    assert co.evaluate(whole, truth=other).cost == pytest.approx(co.evaluate(found, truth=other).cost, rel=1e-12)
    # a nominal needs no problem
    assert co.evaluate(problem, nominal=loaded).cost == pytest.approx(found.cost, rel=1e-9)


def test_a_loop_under_another_truth_survives_a_file(tmp_path):
    found = co.evaluate(combined(), truth=unknown_lag.steering(process_noise=2.0, measurement_noise=0.5))
    loaded = co.load(found.save(tmp_path / "truth.npz"))
    assert loaded.cost == found.cost == pytest.approx(2.47971, abs=0.6e-5)
    np.testing.assert_array_equal(loaded.loop.Z, found.loop.Z)
    assert loaded.loop.other_cost is None
    np.testing.assert_array_equal(loaded.covariance("x"), found.covariance("x"))
