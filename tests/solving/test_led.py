"""Loops whose nominal runs past where it shall be are led there as well, and the cheaper minimum counts."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.models import mars_entry
from covocp.transcription import ranked_starts

DURATION, START, VARIANCE, DENSITY = 4.308, (1.4618, -0.3626), 0.326, 0.0549
WEIGHTS, EFFORT = (4.54, 1.0), 0.246


def van_der_pol(start: tuple[float, float] = START) -> co.Problem:
    """x'' = mu (1 - x^2) x' - x + u with unknown mu, brought to rest by a loop."""
    problem = co.Problem(DURATION, name="van der Pol")
    x = problem.state("x", initial=start[0], variance=0.05)
    v = problem.state("v", initial=start[1], variance=0.05)
    mu = problem.unknown("mu", mean=1.0, variance=VARIANCE)
    u = problem.control("u")
    problem.dynamics(x, v)
    problem.dynamics(v, mu * (1 - x**2) * v - x + u, noise=0.02)
    problem.measurement("y", x, noise=DENSITY)
    problem.estimation_covariance()
    running = 0.5 * (x**2 + v**2) + 0.5 * EFFORT * u**2
    problem.minimize_expected(running=running, terminal_weight={x: WEIGHTS[0], v: WEIGHTS[1]})
    return problem


def expected_cost(solution: co.Solution) -> float:
    """Of the nominal found, by scipy: E forward, S backward; int L + tr(S E)/2 at 0 + int tr(S Q + B C E C')/2."""
    times, controls = solution.t, solution["u"]
    Q, A = np.diag([0.0, 0.02, 0.0]), np.diag([1.0, 1.0, 0.0])
    G = np.array([[0.0], [1.0], [0.0]])
    M = np.array([[1.0], [0.0], [0.0]])

    def slope(x: float, v: float) -> np.ndarray:
        return np.array([[0, 1, 0], [-2 * x * v - 1, 1 - x**2, (1 - x**2) * v], [0, 0, 0]])

    def forward(t: float, z: np.ndarray) -> np.ndarray:
        x, v, E = z[0], z[1], z[2:11].reshape(3, 3)
        u, F = np.interp(t, times, controls), slope(x, v)
        change = F @ E + E @ F.T + Q - E @ M @ M.T @ E / DENSITY
        own = 0.5 * (x**2 + v**2) + 0.5 * EFFORT * u**2
        return np.concatenate([[v, (1 - x**2) * v - x + u], change.ravel(), [own]])

    begin = np.concatenate([START, np.diag([0.05, 0.05, VARIANCE]).ravel(), [0.0]])
    tight = {"rtol": 1e-9, "atol": 1e-12, "dense_output": True, "max_step": 0.02}
    ahead = solve_ivp(forward, (0.0, DURATION), begin, **tight)

    def backward(t: float, z: np.ndarray) -> np.ndarray:
        S, along = z[:9].reshape(3, 3), ahead.sol(t)
        F, E = slope(along[0], along[1]), along[2:11].reshape(3, 3)
        C = G.T @ S / EFFORT
        paid = np.trace(S @ Q) + EFFORT * np.trace(C @ E @ C.T)
        return np.append(-(S @ F + F.T @ S + A - C.T @ C * EFFORT).ravel(), -0.5 * paid)

    end = np.append(np.diag([*WEIGHTS, 0.0]).ravel(), 0.0)
    back = solve_ivp(backward, (DURATION, 0.0), end, **tight)
    S, E = back.y[:9, -1].reshape(3, 3), np.diag([0.05, 0.05, VARIANCE])
    return float(ahead.y[11, -1] + 0.5 * np.trace(S @ E) + back.y[9, -1])


def test_the_cheaper_minimum_is_found_and_costs_what_scipy_finds() -> None:
    solver = co.Solver(van_der_pol())
    found = solver.solve(progress=False)
    path = np.array([1.46, 0.9, 0.35, -0.17, -0.78, -0.98])
    swinging = solver.solve(guess={"x": path}, progress=False, assess=False)
    assert found.stats["tried"] >= 2
    assert found.cost < 0.75 * swinging.cost
    for one in (found, swinging):
        assert one.cost == pytest.approx(expected_cost(one), rel=1e-4)


@pytest.mark.parametrize("start", [(-0.7, 1.3), (0.5, 0.9), (-1.4, -0.3)])
def test_no_start_of_several_is_cheaper(start: tuple[float, float]) -> None:
    solver = co.Solver(van_der_pol(start))
    kept = {"progress": False, "assess": False}
    found = solver.solve(progress=False)
    best = solver.solve(guess="multistart", starts=4, **kept).cost  # type: ignore[arg-type]
    paths = [{"x": start[0] + s * (end - start[0])} for end in (-0.7, 0.0, 0.7) for s in (0.5, 1.0)]
    led = [solver.solve(guess=path, **kept).cost for path in paths]  # type: ignore[arg-type]
    assert found.cost <= min(best, *led) * (1 + 1e-6)


def test_a_loop_that_goes_there_by_itself_or_is_affine_has_one_start() -> None:
    assert "tried" not in co.Solver(mars_entry.problem()).solve(progress=False, assess=False).stats
    problem = co.Problem(4.0)
    x, v = problem.state("x", initial=1.0, variance=0.1), problem.state("v", initial=0.0, variance=0.1)
    u = problem.control("u")
    problem.dynamics(x, v)
    problem.dynamics(v, -4.0 * x + u, noise=0.1)
    problem.measurement("y", x, noise=0.1)
    problem.estimation_covariance()
    problem.minimize_expected(running=x**2 + v**2 + u**2, terminal_weight={x: 1.0})
    assert "tried" not in co.solve(problem, progress=False).stats


def test_a_guess_of_how_it_moves_is_kept() -> None:
    """And so is one of its controls: nothing else is tried."""
    solver = co.Solver(van_der_pol())
    for guess in ({"u": np.linspace(0.5, 0.0, 5)}, {"x": np.linspace(START[0], -0.5, 5)}):
        assert "tried" not in solver.solve(guess=guess, progress=False, assess=False).stats


def test_where_the_cost_prefers_a_state_a_pendulum_is_led() -> None:
    """The rival of a pendulum that swings back and forth leads to the same minimum."""
    problem = co.Problem(4.0)
    a = problem.state("a", initial=1.2, variance=0.05)
    w = problem.state("w", initial=0.0, variance=0.05)
    k = problem.unknown("k", mean=4.0, variance=0.5)
    u = problem.control("u")
    problem.dynamics(a, w)
    problem.dynamics(w, -k * ca.sin(a) - 0.1 * w + u, noise=0.02)
    problem.measurement("y", a, noise=0.01)
    problem.estimation_covariance()
    problem.minimize_expected(running=0.5 * (a**2 + w**2) + 0.1 * u**2, terminal_weight={a: 3.0, w: 1.0})
    solver = co.Solver(problem)
    found = solver.solve(progress=False)
    assert found.stats["tried"] >= 2
    assert found.cost <= solver.solve(guess="multistart", progress=False, assess=False).cost * (1 + 1e-6)


def test_a_start_that_cannot_be_made_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("the model has no value on that line")

    monkeypatch.setattr(ranked_starts, "led", fails)
    monkeypatch.setattr(ranked_starts, "sides_of", lambda *_, **__: ())
    assert "tried" not in co.solve(van_der_pol((1.0, 0.0)), progress=False).stats
