"""What a steep penalty costs along the controls: against the same controls integrated by scipy."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co


def swing_up(weight: float, *, at_the_end: bool) -> co.Problem:
    """A pendulum that shall be upright, or be there all the time after the middle, for a price that bends."""
    ocp = co.Problem(5.0, name="pendulum")
    x, v = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0)
    u = ocp.control("u", lower=-6.0, upper=6.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, -9.81 * ca.sin(x) - 0.1 * v + u)
    miss = weight * ((x - np.pi) ** 2 + v**2)
    late = 1.0 / (1.0 + ca.exp(-20.0 * (ocp.time - 4.5)))
    if at_the_end:
        ocp.minimize(running=0.05 * u**2, terminal=miss)
    else:
        ocp.minimize(running=0.05 * u**2 + late * miss)
    return ocp


def flown(solution: co.Solution, weight: float, *, at_the_end: bool) -> float:
    t, u = solution.t, solution["u"].ravel()
    y = np.zeros(3)
    for a, b, before, after in zip(t[:-1], t[1:], u[:-1], u[1:], strict=True):

        def rate(s: float, y: Any, a=a, b=b, before=before, after=after) -> list[float]:
            force = before + (after - before) * (s - a) / (b - a)
            late = 0.0 if at_the_end else 1.0 / (1.0 + np.exp(-20.0 * (s - 4.5)))
            miss = late * weight * ((y[0] - np.pi) ** 2 + y[1] ** 2)
            return [y[1], -9.81 * np.sin(y[0]) - 0.1 * y[1] + force, 0.05 * force**2 + miss]

        y = solve_ivp(rate, (a, b), y, rtol=1e-11, atol=1e-13).y[:, -1]
    return float(y[2] + at_the_end * weight * ((y[0] - np.pi) ** 2 + y[1] ** 2))


@pytest.mark.parametrize("at_the_end", [True, False], ids=["at the end", "on the way"])
@pytest.mark.parametrize("weight", [1e2, 1e4, 1e6])
def test_by_default_the_cost_is_that_of_the_controls(weight: float, at_the_end: bool) -> None:
    solution = co.solve(swing_up(weight, at_the_end=at_the_end), intervals=60, progress=False)
    assert flown(solution, weight, at_the_end=at_the_end) == pytest.approx(solution.cost, rel=3e-4)


@pytest.mark.parametrize(
    ("weight", "at_the_end", "segments"),
    [
        *((weight, at_the_end, 12) for weight in (1e2, 1e4) for at_the_end in (True, False)),
        *((1e2, True, 1), (1e4, True, 1), (1e2, False, 1)),
    ],
)
def test_long_steps_are_told_with_what_they_cost_along_the_controls(
    weight: float, at_the_end: bool, segments: int
) -> None:
    with pytest.warns(co.CovocpWarning, match="too coarse|alone leaves the nodes|change faster"):
        solution = co.solve(
            swing_up(weight, at_the_end=at_the_end), intervals=60, substeps=1, segments=segments, progress=False
        )
    off = flown(solution, weight, at_the_end=at_the_end) / solution.cost - 1.0
    assert off > 2e-4
    assert 0.4 * off < solution.mesh_error < 1.4 * off  # halves of steps that are too long tell but some of it
