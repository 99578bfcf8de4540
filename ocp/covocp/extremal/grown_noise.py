"""What the deviations add to noise that varies with state and control, and that to the cost: left out of the cost.

The expected cost takes the densities of the noise along the nominal [Schmidt 6.2]. To second order their means are

    < Q > = Q + tr(Q_zz Z)/2,    < U > = U + tr(U_zz Z)/2,    Z = < dz dz' >,  z = (augmented state, control),

entry by entry, du = -C dx', and so is that of the variance of what is read at an instant. What they add to the
covariance of (d, y), the deviation and its estimate, adds to Z again:

    D' = A D + D A' + diag(tr(Q_zz (Z + dZ)), K tr(U_zz (Z + dZ)) K')/2,    left out: int tr(W D)/2 dt + tr(S D)/2.

For a linear system whose densities are quadratic this is exact, but for its integration along the nodes by the
trapezoidal rule, whose error falls with the square of their number; that D is in its own rate is met by repeating this.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array, stacked, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.extremal.around import Around, bend, seen_by, side, spread_of
from covocp.extremal.closed_loop import ClosedLoop
from covocp.extremal.extremal import Extremal
from covocp.extremal.joint import filter_of, loop_of
from covocp.extremal.readings import readings_along
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT

# Repetitions, which converge as those of an integral equation do, and the relative change that ends them.
SWEEPS, SETTLED = 60, 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Grown:
    """What noise that grows with the deviations adds.

    cost: to the expected cost. end: to the covariance of the deviation and its estimate at the end, (2n, 2n).
    """

    cost: float
    end: Array

    __repr__ = short_repr


def grown_noise(extremal: Extremal, loop: ClosedLoop, start: Array | None = None) -> Grown:
    """What noise that varies with state and control adds along a solution, beyond what it is along the nominal.

    Args:
        extremal: of a statement with a loop.
        loop: its covariances.
        start: what phases before have added at the start, (2n, 2n); None: nothing.

    Returns:
        It; infinite where the covariances grow beyond numbers. Costs that are not linear in the covariance of the loop
        do not count.
    """
    st, size = extremal.statement, 2 * len(extremal.statement.augmented)
    first = np.zeros((size, size)) if start is None else start
    if not first.any() and not _varies(st):
        return Grown(cost=0.0, end=first)
    sides, h = [side(extremal, end) for end in (0, 1)], np.diff(extremal.time)
    count, spread = h.size, spread_of(loop)
    drifts, weights = zip(*((stacked(v, count) for v in _moving(st).map(count)(*own)) for own in sides), strict=True)
    moved = np.eye(size) + h[:, None, None] / 2 * np.array(drifts) * np.array([1.0, -1.0])[:, None, None, None]
    steps = np.linalg.solve(moved[1], moved[0])
    grown = np.zeros_like(spread)
    for _ in range(SWEEPS):
        before, whole = grown, spread + grown
        driven = [_driven(st, columns, whole[end : count + end]) for end, columns in enumerate(sides)]
        grown = _passed(first, steps, h, driven, _jumps(extremal, whole))
        if not np.isfinite(grown).all():
            return Grown(cost=np.inf, end=np.full((size, size), np.inf))
        if np.abs(grown - before).max(initial=0.0) <= SETTLED * np.abs(grown).max(initial=0.0):
            break
    parts = [(weight * grown[end : count + end]).sum(axis=(1, 2)) for end, weight in enumerate(weights)]
    t = extremal.trajectory
    S = np.asarray(loop_of(st).terminal(t.x[-1], t.duration, extremal.parameters)[1].full())
    at_end = float(np.sum(S * grown[-1, : size // 2, : size // 2]))
    return Grown(cost=0.5 * (float(h @ (parts[0] + parts[1])) / 2 + at_end), end=grown[-1])


def _passed(first: Array, steps: Array, h: Array, driven: list[Array], jumps: dict[int, tuple[Array, Array]]) -> Array:
    """A covariance from the start through all intervals, (N + 1, 2n, 2n), by trapezoidal steps and jumps."""
    grown = np.array([first] * (h.size + 1))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(h.size):
            if k in jumps:
                across, noise = jumps[k]
                grown[k + 1] = across @ grown[k] @ across.T + noise
            else:
                begun = grown[k] + h[k] / 2 * driven[0][k]
                grown[k + 1] = steps[k] @ begun @ steps[k].T + h[k] / 2 * driven[1][k]
    return grown


def _jumps(extremal: Extremal, spread: Array) -> dict[int, tuple[Array, Array]]:
    """Transition of (d, y) where something is read, and the noise that a spread of them adds there, by interval."""
    columns, result = side(extremal, 0), {}
    for entry in readings_along(extremal):
        k, n = entry.interval, entry.gain.shape[0]
        fed, zero = entry.gain @ entry.H, np.zeros((n, n))
        bent = np.asarray(_read(extremal.statement)(*(column[:, k] for column in columns), spread[k]).full())
        own = entry.gain @ bent[np.ix_(entry.rows, entry.rows)] @ entry.gain.T
        across = np.block([[np.eye(n), zero], [fed, np.eye(n) - fed]])
        result[k] = across, np.block([[zero, zero], [zero, own]])
    return result


def _driven(statement: Statement, columns: list[Array], spread: Array) -> Array:
    """The noise of (d, y) that a spread of them adds, at one end of all intervals, (N, 2n, 2n)."""
    count, size, _ = spread.shape
    values = _added(statement).map(count)(*columns, spread.transpose(1, 0, 2).reshape(size, -1))
    return stacked(values, count)


@lru_cache(maxsize=KEPT)
def _varies(statement: Statement) -> bool:
    """Whether densities, or variances of what is read, are not linear in state, unknowns and control."""
    around = _around(statement)
    values = ca.veccat(*_densities(statement, around), *_variance(statement, around))
    return any(ca.which_depends(values, around.z, 2, False))


def _around(statement: Statement) -> Around:
    return Around.of(statement, int(loop_of(statement).gain.size1_out(0)))


def _densities(statement: Statement, around: Around) -> list[Any]:
    """Q, and U where something is measured."""
    measured = [] if statement.measurement is None else [statement.measurement(*around.at)[2]]
    return [loop_of(statement).slopes(*around.at).Q, *measured]


def _variance(statement: Statement, around: Around) -> list[Any]:
    """R of what can be read at instants, where something can."""
    return [] if statement.samples is None else [statement.samples.measurement(*around.at)[2]]


def _bent(value: Expr, around: Around, gain: Expr, spread: Expr) -> Any:
    """tr(v_zz Z)/2 of each entry of a matrix, Z by the spread of (d, y)."""
    seen = seen_by(gain, type(value))
    return ca.reshape(bend(ca.vec(ca.densify(value)), around.z, seen @ spread @ seen.T) / 2, *value.shape)


@lru_cache(maxsize=KEPT)
def _moving(statement: Statement) -> ca.Function:
    """(all six) -> drift of (d, y), weight of their covariance in the cost; (2n, 2n) each."""
    six, loop = _around(statement).six, loop_of(statement)
    plain = (*six[:2], *six[3:])
    slopes, C = loop.slopes(*plain), loop.gain(*six)
    K, M = _filter(statement, six)
    drift = ca.blockcat([[slopes.F, -slopes.G @ C], [K @ M, slopes.F - slopes.G @ C - K @ M]])
    crossed = -slopes.N @ C
    weight = ca.blockcat([[slopes.A, crossed], [crossed.T, C.T @ slopes.B @ C]])
    return ca.Function("moving", six, [ca.densify(drift), ca.densify(weight)])


def _filter(statement: Statement, six: list[Any]) -> tuple[Any, Any]:
    """Gain K of the design and M."""
    E = unpack_symbolic(six[2][statement.estimation.span], len(statement.augmented))
    return filter_of(statement, six[0], six[1], E, tuple(six[3:]))


@lru_cache(maxsize=KEPT)
def _added(statement: Statement) -> ca.Function:
    """(all six, < (d, y)(d, y)' > (2n, 2n)) -> the noise of (d, y) that it adds."""
    symbolic: Any = statement.symbolic
    around, n = _around(statement), len(statement.augmented)
    spread, C = symbolic.sym("spread", 2 * n, 2 * n), loop_of(statement).gain(*around.six)
    bent = [_bent(value, around, C, spread) for value in _densities(statement, around)]
    K, _ = _filter(statement, around.six)
    fed = K @ bent[1] @ K.T if len(bent) > 1 else symbolic.zeros(n, n)
    added = ca.blockcat([[bent[0], symbolic.zeros(n, n)], [symbolic.zeros(n, n), fed]])
    inner = ca.Function("added", [around.z, *around.six, spread], [ca.densify(added)])
    return ca.Function("added", [*around.six, spread], [inner(around.value, *around.six, spread)])


@lru_cache(maxsize=KEPT)
def _read(statement: Statement) -> ca.Function:
    """(all six, < (d, y)(d, y)' > (2n, 2n)) -> what it adds to the variance of all that can be read at instants."""
    symbolic: Any = statement.symbolic
    around, n = _around(statement), len(statement.augmented)
    spread, C = symbolic.sym("spread", 2 * n, 2 * n), loop_of(statement).gain(*around.six)
    (value,) = _variance(statement, around)
    bent = ca.densify(_bent(value, around, C, spread))
    inner = ca.Function("read", [around.z, *around.six, spread], [bent])
    return ca.Function("read", [*around.six, spread], [inner(around.value, *around.six, spread)])
