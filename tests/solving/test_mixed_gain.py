"""Conditions on the spread of the loop where some is measured all the time and some read at instants.

What the estimate learns on the way is stepped so that Xhat stays semidefinite, however large the gain is.
"""

from __future__ import annotations

import numpy as np
import pytest
from spreads import covariances_with_gains, ellipse_mixed, ellipse_mixed_by_duality

import covocp as co
from covocp.base.errors import ProblemError

NOISE, DENSITY, VARIANCE, UNIT = 0.01, 1e-4, 1e-6, 1e3


@pytest.mark.parametrize(("limits", "variance", "most"), [((0.05, 0.05), 1e-8, 3e-6), ((0.03, 0.08), 0.01, 2e-4)])
def test_an_ellipse_at_the_end_costs_what_duality_says(limits, variance, most):
    """What gains between the nodes leave: 1e-6, and 1.2e-4 where they are steep at the end."""
    solution = co.solve(ellipse_mixed(limits, variance), intervals=30, covariance_step="gauss", progress=False)
    assert -1e-6 < solution.cost / ellipse_mixed_by_duality(limits, variance) - 1.0 < most
    assert solution.optimality.mesh_error < 1e-4


def wall():
    """Towards a wall that is kept clear of, with accurate sensors, in a unit of a thousandth."""
    ocp = co.Problem(5.0, "wall")
    x = ocp.state("x", initial=UNIT, final=0.0, variance=0.01 * UNIT**2)
    v = ocp.state("v", initial=0.0, final=0.0, variance=0.01 * UNIT**2)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=NOISE * UNIT**2)
    ocp.measurement("speed", v, noise=DENSITY * UNIT**2)
    ocp.measurement("place", x, noise=VARIANCE * UNIT**2, every=1.0)
    X = ocp.closed_loop_covariance()
    weight = 1.0 / UNIT**2
    ocp.minimize_expected(weight * (0.5 * u**2 + 0.1 * v**2 - UNIT * x), terminal_weight={x: weight, v: weight})
    ocp.subject_to((x + 3 * X.deviation(x)) / UNIT, upper=1.3, name="wall")
    return ocp


def test_a_wall_is_kept_with_the_covariances_of_scipy():
    """The speed is known within 1/200 s of the first second; classical Runge-Kutta takes 51 steps an interval."""
    solution = co.solve(wall(), intervals=20, progress=False)
    start, noise = np.diag([0.01, 0.01]), np.diag([0.0, NOISE])
    E, Xhat = covariances_with_gains(solution, start, noise, VARIANCE, lambda E: E[:, 1:] @ E[1:] / DENSITY)
    for found, known, most in ((solution.loop.E, E, 1e-4), (solution.loop.Xhat, Xhat, 1e-3)):
        off = np.abs(found / UNIT**2 - known).max(axis=(1, 2))
        assert (off <= most * np.abs(known).max(axis=(1, 2))).all()
    smallest, size = np.linalg.eigvalsh(solution["Xhat"])[:, 0], np.trace(solution["Xhat"], axis1=1, axis2=2)
    assert (smallest >= -1e-9 * size).all()
    largest = solution["x"].ravel() / UNIT + 3 * np.sqrt(E[:, 0, 0] + Xhat[:, 0, 0])
    assert largest.max() == pytest.approx(1.3, abs=1e-3)


def test_strang_is_refused():
    with pytest.raises(ProblemError, match="strang"):
        co.solve(ellipse_mixed((0.05, 0.05), 0.01), intervals=10, covariance_step="strang", progress=False)
