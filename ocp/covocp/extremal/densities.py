"""Noise densities along a trajectory: what depends on state, control or time may leave its domain on the way."""

from __future__ import annotations

import numpy as np

from covocp.base.matrices import Array, stacked, unpack
from covocp.extremal.extremal import Extremal

# Relative size of a negative eigenvalue that counts as roundoff, and of the smallest one of a measurement's density.
ROUNDOFF = 1e-12
SINGULAR = 1e-14

SWITCHED = "; a sensor that can be switched off is stated by measurement(..., information=), which may be zero"


def impossible_density(extremal: Extremal) -> str:
    """The first noise density along a trajectory that no noise can have, in words; "" where there is none.

    Process noise must be positive semidefinite, measurement noise positive definite, at every node.
    """
    st = extremal.statement
    if not st.noise_varies:  # constant ones are checked before a solver starts
        return ""
    x, u, _, t, duration, p = extremal.columns()
    count = extremal.mesh.intervals + 1
    densities: list[tuple[str, Array, float, float]] = []
    for block, form in zip(st.matrices, st.riccati, strict=True):
        if block.estimation and form is not None:
            values = form.map(count)(x, u, t, duration, p)[1].full()
            densities.append(("process noise of " + ", ".join(st.augmented), values, -ROUNDOFF, np.inf))
    if st.information is not None:
        stated = np.asarray(st.information.map(count)(x, u, t, duration, p).full())
        low = np.nan_to_num(stated, nan=-np.inf).min(axis=0)
        if low.min() < -ROUNDOFF * np.abs(stated).max():
            k = int(np.argmin(low))
            return f"the information of a measurement is {low[k]:.3g} at t = {extremal.time[k]:.6g} s"
    if st.measurement is not None:
        slopes, values = (np.asarray(v.full()) for v in st.measurement.map(count)(x, u, t, duration, p)[1:])
        for block in st.measurements:
            own = values.reshape(values.shape[0], count, -1)[block.span][:, :, block.span].reshape(block.size, -1)
            slope = slopes.reshape(values.shape[0], count, -1)[block.span]
            densities.append((f"measurement noise of {block.name}", own, SINGULAR, _seen(extremal, slope)))
    for what, values, least, seen in densities:
        wrong = _first_wrong(values, count, least, seen)
        if wrong is not None:
            return (
                f"the density of the {what} is not positive {'definite' if least > 0 else 'semidefinite'} "
                f"at t = {extremal.time[wrong[0]]:.6g} s (smallest eigenvalue {wrong[1]:.3g})"
                + (SWITCHED if least > 0 else "")
            )
    return ""


def _seen(extremal: Extremal, slope: Array) -> float:
    """What a measurement sees of the uncertainty: largest M E M' of any row and node, times T; inf without E."""
    if not extremal.statement.estimated:
        return np.inf
    block = extremal.statement.estimation
    E = unpack(extremal.trajectory.e[:, block.span], block.size)
    variances = np.einsum("rki,kij,rkj->rk", slope, E, slope)
    return float(np.nan_to_num(np.abs(variances)).max(initial=0.0)) * extremal.trajectory.duration


def _first_wrong(values: Array, count: int, least: float, seen: float) -> tuple[int, float] | None:
    """The first node at which a density is none, and its smallest eigenvalue there.

    Args:
        values: matrices at the nodes side by side, (size, count size).
        count: nodes.
        least: smallest eigenvalue that is allowed, relative to the largest of any node, or to `seen` where that is
            less: a sensor that is nearly switched off at some nodes is noisy there, not singular elsewhere.
        seen: what the measurement could see.
    """
    matrices = stacked(values, count)
    if np.ptp(matrices, axis=0).max(initial=0.0) == 0.0:
        matrices = matrices[:1]
    eigenvalues = np.linalg.eigvalsh(np.nan_to_num(matrices, nan=0.0, posinf=0.0, neginf=0.0))
    smallest, sizes = eigenvalues[:, 0], np.abs(eigenvalues).max(axis=1)
    largest = np.maximum(sizes, min(float(sizes.max()), seen)) if least > 0 else sizes.max()
    wrong = np.flatnonzero((smallest < least * largest) | ~np.isfinite(matrices).all(axis=(1, 2)))
    return (int(wrong[0]), float(smallest[wrong[0]])) if wrong.size else None
