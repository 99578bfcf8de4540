"""Ten plain problems without covariances whose optima are known in closed form, or by a quadrature.

Each is a function that states the problem for covocp, and an optimum that no solver computed; `PLAIN` lists them.

    layers          x' = u, int (x^2 + eps^2 u^2)/2, eps = 0.01: boundary layers at both ends
    hypersensitive  x' = -x^3 + u, int (x^2 + u^2)/2 over 10 000 s (Rao and Mease 2000): H = 0 along the long way
    saturated       x'' = u, least energy, |u| <= 5, rest to rest over 1: a saturated straight line
    fastest         x'' = u, least time, |u| <= 1, rest to rest over 1: T = 2
    drag            v' = u - v^2, least time, rest to rest over 1: tanh, then tan
    swing           x'' = -x + u, least time, |u| <= 1, from (1, 1) to rest: two arcs of circles
    lander          h'' = u - g, least fuel, 0 <= u <= 3 (Meditch 1964): free fall, then full thrust
    fuel            x'' = a - b, least fuel, 0 <= a, b <= 1, rest to rest in 2.5: thrust, coast, thrust
    speed           x'' = u, least time, |u| <= 1, speed at most 0.6, rest to rest over 1: thrust, coast, thrust
    bryson_denham   x'' = u, least energy, x <= 1/9 (Bryson and Ho 1975, section 3.11): 4 / (9 l)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

import covocp as co

LAYER, LONG, STRONGEST, LANDER, FUEL_TIME, FASTEST, WALL = 0.01, 1e4, 5.0, (10.0, -2.0, 1.5, 3.0), 2.5, 0.6, 1 / 9


@dataclass(frozen=True, kw_only=True)
class Plain:
    """A problem, its optimum, and the duration that a guess of it takes."""

    state: Callable[[], co.Problem]
    optimum: float


def _masses(duration: object, name: str, distance: float = 1.0, **limits: float) -> tuple[co.Problem, object, object]:
    """A mass that is pushed from rest to rest."""
    ocp = co.Problem(duration=duration, name=name)
    x = ocp.state("x", initial=0.0, final=distance)
    v = ocp.state("v", initial=0.0, final=0.0, **limits)
    ocp.dynamics(x, v)
    return ocp, x, v


def layers() -> co.Problem:
    """Boundary layers."""
    ocp = co.Problem(duration=1.0, name="layers")
    x, u = ocp.state("x", initial=1.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * (x**2 + LAYER**2 * u**2))
    return ocp


def _layers() -> float:
    return float(LAYER * (1.0 / np.tanh(1.0 / LAYER) - 1.0 / np.sinh(1.0 / LAYER)))


def hypersensitive() -> co.Problem:
    """Hypersensitive."""
    ocp = co.Problem(duration=LONG, name="hypersensitive")
    x, u = ocp.state("x", initial=1.0, final=1.5), ocp.control("u")
    ocp.dynamics(x, -(x**3) + u)
    ocp.minimize(running=0.5 * (x**2 + u**2))
    return ocp


def _hypersensitive() -> float:
    def root(x: float) -> float:
        return float(np.sqrt(x**6 + x**2))

    first = quad(lambda x: -(x**3) + root(x), 0.0, 1.0, epsabs=1e-13, epsrel=1e-13)[0]
    return float(first + quad(lambda x: x**3 + root(x), 0.0, 1.5, epsabs=1e-13, epsrel=1e-13)[0])


def saturated() -> co.Problem:
    """Least energy with saturation."""
    ocp, _, v = _masses(1.0, "saturated")
    u = ocp.control("u", lower=-STRONGEST, upper=STRONGEST)
    ocp.dynamics(v, u)
    ocp.minimize(running=0.5 * u**2)
    return ocp


def _saturated() -> float:
    # u = a up to t1, then a line through zero at 1/2: distance = a/4 - a (1/2 - t1)^2/3
    rest = float(np.sqrt(3.0 * (0.25 - 1.0 / STRONGEST)))
    return STRONGEST**2 * (0.5 - rest + rest / 3.0)


def fastest() -> co.Problem:
    """Least time."""
    ocp, _, v = _masses(co.Free(guess=3.0), "fastest")
    ocp.dynamics(v, ocp.control("u", lower=-1.0, upper=1.0))
    ocp.minimize(terminal=ocp.duration)
    return ocp


def drag() -> co.Problem:
    """Least time with drag."""
    ocp, _, v = _masses(co.Free(guess=3.0), "drag")
    ocp.dynamics(v, ocp.control("u", lower=-1.0, upper=1.0) - v**2)
    ocp.minimize(terminal=ocp.duration)
    return ocp


def _drag() -> float:
    # forward v = tanh t over ln cosh t, braking v = tan(s) over -ln cos s, v at the switch the same
    def way(v: float) -> float:
        return float(-0.5 * np.log(1 - v**2) + 0.5 * np.log(1 + v**2) - 1.0)

    v = float(brentq(way, 0.1, 1 - 1e-12, xtol=1e-15))
    return float(np.arctanh(v) + np.arctan(v))


def swing() -> co.Problem:
    """A swing brought to rest in least time."""
    ocp = co.Problem(duration=co.Free(guess=3.0), name="swing")
    x, v = ocp.state("x", initial=1.0, final=0.0), ocp.state("v", initial=1.0, final=0.0)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, -x + u)
    ocp.minimize(terminal=ocp.duration)
    return ocp


def _swing() -> float:
    # u = -1: a circle about (-1, 0) through (1, 1), clockwise, to the circle of radius 1 about (1, 0) with v < 0
    radius2 = 5.0
    x = radius2 / 4.0 - 1.0 / 4.0  # (x + 1)^2 + v^2 = radius2 and (x - 1)^2 + v^2 = 1
    v = -float(np.sqrt(1.0 - (x - 1.0) ** 2))
    first = float(np.arctan2(1.0, 2.0) - np.arctan2(v, x + 1.0))
    last = float((np.arctan2(v, x - 1.0) - np.pi) % (2 * np.pi))
    return first + last


def lander() -> co.Problem:
    """Soft landing with least fuel."""
    height, speed, gravity, thrust = LANDER
    ocp = co.Problem(duration=co.Free(guess=5.0), name="lander")
    h, v = ocp.state("h", initial=height, final=0.0), ocp.state("v", initial=speed, final=0.0)
    u = ocp.control("u", lower=0.0, upper=thrust)
    ocp.dynamics(h, v)
    ocp.dynamics(v, u - gravity)
    ocp.minimize(running=u)
    return ocp


def _lander() -> float:
    height, speed, gravity, thrust = LANDER
    up = thrust - gravity
    # at the switch v^2 = 2 up h, and v^2 = speed^2 + 2 gravity (height - h)
    h = (speed**2 + 2 * gravity * height) / (2 * (up + gravity))
    return float(thrust * np.sqrt(2 * up * h) / up)


def fuel() -> co.Problem:
    """Least fuel in a given time."""
    ocp, _, v = _masses(FUEL_TIME, "fuel")
    a, b = ocp.control("a", lower=0.0, upper=1.0), ocp.control("b", lower=0.0, upper=1.0)
    ocp.dynamics(v, a - b)
    ocp.minimize(running=a + b)
    return ocp


def _fuel() -> float:
    return float(FUEL_TIME - np.sqrt(FUEL_TIME**2 - 4.0))


def speed() -> co.Problem:
    """Least time below a speed."""
    ocp, _, v = _masses(co.Free(guess=3.0), "speed", upper=FASTEST)
    ocp.dynamics(v, ocp.control("u", lower=-1.0, upper=1.0))
    ocp.minimize(terminal=ocp.duration)
    return ocp


def bryson_denham() -> co.Problem:
    """Least energy below a wall."""
    ocp = co.Problem(duration=1.0, name="bryson_denham")
    x = ocp.state("x", initial=0.0, final=0.0, upper=WALL)
    v, u = ocp.state("v", initial=1.0, final=-1.0), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=0.5 * u**2)
    return ocp


PLAIN = {
    "layers": Plain(state=layers, optimum=_layers()),
    "hypersensitive": Plain(state=hypersensitive, optimum=_hypersensitive()),
    "saturated": Plain(state=saturated, optimum=_saturated()),
    "fastest": Plain(state=fastest, optimum=2.0),
    "drag": Plain(state=drag, optimum=_drag()),
    "swing": Plain(state=swing, optimum=_swing()),
    "lander": Plain(state=lander, optimum=_lander()),
    "fuel": Plain(state=fuel, optimum=_fuel()),
    "speed": Plain(state=speed, optimum=1.0 / FASTEST + FASTEST),
    "bryson_denham": Plain(state=bryson_denham, optimum=4.0 / (9.0 * WALL)),
}
