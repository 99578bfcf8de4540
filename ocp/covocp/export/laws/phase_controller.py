"""Filter and feedback through several phases as one law, for any time between two steps.

Within a phase a step is that of its own controller, in the time of the phase. A step that reaches the end of a phase or
goes beyond it passes the junction: the estimate y of the deviation is predicted to the end with the control that is
held, goes on as J y, J the tangent of the jump along the nominal (zero for what appears: it starts at its mean), and
the later phase goes on from there. Of the controls the later phase holds those of the same name as they were, the
others as its nominal begins.

A reading stands for the time before it. A step exactly where two phases meet takes that of the earlier one, which ends
there, and gives out the control of the later one. A step across a junction takes that of the later phase, for the time
since it began; what the earlier phase would have measured after the last step is not known then.

A phase that measures nothing only predicts, and feeds back the estimate that came from before: what it is given as a
reading is ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import ExportError
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.export.laws.controller import ABOUT, HELD, STATUSES, about, first_fields, points, stepped, with_units
from covocp.export.laws.design import Design
from covocp.export.laws.history import History, clock
from covocp.export.laws.law import RETURNED, Law, Port, flat, span, status_of
from covocp.export.laws.limits import limit_constants, limits_notes, limits_text
from covocp.solution.phases import PhasesSolution
from covocp.statement.statement import entry_names

ABOUT_PHASES = (
    "Through several phases: estimate, control and measurement are those of the phase that the time is in, the first "
    "entries of arrays that have room for those of every phase. Where phases meet the estimate passes by the tangent "
    "of the jump; what appears there enters at its mean. Call it at these times too: such a step takes the measurement "
    "of the phase that ends and returns the control of the one that begins. A step across takes the measurement of the "
    "later phase, for the time since it began; until then the controls of the same name are held, the others those "
    "that the nominal of the later phase begins with.",
    "A time that is not valid does not lead out of the phase: the control returned is then the nominal one of the "
    "phase at that time or, outside of it, at its nearer end. Time, phase, estimate and control of the struct stay, "
    "so the next step computes what it would have computed without this one.",
)
FIELDS = ("estimate", "control", "nominal_state", "nominal_control", "feedback_gain", "filter_gain")


@dataclass(frozen=True, kw_only=True, eq=False)
class Leg:
    """A phase in a controller.

    part: its name in C. tangent: of the jump at its end, (n of the next one, n); None of the last phase.
    kept: controls of this phase that the next one has, as (row there, row here). begun: control where it begins.
    """

    design: Design
    tables: History
    name: str
    part: str
    start: float
    tangent: Array | None
    kept: tuple[tuple[int, int], ...]
    begun: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class _Room:
    """Sizes that are enough for every phase: estimate, control, measurement, state."""

    n: int
    m: int
    r: int
    nx: int

    __repr__ = short_repr

    @property
    def shapes(self) -> dict[str, tuple[int, int]]:
        """Of the fields."""
        n, m = self.n, self.m
        shapes = {"estimate": (n, 1), "control": (m, 1), "nominal_state": (self.nx, 1), "nominal_control": (m, 1)}
        return {**shapes, "feedback_gain": (m, n), "filter_gain": (n, self.r)}


def legs_of(
    solution: PhasesSolution, designs: list[Design], tables: list[History], parts: list[str], starts: Array
) -> tuple[Leg, ...]:
    """The phases of a controller.

    Args:
        solution: of the phases, with feedback.
        designs: their loops.
        tables: their nominals.
        parts: their names in C.
        starts: when they begin [s].
    """
    legs = []
    for k, (design, own) in enumerate(zip(designs, tables, strict=True)):
        m = design.sizes[1]
        tangent, kept = None, []
        if k < len(solution.links):
            later = designs[k + 1]
            names = later.statement.control_names[: later.sizes[1]]
            mine = design.statement.control_names[:m]
            kept = [(row, mine.index(name)) for row, name in enumerate(names) if name in mine]
            t, none = solution[k].trajectory, np.zeros((design.sizes[0],) * 2)
            function = solution.links[k].deviations
            assert function is not None
            given = (t.x[-1], t.e[-1], t.duration, solution[k].parameters, solution[k + 1].parameters, none)
            tangent = np.asarray(function(*given)[0].full())
        begun = np.clip(own.rows(np.zeros(1))[1][0, :m], *design.limits)
        legs.append(
            Leg(
                design=design,
                tables=own,
                name=solution[k].name,
                part=parts[k],
                start=float(starts[k]),
                tangent=tangent,
                kept=tuple(kept),
                begun=begun,
            )
        )
    return tuple(legs)


def check_first_readings(solution: PhasesSolution, designs: list[Design]) -> None:
    """Refuse what is read where a phase begins: a step there takes the reading of the phase before.

    Raises:
        ExportError: names the phase.
    """
    for phase, design in zip(solution, designs, strict=True):
        if design.reads_first:
            raise ExportError(
                f"Something is read where '{phase.name}' begins, which a controller through phases cannot take.",
                expected="instants after the start of each phase",
                received="one at its start",
                remedy="read it at the end of the phase before, or put it into the initial variance of the first phase",
            )


def phases_controller(legs: tuple[Leg, ...], duration: float, margin: float, tolerance: float) -> Law:
    """The law (estimate, last time, held control, measurement, time) -> control and all that the struct keeps.

    Args:
        legs: the phases.
        duration: of all of them [s].
        margin: share of it within which a time is that where two phases meet.
        tolerance: largest relative deviation.
    """
    room = _room(legs)
    return Law(
        name="step",
        kind="controller",
        about=(*about(legs[0].design, ABOUT), *ABOUT_PHASES, *_limits(legs)),
        notes=_notes(legs),
        constants=_constants(legs),
        core=_core(legs, room, duration, margin),
        inputs=_inputs(legs, room),
        outputs=_outputs(legs, room),
        statuses=STATUSES,
        held=HELD,
        returned=RETURNED,
        start=_first(legs[0], room),
        points=lambda random, count: _points(legs, room, duration, random, count),
        tolerance=tolerance,
    )


def _core(legs: tuple[Leg, ...], room: _Room, duration: float, margin: float) -> ca.Function:
    """(estimate, last, held, measurement, time) -> fields, control that is handed out, status."""
    y, last, held = ca.MX.sym("estimate", room.n), ca.MX.sym("last"), ca.MX.sym("held", room.m)
    measured, time = ca.MX.sym("measurement", room.r), ca.MX.sym("time")
    starts = [leg.start for leg in legs]
    now = clock(time, duration, margin, last)
    asked = now.time
    for start in starts[1:]:
        asked = ca.if_else(ca.fabs(asked - start) <= margin * duration, start, asked)
    backwards = asked < last
    valid = ca.if_else(backwards, 0.0, now.within)
    before, after = (sum((t >= start for start in starts[1:]), ca.MX(0)) for t in (last, asked))
    after = ca.if_else(valid, after, before)  # a time that is not valid must not lead out of the phase
    begun = ca.MX(ca.DM(starts))
    meets = ca.logic_and(asked == begun[after], before < after)
    at = ca.if_else(ca.logic_and(valid, before < after), 0.0, last - begun[before])
    own, kept, good, missing = y, held, ca.MX(1), ca.MX(0)
    for k, leg in enumerate(legs[:-1]):
        crosses = ca.logic_and(valid, ca.logic_and(before <= k, after > k))
        reads = ca.logic_and(meets, after == k + 1)
        since = ca.if_else(before == k, last - leg.start, 0.0)
        reading = ca.if_else(reads, measured, np.nan)
        across: Any = ca.Function.if_else(f"across_{k}", _crossing(leg, legs[k + 1], room), _staying(room))
        own, kept, fine, unread = across(crosses, own, since, kept, reading)
        good, missing = ca.logic_and(good, fine), ca.logic_or(missing, ca.logic_and(reads, unread))
    steps = [_step(leg, room) for leg in legs]
    which: Any = ca.Function.conditional("which", steps[:-1], steps[-1])
    inside = ca.fmin(ca.fmax(asked - begun[after], 0.0), ca.MX(ca.DM([leg.tables.duration for leg in legs]))[after])
    at = ca.fmin(at, ca.MX(ca.DM([leg.tables.duration for leg in legs]))[after])  # of a struct that was never set
    *fields, fine, unread = which(after, own, at, kept, ca.if_else(meets, np.nan, measured), inside, valid)
    found = dict(zip(FIELDS, fields, strict=True))
    good = ca.logic_and(good, fine)
    missing = ca.logic_or(missing, ca.logic_and(ca.logic_not(meets), unread))
    found["estimate"] = ca.if_else(valid, found["estimate"], y)
    conditions = [
        *now.conditions, (backwards, "TIME_BACKWARDS"), (ca.logic_not(good), "ESTIMATE_LOST"),
        (missing, "MEASUREMENT_MISSING"),
    ]  # fmt: skip
    given = found["control"]  # kept where the time is valid: the next step must not depend on one that is not
    found["control"] = ca.if_else(valid, given, held)
    outputs = [ca.if_else(valid, asked, last), after, *found.values(), given, status_of(conditions)]
    return ca.Function("step", [y, last, held, measured, time], outputs)


def _room(legs: tuple[Leg, ...]) -> _Room:
    """What is enough for all phases."""
    n, m, r = (max(leg.design.sizes[k] for leg in legs) for k in range(3))
    return _Room(n=n, m=m, r=r, nx=max(leg.design.statement.nx for leg in legs))


def _padded(value: Expr, rows: int, columns: int = 1) -> Any:
    """A matrix with zeros below and to the right."""
    dense = ca.densify(value)
    result = ca.MX.zeros(rows, columns)
    if dense.numel():
        result[: dense.shape[0], : dense.shape[1]] = dense
    return result


def _given(leg: Leg, room: _Room) -> tuple[list[Any], tuple[Any, ...]]:
    """Estimate, time of the last step in the phase, control held, measurement: with room, and what the phase takes."""
    n, m, r = leg.design.sizes
    sizes = (room.n, 1, room.m, room.r)
    names = ("estimate", "last", "held", "measurement")
    symbols = [ca.MX.sym(name, size) for name, size in zip(names, sizes, strict=True)]
    y, last, held, measured = symbols
    return symbols, (y[:n], last, held[:m], measured[:r])


def _step(leg: Leg, room: _Room) -> ca.Function:
    """(estimate, last, held, measurement, time, valid) -> fields with room, whether good, whether a row is missing."""
    symbols, given = _given(leg, room)
    time, valid = ca.MX.sym("time"), ca.MX.sym("valid")
    found = stepped(leg.design, leg.tables, given, time, valid)
    fields = [flat(_padded(found.fields[name], *room.shapes[name])) for name in FIELDS]
    return ca.Function(f"step_{leg.part}", [*symbols, time, valid], [*fields, found.good, found.missing])


def _crossing(leg: Leg, later: Leg, room: _Room) -> ca.Function:
    """(estimate, last, held, measurement) -> estimate and control where the later phase begins, good, missing."""
    symbols, given = _given(leg, room)
    assert leg.tangent is not None
    found = stepped(leg.design, leg.tables, given, ca.MX(leg.tables.duration), ca.MX(1))
    estimate = ca.DM(leg.tangent) @ found.fields["estimate"]
    control = ca.MX(ca.DM(later.begun))
    for row, own in leg.kept:
        control[row] = symbols[2][own]
    values = [_padded(estimate, room.n), _padded(control, room.m), found.good, found.missing]
    return ca.Function(f"across_{leg.part}", symbols, [ca.densify(value) for value in values])


def _staying(room: _Room) -> ca.Function:
    """The same where a step does not reach the end of the phase."""
    y, held = ca.MX.sym("estimate", room.n), ca.MX.sym("held", room.m)
    last, measured = ca.MX.sym("last"), ca.MX.sym("measurement", room.r)
    return ca.Function("stay", [y, last, held, measured], [y, held, ca.MX(1), ca.MX(0)])


def _entries(names: list[tuple[str, tuple[str, ...]]]) -> tuple[str, ...]:
    """What an array holds: once where all phases agree, else of each phase."""
    if len({own for _, own in names}) == 1:
        return names[0][1]
    return tuple(f"in {phase}: {', '.join(own) or 'nothing'}" for phase, own in names)


def _named(leg: Leg, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of entries with their units."""
    return with_units(leg.design.statement, names)


def _inputs(legs: tuple[Leg, ...], room: _Room) -> tuple[Port, ...]:
    """Ports of the inputs; those that are held take the place of fields of the struct."""
    measured = _entries([(leg.name, _named(leg, entry_names(leg.design.measured))) for leg in legs])
    return (
        Port(name="estimate", rows=room.n),
        Port(name="last"),
        Port(name="held", rows=room.m),
        Port(name="measurement", rows=room.r, entries=measured),
        Port(name="time", unit="s", about="of the measurement, since the first phase began"),
    )


def _outputs(legs: tuple[Leg, ...], room: _Room) -> tuple[Port, ...]:
    """Ports of the fields of the struct."""
    listed = ", ".join(f"{k} {leg.name}" for k, leg in enumerate(legs))
    fed = [leg.design.statement.control_names[: leg.design.sizes[1]] for leg in legs]
    controls = _entries([(leg.name, _named(leg, names)) for leg, names in zip(legs, fed, strict=True)])
    about = {
        "estimate": (
            "of the deviation of the state (and of unknown constants) from the nominal",
            _entries([(leg.name, _named(leg, leg.design.labels)) for leg in legs]),
        ),
        "control": (
            "given out by the last step at a valid time and held since; overwrite it where another one was applied",
            controls,
        ),
        "nominal_state": (
            "the nominal at that time",
            _entries([(leg.name, _named(leg, leg.design.statement.state_names)) for leg in legs]),
        ),
        "nominal_control": ("the nominal at that time", controls),
        "feedback_gain": ("C", ()),
        "filter_gain": ("L of the last step; zero for rows that were left out", ()),
    }
    fields = [
        Port(name=name, rows=room.shapes[name][0], columns=room.shapes[name][1], about=words, entries=entries)
        for name, (words, entries) in about.items()
    ]
    return (
        Port(name="time", unit="s", about="of the last step"),
        Port(name="phase", about=f"that this time is in: {listed}", whole=True),
        *fields,
        Port(name=RETURNED, rows=room.m),
        Port(name="status", about="of the last step", whole=True),
    )


def _limits(legs: tuple[Leg, ...]) -> tuple[str, ...]:
    """What is said of the limits of the control, in each phase."""
    return tuple(f"In {leg.name}: {limits_text(leg.design.statement, leg.design.limits)}" for leg in legs)


def _notes(legs: tuple[Leg, ...]) -> tuple[str, ...]:
    """What the package says of the bounds of each phase."""
    return tuple(
        f"{leg.name}: {note}" for leg in legs for note in limits_notes(leg.design.statement, leg.design.limits)
    )


def _constants(legs: tuple[Leg, ...]) -> dict[str, float]:
    """The limits of each phase."""
    return {
        f"{leg.part}_{label}": value
        for leg in legs
        for label, value in limit_constants(leg.design.statement, leg.design.limits).items()
    }


def _first(leg: Leg, room: _Room) -> Array:
    """First values of the fields: those of the first phase."""
    n, m, r = leg.design.sizes
    own = {"estimate": (n, 1), "control": (m, 1), "nominal_state": (leg.design.statement.nx, 1)}
    own |= {"nominal_control": (m, 1), "feedback_gain": (m, n), "filter_gain": (n, r)}
    shapes = {"time": ca.DM(0), **{name: ca.DM(*own[name]) for name in FIELDS}, "status": ca.DM(0)}
    values = first_fields(leg.design, leg.tables, shapes, "time")
    parts, offset = [np.zeros(2)], 1  # time and phase
    for name in FIELDS:
        rows, columns = own[name]
        whole = np.zeros(room.shapes[name])
        whole[:rows, :columns] = values[offset : offset + rows * columns].reshape(rows, columns)
        offset += rows * columns
        parts.append(whole.ravel())
    return np.concatenate([*parts, parts[1 + FIELDS.index("control")], np.zeros(1)])


def _points(legs: tuple[Leg, ...], room: _Room, duration: float, random: np.random.Generator, count: int) -> Array:
    """Steps for a comparison: those of each phase, and those that end where two meet or go across."""
    ports = _inputs(legs, room)
    share = max(count // len(legs), 1)
    parts = []
    for k, leg in enumerate(legs):
        n, m, r = leg.design.sizes
        own = points(leg.design, leg.tables, random, share if k + 1 < len(legs) else max(count - share * k, 1))
        rows = np.zeros((own.shape[0], sum(port.size for port in ports)))
        offset = 0
        for name, size in (("estimate", n), ("last", 1), ("held", m), ("measurement", r), ("time", 1)):
            place = span(ports, name).start
            rows[:, place : place + size] = own[:, offset : offset + size]
            offset += size
        for name in ("last", "time"):
            rows[:, span(ports, name)] += leg.start
        if k + 1 < len(legs):
            meeting, time = legs[k + 1].start, span(ports, "time")
            rows[::5, time] = meeting
            rows[1::5, time] = meeting + random.uniform(0.0, 0.2, (rows[1::5].shape[0], 1)) * leg.tables.duration
        parts.append(rows)
    rows = np.vstack(parts)[:count]
    rows[2::17, span(ports, "last")] = 0.0  # over all that lies between
    return rows
