"""Points at which functions are compared, their values there, and which of two values differ."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array

SEED = 20
ALONG, AROUND, FAR = 8, 6, 12  # numbers of points
SPREAD = 0.3  # of the points around the trajectory, relative
DECADES = 2.0  # magnitudes of the far points, up and down from those of the trajectory and from 1
# Relative difference of two values of a function above which the functions differ: well above what another version or
# compiler changes, well below what another number in a problem does.
SAME = 1e-7
# The same relative to the median over the points, for what is left of a difference of large terms.
ROUNDOFF = 1e-12
SHOWN = 4  # numbers of an array that are shown


def spread_points(along: Array, positive: slice) -> Array:
    """Given points, others around them, and others far from them; a row each.

    Args:
        along: the given ones; what is not finite in them counts as zero.
        positive: columns of times, which are not negative.
    """
    along = np.nan_to_num(along, nan=0.0, posinf=0.0, neginf=0.0)
    size = np.abs(along).max(axis=0)
    size[size == 0] = 1.0
    random = np.random.default_rng(SEED)
    near = along[random.integers(along.shape[0], size=AROUND)]
    near = near * (1 + SPREAD * random.standard_normal(near.shape)) + SPREAD * size * random.standard_normal(near.shape)
    shape = (FAR, size.size)
    far = 10 ** random.uniform(-DECADES, DECADES, shape) * np.where(random.random(shape) < 0.5, size, 1.0)
    far[FAR // 3 :] *= random.choice([-1.0, 1.0], size=(FAR - FAR // 3, size.size))  # the others are positive
    near[:, positive], far[:, positive] = np.abs(near[:, positive]), np.abs(far[:, positive])
    return np.vstack([along, near, far])


def evaluated(function: ca.Function, points: Array, sizes: Mapping[str, int]) -> list[Array]:
    """Outputs of a function at some points, (K, entries) each, columns stacked; NaN where it has no value.

    Args:
        function: of some of the arguments, which are told by their names.
        points: all arguments side by side, a row for each point.
        sizes: lengths of the arguments by their names, in their order.
    """
    ends = np.cumsum([0, *sizes.values()]).tolist()
    columns = dict(zip(sizes, (points[:, i:j] for i, j in pairwise(ends)), strict=True))
    names = [function.name_in(i) for i in range(function.n_in())]
    outputs = [np.full((points.shape[0], function.numel_out(i)), np.nan) for i in range(function.n_out())]
    for k in range(points.shape[0]):
        try:
            results: Any = function.call([ca.DM(columns[name][k]) for name in names])
        except RuntimeError:  # a callback, or a linear system, that cannot be evaluated there
            continue
        for rows, result in zip(outputs, results, strict=True):
            rows[k] = result.full().ravel(order="F")
    return outputs


def apart(old: Array, new: Array) -> Any:
    """Where values at the points differ, (K, entries)."""
    finite = np.isfinite(old)
    size = np.where(finite, np.abs(old), 0.0)
    allowed = SAME * size + ROUNDOFF * np.median(size, axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        far = np.abs(np.where(finite, new - old, 0.0)) > allowed
    return (finite != np.isfinite(new)) | far


def same_columns(old: Array, new: Array) -> bool:
    """Whether each column of the one is a column of the other, in any order and number."""

    def within(some: Array, others: Array) -> bool:
        for column in some.T:
            alike = ~apart(np.tile(column[:, None], others.shape[1]), others).any(axis=0)
            if not alike.any():
                return False
        return True

    return old.shape[0] == new.shape[0] and within(old, new) and within(new, old)


def shown(values: Array) -> str:
    """A few numbers, and how many others there are."""
    more = f", ... ({values.size})" if values.size > SHOWN else ""
    return (
        one_number(values[0])
        if values.size == 1
        else "[" + ", ".join(one_number(v) for v in values[:SHOWN]) + more + "]"
    )


def one_number(value: float) -> str:
    """A number, or that there is none."""
    return "free" if np.isnan(value) else f"{value:.9g}"
