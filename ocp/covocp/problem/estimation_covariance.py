"""The covariance of the estimation error of the augmented state, as the user sees and indexes it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from covocp.base.checks import caller, is_symbolic
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given, symbol_of
from covocp.base.threads import methods_one_at_a_time
from covocp.problem.checks import check_name
from covocp.problem.declarations import Control, Declarations, State, Unknown
from covocp.problem.matrices import Matrix, declare_matrix
from covocp.problem.tangents import tangent_slope
from covocp.statement.entries import error_names, error_size

AugmentedEntry = State | Unknown


def with_estimation(declarations: Declarations, initial: Given = None) -> Declarations:
    """The declarations with the Kalman-Bucy covariance E of the augmented state.

    Args:
        declarations: of a problem.
        initial: covariance at the start; None: from the variances of states and unknowns.

    Raises:
        ProblemError: called twice, nothing to estimate, `initial` not positive semidefinite.
    """
    entries = declarations.augmented
    labels = error_names(entries)
    if not labels:
        raise ProblemError(
            "There is nothing to estimate.",
            expected="states and unknowns declared before estimation_covariance()",
            received="none",
            remedy="call estimation_covariance() after the last state() and unknown()",
        )
    check_name("E", list(declarations.named))
    initial = ca.diagcat(*(entry.variance for entry in entries)) if initial is None else initial
    options = {"initial": initial, "lower": 0.0, "covariance": True, "estimation": True}
    return declarations.adding(matrices=declare_matrix("E", labels=labels, where=caller(), **options))


@methods_one_at_a_time
class EstimationCovariance:
    """The covariance of the estimation error of the augmented state (states, then unknowns).

    `E[a, b]` is the block between two symbols, names (also of components, "x[0]"), or expressions of them (to first
    order, by their Jacobians); `E.matrix` is the whole symmetric matrix.
    """

    _stands_for = "E"  # as a key of solutions

    def __init__(self, entries: Sequence[AugmentedEntry], declaration: Matrix) -> None:
        """Keep the entries of the augmented state and the declared matrix."""
        self._entries = tuple(entries)
        self._declaration = declaration

    @property
    def matrix(self) -> ca.MX:
        """The full symmetric matrix, shape (n, n), n entries of the augmented state."""
        return self._declaration.matrix

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the rows."""
        return self._declaration.labels

    def __getitem__(self, key: Given) -> ca.MX:
        """Covariance between two symbols or names, shape (size of a, size of b).

        Raises:
            ProblemError: where a name is unknown, or an expression contains no augmented state.
        """
        return block_between("E", self.matrix, self._entries, self.labels, key)


def block_between(
    letter: str, matrix: ca.MX, entries: Sequence[AugmentedEntry | Control], labels: tuple[str, ...], key: Given
) -> ca.MX:
    """The block of a covariance between two symbols, names or expressions.

    Args:
        letter: what the covariance is called.
        matrix: the covariance of all entries.
        entries: what its rows stand for.
        labels: names of the rows.
        key: the two.

    Raises:
        ProblemError: where there are not two, a name is unknown, or an expression contains no entry.
    """
    if not isinstance(key, tuple) or len(key) != 2:
        raise ProblemError(
            "A covariance is indexed by two symbols.",
            expected=f"{letter}[a, b] with a, b of " + ", ".join(labels),
            received=f"{letter}[{key}]",
            remedy=f"write {letter}[a, a] for the variance of a; {letter}.matrix is the whole matrix",
        )
    left, right = (_rows(letter, entries, labels, entry) for entry in key)
    if isinstance(left, slice) and isinstance(right, slice):
        return matrix[left, right]
    unit = ca.MX.eye(matrix.shape[0])
    rows, columns = (unit[j, :] if isinstance(j, slice) else j for j in (left, right))
    return ca.densify(rows @ matrix @ columns.T)


def _stands_for(key: Given, entry: AugmentedEntry | Control) -> bool:
    """Whether a symbol or name is that of an entry."""
    if isinstance(key, str):
        return key == entry.name
    # hashes of expressions are those of their nodes; to ask CasADi whether two are equal takes fifty times as long
    return key is entry.symbol or (is_symbolic(key) and bool(key.__hash__() == entry.symbol.__hash__()))


def _rows(letter: str, entries: Sequence[AugmentedEntry | Control], labels: tuple[str, ...], key: Given) -> Any:
    """Rows that a symbol or name stands for (a slice), or the Jacobian of an expression."""
    if isinstance(key, str) and key in labels:  # the name of a scalar, or of a component
        row = labels.index(key)
        return slice(row, row + 1)
    key = symbol_of(key)
    offset = 0
    for entry in entries:
        span = slice(offset, offset + error_size(entry))
        if _stands_for(key, entry):
            return span
        offset = span.stop
    jacobians = [tangent_slope(key, entry) for entry in entries] if is_symbolic(key) else []
    jacobian = ca.horzcat(*jacobians) if jacobians else ca.MX(1, 0)
    if jacobian.nnz() == 0:
        of_loop = any(isinstance(entry, Control) for entry in entries)
        raise ProblemError(
            f"'{key}' is not part of the {'closed loop' if of_loop else 'estimated state'}.",
            expected="a symbol or name of " + ", ".join(labels),
            received=str(key),
            remedy=f"index {letter} with states{', unknowns and controls' if of_loop else ' and unknowns'} of this "
            "problem",
        )
    return jacobian  # sparse: what it leaves out is no part of a cost or a condition
