"""The gradient method for expected costs (Schmidt, appendix E) against the printed covariance equations and shooting.

The reference, `closed_loops`, integrates (6.3-14) with E, Xhat and S; the method under test has E and S only and takes
Xhat from the costate of S. So the slopes compared here come from two different formulas of the cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import closed_loops
import numpy as np
import pytest
from closed_loops import System, closed_loop, lag, nominal, piecewise_linear
from problems import graded, unassessed
from scipy.stats import linregress

import covocp as co
from covocp.base.matrices import pack, pack_costate, unpack_costate
from covocp.models import mars_entry, unknown_lag
from covocp.solvers.gradient import one_iteration, prepare
from covocp.solvers.gradient.iterate import Space
from covocp.solvers.gradient.records import Iterate, Linear
from covocp.solving.warm_start import make_guess
from covocp.transcription.mesh import Options

# --- a loop in which everything depends on everything -----------------------------------------------------------------

DURATION, START, INTERVALS, LIMIT = 1.6, (0.8, -0.3), 6, 0.1
VARIANCE = np.diag([0.2, 0.1])
CONTROL = np.array([0.1, -0.1, 0.45, 0.1, -0.4, 0.25, 0.9])
POINT = np.array([*CONTROL, DURATION, START[1]])


def spring(duration: Any) -> co.Problem:
    """Nonlinear spring: noises of x and u, N and B of x, S(T) of x(T) and T; free x_2(0), T; E_11(T) fixed."""
    ocp = co.Problem(duration=duration)
    x = ocp.state("x", 2, initial=[START[0], None], variance=[0.2, 0.1])
    u = ocp.control("u")
    force = -x[0] - 0.3 * x[0] ** 3 - 0.2 * x[1] + (1 + 0.2 * x[0]) * u
    noise = ca.diag(ca.vertcat(0, 0.2 + 0.1 * x[0] ** 2 + 0.1 * u**2))
    ocp.dynamics(x, ca.vertcat(x[1], force), noise=noise)
    ocp.measurement("m", x[0] + 0.1 * x[0] ** 2 + 0.2 * x[1] * u, noise=0.3)
    E = ocp.estimation_covariance()
    ocp.subject_to(E[x, x][0, 0] - LIMIT, lower=0.0, upper=0.0, at="final", name="E11")
    ocp.minimize_expected(
        running=0.5 * x[0] ** 2 + 0.5 * (1 + 0.2 * x[0] ** 2) * u**2 + 0.1 * x[0] * u,
        terminal=(1 + 0.1 * ocp.duration) * (0.5 * x[0] ** 2 + 0.25 * x[0] ** 4) + 0.5 * x[1] ** 2,
    )
    return ocp


def spring_system(start: np.ndarray, variance: np.ndarray, duration: float, last: np.ndarray) -> System:
    """The same by hand; `last` is x(T)."""
    factor = 1 + 0.1 * duration
    return System(
        start=start,
        variance=variance,
        rate=lambda x, u: np.array([x[1], -x[0] - 0.3 * x[0] ** 3 - 0.2 * x[1] + (1 + 0.2 * x[0]) * u[0]]),
        F=lambda x, u: np.array([[0, 1], [-1 - 0.9 * x[0] ** 2 + 0.2 * u[0], -0.2]]),
        G=lambda x, u: np.array([[0], [1 + 0.2 * x[0]]]),
        M=lambda x, u: np.array([[1 + 0.2 * x[0], 0.2 * u[0]]]),
        Q=lambda x, u: np.diag([0, 0.2 + 0.1 * x[0] ** 2 + 0.1 * u[0] ** 2]),
        U=np.array([[0.3]]),
        weights=lambda x, u: (
            np.diag([1 + 0.2 * u[0] ** 2, 0]),
            np.array([[1 + 0.2 * x[0] ** 2]]),
            np.array([[0.1 + 0.4 * x[0] * u[0]], [0]]),
        ),
        end=np.diag([factor * (1 + 3 * last[0] ** 2), 1.0]),
        running=lambda x, u: 0.5 * x[0] ** 2 + 0.5 * (1 + 0.2 * x[0] ** 2) * u[0] ** 2 + 0.1 * x[0] * u[0],
        terminal=lambda x: factor * (0.5 * x[0] ** 2 + 0.25 * x[0] ** 4) + 0.5 * x[1] ** 2,
        scale=np.ones(2),
    )


def spring_loop(
    point: np.ndarray, variance: np.ndarray = VARIANCE, times: np.ndarray | None = None
) -> closed_loops.Loop:
    """The reference at a point of the method: control values, T, x_2(0)."""
    u, duration, start = point[:-2], float(point[-2]), np.array([START[0], point[-1]])
    control, breaks = piecewise_linear(np.linspace(0, duration, u.size), u)
    first = spring_system(start, variance, duration, np.zeros(2))
    last = nominal(first, control, duration, breaks=breaks)(duration)
    system = spring_system(start, variance, duration, last)
    return closed_loop(system, control, duration, breaks=breaks, times=times)


@dataclass(frozen=True)
class Linearised:
    space: Space
    iterate: Iterate
    linear: Linear


@cache
def linearised(substeps: int) -> Linearised:
    """The method's own sweeps at one control."""
    statement = spring(co.Free(guess=DURATION)).statement()
    solver = prepare(statement, Options(intervals=INTERVALS, substeps=substeps))
    start = np.tile(START, (INTERVALS + 1, 1))
    guess = make_guess(statement, solver.mesh, statement.values, {"u": CONTROL, "x": start})
    space = solver.space(statement.values, guess)
    iterate = space.first(guess)
    return Linearised(space=space, iterate=iterate, linear=space.linearise(iterate))


def test_slopes_by_controls_duration_and_start() -> None:
    # Against differences of (6.3-14) and of E_11(T): of second order, with third derivatives of order one.
    along = np.zeros((5, POINT.size))
    along[:3, :-2] = np.random.default_rng(6).choice([-1.0, 0.0, 1.0], (3, CONTROL.size))
    along[3, -2] = along[4, -1] = 1.0
    linear, step = linearised(8).linear, 1e-3
    for direction in along:
        ahead, behind = spring_loop(POINT + step * direction), spring_loop(POINT - step * direction)
        assert linear.slope @ direction == pytest.approx((ahead.cost - behind.cost) / (2 * step), abs=5e-7)
        change = (ahead.E[-1] - behind.E[-1])[0, 0] / (2 * step)
        assert linear.rows[0] @ direction == pytest.approx(change, abs=5e-7)


def test_cost_is_the_printed_one() -> None:
    loop = spring_loop(POINT)
    assert linearised(8).iterate.run.cost == pytest.approx(loop.cost, abs=1e-7)
    assert linearised(8).iterate.run.miss[0] == pytest.approx(loop.E[-1, 0, 0] - LIMIT, abs=1e-8)


def test_slopes_are_of_fourth_order() -> None:
    exact = linearised(16).linear
    sizes = np.array([1, 2, 4])
    errors = [np.abs(linearised(2 * m).linear.slope - exact.slope).max() for m in sizes.tolist()]
    assert linregress(np.log(1 / sizes), np.log(errors)).slope > 3.6


def test_trajectory_between_the_nodes() -> None:
    # Starts, middles and ends of the pairs: x and E come from the left, S from the right.
    inside = linearised(8).linear.slopes.middles[0]
    count = inside.shape[1] - 1
    loop = spring_loop(POINT, times=np.linspace(0, DURATION, INTERVALS * count + 1))
    expected = np.hstack([loop.x, pack(loop.E), pack(loop.S)])
    for j in range(INTERVALS):
        np.testing.assert_allclose(inside[j], expected[j * count : (j + 1) * count + 1], atol=3e-7)


def test_costates_of_the_matrices() -> None:
    # That of S is -Xhat/2, at every node; that of E at t = 0 is the slope of the cost by E(0).
    at = linearised(8)
    statement = at.space.sweeps.statement
    columns = at.linear.slopes.columns[:, :, 0]
    loop = spring_loop(POINT, times=np.linspace(0, DURATION, INTERVALS + 1))
    behind = [statement.nx + k for k in statement.entries(statement.behind)]
    np.testing.assert_allclose(columns[:, behind], -pack_costate(loop.Xhat) / 2, atol=1e-7)
    slopes = []
    for direction in ([[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]]):
        change = 1e-3 * np.array(direction)
        costs = [spring_loop(POINT, VARIANCE + sign * change).cost for sign in (1, -1)]
        slopes.append((costs[0] - costs[1]) / 2e-3)
    ahead = [statement.nx + k for k in statement.entries(statement.ahead)]
    np.testing.assert_allclose(columns[0, ahead], slopes, atol=5e-7)


def test_predictions_are_first_order() -> None:
    # Halving the step (doubling W and b) quarters the difference between predicted and actual changes.
    def errors(size: float) -> np.ndarray:
        problem = spring(co.Free(guess=DURATION))
        step = one_iteration(
            problem.statement(), Options(intervals=40), weight=size, fraction=1 / size, duration_weight=size
        )
        return np.array([step.actual_cost - step.predicted_cost, *(step.actual_miss - step.predicted_miss)])

    np.testing.assert_allclose(errors(400.0) / errors(800.0), 4.0, rtol=0.05)


# --- first-order lag, section 6.12 ------------------------------------------------------------------------------------


def solve(problem: co.Problem, **options: Any) -> co.Solution:
    return co.solve(problem, method="gradient", progress=False, **options)


@cache
def steered(intervals: int) -> co.Solution:
    return solve(unknown_lag.steering(), grid=graded(intervals))


def test_steering_has_the_specified_optimum() -> None:
    # The error of a piecewise-linear control on N graded intervals falls with N^-4, from 3e-6 at N = 40.
    costs = [steered(n).cost for n in (40, 80)]
    assert costs[0] == pytest.approx(2.0271464, abs=4e-6)
    assert costs[1] == pytest.approx(2.0271464, abs=3e-7)
    solution = steered(80)
    E = solution["E"][-1]
    np.testing.assert_allclose([E[0, 0], E[1, 1]], [0.646544, 4.310046], atol=1e-5)
    control = [-0.00457, -0.00931, -0.01699, -0.02964, -0.05035, -0.08302, -0.12982, -0.17866, -0.14853, 0.35177]
    np.testing.assert_allclose(solution.at(np.arange(10.0))["u"].ravel(), control, atol=1e-3)
    # Xhat(T) from the costate of S: X(T) = E + Xhat, and b's deviation keeps its variance.
    Xhat = -2 * unpack_costate(solution.costates.matrices[-1, 3:], 2)
    assert (E + Xhat)[0, 0] == pytest.approx(0.719375, abs=1e-5)
    assert (E + Xhat)[1, 1] == pytest.approx(5.0, abs=1e-5)


@pytest.mark.parametrize("intervals", [40, 80])
def test_steering_costs_what_shooting_finds(intervals: int) -> None:
    shooting = co.solve(unknown_lag.steering(), progress=False, grid=graded(intervals))
    solution = steered(intervals)
    assert solution.cost == pytest.approx(shooting.cost, rel=1e-9)
    np.testing.assert_allclose(solution["u"], shooting["u"], atol=3e-4)
    assert_optimal(solution, shooting)


def test_steering_costs_what_the_printed_equations_say() -> None:
    solution = steered(40)
    control, breaks = piecewise_linear(solution.t, solution["u"].ravel())
    loop = closed_loop(lag(), control, 10.0, breaks=breaks)
    assert solution.cost == pytest.approx(loop.cost, rel=1e-6)


def test_fixed_weight_of_the_specification() -> None:
    # "25 iterations with W = 2 on 40 graded intervals", to the precision of the source.
    solution = solve(unknown_lag.steering(), grid=graded(40), weight=2.0)
    costs = np.array([row["cost"] for row in solution.stats["history"]])
    assert costs[25] == pytest.approx(2.0271464, rel=3e-6)


def test_weight_grows_where_the_cost_does_not_fall_as_predicted() -> None:
    solution = solve(unknown_lag.steering(), grid=graded(40), weight_factor=0.02)
    weights = [row["weight"] for row in solution.stats["history"]]
    assert max(weights) > 10 * weights[0]
    assert solution.cost == pytest.approx(steered(40).cost, rel=1e-9)


@pytest.mark.parametrize("options", [{}, {"covariance_step": "strang"}, {"control": "constant"}])
def test_coarse_meshes_still_end(options: Any) -> None:
    # Slopes and costs disagree by the discretisation error, mesh_error, and the run still ends within it.
    with pytest.warns(co.CovocpWarning, match="too coarse"):
        solution = solve(unknown_lag.steering(), intervals=10, substeps=2, tolerance=1e-8, **options)
    with pytest.warns(co.CovocpWarning, match="too coarse"):
        shooting = co.solve(unknown_lag.steering(), progress=False, intervals=10, substeps=2, **options)
    assert solution.mesh_error > 1e-4
    assert solution.cost == pytest.approx(shooting.cost, rel=solution.mesh_error)


# --- special cases (6.4 to 6.10) --------------------------------------------------------------------------------------


def test_linear_systems_with_quadratic_costs_separate() -> None:
    # Case 4: u = -C x, the deterministic part is x(0)' S(0) x(0)/2 and the rest does not depend on the control.
    drift, input_, noise = np.array([[0, 1], [-1, -0.3]]), np.array([[0.0], [1.0]]), np.diag([0.1, 0.4])
    first, variance, cross = np.array([1.0, 0.0]), np.diag([0.3, 0.2]), np.array([[0.0], [0.2]])
    end, weight = np.diag([2.0, 1.0]), np.diag([1.0, 0.0])
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", 2, initial=first, variance=variance), ocp.control("u")
    ocp.dynamics(x, drift @ x + input_ @ u, noise=noise)
    ocp.measurement("m", x[0], noise=0.2)
    ocp.minimize_expected(
        running=0.5 * x[0] ** 2 + 0.25 * u**2 + 0.2 * x[1] * u, terminal=0.5 * ca.bilin(ca.DM(end), x, x)
    )
    system = System(
        start=first,
        variance=variance,
        rate=lambda x, u: drift @ x + input_ @ u,
        F=lambda x, u: drift,
        G=lambda x, u: input_,
        M=lambda x, u: np.array([[1.0, 0.0]]),
        Q=lambda x, u: noise,
        U=np.array([[0.2]]),
        weights=lambda x, u: (weight, np.array([[0.5]]), cross),
        end=end,
        scale=np.ones(2),
    )
    solution = solve(ocp, intervals=80)
    loop = closed_loop(system, lambda t: 0.0, 2.0, times=solution.t)
    assert solution.cost == pytest.approx(0.5 * first @ loop.S[0] @ first + loop.cost, rel=1e-7)
    np.testing.assert_allclose(solution["u"], -np.einsum("kij,kj->ki", loop.C, solution["x"])[:, 0], atol=3e-4)
    np.testing.assert_allclose(solution["S"], loop.S, atol=1e-6)


def free_time() -> co.Problem:
    ocp = co.Problem(duration=co.Free(guess=2.0, lower=0.3, upper=20.0))
    x, b, u = ocp.state("x", initial=0.0, final=1.0, variance=0.3), ocp.unknown("b", 1.0, 0.5), ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=0.3)
    ocp.measurement("m", x, noise=0.5)
    ocp.minimize_expected(running=0.5 * u**2 + 0.15, terminal_weight={x: 2.0})
    return ocp


def free_time_of_terminal_weight() -> co.Problem:
    ocp = co.Problem(duration=co.Free(guess=1.5, lower=0.3, upper=20.0))
    x, u = ocp.state("x", initial=1.0, variance=0.2), ocp.control("u")
    ocp.dynamics(x, -0.2 * x**3 + u, noise=0.2)
    ocp.measurement("m", x, noise=0.3)
    cost = 0.25 * (x + 0.3) ** 4 * (1 + 0.5 * ocp.duration) + 0.5 * x**2
    ocp.minimize_expected(running=0.5 * u**2 + 0.1, terminal=cost)
    return ocp


def quartic() -> co.Problem:
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", 2, initial=[1.0, 0.5], variance=[0.2, 0.1]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], ca.sin(x[0]) - 0.3 * x[1] + u), noise=np.diag([0.0, 0.3]))
    ocp.measurement("m", x[0], noise=0.3)
    cost = x[0] ** 4 + x[0] ** 2 * x[1] ** 2 + 0.3 * x[0] ** 2 + 0.5 * x[1] ** 2 + 0.1 * x[1] ** 3
    ocp.minimize_expected(running=0.5 * u**2, terminal=cost)
    return ocp


def noises_of_the_state() -> co.Problem:
    ocp = co.Problem(duration=2.0)
    x, y = ocp.state("x", initial=1.0, final=0.2, variance=0.2), ocp.state("y", initial=0.0, variance=0.1)
    u = ocp.control("u")
    ocp.dynamics(x, -0.5 * x + u, noise=0.1 + x**2)
    ocp.dynamics(y, x, noise=0.05)
    ocp.measurement("m", y, noise=0.2 + 0.1 * x**2)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0, y: 1.0})
    return ocp


def noise_of_the_control() -> co.Problem:
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", initial=1.0, variance=0.2), ocp.control("u")
    ocp.dynamics(x, -0.5 * x + u, noise=0.1 + 0.5 * u**2)
    ocp.measurement("m", x * (1 + 0.1 * u), noise=0.2)
    ocp.minimize_expected(running=0.5 * u**2 + 0.5 * x**2, terminal=2 * (x - 0.5) ** 2)
    return ocp


def two_controls() -> co.Problem:
    ocp = co.Problem(duration=3.0)
    x = ocp.state("x", 3, initial=[0.0, 0.0, 0.3], variance=[0.1, 0.1, 0.05], final=[1.0, 0.5, None])
    b, u = ocp.unknown("b", 0.8, 0.2), ocp.control("u", 2)
    rate = ca.vertcat(u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), b * u[1])
    ocp.dynamics(x, rate, noise=np.diag([0.02, 0.02, 0.05]))
    ocp.measurement("m", x[:2], noise=0.1 * np.eye(2))
    weight = np.diag([4.0, 4.0, 0.0])
    ocp.minimize_expected(running=0.5 * ca.sumsqr(u) + 0.2 * x[2] ** 2 * u[1] ** 2, terminal_weight={x: weight})
    return ocp


def constrained(bound: float = np.inf, **rows: Any) -> co.Problem:
    """The lag with a bound on the control, or with a condition on E_bb."""
    ocp = co.Problem(duration=3.0)
    x, b = ocp.state("x", initial=0.0, final=1.0, variance=0.3), ocp.unknown("b", 1.0, 0.5)
    u = ocp.control("u", upper=bound)
    ocp.dynamics(x, -b * x + u, noise=0.3)
    ocp.measurement("m", x, noise=0.5)
    E = ocp.estimation_covariance()
    if rows:
        ocp.subject_to(E[b, b] - 0.4, name="E_bb", **rows)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0})
    return ocp


def constant_gain() -> co.Problem:
    """E and Xhat forward, C a control: no matrix runs backward."""
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", initial=1.0, variance=0.2), ocp.control("u")
    ocp.dynamics(x, -0.2 * x**3 + u, noise=0.2)
    ocp.measurement("m", x, noise=0.3)
    gain = co.Gain(lower=-5.0, upper=5.0, guess=1.0)
    ocp.minimize_expected(running=0.5 * u**2 + 0.5 * x**2, terminal=x**2, gain=gain)
    return ocp


CASES: dict[str, tuple[co.Problem, dict[str, Any], float]] = {
    "free time": (free_time(), {}, 1e-9),
    "free time, constant controls": (free_time(), {"control": "constant"}, 1e-9),
    "free time, S(T) of x and T": (free_time_of_terminal_weight(), {}, 1e-8),
    "x^4 at the end": (quartic(), {}, 1e-7),
    "x^4 at the end, rk4": (quartic(), {"covariance_step": "rk4"}, 1e-7),
    "noises of the state": (noises_of_the_state(), {}, 1e-9),
    "noise of the control": (noise_of_the_control(), {}, 1e-9),
    "two controls": (two_controls(), {}, 1e-9),
    "bound on the control": (constrained(bound=1.5), {}, 1e-7),
    "E_bb(T) given": (constrained(at="final", lower=0.0, upper=0.0), {}, 1e-9),
    "E_bb(T) limited": (constrained(at="final"), {}, 1e-5),
    "free gain": (constant_gain(), {}, 1e-6),
}


@pytest.mark.parametrize("name", CASES)
def test_same_optimum_as_shooting(name: str) -> None:
    problem, options, tolerance = CASES[name]
    solution, shooting = (unassessed(problem, method, intervals=30, **options) for method in ("gradient", "ipopt"))
    assert solution.cost == pytest.approx(shooting.cost, rel=tolerance)
    assert solution.duration == pytest.approx(shooting.duration, rel=1e-5)
    np.testing.assert_allclose(solution.multipliers.final, shooting.multipliers.final, atol=1e-3)
    np.testing.assert_allclose(solution.costates.matrices, shooting.costates.matrices, atol=1e-3)
    assert_optimal(solution, shooting)


def assert_optimal(solution: co.Solution, shooting: co.Solution) -> None:
    """What the conditions of optimality say of one solution and of the other."""
    one, two = solution.optimality, shooting.optimality
    assert one.stationarity < 1e-4
    assert one.costate_difference < max(1e-5, 1.1 * two.costate_difference)
    if two.transversality is not None:
        assert one.transversality is not None
        assert one.transversality < max(1e-6, 1.1 * two.transversality)


def test_mars_entry_gains_most_in_ten_iterations() -> None:
    # From the constant ratio 0.5, on intervals of 5 s; the optimum is 5.7667749e-4.
    guess = {mars_entry.LIFT_TO_DRAG: np.full(184, mars_entry.REFERENCE)}
    solver = co.Solver(mars_entry.problem(), "gradient", intervals=183, max_iterations=10)
    solution = solver.solve(guess=guess, allow_failure=True, progress=False, assess=False)
    costs = np.array([row["cost"] for row in solution.stats["history"]])
    assert costs[0] == pytest.approx(6.57123e-4, rel=1e-5)
    assert (np.diff(costs) < 0).all()
    assert costs[0] - costs[-1] > 0.9 * (costs[0] - 5.7667749e-4)
