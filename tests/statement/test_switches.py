"""Times at which comparisons of the time change, against where they are known to lie."""

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.transcription.instants import with_instants
from covocp.transcription.mesh import Options


def found(added, duration=100.0, **given):
    """Times [s] of dx/dt = u + what is added, a function of problem, state and time."""
    ocp = co.Problem(duration=duration, **given)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u + added(ocp, x, ocp.time))
    ocp.minimize(running=u**2)
    statement = ocp.statement()
    places = statement.kinks(statement.values)
    return sorted({round(100.0 * place, 9) for own in places for place in own})


@pytest.mark.parametrize(
    ("added", "times"),
    [
        (lambda p, x, t: ca.if_else(t < 20.3, 1, 2), [20.3]),
        (lambda p, x, t: ca.if_else(ca.logic_and(t > 20.3, t < 20.3001), 1, 2), [20.3, 20.3001]),
        (lambda p, x, t: ca.if_else(ca.sin(t / 10) > 0, 1, 2), [31.415926536, 62.831853072, 94.24777961]),
        (lambda p, x, t: ca.floor(t / 30), [30, 60, 90]),
        (lambda p, x, t: ca.fmod(t, 40), [40, 80]),
        (lambda p, x, t: ca.if_else(ca.fmod(t, 40) < 5, 1, 2), [5, 40, 45, 80, 85]),
        (lambda p, x, t: ca.fabs(t - 55.5) + ca.fmax(0, 2 * t - 150), [55.5, 75]),
        (lambda p, x, t: ca.sign(t**2 - 400), [20]),
        (lambda p, x, t: ca.if_else(t < p.parameter("on", 12.5) ** 2 / 10, 1, 2), [15.625]),
        (lambda p, x, t: ca.if_else(x < t, 1, 2), []),  # that depends on what is sought
        (lambda p, x, t: ca.if_else(t < -3, 1, 2) + ca.if_else(t > 100, 1, 2), []),
        (lambda p, x, t: ca.fabs(x) + ca.sin(t), []),
    ],
)
def test_times_are_those_at_which_a_comparison_changes(added, times):
    assert found(added) == pytest.approx(times, abs=1e-7)


def test_a_free_duration_has_none():
    ocp = co.Problem(co.Free(1.0, 0.1, 10.0))
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, u + ca.if_else(ocp.time < 0.3, 0.1, 0.2))
    ocp.minimize(terminal=ocp.duration)
    statement = ocp.statement()
    assert statement.kinks(statement.values) == ()


@pytest.mark.parametrize("time", [4.05, 4.0])  # beside a knot of the tables, and on one
def test_tables_hide_no_comparison(time):
    """They compare the time as well; of one with many knots none becomes a node of a coarse mesh."""
    times = np.linspace(0.0, 10.0, 301)
    ocp = co.Problem(duration=10.0)
    wind = ocp.data("wind", times, np.sin(40.0 * times))
    gust = ocp.data("gust", np.array([0.0, 3.0, 10.0]), np.array([0.0, 1.0, 0.0]))
    wave = ocp.data("wave", times, np.sin(times), kind="cubic")
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u + wind + gust + wave + ca.if_else(ocp.time < time, 1, 2))
    ocp.minimize(running=u**2)
    statement = ocp.statement()
    nodes = with_instants(statement, Options(intervals=50), statement.values).nodes()
    assert nodes.size < 60
    assert np.isclose(nodes[:, None], [0.3, time / 10.0]).any(axis=0).all()


def test_pieces_of_a_spline_are_no_nodes():
    """A table that is written out compares the time with each of its knots, where it neither jumps nor bends."""
    axis = np.linspace(0.0, 10.0, 30)
    wave = co.table("wave", axis, np.sin(axis), kind="cubic")
    ocp = co.Problem(duration=10.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u + wave(ocp.time) + ca.fmax(ocp.time, 2.5))
    ocp.minimize(running=u**2)
    statement = ocp.statement()
    assert statement.symbolic is ca.SX
    assert statement.kinks(statement.values) == ((pytest.approx(0.25),),)


@pytest.mark.parametrize("added", [lambda t: ca.if_else(ca.log(t - 50) > 0, 1, 2), lambda t: ca.sqrt(t - 50)])
def test_times_without_a_value_are_none(added):
    assert found(lambda p, x, t: added(t)) in ([], [51.0])
