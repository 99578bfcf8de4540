"""A controller's tables at times that were counted up: the node that is meant, as for the solution."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co
from covocp.export.laws.history import history


@pytest.mark.parametrize("control", ["constant", "linear"])
@pytest.mark.parametrize("uneven", [False, True])
def test_a_time_that_was_counted_up_to_a_node_is_after_it(control: str, uneven: bool) -> None:
    """2.3 - 2.0 and sums of 0.1 lie just before 0.3: held controls were those of the interval before."""
    ocp = co.Problem(3.0)
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, u - x, noise=0.1)
    ocp.measurement("m", x, noise=0.05, every=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=(u - ocp.time) ** 2 + x**2, terminal=E[x, x])
    nodes = np.delete(np.linspace(0.0, 1.0, 31), [8, 19] if uneven else [])
    plan = co.solve(ocp, grid=nodes, control=control, progress=False)
    tables = history(plan, "double")
    times = np.concatenate([np.cumsum(np.full(29, 0.1)), [2.3 - 2.0, 2.4 - 2.0, 0.1 * 3, 0.3]])
    x, u, e = tables.rows(times)
    exact = plan.at(times)
    np.testing.assert_allclose(u[:, 0], exact["u"], atol=1e-12)
    np.testing.assert_allclose(x[:, 0], exact["x"], atol=1e-9)
    np.testing.assert_allclose(e[:, 0], exact["E"][:, 0, 0], atol=1e-9)
