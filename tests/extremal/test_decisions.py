"""The condition of decisions, int H_d dt + end terms, against finite differences of the cost."""

from __future__ import annotations

import numpy as np
import pytest
from decided import everywhere
from problems import solve

import covocp as co
from covocp.extremal.costates import discrete_costates
from covocp.extremal.decisions import decision_slopes, with_tied_multipliers

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
