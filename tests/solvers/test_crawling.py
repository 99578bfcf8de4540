"""Experiments whose best input goes from bound to bound: the cost is concave in it, and Ipopt learns no curvature."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

import covocp as co
from covocp.solvers.monitor import SAME_STEPS, _Steps

# Of the measurement, m^2 s.
NOISE = 0.1


def experiment(kind: str, duration: float) -> co.Problem:
    """x' = -a x + u or -x + a u, of which a is unknown, without process noise, u within 1."""
    ocp = co.Problem(duration)
    x = ocp.state("x", initial=0.0, variance=0.0)
    a = ocp.unknown("a", mean=1.0, variance=1.0)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, -a * x + u if kind == "pole" else -x + a * u)
    ocp.measurement("m", x, noise=NOISE)
    E = ocp.estimation_covariance()
    ocp.minimize(terminal=E[a, a])
    return ocp


def least_variance(kind: str, duration: float) -> float:
    """The sensitivity of x to a is a convolution of u with a kernel of one sign: largest by u = 1 all the time."""

    def sensitivity(t: float) -> float:
        return t * np.exp(-t) - (1 - np.exp(-t)) if kind == "pole" else 1 - np.exp(-t)

    information, _ = quad(lambda t: sensitivity(t) ** 2 / NOISE, 0.0, duration)
    return 1.0 / (1.0 + information)


@pytest.mark.parametrize(("kind", "duration"), [("pole", 8.0), ("pole", 15.0), ("gain", 3.0), ("gain", 8.0)])
def test_bounded_experiments_are_solved(kind: str, duration: float):
    """By the defaults, in tens of iterations."""
    solution = co.solve(experiment(kind, duration), progress=False)
    assert solution.converged
    assert solution.stats["iterations"] < 100
    assert solution.cost == pytest.approx(least_variance(kind, duration), rel=2e-6)
    assert np.abs(solution["u"]).min() > 0.999


def test_a_first_hessian_that_is_given_is_kept():
    """Whoever sets it gets what he asks for, here the limit of iterations."""
    options = {"ipopt": {"limited_memory_init_val": 1.0}}
    with pytest.raises(co.SolveError, match="largest number of iterations"):
        co.solve(experiment("pole", 8.0), progress=False, plugin_options=options, max_iterations=100)


def test_steps_that_are_the_same_are_counted():
    """A run along a line by steps of one length; a step of another length or direction begins anew, none is none."""
    steps = _Steps()
    counts = [steps.same(np.array([float(k), 0.0])) for k in range(SAME_STEPS + 2)]
    assert counts == [0, 0, *range(1, SAME_STEPS + 1)]
    assert steps.same(np.array([SAME_STEPS + 1.5, 0.0])) == 0
    assert steps.same(np.array([SAME_STEPS + 1.5, 0.5])) == 0
    assert steps.same(np.array([SAME_STEPS + 1.5, 0.5])) == 0
    assert steps.same(np.array([SAME_STEPS + 1.5, 0.5])) == 0
