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

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.statement.statement import INPUTS, Block, Statement
from covocp.transcription.trajectory import Trajectory

SEED = 20
ALONG, AROUND, FAR = 8, 6, 12  # numbers of points
SPREAD = 0.3  # of the points around the trajectory, relative
DECADES = 2.0  # magnitudes of the far points, up and down from those of the trajectory and from 1
# Relative difference of two values of a function above which the functions differ: well above what another version or
# compiler changes, well below what another number in a problem does.
SAME = 1e-7
# The same relative to the median over the points, for what is left of a difference of large terms.
ROUNDOFF = 1e-12
SHOWN = 4  # differences that an error lists

TWO_SIDED = ("OP_LT", "OP_LE", "OP_EQ", "OP_NE", "OP_FMAX", "OP_FMIN")
ONE_SIDED = {
    "OP_FABS": (0,), "OP_FLOOR": (0,), "OP_CEIL": (0,), "OP_SIGN": (0,), "OP_IF_ELSE_ZERO": (1,), "OP_COPYSIGN": (1,),
    "OP_FMOD": (0, 1), "OP_REMAINDER": (0, 1),
}  # fmt: skip
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
    """

    casadi: str
    symbols: tuple[str, ...]
    numbers: Mapping[str, Annotated[Array, "some"]]
    points: Annotated[Array, "points any"]
    values: Mapping[str, Annotated[Array, "points any"]]
    switches: Annotated[Array, "points any"]
    tables: tuple[str, ...]

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One thing that differs: what, as it was and as it is."""

    what: str
    stored: str
    given: str


def fingerprint(statement: Statement, trajectory: Trajectory, parameters: Array) -> Fingerprint:
    """The fingerprint of a problem.

    Args:
        statement: the problem.
        trajectory: of its solution, for the points; what is not finite in it counts as zero.
        parameters: of the solution, stacked.
    """
    return _at(statement, _points(statement, trajectory, parameters))


def differences(stored: Fingerprint, statement: Statement, parameters: Array) -> list[Difference]:
    """What differs between a problem and the one that was solved; of symbols, the first only.

    Args:
        stored: of the problem that was solved.
        statement: the given problem.
        parameters: that were solved for: declared values that equal them or the stored ones are the same.
    """
    symbols = _symbols(statement)
    if stored.symbols != symbols or stored.points.shape[1] != sum(_sizes(statement)):
        return [Difference(what="the symbols", stored=", ".join(stored.symbols), given=", ".join(symbols))]
    given = _at(statement, stored.points)
    numbers = [
        entry
        for name, new in given.numbers.items()
        if (entry := _number_difference(name, stored.numbers.get(name), new, _solved_for(name, statement, parameters)))
    ]
    removed = set(stored.numbers) | set(stored.values)
    removed -= set(given.numbers) | set(given.values)
    numbers += [Difference(what=name, stored="there", given="not there") for name in sorted(removed)]
    found = [
        entry for name, new in given.values.items() if (entry := _value_difference(name, stored.values.get(name), new))
    ]
    both = numbers + found
    if not both and not _same_switches(stored.switches, given.switches):
        both = [Difference(what=SWITCHES, stored="at other places", given="the given ones")]
    return both


def unlike_text(stored: Fingerprint, statement: Statement) -> bool:
    """Whether tables or external functions were written otherwise by the same version of CasADi."""
    return stored.casadi == ca.CasadiMeta.version() and set(stored.tables) != set(_tables(statement))


def only_switches(found: list[Difference]) -> bool:
    """Whether nothing differs but where pieces of functions meet, at no point of which their values differ."""
    return [entry.what for entry in found] == [SWITCHES]


# --- points -----------------------------------------------------------------------------------------------------------


def _sizes(statement: Statement) -> tuple[int, ...]:
    """Lengths of the arguments in the order of `INPUTS`."""
    return statement.nx, statement.nu, statement.ne, 1, 1, statement.np


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
    along = np.nan_to_num(along, nan=0.0, posinf=0.0, neginf=0.0)
    size = np.abs(along).max(axis=0)
    size[size == 0] = 1.0
    random = np.random.default_rng(SEED)
    near = along[random.integers(rows.size, size=AROUND)]
    near = near * (1 + SPREAD * random.standard_normal(near.shape)) + SPREAD * size * random.standard_normal(near.shape)
    shape = (FAR, size.size)
    far = 10 ** random.uniform(-DECADES, DECADES, shape) * np.where(random.random(shape) < 0.5, size, 1.0)
    far[FAR // 3 :] *= random.choice([-1.0, 1.0], size=(FAR - FAR // 3, size.size))  # the others are positive
    nx, nu, ne = statement.nx, statement.nu, statement.ne
    times = slice(nx + nu + ne, nx + nu + ne + 2)
    near[:, times], far[:, times] = np.abs(near[:, times]), np.abs(far[:, times])
    return np.vstack([along, near, far])


def _evaluated(function: ca.Function, points: Array, sizes: tuple[int, ...]) -> list[Array]:
    """Outputs of a function at the points, (K, entries) each, columns stacked; NaN where it has no value."""
    ends = np.cumsum([0, *sizes]).tolist()
    columns = dict(zip(INPUTS, (points[:, i:j] for i, j in pairwise(ends)), strict=True))
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


# --- what is kept -----------------------------------------------------------------------------------------------------


def _at(statement: Statement, points: Array) -> Fingerprint:
    """The fingerprint with the values at these points."""
    sizes = _sizes(statement)
    values: dict[str, Array] = {}
    for function, parts in _functions(statement):
        outputs = _evaluated(function, points, sizes)
        for name, (output, entries) in parts.items():
            chosen = outputs[output][:, entries]
            if chosen.shape[1]:
                values[name] = chosen
    operands = [_operands(function) for function in _switching(statement)]
    rows = [_evaluated(f, points, sizes)[0] for f in operands if f is not None]
    switches = np.abs(np.hstack([np.zeros((points.shape[0], 0)), *rows]))
    return Fingerprint(
        casadi=ca.CasadiMeta.version(),
        symbols=_symbols(statement),
        numbers=dict(_numbers(statement)),
        points=points,
        values=values,
        switches=np.unique(switches, axis=1) if switches.shape[1] else switches,
        tables=_tables(statement),
    )


def _symbols(statement: Statement) -> tuple[str, ...]:
    blocks = [f"{b.kind} {b.name} ({b.size})" for b in (*statement.blocks, *statement.measurements)]
    return (*blocks, *(f"estimated {name}" for name in statement.augmented))


def _numbers(statement: Statement) -> Iterator[tuple[str, Array]]:
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
    for block in _constants(statement):
        yield _declared(block), statement.values[block.span]
    for data in statement.data:
        yield f"the times of the data '{data.name}'", data.times
        yield f"the values of the data '{data.name}'", data.values.ravel()


def _constants(statement: Statement) -> tuple[Block, ...]:
    return (*statement.of_kind("parameter"), *statement.of_kind("unknown"))


def _declared(block: Block) -> str:
    return f"the {'mean' if block.kind == 'unknown' else 'value'} of '{block.name}'"


def _functions(statement: Statement) -> Iterator[tuple[ca.Function, dict[str, tuple[int, Any]]]]:
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
        yield st.measurement, _measurement_parts(st)
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


def _measurement_parts(st: Statement) -> dict[str, tuple[int, Any]]:
    """What is measured, and the density of its noise, by measurement."""
    rows = sum(block.length for block in st.measurements)
    parts: dict[str, tuple[int, Any]] = {f"the measurement '{b.name}'": (0, b.span) for b in st.measurements}
    for b in st.measurements:
        parts[f"the noise of the measurement '{b.name}'"] = (2, slice(b.span.start * rows, b.span.stop * rows))
    return parts


def _noise_parts(st: Statement) -> dict[str, tuple[int, Any]]:
    """Columns of the process noise of the augmented state by its rows."""
    n = len(st.augmented)
    return {f"the process noise of '{name}'": (1, slice(i * n, i * n + n)) for i, name in enumerate(st.augmented)}


# --- where functions switch -------------------------------------------------------------------------------------------


def _switching(statement: Statement) -> list[ca.Function]:
    """The functions in which the user's own pieces are."""
    st = statement
    chosen = [st.rates, st.terminal, *(place.function for place in st.conditions)]
    chosen += [] if st.measurement is None else [st.measurement]
    return chosen + ([] if st.loop is None else [st.loop.running, st.loop.terminal])


def _operands(function: ca.Function) -> ca.Function | None:
    """What a function compares, rounds or chooses, as a function; None where it does nothing of the kind."""
    if not function.is_a("SXFunction"):
        return None
    two = {getattr(ca, name) for name in TWO_SIDED if hasattr(ca, name)}
    one = {getattr(ca, name): places for name, places in ONE_SIDED.items() if hasattr(ca, name)}
    codes = [function.instruction_id(k) for k in range(function.n_instructions())]
    marked = [k for k, code in enumerate(codes) if code in two or code in one]
    if not marked:
        return None
    expressions: Any = function.instructions_sx()
    operands = []
    for k in marked:
        node = expressions[k]
        if codes[k] in two:
            operands.append(node.dep(0) - node.dep(1))
        else:
            operands += [node.dep(i) for i in one[codes[k]]]
    arguments: Any = function.sx_in()
    names = [function.name_in(i) for i in range(function.n_in())]
    return ca.Function("operands", arguments, [ca.vertcat(*operands)], names, ["operands"])


def _tables(statement: Statement) -> tuple[str, ...]:
    """Digests of the functions inside others that have no expressions: tables, external functions."""
    found = set()
    for function in _switching(statement):
        for inner in function.find_functions():
            if not inner.is_a("SXFunction") and not inner.is_a("MXFunction"):
                found.add(_digest(inner))
    return tuple(sorted(found))


def _digest(function: ca.Function) -> str:
    try:
        text = function.serialize()
    except RuntimeError:  # a callback cannot be written
        text = function.class_name()
    return hashlib.sha256(text.encode()).hexdigest()


# --- comparison -------------------------------------------------------------------------------------------------------


def _solved_for(name: str, statement: Statement, parameters: Array) -> Array | None:
    """The value that was solved for, of a parameter or a mean by the name of its declaration."""
    return next((parameters[b.span] for b in _constants(statement) if _declared(b) == name), None)


def _number_difference(name: str, old: Array | None, new: Array, solved: Array | None) -> Difference | None:
    if old is None:
        return Difference(what=name, stored="not there", given=_shown(new))
    if any(known is not None and np.array_equal(known, new, equal_nan=True) for known in (old, solved)):
        return None
    if name == "the duration" and math.isclose(float(old[0]), float(new[0])):
        return None
    return Difference(what=name, stored=_shown(old), given=_shown(new))


def _value_difference(name: str, old: Array | None, new: Array) -> Difference | None:
    if old is None or old.shape != new.shape:
        return Difference(what=name, stored="not there" if old is None else "of other rows", given="there")
    apart = _apart(old, new)
    if not apart.any():
        return None
    row, entry = np.argwhere(apart)[0]
    return Difference(what=name, stored=_one(old[row, entry]), given=_one(new[row, entry]))


def _apart(old: Array, new: Array) -> Any:
    """Where values at the points differ, (K, entries)."""
    finite = np.isfinite(old)
    size = np.where(finite, np.abs(old), 0.0)
    allowed = SAME * size + ROUNDOFF * np.median(size, axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        far = np.abs(np.where(finite, new - old, 0.0)) > allowed
    return (finite != np.isfinite(new)) | far


def _same_switches(old: Array, new: Array) -> bool:
    """Whether each operand of the one is an operand of the other, in any order and number."""

    def within(some: Array, others: Array) -> bool:
        for column in some.T:
            alike = ~_apart(np.tile(column[:, None], others.shape[1]), others).any(axis=0)
            if not alike.any():
                return False
        return True

    return old.shape[0] == new.shape[0] and within(old, new) and within(new, old)


def _shown(values: Array) -> str:
    """A few numbers."""
    return _one(values[0]) if values.size == 1 else "[" + ", ".join(_one(v) for v in values[:SHOWN]) + "]"


def _one(value: float) -> str:
    return "free" if np.isnan(value) else f"{value:.9g}"
