"""How many explicit steps the adjoint equations take, whose fastest rates are those of nominal and covariances."""

from __future__ import annotations

import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.matrices import Array, own_units, stacked, unpack
from covocp.extremal.extremal import Extremal
from covocp.extremal.forms import drift_matrices
from covocp.transcription.mesh import LARGEST_SUBSTEPS, STIFFNESS_PER_STEP
from covocp.transcription.stiffness import state_jacobian

# How often a matrix is squared to bound its spectral radius; by how many steps an interval the bound may be above it.
SQUARED, ABOVE = 4, 0.1


def explicit_pairs(extremal: Extremal) -> tuple[int, int]:
    """Explicit steps an interval for the adjoint equations, and the first node that they reach from the end.

    A covariance E that is measured well falls fast, and its costate P' = -(F - E W)' P - P (F - E W) with it: the steps
    of E do not mind, explicit ones of P end in overflow. That is at the start as a rule, where a prior is large:
    an interval that would take too many steps is the last one on the way back, and nothing is known before it.

    Args:
        extremal: the solution.
    """
    mesh, lengths = extremal.mesh, np.diff(extremal.time)
    own = 1 if mesh.step == "rodas" else max(1, mesh.substeps)
    needed = np.full(mesh.intervals, float(own))
    for matrices, times in _linear(extremal):
        unknown, rates = not np.isfinite(matrices).all(), np.zeros(mesh.intervals + 1)
        asked = np.ones(mesh.intervals + 1, dtype=bool)
        for largest in (_norms, _norms_of_powers):  # the first bound of the rates is had sooner than the closer one
            with np.errstate(over="ignore", invalid="ignore"):
                rates[asked] = times * largest(matrices[asked])
                steps = np.maximum(rates[1:], rates[:-1]) * lengths / STIFFNESS_PER_STEP
            open_ones = ~(steps <= own)
            if not open_ones.any():
                break
            asked = np.append(open_ones, False) | np.append(False, open_ones) | unknown
        needed = np.maximum(needed, np.where(np.isfinite(steps), steps, np.inf))
    many = np.flatnonzero(needed > max(LARGEST_SUBSTEPS, own))
    first = 0 if not many.size else int(many[-1]) + 1
    return int(np.ceil((needed[first:] - ABOVE).max(initial=float(own)))), first


def _linear(extremal: Extremal) -> list[tuple[Array, float]]:
    """Matrices of what the costates of states and matrices follow, at the nodes (K, n, n), and how often each acts."""
    st, count = extremal.statement, extremal.mesh.intervals + 1
    x, u, _, *others = extremal.columns()
    result: list[tuple[Array, float]] = []
    if extremal.mesh.step == "rodas":  # explicit steps of the nominal are short enough already
        result.append((stacked(state_jacobian(st).map(count)(*extremal.columns()), count), 1.0))
    for i, (block, form) in enumerate(zip(st.matrices, st.riccati, strict=True)):
        if form is None:
            continue
        values = unpack(extremal.trajectory.e[:, list(st.entries((i,)))], block.size)
        matrices = drift_matrices(st, i, [np.asarray(column) for column in (x, u, *others)], values)
        if matrices is None:
            parts = Matrices(form.map(count)).evaluated(x, u, *others)
            drift, _, information = (stacked(part, count) for part in parts)
            matrices = drift - values @ information
        units = own_units(values)  # in these the bounds are near the radii, whatever units the model has
        result.append((matrices * units[:, None, :] / units[:, :, None], 2.0))
    return result


def _norms(matrices: Array) -> Array:
    """Bounds of the spectral radii: the smaller one of the largest sums of rows and of columns."""
    sizes = np.abs(matrices)
    return np.asarray(np.minimum(sizes.sum(axis=1).max(axis=1), sizes.sum(axis=2).max(axis=1)))


def _norms_of_powers(matrices: Array) -> Array:
    """Closer bounds: roots of the same of a power of the matrices, a few hundredths above where n^(1/16) is little."""
    scale = np.maximum(np.abs(matrices).max(axis=(1, 2), initial=0.0), np.finfo(float).tiny)
    powers = matrices / scale[:, None, None]
    for _ in range(SQUARED):
        powers = powers @ powers
    return np.asarray(scale * _norms(powers) ** (0.5**SQUARED))
