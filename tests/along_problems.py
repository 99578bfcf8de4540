"""Problems along whose nodes numbers of the compiled library are compared with CasADi's expressions."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import random_problems
from vehicles import vehicle

import covocp as co
from covocp.models import bryson_denham, mass_chain, unknown_lag


def own_rates() -> co.Problem:
    """A matrix with rates of its own that depend on state and control; free duration, a state limit, a path limit."""
    ocp = co.Problem(duration=co.Free(3.0, lower=1.0, upper=6.0), name="two")
    x, v = ocp.state("x", initial=0.0, final=2.0), ocp.state("v", initial=0.0, upper=1.5)
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.1 * v**3)
    P = ocp.symmetric("P", 2, initial=[[1.0, 0.1], [0.1, 0.5]])
    F = ca.blockcat([[-0.3, 1.0], [-ca.exp(-x), -0.2 - 0.1 * v**2]])
    ocp.dynamics(P, F @ P + P @ F.T + ca.diag(ca.vertcat(0.1, 0.2 + u**2)))
    ocp.subject_to(v * x, upper=5.0)
    ocp.minimize(running=0.1 + 0.5 * u**2, terminal=P[0, 0] + 0.3 * P[0, 1] + 0.1 * x * v)
    return ocp


def turning() -> co.Problem:
    """An attitude whose error is estimated."""
    ocp = co.Problem(duration=2.0, name="turning")
    w, u = ocp.state("w", 3, initial=0.0, variance=0.1), ocp.control("u", 3, guess=[0.1, -0.2, 0.05])
    q = ocp.attitude("q", initial=[1.0, 0.0, 0.0, 0.0], rate=w, variance=0.1, noise=0.01)
    ocp.dynamics(w, u - ca.cross(w, ca.DM([1.0, 2.0, 0.5]) * w), noise=0.1)
    ocp.measurement("star", q.matrix[:, 0], noise=0.01)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * ca.sumsqr(u), terminal=E[w[0], w[0]] + 3.0 * E[w[2], w[2]])
    return ocp


PROBLEMS: dict[str, tuple[Any, dict[str, Any]]] = {
    "chain": (lambda: mass_chain.problem(masses=2), {}),
    "many masses": (lambda: mass_chain.problem(masses=14), {}),
    "substeps": (lambda: mass_chain.problem(masses=2), {"substeps": 3}),
    "constant": (unknown_lag.problem, {"control": "constant", "substeps": 2}),
    "limits": (bryson_denham.problem, {}),
    "limits inside": (bryson_denham.problem, {"points": 4}),
    "vehicle": (lambda: vehicle(8.0, 0.5, 1.0, beacon=True), {}),
    "two": (own_rates, {}),
    "turning": (turning, {}),
    **{f"random {seed}": (lambda seed=seed: random_problems.draw(seed).problem, {}) for seed in (2, 4, 6, 7, 9)},
}


def alike(one: np.ndarray, other: np.ndarray, allowed: float = 1e-10) -> None:
    """To roundoff of the largest entry."""
    assert np.shape(one) == np.shape(other)
    assert np.abs(one - other).max(initial=0.0) <= allowed * np.abs(other).max(initial=0.0)
