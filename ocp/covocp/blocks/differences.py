"""Differences of one reading to those before it: rows that share the noise of that reading, made independent."""

from __future__ import annotations

from typing import Any

import casadi as ca

from covocp.base.expressions import Expr
from covocp.blocks.arithmetic import where

# Readings beyond this count as missing: their squares would leave the range of numbers.
LARGEST = 1e30


def is_usable(reading: Expr) -> Any:
    """1 where a number is finite and its square a number too."""
    return ca.fabs(reading) <= LARGEST


def independent(rows: Expr, values: Expr, used: Expr, noise: Expr) -> tuple[Any, Any, Any]:
    """Rows with independent noise, and their variances.

    With the covariance noise (I + 1 1') the best guess of the noise of the j-th row by those before it is their mean
    times (j - 1) / j, and 1 + 1/j is left. A row needs those before it only, so rows may be missing.

    Args:
        rows: SX, (m, n).
        values: SX, (m, 1).
        used: 1 where a row is there, 0 where not, SX, (m, 1).
        noise: variance of one reading.

    Returns:
        Rows (m, n), values (m, 1), of missing ones zero, and variances (m, 1).
    """
    row_sum, value_sum, count = ca.SX(1, rows.shape[1]), ca.SX(1, 1), ca.SX(0)
    new_rows, new_values, variances = [], [], []
    for j in range(rows.shape[0]):
        row, value = where(ca.repmat(used[j], 1, rows.shape[1]), rows[j, :]), where(used[j], values[j])
        share = 1 / (count + 1)
        new_rows.append(where(ca.repmat(used[j], 1, rows.shape[1]), row - share * row_sum))
        new_values.append(where(used[j], value - share * value_sum))
        variances.append(noise * (1 + share))
        row_sum, value_sum, count = row_sum + row, value_sum + value, count + used[j]
    return ca.vertcat(*new_rows), ca.vertcat(*new_values), ca.vertcat(*variances)
