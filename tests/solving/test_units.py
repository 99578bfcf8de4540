"""The units that a problem is stated in change nothing: where it starts, how a saddle is left, what it costs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from problems import solve

import covocp as co
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess
from covocp.models import unknown_lag
from covocp.solving.other_minima import away_from_saddle
from covocp.transcription.mesh import Options
from covocp.transcription.scales import needed_controls
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.trajectory import Trajectory

# One unit of state, control and time of the lag, in those of the problem.
UNITS = [
    (1e7, 1e7, 1.0),
    (1e-7, 1e-7, 1.0),
    (1e-7, 1.0, 1.0),
    (1.0, 1e7, 1e-7),
    (1e4, 1e-4, 1e4),
    (1e-4, 1e4, 1e7),
    (1e7, 1e-7, 1e-4),
]
# The minimum for x(T) = 1, of two; that for x(T) = 0 has a closed form.
TRANSIENT = 7.08523968


def rescaled_lag(state: float, control: float, time: float, final: float = 0.0) -> co.Problem:
    """The lag of `unknown_lag` with the weight 10 in other units; its cost keeps its own."""
    ocp = co.Problem(10.0 * time)
    x = ocp.state("x", initial=0.0, final=final * state, variance=state**2)
    b = ocp.unknown("b", mean=1.0 / time, variance=5.0 / time**2)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u * (state / control / time), noise=state**2 / time)
    ocp.measurement("position", x, noise=state**2 * time)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * (u / control) ** 2 / time, terminal=10.0 * E[b, b] * time**2)
    return ocp


@pytest.mark.parametrize("method", ["ipopt", "reduced"])
@pytest.mark.parametrize("units", UNITS)
def test_default_start_is_in_the_units_of_the_problem(units, method):
    """One unit of the control would be no bend where it moves nothing, and elsewhere one that leads far away."""
    assert solve(rescaled_lag(*units), method=method).cost == pytest.approx(unknown_lag.exact().cost, rel=1e-6)
    assert solve(rescaled_lag(*units, final=1.0), method=method).cost == pytest.approx(TRANSIENT, rel=1e-6)


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.filterwarnings("ignore:The run ended at a saddle")
def test_saddle_is_left_in_the_units_of_the_problem(units):
    solution = solve(rescaled_lag(*units), guess={"u": np.zeros(101)})
    assert solution.stats["left_saddle"]
    assert solution.cost == pytest.approx(unknown_lag.exact().cost, rel=1e-6)


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e7, 1.0), (1.0, 1e7), (1e-7, 1e7)])
@pytest.mark.filterwarnings("ignore:The run ended at a saddle")
def test_saddle_in_one_of_two_controls_is_left(units):
    """The other one is 0.1, as it should be; where it is the smaller number the curvature had been rounding."""
    one, two = units
    ocp = co.Problem(10.0)
    x, z = ocp.state("x", initial=0.0, final=0.0, variance=1.0), ocp.state("z", initial=0.0, final=1.0)
    b, u, w = ocp.unknown("b", mean=1.0, variance=5.0), ocp.control("u"), ocp.control("w")
    ocp.dynamics(x, -b * x + u / one, noise=1.0)
    ocp.dynamics(z, w / two)
    ocp.measurement("position", x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * (u / one) ** 2 + 0.5 * (w / two) ** 2, terminal=10.0 * E[b, b])
    solution = solve(ocp, guess={"u": np.zeros(101), "w": np.full(101, 0.1 * two)})
    assert solution.stats["left_saddle"]
    assert solution.optimality.curvature > 1e-3
    assert solution.cost == pytest.approx(unknown_lag.exact().cost + 0.05, rel=1e-6)  # of w = 0.1 for 10 s


def test_saddle_that_is_cheaper_by_roundoff_has_not_been_left():
    """Runs from both sides that come back to the saddle differ from it by the last digits of the cost."""
    solver = co.Solver(rescaled_lag(1.0, 1.0, 1.0), intervals=20)
    still = solver.solve(guess={"u": np.zeros(21)}, progress=False, assess=False).extremal
    start = Guess(trajectory=still.trajectory)
    outcome = solver._prepared.solve(still.parameters, start, Progress("", False))
    assert outcome.converged
    terms = {name: value * (1.0 - 1e-13) for name, value in outcome.cost_terms.items()}

    class ComesBack:
        mesh = solver._prepared.mesh

        def solve(self, *_):
            return replace(outcome, cost_terms=terms)

    with pytest.warns(co.CovocpWarning, match="no minimum"):
        found = away_from_saddle(ComesBack(), outcome, still.parameters, Progress("", False), start)
    assert found is outcome


def rest_to_rest(time: float, length: float, control: float, cost: float, *, kind: str) -> co.Problem:
    """A double integrator in units: the least energy and time, the least time, or the problem of Bryson and Denham."""
    free = kind != "limited"
    ocp = co.Problem(co.Free(2.5 * time) if free else time)
    speed = 0.0 if free else length / time
    x = ocp.state("x", initial=0.0, final=length if free else 0.0)
    v = ocp.state("v", initial=speed, final=-speed)
    bound = control if kind == "quick" else np.inf
    u = ocp.control("u", lower=-bound, upper=bound)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u * (length / control / time**2))
    if kind == "limited":
        ocp.subject_to(x - 0.12 * length)
    running = 0.0 if kind == "quick" else 0.5 * (u / control) ** 2 * cost / time
    ocp.minimize(running=running, terminal=ocp.duration * cost / time if free else 0.0)
    return ocp


@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
@pytest.mark.parametrize(
    "units",
    [
        (1e-6, 1e6, 1e-6, 1e6),
        (1.0, 1e-6, 1.0, 1.0),
        (1.0, 1.0, 1e-9, 1.0),
        (1.0, 1.0, 1.0, 1e-12),
    ],
)
@pytest.mark.parametrize(
    ("kind", "exact"), [("energy", 18**0.25 * 4 / 3), ("quick", 2.0), ("limited", 4.0 / (9.0 * 0.12))]
)
def test_speeds_from_rest_to_rest_and_limits_of_zero_have_no_unit_of_their_own(kind, exact, units, method):
    """Nothing tells the size of v; that of the row x - 0.12 m is nothing but what x makes of it."""
    solution = solve(rest_to_rest(*units, kind=kind), method=method, intervals=24)
    assert solution.cost / units[3] == pytest.approx(exact, rel=2e-3)
    assert solution.stats["iterations"] < (200 if method == "gradient" else 80)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("bound", [1.0, np.inf])
def test_what_a_control_is_needed_for_is_measured_in_its_own_unit(unit, bound):
    """x(1) = exp(u + u^3) - 1 in this unit: to first order one unit moves x by one."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u", lower=-bound * unit, upper=bound * unit)
    ocp.dynamics(x, (u / unit + (u / unit) ** 3) * (1.0 + x))
    ocp.minimize(running=u**2)
    st = ocp.statement()
    mesh = resolve_mesh(st, Options(intervals=20), st.values)
    still = Trajectory(x=np.zeros((21, 1)), u=np.zeros((21, 1)), e=np.zeros((21, 0)), duration=1.0)
    needed = needed_controls(st, mesh, still, np.ones(1), st.values)
    assert needed[0] / unit == pytest.approx(1.0, rel=1e-2)


@pytest.mark.parametrize("written", ["beside zero", "beside a number"])
@pytest.mark.parametrize("far", [1e4, 1e8])
def test_a_limit_that_stands_beside_the_variables_holds_from_far_away(far, written):
    """Brought from far to x <= 1 with v = 1: x - 1 <= 0 has the size of the number in it, not that of the start."""
    ocp = co.Problem(10.0)
    x, v, u = ocp.state("x", initial=far), ocp.state("v", initial=0.0), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=u**2)
    zero = written == "beside zero"
    ocp.subject_to(x - 1.0 if zero else x, upper=0.0 if zero else 1.0, at="final")
    ocp.subject_to(v - 1.0 if zero else v, equals=0.0 if zero else 1.0, at="final")
    solution = solve(ocp, intervals=30)
    missed = np.array([1.0 - far, 1.0])  # by the Gramian of two integrators
    gramian = np.array([[1000.0 / 3, 50.0], [50.0, 10.0]])
    assert solution.cost == pytest.approx(missed @ np.linalg.solve(gramian, missed), rel=1e-8)
    assert solution["x"][-1] <= 1.0 + 1e-6


@pytest.mark.parametrize("prior", [1e4, 1e8])
def test_a_variance_that_stands_beside_its_limit_is_met_from_a_large_prior(prior):
    costs = []
    for beside in (0.0, 0.01):
        ocp = co.Problem(10.0)
        x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
        b = ocp.unknown("b", mean=1.0, variance=prior)
        ocp.dynamics(x, -x + b * u, noise=0.1)
        ocp.measurement("y", x, noise=0.1)
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2)
        ocp.subject_to(E[b, b] - beside, upper=0.01 - beside, at="final")
        solution = solve(ocp, intervals=30)
        assert solution.trajectory.e[-1, -1] <= 0.01 * (1 + 1e-5)
        costs.append(solution.cost)
    assert costs[1] == pytest.approx(costs[0], rel=1e-5)


@pytest.mark.parametrize("at", ["final", "path"])
@pytest.mark.parametrize("speed", [1e3, 1e7])
def test_a_target_that_moves_is_met_where_it_is_at_the_end(speed, at):
    """It is at 1 at the end, and far below all the time before: a straight way costs 1 / T."""
    ocp = co.Problem(10.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    ocp.subject_to(x - (1.0 + speed * (ocp.time - 10.0)), lower=0.0, **({"at": "final"} if at == "final" else {}))
    solution = solve(ocp, intervals=20)
    assert solution.cost == pytest.approx(0.1, rel=1e-6)


def around(center, written):
    """The least cost of a way around a disc of radius 2 about some place, with the distance it keeps at the nodes."""
    ocp = co.Problem(10.0)
    x = ocp.state("x", 2, initial=[center - 5.0, center + 0.5], final=[center + 5.0, center + 0.5])
    u = ocp.control("u", 2)
    ocp.dynamics(x, u)
    ocp.minimize(running=ca.sumsqr(u))
    value, lower = written(ca.sumsqr(x - center))
    ocp.subject_to(value, lower=lower)
    solution = solve(ocp, intervals=40)
    return solution.cost, np.linalg.norm(solution["x"] - center, axis=1).min()


@pytest.mark.parametrize(
    ("center", "written"),
    [
        (0.0, lambda d: (1 - 4 / (d + 1e-6), 0.0)),
        (0.0, lambda d: (1 - 4 / (d + 1e-9), 0.0)),
        (1e4, lambda d: (d - 4.0, 0.0)),
        (1e4, lambda d: (ca.sqrt(d) - 2.0, 0.0)),
    ],
)
def test_what_a_row_is_where_it_never_comes_is_no_unit(center, written):
    """Of the inverse of a distance at the center, of a distance at the origin of a map."""
    cost, nearest = around(center, written)
    assert nearest > 2.0 - 1e-3
    assert cost == pytest.approx(around(0.0, lambda d: (d, 4.0))[0], rel=1e-4)


def stays_near(length: float, time: float, aside: float = 0.0, bound: float | None = 0.05) -> co.Problem:
    """An aircraft of 250 m/s that shall stay where it starts, in other units: straight on is a saddle."""
    ocp = co.Problem(300.0 * time)
    x, y = ocp.state("x", initial=0.0), ocp.state("y", initial=aside * length)
    heading = ocp.state("heading", initial=0.0)
    u = ocp.control("u", **({} if bound is None else {"lower": -bound / time, "upper": bound / time}))
    speed = 250.0 * length / time
    ocp.dynamics(x, speed * ca.cos(heading))
    ocp.dynamics(y, speed * ca.sin(heading))
    ocp.dynamics(heading, u)
    ocp.minimize(running=((x**2 + y**2) / (2e4 * length) ** 2 + 1e3 * (u * time) ** 2) / time)
    return ocp


@cache
def cost_without_bounds(*units: float) -> float:
    return solve(stays_near(*units, bound=None)).cost


@pytest.mark.parametrize("bound", [0.05, 1.0])
@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-3, 1.0), (1e-3, 1 / 60), (1e3, 60.0)])
def test_bounds_that_are_never_reached_hide_no_minimum(units, bound):
    """Straight on costs 1406; without bounds the turn is found at once."""
    free = cost_without_bounds(*units)
    assert free == pytest.approx(247.507, rel=1e-5)
    assert solve(stays_near(*units, bound=bound)).cost == pytest.approx(free, rel=1e-6)


@pytest.mark.filterwarnings("ignore:The run ended at a saddle")
def test_a_start_a_little_aside_hides_no_minimum():
    """One metre is the magnitude that is told of the way to the side, which becomes ten kilometres."""
    assert solve(stays_near(1.0, 1.0, aside=1.0)).cost == pytest.approx(247.507, rel=1e-4)


@pytest.mark.filterwarnings("ignore:The (run ended at a saddle|controls change faster)")
def test_a_heading_in_small_units_is_no_stationary_point():
    costs = []
    for length in (1.0, 500.0):
        ocp = co.Problem(5.0)
        x, y, u = ocp.state("x", initial=0.0), ocp.state("y", initial=0.0), ocp.control("u")
        ocp.dynamics(x, length * (ca.cos(u) + 0.1))
        ocp.dynamics(y, length * ca.sin(u))
        ocp.minimize(running=0.05 * u**2 + 0.1 * (x**2 + y**2) / length**2)
        costs.append(solve(ocp).cost)
    assert costs[1] < 1.05 * costs[0]
