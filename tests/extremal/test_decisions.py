"""The condition of decisions, int H_d dt + end terms, against finite differences of the cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from decided import everywhere
from problems import solve

import covocp as co
from covocp.extremal.cost_sizes import variable_cost
from covocp.extremal.costates import discrete_costates
from covocp.extremal.decisions import decision_slopes, with_tied_multipliers
from covocp.extremal.optimality import assess

STEP = 1e-4


@pytest.mark.parametrize("closed", [False, True], ids=["filter", "loop"])
@pytest.mark.parametrize("step", ["gauss", "rk4"])
def test_slopes_are_those_of_the_cost(closed, step):
    """Along given controls, at a point that is not the best: five-point differences to 1e-6."""
    nominal, at = {"u": np.cos(np.linspace(0.0, 2.0, 21))}, np.array([0.9, 1.1, 0.7])
    options = {"grid": np.linspace(0.0, 1.0, 21), "substeps": 2, "covariance_step": step}

    def cost(values):
        return co.evaluate(everywhere(values, closed), nominal={**nominal, "d": values}, **options).cost

    extremal = co.evaluate(everywhere(at, closed), nominal={**nominal, "d": at}, **options).extremal
    extremal = with_tied_multipliers(extremal)  # of x(0) = d[2]
    slopes = decision_slopes(extremal, discrete_costates(extremal)[0])
    for k in range(3):
        shift = STEP * np.eye(3)[k]
        near, far = (cost(at + m * shift) - cost(at - m * shift) for m in (1, 2))
        assert slopes.total[k] == pytest.approx((8 * near - far) / (12 * STEP), rel=1e-6)
    assert (slopes.size >= np.abs(slopes.total)).all()


def test_the_condition_is_among_the_residuals():
    """Small at a solution, in the printout; none without decisions; not small elsewhere."""
    ocp = co.Problem(1.0, "two")
    d = ocp.decision("d", guess=0.1)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u + d)
    ocp.minimize(running=u**2, terminal=(x - 1.0) ** 2 + d**2)
    solution = solve(ocp, intervals=10)
    assert float(solution["d"]) == pytest.approx(1.0 / 3.0, rel=1e-7)
    assert solution.optimality.decisions < 1e-8
    assert "condition of the decisions" in str(solution)
    given = co.evaluate(ocp, nominal=solution).extremal
    moved = co.evaluate(ocp, nominal={"u": 0.0, "d": 0.1}).extremal
    costates = [discrete_costates(extremal)[0] for extremal in (given, moved)]
    assert decision_slopes(given, costates[0]).relative < 1e-6
    assert decision_slopes(moved, costates[1]).relative > 0.1
    plain = co.Problem(1.0, "plain")
    x, u = plain.state("x", initial=0.0), plain.control("u")
    plain.dynamics(x, u)
    plain.minimize(running=u**2, terminal=(x - 1.0) ** 2)
    assert solve(plain, intervals=10).optimality.decisions is None


def used_in_one_phase(*, last: bool, constant: float = 0.0) -> co.Phases:
    """An integrator from 0 to 1 in 2 s with least energy, 0.5, and a number that is best at 2, in one of two phases.

    A constant is added to the running cost of the phase without that number.
    """
    parts = []
    for name in ("A", "B"):
        first = name == "A"
        ocp = co.Problem(1.0, name=name)
        x = ocp.state("x", initial=0.0 if first else None, final=None if first else 1.0)
        d, u = ocp.decision("d", guess=0.5), ocp.control("u")
        ocp.dynamics(x, u)
        ocp.minimize(running=u**2 + (0.01 * (d - 2.0) ** 2 * (1.0 + x**2) if first != last else constant))
        parts.append(ocp)
    return co.Phases(parts)


@pytest.mark.parametrize("last", [False, True])
def test_a_phase_that_does_not_use_a_decision_has_nothing_to_complain_of(last):
    """Its slope is roundoff there, and had been compared with itself."""
    solution = co.solve(used_in_one_phase(last=last), intervals=10, progress=False)
    assert float(solution["A"]["d"]) == pytest.approx(2.0, rel=1e-6)
    assert max(phase.optimality.decisions for phase in solution) < 1e-6
    assert "LARGE" not in str(solution)


@pytest.mark.parametrize("constant", [0.0, 1e6])
def test_a_wrong_decision_of_a_phase_is_told(constant):
    """Moved from the best value 2 by m: a slope of 0.02 m (1 + mean x^2), x = (1 + t) / 2; told from 1e-4 on."""
    solution = co.solve(used_in_one_phase(last=True, constant=constant), intervals=10, progress=False)
    assert "LARGE" not in str(solution)
    phase = solution["B"]
    # of 0.25 each; u = 0.5 doubled changes u^2 by 2 u u + u^2, which counts where there is more of the cost
    others = 0.25 if not constant else 0.75
    assert variable_cost(solution["A"].extremal) == pytest.approx(others, rel=1e-6)
    given = np.array([0.0, -phase.costates.state[0, 1]])
    for moved in (2e-3, 0.2):
        t = phase.extremal.trajectory
        x = t.x + moved * np.eye(2)[1]
        extremal = replace(phase.extremal, trajectory=replace(t, x=x))
        slopes = decision_slopes(extremal, discrete_costates(extremal)[0], given, others)
        assert slopes.total[0] == pytest.approx(0.02 * moved * (1.0 + 7.0 / 12.0), rel=5e-3)
        # a tenth of the whole cost by the magnitude of the decision is more than the terms, which vanish at 2
        assert slopes.relative == pytest.approx(slopes.total[0] * (2.0 + moved) / (0.1 * (0.25 + others)), rel=2e-2)
        assert slopes.relative > 1e-4


@pytest.mark.parametrize("unit", [1.0, 1e-12])
@pytest.mark.parametrize("constant", [0.0, 1e6])
def test_a_constant_in_the_cost_hides_nothing(constant, unit):
    """At u = 0, d = 0.7, x(1) = 0.7: slopes -0.6 and 1.4 by d, -0.6 by u, of which nothing cancels."""
    ocp = co.Problem(1.0, "moved")
    d = ocp.decision("d", guess=0.1)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u + d)
    ocp.minimize(running=unit * (u**2 + constant), terminal=unit * ((x - 1.0) ** 2 + d**2))
    extremal = co.evaluate(ocp, nominal={"u": 0.0, "d": 0.7}, intervals=10).extremal
    found = assess(extremal, discrete_costates(extremal)[0], mesh_error=0.0, smallest_eigenvalue=np.inf)
    assert found.decisions == pytest.approx((1.4 - 0.6) / (1.4 + 0.6), rel=1e-6)
    assert found.stationarity == pytest.approx(1.0, rel=1e-6)
