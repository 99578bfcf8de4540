"""Deviations at the end of a trajectory, the measure of what a covariance is there."""

from __future__ import annotations

import numpy as np

from covocp.base.matrices import Array, half_indices
from covocp.statement.statement import Statement

# Share of its largest value below which a variance at the end is zero.
LEAST_SHARE = 1e-12


def final_deviations(statement: Statement, e: Array) -> Array:
    """Products of the deviations at the end to which entries of covariances belong, (ne,); inf of other matrices.

    What is told of the end is what remains of a prior that may be a million times as large: of its range it is nothing.
    """
    result = np.full(statement.ne, np.inf)
    for block in statement.matrices:
        if not block.covariance or block.span.start in statement.entries(statement.behind):
            continue
        rows, columns = half_indices(block.size)
        variances = np.abs(e[:, block.span.start + np.flatnonzero(rows == columns)])
        own = np.sqrt(np.maximum(variances[-1], LEAST_SHARE * variances.max(axis=0)))
        result[block.span] = np.where(own[rows] * own[columns] > 0.0, own[rows] * own[columns], np.inf)
    return result
