"""Noise densities along a trajectory: what depends on state, control or time may leave its domain on the way."""

from __future__ import annotations

import numpy as np

from covocp.extremal import Extremal
from covocp.matrices import Array

# Relative size of a negative eigenvalue that counts as roundoff, and of the smallest one of a measurement's density.
ROUNDOFF = 1e-12
SINGULAR = 1e-14


def impossible_density(extremal: Extremal) -> str:
    """The first noise density along a trajectory that no noise can have, in words; "" where there is none.

    Process noise must be positive semidefinite, measurement noise positive definite, at every node.
    """
    st = extremal.statement
    if not st.noise_varies:  # constant ones are checked before a solver starts
        return ""
    x, u, _, t, duration, p = extremal.columns()
    count = extremal.mesh.intervals + 1
    densities: list[tuple[str, Array, float]] = []
    for block, form in zip(st.matrices, st.riccati, strict=True):
        if block.estimation and form is not None:
            values = form.map(count)(x, u, t, duration, p)[1].full()
            densities.append(("process noise of " + ", ".join(st.augmented), values, -ROUNDOFF))
    if st.measurement is not None:
        values = st.measurement.map(count)(x, u, t, duration, p)[2].full()
        densities.append(("measurement noise of " + ", ".join(st.measurement_names), values, SINGULAR))
    for what, values, least in densities:
        size = values.shape[0]
        matrices = np.asarray(values).reshape(size, count, size).transpose(1, 0, 2)
        if np.ptp(matrices, axis=0).max(initial=0.0) == 0.0:
            matrices = matrices[:1]
        eigenvalues = np.linalg.eigvalsh(np.nan_to_num(matrices, nan=0.0, posinf=0.0, neginf=0.0))
        smallest, largest = eigenvalues[:, 0], np.abs(eigenvalues).max()
        wrong = np.flatnonzero((smallest < least * largest) | ~np.isfinite(matrices).all(axis=(1, 2)))
        if wrong.size:
            k = int(wrong[0])
            return (
                f"the density of the {what} is not positive {'definite' if least > 0 else 'semidefinite'} "
                f"at t = {extremal.time[k]:.6g} s (smallest eigenvalue {smallest[k]:.3g})"
            )
    return ""
