"""A free duration in which something is learnt: minima of other durations are compared."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co

WEIGHT, SPRING, VARIANCE, DENSITY = 7.5, 2.0, 0.39, 0.4
INTERVALS = 60


def oscillator(duration: float | co.Free, start: float = -0.83) -> co.Problem:
    """x'' = -k x - x'/5 + u with unknown k, |u| <= 2: time and energy are paid, and the variance of k at the end."""
    problem = co.Problem(duration, name="oscillator")
    x = problem.state("x", initial=start, variance=0.1)
    v = problem.state("v", initial=0.0, variance=0.1)
    k = problem.unknown("k", mean=SPRING, variance=VARIANCE)
    u = problem.control("u", lower=-2.0, upper=2.0)
    problem.dynamics(x, v)
    problem.dynamics(v, -k * x - 0.2 * v + u, noise=0.05)
    problem.measurement("y", x, noise=DENSITY)
    E = problem.estimation_covariance()
    problem.minimize(running=0.05 + 0.2 * u**2, terminal=WEIGHT * E[k, k])
    return problem


def cost_by_scipy(solution: co.Solution, start: float = -0.83) -> float:
    """What the controls found cost, integrated by scipy."""
    times, controls = solution.t, solution["u"]

    def rates(t: float, z: np.ndarray) -> np.ndarray:
        x, v, E = z[0], z[1], z[2:11].reshape(3, 3)
        u = np.interp(t, times, controls)
        F = np.array([[0, 1, 0], [-SPRING, -0.2, -x], [0, 0, 0]])
        change = F @ E + E @ F.T + np.diag([0, 0.05, 0]) - np.outer(E[:, 0], E[0]) / DENSITY
        return np.concatenate([[v, -SPRING * x - 0.2 * v + u], change.ravel(), [0.05 + 0.2 * u**2]])

    begin = np.concatenate([[start, 0.0], np.diag([0.1, 0.1, VARIANCE]).ravel(), [0.0]])
    found = solve_ivp(rates, (0.0, times[-1]), begin, rtol=1e-9, atol=1e-12, max_step=0.1)
    return float(WEIGHT * found.y[10, -1] + found.y[11, -1])


@cache
def of_free_duration(guess: float) -> co.Solution:
    return co.solve(oscillator(co.Free(guess, 0.2, 60.0)), intervals=INTERVALS, progress=False)


def cost_of(problem: co.Problem, intervals: int = INTERVALS) -> float:
    """Of a fixed duration."""
    return co.Solver(problem, intervals=intervals).solve(progress=False, assess=False).cost


@pytest.fixture(scope="module")
def least() -> float:
    """The least cost of all fixed durations, each solved by itself."""
    return min(cost_of(oscillator(float(T))) for T in np.arange(2.0, 14.0, 0.5))


@pytest.mark.parametrize("guess", [2.0, 3.0, 12.0, 30.0])
def test_no_fixed_duration_is_cheaper(guess: float, least: float) -> None:
    found = of_free_duration(guess)
    assert found.cost <= least * 1.001
    assert cost_by_scipy(found) == pytest.approx(found.cost, rel=1e-3)


@pytest.mark.parametrize("method", ["auto", "reduced"])
def test_other_methods_are_led_there_too(method: str, least: float) -> None:
    assert (
        co.solve(oscillator(co.Free(3.0, 0.2, 60.0)), method, intervals=INTERVALS, progress=False).cost <= least * 1.001
    )


def test_the_printout_says_what_was_left_and_limits_and_guesses_are_kept() -> None:
    solver = co.Solver(oscillator(co.Free(3.0, 0.2, 60.0)), intervals=INTERVALS)
    found = of_free_duration(3.0)
    left = found.stats["left_duration"]
    assert left < found.duration
    assert f"a duration of {left:.3g} s" in " ".join(str(found).split())
    guess = {"u": np.full(11, 0.5)}
    for given in ({"iteration_limit": 500}, {"time_limit": 100.0}, {"guess": guess}, {"guess": found}):
        assert "left_duration" not in solver.solve(progress=False, **given).stats, given  # type: ignore[arg-type]
    alone = solver.solve(progress=False, assess=False)
    assert alone.cost > 1.05 * found.cost
    assert alone.duration == pytest.approx(left, rel=1e-3)


def test_limits_of_the_duration_are_kept() -> None:
    found = co.solve(oscillator(co.Free(3.0, 2.0, 4.5)), intervals=INTERVALS, progress=False)
    assert 2.0 - 1e-6 <= found.duration <= 4.5 + 1e-6
    assert found.cost <= min(cost_of(oscillator(float(T))) for T in np.arange(2.0, 4.6, 0.25)) * 1.001


def vehicle(duration: float | co.Free) -> co.Problem:
    """It learns its speed and where it is from the range of a beacon, and pays time and turns."""
    problem = co.Problem(duration)
    x, y = (problem.state(name, initial=0.0, variance=0.2) for name in "xy")
    heading = problem.state("heading", initial=0.1338)
    speed = problem.unknown("speed", mean=1.0, variance=0.2008)
    turn = problem.control("turn", lower=-1.0, upper=1.0)
    problem.dynamics(x, speed * ca.cos(heading), noise=0.01)
    problem.dynamics(y, speed * ca.sin(heading), noise=0.01)
    problem.dynamics(heading, turn)
    problem.measurement("range", ca.sqrt((x - 1.376) ** 2 + (y + 0.9115) ** 2 + 0.1), noise=0.0175)
    E = problem.estimation_covariance()
    problem.minimize(running=0.02 + 0.05 * turn**2, terminal=E[x, x] + E[y, y] + 1.051 * E[speed, speed])
    return problem


def test_a_vehicle_does_not_stop_before_it_has_learnt() -> None:
    """From the second guess it ended after half a second, at 2.8 times the cost."""
    fixed = min(cost_of(vehicle(T)) for T in (3.0, 3.4, 3.8, 4.2))
    for guess in (4.0, 10.0):
        found = co.solve(vehicle(co.Free(guess, 0.2, 60.0)), intervals=INTERVALS, progress=False)
        assert found.cost <= fixed * 1.001


def loop(duration: float | co.Free) -> co.Problem:
    """A spring of unknown rate that is brought over and held under its feedback: two durations are minima."""
    problem = co.Problem(duration, name="loop")
    x = problem.state("x", initial=-3.0, final=1.0, variance=0.1)
    v = problem.state("v", initial=0.0, final=0.0, variance=0.1)
    b, u = problem.unknown("b", mean=1.8, variance=0.2), problem.control("u", lower=-4.0, upper=4.0, guess=0.1)
    problem.dynamics(x, v)
    problem.dynamics(v, u - b * x - 0.2 * v, noise=0.01)
    problem.measurement("m", x, noise=0.0017)
    problem.minimize_expected(running=0.3 + 0.5 * u**2 + 0.1 * x**2, terminal_weight={x: 3.0, v: 1.0})
    return problem


@pytest.fixture(scope="module")
def costs_of_loops() -> list[float]:
    return [cost_of(loop(T), 40) for T in (2.1, 2.2, 2.3, 2.4, 3.0, 5.0, 6.4, 6.8, 7.2, 9.0)]


@pytest.mark.parametrize("guess", [2.5, 7.5, 10.0])
def test_no_fixed_duration_of_a_loop_is_cheaper(guess: float, costs_of_loops: list[float]) -> None:
    costs = costs_of_loops
    assert costs[5] > 1.5 * max(costs[2], costs[7])  # between two minima
    assert co.solve(loop(co.Free(guess, 2.0, 22.0)), intervals=40, progress=False).cost <= min(costs)


@pytest.mark.parametrize("starts", [0, 3])
def test_many_starts_are_no_worse_than_none(starts: int) -> None:
    """They are tried beside what is found without them, other durations among that."""
    solver = co.Solver(oscillator(co.Free(3.0, 0.2, 60.0)), intervals=INTERVALS)
    alone = of_free_duration(3.0)
    many = solver.solve(guess="multistart", starts=starts, progress=False)
    assert many.cost <= alone.cost * (1.0 + 1e-7)
