"""Statements one after the other: what the end of each gives to the start of the next."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import OutsideDomainError
from covocp.base.matrices import Array, unpack
from covocp.base.short_repr import short_repr
from covocp.statement.statement import Statement

# States that an error lists.
LISTED = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """What the end of a statement gives to the start of the next one.

    states: entries of the later initial state that are given; the others start as the later statement says.
    matrices: entries of the later half-vectors at the start that are given.
    parameters: where these lie among the parameters of the later statement, which have them as initial values.
    names: of the rows, states first.
    function: (state and half-vectors at the end, duration, parameters, parameters of the later statement) -> states,
        matrices.
    behind: entries of the later half-vectors at the start that the statement before takes as parameters: S of an
        expected cost, what deviations cost from there on.
    weights: where these lie among its parameters.
    deviations: of an expected cost, (the same, covariance X of the deviations at the end) -> tangent J_x of what the
        later augmented state is by the one before, variances that are added, half of tr(J_xx X).
    """

    states: tuple[int, ...]
    matrices: tuple[int, ...]
    parameters: tuple[int, ...]
    names: tuple[str, ...]
    function: ca.Function
    behind: tuple[int, ...] = ()
    weights: tuple[int, ...] = ()
    deviations: ca.Function | None = None

    __repr__ = short_repr

    def values(self, x: Array, e: Array, duration: float, parameters: Array, later: Array) -> tuple[Array, Array]:
        """The states and the half-vectors that are given, as numbers."""
        states, matrices = self.function(x, e, duration, parameters, later)
        return np.asarray(states.full()).ravel(), np.asarray(matrices.full()).ravel()

    def variances(
        self, later: Statement, x: Array, e: Array, duration: float, parameters: Array, of_later: Array
    ) -> tuple[Array, Array]:
        """What is added to the covariance of the error, N of J E J' + N, and that covariance as the later one has it.

        Args:
            later: a statement with such a covariance, which goes on.
            x, e, duration, parameters, of_later: as of `values`.
        """
        block = later.estimation
        rows = [k for k, entry in enumerate(self.matrices) if block.span.start <= entry < block.span.stop]
        added, passed = (self.values(x, own, duration, parameters, of_later)[1][rows] for own in (np.zeros_like(e), e))
        return unpack(added, block.size), unpack(passed, block.size)

    def check_finite(self, before: Statement, ends: tuple[Array, Array, float], given: tuple[Array, Array]) -> None:
        """What is given must be numbers, where the statement before ends with numbers: else it is not the link's fault.

        Args:
            before: the statement that ends there.
            ends: its state, half-vectors and duration there.
            given: what `values` makes of them, states and half-vectors.

        Raises:
            OutsideDomainError: names what passes and is NaN or inf, and the states that it is made of.
        """
        x, e, duration = ends
        known = (np.isfinite(x).all(), np.isfinite(x).all() and np.isfinite(e).all())
        names = (self.names[: len(self.states)], self.names[len(self.states) :])
        for output, (values, sound) in enumerate(zip(given, known, strict=True)):
            wrong = np.flatnonzero(~np.isfinite(values))
            if not sound or not wrong.size:
                continue
            rows, columns = self.function.jac_sparsity(output, 0).get_triplet()
            of = [column for row, column in zip(rows, columns, strict=True) if row == wrong[0]]
            shown = ", ".join(f"{before.state_names[k]} = {x[k]:.4g}" for k in of[:LISTED])
            more = f" and {len(of) - LISTED} more" if len(of) > LISTED else ""
            raise OutsideDomainError(
                f"The {names[output][wrong[0]]} is {values[wrong[0]]:g} for what '{before.name}' ends with.",
                expected="a jump whose value and slopes are finite there",
                received=f"{shown}{more}{', ' if shown else ''}duration {duration:.4g} s",
                remedy="correct the expression of the jump, or give a guess, a nominal or bounds that keep what it is "
                "made of in its domain",
            )

    def filled(self, later: Array, matrices: Array) -> Array:
        """The parameters of the later statement with the half-vectors at its start."""
        result = later.copy()
        result[list(self.parameters)] = matrices
        return result

    def weighed(self, earlier: Array, start: Array) -> Array:
        """The parameters of the earlier statement with what runs backward in the later one, at its start."""
        result = earlier.copy()
        result[list(self.weights)] = start
        return result


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """Statements one after the other, each with its own time that starts at zero; a link between any two."""

    name: str
    statements: tuple[Statement, ...]
    links: tuple[Link, ...]

    __repr__ = short_repr


def started_at(statement: Statement, link: Link, states: Array) -> Statement:
    """The later statement with the initial states that a link gives as its own."""
    p = ca.MX.sym("parameters", statement.np)
    initial, *others = statement.boundary(p)
    rows = ca.vertsplit(initial) if statement.nx > 1 else [initial]
    for entry, value in zip(link.states, states, strict=True):
        rows[entry] = ca.MX(float(value))
    names = (statement.boundary.name_in(), statement.boundary.name_out())
    boundary = ca.Function("boundary", [p], [ca.vertcat(*rows), *others], *names)
    return replace(statement, boundary=boundary)
