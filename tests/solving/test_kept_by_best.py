"""Conditions on X that the best gain keeps leave it the optimum, also beside an actuator that is known exactly."""

from __future__ import annotations

import pytest

import covocp as co

INTERVALS = {"intervals": 80, "progress": False}


def lane(probability=None):
    """A lane change with an actuator that is known exactly; state and control are bounded, neither bound acts."""
    ocp = co.Problem(4.0, name="lane change")
    y = ocp.state("y", initial=0.0, final=3.5, variance=0.04)
    psi = ocp.state("psi", initial=0.0, final=0.0, variance=1e-4)
    delta = ocp.state("delta", initial=0.0, lower=-0.2, upper=0.2)
    rate = ocp.control("rate", lower=-0.5, upper=0.5)
    ocp.dynamics(y, 20 * psi, noise=0.01)
    ocp.dynamics(psi, 7.4 * delta, noise=1e-4)
    ocp.dynamics(delta, rate)
    ocp.measurement("camera", y, noise=0.01)
    cost = rate**2 + 10 * delta**2 + 0.01 * (y - 3.5) ** 2
    ocp.minimize_expected(running=cost, terminal_weight={y: 1.0, psi: 10.0, delta: 1.0})
    if probability is not None:
        ocp.chance(y, lower=-0.7, upper=4.2, probability=probability, name="road")
    return ocp


@pytest.fixture(scope="module")
def best():
    """Of the best gain, from a Riccati equation."""
    return co.solve(lane(), **INTERVALS)


def test_a_condition_that_the_best_gain_keeps_costs_nothing(best):
    """Xhat is known to what steps may leave, along an actuator that hardly scatters: no warning tells of it."""
    found = co.solve(lane(0.5), **INTERVALS)
    assert found.cost == pytest.approx(best.cost, rel=2e-5)
    assert found.stats["iterations"] < 10
    assert found["delta"] == pytest.approx(best["delta"], abs=1e-4)
    assert found.chances[0].reached > 0.9


def test_a_condition_that_acts_beside_an_actuator_known_exactly_is_found(best):
    """The same optimum by steps that keep Xhat semidefinite whatever the gain; it acts from here on."""
    found = co.solve(lane(0.99), **INTERVALS)
    assert found.chances[0].reached == pytest.approx(0.99, abs=1e-6)
    assert found.cost == pytest.approx(0.14279145, rel=1e-6)  # by covariance_step="gauss"
    assert found.cost > best.cost * (1 + 1e-3)
