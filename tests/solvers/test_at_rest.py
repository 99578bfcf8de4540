"""Plants that are at rest already: nothing has a magnitude, and no share of the cost says anything."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import covocp as co


def regulator(*, unit: float = 1.0, dense: bool = False, constant: float = 0.0) -> co.Problem:
    """A damped mass at rest, kept there; `unit`: of lengths, in metres; `constant`: added to the running cost."""
    ocp = co.Problem(duration=10.0, name="at rest")
    x, v = (ocp.state(name, initial=0.0, variance=0.01 * unit**2 if dense else None) for name in "xv")
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.1 * v, noise=1e-4 * unit**2 if dense else None)
    cost = (x**2 + v**2 + u**2) / unit**2 + constant
    if dense:
        ocp.measurement("y", x, noise=1e-3 * unit**2)
        E = ocp.estimation_covariance()
        ocp.minimize(running=cost, terminal=0 * E[x, x])
    else:
        ocp.minimize(running=cost)
    return ocp


@pytest.mark.parametrize("intervals", [20, 640])
@pytest.mark.parametrize("method", ["ipopt", "reduced", "auto", "gradient"])
def test_rest_is_found_without_a_word(method, intervals):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = co.solve(regulator(), method, intervals=intervals, progress=False)
    assert found.cost < 1e-20
    assert np.abs(found["u"]).max() < 1e-10
    assert found.stats["iterations"] < 200
    assert "LARGE" not in str(found)
    assert found.optimality.stationarity < 1e-9
    assert found.optimality.control_error < 1e-9


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")  # of a cost of 1e-12, which is nothing
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("method", ["ipopt", "reduced"])
def test_in_any_unit_and_beside_a_filter(method, unit):
    for dense in (False, True):
        found = co.solve(regulator(unit=unit, dense=dense), method, intervals=40, progress=False)
        assert found.cost < 1e-12


@pytest.mark.parametrize("constant", [1.0, 1e6])
@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
def test_beside_a_constant(method, constant):
    """What of the cost can change is nothing there but by its second derivatives."""
    found = co.solve(regulator(constant=constant), method, intervals=40, progress=False)
    assert found.cost == pytest.approx(10.0 * constant)
    assert "LARGE" not in str(found)


@pytest.mark.parametrize("constant", [0.0, 1e6])
def test_phases_at_rest_meet(constant):
    """Costates of 1e-150 on both sides of a link differ by nothing."""
    parts = []
    for k in range(2):
        ocp = co.Problem(2.0, name=f"part {k}")
        x, u = ocp.state("x", initial=0.0 if k == 0 else None, final=0.0 if k == 1 else None), ocp.control("u")
        ocp.dynamics(x, u - x)
        ocp.minimize(running=x**2 + u**2 + constant)
        parts.append(ocp)
    found = co.solve(co.Phases(parts), intervals=10, progress=False)
    assert found.cost == pytest.approx(4.0 * constant, abs=1e-20)
    assert "LARGE" not in str(found)
