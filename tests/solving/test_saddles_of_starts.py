"""Runs that keep a decision or a free initial value where its slope vanishes, however far the controls go."""

from __future__ import annotations

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_bvp

import covocp as co
from covocp.solving import other_minima
from covocp.transcription import first_guess

METHODS = ("auto", "ipopt", "reduced", "gradient")


def regulator():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    return ocp, u**2 + x**2


def decided(unit=1.0):
    """min .1 r^4 - r^2 = -2.4 at the bounds, 2 units away; 0 is a maximum of it."""
    ocp, cost = regulator()
    r = ocp.decision("r", guess=0.0, lower=-2.0 * unit, upper=2.0 * unit) / unit
    ocp.minimize(running=cost, terminal=0.1 * r**4 - r**2)
    return ocp


def begun(unit=1.0):
    """The start of a state that decays is free."""
    ocp, cost = regulator()
    y = ocp.state("y", initial=None, lower=-3.0 * unit, upper=3.0 * unit)
    ocp.dynamics(y, -0.1 * y)
    ocp.minimize(running=cost + 0.1 * (y / unit) ** 4 - (y / unit) ** 2)
    return ocp


def best_start():
    """The smallest value of int .1 y^4 - y^2 with y = c exp(-t/10)."""
    fourth, second = (1 - np.exp(-0.4)) / 0.4, (1 - np.exp(-0.2)) / 0.2
    return -(second**2) / (4 * 0.1 * fourth)


REGULATED = np.tanh(1.0)  # of min int x^2 + u^2 with x(0) = 1


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e2])
@pytest.mark.parametrize(("made", "best"), [(decided, -2.4), (begun, best_start())])
def test_a_saddle_is_left_though_the_controls_moved(made, best, unit, method):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solution = co.solve(made(unit), method=method, progress=False)
    assert solution.cost == pytest.approx(REGULATED + best, abs=1e-5)
    assert solution.optimality.curvature > 0
    assert not [str(w.message) for w in said if "no minimum" in str(w.message)]


@pytest.mark.parametrize("method", METHODS)
def test_what_goes_no_further_in_too_small_a_unit_is_told(method):
    """Bounds are the one thing that tells the unit, and far ones tell none."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solution = co.solve(begun(1e4), method=method, progress=False)
    told = any("no minimum" in str(w.message) for w in said)
    assert told or solution.cost == pytest.approx(REGULATED + best_start(), abs=1e-5)


@pytest.fixture
def from_guesses(monkeypatch):
    """Runs that start where the guesses say, not beside them."""
    monkeypatch.setattr(first_guess, "BESIDE", 0.0)


@pytest.mark.usefixtures("from_guesses")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("made", "best"), [(decided, -2.4), (begun, best_start())])
def test_a_saddle_that_a_run_ended_at_is_left_and_told(made, best, method):
    with pytest.warns(co.CovocpWarning, match="ended at a saddle"):
        solution = co.solve(made(), method=method, progress=False)
    assert solution.cost == pytest.approx(REGULATED + best, abs=1e-5)


@pytest.mark.usefixtures("from_guesses")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("made", "best"), [(decided, -2.4), (begun, best_start())])
def test_a_saddle_that_the_best_of_several_starts_ended_at_is_left_and_told(made, best, method):
    options = {"method": method, "guess": "multistart", "starts": 0, "progress": False}
    with pytest.warns(co.CovocpWarning, match="ended at a saddle"):
        solution = co.solve(made(), **options)
    assert solution.cost == pytest.approx(REGULATED + best, abs=1e-5)
    assert len(solution.stats["starts"]) == 1  # what is told of the starts is kept


@pytest.mark.usefixtures("from_guesses")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("made", [decided, begun])
def test_a_saddle_that_is_not_left_is_told(made, method, monkeypatch):
    monkeypatch.setattr(other_minima, "CHEAPER", np.inf)  # no other end is cheap enough
    with pytest.warns(co.CovocpWarning, match="no minimum"):
        solution = co.solve(made(), method=method, progress=False)
    assert solution.cost == pytest.approx(REGULATED, abs=1e-5)


@pytest.mark.usefixtures("from_guesses")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("made", [decided, begun])
def test_a_negative_curvature_that_is_computed_is_told_and_its_advice_helps(made, method, monkeypatch):
    """As if the run had given no reason to look."""
    looks = other_minima._off_saddle
    monkeypatch.setattr(other_minima, "_off_saddle", lambda _, outcome, *__: outcome)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        solution = replace(co.solve(made(), method=method, progress=False))
    with pytest.warns(co.CovocpWarning, match="no minimum.*method='ipopt'"):
        assert solution.optimality.curvature < 0
    monkeypatch.setattr(other_minima, "_off_saddle", looks)
    with pytest.warns(co.CovocpWarning, match="ended at a saddle"):
        left = co.solve(made(), method="ipopt", guess=solution, progress=False)
    assert left.cost < solution.cost - 2.0


@pytest.mark.parametrize("method", METHODS)
def test_a_minimum_that_the_guess_met_is_no_saddle(method):
    ocp, cost = regulator()
    r = ocp.decision("r", guess=0.0, lower=-2.0, upper=2.0)
    ocp.minimize(running=cost, terminal=1.0 - ca.cos(r))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = co.solve(ocp, method=method, progress=False)
        assert solution.optimality.curvature > 0
    assert solution["r"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("start", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("method", METHODS)
def test_a_decision_that_acts_at_the_end_alone_is_found_in_the_unit_of_its_bounds(method, start):
    """The first Hessian of "reduced" is that of the decision in all segments, not of its value at the start."""
    ocp, cost = regulator()
    r = ocp.decision("r", guess=0.0, lower=-2.0, upper=2.0)
    ocp.minimize(running=cost, terminal=1.0 - ca.cos(r))
    solution = co.solve(ocp, method=method, guess={"r": start}, progress=False)
    assert solution.cost == pytest.approx(REGULATED, abs=1e-6)
    assert solution.stats["iterations"] < 50


def swing_by_its_conditions() -> float:
    """The cost of the next problem in units of 1: its boundary value problem, with p1(0) = 0 as x(0) is free."""

    def rates(_t, y):
        x, v, p1, p2, _ = y
        u = -p2 / 2
        return np.array([v, -np.sin(x) + u, -0.2 * x + p2 * np.cos(x), -p1, u**2 + 0.1 * x**2])

    def ends(a, b):
        return np.array([a[1] - 0.5, a[2], a[4], b[2], b[3]])

    found = solve_bvp(rates, ends, np.linspace(0, 2, 41), np.zeros((5, 41)), tol=1e-9)
    assert found.success
    return float(found.y[4, -1])


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_free_start_is_beside_its_guess_in_the_units_of_the_problem(unit: float) -> None:
    """One percent of 1 had been ten thousand times what moves there: 272 iterations instead of 3."""
    ocp = co.Problem(2.0, name="swing")
    x, v = ocp.state("x", initial=None), ocp.state("v", initial=0.5 * unit)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, -unit * ca.sin(x / unit) + u)
    ocp.minimize(running=(u / unit) ** 2 + 0.1 * (x / unit) ** 2)
    solution = co.solve(ocp, "ipopt", progress=False)
    assert solution.cost == pytest.approx(swing_by_its_conditions(), rel=1e-5)
    assert solution.stats["iterations"] <= 10


@pytest.mark.parametrize("guess", [0.9, 0.995])
def test_a_decision_whose_cost_has_no_value_beside_its_guess_stays_there(guess: float) -> None:
    """Of a terminal cost as of a running one; the best is where 1 - e^2 is a quarter, for whatever the rest costs."""
    ocp = co.Problem(2.0, name="orbit")
    e = ocp.decision("e", guess=guess)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=10.0 * (ca.sqrt(1.0 - e**2) - 0.5) ** 2)
    solution = co.solve(ocp, "ipopt", progress=False)
    assert solution.cost == pytest.approx(0.5, rel=1e-6)
    assert abs(float(solution["e"])) == pytest.approx(np.sqrt(0.75), rel=1e-4)
