"""Ten plain problems without covariances, as data for any tool, with optima that no solver computed.

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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

LAYER, STRONGEST, FUEL_TIME, FASTEST, WALL = 0.01, 5.0, 2.5, 0.6, 1 / 9
HEIGHT, SPEED, GRAVITY, THRUST = 10.0, -2.0, 1.5, 3.0
FREE = None


def _nothing(x: Any, u: Any) -> Any:
    return 0.0


@dataclass(frozen=True, kw_only=True)
class Plain:
    """A problem; x and u are sequences of scalars.

    duration: FREE where the time is what is minimised, or free beside a running cost; guess: of it.
    highest: upper bounds of states.
    """

    rates: Callable[[Any, Any], Sequence[Any]]
    running: Callable[[Any, Any], Any] = _nothing
    initial: tuple[float, ...] = (0.0, 0.0)
    final: tuple[float, ...] = (1.0, 0.0)
    lower: tuple[float, ...] = (-np.inf,)
    upper: tuple[float, ...] = (np.inf,)
    highest: tuple[float, ...] = (np.inf, np.inf)
    duration: float | None = FREE
    guess: float = 3.0
    optimum: float

    @property
    def fastest(self) -> bool:
        """Whether the time is minimised."""
        return self.duration is FREE and self.running is _nothing


def _hypersensitive() -> float:
    def root(x: float) -> float:
        return float(np.sqrt(x**6 + x**2))

    first = quad(lambda x: -(x**3) + root(x), 0.0, 1.0, epsabs=1e-13, epsrel=1e-13)[0]
    return float(first + quad(lambda x: x**3 + root(x), 0.0, 1.5, epsabs=1e-13, epsrel=1e-13)[0])


def _saturated() -> float:
    # u = a up to t1, then a line through zero at 1/2: distance = a/4 - a (1/2 - t1)^2/3
    rest = float(np.sqrt(3.0 * (0.25 - 1.0 / STRONGEST)))
    return STRONGEST**2 * (0.5 - rest + rest / 3.0)


def _drag() -> float:
    # forward v = tanh t over ln cosh t, braking v = tan(s) over -ln cos s, the same v at the switch
    def way(v: float) -> float:
        return float(-0.5 * np.log(1 - v**2) + 0.5 * np.log(1 + v**2) - 1.0)

    v = float(brentq(way, 0.1, 1 - 1e-12, xtol=1e-15))
    return float(np.arctanh(v) + np.arctan(v))


def _swing() -> float:
    # u = -1: a circle about (-1, 0) through (1, 1), clockwise, to that of radius 1 about (1, 0) with v < 0
    x = 5.0 / 4.0 - 1.0 / 4.0
    v = -float(np.sqrt(1.0 - (x - 1.0) ** 2))
    first = float(np.arctan2(1.0, 2.0) - np.arctan2(v, x + 1.0))
    return first + float((np.arctan2(v, x - 1.0) - np.pi) % (2 * np.pi))


def _lander() -> float:
    # at the switch v^2 = 2 (thrust - g) h, and v^2 = speed^2 + 2 g (height - h)
    up = THRUST - GRAVITY
    h = (SPEED**2 + 2 * GRAVITY * HEIGHT) / (2 * (up + GRAVITY))
    return float(THRUST * np.sqrt(2 * up * h) / up)


UNIT: dict[str, Any] = {"lower": (-1.0,), "upper": (1.0,)}

PLAIN = {
    "layers": Plain(
        rates=lambda x, u: (u[0],),
        running=lambda x, u: 0.5 * (x[0] ** 2 + LAYER**2 * u[0] ** 2),
        initial=(1.0,),
        final=(1.0,),
        highest=(np.inf,),
        duration=1.0,
        optimum=float(LAYER * (1.0 / np.tanh(1.0 / LAYER) - 1.0 / np.sinh(1.0 / LAYER))),
    ),
    "hypersensitive": Plain(
        rates=lambda x, u: (-(x[0] ** 3) + u[0],),
        running=lambda x, u: 0.5 * (x[0] ** 2 + u[0] ** 2),
        initial=(1.0,),
        final=(1.5,),
        highest=(np.inf,),
        duration=1e4,
        optimum=_hypersensitive(),
    ),
    "saturated": Plain(
        rates=lambda x, u: (x[1], u[0]),
        running=lambda x, u: 0.5 * u[0] ** 2,
        lower=(-STRONGEST,),
        upper=(STRONGEST,),
        duration=1.0,
        optimum=_saturated(),
    ),
    "fastest": Plain(rates=lambda x, u: (x[1], u[0]), optimum=2.0, **UNIT),
    "drag": Plain(rates=lambda x, u: (x[1], u[0] - x[1] ** 2), optimum=_drag(), **UNIT),
    "swing": Plain(
        rates=lambda x, u: (x[1], u[0] - x[0]), initial=(1.0, 1.0), final=(0.0, 0.0), optimum=_swing(), **UNIT
    ),
    "lander": Plain(
        rates=lambda x, u: (x[1], u[0] - GRAVITY),
        running=lambda x, u: u[0],
        initial=(HEIGHT, SPEED),
        final=(0.0, 0.0),
        lower=(0.0,),
        upper=(THRUST,),
        guess=5.0,
        optimum=_lander(),
    ),
    "fuel": Plain(
        rates=lambda x, u: (x[1], u[0] - u[1]),
        running=lambda x, u: u[0] + u[1],
        lower=(0.0, 0.0),
        upper=(1.0, 1.0),
        duration=FUEL_TIME,
        optimum=float(FUEL_TIME - np.sqrt(FUEL_TIME**2 - 4.0)),
    ),
    "speed": Plain(rates=lambda x, u: (x[1], u[0]), highest=(np.inf, FASTEST), optimum=1.0 / FASTEST + FASTEST, **UNIT),
    "bryson_denham": Plain(
        rates=lambda x, u: (x[1], u[0]),
        running=lambda x, u: 0.5 * u[0] ** 2,
        initial=(0.0, 1.0),
        final=(0.0, -1.0),
        highest=(WALL, np.inf),
        duration=1.0,
        optimum=4.0 / (9.0 * WALL),
    ),
}


def stated(name: str) -> Any:
    """A problem as covocp states it."""
    import covocp as co

    own = PLAIN[name]
    ocp = co.Problem(duration=co.Free(guess=own.guess) if own.duration is FREE else own.duration, name=name)
    rows = zip(own.initial, own.final, own.highest, strict=True)
    x = [
        ocp.state(f"x{i}", initial=a, final=b, **({"upper": h} if np.isfinite(h) else {}))
        for i, (a, b, h) in enumerate(rows)
    ]
    limits = [{k: v for k, v in pair if np.isfinite(v)} for pair in _pairs(own)]
    u = [ocp.control(f"u{i}", **limit) for i, limit in enumerate(limits)]
    for state, rate in zip(x, own.rates(x, u), strict=True):
        ocp.dynamics(state, rate)
    ocp.minimize(running=own.running(x, u), terminal=ocp.duration if own.fastest else 0.0)
    return ocp


def _pairs(own: Plain) -> list[tuple[tuple[str, float], ...]]:
    """Bounds of the controls by name."""
    return [(("lower", a), ("upper", b)) for a, b in zip(own.lower, own.upper, strict=True)]
