"""What a statement says, entry by entry and in words: that by which one problem is told from another.

Not among the entries is what follows from others (rates without costs, Riccati forms, gains of measurements, what the
statement knows of its own structure), and what is no part of a problem (guesses, scales).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.pieces import expanded, operands_of
from covocp.base.short_repr import short_repr
from covocp.statement.chances import ChanceLimits
from covocp.statement.statement import Block, Statement

SAMPLED = "measurements at instants"
# Functions, and what their outputs (or entries of them) are called.
Functions = Iterator[tuple[ca.Function, dict[str, tuple[int, Any]]]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Aspect:
    """One side of what a statement says.

    Attributes:
        name: of it, as files that know it list it and a warning calls what a file does not know; the side that all
            files know has none.
        symbols: kind, name and size of each.
        numbers: exact ones by what they are.
        functions: by what their outputs are.
        words: by what they are.
        pieces: the functions in which the user's own pieces are.
        told: whether a warning says that a file does not know it; not of what no equation depends on.
    """

    name: str
    symbols: Callable[[Statement], Iterator[str]] = lambda _: iter(())
    numbers: Callable[[Statement], Iterator[tuple[str, Array]]] = lambda _: iter(())
    functions: Callable[[Statement], Functions] = lambda _: iter(())
    words: Callable[[Statement], Iterator[tuple[str, str]]] = lambda _: iter(())
    pieces: Callable[[Statement], Sequence[ca.Function]] = lambda _: ()
    told: bool = True

    __repr__ = short_repr

    def stated(self, statement: Statement) -> bool:
        """Whether a statement says anything of it."""
        own = (self.numbers(statement), self.functions(statement), self.words(statement), iter(self.pieces(statement)))
        return any(next(entries, None) is not None for entries in own)


def _main_symbols(statement: Statement) -> Iterator[str]:
    """All symbols in their order, and the rows of the augmented state."""
    yield from (f"{b.kind} {b.name} ({b.size})" for b in (*statement.blocks, *statement.measurements))
    yield from (f"estimated {name}" for name in statement.augmented)


def _main_numbers(statement: Statement) -> Iterator[tuple[str, Array]]:
    """Exact numbers: duration, bounds, limits, values that were declared."""
    duration = statement.duration
    if duration.free:
        yield "the bounds of the duration", np.array([duration.lower, duration.upper])
    else:
        yield "the duration", np.array([duration.guess])
    groups = (
        (statement.state_names, statement.state_bounds),
        (statement.control_names, statement.control_bounds),
        (statement.matrix_names, (statement.matrix_lower, np.full(statement.ne, np.inf))),
    )
    for names, bounds in groups:
        for side, limits in zip(("lower", "upper"), bounds, strict=True):
            for name, value in zip(names, limits, strict=True):
                yield f"the {side} bound of '{name}'", np.array([value])
    for place in statement.conditions:
        for name, lower, upper in zip(place.names, place.lower, place.upper, strict=True):
            yield f"the limits of '{name}'", np.array([lower, upper])
    for part in statement.inside.parts:
        for name in part.conditions.names:
            yield f"the instant of '{name}'", np.array([part.place, float(part.late)])
    for block in constants(statement):
        yield declared(block), statement.values[block.span]
    for data in statement.data:
        yield f"the times of the data '{data.name}'", data.times
        yield f"the values of the data '{data.name}'", data.values.ravel()


def constants(statement: Statement) -> tuple[Block, ...]:
    """The known numbers and the means of the unknowns."""
    return (*statement.of_kind("parameter"), *statement.of_kind("unknown"))


def declared(block: Block) -> str:
    """What the value of a parameter or an unknown is called."""
    return f"the {'mean' if block.kind == 'unknown' else 'value'} of '{block.name}'"


def _main_functions(statement: Statement) -> Functions:
    """Every function that says something of a problem, and what its outputs (or entries of them) are called."""
    st = statement
    yield st.boundary, _boundary_parts(st)
    if st.tied is not None:
        groups = ((0, st.tied.states, st.state_names), (1, st.tied.matrices, st.matrix_names))
        yield (
            st.tied.function,
            {
                f"the initial value of '{names[k]}'": (output, slice(i, i + 1))
                for output, entries, names in groups
                for i, k in enumerate(entries)
            },
        )
    if st.loop is not None:
        yield st.loop.running, {"the running cost": (0, slice(None))}
        terms = {"the terminal cost": (0, slice(None)), "the weight of the deviations at the end": (1, slice(None))}
        yield st.loop.terminal, terms
        yield (
            st.loop.expansion,
            {
                "the weights of the deviations on the way": (2, slice(None)),
                "the weight of the fed-back control": (3, slice(None)),
                "the cross weight of state and control": (4, slice(None)),
            },
        )
        yield st.loop.gain, {"the feedback gain": (0, slice(None))}
    expected = "expected " if st.loop is not None else ""
    yield st.terminal, {f"the {expected}terminal cost": (0, slice(None))}
    if st.measurement is not None:
        yield st.measurement, _measurement_parts(st.measurements)
    for block, form in zip(st.matrices, st.riccati, strict=True):
        if block.estimation and form is not None:
            yield form, _noise_parts(st)
    yield (
        st.rates,
        {
            **{f"the rate of '{b.name}'": (0, b.span) for b in st.states},
            **{f"the rate of '{b.name}'": (1, b.span) for b in st.matrices},
            f"the {expected}running cost": (2, slice(None)),
        },
    )
    if st.matrix_end is not None:
        yield st.matrix_end, {"the values at the end of the matrices that run backward": (0, slice(None))}
    for place in st.conditions:
        yield place.function, {f"the constraint '{name}'": (0, slice(i, i + 1)) for i, name in enumerate(place.names)}


def _boundary_parts(st: Statement) -> dict[str, tuple[int, Any]]:
    """Initial and final values, entry by entry."""
    groups = (
        ("initial", 0, st.state_names),
        ("final", 1, st.state_names),
        ("initial", 2, st.matrix_names),
        ("final", 3, st.matrix_names),
    )
    return {
        f"the {end} value of '{name}'": (output, slice(i, i + 1))
        for end, output, names in groups
        for i, name in enumerate(names)
    }


def _measurement_parts(measurements: Sequence[Block]) -> dict[str, tuple[int, Any]]:
    """What is measured, and the density or the variance of its noise, by measurement."""
    rows = sum(block.length for block in measurements)
    parts: dict[str, tuple[int, Any]] = {f"the measurement '{b.name}'": (0, b.span) for b in measurements}
    for b in measurements:
        parts[f"the noise of the measurement '{b.name}'"] = (2, slice(b.span.start * rows, b.span.stop * rows))
    return parts


def _noise_parts(st: Statement) -> dict[str, tuple[int, Any]]:
    """Columns of the process noise of the augmented state by its rows."""
    n = len(st.augmented)
    return {f"the process noise of '{name}'": (1, slice(i * n, i * n + n)) for i, name in enumerate(st.augmented)}


def _main_pieces(statement: Statement) -> list[ca.Function]:
    """The functions in which the user's own pieces are."""
    st = statement
    chosen = [st.rates, st.terminal, *(place.function for place in st.conditions)]
    chosen += [] if st.measurement is None else [st.measurement]
    return chosen + ([] if st.loop is None else [st.loop.running, st.loop.terminal])


# --- what files did not always keep -----------------------------------------------------------------------------------


def _sampled_symbols(statement: Statement) -> Iterator[str]:
    if statement.samples is not None:
        yield from (f"{b.kind} {b.name} ({b.size}) at instants" for b in statement.samples.blocks)


def _sampled_numbers(statement: Statement) -> Iterator[tuple[str, Array]]:
    if statement.samples is not None:
        for block, places in zip(statement.samples.blocks, statement.samples.places, strict=True):
            yield f"the instants (shares of the duration) of the measurement '{block.name}'", np.array(places)


def _sampled_functions(statement: Statement) -> Functions:
    if statement.samples is not None:
        yield statement.samples.measurement, _measurement_parts(statement.samples.blocks)


def _sampled_pieces(statement: Statement) -> tuple[ca.Function, ...]:
    return () if statement.samples is None else (statement.samples.measurement,)


def _chance_numbers(statement: Statement) -> Iterator[tuple[str, Array]]:
    for chance in statement.chances:
        yield f"the probability of '{chance.name}'", np.array([chance.probability])
        for name, lower, upper in zip(chance.names, chance.lower, chance.upper, strict=True):
            yield f"the limits in probability of '{name}'", np.array([lower, upper])


def _chance_words(statement: Statement) -> Iterator[tuple[str, str]]:
    for chance in statement.chances:
        yield f"the rows of '{chance.name}'", "joint" if chance.joint else "each for itself"


def _chance_functions(statement: Statement) -> Functions:
    for chance in statement.chances:
        yield chance.function, _chance_parts(chance)


def _chance_parts(chance: ChanceLimits) -> dict[str, tuple[int, Any]]:
    return {f"the value in probability of '{name}'": (0, slice(i, i + 1)) for i, name in enumerate(chance.names)}


def _between_numbers(statement: Statement) -> Iterator[tuple[str, Array]]:
    for place in statement.conditions:
        for name, between in zip(place.names, place.between, strict=False):
            if between:
                yield f"what '{name}' says between the nodes", np.ones(1)


def _range_numbers(statement: Statement) -> Iterator[tuple[str, Array]]:
    """The outermost knots of each table, each pair once."""
    tables = statement.tables
    if tables is not None:
        for name in dict.fromkeys(tables.names):
            rows = [k for k, other in enumerate(tables.names) if other == name]
            ends = sorted({(float(tables.lower[k]), float(tables.upper[k])) for k in rows})
            yield f"the range of {name}", np.array(ends).ravel()


def _initial_pieces(statement: Statement) -> tuple[ca.Function, ...]:
    """The functions of initial and final values where these have pieces.

    Not those of attitudes, which have one that chooses between q and -q by the guess.
    """
    if not statement.geometry.plain:
        return ()
    functions = [statement.boundary, *([] if statement.tied is None else [statement.tied.function])]
    return tuple(own for own in map(expanded, functions) if operands_of(own) is not None)


def _labels(statement: Statement) -> Iterator[tuple[str, str]]:
    """What numbers are called and how they are laid out, on which the equations do not depend."""
    sampled = () if statement.samples is None else statement.samples.blocks
    for block in (*statement.measurements, *sampled):
        yield f"the unit of the measurement '{block.name}'", block.unit or "none"
    for data in statement.data:
        yield f"the unit of the data '{data.name}'", data.unit or "none"
        yield f"the interpolation of the data '{data.name}'", data.kind
    for name, (rows, columns) in statement.matrix_parameters.items():
        yield f"the shape of '{name}'", f"({rows}, {columns})"


MAIN = Aspect(name="", symbols=_main_symbols, numbers=_main_numbers, functions=_main_functions, pieces=_main_pieces)
# Those that were not kept from the first on, by name.
ADDED = {
    aspect.name: aspect
    for aspect in (
        Aspect(
            name=SAMPLED,
            symbols=_sampled_symbols,
            numbers=_sampled_numbers,
            functions=_sampled_functions,
            pieces=_sampled_pieces,
        ),
        Aspect(
            name="probabilities of chance conditions",
            numbers=_chance_numbers,
            functions=_chance_functions,
            words=_chance_words,
        ),
        Aspect(name="constraints between the nodes", numbers=_between_numbers),
        Aspect(name="ranges of tables", numbers=_range_numbers),
        Aspect(name="pieces of initial values", pieces=_initial_pieces),
        Aspect(name="units, interpolations and shapes", words=_labels, told=False),
    )
}
