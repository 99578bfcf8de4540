"""Expected costs of phases against the whole problem, independent integrations, and simulated runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from phased_loops import DRAG, NOISE, RESTITUTION, bounce, lag
from problems import unassessed
from read_again import printed
from scipy.integrate import solve_ivp

import covocp as co
from covocp.solution.flight import interpolated_flight

QUIET: dict[str, Any] = {"progress": False}
FORMS = ("eliminated", "states")


@pytest.fixture(scope="module")
def both() -> dict[str, co.PhasesSolution]:
    return {form: co.solve(bounce(), intervals=40, covariances=form, tolerance=1e-9, **QUIET) for form in FORMS}


@pytest.fixture(params=FORMS)
def bounced(request: pytest.FixtureRequest, both: dict[str, co.PhasesSolution]) -> co.PhasesSolution:
    return both[request.param]


def test_both_formulations_agree(both: dict[str, co.PhasesSolution]) -> None:
    one, other = (both[form] for form in FORMS)
    assert one.cost == pytest.approx(other.cost, rel=1e-8)
    for name in ("fall", "rise"):
        np.testing.assert_allclose(one[name].loop.Xhat, other[name].loop.Xhat, atol=1e-6)
        np.testing.assert_allclose(one[name].costates.matrices, other[name].costates.matrices, atol=1e-5)


@pytest.mark.parametrize("form", FORMS)
def test_a_problem_cut_in_two_has_cost_gains_and_covariances_of_the_whole(form: str) -> None:
    options = {"covariances": form, "tolerance": 1e-10}
    whole = unassessed(lag(10.0, "whole"), intervals=100, **options)
    parts = co.Phases([lag(4.0, "A", last=False), lag(6.0, "B", first=False)])
    cut = co.solve(parts, intervals=[40, 60], **options, **QUIET)
    assert cut.cost == pytest.approx(whole.cost, rel=1e-8)
    assert max(cut.link_residuals) < 1e-6
    t = np.concatenate([cut["A"].t[:-1], 4.0 + cut["B"].t])
    for name in ("E", "S"):
        np.testing.assert_allclose(cut.at(t)[name], whole.at(t)[name], rtol=1e-5, atol=1e-7, err_msg=name)
    nodes = {"A": (0, 4.0), "B": (4.0, 10.0)}
    for phase in cut:
        begin, end = nodes[phase.name]
        inside = (whole.t >= begin - 1e-9) & (whole.t <= end + 1e-9)
        own = np.array([np.abs(whole.t[inside] - begin - t).argmin() for t in phase.t])
        np.testing.assert_allclose(whole.t[inside][own] - begin, phase.t, atol=0.06)  # meshes are graded where E is
        same = np.abs(whole.t[inside][own] - begin - phase.t) < 1e-9
        assert same.sum() > 30
        for found, known in (
            (phase.gains["C"], whole.gains["C"]),
            (phase.loop.Xhat, whole.loop.Xhat),
            (phase.loop.X, whole.loop.X),
        ):
            np.testing.assert_allclose(found[same], known[inside][own][same], rtol=1e-5, atol=1e-6)
    # the effect on the mean goes on through the phases
    effects = [phase.mean_effect for phase in cut]
    assert whole.mean_effect is not None
    assert sum(effect.cost for effect in effects) == pytest.approx(whole.mean_effect.cost, rel=1e-4)


def test_the_necessary_conditions_hold(bounced: co.PhasesSolution) -> None:
    assert max(bounced.link_residuals) < 1e-7
    for phase in bounced:
        residuals = phase.optimality
        assert residuals.stationarity < 1e-6
        assert residuals.costate_difference < 1e-6
        assert residuals.cross_covariance < 1e-7  # Z = 0
        assert residuals.conservation < 1e-10
        assert residuals.cost_identity < 1e-7
        assert phase.loop.other_cost == pytest.approx(phase.loop.expected_cost, rel=1e-7)
    assert bounced["fall"].optimality.transversality < 1e-6


def test_a_final_value_of_an_inner_phase_is_weighed_by_the_next_one(bounced: co.PhasesSolution) -> None:
    """x is prescribed where the body hits the ground, without a weight: what missing it costs is in S."""
    assert bounced["fall"].values["S"][-1][0, 0] > 0.1
    assert bounced["fall"]["x"][-1] == pytest.approx(0.1, abs=1e-9)


def test_files_keep_the_loops_of_phases(bounced: co.PhasesSolution, tmp_path: Path) -> None:
    path = bounced.save(tmp_path / "bounce.npz")
    for read, alone in ((co.load(path), True), (co.load(path, bounce()), False)):
        assert printed(read, alone=alone) == str(bounced)
        np.testing.assert_array_equal(read["rise"].within.deviations, bounced["rise"].within.deviations)
    other = bounce()
    other.problems[1].parameter("unused", 1.0)
    with pytest.raises(co.ProblemError, match="another problem"):
        co.load(path, other)


def test_what_a_later_phase_cannot_do_alone_is_refused(bounced: co.PhasesSolution, tmp_path: Path) -> None:
    with pytest.raises(co.ProblemError, match="begins with what the feedback before it left"):
        co.simulate(bounced["rise"], runs=10, seed=1, **QUIET)
    with pytest.raises(co.ProblemError, match="begins with what the feedback before it left"):
        co.export_c(bounced["rise"], tmp_path / "rise")
    assert interpolated_flight(bounced["rise"]).worst < 1.001  # it flies as predicted, from where it begins


def _fall(x: float, v: float) -> tuple[np.ndarray, ...]:
    """F, G, Q, information, A, N of the fall over x, v, r, k."""
    size = np.sqrt(v**2 + 0.01)
    F = np.zeros((4, 4))
    F[0, 1], F[1, 1], F[1, 3] = 1.0, -DRAG * (size + v**2 / size), -v * size
    return F, np.eye(4)[:, 1:2], np.diag([0.01, 0.02, 0, 0]), np.diag([10.0, 0, 0, 0]), np.diag([0.2, 0, 0, 0])


def _rise(x: float, v: float) -> tuple[np.ndarray, ...]:
    """The same of the rise over x, v, q, r, k."""
    size = np.sqrt(v**2 + 0.01)
    F = np.zeros((5, 5))
    F[0, 1] = F[1, 2] = 1.0
    F[1, 1], F[1, 4], F[2, 2] = -DRAG * (size + v**2 / size), -v * size, -1.0
    noise, information = np.diag([0.01, 0.02, 0.05, 0, 0]), np.diag([10.0, 5.0, 0, 0, 0])
    return F, np.eye(5)[:, 1:2], noise, information, np.diag([0, 0.2, 0, 0, 0])


def test_covariances_weights_and_cost_are_those_of_an_independent_integration(bounced: co.PhasesSolution) -> None:
    """E and Xhat forward, S backward through the jump, and the cost as terminal and running expectations."""
    fall, rise = bounced
    models, speed = {"fall": _fall, "rise": _rise}, fall["v"][-1]
    J, added = np.zeros((5, 4)), np.diag([0.0, NOISE * (1.0 + speed**2), 0.3, 0.0, 0.0])
    J[0, 0] = J[3, 2] = J[4, 3] = 1.0
    J[1, 1], J[1, 2] = -RESTITUTION, -speed

    def at(phase: co.Solution, t: float) -> tuple[np.ndarray, ...]:
        sample = phase.at(float(np.clip(t, 0.0, phase.duration)))
        return models[phase.name](float(sample["x"]), float(sample["v"]))

    def back(phase: co.Solution, end: np.ndarray) -> Any:
        def rate(t: float, s: np.ndarray) -> np.ndarray:
            F, G, _, _, A = at(phase, phase.duration - t)
            S = s.reshape(F.shape)
            return (F.T @ S + S @ F + A - S @ G @ G.T @ S).ravel()

        return solve_ivp(rate, (0.0, phase.duration), end.ravel(), rtol=1e-9, atol=1e-11, dense_output=True)

    later = back(rise, np.diag([3.0, 1.0, 0, 0, 0]))
    S_jump = later.y[:, -1].reshape(5, 5)
    np.testing.assert_allclose(rise.values["S"][0], S_jump, atol=2e-6)
    first = back(fall, np.diag([0.0, 0.4, 0, 0]) + J.T @ S_jump @ J)
    np.testing.assert_allclose(fall.values["S"][-1], np.diag([0, 0.4, 0, 0]) + J.T @ S_jump @ J, atol=2e-6)
    np.testing.assert_allclose(fall.values["S"][0], first.y[:, -1].reshape(4, 4), atol=2e-6)

    def forth(phase: co.Solution, weight: Any, E: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        n = E.shape[0]

        def rate(t: float, z: np.ndarray) -> np.ndarray:
            F, G, Q, W, A = at(phase, t)
            E, X = z[: n * n].reshape(n, n), z[n * n : 2 * n * n].reshape(n, n)
            C = G.T @ weight.sol(phase.duration - t).reshape(n, n)
            gained, closed = E @ W @ E, F - G @ C
            dE = F @ E + E @ F.T + Q - gained
            dX = closed @ X + X @ closed.T + gained
            return np.concatenate([dE.ravel(), dX.ravel(), [0.5 * np.sum(A * (E + X)) + 0.5 * np.sum(C @ X @ C.T)]])

        start = np.concatenate([E.ravel(), X.ravel(), [0.0]])
        end = solve_ivp(rate, (0.0, phase.duration), start, rtol=1e-8, atol=1e-10).y[:, -1]
        return end[: n * n].reshape(n, n), end[n * n : -1].reshape(n, n), float(end[-1])

    E, X, cost = forth(fall, first, np.diag([0.1, 0.2, 0.04, 0.01]), np.zeros((4, 4)))
    np.testing.assert_allclose(fall.loop.Xhat[-1], X, atol=2e-6)
    cost += 0.5 * 0.4 * (E + X)[1, 1]
    assert fall.cost_terms["deviations"] == pytest.approx(cost, rel=1e-5)
    E, X = J @ E @ J.T + added, J @ X @ J.T
    np.testing.assert_allclose(rise.loop.Xhat[0], X, atol=2e-6)
    np.testing.assert_allclose(rise.loop.X[0], E + X, atol=4e-6)
    E, X, own = forth(rise, later, E, X)
    np.testing.assert_allclose(rise.loop.Xhat[-1], X, atol=4e-6)
    own += 0.5 * (3.0 * (E + X)[0, 0] + (E + X)[1, 1])
    assert rise.cost_terms["deviations"] == pytest.approx(own, rel=1e-5)
    plain = sum(phase.cost_terms[name] for phase in bounced for name in ("terminal", "running"))
    assert bounced.cost == pytest.approx(plain + cost + own, rel=1e-5)


def _kicked(name: str, *, first: bool, bent: float = 0.0) -> co.Problem:
    """An integrator that is measured and moved by noise, for one second."""
    ocp = co.Problem(1.0, name=name)
    x = ocp.state("x", initial=1.0 if first else None, variance=0.3 if first else None)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=0.2)
    ocp.measurement("position", x, noise=0.05)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=0.0 if first else 2.0 * x**2)
    return ocp


@pytest.mark.parametrize("bend", [0.0, 0.2])
def test_cost_and_mean_are_those_of_simulated_runs(bend: float) -> None:
    """x+ = -0.8 x + bend x^2 + noise: the rest is linear, so that cost and effect on the mean are exact to first order.

    Runs by Euler's method with the true state and the filter of the linearised system.
    """
    one, two = _kicked("one", first=True), _kicked("two", first=False)
    x, y = one.states[0].symbol, two.states[0].symbol
    phases = co.Phases([one, two])
    phases.jump(y, -0.8 * x + bend * x**2, noise=0.1)
    solution = co.solve(phases, intervals=40, tolerance=1e-9, **QUIET)
    runs, steps, random = 40_000, 250, np.random.default_rng(5)
    d, estimate = random.normal(0.0, np.sqrt(0.3), runs), np.zeros(runs)
    cost, h = np.zeros(runs), 1.0 / steps
    for phase in solution:
        if phase.name == "two":
            before = solution["one"]["x"][-1]
            d = -0.8 * d + bend * ((before + d) ** 2 - before**2) + random.normal(0.0, np.sqrt(0.1), runs)
            estimate = (-0.8 + 2.0 * bend * before) * estimate
        sample = phase.at((np.arange(steps) + 0.5) * h)
        C = np.interp((np.arange(steps) + 0.5) * h, phase.t, phase.gains["C"][:, 0, 0])
        for k in range(steps):
            du = -C[k] * estimate
            cost += h * (0.5 * (sample["u"][k] + du) ** 2 + (sample["x"][k] + d) ** 2)
            K = sample["E"][k, 0, 0] / 0.05
            seen = K * (h * (d - estimate) + random.normal(0.0, np.sqrt(0.05 * h), runs))
            d, estimate = d + h * du + random.normal(0.0, np.sqrt(0.2 * h), runs), estimate + h * du + seen
    cost += 2.0 * (solution["two"]["x"][-1] + d) ** 2
    effects = [phase.mean_effect for phase in solution]
    predicted = solution.cost + sum(effect.cost for effect in effects)
    error = cost.std() / np.sqrt(runs)
    assert predicted == pytest.approx(cost.mean(), abs=3.5 * error + 0.01 * cost.mean() * (1.0 + 4.0 * bend))
    assert effects[-1].mean[-1, 0] == pytest.approx(d.mean(), abs=4.0 * d.std() / np.sqrt(runs))
    np.testing.assert_allclose(solution["two"].loop.X[-1, 0, 0], d.var(), rtol=0.03 + bend)
    if bend:
        assert abs(effects[0].mean).max() == 0.0
        assert effects[1].mean[0, 0] > 0.03
