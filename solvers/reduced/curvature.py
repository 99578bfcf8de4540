"""The Hessian of the Lagrangian in the chosen variables: what the running cost tells at first, then what is learnt."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.matrices import Array
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Statement
from covocp.transcription.nlp import NLP
from covocp.transcription.steering import quadrature_weights
from covocp.transcription.trajectory import Trajectory, at_nodes

# Least curvature of a control, as a share of the largest one, below which the cost is asked along its own slope.
FLAT = 1e-3
# Least curvature of a combination of the controls of a node, as a share of the largest one there.
RANK = 1e-4
# Relative displacement by which slopes are differentiated.
DISPLACEMENT = 1e-4
# Powell's share of the curvature that is kept where a step shows less (Nocedal and Wright, 18.3).
KEPT_SHARE = 0.1
# Condition of the Hessian (product of Frobenius norms) from which on it is lost: along concave directions a step leaves
# a tenth of the curvature, until what lies across them, and the inverse, is roundoff. A run that begins to learn anew
# earlier takes fewer steps (ten pendulums: 111 to 952 before, 94 to 888 so; with 1e12 one of them does not end).
WORST_CONDITION = 1e9


def first_curvature(
    nlp: NLP,
    chosen: NDArray[np.intp],
    w: Array,
    trajectory: Trajectory,
    parameters: Array,
    slope_at: Callable[[Array], Array],
    cost_scale: float,
) -> Curvature:
    """A first Hessian in the chosen variables: of the running cost by the controls, elsewhere from differences.

    Args:
        nlp: the program.
        chosen: places of the variables.
        w: the point.
        trajectory: the same point.
        parameters: of the statement.
        slope_at: the slope of the cost by all variables at a point, in its unit.
        cost_scale: this unit.

    Returns:
        Positive definite, of the cost in its unit.
    """
    st, nodes, nu = nlp.statement, nlp.mesh.control_nodes, nlp.statement.nu
    size = w.size
    first = size - nodes * nu - int(st.duration.free)
    blocks, weights = _running(nlp, trajectory, parameters)
    slope = slope_at(w)
    own = np.zeros(size, dtype=bool)
    own[chosen] = True
    metric = np.ones(size)
    metric[first : first + nodes * nu] = (weights / weights.mean(axis=0)).ravel()  # beside others: in no unit
    result = np.zeros((size, size))
    for k in range(nodes):
        span = slice(first + k * nu, first + (k + 1) * nu)
        result[span, span] = blocks[k] / cost_scale
    diagonal = np.einsum("ii->i", result)
    flat = own & (diagonal <= FLAT * metric * (diagonal / metric)[own].max(initial=0.0))
    if flat.any():
        diagonal[flat] = metric[flat] * _along_slope(slope_at, slope, w, metric, own)
    for i in np.flatnonzero(own):
        if not first <= i < first + nodes * nu:
            # a decision is one number, whatever segment it acts in: alone at the start it may cost nothing
            together = slice(i, st.nx * len(nlp.mesh.starts), st.nx) if i in st.decisions else slice(i, i + 1)
            step = DISPLACEMENT * max(1.0, abs(float(w[i])))
            moved = w.copy()
            moved[together] += step
            change = float((slope_at(moved) - slope)[together].sum()) / step
            floor = abs(float(slope[together].sum())) / max(1.0, abs(float(w[i])))
            diagonal[i] = max(abs(change) if np.isfinite(change) else 0.0, floor, diagonal[own].max() * 1e-6, 1e-12)
    return Curvature.of(result[np.ix_(chosen, chosen)])


def _running(nlp: NLP, trajectory: Trajectory, parameters: Array) -> tuple[Array, Array]:
    """Curvature of the running cost by the control values, (nodes, nu, nu), and their weights in time, (nodes, nu)."""
    st, mesh = nlp.statement, nlp.mesh
    nodes, nu = mesh.control_nodes, st.nu
    if not nu:
        return np.zeros((nodes, 0, 0)), np.zeros((nodes, 0))
    q = quadrature_weights(mesh) * trajectory.duration
    units = np.broadcast_to(nlp.scales.u, (nodes, nu))
    u = at_nodes(trajectory.u, nodes)
    times = mesh.nodes[:nodes] * trajectory.duration
    slopes = _curvature_of_running(st).map(nodes)
    given = (trajectory.x[:nodes].T, u.T, trajectory.e[:nodes].T, times[None, :])
    values = np.asarray(slopes(*given, trajectory.duration, ca.repmat(ca.DM(parameters), 1, nodes)).full())
    blocks = values.reshape(nu, nodes, nu).transpose(1, 0, 2)
    blocks = np.nan_to_num(0.5 * (blocks + blocks.transpose(0, 2, 1)), nan=0.0, posinf=0.0, neginf=0.0)
    blocks = q[:, None, None] * units[:, :, None] * blocks * units[:, None, :]
    for k in range(nodes):
        least, vectors = np.linalg.eigh(blocks[k])
        blocks[k] = (vectors * np.maximum(least, RANK * max(float(least[-1]), 0.0))) @ vectors.T
    return blocks, q[:, None] * units**2


@lru_cache(maxsize=4)
def _curvature_of_running(statement: Statement) -> ca.Function:
    """(x, u, e, t, T, p) -> Hessian of the running cost by u."""
    x, u, e, t, duration, p = model_symbols(statement)
    if statement.nominal is None or statement.running_uses_matrices:
        running = statement.rates(x, u, e, t, duration, p)[2]
    else:
        running = statement.nominal(x, u, t, duration, p)[1]
    hessian = ca.densify(ca.hessian(running, u)[0])
    return ca.Function("curvature_of_running", [x, u, e, t, duration, p], [hessian])


def _along_slope(slope_at: Callable[[Array], Array], slope: Array, w: Array, metric: Array, own: Array) -> float:
    """Curvature of the cost along its own slope, in the metric."""
    direction = np.where(own, slope / metric, 0.0)
    size = float(np.sqrt((direction**2) @ metric))
    if not np.isfinite(size) or size == 0.0:
        return 1.0
    step = DISPLACEMENT * np.sqrt(metric.sum()) / size
    curvature = abs(float((slope_at(w - step * direction) - slope) @ direction)) / (step * size**2)
    return curvature if np.isfinite(curvature) and curvature > 0.0 else 1.0


class Curvature(NamedTuple):
    """B and its inverse, (nz, nz) each, learnt side by side."""

    matrix: Array
    inverse: Array

    @staticmethod
    def of(matrix: Array) -> Curvature:
        """With the inverse of a matrix."""
        return Curvature(matrix, np.asarray(np.linalg.inv(matrix), dtype=float))


def learnt(curvature: Curvature, change: Array, difference: Array) -> Curvature | None:
    """The damped update of Broyden, Fletcher, Goldfarb and Shanno: B stays positive definite.

    Args:
        curvature: B and its inverse.
        change: s, of the variables.
        difference: y, of the slope of the Lagrangian.

    Returns:
        B and its inverse; None where it would be too ill-conditioned to stay definite in numbers.
    """
    B, H = curvature
    Bs = B @ change
    sBs, sy = float(change @ Bs), float(change @ difference)
    if not sBs > 0.0 or not np.isfinite(sy):
        return curvature
    theta = 1.0 if sy >= KEPT_SHARE * sBs else (1.0 - KEPT_SHARE) * sBs / (sBs - sy)
    r = theta * difference + (1.0 - theta) * Bs
    sr = float(change @ r)
    if not sr > 0.0:  # too small to be told from nothing
        return curvature
    Hr = H @ r
    scaled = change / sr
    B = B + np.outer(r, r / sr) - np.outer(Bs, Bs / sBs)
    H = H + np.outer((1.0 + float(r @ Hr) / sr) * scaled, change) - np.outer(Hr, scaled) - np.outer(scaled, Hr)
    return Curvature(B, H) if np.linalg.norm(B) * np.linalg.norm(H) < WORST_CONDITION else None
