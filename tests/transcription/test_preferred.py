"""Where a cost prefers states to be: found in any unit, and nowhere where it prefers none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.transcription.preferred import At, preferred


def places(cost: Callable[[Any, Any], Any], *, running: bool = False, unit: float = 1.0) -> np.ndarray:
    """Of two states that begin at (1, 0) and are in some unit, by a cost of them in the unit 1."""
    ocp = co.Problem(2.0)
    x, v, u = ocp.state("x", initial=unit), ocp.state("v", initial=0.0), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    own = cost(x / unit, v / unit)
    ocp.minimize(running=own if running else u**2, terminal=0.0 if running else own)
    statement = ocp.statement()
    none = np.zeros(0)
    at = At(x=np.array([unit, 0.0]), u=np.zeros(1), e=none, duration=2.0, parameters=statement.values)
    return preferred(statement, at, np.array([unit, 1.0]), np.ones(2, dtype=bool)) / unit


@pytest.mark.parametrize("running", [False, True])
@pytest.mark.parametrize("unit", [1e-6, 1e-2, 1.0, 57.3, 1e3, 1e6])
def test_a_target_is_found_in_any_unit(unit, running):
    found = places(lambda x, v: 10.0 * (x - np.pi) ** 2 + 0.1 * (v + 3.0) ** 2, running=running, unit=unit)
    np.testing.assert_allclose(found, [np.pi, -3.0], rtol=1e-3)


def test_a_state_without_a_weight_has_no_place():
    found = places(lambda x, v: (x - 2.0) ** 2)
    assert found[0] == pytest.approx(2.0)
    assert np.isnan(found[1])


@pytest.mark.parametrize(
    "cost",
    [
        lambda x, v: -3.0 * x + 2.0 * v,
        lambda x, v: -(x**2) - v**2,
        lambda x, v: ca.exp(-x) + ca.exp(-v),
        lambda x, v: ca.cos(x) - 2.0 * x + ca.cos(v),
    ],
)
def test_a_cost_that_falls_on_prefers_no_place(cost):
    assert np.isnan(places(cost)).all()
