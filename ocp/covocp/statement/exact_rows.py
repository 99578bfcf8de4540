"""Rows of covariances that stay zero: a statement without them, for methods, and what belongs to the whole one.

A row of E vanishes for all times where it vanishes at the start, no noise enters it, and the rate of its state depends
on no state or unknown that is uncertain. With u the uncertain rows and e the others, F_eu = 0, and E(0) and Q have
entries in the block uu alone: so has E, by the Riccati equation and after every reading, and E_uu obeys them with F_uu,
Q_uu and W_uu.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, half_indices
from covocp.base.short_repr import short_repr
from covocp.statement.conditions import Inside
from covocp.statement.statement import Block, Conditions, Samples, Statement

# Statements whose rows are known.
KEPT = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class Carried:
    """A statement without the rows of its covariances that stay zero.

    entries: where its half-vectors lie among those of the whole statement. whole: how many these are.
    """

    statement: Statement
    entries: tuple[int, ...]
    whole: int

    __repr__ = short_repr

    def taken(self, values: Array) -> Array:
        """Of the half-vectors of the whole statement, the last axis, those that are carried; of none, none."""
        return values[..., list(self.entries)] if values.shape[-1] else values

    def filled(self, values: Array) -> Array:
        """Half-vectors of the whole statement from those that are carried, the last axis; of none, none."""
        if not values.shape[-1]:
            return values
        result = np.zeros((*values.shape[:-1], self.whole))
        result[..., list(self.entries)] = values
        return result


@lru_cache(maxsize=KEPT)
def carried(statement: Statement) -> Carried | None:
    """The statement without the rows of its covariances that stay zero; None where there are none.

    A closed loop keeps its rows: its feedback moves what is known exactly.
    """
    if statement.loop is not None or not statement.matrices:
        return None
    kept = [_carried_rows(statement, i) for i in range(len(statement.matrices))]
    if all(len(rows) == block.size for rows, block in zip(kept, statement.matrices, strict=True)):
        return None
    entries: list[int] = []
    blocks: dict[str, Block] = {}
    for block, rows in zip(statement.matrices, kept, strict=True):
        blocks[block.name] = replace(
            block, size=len(rows), offset=len(entries), labels=tuple(block.labels[row] for row in rows)
        )
        entries += [block.offset + k for k in _half_entries(block.size, rows)]
    return Carried(statement=_without(statement, kept, entries, blocks), entries=tuple(entries), whole=statement.ne)


def _carried_rows(statement: Statement, position: int) -> list[int]:
    """Rows of a matrix that may differ from zero; all of them where that is not known."""
    block, form = statement.matrices[position], statement.riccati[position]
    every = list(range(block.size))
    if not block.covariance or block.backward or form is None or statement.guesses.get(block.name) is not None:
        return every
    kind: Any = statement.symbolic
    sizes = (statement.nx, statement.nu, 1, 1, statement.np)
    F, Q, _ = (_pattern(value) for value in form(*(kind.sym(f"s{i}", size) for i, size in enumerate(sizes))))
    start = _started(statement, block)
    exact = {row for row in every if not start[row].any() and not Q[row].any()}
    while moved := {row for row in exact if any(F[row, column] for column in every if column not in exact)}:
        exact -= moved
    rows = [row for row in every if row not in exact]
    return rows or every


def _pattern(value: Any) -> Any:
    """Where a matrix may differ from zero, truth values."""
    sparse = ca.sparsify(value) if isinstance(value, ca.SX) else value
    return ca.DM(sparse.sparsity(), 1.0).full() != 0.0


def _started(statement: Statement, block: Block) -> Any:
    """Where a matrix may differ from zero at the start, or has a final value; truth values of shape (n, n)."""
    _, _, first, last = statement.boundary_values(statement.values)
    half = (first != 0.0) | ~np.isnan(last)  # NaN, what is free or decided, differs
    half[statement.boundary.jac_sparsity(2, 0).row()] = True
    half[list(() if statement.tied is None else statement.tied.matrices)] = True
    result = np.zeros((block.size, block.size), dtype=bool)
    rows, columns = half_indices(block.size)
    result[rows, columns] = result[columns, rows] = half[block.span]
    return result


def _half_entries(size: int, kept: list[int]) -> list[int]:
    """Entries of the half-vector of a matrix that belong to some of its rows."""
    return [k for k, (i, j) in enumerate(zip(*half_indices(size), strict=True)) if i in kept and j in kept]


def _without(statement: Statement, kept: list[list[int]], entries: list[int], blocks: dict[str, Block]) -> Statement:
    """The statement whose matrices have these blocks."""
    cut = _Cut(statement, entries)
    estimated = next((rows for rows, b in zip(kept, statement.matrices, strict=True) if b.estimation), None)
    rows = list(range(len(statement.augmented))) if estimated is None else estimated
    measurement = statement.measurement and cut.of(statement.measurement, (None, (None, rows), None))
    tied, samples = statement.tied, statement.samples
    if tied is not None:
        tied = replace(tied, matrices=tuple(entries.index(k) for k in tied.matrices))
    if samples is not None:
        samples = Samples(
            blocks=samples.blocks,
            places=samples.places,
            measurement=cut.of(samples.measurement, (None, (None, rows), None)),
            groups=samples.groups,
            update=cut.of(samples.update, ((entries, None), None)),
        )
    forms = tuple(
        form and cut.of(form, ((own, own), (own, own), (own, own)))
        for form, own in zip(statement.riccati, kept, strict=True)
    )
    return replace(
        statement,
        blocks=tuple(blocks.get(b.name, b) if b.kind == "matrix" else b for b in statement.blocks),
        rates=cut.of(statement.rates, (None, (entries, None), None)),
        terminal=cut.of(statement.terminal, (None,)),
        boundary=cut.of(statement.boundary, (None, None, (entries, None), (entries, None))),
        tied=tied,
        riccati=forms,
        measurement=measurement,
        samples=samples,
        path=cut.conditions(statement.path),
        start=cut.conditions(statement.start),
        end=cut.conditions(statement.end),
        inside=Inside(
            parts=tuple(replace(part, conditions=cut.conditions(part.conditions)) for part in statement.inside.parts)
        ),
        matrix_lower=statement.matrix_lower[entries],
        augmented=tuple(statement.augmented[row] for row in rows),
    )


class _Cut:
    """Functions of the statement with fewer half-vectors."""

    def __init__(self, statement: Statement, entries: list[int]) -> None:
        self._statement, self._entries = statement, entries

    def of(self, function: ca.Function, chosen: Iterable[tuple[Any, Any] | None]) -> ca.Function:
        """A function of fewer half-vectors, the others zero, with some rows and columns of its outputs; None: all."""
        names = function.name_in()
        plain = function.is_a("SXFunction")
        kind: Any = ca.SX if plain else ca.MX
        inputs, given = [], []
        for i, name in enumerate(names):
            size = len(self._entries) if name == "matrices" else function.size1_in(i)
            inputs.append(kind.sym(name, size))
            given.append(self._whole(inputs[-1], kind) if name == "matrices" else inputs[-1])
        outputs = function.call(given, True, False)
        for i, pair in enumerate(chosen):
            if pair is not None:
                rows, columns = (slice(None) if own is None else own for own in pair)
                outputs[i] = outputs[i][rows, columns]
        return ca.Function(function.name(), inputs, outputs, names, function.name_out())

    def conditions(self, own: Conditions) -> Conditions:
        """Conditions of fewer half-vectors."""
        realised = own.realised and self.of(own.realised, (None,))
        scattered = own.scattered and self.of(own.scattered, (None,))
        return replace(own, function=self.of(own.function, (None,)), realised=realised, scattered=scattered)

    def _whole(self, half: Any, kind: Any) -> Any:
        """All half-vectors from those that are carried."""
        rows = [kind(0.0)] * self._statement.ne
        for k, entry in zip(self._entries, ca.vertsplit(half), strict=True):
            rows[k] = entry
        return ca.vertcat(*rows)
