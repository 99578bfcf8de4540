"""Nominals that give decisions, and those that do not."""

import numpy as np
import pytest
from refusals import refused

import covocp as co


def decided():
    """A lag whose rate is chosen: along u = 0 the cost is (1 - exp(-4 k)) / (2 k) + 0.2 k^2."""
    ocp = co.Problem(2.0, "chosen lag")
    x, k, u = ocp.state("x", initial=1.0), ocp.decision("k", guess=1.0, lower=0.0, upper=10.0), ocp.control("u")
    ocp.dynamics(x, u - k * x)
    ocp.minimize(running=x**2 + u**2 + 0.1 * k**2)
    return ocp, k


def test_a_nominal_gives_the_decisions_too():
    ocp, k = decided()
    for key in ("k", k):
        found = co.evaluate(ocp, nominal={"u": 0.0, key: 2.0})
        assert found.cost == pytest.approx((1 - np.exp(-8.0)) / 4 + 0.8, rel=1e-6)
        assert float(found["k"]) == 2.0
    assert co.evaluate(ocp, nominal={"u": 0.0, "k": 12.0}).violations["bounds of k"] == pytest.approx(2.0)


def test_a_decision_that_the_nominal_does_not_give_is_no_guess():
    ocp, _ = decided()
    refused(lambda: co.evaluate(ocp, nominal={"u": 0.0}), "the decision 'k'", "add 'k' to nominal=")
    plain = co.Problem(2.0, "plain")
    x, u = plain.state("x", initial=1.0), plain.control("u")
    plain.dynamics(x, u - x)
    plain.minimize(running=x**2 + u**2)
    other = co.solve(plain, intervals=10, progress=False)
    refused(lambda: co.evaluate(ocp, nominal=other), "the decision 'k'", "give a dict")


def test_a_constant_gain_is_the_mean_of_the_best_one():
    """Of a solution without that constraint; before, it was the guess of the gain, zero."""

    def loop(gain=None):
        ocp = co.Problem(3.0)
        x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
        ocp.dynamics(x, u, noise=0.1)
        ocp.measurement("m", x, noise=0.05)
        ocp.minimize_expected(running=u**2 + x**2, terminal=5 * (x - 2) ** 2, gain=gain)
        return ocp

    best = co.solve(loop(), intervals=20, progress=False)
    found = co.evaluate(loop(co.Gain(constant=True)), nominal=best)
    np.testing.assert_allclose(found.gains["C"], np.mean(best.gains["C"]), rtol=1e-9)
    assert best.cost < found.cost < 1.1 * best.cost
