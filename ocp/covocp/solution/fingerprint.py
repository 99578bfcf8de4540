"""What tells one problem from another: its numbers, names, and the values of its functions at points kept with them.

Expressions are compared by what they compute, not by how they are written: the order in which symbols are made, a
rewritten formula or another version of CasADi change the text of an expression and not the problem. The points lie
along the solution that the fingerprint belongs to, around it, and far from it with magnitudes over four decades and
both signs; two different analytic functions do not agree at all of them. Pieces of a function that no point reaches
(`if_else`, `fmax`, |x|, `floor`) are caught by their own operands, which are evaluated at the same points whether or
not they come into effect. Tables and external functions show no operands: they are compared at the points, and by what
CasADi writes of them, where a difference alone is a warning.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.digests import sha256
from covocp.base.matrices import Array
from covocp.base.pieces import operands_of
from covocp.base.short_repr import short_repr
from covocp.solution.meaning import ADDED, MAIN, Aspect, constants, declared
from covocp.solution.points import ALONG, apart, evaluated, one_number, same_columns, shown, spread_points
from covocp.statement.statement import INPUTS, Statement
from covocp.transcription.trajectory import Trajectory

SWITCHES = "the places where the equations switch (if_else, fmax, |x|, ...)"


@dataclass(frozen=True, kw_only=True)
class Fingerprint:
    """Of a statement, as plain data.

    Attributes:
        casadi: the version that evaluated the functions.
        symbols: kind, name and size of each symbol in their order, and the rows of the augmented state.
        numbers: exact ones by what they are, such as "the upper bound of 'u'"; NaN where something is free.
        points: arguments of the functions, a row each in the order of `INPUTS`.
        values: of each function at the points by what it is, such as "the terminal cost", (K, entries).
        switches: what decides where the functions switch, and what they switch to, at the points, (K, operands).
        tables: digests of the functions that show no operands.
        words: what is told in words by what it is, such as "the unit of the measurement 'm'".
        aspects: what it knows beside what every fingerprint does, by the names of `ADDED`; of other aspects nothing is
            compared.
    """

    casadi: str
    symbols: tuple[str, ...]
    numbers: Mapping[str, Annotated[Array, "some"]]
    points: Annotated[Array, "points any"]
    values: Mapping[str, Annotated[Array, "points any"]]
    switches: Annotated[Array, "points any"]
    tables: tuple[str, ...]
    words: Mapping[str, str] = field(default_factory=dict)
    aspects: tuple[str, ...] = ()

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One thing that differs: what, as it was and as it is."""

    what: str
    stored: str
    given: str


def fingerprint(
    statement: Statement, trajectory: Trajectory, parameters: Array, aspects: tuple[str, ...] = tuple(ADDED)
) -> Fingerprint:
    """The fingerprint of a problem.

    Args:
        statement: the problem.
        trajectory: of its solution, for the points; what is not finite in it counts as zero.
        parameters: of the solution, stacked.
        aspects: what it is to know, by the names of `ADDED`.
    """
    return _at(statement, _points(statement, trajectory, parameters), aspects)


def differences(stored: Fingerprint, statement: Statement, parameters: Array) -> list[Difference]:
    """What differs between a problem and the one that was solved; of symbols, the first only.

    Args:
        stored: of the problem that was solved.
        statement: the given problem.
        parameters: that were solved for: declared values that equal them or the stored ones are the same.
    """
    own = _symbols(statement, _compared(stored.aspects))
    if stored.symbols != own or stored.points.shape[1] != sum(_sizes(statement).values()):
        return [Difference(what="the symbols", stored=", ".join(stored.symbols), given=", ".join(own))]
    given = _at(statement, stored.points, stored.aspects)
    words = [
        Difference(what=name, stored=stored.words.get(name, "not there"), given=new)
        for name, new in given.words.items()
        if stored.words.get(name) != new
    ]
    numbers = [
        entry
        for name, new in given.numbers.items()
        if (entry := _number_difference(name, stored.numbers.get(name), new, _solved_for(name, statement, parameters)))
    ]
    removed = {*stored.words, *stored.numbers, *stored.values} - {*given.words, *given.numbers, *given.values}
    numbers += [Difference(what=name, stored="there", given="not there") for name in sorted(removed)]
    found = [
        entry for name, new in given.values.items() if (entry := _value_difference(name, stored.values.get(name), new))
    ]
    both = words + numbers + found
    if not both and not same_columns(stored.switches, given.switches):
        both = [Difference(what=SWITCHES, stored="at other places", given="the given ones")]
    return both


def unlike_text(stored: Fingerprint, statement: Statement) -> bool:
    """Whether tables or external functions were written otherwise by the same version of CasADi."""
    known = set(_tables(statement, _compared(stored.aspects)))
    return stored.casadi == ca.CasadiMeta.version() and set(stored.tables) != known


def not_compared(stored: Fingerprint, statement: Statement) -> list[str]:
    """What a problem says of which a fingerprint knows nothing, in words: it was made when this was not kept."""
    missing = [aspect for name, aspect in ADDED.items() if name not in stored.aspects]
    return [aspect.name for aspect in missing if aspect.told and aspect.stated(statement)]


def only_switches(found: list[Difference]) -> bool:
    """Whether nothing differs but where pieces of functions meet, at no point of which their values differ."""
    return [entry.what for entry in found] == [SWITCHES]


# --- points -----------------------------------------------------------------------------------------------------------


def _sizes(statement: Statement) -> dict[str, int]:
    """Lengths of the arguments by their names."""
    lengths = (statement.nx, statement.nu, statement.ne, 1, 1, statement.np)
    return dict(zip(INPUTS, lengths, strict=True))


def _points(statement: Statement, trajectory: Trajectory, parameters: Array) -> Array:
    """Along the trajectory, around it, and far from it; (K, length of all arguments)."""
    count, last = trajectory.x.shape[0], trajectory.u.shape[0] - 1
    rows = np.unique(np.linspace(0, count - 1, ALONG).round().astype(int))
    duration = np.full((rows.size, 1), trajectory.duration if math.isfinite(trajectory.duration) else 0.0)
    along = np.hstack(
        [
            trajectory.x[rows],
            trajectory.u[np.minimum(rows, last)],
            trajectory.e[rows],
            rows[:, None] / max(count - 1, 1) * duration,
            duration,
            np.tile(parameters, (rows.size, 1)),
        ]
    )
    nx, nu, ne = statement.nx, statement.nu, statement.ne
    return spread_points(along, slice(nx + nu + ne, nx + nu + ne + 2))


# --- what is kept -----------------------------------------------------------------------------------------------------


def _compared(aspects: tuple[str, ...]) -> list[Aspect]:
    """What is compared where the aspects of these names are known."""
    return [MAIN, *(aspect for name, aspect in ADDED.items() if name in aspects)]


def _at(statement: Statement, points: Array, aspects: tuple[str, ...]) -> Fingerprint:
    """The fingerprint of some aspects with the values at these points."""
    sizes, compared = _sizes(statement), _compared(aspects)
    values: dict[str, Array] = {}
    for function, parts in (entry for aspect in compared for entry in aspect.functions(statement)):
        outputs = evaluated(function, points, sizes)
        for name, (output, entries) in parts.items():
            chosen = outputs[output][:, entries]
            if chosen.shape[1]:
                values[name] = chosen
    operands = [operands_of(function) for aspect in compared for function in aspect.pieces(statement)]
    rows = [evaluated(f, points, sizes)[0] for f in operands if f is not None]
    switches = np.abs(np.hstack([np.zeros((points.shape[0], 0)), *rows]))
    return Fingerprint(
        casadi=ca.CasadiMeta.version(),
        symbols=_symbols(statement, compared),
        numbers={name: value for aspect in compared for name, value in aspect.numbers(statement)},
        points=points,
        values=values,
        switches=np.unique(switches, axis=1) if switches.shape[1] else switches,
        tables=_tables(statement, compared),
        words={name: value for aspect in compared for name, value in aspect.words(statement)},
        aspects=aspects,
    )


def _symbols(statement: Statement, compared: list[Aspect]) -> tuple[str, ...]:
    return tuple(symbol for aspect in compared for symbol in aspect.symbols(statement))


def _tables(statement: Statement, compared: list[Aspect]) -> tuple[str, ...]:
    """Digests of the functions inside others that have no expressions: tables, external functions."""
    found = set()
    for function in (own for aspect in compared for own in aspect.pieces(statement)):
        for inner in function.find_functions():
            if not inner.is_a("SXFunction") and not inner.is_a("MXFunction"):
                found.add(_digest(inner))
    return tuple(sorted(found))


def _digest(function: ca.Function) -> str:
    try:
        text = function.serialize()
    except RuntimeError:  # a callback cannot be written
        text = function.class_name()
    return sha256(text.encode()).hexdigest()


# --- comparison -------------------------------------------------------------------------------------------------------


def _solved_for(name: str, statement: Statement, parameters: Array) -> Array | None:
    """The value that was solved for, of a parameter or a mean by the name of its declaration."""
    return next((parameters[b.span] for b in constants(statement) if declared(b) == name), None)


def _number_difference(name: str, old: Array | None, new: Array, solved: Array | None) -> Difference | None:
    if old is None:
        return Difference(what=name, stored="not there", given=shown(new))
    if any(known is not None and np.array_equal(known, new, equal_nan=True) for known in (old, solved)):
        return None
    if name == "the duration" and math.isclose(float(old[0]), float(new[0])):
        return None
    return Difference(what=name, stored=shown(old), given=shown(new))


def _value_difference(name: str, old: Array | None, new: Array) -> Difference | None:
    if old is None or old.shape != new.shape:
        return Difference(what=name, stored="not there" if old is None else "of other rows", given="there")
    differ = apart(old, new)
    if not differ.any():
        return None
    row, entry = np.argwhere(differ)[0]
    return Difference(what=name, stored=one_number(old[row, entry]), given=one_number(new[row, entry]))
