"""What is said of the covariance of the closed loop: limits that no feedback keeps, and where its values are."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co


def steered(limit=None, *, weight=1.0):
    """A double integrator whose position is measured; perhaps with a limit of X at the end."""
    ocp = co.Problem(duration=5.0, name="steered")
    x, v = ocp.state("x", initial=0.0, final=1.0, variance=0.04), ocp.state("v", initial=0.0, final=0.0, variance=0.01)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=0.01)
    ocp.measurement("position", x, noise=0.01)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: weight, v: weight})
    if limit is not None:
        ocp.subject_to(X[x, x] / limit, upper=1.0, at="final", name="end")
    return ocp, X, x, u


def test_a_limit_below_E_is_named_with_what_E_is():
    plain, *_ = steered()
    least = co.solve(plain, intervals=20, progress=False).loop.E[-1, 0, 0]  # linear: E is that of every nominal
    ocp, *_ = steered(0.001)
    with pytest.raises(co.SolveError, match=r"no feedback takes X below E.*'end'") as caught:
        co.solve(ocp, intervals=20, progress=False)
    said = float(str(caught.value).split("'end' is ")[1].split(" at ")[0])
    assert said == pytest.approx(least / 0.001, rel=1e-3)


def test_with_the_best_gain_values_of_X_are_those_of_the_loop():
    ocp, X, x, u = steered()
    solution = co.solve(ocp, intervals=20, progress=False)
    for key in (X, X.matrix, X[x, x], X.deviation(u)):
        with pytest.raises(co.ProblemError, match=r"solution\.loop"):
            solution[key]
        with pytest.raises(co.ProblemError, match=r"solution\.loop"):
            solution.at(1.0)[key]
    assert np.array_equal(solution.covariance(x)[:, 0, 0], solution.loop.X[:, 0, 0])


def test_with_a_free_gain_the_whole_X_is_not_E():
    ocp, X, x, _ = steered(0.06)
    solution = co.solve(ocp, intervals=10, progress=False)
    assert solution[X[x, x]] == pytest.approx(solution.loop.X[:, 0, 0], rel=1e-3)
    with pytest.raises(co.ProblemError, match=r"solution\.loop"):
        solution[X]
