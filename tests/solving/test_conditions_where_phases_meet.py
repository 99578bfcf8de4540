"""Conditions at instants, as ends of phases: natural splines through points, and what a limit of a variance costs."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import covocp as co

FORMS = ("eliminated", "states")
QUIET: dict[str, Any] = {"tolerance": 1e-10, "progress": False}


def test_least_energy_through_points_is_the_natural_spline() -> None:
    """Costates are third and second derivatives of the spline; multipliers the jumps of the third."""
    times, points = np.array([0.0, 1.0, 2.5, 4.0]), np.array([0.0, 1.0, -0.5, 2.0])
    legs = []
    for k, (begin, end) in enumerate(pairwise(times)):
        leg = co.Problem(end - begin, name=f"leg {k + 1}")
        x, v = leg.state("x", initial=None if k else points[0]), leg.state("v", initial=None)
        u = leg.control("u")
        leg.dynamics(x, v)
        leg.dynamics(v, u)
        leg.minimize(running=u**2 / 2)
        leg.subject_to(x, lower=points[k + 1], upper=points[k + 1], at="final", name="through")
        legs.append(leg)
    found = co.solve(co.Phases(legs), intervals=20, **QUIET)
    spline = CubicSpline(times, points, bc_type="natural")
    bend, third = spline(times, 2), 6.0 * spline.c[0]
    energy = np.diff(times) * (bend[:-1] ** 2 + bend[:-1] * bend[1:] + bend[1:] ** 2) / 6.0
    assert found.cost == pytest.approx(energy.sum(), rel=1e-9)
    t = np.linspace(0.0, 4.0, 33)
    np.testing.assert_allclose(np.ravel(found.at(t)["x"]), spline(t), atol=1e-8)
    for k, leg in enumerate(legs):
        costates = found[leg.name].costates.state
        np.testing.assert_allclose(costates[:, 0], third[k], rtol=1e-7)
        np.testing.assert_allclose(costates[[0, -1], 1], -bend[k : k + 2], atol=1e-7)
    # x''' is the costate of x, which before a point is that after it plus the multiplier; after the last one it is zero
    multipliers = [float(found[leg.name].multiplier("through")) for leg in legs]
    np.testing.assert_allclose(multipliers, -np.diff(third, append=0.0), rtol=1e-7)


def known_at_four(upper: float | None) -> co.Phases:
    """The lag with an unknown time constant, whose variance at t = 4 of 10 is limited."""
    problems = []
    for name, duration in (("before", 4.0), ("after", 6.0)):
        ocp, first = co.Problem(duration, name=name), name == "before"
        start = {"initial": 0.0, "variance": 1.0} if first else {"initial": None}
        x = ocp.state("x", final=None if first else 1.0, **start)
        b = ocp.unknown("b", mean=1.0, variance=5.0)
        u = ocp.control("u")
        ocp.dynamics(x, -b * x + u, noise=1.0)
        ocp.measurement("position", x, noise=1.0)
        E = ocp.estimation_covariance()
        ocp.minimize(running=0.5 * u**2)
        if first and upper is not None:
            ocp.subject_to(E[b, b], upper=upper, at="final", name="accuracy")
        problems.append(ocp)
    return co.Phases(problems)


@pytest.mark.parametrize("form", FORMS)
def test_a_variance_that_is_limited_where_phases_meet(form: str) -> None:
    """The multiplier is the slope of the cost by the limit; a limit that is met anyway costs nothing."""
    options = {"intervals": 20, "covariances": form, **QUIET}
    found, step = co.solve(known_at_four(1.0), **options), 1e-3
    near = [co.solve(known_at_four(1.0 + way * step), guess=found, **options).cost for way in (-1, 1)]
    multiplier = float(found["before"].multiplier("accuracy"))
    assert multiplier > 1.0
    assert multiplier == pytest.approx((near[0] - near[1]) / (2 * step), rel=1e-5)
    assert found["before"].values["E"][-1][1, 1] == pytest.approx(1.0, abs=1e-6)
    # the costate of E passes where phases meet, but for the multiplier of the limit
    before, after = (found[name].costates.matrices for name in ("before", "after"))
    expected = after[0] + np.array([0.0, 0.0, multiplier])
    np.testing.assert_allclose(before[-1].ravel(), expected.ravel(), rtol=1e-5, atol=1e-7)
    free, idle = (co.solve(known_at_four(limit), **options) for limit in (None, 100.0))
    assert idle.cost == pytest.approx(free.cost, rel=1e-9)
    assert float(idle["before"].multiplier("accuracy")) == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("phase", ["before", "after"])
def test_a_reading_at_the_instant_counts_in_the_phase_that_has_it(phase: str) -> None:
    """A walk, P(2) = 3 before it is read with variance 1 and 3/4 after: a condition sees one of both."""
    problems = []
    for name, at in (("before", [2.0]), ("after", [0.0])):
        ocp, first = co.Problem(2.0, name=name), name == "before"
        x = ocp.state("x", **({"initial": 0.0, "variance": 1.0} if first else {"initial": None}))
        s = ocp.state("s", initial=0.0 if first else None)
        u = ocp.control("u")
        ocp.dynamics(x, u, noise=1.0)
        ocp.dynamics(s, u)
        if phase == name:
            ocp.measurement("position", x, noise=1.0, at=at)
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2 / 2)
        if first:
            ocp.subject_to(s - E[x, x], lower=0.0, at="final", name="as far as it is known")
        problems.append(ocp)
    found = co.solve(co.Phases(problems), intervals=10, **QUIET)
    variance = 0.75 if phase == "before" else 3.0
    # Ipopt widens limits by 1e-8
    assert found["before"].values["s"][-1] == pytest.approx(variance, rel=3e-8)
    assert found.cost == pytest.approx(variance**2 / 4.0, rel=6e-8)
    assert found["after"].values["E"][-1][0, 0] == pytest.approx(2.75, rel=1e-8)
