"""Problems in phases that several tests share."""

from __future__ import annotations

import casadi as ca

import covocp as co

RESTITUTION, DRAG = 0.7, 0.2


def lag(
    duration: float, name: str, *, first: bool = True, last: bool = True, at: list[float] | None = None
) -> co.Problem:
    """The lag with an unknown time constant, or one part of it: the cost is that of knowing the constant at the end.

    Args:
        duration: of the part.
        name: of it.
        first: whether it is the first one.
        last: whether it is the last one.
        at: when the position is measured; None: always.
    """
    ocp = co.Problem(duration=duration, name=name)
    x = ocp.state("x", initial=0.0 if first else None, final=1.0 if last else None, variance=1.0 if first else None)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=1.0, at=at)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=10.0 * E[b, b] if last else 0.0)
    return ocp


def steered(first: co.Problem, second: co.Problem, price: float = 0.0) -> tuple[ca.MX, ca.MX]:
    """An integrator moved with least energy in two phases, the second with a price of its time; its state in both."""
    states = []
    for ocp in (first, second):
        x = ocp.state("x", initial=0.0 if ocp is first else None, final=None if ocp is first else 1.0)
        u = ocp.control("u")
        ocp.dynamics(x, u)
        ocp.minimize(running=0.5 * u**2, terminal=price * ocp.duration if ocp is second else 0.0)
        states.append(x)
    return states[0], states[1]


def bounce(variance: float = 0.5, upper: float | None = None) -> co.Phases:
    """A body that falls, bounces off the ground with an unknown restitution, and then also has an unknown thrust error.

    Args:
        variance: of the speed at the start.
        upper: of the variance of the speed at the end.
    """
    fall = co.Problem(duration=co.Free(1.0, 0.2, 3.0), name="fall")
    x = fall.state("x", initial=1.0, final=0.0, variance=0.1)
    v = fall.state("v", initial=0.0, variance=variance)
    r = fall.unknown("r", mean=RESTITUTION, variance=0.04)
    k = fall.unknown("k", mean=DRAG, variance=0.01)
    u = fall.control("u")
    fall.dynamics(x, v, noise=0.01)
    fall.dynamics(v, -1.0 - k * v * ca.sqrt(v**2 + 0.01) + u, noise=0.02)
    fall.measurement("position", x, noise=0.1)
    E = fall.estimation_covariance()
    fall.minimize(running=0.5 * u**2 + 0.3 * E[v, v], terminal=0.1 * fall.duration)

    rise = co.Problem(duration=1.5, name="rise")
    x2, v2 = rise.state("x", initial=None, final=0.8), rise.state("v", initial=None)
    q = rise.state("q", initial=0.1, variance=0.3)
    r2 = rise.unknown("r", mean=RESTITUTION, variance=0.04)
    k2 = rise.unknown("k", mean=DRAG, variance=0.01)
    w = rise.control("w")
    rise.dynamics(x2, v2, noise=0.01)
    rise.dynamics(v2, -1.0 - k2 * v2 * ca.sqrt(v2**2 + 0.01) + w + q, noise=0.02)
    rise.dynamics(q, -q, noise=0.05)
    rise.measurement("position", x2, noise=0.1)
    rise.measurement("speed", v2, noise=0.2)
    E2 = rise.estimation_covariance()
    rise.minimize(running=0.5 * w**2, terminal=20.0 * E2[k2, k2] + 3.0 * E2[x2, x2] + 2.0 * E2[r2, r2])
    if upper is not None:
        rise.subject_to(E2[v2, v2], upper=upper, at="final", name="speed known")
    phases = co.Phases([fall, rise], name="bounce")
    phases.jump(v2, -r * v, noise=0.01 * v**2)
    return phases
