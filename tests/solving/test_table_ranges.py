"""Tables are read where they have values, or it is said by how much not."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np
import pytest

import covocp as co

KNOTS = np.linspace(0.0, 2.0, 9)
DRAG = co.table("drag of v", KNOTS, 0.1 * KNOTS**2)


def pushed(rate, **state):
    """v' = u = 1 without drag: v = t over 3 s, where nothing else acts."""
    ocp = co.Problem(3.0, name="pushed")
    v = ocp.state("v", initial=0.0, **state)
    y = ocp.state("y", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(v, u)
    ocp.dynamics(y, rate(v, u))
    ocp.minimize(running=(u - 1.0) ** 2)
    return ocp


@pytest.mark.parametrize("kind", ["linear", "cubic"])
@pytest.mark.parametrize("count", [9, 200])
def test_a_path_beyond_the_knots_is_told_with_how_far_and_when(kind, count):
    knots = np.linspace(0.0, 2.0, count)
    drag = co.table("drag", knots, 0.1 * knots**2, kind=kind)
    with pytest.warns(co.CovocpWarning, match="table 'drag' is read beyond its knots, by 1 at t = 3 s: its outermost"):
        solution = co.solve(pushed(lambda v, u: -drag(v)), intervals=12, progress=False)
    (left,) = solution.left_tables()
    assert (left.by, left.time) == pytest.approx((1.0, 3.0), abs=1e-6)


def test_between_the_knots_nothing_is_said():
    solution = co.solve(pushed(lambda v, u: -DRAG(v * 2 / 3)), intervals=12, progress=False)
    assert solution.left_tables() == ()
    assert co.solve(pushed(lambda v, u: v), intervals=12, progress=False).left_tables() == ()


def test_each_argument_has_its_own_knots_also_inside_of_functions():
    plane = co.table("lift", (KNOTS, 2 * KNOTS), np.add.outer(KNOTS, KNOTS))
    z = ca.MX.sym("z")
    own = ca.Function("own", [z], [plane(0.5, -z) + DRAG(z / 2)])
    with pytest.warns(co.CovocpWarning, match="'lift', argument 2 is read beyond its knots, by 3 at t = 3 s"):
        solution = co.solve(pushed(lambda v, u: own(v)), intervals=12, progress=False)
    assert [entry.name for entry in solution.left_tables()] == ["table 'lift', argument 2"]


def test_where_a_nominal_is_evaluated_it_is_told_too():
    with pytest.warns(co.CovocpWarning, match=re.escape("table 'drag_of_v' is read beyond its knots, by 4")):
        co.evaluate(pushed(lambda v, u: -DRAG(v)), nominal={"u": 2.0}, intervals=12)


def test_covariances_that_a_table_reads_count():
    ocp = co.Problem(2.0, name="known")
    x = ocp.state("x", initial=0.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2 + DRAG(E[x, x]))
    with pytest.warns(co.CovocpWarning, match="by 1 at t = 2 s"):  # E = 1 + t
        co.solve(ocp, intervals=12, progress=False)
