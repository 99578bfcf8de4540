"""The first-order lag of 5.3: solved, and with one thing changed."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

import covocp as co
from covocp.models import unknown_lag

SECOND = {"u": lambda s: -np.sin(2 * np.pi * s)}  # leads to the second local minimum of 5.3


@lru_cache
def lag(weight: float, final: float, *, second: bool = False, **options: Any) -> co.Solution:
    problem = unknown_lag.problem(weight=weight, final=final)
    return co.solve(problem, intervals=80, progress=False, guess=SECOND if second else None, **options)


def variant(
    *,
    duration: Any = 10.0,
    start: Any = 0.0,
    final: Any = 1.0,
    unknown: bool = True,
    covariance: bool = True,
    initial: Any = None,
    variance: float = 5.0,
    state: dict[str, Any] | None = None,
    control: dict[str, Any] | None = None,
    rate: Any = lambda x, b, u, t: -b * x + u,
    noise: Any = lambda x, u: 1.0,
    measure: Any = lambda x, b, u, t: x,
    measured: bool = True,
    density: Any = lambda x, u: 1.0,
    running: Any = lambda x, u, E, b: 0.5 * u**2,
    terminal: Any = lambda x, E, b: 10.0 * E[b, b],
    extra: Any = lambda ocp, x, u, E, b: None,
) -> co.Problem:
    """The first-order lag of 5.3 with one thing changed."""
    ocp = co.Problem(duration, name="variant")
    x = ocp.state("x", initial=start, final=final, variance=1.0, **(state or {}))
    if unknown:
        b: Any = ocp.unknown("b", mean=1.0, variance=variance)
    else:
        b = ocp.parameter("b", 1.0)
    u = ocp.control("u", guess=lambda s: np.sin(np.pi * s), **(control or {}))
    ocp.dynamics(x, rate(x, b, u, ocp.time), noise=noise(x, u))
    if measured:
        ocp.measurement("position", measure(x, b, u, ocp.time), noise=density(x, u))
    E: Any = ocp.estimation_covariance(initial=initial) if covariance else None
    extra(ocp, x, u, E, b)
    ocp.minimize(running=running(x, u, E, b), terminal=terminal(x, E, b))
    return ocp
