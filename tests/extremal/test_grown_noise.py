"""What deviations add to noise that varies with state and control: against the exact moments of linear systems."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co

QUIET = {"progress": False}
Curve = Callable[[float], float]


def lag(T: float = 4.0, *, q: tuple[float, float] = (0.3, 0.4), v: tuple[float, float] = (0.1, 0.2)) -> co.Problem:
    """x' = -x/2 + u, whose process and measurement noise grow with x^2 and u^2 by these factors."""
    ocp = co.Problem(T, name="noise that grows")
    x, u = ocp.state("x", initial=1.0, variance=0.6), ocp.control("u")
    ocp.dynamics(x, -0.5 * x + u, noise=0.1 + q[0] * x**2 + q[1] * u**2)
    ocp.measurement("m", x, noise=0.05 + v[0] * x**2 + v[1] * u**2)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=2.0 * x**2)
    return ocp


def exact(solution: co.Solution, q: tuple[float, float], v: tuple[float, float], *, grows: bool = True) -> float:
    """Expected cost along the nominal and the gains of a solution; without `grows` with the noise of the nominal."""
    at_nodes, C = solution.t, solution.loop.gain[:, 0, 0]

    def moments(t: float, z: np.ndarray) -> list[float]:
        dd, dy, yy, _ = z
        sample = solution.at(t)
        x, u, E, c = float(sample["x"]), float(sample["u"]), float(sample["E"][0, 0]), np.interp(t, at_nodes, C)
        X, U = (dd, c**2 * yy) if grows else (0.0, 0.0)
        Q, R = 0.1 + q[0] * (x**2 + X) + q[1] * (u**2 + U), 0.05 + v[0] * (x**2 + X) + v[1] * (u**2 + U)
        K = E / (0.05 + v[0] * x**2 + v[1] * u**2)
        # d' = -d/2 - c y + n,  y' = -y/2 - c y + K (d - y + noise)
        a, b = -0.5, -0.5 - c - K
        return [
            2 * (a * dd - c * dy) + Q,
            a * dy - c * yy + K * dd + b * dy,
            2 * (K * dy + b * yy) + K**2 * R,
            0.5 * (u**2 + c**2 * yy) + x**2 + dd,
        ]

    whole = solve_ivp(moments, (0.0, at_nodes[-1]), [0.6, 0.0, 0.0, 0.0], rtol=1e-7, atol=1e-9, max_step=0.02).y[:, -1]
    return float(whole[3] + 2.0 * (float(solution.at(at_nodes[-1])["x"]) ** 2 + whole[0]))


@pytest.mark.parametrize(("q", "v"), [((0.3, 0.4), (0.0, 0.0)), ((0.0, 0.0), (0.1, 0.2)), ((0.3, 0.4), (0.1, 0.2))])
def test_the_cost_of_a_linear_system_with_quadratic_densities_is_exact(q, v):
    solution = co.solve(lag(q=q, v=v), intervals=120, **QUIET)
    effect = solution.mean_effect
    assert exact(solution, q, v, grows=False) == pytest.approx(solution.cost, rel=2e-4)
    left_out = exact(solution, q, v) - exact(solution, q, v, grows=False)
    assert effect.noise_cost == pytest.approx(left_out, rel=5e-3)
    assert effect.noise_cost > 0.02 * solution.cost
    assert abs(effect.cost) < 1e-12  # nothing bends
    assert "not in the cost: noise that varies with state and control adds +" in str(solution)


def test_constant_controls_have_their_own_at_both_ends_of_an_interval():
    held = co.solve(lag(), intervals=200, control="constant", **QUIET).mean_effect.noise_cost
    assert held == pytest.approx(co.solve(lag(), intervals=120, **QUIET).mean_effect.noise_cost, rel=5e-3)


def test_densities_that_do_not_bend_add_nothing():
    """A density that is linear in what deviates has the mean of the nominal."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=1.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, u, noise=0.5 + 0.1 * x)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=u**2 + x**2)
    solution = co.solve(ocp, intervals=20, **QUIET)
    assert solution.mean_effect.noise_cost == 0.0
    assert "not in the cost" not in str(solution)


def test_variances_of_readings_grow_too():
    """One reading halfway, its variance by x^2: in closed form, the feedback between jumps being linear."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=1.0, variance=0.6), ocp.control("u")
    ocp.dynamics(x, u, noise=0.01)
    ocp.measurement("seen", x, noise=0.05 + 0.3 * x**2, at=[1.0])
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=2.0 * x**2)
    solution = co.solve(ocp, intervals=100, **QUIET)
    k = int(np.flatnonzero(np.diff(solution.t) == 0.0)[0])
    before, after = solution.loop.E[k, 0, 0], solution.loop.E[k + 1, 0, 0]
    K = 1.0 - after / before
    added = 0.3 * solution.loop.X[k, 0, 0]  # R is larger by 0.3 <d^2>
    gain, t = solution.loop.gain[k + 1 :, 0, 0], solution.t[k + 1 :]
    # after it d' = -c y, y' = -c y: what the reading adds to <y^2> is decay and cost of both
    phi = np.exp(-np.append(0.0, np.cumsum(0.5 * (gain[1:] + gain[:-1]) * np.diff(t))))
    y2 = K**2 * added * phi**2
    d2 = K**2 * added * (phi - 1.0) ** 2
    cost = np.trapezoid(0.5 * gain**2 * y2 + d2, t) + 2.0 * d2[-1]
    assert solution.mean_effect.noise_cost == pytest.approx(cost, rel=2e-3)


def test_what_a_phase_adds_goes_on_into_the_next():
    whole = co.solve(lag(4.0), intervals=120, **QUIET)

    def part(T: float, name: str, *, first: bool, last: bool) -> co.Problem:
        ocp = co.Problem(T, name=name)
        x = ocp.state("x", initial=1.0 if first else None, variance=0.6 if first else 0.0)
        u = ocp.control("u")
        ocp.dynamics(x, -0.5 * x + u, noise=0.1 + 0.3 * x**2 + 0.4 * u**2)
        ocp.measurement("m", x, noise=0.05 + 0.1 * x**2 + 0.2 * u**2)
        ocp.minimize_expected(running=0.5 * u**2 + x**2, **({"terminal": 2.0 * x**2} if last else {}))
        return ocp

    phases = co.Phases([part(1.5, "A", first=True, last=False), part(2.5, "B", first=False, last=True)])
    cut = co.solve(phases, intervals=[45, 75], **QUIET)
    assert cut.cost == pytest.approx(whole.cost, rel=1e-4)
    found = sum(phase.mean_effect.noise_cost for phase in cut)
    assert found == pytest.approx(whole.mean_effect.noise_cost, rel=2e-3)


def test_a_file_remembers_it(tmp_path):
    solution = co.solve(lag(), intervals=40, **QUIET)
    assert co.load(solution.save(tmp_path / "lag.npz")).mean_effect.noise_cost == solution.mean_effect.noise_cost


def test_an_unknown_and_several_noises_that_are_correlated():
    """Against 40,000 simulated runs."""
    ocp = co.Problem(1.0)
    x, b, u = ocp.state("x", 2, initial=[1.0, 0.0], variance=0.02), ocp.unknown("b", 1.0, 0.02), ocp.control("u")
    noise = ca.blockcat([[0.1 + 0.2 * x[0] ** 2 * b, 0.02 * x[1] * u], [0.02 * x[1] * u, 0.1 + 0.05 * ca.exp(b * u)]])
    ocp.dynamics(x, ca.vertcat(x[1], u - x[0]), noise=noise)
    ocp.measurement("m", x[0], noise=0.05)
    ocp.minimize_expected(running=0.5 * u**2 + ca.sumsqr(x), terminal=ca.sumsqr(x))
    solution = co.solve(ocp, intervals=30, **QUIET)
    runs = co.simulate(solution, runs=40_000, seed=3, progress=False)
    effect = solution.mean_effect
    assert effect.noise_cost > 4 * runs.cost_error
    assert abs(runs.cost - solution.cost - effect.cost - effect.noise_cost) < 4 * runs.cost_error
