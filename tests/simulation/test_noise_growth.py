"""Why a prediction fails: noise that grows with the deviations is told from a system that is too nonlinear."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co

QUIET: dict[str, Any] = {"progress": False}
Q, U = (0.1, 0.3, 0.4), (0.05, 0.1, 0.2)


def lag(T: float = 4.0, *, first: bool = True, last: bool = True, name: str = "lag") -> co.Problem:
    """x' = -x/2 + u, whose process and measurement noise grow with x^2 and u^2."""
    ocp = co.Problem(T, name=name)
    x = ocp.state("x", initial=1.0 if first else None, variance=0.6 if first else None)
    u = ocp.control("u")
    ocp.dynamics(x, -0.5 * x + u, noise=Q[0] + Q[1] * x**2 + Q[2] * u**2)
    ocp.measurement("m", x, noise=U[0] + U[1] * x**2 + U[2] * u**2)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=2.0 * x**2 if last else 0.0)
    return ocp


def exact(solution: Any, start: Any, *, grows: bool = True) -> np.ndarray:
    """< d^2 >, < d y >, < y^2 > at the end, along the nominal and the gains of a solution of `lag`; times from zero."""
    at_nodes, C = solution.t, solution.loop.gain[:, 0, 0]

    def moments(t: float, z: np.ndarray) -> list[float]:
        dd, dy, yy = z
        sample = solution.at(t)
        x, u, E, c = float(sample["x"]), float(sample["u"]), float(sample["E"][0, 0]), np.interp(t, at_nodes, C)
        X, V = (dd, c**2 * yy) if grows else (0.0, 0.0)
        density, noise = Q[0] + Q[1] * (x**2 + X) + Q[2] * (u**2 + V), U[0] + U[1] * (x**2 + X) + U[2] * (u**2 + V)
        K = E / (U[0] + U[1] * x**2 + U[2] * u**2)
        a, b = -0.5, -0.5 - c - K
        return [
            2 * (a * dd - c * dy) + density,
            a * dy - c * yy + K * dd + b * dy,
            2 * (K * dy + b * yy) + K**2 * noise,
        ]

    return solve_ivp(moments, (at_nodes[0], at_nodes[-1]), start, rtol=1e-7, atol=1e-9, max_step=0.05).y[:, -1]


def test_noise_that_grows_is_named_and_its_spread_is_exact():
    """A linear system with quadratic densities: nothing of it is nonlinear."""
    solution = co.solve(lag(), intervals=100, **QUIET)
    sample = co.simulate(solution, 2000, 1, **QUIET)
    assert sample.verdict.reasons == ("noise",)
    (entry,) = sample.verdict.deviations
    dd, dy, yy = exact(solution, [0.6, 0.0, 0.0])
    assert entry.grown == pytest.approx(np.sqrt(dd), rel=5e-3)
    assert sample.verdict.errors[0].grown == pytest.approx(np.sqrt(dd - 2 * dy + yy), rel=5e-3)
    assert entry.low <= np.sqrt(dd) <= entry.high
    assert entry.predicted == pytest.approx(np.sqrt(exact(solution, [0.6, 0.0, 0.0], grows=False)[0]), rel=1e-3)
    text = " ".join(str(sample).split())
    assert f"with what they add it is x {entry.grown:.3g}, inside the band" in text
    assert "nonlinear" not in text


def test_what_phases_before_have_added_counts():
    phases = co.Phases([lag(1.0, last=False, name="first"), lag(0.5, first=False, name="second")])
    solution = co.solve(phases, intervals=40, **QUIET)
    sample = co.simulate(solution, 4000, 1, **QUIET)
    middle = exact(solution["first"], [0.6, 0.0, 0.0])
    for k, end in enumerate((middle, exact(solution["second"], middle))):
        assert sample[k].verdict.reasons == ("noise",)
        assert sample[k].verdict.deviations[0].grown == pytest.approx(np.sqrt(end[0]), rel=5e-3)


def cubic(noise: Any, measured: Any, least: float = -np.inf) -> Any:
    """Runs of x' = -x^3 + u: the rate holds them closer together than its slope says."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=0.5, variance=0.3), ocp.control("u", lower=least)
    ocp.dynamics(x, -(x**3) + u, noise=noise(x, u))
    ocp.measurement("m", x, noise=measured(x))
    ocp.minimize_expected(running=0.5 * u**2 + x**2)
    return co.simulate(co.solve(ocp, intervals=40, **QUIET), 2000, 1, **QUIET)


def test_a_bent_system_with_noise_that_grows_is_still_too_nonlinear():
    sample = cubic(lambda x, u: 0.1 + 0.05 * x**2 + 0.05 * u**2, lambda x: 0.05 + 0.02 * x**2)
    assert sample.grown[0, 0] > 0
    assert sample.verdict.reasons == ("nonlinear",)


def test_a_system_of_constant_noise_is_too_nonlinear():
    sample = cubic(lambda x, u: 0.2, lambda x: 0.1)
    assert not sample.grown.any()
    assert sample.verdict.reasons == ("nonlinear",)
    assert "noise, which varies" not in str(sample)
    assert "no run is unstable or short of control" in str(sample.verdict)


def test_a_few_runs_short_of_control_are_not_denied():
    """Four of a thousand ask for more control than there is, which explains nothing, but they are there."""
    sample = cubic(lambda x, u: 0.2, lambda x: 0.1, least=-1.1)
    assert 0 < sample.asked.any(axis=1).mean() < 0.01
    assert sample.verdict.reasons == ("nonlinear",)
    assert "too few runs are unstable or short of control to explain it, so the system is too" in str(sample.verdict)
    assert "no run" not in str(sample.verdict)


def test_without_feedback_the_noise_may_be_to_blame():
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u - x, noise=0.01 + x**2 / 2)
    ocp.measurement("m", x, noise=0.1 + x**2 / 2)
    ocp.estimation_covariance()
    ocp.minimize(running=u**2 / 10 + x**2)
    sample = co.simulate(co.solve(ocp, intervals=40, **QUIET), 2000, 1, **QUIET)
    assert sample.verdict.reasons == ("nonlinear",)
    assert "or the noise, which varies with it, grows with it too much" in " ".join(str(sample).split())


def test_a_known_parameter_that_scales_the_noise_is_none_that_varies():
    """Its square is a number: no run deviates in it."""
    ocp = co.Problem(2.0)
    x, u, sigma = ocp.state("x", initial=0.0, variance=0.5), ocp.control("u"), ocp.parameter("sigma", 0.4)
    ocp.dynamics(x, -ca.sin(3.0 * x) + u, noise=sigma**2)
    ocp.measurement("m", x, noise=0.1)
    ocp.estimation_covariance()
    ocp.minimize(running=u**2)
    sample = co.simulate(co.solve(ocp, intervals=40, **QUIET), 2000, 1, **QUIET)
    assert not sample.verdict.holds
    assert not sample.verdict.unknown_noise
