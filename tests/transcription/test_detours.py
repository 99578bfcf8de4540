"""Ways round obstacles: an obstacle is passed on the cheap side, wherever the start was bent to."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import solve
from scipy.integrate import solve_ivp

import covocp as co
from covocp.transcription import ranked_starts

RADIUS, LENGTH, TIME = 2.0, 10.0, 10.0


def shortest(offset: float, goal: float = LENGTH, radius: float = RADIUS) -> float:
    """Length of the shortest way round a circle that stands beside the middle of the straight line: two tangents."""
    half, far = goal / 2, float(np.hypot(goal / 2, offset))
    turn = 2 * np.arctan2(half, abs(offset)) - 2 * np.arccos(radius / far)
    return float(2 * np.sqrt(far**2 - radius**2) + radius * turn)


def walk(dimensions: int = 2, unit: float = 1.0, duration: float = TIME) -> tuple[co.Problem, ca.SX, ca.SX]:
    """A point whose velocity is its control, from the origin to somewhere on the first axis: cost length^2 / time."""
    goal = [LENGTH * unit, *[0.0] * (dimensions - 1)]
    problem = co.Problem(duration=duration, name="walk")
    x = problem.state("x", dimensions, initial=[0.0] * dimensions, final=goal)
    u = problem.control("u", dimensions)
    problem.dynamics(x, u)
    problem.minimize(running=ca.sumsqr(u / unit))
    return problem, x, u


def apart(x: ca.SX, *place: float) -> ca.SX:
    """Squared distance of a place."""
    return ca.sumsqr(x - ca.DM(list(place)))


# --- one obstacle: the closed form ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("offset", "unit"), [(0.3, 1.0), (-1.5, 1.0), (1.0, 1e3), (1.5, 1e-5)])
def test_a_tree_is_passed_on_the_near_side_in_any_unit(offset, unit):
    problem, x, _ = walk(unit=unit)
    problem.subject_to(apart(x / unit, 5.0, offset), lower=RADIUS**2, name="tree")
    assert solve(problem, intervals=50).cost == pytest.approx(shortest(offset) ** 2 / TIME, rel=2e-3)


FORMS = {
    "other sign": lambda d: (RADIUS**2 - d, 0.0),
    "distance": lambda d: (RADIUS - ca.sqrt(d), 0.0),
    "bump": lambda d: (ca.exp(-d), np.exp(-(RADIUS**2))),
}


@pytest.mark.parametrize("form", FORMS)
def test_however_the_tree_is_written(form):
    problem, x, _ = walk()
    value, upper = FORMS[form](apart(x, 5.0, 1.5))
    problem.subject_to(value, upper=upper)
    assert solve(problem, intervals=50).cost == pytest.approx(shortest(1.5) ** 2 / TIME, rel=2e-3)


@pytest.mark.parametrize("method", ["reduced", "auto", "gradient"])
def test_by_every_method(method):
    problem, x, _ = walk()
    problem.subject_to(apart(x, 5.0, 1.5), lower=RADIUS**2)
    assert co.solve(problem, method, intervals=30, progress=False).cost == pytest.approx(
        shortest(1.5) ** 2 / TIME, rel=5e-3
    )


@pytest.mark.parametrize("place", [(1.2, -0.5)])
def test_a_ball_in_space(place):
    """The shortest way lies in the plane of the line and the centre."""
    problem, x, _ = walk(3)
    problem.subject_to(apart(x, 5.0, *place), lower=RADIUS**2, name="ball")
    cost = shortest(float(np.hypot(*place))) ** 2 / TIME
    assert solve(problem, intervals=50).cost == pytest.approx(cost, rel=2e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_tree_that_moves_along(side):
    """Beside it the goal moves back, the way is the shortest one there; |u|^2 = |u' + w|^2."""
    drift = 0.2
    problem, x, _ = walk()
    nearer = LENGTH - drift * TIME
    problem.subject_to(apart(x - ca.vertcat(drift * problem.time, 0), nearer / 2, side * 1.2), lower=RADIUS**2)
    cost = shortest(1.2, nearer) ** 2 / TIME + 2 * drift * nearer + drift**2 * TIME
    assert solve(problem, intervals=50).cost == pytest.approx(cost, rel=2e-3)


def test_a_tree_between_the_straight_line_and_the_bent_start():
    """Nothing lies on the straight line, which is the shortest way."""
    problem, x, _ = walk()
    own = ranked_starts.own_start(problem.statement(), co.Solver(problem).solve(progress=False).mesh, np.zeros(0))
    side = np.sign(own.trajectory.x[25, 1])
    problem.subject_to(apart(x, 5.0, side * 0.7), lower=0.6**2)
    assert solve(problem, intervals=50).cost == pytest.approx(LENGTH**2 / TIME, rel=1e-6)


def shortest_between(start: list[float], goal: list[float], centre: list[float], radius: float) -> float:
    """Length of the shortest way round a circle: two tangents and an arc on the near side."""
    from_start, from_goal = np.subtract(start, centre), np.subtract(goal, centre)
    a, b = np.linalg.norm(from_start), np.linalg.norm(from_goal)
    arc = np.arccos(from_start @ from_goal / a / b) - np.arccos(radius / a) - np.arccos(radius / b)
    return float(np.sqrt(a**2 - radius**2) + np.sqrt(b**2 - radius**2) + radius * arc)


@pytest.mark.parametrize(("aside", "centre", "radius"), [(0.3, 1.5, 2.0), (0.5, -1.5, 2.0), (-0.1, -1.5, 2.0)])
@pytest.mark.parametrize("kind", ["vector", "numbers", "in other units"])
def test_the_goal_lies_a_little_aside(aside, centre, radius, kind):
    """How far the goal lies aside says nothing of how far the way round is; nor need coordinates have one unit."""
    unit = 1e3 if kind == "in other units" else 1.0
    problem = co.Problem(duration=TIME, name=kind)
    if kind == "vector":
        place = problem.state("p", 2, initial=[0.0, 0.0], final=[LENGTH, aside])
        u = problem.control("u", 2)
        problem.dynamics(place, u)
    else:
        x, y = problem.state("x", initial=0.0, final=LENGTH), problem.state("y", initial=0.0, final=aside / unit)
        u = problem.control("u", 2)
        problem.dynamics(x, u[0])
        problem.dynamics(y, u[1] / unit)
        place = ca.vertcat(x, y * unit)
    problem.minimize(running=ca.sumsqr(u))
    problem.subject_to(apart(place, 5.0, centre), lower=radius**2, name="tree")
    cost = shortest_between([0.0, 0.0], [LENGTH, aside], [5.0, centre], radius) ** 2 / TIME
    assert solve(problem, intervals=40).cost == pytest.approx(cost, rel=3e-3)


def test_in_the_coordinates_of_a_map():
    """Far from their origin the distances of a run have few digits left, at its end none."""
    origin, goal = 1e5, LENGTH
    problem = co.Problem(duration=TIME, name="map")
    x = problem.state("x", 2, initial=[origin, origin], final=[origin + goal, origin])
    u = problem.control("u", 2)
    problem.dynamics(x, u)
    problem.minimize(running=ca.sumsqr(u))
    problem.subject_to(ca.sqrt(apart(x, origin + 5.0, origin + 0.5)), lower=RADIUS, name="tree")
    assert solve(problem, intervals=40).cost == pytest.approx(shortest(0.5) ** 2 / TIME, rel=3e-3)


def test_a_goal_inside_what_is_forbidden_is_refused():
    problem, x, _ = walk()
    problem.subject_to(apart(x, LENGTH, 0.5), lower=1.0, name="tree")
    with pytest.raises(co.SolveError, match="tree"):
        solve(problem, intervals=30)


def test_numbers_without_a_value_end_no_solve(monkeypatch):
    def fails(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("covocp.transcription.detours.detours", fails)
    problem, x, _ = walk()
    problem.subject_to(apart(x, 5.0, 1.0), lower=RADIUS**2)
    assert solve(problem, intervals=30).converged


# --- several obstacles, other vehicles: the best of many guesses ------------------------------------------------------

TREES = [(2.6, 0.4, 1.0), (5.2, -0.5, 1.1), (7.6, 0.45, 0.9)]


def vehicle(kind: str) -> tuple[co.Problem, ca.SX]:
    """From the origin to (10, 0): with an acceleration, in a free time, or as a unicycle."""
    free = co.Free(10.0, lower=2.0, upper=40.0)
    problem = co.Problem(duration=free if kind == "free" else TIME, name=kind)
    x = problem.state("x", 2, initial=[0.0, 0.0], final=[LENGTH, 0.0])
    if kind == "unicycle":
        heading, u = problem.state("heading", initial=0.0), problem.control("u")
        problem.dynamics(x, 1.15 * ca.vertcat(ca.cos(heading), ca.sin(heading)))
        problem.dynamics(heading, u)
    else:
        v = problem.state("v", 2, initial=[0.0, 0.0], final=[0.0, 0.0])
        u = problem.control("u", 2, lower=-2.0, upper=2.0)
        problem.dynamics(x, v)
        problem.dynamics(v, u)
    problem.minimize(running=ca.sumsqr(u) + (1.0 if kind == "free" else 0.0))
    return problem, x


@pytest.mark.parametrize("kind", ["acceleration", "free", "unicycle"])
def test_among_three_trees_as_cheap_as_the_best_of_all_sides(kind):
    problem, x = vehicle(kind)
    for i, (a, b, radius) in enumerate(TREES):
        problem.subject_to(apart(x, a, b), lower=radius**2, name=f"tree {i}")
    solver, costs = co.Solver(problem, intervals=30), []
    for sides in np.ndindex(2, 2, 2):
        beside = [[a, b + (2 * s - 1) * 1.1 * r] for (a, b, r), s in zip(TREES, sides, strict=True)]
        guess = {"x": [[0.0, 0.0], *beside, [LENGTH, 0.0]]}
        other = solver.solve(guess=guess, progress=False, assess=False, allow_failure=True, iteration_limit=60)
        costs += [other.cost] if other.converged else []
    assert solver.solve(progress=False, assess=False).cost <= 1.001 * min(costs)
    assert max(costs) > 1.05 * min(costs)


def test_a_unicycle_beside_several_trees_as_cheap_as_the_best_of_many_guesses():
    """The ways that are pushed must not displace the start that led to the cheapest one."""
    problem = co.Problem(duration=TIME, name="unicycle")
    goal = [LENGTH, -1.204]
    x = problem.state("x", 2, initial=[0.0, 0.0], final=goal)
    heading, u = problem.state("heading", initial=0.0), problem.control("u")
    problem.dynamics(x, 1.3 * ca.vertcat(ca.cos(heading), ca.sin(heading)))
    problem.dynamics(heading, u)
    problem.minimize(running=u**2)
    for a, b, radius in [(5.919, 1.737, 1.586), (7.109, 1.515, 0.557), (5.645, 1.457, 1.025), (3.977, 1.913, 1.377)]:
        problem.subject_to(apart(x, a, b), lower=radius**2)
    solver, costs = co.Solver(problem, intervals=30), []
    for bow in (-4.0, -2.0, 2.0, 4.0):
        guess = {"x": [[0.0, 0.0], [3.0, bow], [6.0, bow], goal]}
        other = solver.solve(guess=guess, progress=False, assess=False, allow_failure=True, iteration_limit=60)
        costs += [other.cost] if other.converged else []
    assert solver.solve(progress=False, assess=False).cost <= 1.001 * min(costs)


def exchange(count: int) -> co.Problem:
    """Points on a circle that exchange their places across it, a metre apart."""
    problem, xs, us = co.Problem(duration=TIME, name="exchange"), [], []
    for angle in np.arange(count) * 2 * np.pi / count:
        place = 5.0 * np.array([np.cos(angle), np.sin(angle)])
        xs.append(problem.state(f"x{len(xs)}", 2, initial=place, final=-place))
        us.append(problem.control(f"u{len(us)}", 2))
        problem.dynamics(xs[-1], us[-1])
    problem.minimize(running=sum(ca.sumsqr(u) for u in us))
    for i, x in enumerate(xs):
        for other in xs[:i]:
            problem.subject_to(ca.sumsqr(x - other), lower=1.0)
    return problem


@pytest.mark.filterwarnings("ignore:Between the points where it is imposed")
def test_four_points_exchange_their_places_at_no_more_than_on_a_roundabout():
    """Whose neighbours are a metre apart; coordinates that end at zero but for rounding are missed by no run."""
    around = 4 * shortest_between([-5.0, 0.0], [5.0, 1e-9], [0.0, 0.0], np.sqrt(0.5)) ** 2 / TIME
    assert solve(exchange(4), intervals=30).cost <= 1.002 * around


@pytest.mark.filterwarnings("ignore:Between the points where it is imposed")
def test_five_points_find_a_way_among_ten_conditions():
    """On a roundabout next neighbours are a metre apart; ways that are no roundabout may be cheaper."""
    radius = 0.5 / np.sin(np.pi / 5)
    around = 5 * shortest_between([-5.0, 0.0], [5.0, 1e-9], [0.0, 0.0], radius) ** 2 / TIME
    assert solve(exchange(5), intervals=20).cost <= 1.02 * around


def test_the_later_of_two_phases_passes_on_the_near_side():
    first, x, _ = walk()
    second = co.Problem(duration=TIME, name="on")
    y = second.state("x", 2, initial=None, final=[2 * LENGTH, 0.0])
    u = second.control("u", 2)
    second.dynamics(y, u)
    second.minimize(running=ca.sumsqr(u))
    second.subject_to(apart(y, 15.0, 1.5), lower=RADIUS**2)
    assert x.shape == y.shape
    phases = co.Phases([first, second], name="two")
    cost = (LENGTH**2 + shortest(1.5) ** 2) / TIME
    assert co.solve(phases, intervals=40, progress=False).cost == pytest.approx(cost, rel=2e-3)


# --- where nothing is looked for --------------------------------------------------------------------------------------


def test_a_guess_says_on_which_side():
    problem, x, _ = walk()
    problem.subject_to(apart(x, 5.0, 1.0), lower=RADIUS**2)
    solution = solve(problem, intervals=40, guess={"x": [[0.0, 0.0], [5.0, 3.2], [LENGTH, 0.0]]})
    assert solution.at(5.0)["x"][1] == pytest.approx(3.0, abs=1e-3)


CONVEX = {
    "within a disc": lambda x, u: (apart(x, 5.0, 4.0), 41.5),
    "a wall": lambda x, u: (ca.vertcat(x[1], -x[1]) - 0.01, 0.0),
    "a control": lambda x, u: (-ca.sumsqr(u), -0.5),
}


@pytest.mark.parametrize("name", CONVEX)
def test_what_has_one_side_is_left_alone(name, monkeypatch):
    monkeypatch.setattr("covocp.transcription.detours.detours", lambda *a: pytest.fail("other sides were looked for"))
    problem, x, u = walk()
    value, upper = CONVEX[name](x, u)
    problem.subject_to(value, upper=upper)
    assert solve(problem, intervals=30).cost == pytest.approx(LENGTH**2 / TIME, rel=1e-5)


def test_nothing_is_looked_for_where_the_start_runs_free(monkeypatch):
    monkeypatch.setattr("covocp.transcription.detours.detours", lambda *a: pytest.fail("other sides were looked for"))
    problem, x, _ = walk()
    problem.subject_to(apart(x, 5.0, 30.0), lower=RADIUS**2)
    assert solve(problem, intervals=30).converged


# --- beside covariances -----------------------------------------------------------------------------------------------


def drifting(known: bool) -> co.Problem:
    """An unstable point in the plane with a tree beside its way, and what is known of it at the end in the cost."""
    problem = co.Problem(duration=6.0, name="drifting")
    given = ({"variance": 0.05}, {"variance": 0.01}) if known else ({}, {})
    x = problem.state("x", 2, initial=[0.0, 0.0], final=[8.0, 0.0], **given[0])
    v = problem.state("v", 2, initial=0.0, final=0.0, **given[1])
    u = problem.control("u", 2)
    problem.dynamics(x, v)
    problem.dynamics(v, u + 0.2 * v, noise=0.01 if known else 0.0)
    problem.subject_to(ca.sqrt(apart(x, 4.0, 0.4) + 1e-6), lower=1.0, name="tree")
    end = 0.0
    if known:
        problem.measurement("position", x, noise=0.02)
        E = problem.estimation_covariance()
        end = 3.0 * ca.trace(E[x, x])
    problem.minimize(running=0.5 * ca.sumsqr(u), terminal=end)
    return problem


@pytest.mark.filterwarnings("ignore:Between the points where it is imposed")
def test_a_rival_has_magnitudes_of_its_own_beside_covariances():
    """The controls do not move what is known: the cost is that without it, and a sum. In those of the way through the
    tree no run found its way."""

    def rate(_, e):
        E, F = e.reshape(2, 2), np.array([[0.0, 1.0], [0.0, 0.2]])
        return (F @ E + E @ F.T + np.diag([0.0, 0.01]) - np.outer(E[:, 0], E[0]) / 0.02).ravel()

    end = solve_ivp(rate, (0.0, 6.0), np.diag([0.05, 0.01]).ravel(), rtol=1e-10, atol=1e-12).y[0, -1]
    alone = solve(drifting(known=False), intervals=25).cost
    assert solve(drifting(known=True), intervals=25).cost == pytest.approx(alone + 3.0 * 2.0 * end, rel=1e-4)
