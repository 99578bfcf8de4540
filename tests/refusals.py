"""Refusals: small problems to put something wrong into, and the check that the answer says what is wrong."""

from __future__ import annotations

import pytest

import covocp as co


def refused(call, *words):
    """The call raises a ProblemError that has its four parts and contains the words; its message."""
    with pytest.raises(co.ProblemError) as caught:
        call()
    message = str(caught.value)
    missing = [part for part in ("\n  expected: ", "\n  received: ", "\n  remedy:   ", *words) if part not in message]
    assert missing == [], message
    return message


def wrong(*words):
    """Make a test of a function that states something wrong: refused in these words, before a solver starts."""

    def make(statement):
        def test(monkeypatch):
            def start(self, *arguments):
                pytest.fail("a solver was started")

            monkeypatch.setattr("covocp.solvers.ipopt.ShootingSolver.solve", start)
            message = refused(statement, *words)
            assert message[0].isupper() or message.startswith(("'", "dynamics()", "covariance_step="))  # or a name

        test.__name__, test.__doc__ = statement.__name__, statement.__doc__
        return test

    return make


def empty():
    return co.Problem(duration=1.0)


def simple(rate=None, running=None, terminal=0.0, control=None, **state):
    """An integrator x' = u, with one thing replaced."""
    ocp = empty()
    x, u = ocp.state("x", **{"initial": 0.0, **state}), ocp.control("u", **(control or {}))
    ocp.dynamics(x, u if rate is None else rate(x, u))
    ocp.minimize(running=u**2 if running is None else running(x, u), terminal=terminal(x) if terminal else 0.0)
    return ocp, x, u


def lag(noise=1.0, measurement_noise=1.0):
    ocp = co.Problem(duration=10.0)
    x = ocp.state("x", initial=0.0, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=noise)
    ocp.measurement("position", x, noise=measurement_noise)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=E[b, b])
    return ocp, x, b, u, E


def uncertain():
    """An integrator whose initial variance is the parameter v, measurement noise the parameter r."""
    ocp = empty()
    v, r = ocp.parameter("v", 1.0), ocp.parameter("r", 1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=v), ocp.control("u")
    ocp.dynamics(x, u, noise=1.0)
    ocp.measurement("range", x, noise=r)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x, x])
    return ocp
