"""Times at which a model changes since it compares the time: `if_else(time < t_k, ...)`, `floor`, `fmod`, |t - t_k|."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import trial_values
from covocp.base.matrices import SAME, Array, distinct
from covocp.base.pieces import has_pieces, sides_of

# Equal parts of the time at whose ends it is looked which pieces hold. What is linear in the time is known exactly,
# however short the pieces are.
PARTS = 4096
# Functions and parameters whose times are remembered.
KEPT = 64
# Share of the time by which what lies on either side of a place is looked at, and how many times what its slope allows
# a value may change in between. Share of the largest slope by which a slope jumps.
BESIDE, FEW, BENT = 1e-9, 10.0, 1e-6
# Difference of values, relative to them, that is none.
ROUNDING = 1e-14
# Halvings after which the time of a change is known to rounding.
HALVINGS = 50


def switch_times(function: ca.Function, duration: float, parameters: Array) -> tuple[tuple[float, ...], ...]:
    """When a function jumps or bends by comparisons of time and parameters, as fractions of a fixed terminal time.

    Args:
        function: of arguments with the names of a statement's; one that calls others tells nothing.
        duration: T [s].
        parameters: their values.

    Returns:
        Instants inside (0, 1), rising: a tuple for each comparison by which it jumps, and one of all where it bends.
    """
    sides = _sides(function)
    if sides is None:
        return ()
    known = sorted({column for k in (0, 1) for column in sides.jac_sparsity(k, 2).get_triplet()[1]})
    values = trial_values(parameters.size)
    values[known] = parameters[known]
    return _times(function, duration, tuple(values.tolist()))


@lru_cache(maxsize=KEPT)
def _sides(function: ca.Function) -> ca.Function | None:
    """Which comparisons depend on the time and what is known beside it: (time, duration, parameters) -> ends, sides."""
    known = [function.index_in(name) for name in ("time", "duration", "parameters")]
    return sides_of(function, known, known[0])


@lru_cache(maxsize=KEPT)
def _times(function: ca.Function, duration: float, parameters: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    """What `switch_times` returns, by the parameters that are compared; the others stand for any."""
    sides, values = _sides(function), np.array(parameters)
    assert sides is not None
    zeros = _zeros(sides, duration, values)
    bent = np.flatnonzero(np.isnan(zeros))
    rows = [*([place] for place in zeros.tolist()), *_changes(sides, bent.tolist(), duration, values)]
    inside = [distinct([place for place in row if SAME < place < 1.0 - SAME]) for row in rows]
    inside = [row[np.diff(row, prepend=0.0) > SAME] for row in inside]
    places = distinct([], *inside)
    if not places.size:
        return ()
    jumps, bends = (places[chosen] for chosen in _sharp(function, places, duration, values))
    jumping = {tuple(row[np.isin(row, jumps)].tolist()) for row in inside}
    return tuple(sorted(own for own in (*jumping, tuple(bends.tolist())) if own))


def _sharp(function: ca.Function, places: Array, duration: float, parameters: Array) -> tuple[Any, Any]:
    """At which places a function jumps, and at which its slope by the time does; pieces of a spline do neither.

    Its other arguments are numbers that no model knows; where it has no value there, it counts as one that jumps.
    """
    arguments = function.sx_in()
    time = arguments[function.index_in("time")]
    value = ca.veccat(*function(*arguments)) if function.n_out() > 1 else ca.vec(function(*arguments))
    both = ca.Function("both", arguments, [ca.densify(value), ca.densify(ca.jacobian(value, time))])
    sides = []
    for side in (-BESIDE, BESIDE):
        given = [np.tile(trial_values(symbol.numel())[:, None], (1, places.size)) for symbol in arguments]
        given[function.index_in("time")] = duration * (places + side)[None]
        given[function.index_in("duration")] = np.full((1, places.size), duration)
        given[function.index_in("parameters")] = np.tile(parameters[:, None], (1, places.size))
        sides.append([np.asarray(v.full()) for v in both.map(places.size)(*given)])
    (before, slope), (after, later) = sides
    steepest = np.abs([slope, later]).max(axis=0)
    smooth = FEW * BESIDE * duration * steepest + ROUNDING * np.abs([before, after]).max(axis=0)
    jumps = ~(np.abs(after - before) <= smooth).all(axis=0)
    bends = (np.abs(later - slope) > BENT * steepest.max(axis=1, initial=0.0)[:, None]).any(axis=0)
    return jumps, bends & ~jumps


def _zeros(sides: ca.Function, duration: float, parameters: Array) -> Array:
    """Where each of what is compared is zero, as a fraction; inf where nowhere, nan where it is no line in the time."""
    time = ca.SX.sym("t")
    ends, held = sides(time, duration, parameters)
    slope = ca.jacobian(ends, time)
    line = ca.Function("line", [time], [ends, ca.densify(slope)])
    values, slopes = (np.asarray(v.full()).ravel() for v in line(0.0))
    places = np.where(slopes == 0, np.inf, -values / np.where(slopes == 0, 1.0, slopes) / duration)
    places[ca.jacobian_sparsity(slope, time).row()] = np.nan
    places[[k for k, side in enumerate(ca.vertsplit(held)) if side.is_op(ca.OP_FLOOR)]] = np.nan
    if has_pieces(line):  # a saw has a constant slope as well
        single = [ca.Function("end", [time], [end]) for end in ca.vertsplit(ends)]
        places[[k for k, end in enumerate(single) if has_pieces(end)]] = np.nan
    return np.asarray(places)


def _changes(sides: ca.Function, rows: list[int], duration: float, parameters: Array) -> list[list[float]]:
    """Fractions at which some of the sides change between neighbouring points, by bisection; a list for each."""

    def held(places: Array) -> Array:
        count = places.size
        fixed = (np.full((1, count), duration), np.tile(parameters[:, None], (1, count)))
        return np.asarray(chosen.map(count)(duration * places[None], *fixed).full())

    if not rows:
        return []
    arguments = sides.sx_in()
    chosen = ca.Function("chosen", arguments, [sides(*arguments)[1][rows]])
    places = np.linspace(0.0, 1.0, PARTS + 1)
    values = held(places)
    numbers = np.isfinite(values[:, 1:]) & np.isfinite(values[:, :-1])
    which, parts = np.nonzero(numbers & (values[:, 1:] != values[:, :-1]))
    low, high, before = places[parts], places[parts + 1], values[which, parts]
    for _ in range(HALVINGS if which.size else 0):
        middle = 0.5 * (low + high)
        same = held(middle)[which, np.arange(which.size)] == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return [high[which == i].tolist() for i in range(len(rows))]
