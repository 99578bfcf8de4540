"""What the form of a control costs where it meets its bounds, against closed forms."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import least_fuel
from scipy.linalg import expm

import covocp as co

STRONGEST = 5.0


def saturated() -> tuple[co.Problem, float]:
    """Least energy from rest to rest within bounds of the force, and its optimum: a saturated straight line."""
    ocp = co.Problem(1.0)
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u", lower=-STRONGEST, upper=STRONGEST)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=u**2)
    rest = float(np.sqrt(3.0 * (0.25 - 1.0 / STRONGEST)))  # distance = a/4 - a rest^2/3
    return ocp, 2 * STRONGEST**2 * (0.5 - rest + rest / 3.0)


@pytest.mark.parametrize("intervals", [7, 8, 10, 13, 17, 25, 40])
def test_intervals_that_touch_a_bound_count(intervals):
    """Without them a tenth of the error was told."""
    ocp, optimum = saturated()
    solution = co.solve(ocp, intervals=intervals, progress=False)
    excess = solution.cost / optimum - 1.0
    assert 0.5 * excess < solution.optimality.control_error < 2.5 * excess


def test_a_control_that_is_always_at_its_bound_costs_nothing():
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=0.0)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, u)
    ocp.minimize(running=0.1 * u**2, terminal=-x)  # u = 1 for any weight below 1/2
    solution = co.solve(ocp, intervals=10, progress=False)
    assert solution.cost == pytest.approx(-0.9, rel=1e-6)
    assert solution.optimality.control_error < 1e-9


def behind_a_fast_lag(lag: float) -> tuple[co.Problem, float]:
    """Least energy over a distance of 1 in 1 s, the force behind a lag; its optimum, by the Gramian of (x, v)."""
    ocp = co.Problem(1.0)
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    f, u = ocp.state("f", initial=0.0), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, f)
    ocp.dynamics(f, (u - f) / lag)
    ocp.minimize(running=u**2)
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / lag]])
    B = np.array([[0.0], [0.0], [1.0 / lag]])
    moves = expm(np.block([[-A, B @ B.T], [np.zeros((3, 3)), A.T]]) / 4096)  # Van Loan: over a short time, then doubled
    passage = moves[3:, 3:].T
    gramian = passage @ moves[:3, 3:]
    for _ in range(12):
        gramian, passage = gramian + passage @ gramian @ passage.T, passage @ passage
    return ocp, float(np.linalg.inv(gramian[:2, :2])[0, 0])


@pytest.mark.parametrize("intervals", [5, 10])
def test_a_fast_lag_does_not_make_the_form_of_the_control_dear(intervals):
    """Its costate is no polynomial over an interval: 200 times the cost was told, of which 4 % is true.

    A ninth of the excess is in the layers at both ends, which are shorter than a step.
    """
    ocp, optimum = behind_a_fast_lag(1e-3)
    solution = co.solve(ocp, intervals=intervals, control="constant", progress=False)
    assert solution.mesh.step == "rodas"
    assert solution.optimality.control_error == pytest.approx(solution.cost / optimum - 1.0, rel=0.15)
    solution = co.solve(ocp, intervals=intervals, progress=False)
    assert 0.0 < solution.optimality.control_error < solution.cost / optimum - 1.0


def test_a_filter_that_is_fast_at_the_start_does_not_make_the_form_of_the_control_dear():
    """Against the cost with four times the intervals, whose own error is 256 times smaller; 1.2 % was told."""

    def solved(intervals: int) -> co.Solution:
        ocp = co.Problem(10.0)
        x, v = ocp.state("x", initial=0.0, variance=1e6), ocp.state("v", initial=0.0, variance=1e3)
        a, g = ocp.unknown("a", mean=0.0, variance=1e9), ocp.unknown("g", mean=1.0, variance=1e3)
        u = ocp.control("u")
        ocp.dynamics(x, v)
        ocp.dynamics(v, a + g * u, noise=1e-6)
        ocp.measurement("position", x, noise=1e-8)
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2, terminal=1e4 * E[g, g])
        return co.solve(ocp, intervals=intervals, progress=False)

    solution = solved(100)
    assert solution.optimality.control_error == pytest.approx(solution.cost / solved(400).cost - 1.0, rel=0.1)


def test_singular_controls_behind_implicit_steps_have_no_estimate():
    """Least time through a fast lag: H is linear in u, and its costates are not known pointwise."""
    ocp = co.Problem(co.Free(2.0, 0.5, 5.0))
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    f, u = ocp.state("f", initial=0.0), ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, f)
    ocp.dynamics(f, (u - f) / 1e-3)
    ocp.minimize(terminal=ocp.duration)
    solution = co.solve(ocp, intervals=20, progress=False)
    assert solution.mesh.step == "rodas"
    assert solution.optimality.control_error is None
    assert "piecewise form" not in str(solution)


def with_a_valve() -> tuple[co.Problem, float]:
    """Layers of 1/30 s at both ends, sqrt(e) tanh(1/(2 sqrt(e))), beside a valve that lets 0.5 pass at any time."""
    weight = 1e-3
    ocp = co.Problem(1.0)
    x, y = ocp.state("x", initial=1.0, final=1.0), ocp.state("y", initial=0.0, final=0.5)
    u, w = ocp.control("u"), ocp.control("w", lower=0.0, upper=1.0)
    ocp.dynamics(x, u)
    ocp.dynamics(y, w)
    ocp.minimize(running=0.5 * x**2 + 0.5 * weight * u**2 + 0.01 * w)
    return ocp, float(np.sqrt(weight) * np.tanh(0.5 / np.sqrt(weight))) + 0.005


def least_time() -> tuple[co.Problem, float]:
    """From rest to rest over 1 by a force between -2 and 1."""
    ocp = co.Problem(co.Free(2.0, 0.1, 10.0))
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u", lower=-2.0, upper=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(terminal=ocp.duration)
    return ocp, float(np.sqrt(3.0))


def singular_arc() -> tuple[co.Problem, float]:
    """Bang, then u = x along x + v = 0; its optimum as published."""
    ocp = co.Problem(5.0)
    x, v = ocp.state("x", initial=0.0), ocp.state("v", initial=1.0)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=x**2 + v**2)
    return ocp, 0.7539839


def short_pulse() -> tuple[co.Problem, float]:
    """H_u = t - 0.03: the best control is at its upper bound for 0.03 s, which no node sees."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, u)
    ocp.minimize(running=(ocp.time - 0.03) * u)
    return ocp, -0.5 * (0.03**2 + 0.97**2)


@pytest.mark.filterwarnings("ignore:The controls change faster")  # with a valve on 13 intervals by 1.3e-2
@pytest.mark.parametrize("control", ["constant", "linear"])
@pytest.mark.parametrize(
    ("problem", "intervals", "most"),
    [
        (with_a_valve, 13, 1.1),
        (with_a_valve, 20, 1.1),
        (least_time, 10, 2.0),
        (least_time, 25, 2.0),
        (least_fuel, 20, 3.0),
        (singular_arc, 20, 4.0),
        (short_pulse, 10, 1.1),
    ],
)
def test_controls_in_which_h_is_linear_count(problem, intervals, most, control):
    """Beside them others did not count at all, nor did they where they were constant: 0 was told of 31 %."""
    ocp, optimum = problem()
    solution = co.solve(ocp, intervals=intervals, control=control, substeps=8, progress=False)
    excess = (solution.cost - optimum) / abs(optimum)
    assert 0.7 * excess < solution.optimality.control_error < most * excess


def test_the_error_of_one_control_value_is_not_known():
    ocp = co.Problem(1.0)
    x, y = ocp.state("x", initial=1.0), ocp.state("y", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.dynamics(y, x)
    ocp.minimize(running=x**2, terminal=y**2)
    solution = co.solve(ocp, intervals=1, control="constant", progress=False)
    assert np.isnan(solution.optimality.control_error)
    assert "NOT KNOWN, with one control value" in str(solution)


def watched_oscillator(*, density: bool) -> co.Problem:
    """A sensor whose rate costs: the information is linear in it, the density of its noise its inverse."""
    ocp = co.Problem(3.0)
    x, w = ocp.state("x", 2, initial=[1.0, 0.0], variance=1.0), ocp.control("w", lower=0.0, upper=1.0)
    ocp.dynamics(x, ca.vertcat(x[1], -x[0]), noise=[0.0, 0.2])
    ocp.measurement("y", x[0], **({"noise": 0.1 / (w + 1e-3)} if density else {"information": (w + 1e-3) / 0.1}))
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.3 * w + E[x[0], x[0]], terminal=2.0 * E[x[0], x[0]])
    return ocp


def test_a_rate_of_measurement_is_judged_alike_as_information_and_as_a_density():
    """Of a density rounding leaves some curvature: the error was told as millions of times the cost."""
    told, same, finer = (
        co.solve(watched_oscillator(density=density), intervals=intervals, progress=False)
        for density, intervals in ((True, 16), (False, 16), (False, 64))
    )
    assert told.cost == pytest.approx(same.cost, rel=1e-6)
    assert told.optimality.control_error == pytest.approx(same.optimality.control_error, rel=1e-3)
    excess = told.cost / finer.cost - 1.0
    assert 0.3 * excess < told.optimality.control_error < 10.0 * excess
