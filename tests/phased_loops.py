"""Problems in phases with an expected cost, that several tests share."""

from __future__ import annotations

import casadi as ca

import covocp as co

RESTITUTION, DRAG, NOISE = 0.7, 0.2, 0.01


def lag(duration: float, name: str, *, first: bool = True, last: bool = True) -> co.Problem:
    """The lag with an unknown time constant and an expected cost, or one part of it.

    Args:
        duration: of the part.
        name: of it.
        first: whether it is the first one.
        last: whether it is the last one.
    """
    ocp = co.Problem(duration, name=name)
    x = ocp.state("x", initial=0.0 if first else None, final=1.0 if last else None, variance=1.0 if first else None)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=1.0)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0} if last else None)
    return ocp


def bounce(*, free: bool = True) -> co.Phases:
    """A body that falls, bounces off the ground with an unknown restitution, and then also has an unknown thrust error.

    Args:
        free: whether the duration of the fall is.
    """
    fall = co.Problem(co.Free(1.0, 0.2, 3.0) if free else 1.0, name="fall")
    x = fall.state("x", initial=1.0, final=0.1, variance=0.1)
    v = fall.state("v", initial=0.0, variance=0.2)
    r = fall.unknown("r", mean=RESTITUTION, variance=0.04)
    k = fall.unknown("k", mean=DRAG, variance=0.01)
    u = fall.control("u")
    fall.dynamics(x, v, noise=0.01)
    fall.dynamics(v, -1.0 - k * v * ca.sqrt(v**2 + 0.01) + u, noise=0.02)
    fall.measurement("position", x, noise=0.1)
    fall.minimize_expected(running=0.5 * u**2 + 0.1 * x**2, terminal=0.1 * fall.duration + 0.2 * v**2)

    rise = co.Problem(1.5, name="rise")
    x2, v2 = rise.state("x", initial=None, final=0.8), rise.state("v", initial=None)
    q = rise.state("q", initial=0.1, variance=0.3)
    rise.unknown("r", mean=RESTITUTION, variance=0.04)
    k2 = rise.unknown("k", mean=DRAG, variance=0.01)
    w = rise.control("w")
    rise.dynamics(x2, v2, noise=0.01)
    rise.dynamics(v2, -1.0 - k2 * v2 * ca.sqrt(v2**2 + 0.01) + w + q, noise=0.02)
    rise.dynamics(q, -q, noise=0.05)
    rise.measurement("position", x2, noise=0.1)
    rise.measurement("speed", v2, noise=0.2)
    rise.minimize_expected(running=0.5 * w**2 + 0.1 * v2**2, terminal_weight={x2: 3.0, v2: 1.0})
    phases = co.Phases([fall, rise], name="bounce")
    phases.jump(v2, -r * v, noise=NOISE * (1.0 + v**2))
    return phases
