"""Kinks of expected costs in what scatters are told, once; others, and smooth forms, are not."""

from __future__ import annotations

import warnings

import casadi as ca
import numpy as np
import pytest

import covocp as co

KNOTS = np.linspace(-5.0, 5.0, 11)
LINEAR, CUBIC = (co.table(kind, KNOTS, KNOTS**2, kind=kind) for kind in ("linear", "cubic"))


def stated(running=lambda **_: 0.0, terminal=lambda **_: 0.0, ocp=None):
    """A noisy integrator with an unknown drift, a clock that nothing moves, and costs of these besides u^2."""
    ocp = co.Problem(1.0, name="kinked") if ocp is None else ocp
    x = ocp.state("x", 2, initial=[0.0, 0.0], variance=[0.1, 0.0])
    clock = ocp.state("clock", initial=0.0)
    b = ocp.unknown("b", mean=0.0, variance=0.1)
    d = ocp.parameter("d", 0.3)
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u + b), noise=[0.0, 0.1])
    ocp.dynamics(clock, 1.0)
    ocp.measurement("m", x[0], noise=0.1)
    given = {"x": x, "b": b, "u": u, "t": ocp.time, "clock": clock, "d": d}
    ocp.minimize_expected(running=u**2 + running(**given), terminal=ca.sumsqr(x) + terminal(**given))
    return ocp


@pytest.mark.parametrize(
    ("cost", "told"),
    [
        (lambda x, **_: abs(x[0]), r"in 'x': abs\."),
        (lambda b, **_: ca.fabs(b), r"in 'b': abs\."),
        (lambda x, b, **_: ca.fmax(x[1] - b, 0.0) ** 2, r"in 'x' and 'b': fmax\."),
        (lambda x, **_: ca.fmin(x[0], 1.0), r"in 'x': fmin\."),
        (lambda x, **_: ca.if_else(x[0] > 1.0, x[0] ** 2, x[0]), r"in 'x': <, if_else"),
        (lambda x, **_: ca.if_else(x[0] > 1.0, x[0] ** 2, x[0], True), r"in 'x': .*if_else"),
        (lambda x, **_: (x[0] > 1.0) * x[0], r"in 'x': <\."),
        (lambda x, d, **_: ca.floor(x[0] + d), r"in 'x': floor\."),
        (lambda x, **_: LINEAR(x[0]), r"in 'x': the linear table 'linear'\."),
    ],
)
@pytest.mark.parametrize("which", ["running", "terminal"])
def test_kinks_are_told_by_operation_and_state(cost, told, which):
    with pytest.warns(co.CovocpWarning, match=f"The expected {which} cost has kinks or jumps {told}"):
        co.Solver(stated(**{which: cost}), intervals=5)


@pytest.mark.parametrize(
    "cost",
    [
        lambda t, x, **_: ca.fmax(t - 0.5, 0.0) * x[0] ** 2,
        lambda clock, x, **_: ca.if_else(clock > 0.5, x[0] ** 2, 0.0),
        lambda d, x, **_: abs(d) * x[0] ** 2,
        lambda u, **_: ca.fmax(u, 0.0),
        lambda x, **_: ca.sqrt(x[0] ** 2 + 0.1),
        lambda x, **_: (x[0] + ca.sqrt(x[0] ** 2 + 0.1)) / 2,
        lambda x, **_: (1 + ca.tanh(x[0] / 0.3)) / 2,
        lambda x, **_: CUBIC(x[0]),
        lambda x, **_: ca.norm_2(ca.vertcat(x, 1.0)),
    ],
    ids=["time", "clock", "parameter", "control", "abs", "fmax", "step", "cubic", "length"],
)
def test_nothing_is_told_of_what_does_not_scatter_or_is_smooth(cost):
    co.Solver(stated(running=cost), intervals=5)  # warnings are errors


def test_a_state_that_something_uncertain_moves_scatters():
    """Its own initial value is certain, and it has no noise."""
    ocp = co.Problem(1.0, name="moved")
    b = ocp.unknown("b", mean=1.0, variance=0.1)
    first, second = (ocp.state(name, initial=0.0) for name in ("first", "second"))
    u = ocp.control("u")
    ocp.dynamics(second, first)
    ocp.dynamics(first, b)
    ocp.measurement("m", second, noise=0.1)
    ocp.minimize_expected(running=u**2 + second**2 + abs(second))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        co.Solver(ocp, intervals=5)
    assert any("kinks or jumps in 'second': abs." in str(one.message) for one in caught)


def test_they_are_told_once():
    ocp = stated(running=lambda x, **_: ca.sqrt(x[0] ** 2 + 0.1) + abs(x[0] - 2.0))  # and never gets there
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = co.solve(ocp, intervals=5, progress=False)
        co.evaluate(ocp, nominal=found, intervals=5)
        co.Solver(ocp, "reduced", intervals=5).solve(progress=False)
    assert sum("has kinks or jumps" in str(one.message) for one in caught) == 1


def test_a_deterministic_cost_has_its_kinks_without_a_word():
    ocp = co.Problem(1.0, name="plain")
    x, u = ocp.state("x", initial=1.0, final=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2 + abs(x))
    co.Solver(ocp, intervals=5)


def test_phases_are_told_by_name():
    """What scatters in the second phase comes from the first."""
    parts = []
    for name in ("A", "B"):
        ocp = co.Problem(1.0, name=name)
        first = name == "A"
        x = ocp.state("x", initial=0.0 if first else None, variance=0.1 if first else None)
        u = ocp.control("u")
        ocp.dynamics(x, u)
        ocp.measurement("m", x, noise=0.1)
        ocp.minimize_expected(running=u**2 + (0.0 if first else abs(x - 3.0)), terminal=x**2)
        parts.append(ocp)
    with pytest.warns(co.CovocpWarning, match=r"running cost of the phase 'B' has kinks or jumps in 'x': abs\."):
        co.solve(co.Phases(parts), intervals=5, progress=False)
