"""The step of the gradient method: the change of the controls that lowers the cost most for its size, within bounds.

G. T. Schmidt, Sc.D. thesis, M.I.T. 1971, [4.3] (steps 4 to 6) and appendix D, corrected. The step d minimises

    r' d + d' B d / 2   subject to   G d = c,   lower <= d <= upper,

r the slopes of the cost, G those of the terminal conditions, and d' B d = int du' W du dt + b dT^2 + ... the size of
the step. Without bounds that is

    l = -I_kk^-1 (c + I_kj),   d = -B^-1 (r + G' l),   I_kk = G B^-1 G',   I_kj = G B^-1 r,   I_jj = r' B^-1 r.

With bounds the step is projected onto them in the same metric, by the primal-dual active-set method (M. Hintermueller,
K. Ito, K. Kunisch, SIAM J. Optimization 13, 2003); the multipliers of the bounds come with it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.solvers.gradient.memory import Metric
from covocp.transcription.mesh import Mesh

ACTIVE_SET_PASSES = 30
# Share of the largest eigenvalue of I_kk (rows scaled to ones on the diagonal) below which a combination of the
# terminal conditions counts as one that the step cannot change.
RANK = 1e-12


@dataclass(frozen=True, kw_only=True)
class Step:
    """A step: the change, the multipliers l of the terminal conditions, which entries end at a bound (-1, 0, 1)."""

    change: Array
    ell: Array
    active: Array
    gram: Array

    __repr__ = short_repr


def control_metric(mesh: Mesh, duration: float, weights: Array) -> Any:
    """Matrix of int du' W du dt over the control values (node by node), W linear between the nodes.

    Args:
        mesh: nodes and form of the control.
        duration: T [s].
        weights: W at the nodes, (N + 1, nu, nu).

    Returns:
        Sparse matrix, (K nu, K nu).
    """
    n, nu = mesh.intervals, weights.shape[1]
    h = (np.diff(mesh.nodes) * duration)[:, None, None]
    left, right = weights[:-1], weights[1:]
    if mesh.control == "constant":
        blocks = [(0, 0, h * (left + right) / 2)]
    else:
        between = h * (left + right) / 12
        blocks = [
            (0, 0, h * (left / 4 + right / 12)),
            (1, 1, h * (left / 12 + right / 4)),
            (0, 1, between),
            (1, 0, between),
        ]
    rows, columns, values = [], [], []
    inner_rows, inner_columns = np.divmod(np.arange(nu * nu), max(nu, 1))
    for i, j, block in blocks:
        rows.append((nu * (np.arange(n) + i)[:, None] + inner_rows).ravel())
        columns.append((nu * (np.arange(n) + j)[:, None] + inner_columns).ravel())
        values.append(block.reshape(-1))
    size = mesh.control_nodes * nu
    idle = (nu * np.array(mesh.idle, dtype=int)[:, None] + np.arange(nu)).ravel()  # nothing moves these
    rows.append(idle)
    columns.append(idle)
    values.append(np.ones(idle.size))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.coo_array(entries, shape=(size, size)).tocsc()


def with_extra(metric: Expr, extra: Array) -> Any:
    """The metric of the controls beside weights of further entries (b of the terminal time, of free initial values)."""
    count = metric.shape[0]
    size = count + extra.size
    coo = metric.tocoo()
    at = np.arange(count, size)
    rows, columns = np.concatenate([coo.row, at]), np.concatenate([coo.col, at])
    return sparse.coo_array((np.concatenate([coo.data, extra]), (rows, columns)), shape=(size, size)).tocsc()


def solve_step(
    metric: Metric, slope: Array, rows: Array, target: Array, lower: Array, upper: Array, active: Array | None = None
) -> Step:
    """Minimise slope' d + d' metric d / 2 subject to rows d = target and bounds.

    Args:
        metric: positive definite, (n, n).
        slope: (n,).
        rows: (q, n).
        target: (q,).
        lower: lower bounds of d, (n,).
        upper: upper bounds of d, (n,).
        active: which bounds to try first; -1 lower, 1 upper.

    Returns:
        The step. Where the active set does not settle, the change is clipped.
    """
    state = np.zeros(slope.size, dtype=int) if active is None else active.astype(int)
    tried: list[tuple[Array, tuple[Array, Array, Array]]] = []  # which entries were active, and the step with these
    places: dict[bytes, int] = {}
    for _ in range(ACTIVE_SET_PASSES):
        found = _equality_step(metric, slope, rows, target, np.where(state < 0, lower, upper), state)
        if found is None:
            return solve_step(metric.plain(), slope, rows, target, lower, upper, active)
        change, ell, gram = found
        pressure = -(slope + metric @ change + rows.T @ ell)
        new = np.where(state == 0, np.where(change > upper, 1, np.where(change < lower, -1, 0)), 0)
        new = np.where((state > 0) & (pressure > 0), 1, np.where((state < 0) & (pressure < 0), -1, new))
        if (new == state).all():
            break
        places[state.tobytes()] = len(tried)
        tried.append((state, found))
        state = new
        begin = places.get(new.tobytes())
        if begin is not None:  # from here on the same sets come in turn: those of the last pass are known
            period, left = len(tried) - begin, ACTIVE_SET_PASSES - begin
            (change, ell, gram), state = tried[begin + (left - 1) % period][1], tried[begin + left % period][0]
            break
    return Step(change=np.clip(change, lower, upper), ell=ell, active=state, gram=gram)


def _equality_step(
    metric: Metric, slope: Array, rows: Array, target: Array, bounds: Array, state: Array
) -> tuple[Array, Array, Array] | None:
    """The step with the active entries at their bounds: change, l, I_kk; None where what the metric has learnt is lost.

    Pairs that hardly differ leave a metric that is not positive definite, by rounding.
    """
    free = np.flatnonzero(state == 0)
    change = np.where(state == 0, 0.0, bounds)
    if not free.size:
        return change, np.zeros(target.size), np.zeros((target.size, target.size))
    held = metric @ change
    right = np.column_stack([-(slope + held)[free], rows[:, free].T])
    solved = metric.inverse(free)(right)
    gram = rows[:, free] @ solved[:, 1:]
    if metric.learns and not (np.isfinite(solved).all() and (np.diag(gram) >= 0.0).all()):
        return None
    ell = solve_gram(gram, rows[:, free] @ solved[:, 0] - (target - rows @ change))
    change[free] = solved[:, 0] - solved[:, 1:] @ ell
    return change, ell, gram


def solve_gram(gram: Array, right: Array) -> Array:
    """I_kk^-1 right; combinations of conditions that nothing changes get no multiplier."""
    if not right.size:
        return np.zeros(0)
    size = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(gram / np.outer(size, size))
    inverse = np.where(
        values > RANK * max(values[-1], np.finfo(float).tiny), 1.0 / np.where(values == 0, 1, values), 0.0
    )
    return np.asarray(vectors @ (inverse * (vectors.T @ (right / size))) / size)


def unreachable(gram: Array, miss: Array) -> Array:
    """The part of the miss that no change of the controls reduces to first order."""
    if not miss.size:
        return miss
    size = np.sqrt(np.diag(gram))
    zero = size == 0
    size = np.where(zero, 1.0, size)
    values, vectors = np.linalg.eigh(gram / np.outer(size, size))
    hopeless = vectors[:, values <= RANK * max(float(values[-1]), np.finfo(float).tiny)]
    return np.asarray(size * (hopeless @ (hopeless.T @ (miss / size))))


def positive_definite(blocks: Array, scale: Array, unit: float, smallest: float) -> Array:
    """Symmetric blocks made positive definite: absolute eigenvalues, none below a share of the largest of all.

    Args:
        blocks: (K, n, n).
        scale: typical magnitudes of the n entries; eigenvalues are taken in units of them.
        unit: eigenvalue to take where all are zero.
        smallest: share of the largest.
    """
    scaled = blocks * scale[:, None] * scale
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.transpose(0, 2, 1)))
    largest = float(np.abs(values).max(initial=0.0))
    reference = largest if largest > smallest * unit else unit
    values = np.maximum(np.abs(values), smallest * reference)
    made = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.asarray(made / (scale[:, None] * scale))


def solve_tangent(metric: Metric, slope: Array, rows: Array, active: Array) -> Array:
    """metric^-1 slope within the directions that change neither the conditions nor the active entries, (n,)."""
    zero = np.zeros(slope.size)
    given = (-slope, rows, np.zeros(rows.shape[0]), zero, active)
    found = _equality_step(metric, *given)
    return solve_tangent(metric.plain(), slope, rows, active) if found is None else found[0]
