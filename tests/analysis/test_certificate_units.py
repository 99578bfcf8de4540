"""Certificates in other units, of limits that are met up to a tolerance, and of what costs nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from lag_variants import lag

import covocp as co


def in_units(cost: float, state: float, control: float, second: float, **limits: Any) -> co.Problem:
    """The first-order lag to x(T) = 1 with other units of cost, state, control and time."""
    ocp = co.Problem(10.0 * second, name="lag in other units")
    x = ocp.state("x", initial=0.0, final=state, variance=state**2)
    b = ocp.unknown("b", mean=1.0 / second, variance=5.0 / second**2)
    u = ocp.control("u", **limits)
    ocp.dynamics(x, -b * x + u * state / (control * second), noise=state**2 / second)
    ocp.measurement("position", x, noise=state**2 * second)
    E: Any = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * cost / second * (u / control) ** 2, terminal=10.0 * cost * second**2 * E[b, b])
    return ocp


@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0, 1.0), (1e-13, 1.0, 1.0, 1.0), (1e-6, 1e-9, 1e-7, 1e3)])
def test_no_unit_decides_what_is_certified(units: tuple[float, float, float, float]) -> None:
    """A tolerance in the unit of the cost certified three times the least cost, where that is 1e-13."""
    ocp = in_units(*units)
    better, worse = (
        co.certify(co.evaluate(ocp, nominal={"u": units[2] * found.trajectory.u}, intervals=80))
        for found in (lag(10.0, 1.0), lag(10.0, 1.0, second=True))
    )
    assert better.certified, str(better)
    assert better.stationarity < 1e-2
    assert worse.verdict == "not certified"
    # Exactly 7.71199239 - 7.08523968 in the unit of the cost, at least.
    assert worse.gap > 0.6267 * units[0]


def test_a_limit_in_a_small_unit_is_violated_by_a_share_of_it() -> None:
    """Twice the limit, which is far below 1."""
    best = lag(10.0, 1.0).trajectory.u
    for size in (1.0, 1e-8):
        ocp = in_units(1.0, 1.0, size, 1.0, upper=0.5 * size * best.max())
        certificate = co.certify(co.evaluate(ocp, nominal={"u": size * best}, intervals=80))
        assert certificate.verdict == "not certified"
        assert "violates the constraints of the problem" in certificate.reason


def with_unwanted_actuator(kind: str, size: float = 1.0) -> co.Problem:
    """The lag and a control in some unit, which moves nothing or another state and is best at its limit of zero."""
    ocp = co.Problem(10.0, name="lag with two controls")
    x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
    y = ocp.state("y", initial=0.0) if kind == "state" else None
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u, v = ocp.control("u"), ocp.control("v", lower=-np.inf if kind == "condition" else 0.0)
    ocp.dynamics(x, -b * x + u, noise=1.0)
    if y is not None:
        ocp.dynamics(y, -y + v / size)
    if kind == "condition":
        ocp.subject_to(v, lower=0.0, name="pos")
    ocp.measurement("position", x, noise=1.0)
    E: Any = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + 0.5 * (v / size + 0.1) ** 2, terminal=10.0 * E[b, b])
    return ocp


@pytest.mark.parametrize("kind", ["condition", "bound", "state"])
@pytest.mark.parametrize("method", ["ipopt", "reduced"])
@pytest.mark.filterwarnings("ignore:At points where it is imposed the limit of")  # by 1e-8, or by 1e-34
def test_a_limit_of_zero_that_is_met_up_to_the_solver_s_tolerance_is_met(kind: str, method: Any) -> None:
    """What is left there is 1e-8 of the unit of the control, or rounding of nothing."""
    solution = co.solve(with_unwanted_actuator(kind), intervals=20, method=method, progress=False)
    assert "violates" not in str(co.certify(solution))


@pytest.mark.parametrize("size", [1.0, 1e-9])
def test_a_limit_of_zero_is_violated_by_a_share_of_the_unit_of_the_control(size: float) -> None:
    """The control costs by itself as much as the solution where it is 1.2 of its unit all the time."""
    best = lag(10.0, 1.0).trajectory.u[:, 0]
    for kind, share, violates in (("condition", 1e-4, True), ("bound", 1e-4, True), ("bound", 1e-8, False)):
        nominal = {"u": best, "v": -share * size * np.ones(best.size)}
        found = co.certify(co.evaluate(with_unwanted_actuator(kind, size), nominal=nominal, intervals=80))
        assert ("violates" in str(found)) == violates


@pytest.mark.parametrize("weight", [0.0, 1.0])
@pytest.mark.parametrize("method", ["ipopt", "reduced"])
@pytest.mark.parametrize("unit", [1e-9])
@pytest.mark.filterwarnings("ignore:The mesh is too coarse")  # a share of nothing as well
def test_nothing_is_the_global_minimum_where_nothing_costs_nothing(weight: float, method: str, unit: float) -> None:
    """What a solver leaves of u = 0 costs a share of nothing, but no more than controls that do nothing."""
    ocp = co.Problem(10.0)
    x, b = ocp.state("x", initial=0.0, variance=1.0), ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u / unit, noise=1.0)
    ocp.measurement("position", x, noise=1.0)
    ocp.estimation_covariance()
    ocp.minimize(running=0.5 * (u / unit) ** 2 + weight * x**2)
    certificate = co.certify(co.solve(ocp, method, intervals=20, progress=False), progress=False)
    assert certificate.certified, str(certificate)
    assert certificate.gap < 1e-9
