"""Bounds that never bind change no optimum, however wide they are: against closed forms.

A range of bounds that stood for the magnitude of a control made Ipopt's tolerances mean nothing: 0.198 and 46 for 0.03,
by runs that called themselves solved.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from problems import solve, unassessed

import covocp as co
from covocp.solution.doubts import mention_doubts
from covocp.statement.statement import Statement
from covocp.transcription.limit_units import limit_units
from covocp.transcription.mesh import Options
from covocp.transcription.scales import AT_START, GIVEN_SHARE, choose_scales, magnitudes
from covocp.transcription.starts import own_start
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.trajectory import Trajectory

SLOW = 0.03  # see `test_the_closed_form_of_the_slow_mass`
WIDE = [10.0, 1e3, 1e5, 1e8]


def slow(*, wide: float = np.inf, states: float = np.inf, row: float = np.inf, duration: float = 4.0, **control: Any):
    """A mass that is moved by 1 in 4 s with little energy and no faster than 0.3."""
    ocp = co.Problem(duration, name="slow")
    x = ocp.state("x", initial=0.0, final=1.0, lower=-states, upper=states)
    v = ocp.state("v", initial=0.0, lower=-states, upper=states)
    u = ocp.control("u", lower=-wide, upper=wide, **control)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.subject_to(v, lower=-row, upper=0.3, name="speed")
    ocp.minimize(running=0.5 * u**2)
    return ocp


def thrown(**control: Any) -> co.Problem:
    """Bryson and Denham's mass under a roof at 1/9: J = 4 / (9 limit) = 4."""
    ocp = co.Problem(1.0, name="roof")
    x, v = ocp.state("x", initial=0.0, final=0.0), ocp.state("v", initial=1.0, final=-1.0)
    u = ocp.control("u", **control)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.subject_to(x, upper=1 / 9, name="roof")
    ocp.minimize(running=0.5 * u**2)
    return ocp


def test_the_closed_form_of_the_slow_mass():
    """u = a (1 - t/b) to t = b, then coasting at 0.3: a b/2 = 0.3, 0.3 (4 - b) + a b^2/3 = 1: b = 2, a = 0.3."""
    a, b = 0.3, 2.0
    assert a * b / 2 == pytest.approx(0.3)
    assert 0.3 * (4 - b) + a * b**2 / 3 == pytest.approx(1.0)
    assert 0.5 * a**2 * b / 3 == pytest.approx(SLOW)


@pytest.mark.parametrize("wide", WIDE)
@pytest.mark.parametrize("method", ["ipopt", "auto", "reduced"])
def test_a_control_between_wide_bounds(wide, method):
    solution = co.solve(slow(wide=wide), method=method, progress=False)
    assert solution.cost == pytest.approx(SLOW, rel=1e-5)
    assert solution.optimality.complementarity <= 1e-5


def test_wide_bounds_cost_no_iterations():
    few, many = (co.solve(slow(wide=wide), progress=False).stats["iterations"] for wide in (1.0, 1e6))
    assert many <= few + 5


@pytest.mark.parametrize("upper", [1.0, 1e3, 1e6])
def test_a_thrust_of_one_sign(upper):
    """x'' = u - 0.1 x': u in proportion to g, what it moves x(4) by, so that J = 0.5 / int g^2."""
    ocp = co.Problem(4.0)
    x, v, u = (
        ocp.state("x", initial=0.0, final=1.0),
        ocp.state("v", initial=0.0),
        ocp.control("u", lower=0, upper=upper),
    )
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.1 * v)
    ocp.minimize(running=0.5 * u**2)
    square = 100 * (4 - 20 * (1 - np.exp(-0.4)) + 5 * (1 - np.exp(-0.8)))  # of (1 - exp(-0.1 (4 - t))) / 0.1
    assert co.solve(ocp, progress=False).cost == pytest.approx(0.5 / square, rel=1e-5)


@pytest.mark.parametrize("wide", [20.0, 50.0, 1e3, 1e5])
def test_a_pendulum_swings_up_as_without_bounds(wide):
    """A start that turned it forty times ended at other optima: 43765 and 1473336."""

    def swung(bound: float) -> float:
        ocp = co.Problem(5.0)
        a, w = ocp.state("a", initial=0.0, final=np.pi), ocp.state("w", initial=0.0, final=0.0)
        u = ocp.control("u", lower=-bound, upper=bound)
        ocp.dynamics(a, w)
        ocp.dynamics(w, -9.81 * ca.sin(a) + u)
        ocp.minimize(running=u**2)
        return co.solve(ocp, progress=False).cost

    assert swung(wide) == pytest.approx(swung(np.inf), rel=1e-5)


@pytest.mark.parametrize("states", [1e3, 1e6, 1e9])
def test_states_between_wide_bounds(states):
    assert co.solve(slow(states=states), progress=False).cost == pytest.approx(SLOW, rel=1e-5)


def test_a_condition_whose_other_limit_is_far():
    assert co.solve(slow(row=1e9), progress=False).cost == pytest.approx(SLOW, rel=1e-5)


@pytest.mark.parametrize("upper", [1e4, 1e9])
@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
def test_a_condition_of_one_sign_whose_other_limit_is_far(upper, method):
    """x(1) >= 1 with least energy: u = 1. In units of the upper limit nothing held: x(1) = 0, at no cost."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.subject_to(x - 1, at="final", lower=0.0, upper=upper)
    ocp.minimize(running=u**2)
    assert co.solve(ocp, method=method, intervals=10, progress=False).cost == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("upper", [10.0, 1e4, 1e8])
def test_a_duration_with_a_wide_bound(upper):
    """T u^2 + T with u = 1/T is least at T = 1: 2."""
    ocp = co.Problem(co.Free(3.0, lower=0.1, upper=upper))
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u", lower=-upper, upper=upper)
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2 + 1)
    assert co.solve(ocp, progress=False).cost == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize("upper", [10.0, 1e4, 1e8])
def test_a_decision_with_a_wide_bound(upper):
    """3 u^2 + 0.1 d^2 with 3 d u = 1 is least at d^4 = 1/0.3: 0.2 / sqrt(0.3)."""
    ocp = co.Problem(3.0)
    d = ocp.decision("d", guess=1.0, lower=0, upper=upper)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, d * u)
    ocp.minimize(running=u**2, terminal=0.1 * d**2)
    assert co.solve(ocp, progress=False).cost == pytest.approx(0.2 / np.sqrt(0.3), rel=1e-6)


@pytest.mark.parametrize("wide", [1.0, 1e4])
def test_phases_between_wide_bounds(wide):
    parts = []
    for i in range(2):
        part = co.Problem(2.0, name=f"part {i}")
        x = part.state("x", initial=None if i else 0.0, final=1.0 if i else None)
        v, u = part.state("v", initial=None if i else 0.0), part.control("u", lower=-wide, upper=wide)
        part.dynamics(x, v)
        part.dynamics(v, u)
        part.subject_to(v, upper=0.3)
        part.minimize(running=0.5 * u**2)
        parts.append(part)
    assert co.solve(co.Phases(parts), intervals=20, progress=False).cost == pytest.approx(SLOW, rel=1e-5)


def closed_loop(wide: float) -> co.Problem:
    ocp = co.Problem(3.0)
    x = ocp.state("x", initial=1.0, variance=0.5)
    v, u = ocp.state("v", initial=0.0, variance=0.2), ocp.control("u", lower=-wide, upper=wide)
    b = ocp.unknown("b", -1.0, 2.2)
    ocp.dynamics(x, v)
    ocp.dynamics(v, -x - 0.3 * v + b * u, noise=0.05)
    ocp.measurement("m", x, noise=0.27)
    ocp.subject_to(x, at="final", lower=0.5)
    ocp.minimize_expected(running=u**2 + 0.5 * (x - 1) ** 2, terminal_weight={x: 3.0})
    return ocp


def test_a_closed_loop_between_wide_bounds():
    free = unassessed(closed_loop(np.inf), intervals=30)
    wide = co.solve(closed_loop(1e6), intervals=30, progress=False)
    assert wide.cost == pytest.approx(free.cost, rel=1e-6)


@pytest.mark.parametrize("scale", [1.0, 1e3, 1e5])
def test_a_given_scale_that_is_far_off(scale):
    solution = co.solve(slow(wide=1e5, scale=scale), progress=False)
    assert solution.cost == pytest.approx(SLOW, rel=2e-5)


def test_a_multistart_between_wide_bounds():
    solution = co.solve(slow(wide=1e5), intervals=20, guess="multistart", starts=2, progress=False)
    assert solution.cost == pytest.approx(SLOW, rel=1e-5)


FAR = [{"lower": -1e5, "upper": 1e5}, {"guess": lambda s: 1e5 * (1 - 2 * s)}, {"scale": 1e5}]


@pytest.mark.parametrize("control", FAR, ids=["bounds", "guess", "scale"])
@pytest.mark.parametrize("method", ["gradient", "ipopt"])
def test_a_roof_holds_from_far_away(control, method):
    """The magnitudes of a start far away made the gradient method pass the roof by 4e-3 at the nodes, at 3.888."""
    solution = solve(thrown(**control), method=method, intervals=20)
    assert solution.cost == pytest.approx(4.0, rel=1e-3)
    assert solution["x"].max() <= 1 / 9 * (1 + 1e-5)
    assert not solution.violations


# --- the magnitudes themselves ----------------------------------------------------------------------------------------


def start(ocp: co.Problem) -> tuple[Statement, Any, Trajectory]:
    statement = ocp.statement()
    mesh = resolve_mesh(statement, Options(intervals=20), statement.values)
    return statement, mesh, own_start(statement, mesh, statement.values).trajectory


@pytest.mark.parametrize("wide", [1e3, 1e9])
def test_a_start_stays_near_what_moves_the_states(wide):
    """1/8 moves x by 1 in 4 s; a bend of half the range would start, and scale, at 1e9."""
    statement, mesh, guess = start(slow(wide=wide, states=wide))
    scales = choose_scales(statement, mesh, guess, statement.values)
    assert np.abs(guess.u).max() <= 3.0
    assert np.abs(guess.x).max() <= 20.0
    assert scales.u[0] <= 3.0
    assert (scales.x <= 20.0).all()


def test_a_range_is_an_upper_limit():
    statement, mesh, guess = start(slow(wide=0.05))
    assert choose_scales(statement, mesh, guess, statement.values).u == pytest.approx([0.05])


def test_scales_that_are_given_are_kept_at_a_start_and_limited_at_a_point_that_was_reached():
    statement, mesh, guess = start(slow(scale=1e4))
    reached = Trajectory(x=0.0 * guess.x, u=np.full_like(guess.u, 0.3), e=guess.e, duration=4.0)
    assert choose_scales(statement, mesh, reached, statement.values).u == pytest.approx([1e4])
    assert choose_scales(statement, mesh, reached, statement.values, reached=True).u[0] <= 1.0
    nothing = Trajectory(x=guess.x, u=np.full_like(guess.u, 1e-30), e=guess.e, duration=4.0)
    assert magnitudes(statement, nothing, statement.values, reached=True).u == pytest.approx([1e4 * GIVEN_SHARE])


def test_a_state_that_has_not_moved_yet():
    statement, _, guess = start(slow(states=1e9))
    still = Trajectory(x=1e-30 * np.ones_like(guess.x), u=guess.u, e=guess.e, duration=4.0)
    assert magnitudes(statement, still, statement.values).x == pytest.approx([1.0, AT_START])


@pytest.mark.parametrize(
    ("lower", "upper", "unit"),
    [
        (-1e9, 0.3, 1.0),
        (-np.inf, 1e-3, 1e-3),
        (0.0, 1e5, 1.0),
        (2e4, 1e9, 2e4),
        (-1e9, 1e-9, 1e-9),
        (-np.inf, np.inf, 1.0),
        (0.01, 5, 1.0),
    ],
)
def test_units_of_limits(lower, upper, unit):
    assert limit_units(np.array([lower]), np.array([upper])) == pytest.approx([unit])


# --- what is said -----------------------------------------------------------------------------------------------------


def test_an_equation_is_passed_by_a_share_of_its_terms():
    """u = w + x holds at the nodes; between them x bends, by some of u on 2 intervals: points= would change nothing."""
    ocp = co.Problem(3.0)
    x, u, w = ocp.state("x", initial=0.0, final=1.0), ocp.control("u"), ocp.control("w")
    ocp.dynamics(x, u - x)
    ocp.subject_to(u - w - x, equals=0.0, name="balance")
    ocp.minimize(running=ca.sumsqr(ca.vertcat(u, w)))
    with pytest.warns(co.CovocpWarning) as said:
        coarse = co.solve(ocp, intervals=2, progress=False)
    (limit,) = [str(entry.message) for entry in said if "balance" in str(entry.message)]
    assert limit.startswith("Between the points")
    assert "points=" not in limit
    (passed,) = coarse.passed_limits()
    assert passed.equation
    assert passed.share == pytest.approx(passed.by / np.abs([coarse["u"], coarse["w"], coarse["x"]]).sum(axis=0).max())
    assert co.solve(ocp, progress=False).passed_limits()[0].share < 1e-3


@pytest.mark.parametrize(("tolerance", "where"), [(0.1, "At points where"), (1e-6, "Between the points where")])
def test_a_limit_that_is_passed_at_its_points(tolerance, where):
    """On 5 intervals the path passes the roof between the nodes; a loose tolerance lets it pass at them."""
    with pytest.warns(co.CovocpWarning) as said:
        solution = co.solve(
            thrown(), method="gradient", intervals=5, violation_tolerance=tolerance, tolerance=1e-2, progress=False
        )
    assert any(str(entry.message).startswith(where) for entry in said)
    assert ("there that of" in str(solution)) == (tolerance > 1e-3)


def test_a_gradient_that_is_not_that_of_its_cost_is_told():
    """A noise that grows with the square of the control makes a cost of many minima."""
    ocp = co.Problem(4.0)
    x, v = ocp.state("x", initial=0.0, final=1.0, variance=1.0), ocp.state("v", initial=0.0, variance=0.5)
    u = ocp.control("u", lower=-3, upper=3)
    ocp.dynamics(x, v)
    ocp.dynamics(v, -x + u, noise=1.0)
    ocp.measurement("m", x, noise=0.1 + u**2)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal_weight={x: 20.0})
    with pytest.warns(co.CovocpWarning) as said:
        solution = co.solve(ocp, method="gradient", progress=False)
    text = " ".join(str(entry.message) for entry in said)
    assert "no minimum" in text
    with pytest.warns(co.CovocpWarning, match="no minimum"):
        assert solution.optimality.curvature < 0
    with warnings.catch_warnings(record=True) as fine:  # on a mesh that seems fine
        warnings.simplefilter("always")
        mention_doubts(replace(solution, mesh_error=1e-6))
    assert any("stationary by the slopes" in str(entry.message) for entry in fine)


def test_complementarity_that_is_large_is_marked():
    solution = co.solve(slow(), intervals=20, progress=False)
    assert "LARGE" not in str(solution)
    bad = replace(solution.optimality, complementarity=0.94)
    assert "LARGE: multipliers push" in str(replace(solution, stored_optimality=bad))


@pytest.mark.parametrize("method", ["ipopt", "auto"])
@pytest.mark.parametrize("strength", [0.01, 1.0])
def test_a_dear_control_that_is_best_at_its_bound(strength: float, method: str) -> None:
    """One that moves little has a large scale, and Ipopt passes its bound by a share of it: that was no solution."""
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=0.0, final=1.0)
    u, w = ocp.control("u"), ocp.control("w", lower=0.0)
    ocp.dynamics(x, u + strength * w)
    ocp.minimize(running=u**2 + 10.0 * w)
    found = co.solve(ocp, intervals=20, method=method, progress=False)
    assert found.cost == pytest.approx(1.0, rel=5e-7)
    assert np.abs(found["w"]).max() < 1e-7
