"""Limits of zero: what a row compares with is a limit, however it is written."""

from __future__ import annotations

import warnings

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.statement.offsets import offset_of

MIDDLE, RADIUS = np.array([2.5, -0.05]), 0.5


def past_a_circle(form: str) -> co.Problem:
    """From 10 m away, in steps that are longer than the circle."""
    ocp = co.Problem(10.0, form)
    p, u = ocp.state("p", 2, initial=[-10.0, 0.0], final=[5.0, 0.0]), ocp.control("u", 2)
    ocp.dynamics(p, u)
    radius, apart = ocp.parameter("radius", RADIUS), ca.sumsqr(p - MIDDLE)
    if form == "limit":
        ocp.subject_to(apart, lower=RADIUS**2, name="circle")
    elif form == "parameter":
        ocp.subject_to(radius**2 - apart, upper=0.0, name="circle")
    elif form == "scaled":
        ocp.subject_to(3.0 * (apart - radius**2) / 7.0, lower=0.0, name="circle")
    else:
        ocp.subject_to(
            ca.sumsqr(p) - 2 * ca.dot(MIDDLE, p) + float(MIDDLE @ MIDDLE) - radius**2, lower=0.0, name="circle"
        )
    ocp.minimize(running=0.5 * ca.sumsqr(u))
    return ocp


@pytest.mark.parametrize("form", ["parameter", "scaled", "expanded"])
def test_a_circle_is_passed_by_as_much_however_it_is_written(form: str) -> None:
    """Of the expanded form the circle is no term of its own: the share is no more than that of its largest terms."""
    shares = []
    for one in ("limit", form):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = co.solve(past_a_circle(one), intervals=20, progress=False)
        assert any("Between the points" in str(warning.message) for warning in told)
        clearance = np.linalg.norm(found.at(np.linspace(0.0, 10.0, 4001))["p"] - MIDDLE, axis=1).min()
        assert clearance < 0.7 * RADIUS
        shares.append(found.passed_limits()[0].share)
    assert shares[0] == pytest.approx(1.0 - (clearance / RADIUS) ** 2, rel=1e-3)
    if form == "expanded":
        assert 0.01 < shares[1] <= shares[0]
    else:
        assert shares[1] == pytest.approx(shares[0], rel=1e-6)


def test_what_is_beside_the_variables_in_closed_form() -> None:
    """Sums, differences, negatives and products with what is free of variables; nothing of what is inside functions."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    a = ocp.parameter("a", 3.0)
    t, E = ocp.time, ocp.symmetric("E", 1, initial=1.0)
    ocp.dynamics(x, u)
    ocp.dynamics(E, -E)
    ocp.minimize(running=u**2)
    rows = [
        (a**2 - x**2, a**2),
        (-(x - 2 * a) / 4, a / 2),
        (x * u, 0.0),
        ((x - 1) ** 2, 0.0),
        (2 * (ca.sqrt(E[0, 0]) + t) - (a - (u - t)), t - a),
        ((1 + t) * (x + a), (1 + t) * a),
    ]
    for row, _ in rows:
        ocp.subject_to(row, upper=0.0)
    offset = offset_of(ocp.statement().path)
    assert offset is not None
    expected = ca.Function("expected", [t, a], [ca.vertcat(*(ca.MX(value) for _, value in rows))])
    for time, value in ((0.0, 3.0), (0.7, -1.3)):
        found = np.asarray(offset(time, 2.0, value).full())
        np.testing.assert_allclose(found, np.asarray(expected(time, value).full()), atol=1e-14)
