"""The covariances of a solution: those of the deviations by symbol, and whether all of them can be covariances."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array, is_semidefinite
from covocp.base.residuals import VIOLATION
from covocp.solution.reading import name_in
from covocp.statement.augmented import augmented_blocks, check_no_quaternion_entry
from covocp.statement.names import block_of
from covocp.transcription.before_reading import ESTIMATE

if TYPE_CHECKING:
    from covocp.solution.solution import Solution

# Share of the largest variances of X up to which the covariance of the estimate is known where it is a variable of the
# program or follows from a gain that is one, what a converged point may violate steps by: after few readings it is
# singular, before them zero.
ITERATED = VIOLATION


def all_covariances(solution: Solution) -> list[Array]:
    """Those that are states, and of a closed loop those of the estimate and of the deviations."""
    loop = [] if solution.loop is None else [solution.loop.Xhat, solution.loop.X]
    return [solution.values[b.name] for b in solution.blocks if b.kind == "matrix" and b.covariance] + loop


def are_semidefinite(solution: Solution) -> bool:
    """Whether all covariances are positive semidefinite up to roundoff at all nodes."""
    if solution.loop is None or (solution.mesh.eliminated and ESTIMATE not in solution.values):
        return all(map(is_semidefinite, all_covariances(solution)))
    estimates = [solution.values.get(ESTIMATE), solution.loop.Xhat]
    others = [matrix for matrix in all_covariances(solution) if all(matrix is not own for own in estimates)]
    iterated = [np.concatenate([own, solution.loop.X]) for own in estimates if own is not None]
    return all(map(is_semidefinite, others)) and all(is_semidefinite(own, ITERATED) for own in iterated)


def covariance_between(solution: Solution, a: Given, b: Given) -> Array:
    """What `Solution.covariance` returns, and its errors."""
    block = next((q for q in solution.blocks if q.kind == "matrix" and q.estimation), None)
    if block is None:
        raise ProblemError(
            "The problem has no estimation covariance.",
            expected="a problem with estimation_covariance()",
            received=solution.name,
            remedy="index the matrices of the problem by their names",
        )
    full = solution.values[block.name].copy() if solution.loop is None else solution.loop.X
    rows, columns = _augmented_span(solution, a), _augmented_span(solution, a if b is None else b)
    return np.asarray(full[:, rows, columns])


def _augmented_span(solution: Solution, key: Given) -> slice:
    """Rows of a state, an unknown or an entry of one in the covariances of the augmented state."""
    rows = augmented_blocks(solution.blocks, solution.augmented)
    check_no_quaternion_entry(key, solution.symbols, solution.blocks, [block.name for block in rows])
    found = block_of(name_in(solution, key, rows), rows)
    assert found is not None
    return found.span
