"""One accurate run of a loop by LSODA, and why it ends before its time where it does.

Where a trial step leaves the domain of a function of the loop (a root, a logarithm) LSODA goes on with NaN for ever: it
begins again from the last state that is one with shorter steps, until these tell that the run itself leaves the domain.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

Array = NDArray[np.float64]

# Error of a step without noise, relative and, for entries near zero, absolute.
TOLERANCE = 1e-9
# After so many steps in a row that do not move the time, it is moved by its rounding: a jump of the law lies there, or
# a finite escape. So often at most, which a law that always jumps would go on for ever.
STALLED, MOVED = 100, 100
# A rate that changes by this share over the rounding of the time cannot be followed; it belongs to a finite escape
# where the state grows by this share over it.
TURNED, ESCAPING = 0.5, 1e-3
# Every so many steps it is looked whether more than so many would be needed to the end: half an hour and more. It is
# chattering where the rate then jumps by `TURNED` so often in as many steps; what only oscillates fast goes on.
WATCHED, ENDLESS, JUMPS = 2000, 2e7, 5
# Share by which steps are shortened where one has left the domain, and of the time below which none is tried; after
# so many that stay inside they are longer again.
SHORTER, SHORTEST, AGAIN = 0.25, 1e-13, 10


@dataclass(frozen=True, kw_only=True)
class Piece:
    """States at the first times of a grid, (K, total), and why there are no more.

    time: where the run ended [s]; state: there. ended: "" where it did not, or because it left the range of numbers;
    "stalled" where no step is small enough, "chatters" where a jump is crossed back and forth, "undefined" where the
    rate is NaN or inf beyond. around: two (time, state) between which the rate jumps, or the first without a rate.
    """

    states: Array
    time: float
    state: Array
    ended: str = ""
    around: tuple[tuple[float, Array], ...] = ()

    __repr__ = short_repr


class _Watch:
    """What the steps of a run do: whether they go on for ever, and where the rate had no value."""

    def __init__(self, slope: Callable[[float, Array], Array], goes_on: Callable[[Array], bool]) -> None:
        """Nothing was seen yet."""
        self.rate, self.goes_on = slope, goes_on
        self.undefined: tuple[float, Array] | None = None
        self.count, self.since, self.before = 0, 0.0, np.zeros(0)
        self.jumps: list[tuple[tuple[float, Array], ...]] | None = None
        self.at: tuple[float, Array] | None = None

    def slope(self, t: float, state: Array) -> Array:
        """The rate, where it has no value at a state that is a number noted."""
        value = self.rate(t, state)
        if not np.isfinite(value).all() and self.goes_on(state):
            self.undefined = (t, state.copy())
        return value

    def tried(self, t: float) -> float:
        """How far a step from a time on went that found no rate [s]."""
        return 0.0 if self.undefined is None else max(self.undefined[0] - t, 0.0)

    def chattering(self, t: float, state: Array, end: float) -> tuple[tuple[float, Array], ...]:
        """After a step: the states around a jump that is crossed for ever, else ()."""
        self.count += 1
        if self.jumps is not None:
            rate, now = self.rate(t, state), (t, state.copy())
            if self.at is not None and np.abs(rate - self.before).max() > TURNED * np.abs(rate).max(initial=0.0):
                self.jumps.append((self.at, now))
            self.at, self.before = now, rate
            if len(self.jumps) >= JUMPS and self.count >= WATCHED:
                return self.jumps[-1]
        if self.count >= WATCHED:
            endless = (end - t) * WATCHED > ENDLESS * (t - self.since)
            self.jumps = [] if endless else None
            self.count, self.since, self.at = 0, t, None
        return ()


def integrated(
    slope: Callable[[float, Array], Array], begin: float, state: Array, grid: Array, goes_on: Callable[[Array], bool]
) -> Piece:
    """States at the times of a grid by LSODA; fewer where the run ends before.

    Args:
        slope: (t, state) -> rate.
        begin: time of the start [s].
        state: there, (total,).
        grid: times, (K,).
        goes_on: whether a state is in the range of numbers.
    """
    found: list[Array] = []
    end, watch = float(grid[-1]), _Watch(slope, goes_on)
    watch.since = begin
    solver, moved, ended = _solver(watch, begin, state, end), 0, ""
    around: tuple[tuple[float, Array], ...] = ()
    good, inside, stalled, longest = (begin, state), 0, 0, np.inf
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "lsoda", UserWarning)  # told by what is returned
        while solver.status == "running":
            message = solver.step()
            if not np.isfinite(solver.y).all() or (message is not None and watch.undefined is not None):
                longest = SHORTER * min(longest, watch.tried(good[0]))
                if watch.undefined is None or longest <= SHORTEST * max(abs(good[0]), end - begin):
                    ended, around = ("undefined", (watch.undefined,)) if watch.undefined else ("", ())
                    break
                watch.undefined, inside, stalled = None, 0, 0
                solver = _solver(watch, *good, end, longest)
                continue
            if message is not None:
                ended = "stalled"
                break
            due = grid[len(found) :]
            due = due[due <= solver.t]
            found += takewhile(goes_on, list(solver.dense_output()(due).T) if due.size else [])
            if not goes_on(solver.y):
                break
            good, inside, watch.undefined = (float(solver.t), solver.y.copy()), inside + 1, None
            if around := watch.chattering(*good, end):
                ended = "chatters"
                break
            stalled = stalled + 1 if solver.t == solver.t_old else 0
            if stalled == STALLED:
                after, start, ended = _beyond(slope, solver.t, solver.y, end)
                if ended or start is None:
                    break
                solver, moved, stalled = _solver(watch, after, start, end), moved + 1, 0
                if moved == MOVED:
                    ended = "stalled"
                    break
            elif np.isfinite(longest) and inside == AGAIN and solver.status == "running":
                longest, inside = longest / SHORTER, 0
                solver = _solver(watch, *good, end, longest)
    states = np.array(found).reshape(-1, state.size)
    return Piece(states=states, time=good[0], state=good[1], ended=ended, around=around)


def _solver(watch: _Watch, t: float, state: Array, end: float, longest: float = np.inf) -> Any:
    """LSODA from a state on, with steps of some length at most."""
    from scipy.integrate import LSODA

    first = None if np.isinf(longest) else min(longest, end - t)
    return LSODA(watch.slope, t, state, end, rtol=TOLERANCE, atol=TOLERANCE, max_step=longest, first_step=first)


def _beyond(
    slope: Callable[[float, Array], Array], t: float, state: Array, end: float
) -> tuple[float, Array | None, str]:
    """Time and state a rounding after a place where no step moves; no state where the run ends, and why."""
    after = float(np.nextafter(t, end))
    rate = slope(after, state)
    start = state + (after - t) * rate
    if np.abs(slope(after, start) - rate).max() <= TURNED * np.abs(rate).max():
        return after, start, ""
    escapes = np.abs(start).max() > (1.0 + ESCAPING) * np.abs(state).max()
    return after, None, "" if escapes else "stalled"
