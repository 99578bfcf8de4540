"""Bounded controls that make unknowns known: minima of other numbers of switches are compared."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co

PIECES = 8


def lag() -> co.Problem:
    """x' = -a x + b u with unknown a and b, |u| <= 1 over 8 s; the largest eigenvalue of their covariance costs."""
    problem = co.Problem(8.0)
    x = problem.state("x", initial=0.0, variance=0.1)
    a, b = (problem.unknown(name, mean=1.0, variance=0.3) for name in "ab")
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, -a * x + b * u, noise=0.01)
    problem.measurement("y", x, noise=0.05)
    E = problem.estimation_covariance()
    half = 0.5 * (E[a, a] - E[b, b])
    problem.minimize(terminal=0.5 * (E[a, a] + E[b, b]) + ca.sqrt(half**2 + E[a, b] ** 2 + 1e-14))
    return problem


def duffing() -> co.Problem:
    """x'' = -p x - q x^3 - x'/5 + u with unknown p and q, |u| <= 0.6 over 10 s."""
    problem = co.Problem(10.0)
    x = problem.state("x", initial=0.0, variance=0.01)
    v = problem.state("v", initial=0.0, variance=0.01)
    p = problem.unknown("p", mean=1.0, variance=0.2)
    q = problem.unknown("q", mean=0.5, variance=0.2)
    u = problem.control("u", lower=-0.6, upper=0.6)
    problem.dynamics(x, v)
    problem.dynamics(v, -p * x - q * x**3 - 0.2 * v + u, noise=0.002)
    problem.measurement("y", x, noise=0.02)
    E = problem.estimation_covariance()
    problem.minimize(terminal=ca.log(E[p, p] * E[q, q] - E[p, q] ** 2))
    return problem


def log_det_of_duffing(times: np.ndarray, controls: np.ndarray) -> float:
    """ln det of the covariance of p and q along controls that are linear between these times, by scipy."""

    def rates(t: float, z: np.ndarray) -> np.ndarray:
        x, v, E = z[0], z[1], z[2:].reshape(4, 4)
        u = np.interp(t, times, controls)
        F = np.array([[0, 1, 0, 0], [-1 - 1.5 * x**2, -0.2, -x, -(x**3)], [0, 0, 0, 0], [0, 0, 0, 0]])
        Q = np.diag([0, 0.002, 0, 0])
        change = F @ E + E @ F.T + Q - np.outer(E[:, 0], E[0]) / 0.02
        return np.concatenate([[v, -x - 0.5 * x**3 - 0.2 * v + u], change.ravel()])

    begin = np.concatenate([[0.0, 0.0], np.diag([0.01, 0.01, 0.2, 0.2]).ravel()])
    found = solve_ivp(rates, (0.0, 10.0), begin, rtol=1e-9, atol=1e-12, max_step=0.1)
    return float(np.linalg.slogdet(found.y[2:, -1].reshape(4, 4)[2:, 2:])[1])


def switching(pieces: int, size: float) -> np.ndarray:
    """101 values that change their sign between so many equal parts."""
    return np.where(np.arange(101) * pieces // 101 % 2 == 0, size, -size)


@pytest.mark.parametrize(("make", "size"), [(lag, 0.95), (duffing, 0.57)])
def test_no_even_switching_leads_to_a_cheaper_minimum(make: Callable[[], co.Problem], size: float) -> None:
    solver = co.Solver(make())
    found = solver.solve(progress=False)
    assert found.stats["excited"]
    assert "another number of switches" in " ".join(str(found).split())
    kept = {"progress": False, "allow_failure": True, "assess": False}
    others = [solver.solve(guess={"u": switching(count, size)}, **kept) for count in range(1, PIECES + 1)]
    least = min(one.cost for one in others if one.converged)
    assert found.cost <= least + 2e-3 * abs(least)


def test_what_is_found_is_what_scipy_finds_along_it_and_beats_what_its_own_start_leads_to() -> None:
    solver = co.Solver(duffing())
    found, alone = (solver.solve(progress=False, assess=assess) for assess in (True, False))
    costs = [log_det_of_duffing(one.t, one["u"]) for one in (found, alone)]
    assert found.cost == pytest.approx(costs[0], abs=1e-4)
    assert costs[0] < costs[1] - 0.4  # a determinant that is a third smaller


def test_limits_and_guesses_are_kept() -> None:
    solver = co.Solver(lag())
    guess = {"u": switching(1, 0.5)}
    for given in ({"iteration_limit": 500}, {"time_limit": 100.0}, {"guess": guess}, {"assess": False}):
        assert "excited" not in solver.solve(progress=False, **given).stats, given
    assert "excited" not in co.solve(lag(), progress=False, max_iterations=500).stats
    assert solver.solve(progress=False).stats["excited"]


@pytest.mark.parametrize(
    ("method", "intervals"), [("auto", 100), ("reduced", 100), ("gradient", 100), ("gradient", 50)]
)
def test_other_methods_are_led_there_too(method: str, intervals: int) -> None:
    """Also on a mesh that is too coarse to be thinned."""
    assert co.solve(lag(), method, intervals=intervals, progress=False).cost < 0.0725  # 0.0851 without, 0.0712 at best


def test_a_control_without_bounds_is_not_looked_at() -> None:
    problem = co.Problem(8.0)
    x = problem.state("x", initial=0.0, variance=0.1)
    a = problem.unknown("a", mean=1.0, variance=0.3)
    u = problem.control("u")
    problem.dynamics(x, -a * x + u, noise=0.01)
    problem.measurement("y", x, noise=0.05)
    E = problem.estimation_covariance()
    problem.minimize(running=0.01 * u**2, terminal=E[a, a])
    assert "excited" not in co.solve(problem, progress=False).stats


def decay() -> co.Problem:
    """y' = -b y x with unknown b: seen well where x is negative, |x'| <= 1, and y grows; x ends at zero."""
    problem = co.Problem(6.2)
    x = problem.state("x", initial=0.73, final=0.0, variance=0.1)
    y = problem.state("y", initial=0.5, variance=0.2)
    b = problem.unknown("b", mean=2.5, variance=0.3)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, u, noise=0.02)
    problem.dynamics(y, -b * y * x, noise=0.01)
    problem.measurement("m", y, noise=0.0366)
    E = problem.estimation_covariance()
    problem.minimize(running=0.5 * u**2, terminal=85.0 * E[b, b])
    return problem


def cost_of_decay(times: np.ndarray, controls: np.ndarray) -> tuple[float, float]:
    """Cost and x at the end along controls that are linear between these times, by scipy."""

    def rates(t: float, z: np.ndarray) -> np.ndarray:
        x, y, E = z[0], z[1], z[2:11].reshape(3, 3)
        u = np.interp(t, times, controls)
        F = np.array([[0, 0, 0], [-2.5 * y, -2.5 * x, -x * y], [0, 0, 0]])
        change = F @ E + E @ F.T + np.diag([0.02, 0.01, 0]) - np.outer(E[:, 1], E[1]) / 0.0366
        return np.concatenate([[u, -2.5 * y * x], change.ravel(), [0.5 * u**2]])

    begin = np.concatenate([[0.73, 0.5], np.diag([0.1, 0.2, 0.3]).ravel(), [0.0]])
    found = solve_ivp(rates, (0.0, 6.2), begin, method="LSODA", rtol=1e-8, atol=1e-11, max_step=0.05).y[:, -1]
    return float(found[11] + 85.0 * found[10]), float(found[0])


# y grows e^12-fold there, and its variance
@pytest.mark.filterwarnings("ignore:The integration steps are long", "ignore:What the steps are off grows")
@pytest.mark.parametrize("intervals", [30, 60, 100])
def test_the_side_that_tells_more_is_found_from_a_small_control_on_the_other(intervals: int) -> None:
    """Full speed there and back is far from the controls of the dear minimum, and costs a fifth of it."""
    times = np.linspace(0.0, 6.2, 621)
    there, end = cost_of_decay(times, np.where(times < 0.5 * (6.2 + 0.73), -1.0, 1.0))
    assert abs(end) < 0.02
    found = co.solve(decay(), intervals=intervals, progress=False)
    assert found.cost < there
    assert cost_of_decay(found.t, found["u"])[0] == pytest.approx(found.cost, rel=1e-3)
