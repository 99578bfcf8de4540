"""Conditions on the covariance of the filter's error where the actual system scatters more widely than that."""

from __future__ import annotations

import numpy as np

from covocp.base.errors import warn_user
from covocp.base.matrices import Array, half_indices, standard_deviations
from covocp.solution.solution import Solution
from covocp.statement.statement import Conditions

# Share by which the deviation of the actual system may exceed that of the filter's error before it is mentioned.
SAME_SPREAD = 0.01


def mention_spread(solution: Solution) -> None:
    """Warn where a condition of a closed loop contains E: E is what the filter does not know, the spread is X."""
    statement, loop = solution.statement, solution.loop
    if statement is None or loop is None:
        return
    block = next(b for b in solution.blocks if b.estimation)
    ends = ((statement.path, slice(None)), (statement.start, slice(0, 1)), (statement.end, slice(-1, None)))
    inside = zip(statement.inside.parts, statement.inside.nodes_among(solution.mesh.nodes), strict=True)
    for conditions, at in (*ends, *((part.conditions, slice(k, k + 1)) for part, k in inside)):
        names, used = _rows_with(conditions, block.span)
        if not names:
            continue
        moving = block.size - sum(b.size for b in solution.blocks if b.kind == "unknown")
        pairs = zip(*half_indices(block.size), used, strict=True)
        rows = sorted({int(k) for i, j, there in pairs if there for k in (i, j) if k < moving})
        if not rows:  # what is constant scatters as it did; a condition on it is one on what is learnt
            continue
        error = standard_deviations(loop.E[at])[:, rows]
        actual = standard_deviations(loop.X[at])[:, rows]
        excess: Array = np.where(actual > (1.0 + SAME_SPREAD) * error, actual - error, 0.0)
        if not np.any(excess):
            continue
        share = excess / np.maximum(actual, np.finfo(float).tiny)
        k, i = (int(n) for n in np.unravel_index(int(np.argmax(share)), share.shape))
        label, t = block.labels[rows[i]], solution.t[at][k]
        listed = ", ".join(f"'{name}'" for name in names)
        warn_user(
            f"{listed} contain{'s' if len(names) == 1 else ''} E, the covariance of the filter's error. The actual "
            f"system scatters by X = E + Xhat: at {t:.4g} s the deviation of {label} is {actual[k, i]:.4g}, of which E "
            f"shows {error[k, i]:.4g}. Where the condition is about the spread, put X = closed_loop_covariance() in "
            "place of E."
        )


def _rows_with(conditions: Conditions, span: slice) -> tuple[list[str], Array]:
    """Names of the conditions that contain some half-vector, and which of its entries they contain."""
    if not conditions.uses_matrices:
        return [], np.zeros(0, bool)
    function = conditions.function if conditions.realised is None else conditions.realised  # X contains E by right
    rows, columns = function.jac_sparsity(0, 2).get_triplet()
    inside = [(i, j - span.start) for i, j in zip(rows, columns, strict=True) if span.start <= j < span.stop]
    used = np.zeros(span.stop - span.start, bool)
    used[[j for _, j in inside]] = True
    return [conditions.names[i] for i in sorted({i for i, _ in inside})], used
