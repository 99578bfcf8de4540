"""Where the models change with the time within the steps of a simulation faster than these see.

Heun's steps and their halves, and those of the prediction, meet the time at regular places: an oscillation with whole
periods in each of them is a constant to all. Here the models are looked at in irregular places as well, and the steps
are divided until none of them holds more than half a period.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.errors import warn_user
from covocp.base.matrices import Array, unpack
from covocp.base.short_repr import short_repr
from covocp.extremal.dense_output import mapped
from covocp.simulation.actual import System
from covocp.simulation.schedule import WHOLE, Grid, nominal_at
from covocp.solution.solution import Solution

# Places in a step that no period has in common, fractions of square roots of primes: from one of them to the next what
# has up to 3000 periods in a step turns at least twice, but for a few numbers and phases.
PLACES = np.sort(np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0, 23.0, 29.0, 31.0, 37.0]) % 1.0)
# Turns from which on a step is said to be passed too fast: a kink of a table is one, a jump none, and halves see these.
# Less than the second share of what changes in the step, of the third in any step, and roundoff are no turns.
TURNS, TURN, COUNTS, ROUNDOFF = 2, 0.02, 1e-3, 1e-9
# Share of the sampling error of a mean, and of a variance, that an oscillation may do at most to be left as it is.
SHARE = 0.2
# Turns are looked for in so many steps on end: one that holds more than half a period then has two of them for certain.
WINDOW = 2.0
# By how much the steps that just see everything are divided once more.
MARGIN = 2
# Steps of a run that an oscillation may ask for, at most: 300 runs take some ten seconds.
MOST_STEPS = 20_000
# Share of its magnitude by which a state that is known exactly may be off by the steps (`verdict`), and of the largest
# rate below which that of such a state is rounding.
EXACT, ROUNDING = 1e-4, 1e-12
# Numbers that are held at a time while looking.
HELD_NUMBERS = 4_000_000

# (times within the steps of a grid, (steps, places), where from the start to the end of the step, the same shape,
# which steps of the base) -> (steps, places, rows)
_Values = Callable[[Array, Array, Any], Array]


def seeing(solution: Solution, design: System, actual: System, base: Grid, runs: int) -> Grid:
    """A grid with the longest steps that see how design and actual system change with the time along the nominal.

    What is so small that it does less than `SHARE` of the sampling error at its worst is not looked at. Where the steps
    would be too many they stay too long, and a warning says what that may do.

    Args:
        solution: whose nominal is flown.
        design: what its filter and feedback assume.
        actual: what is simulated.
        base: intervals that the steps divide.
        runs: number of runs, for the sampling error.
    """
    known = _deviations(solution, design)
    values, least = _rows(solution, design, actual, base, known, runs)
    most = max(1, MOST_STEPS // base.steps)
    parts = np.ones(base.steps, dtype=int)
    blind = base.h > WHOLE * solution.duration
    while blind.any() and int(parts.max()) <= most:
        blind = _blind(values, least, base, parts, blind)
        parts[blind] *= 2
    found = parts > 1
    parts = np.where(found, np.minimum(parts * MARGIN, most), 1)
    seen = np.where(found, base.h / parts, np.inf)
    if blind.any():
        _tell(values, base, base.h[blind].max() / most, blind, (design, actual, known))
    around = np.pad(seen, 1, constant_values=np.inf)  # what one step misses by chance its neighbours see
    return replace(base, seen=np.min([around[:-2], around[1:-1], around[2:]], axis=0))


def _blind(values: _Values, least: Array, base: Grid, parts: Any, among: Any) -> Any:
    """Which steps of the base, of some, have parts that do not see the models, (N,)."""
    result, size = np.zeros(base.steps, dtype=bool), PLACES.size * max(1, least.size)
    chosen = np.flatnonzero(among)
    for some in np.array_split(chosen, 1 + int(parts[chosen].sum()) * size // HELD_NUMBERS):
        if not some.size:
            continue
        count, first = parts[some], np.cumsum(parts[some]) - parts[some]
        step = np.repeat(some, count)
        length = base.h[step] / parts[step]
        start = base.t[step] + length * (np.arange(step.size) - np.repeat(first, count))
        window = np.minimum(WINDOW * length, base.t[-1])
        low = np.clip(start + (length - window) / 2, 0.0, base.t[-1] - window)
        times = low[:, None] + window[:, None] * PLACES
        where = np.clip((times - base.t[step, None]) / base.h[step, None], 0.0, 1.0)
        turns = turning(values(times, where, step), least).any(axis=1)
        result[some] = np.logical_or.reduceat(turns, first)
    return result


def turning(values: Array, least: Array | float = 0.0) -> NDArray[np.bool_]:
    """Which rows of a model rise and fall and rise again in which steps, or the reverse, (steps, rows).

    Args:
        values: at the places in each step, (steps, places, rows); a step without a value there turns nothing.
        least: amplitude of each row in a step below which it is no turn, (rows,), beside what is little anyway.
    """
    turned = np.zeros((values.shape[0], values.shape[2]), dtype=bool)
    with np.errstate(over="ignore", invalid="ignore"):
        known = np.isfinite(values).all(axis=(1, 2))  # a model without a value there: the steps tell
        values = values[known]
        if not values.size:
            return turned
        change = np.ptp(values, axis=1)
        little = np.maximum(COUNTS * change.max(axis=0), ROUNDOFF * np.abs(values).max(axis=(0, 1)))
        steps = np.diff(values, axis=1)
        moves = np.sign(np.where(np.abs(steps) > TURN * change[:, None], steps, 0.0))
    turns, last = np.zeros(change.shape), np.zeros(change.shape)
    for move in moves.swapaxes(0, 1):
        turns += move * last < 0
        last = np.where(move != 0, move, last)
    turned[known] = (turns >= TURNS) & (change > np.maximum(little, 2.0 * np.asarray(least)))
    return turned


def _rows(
    solution: Solution, design: System, actual: System, base: Grid, known: _Deviations, runs: int
) -> tuple[_Values, Array]:
    """The models along the chords of the nominal in each step, and how much each row of them may oscillate."""
    starts, ends = (nominal_at(solution, t, base.interval) for t in (base.t[:-1], base.t[1:]))
    function = _models(design, actual)

    def values(times: Array, where: Array, step: Any) -> Array:
        rows, share = np.repeat(step, times.shape[1]), where.reshape(-1, 1)
        x, u, e = (
            ((1 - share) * one[rows] + share * two[rows]).T
            for one, two in zip((starts.x, starts.u, starts.e), (ends.x, ends.u, ends.e), strict=True)
        )
        fixed = [np.tile(np.ravel(v)[:, None], (1, rows.size)) for v in (solution.duration, solution.parameters)]
        own = np.tile(actual.parameters[:, None], (1, rows.size))
        return mapped(function, x, u, e, times.reshape(1, -1), *fixed, own)[0].T.reshape(*times.shape, -1)

    found = values(
        base.t[:-1, None] + base.h[:, None] * PLACES, np.tile(PLACES, (base.steps, 1)), np.arange(base.steps)
    )
    largest = np.abs(np.nan_to_num(found)).max(axis=(0, 1))
    least, width = [], _width(design)
    for first in range(0, 2 * width if actual is not design else width, width):
        least.append(_allowed(design, largest[first : first + width], known, solution.duration, runs))
    share = SHARE * np.sqrt(2.0 / runs) * abs(solution.cost) / solution.duration
    for scale in [np.ones(1), np.outer(known.most, known.most).ravel()] if design.statement.loop is not None else []:
        with np.errstate(divide="ignore"):
            least.append(share / scale)
    return values, np.concatenate(least)


def _width(system: System) -> int:
    """Rows of `_models` for a system."""
    n, r = system.size, system.measured
    return n + 3 * n * n + r + 2 * r * n + r * r


def _allowed(design: System, largest: Array, known: _Deviations, duration: float, runs: int) -> Array:
    """What oscillations in the rows of a system may be, by what they do to means and variances at most."""
    n, r = design.size, design.measured
    mean, square = SHARE / np.sqrt(runs), SHARE * np.sqrt(2.0 / runs)
    ends = np.cumsum([n, 3 * n * n, r, 2 * r * n, r * r])
    seen = largest[ends[2] : ends[2] + r * n].reshape(n, r).T
    told = (seen * known.least).max(axis=1, initial=0.0)
    noise = np.sqrt(np.diagonal(largest[ends[3] :].reshape(r, r)))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = square * known.least[:, None] / known.most / duration
        rows = square * told[:, None] / known.most
    slopes[known.least == 0.0], rows[:, known.most == 0.0] = np.inf, np.inf  # nothing deviates
    densities = square * np.outer(known.least, known.least) / duration
    rate = np.where(known.least > 0.0, mean * known.least, known.exact) / duration
    rate = np.maximum(rate, ROUNDING * largest[:n].max(initial=0.0) * (known.least == 0.0))
    blocks = [rate, slopes, slopes, densities, mean * told, rows, rows, square * np.outer(noise, noise)]
    return np.concatenate([block.ravel(order="F") for block in blocks])


def _models(design: System, actual: System) -> ca.Function:
    """(x, u, e, t, T, p, parameters of the truth) -> all that the steps use, stacked.

    Of each system rate, F, G C, Q, h, M, Hu C and U (`System.linear`), then of the cost L and its second derivative by
    deviations under the feedback, A - N C - C'N' + C'B C.
    """
    st, other = design.statement, actual.statement
    symbolic: Any = ca.SX if st.symbolic is ca.SX and other.symbolic is ca.SX else ca.MX
    sizes = (st.nx, st.nu, st.ne, 1, 1, st.np, other.np)
    x, u, e, t, T, p, q = a = [symbolic.sym(f"a{i}", k) for i, k in enumerate(sizes)]
    C = symbolic(0, design.size) if st.loop is None else st.loop.gain(x, u, e, t, T, p)
    at = [design.model(x, u, t, T, p)]
    if actual is not design:
        at.append(actual.model(x[: other.nx], u[: other.nu], t, T, q))
    parts = [v for s in at for v in (s.rate, s.F, s.G @ C, s.Q, s.h, s.M, s.Hu @ C, s.U)]
    if st.loop is not None:
        slopes = st.loop.slopes(x, u, t, T, p)
        crossed = slopes.N @ C
        parts += [st.loop.running(x, u, t, T, p), slopes.A - crossed - crossed.T + C.T @ slopes.B @ C]
    return ca.Function("models", a, [ca.veccat(*map(ca.densify, parts))])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Deviations:
    """Least (of those that are not zero) and largest standard deviation of each row of the augmented state, (n,).

    exact: by how much a state that is known exactly may be off.
    """

    least: Array
    most: Array
    exact: Array

    __repr__ = short_repr


def _deviations(solution: Solution, design: System) -> _Deviations:
    """Those that the solution promises."""
    squares = np.diagonal(unpack(solution.trajectory.e[:, design.covariance], design.size), axis1=1, axis2=2)
    if solution.loop is not None:
        squares = np.diagonal(solution.loop.X, axis1=1, axis2=2)
    squares = np.where(np.isfinite(squares), squares, 0.0).clip(0.0)
    least = np.where(squares > 0.0, squares, np.inf).min(axis=0)
    exact = np.ones(design.size)
    if design.geometry.plain:
        exact[: design.states] = np.abs(solution.trajectory.x[:, : design.states]).max(axis=0, initial=0.0)
    return _Deviations(
        least=np.sqrt(np.where(np.isfinite(least), least, 0.0)), most=np.sqrt(squares.max(axis=0)), exact=EXACT * exact
    )


def _tell(values: _Values, base: Grid, step: float, blind: Any, of: tuple[System, System, _Deviations]) -> None:
    """Warn of what so many steps as there may be do not see, and by how much it may move a state at most."""
    design, actual, known = of
    chosen = np.flatnonzero(blind)
    places = base.t[chosen, None] + base.h[chosen, None] * PLACES
    found = np.ptp(values(places, np.zeros(places.shape), chosen), axis=1) / 2
    first, least = 0 if actual is design else _width(design), known.least[: design.states]
    moved = (found[:, first : first + design.states] * base.h[chosen, None]).sum(axis=0)
    worst = int(np.argmax(moved / np.where(least > 0.0, least, np.inf)))
    name = design.statement.augmented[worst]
    may = (
        f"where they meet it at one place of its period '{name}' is off by up to {moved[worst]:.2g}, and the "
        f"prediction as much (its smallest standard deviation is {least[worst]:.2g})"
        if moved[worst] > 0
        else "slopes, densities or the cost, and what is predicted of them, are those of one place of its period"
    )
    warn_user(
        f"The model changes with the time faster than the steps of this simulation see, of {step:.2g} s "
        f"({MOST_STEPS} in all, from t = {base.t[chosen[0]]:.4g} s on): {may}. Put the mean of what oscillates so fast "
        "in its place, or give step=, shorter than a quarter of its period."
    )
