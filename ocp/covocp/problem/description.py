"""What print(problem) shows, and a notebook: what is declared, and its equations in the user's names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, half_indices
from covocp.base.normal import shown_probability
from covocp.base.pages import Part, Section, Sentence, Table, number
from covocp.problem.closed_loop_covariance import SPREAD, reasons
from covocp.problem.decisions import decisions_of
from covocp.problem.declarations import Chance, Constraint
from covocp.problem.formulas import formulas
from covocp.problem.integrals import integrals_of
from covocp.statement.entries import entries_of, entry_names, half_names
from covocp.statement.time_data import in_words

if TYPE_CHECKING:
    from covocp.problem.declared import Declared

# Entries of a vector or a matrix that are shown one by one, at most.
MOST_ENTRIES = 24
# Instants of a measurement that are listed.
MOST_INSTANTS = 4
FREE = "free"
FILTER = "F E + E F' + Q"
UPDATE = " - E M' U^-1 M E"


def sections(problem: Declared) -> list[Section]:
    """A problem, complete or not, in sentences and tables.

    Args:
        problem: as it is so far.

    Returns:
        Name and duration, symbols with their data, rates and measurements with their noise, cost, constraints, and what
        the names of intermediate results in them stand for.
    """
    written = _Written.of(problem)
    parts: list[Section] = [
        _head(problem),
        _states(problem, written),
        _decisions(problem),
        _unknowns(problem, written),
        _values("parameter", [(q, [number(v) for v in q.value]) for q in problem.parameters], "value"),
        _values("control", [(q, _ranges(q.lower, q.upper)) for q in problem.controls], "bounds"),
        _matrices(problem, written),
        _data(problem),
        _rates(problem, written),
        _integrals(problem, written),
        _measurements(problem, written),
        _cost(problem, written),
        _constraints(problem, written),
    ]
    where = [[name, f"= {text}"] for name, text in written.definitions]
    return [*parts, _table(["where", ""], where, code=(0, 1))]


@dataclass(frozen=True)
class _Written:
    """The formulas of the expressions of a problem, by what they are of: entries, column by column."""

    entries: dict[tuple[str, str], tuple[str, ...]]
    definitions: tuple[tuple[str, str], ...]

    @staticmethod
    def of(problem: Declared) -> _Written:
        """Data and equations have names of intermediate results in common."""
        expressions = dict(_expressions(problem))
        vectors: list[Any] = [*problem.states, *problem.unknowns, *problem.parameters, *problem.controls]
        symbols = [entry.symbol for entry in vectors] + [matrix.symbol for matrix in problem.matrices]
        names = [entry_names((q,)) for q in vectors] + [entries_of(q) for q in problem.matrices]
        spread = problem.declarations.spread
        if spread is not None:
            symbols, names = [*symbols, spread.symbol], [*names, half_names(spread.name, spread.labels)]
        symbols, names = [*symbols, problem.time], [*names, ["time"]]
        if problem.free_duration is not None:
            symbols, names = [*symbols, problem.declarations.duration], [*names, ["duration"]]
        data = problem.declarations.data
        called, plain = in_words((entry.course for entry in data), list(expressions.values()))
        found = formulas(called, [*symbols, *plain], [*names, *(entry_names((entry,)) for entry in data)])
        return _Written(entries=dict(zip(expressions, found.entries, strict=True)), definitions=found.definitions)

    def __call__(self, kind: str, name: str = "") -> list[str]:
        """The entries of an expression."""
        return list(self.entries[kind, name])

    def diagonal(self, kind: str, name: str) -> list[str]:
        """Of a square matrix the entries of the diagonal, or whole rows in brackets where there are others."""
        entries = self.entries[kind, name]
        size = round(len(entries) ** 0.5)
        rows = [[entries[i + size * j] for j in range(size)] for i in range(size)]
        if all(entry == "0" for i, row in enumerate(rows) for j, entry in enumerate(row) if i != j):
            return ["" if row[i] == "0" else row[i] for i, row in enumerate(rows)]
        return [f"[{', '.join(row)}]" for row in rows]


def _expressions(problem: Declared) -> Iterator[tuple[tuple[str, str], Any]]:
    """All expressions of a problem by kind and name."""
    for state in problem.states:
        yield ("initial", state.name), state.initial
        yield ("final", state.name), state.final if state.target is None else state.target
        yield ("variance", state.name), state.variance
    for unknown in problem.unknowns:
        yield ("variance", unknown.name), unknown.variance
    for matrix in problem.matrices:
        for kind, value in (("initial", matrix.initial), ("final", matrix.final)):
            if value is not None:
                yield (kind, matrix.name), value
    for name, dynamics in problem.rates.items():
        yield ("rate", name), dynamics.rate
        if dynamics.noise is not None:
            yield ("noise", name), dynamics.noise
    for measurement in problem.measurements:
        yield ("measurement", measurement.name), measurement.expression
        stated = measurement.information is not None
        yield (
            ("information" if stated else "noise", measurement.name),
            measurement.information if stated else measurement.noise,
        )
    cost = (problem.expected.running, problem.expected.terminal) if problem.expected is not None else problem.cost
    if cost is not None:
        yield ("running", ""), cost[0]
        yield ("terminal", ""), cost[1]
    for what, weight in _weights(problem):
        if isinstance(weight, dict):
            yield from (((what, name), value) for name, value in weight.items())
    for constraint in problem.constraints:
        if constraint.chance is None:
            yield ("constraint", constraint.name), constraint.expression
    for chance in problem.chances:
        yield ("constraint", chance.name), chance.expression


def _table(columns: list[str], rows: list[list[str]], code: tuple[int, ...] = ()) -> Section:
    """A section of one table of words without the columns that are empty; an empty one where there are no rows."""
    kept = [j for j in range(len(columns)) if any(row[j] for row in rows)]
    places = tuple(new for new, j in enumerate(kept) if j in code)
    rows = [[row[j] for j in kept] for row in rows]
    heads = [columns[j] for j in kept]
    return [Table(columns=heads, rows=rows, words=tuple(range(len(kept))), code=places)] if rows else []


def _shortened(rows: list[list[str]]) -> list[list[str]]:
    """The first rows of many, and how many more there are."""
    if len(rows) <= MOST_ENTRIES:
        return rows
    return [*rows[:MOST_ENTRIES], [f"({len(rows) - MOST_ENTRIES} more)", *[""] * (len(rows[0]) - 1)]]


def _free(values: list[str]) -> list[str]:
    """Values at an end, where no number is none required; nothing where none is."""
    return [FREE if value == "nan" else value for value in values]


def _ranges(lower: Array, upper: Array) -> list[str]:
    """Bounds in words."""
    result = []
    for low, high in zip(np.ravel(lower), np.ravel(upper), strict=True):
        if np.isfinite(low) and np.isfinite(high):
            result.append(f"{number(low)} .. {number(high)}")
        else:
            result.append(
                f">= {number(low)}" if np.isfinite(low) else f"<= {number(high)}" if np.isfinite(high) else ""
            )
    return result


def _head(problem: Declared) -> Section:
    free = problem.free_duration
    duration = f"{number(problem.declarations.duration)} s" if free is None else f"free, {_ranges_of(free)}"
    return [Sentence(f"{problem.name or 'problem without a name'}: duration {duration}")]


def _ranges_of(free: Any) -> str:
    """Bounds and guess of a free duration."""
    upper = "" if np.isinf(free.upper) else f" and at most {number(free.upper)} s"
    return f"at least {number(free.lower)} s{upper}, guess {number(free.guess)} s"


def _states(problem: Declared, written: _Written) -> Section:
    rows = []
    for q in (state for state in problem.states if state.role == "moving"):
        initial, final = _free(written("initial", q.name)), _free(written("final", q.name))
        units = [q.unit if q.chart is None else ""] * q.size
        columns = (entry_names((q,)), units, initial, final, _ranges(q.lower, q.upper))
        variance = _filled(written.diagonal("variance", q.name), q.size)
        rows += _shortened([list(row) for row in zip(*columns, variance, strict=True)])
    return _table(["state", "unit", "at 0", "at T", "bounds", "variance at 0"], rows)


def _filled(cells: list[str], size: int) -> list[str]:
    """Cells of the errors of a state, which has more entries than errors where it is no vector."""
    return [*cells, *[""] * (size - len(cells))]


def _decisions(problem: Declared) -> Section:
    rows = []
    for q in decisions_of(problem.declarations):
        guess: Any = q.guess
        columns = (entry_names((q,)), [q.unit] * q.size, _ranges(q.lower, q.upper), [number(v) for v in guess])
        rows += _shortened([list(row) for row in zip(*columns, strict=True)])
    return _table(["decision", "unit", "bounds", "guess"], rows)


def _integrals(problem: Declared, written: _Written) -> Section:
    rows = [[q.name, q.unit, *written("rate", q.name)] for q in integrals_of(problem.declarations)]
    return _table(["integral", "unit", "of"], rows)


def _data(problem: Declared) -> Section:
    """Data over time: how many values, over which times, in which range."""
    rows = []
    for q in problem.declarations.data:
        times, values = q.course.times, q.course.values
        knots = f"{q.course.kind}, {times.size} values from {number(times[0])} to {number(times[-1])} s"
        spans = _ranges(values.min(axis=0), values.max(axis=0))
        rows += _shortened([[name, q.unit, knots, span] for name, span in zip(entry_names((q,)), spans, strict=True)])
    return _table(["data", "unit", "over time", "range"], rows)


def _unknowns(problem: Declared, written: _Written) -> Section:
    rows = []
    for q in problem.unknowns:
        columns = (entry_names((q,)), [q.unit] * q.size, [number(v) for v in q.mean])
        rows += _shortened([list(row) for row in zip(*columns, written.diagonal("variance", q.name), strict=True)])
    return _table(["unknown", "unit", "mean", "variance"], rows)


def _values(kind: str, entries: Sequence[tuple[Any, list[str]]], what: str) -> Section:
    """Vectors with one column of data."""
    rows = []
    for q, values in entries:
        rows += _shortened([list(row) for row in zip(entry_names((q,)), [q.unit] * q.size, values, strict=True)])
    return _table([kind, "unit", what], rows)


def _matrices(problem: Declared, written: _Written) -> Section:
    """Symmetric matrices: their entries; of large ones, and where the others are zero, those of the diagonal."""
    rows = []
    matrices = [matrix for matrix in problem.matrices if matrix.role == "moving"]
    for q in matrices:
        names = half_names(q.name, q.labels)
        ends = [
            _free(written(kind, q.name)) if value is not None else [FREE if kind == "initial" else ""] * len(names)
            for kind, value in (("initial", q.initial), ("final", q.final))
        ]
        diagonal = [i == j for i, j in zip(*half_indices(q.size), strict=True)]
        lower = [number(q.lower) if q.lower is not None and on and not q.estimation else "" for on in diagonal]
        own = [list(row) for row in zip(names, [q.unit] * len(names), *ends, lower, strict=True)]
        beside = {tuple(row[2:]) for row, on in zip(own, diagonal, strict=True) if not on}
        if len(own) > MOST_ENTRIES or beside <= {("0", "", ""), ("0", "0", ""), ("free", "", "")}:
            own = [row for row, on in zip(own, diagonal, strict=True) if on]
        rows += _shortened(own)
    kinds = dict.fromkeys("covariance" if q.covariance else "matrix" for q in matrices)
    return _table([" or ".join(kinds), "unit", "at 0", "at T", "lower bound"], rows)


def _rates(problem: Declared, written: _Written) -> Section:
    """Rates with the densities of their noise, and what the letters of the filter's mean."""
    rows, notes = [], list[Part]()
    for state in (q for q in problem.states if q.role == "moving"):
        given = problem.rates.get(state.name)
        rates = ["(not given yet)"] * state.size if given is None else written("rate", state.name)
        noise = [""] * state.size if given is None or given.noise is None else written.diagonal("noise", state.name)
        columns = (
            [f"d {name}/dt" for name in entry_names((state,))],
            [f"= {rate}" for rate in rates],
            _filled(noise, state.size),
        )
        rows += _shortened([list(row) for row in zip(*columns, strict=True)])
    for matrix in (q for q in problem.matrices if q.role == "moving"):
        if matrix.estimation:
            measured = bool(problem.measurements)
            rows.append([f"d {matrix.name}/dt", f"= {FILTER}{UPDATE if measured else ''}", ""])
            notes.append(_filter_note(matrix.labels, measured))
        else:
            given = problem.rates.get(matrix.name)
            own = [f"= {rate}" for rate in written("rate", matrix.name)] if given is not None else []
            names = [f"d {name}/dt" for name in half_names(matrix.name, matrix.labels)]
            filled = zip(names, own or ["= (not given yet)"] * len(names), strict=True)
            rows += _shortened([[*row, ""] for row in filled])
    return [*_table(["rate", "", "noise density"], rows, code=(0, 1)), *notes]


def _filter_note(labels: tuple[str, ...], measured: bool) -> Sentence:
    names = ", ".join(labels[:MOST_ENTRIES]) + (", ..." if len(labels) > MOST_ENTRIES else "")
    slopes = "F and M: slopes of rates and measurements" if measured else "F: slopes of the rates"
    return Sentence(f"{slopes} by {names}; Q{' and U' if measured else ''}: noise densities", "")


def _measurements(problem: Declared, written: _Written) -> Section:
    rows = []
    for q in problem.measurements:
        values = written("measurement", q.name)
        names = [q.name] if len(values) == 1 else [f"{q.name}[{i}]" for i in range(len(values))]
        kind = "noise" if q.information is None else "information"
        noise, empty = [entry or "0" for entry in written.diagonal(kind, q.name)], [""] * len(values)
        columns = (names, [q.unit] * len(values), [f"= {v}" for v in values])
        place = 2 if q.instants else 0 if kind == "noise" else 1
        kinds = [noise if k == place else empty for k in range(3)]
        taken = [_instants(problem, q.instants)] + [""] * (len(values) - 1)
        rows += _shortened([list(row) for row in zip(*columns, *kinds, taken, strict=True)])
    titles = ["measurement", "unit", "", "noise density", "inverse density", "noise variance", "taken"]
    return _table(titles, rows, code=(2,))


def _instants(problem: Declared, instants: tuple[float, ...]) -> str:
    """When a measurement is taken, in a few words."""
    if not instants:
        return ""
    free = problem.free_duration is not None
    times = np.array(instants) * (1.0 if free else float(problem.declarations.duration))
    unit = "T" if free else "s"
    if times.size > 1 and np.allclose(np.diff(times), times[0], rtol=1e-9):
        return f"every {times[0]:.4g} {unit}"
    listed = ", ".join(f"{time:.4g}" for time in times[:MOST_INSTANTS])
    return f"at {listed}{', ...' if times.size > MOST_INSTANTS else ''} {unit}"


def _weights(problem: Declared) -> list[tuple[str, Any]]:
    """The weights of an expected cost, by symbol or as they were given."""
    expected = problem.expected
    if expected is None:
        return []
    return [("weight of a miss", expected.terminal_weight), ("control weight", expected.control_weight)]


def _cost(problem: Declared, written: _Written) -> Section:
    if ("running", "") not in written.entries:
        return [Sentence("no cost yet: minimize() or minimize_expected()")]
    words = {"terminal": "at T", "running": "integral of"}
    rows = [[word, text] for kind, word in words.items() if (text := written(kind)[0]) != "0"]
    expected = problem.expected
    if expected is None:
        return _table(["minimise", ""], rows, code=(1,))
    for what, weight in _weights(problem):
        if isinstance(weight, dict):
            rows += [[f"{what} {name}", ", ".join(q or "0" for q in written.diagonal(what, name))] for name in weight]
        elif weight is not None:
            rows.append([what, " ".join(str(weight).split())])
    asked = reasons(problem.declarations)
    if expected.gain is not None:
        rows.append(["gain of the feedback", repr(expected.gain)])
    elif asked:
        rows.append(["gain of the feedback", f"free, for {SPREAD} in {', '.join(asked)}"])
    elif problem.declarations.spread is not None:
        rows.append(["gain of the feedback", f"the best one: {SPREAD} is in no condition, and in no nonlinear cost"])
    return _table(["minimise the expected", ""], rows, code=(1,))


def _constraints(problem: Declared, written: _Written) -> Section:
    rows = []
    places = {"path": "always", "initial": "at 0", "final": "at T"}
    for q in [*(c for c in problem.constraints if c.chance is None), *problem.chances]:
        own = []
        texts = written("constraint", q.name)
        for i, (text, low, high) in enumerate(zip(texts, q.lower, q.upper, strict=True)):
            name = q.name if len(texts) == 1 else f"{q.name}[{i}]"
            left = f"{number(low)} <= " if np.isfinite(low) and low != high else ""
            right = f" = {number(high)}" if low == high else f" <= {number(high)}" if np.isfinite(high) else ""
            if not right:
                left, right = "", f" >= {number(low)}"
            place = _moment(problem, q) if isinstance(q, Constraint) and q.instant is not None else places[q.at]
            place += ", between the nodes too" if getattr(q, "between", False) else ""
            own.append([name, place, f"{left}{text}{right}", ""])
            if isinstance(q, Chance):
                together = ", together" if q.joint else ""
                own[-1][3] = f"probability {shown_probability(q.probability)}{together}"
        rows += _shortened(own)
    return [*_table(["constraint", "", "", ""], rows, code=(2,)), *_chance_notes(problem)]


def _moment(problem: Declared, constraint: Constraint) -> str:
    """The instant at which a constraint holds, in a few words."""
    assert constraint.instant is not None
    free = problem.free_duration is not None
    time = constraint.instant * (1.0 if free else float(problem.duration))
    return f"at {number(time, 4)} {'T' if free else 's'}{'' if constraint.late else ', before'}"


def _chance_notes(problem: Declared) -> Section:
    """By which spread the probabilities are meant, and how several rows share their risk."""
    chances = problem.chances
    if not chances:
        return []
    if problem.expected is not None:
        spread = f"the covariance {SPREAD} = E + Xhat of the closed loop"
    elif problem.measurements:
        spread = f"the covariance {SPREAD} without feedback, d {SPREAD}/dt = {FILTER.replace('E', SPREAD)}: measuring"
        spread += " alone makes no system scatter less"
    else:
        spread = "E, as nothing is measured or fed back"
    text = f"Probabilities: by {spread}; to first order"
    text += ", at each time by itself" if any(q.at == "path" for q in chances) else ""
    joint = any(q.joint for q in chances)
    return [Sentence(text + ("; rows that hold together share the risk equally (Boole's bound)" if joint else ""), "")]
