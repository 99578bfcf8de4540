"""Filter and feedback through several phases as one law, for any time between two steps.

Within a phase a step is that of its own controller, in the time of the phase, piece by piece from node to node. A step
that reaches the end of a phase or goes beyond it passes the junction: the estimate y of the deviation is predicted to
the end with the control that is held, goes on as J y, J the tangent of the jump along the nominal (zero for what
appears: it starts at its mean), and the later phase goes on from there. Of the controls the later phase holds those of
the same name as they were, the others as its nominal begins.

A reading stands for the time before it. A step exactly where two phases meet takes that of the earlier one, which ends
there, and gives out the control of the later one. A step across a junction takes that of the later phase, for the time
since it began; what the earlier phase would have measured after the last step is not known then.

A phase that measures nothing only predicts, and feeds back the estimate that came from before: what it is given as a
reading is ignored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError
from covocp.base.expressions import Expr
from covocp.base.matrices import Array, half_length, pack_symbolic, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.export.laws.controller import (
    ABOUT,
    ABOUT_INSTANTS,
    ABOUT_KEPT,
    HELD,
    STATUSES,
    Given,
    about,
    first_fields,
    input_ports,
    points,
    stepped,
    with_units,
)
from covocp.export.laws.design import Design
from covocp.export.laws.history import History, clock
from covocp.export.laws.law import RETURNED, Law, Port, flat, span, status_of
from covocp.export.laws.limits import limit_constants, limits_notes, limits_text
from covocp.export.laws.prediction import CONTINUE
from covocp.solution.phases import PhasesSolution
from covocp.statement.entries import entry_names

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Leg:
    """A phase in a controller.

    part: its name in C. tangent: of the jump at its end, (n of the next one, n), and noise: variances that are added
    there; None of the last phase.
    kept: controls of this phase that the next one has, as (row there, row here). begun: control where it begins.
    """

    design: Design
    tables: History
    name: str
    part: str
    start: float
    tangent: Array | None
    noise: Array | None
    kept: tuple[tuple[int, int], ...]
    begun: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class _Room:
    """Sizes that are enough for every phase: estimate, control, measurement, state; what is measured all the time, that
    and the estimate; whether one reads at instants.
    """

    n: int
    m: int
    r: int
    nx: int
    always: int
    joint: int
    reads: bool

    __repr__ = short_repr

    @property
    def shapes(self) -> dict[str, tuple[int, int]]:
        """Of the fields but time, phase and status, in their order."""
        n, m = self.n, self.m
        shapes = {"estimate": (n, 1), "control": (m, 1), "nominal_state": (self.nx, 1), "nominal_control": (m, 1)}
        shapes |= {
            "feedback_gain": (m, n),
            "filter_gain": (n, self.r),
            "length": (1, 1),
            "elapsed": (1, 1),
            "spread": (half_length(self.joint), 1),
        }
        shapes |= {"expected": (self.always, 1)} if self.always else {}
        return shapes | {"overdue": (1, 1)}

    @property
    def fields(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(self.shapes)

    @property
    def kept(self) -> dict[str, int]:
        """Sizes of the inputs that a struct keeps, but the time of the last step."""
        shapes = self.shapes
        return {name: shapes[field][0] for name, field in HELD.items() if field in shapes}


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
        tangent, noise, kept = None, None, []
        if k < len(solution.links):
            later = designs[k + 1]
            names = later.statement.control_names[: later.sizes[1]]
            mine = design.statement.control_names[:m]
            kept = [(row, mine.index(name)) for row, name in enumerate(names) if name in mine]
            t, none = solution[k].trajectory, np.zeros((design.sizes[0],) * 2)
            function = solution.links[k].deviations
            assert function is not None
            given = (t.x[-1], t.e[-1], t.duration, solution[k].parameters, solution[k + 1].parameters, none)
            tangent, noise = (np.asarray(value.full()) for value in function(*given)[:2])
        begun = np.clip(own.rows(np.zeros(1))[1][0, :m], *design.limits)
        legs.append(
            Leg(
                design=design,
                tables=own,
                name=solution[k].name,
                part=parts[k],
                start=float(starts[k]),
                tangent=tangent,
                noise=noise,
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
    legs, room = tuple(_by_the_clock_of_all(leg, duration, margin) for leg in legs), _room(legs)
    return Law(
        name="step",
        kind="controller",
        about=(
            *about(legs[0].design, (*ABOUT, *(ABOUT_INSTANTS if room.reads else ()))),
            *ABOUT_PHASES,
            *_limits(legs),
        ),
        notes=_notes(legs),
        constants=_constants(legs),
        core=_core(legs, room, duration, margin),
        inputs=_inputs(legs, room),
        outputs=_outputs(legs, room),
        statuses=STATUSES,
        held={name: field for name, field in HELD.items() if field in ("time", *room.fields)},
        returned=RETURNED,
        start=_first(legs[0], room),
        points=lambda random, count: _points(legs, room, duration, random, count),
        tolerance=tolerance,
    )


def _by_the_clock_of_all(leg: Leg, duration: float, margin: float) -> Leg:
    """A phase whose times are as uncertain as those of the flight, by which its nodes are kept between two calls.

    By its own, shorter, clock a node rounded to that of the flight would come again, and again.
    """
    return replace(leg, tables=replace(leg.tables, margin=margin * duration / leg.tables.duration))


def _core(legs: tuple[Leg, ...], room: _Room, duration: float, margin: float) -> ca.Function:
    """(inputs of the law) -> fields, control that is handed out, status.

    One call goes to the next node of the mesh, over a junction, or to the time that is asked for.
    """
    symbols = {port.name: ca.MX.sym(port.name, port.size) for port in _inputs(legs, room)}
    own = {name: symbols[name] for name in room.kept}
    last, measured = symbols["last"], symbols["measurement"]
    starts, lengths = ca.MX(ca.DM([leg.start for leg in legs])), ca.MX(ca.DM([leg.tables.duration for leg in legs]))
    now = clock(symbols["time"], duration, margin, last)
    asked = now.time
    for leg in legs[1:]:
        asked = ca.if_else(ca.fabs(asked - leg.start) <= margin * duration, leg.start, asked)
    backwards = asked < last
    valid = ca.if_else(backwards, 0.0, now.within)
    before, after = (sum((t >= leg.start for leg in legs[1:]), ca.MX(0)) for t in (last, asked))
    after = ca.if_else(valid, after, before)  # a time that is not valid must not lead out of the phase
    crosses = before < after
    steps = [_step(leg, room) for leg in legs]
    over = [_crossing(legs[k : k + 2], steps[k + 1], room, k) for k in range(len(legs) - 1)]
    leave: Any = ca.Function.conditional("leave", over, _staying(room))
    meets = ca.logic_and(asked == starts[after], after == before + 1)
    since = ca.fmin(last - starts[before], lengths[before])  # of a struct that was never set
    left = leave(ca.if_else(crosses, before, len(over)), *own.values(), since, measured, meets)
    lost = ca.logic_and(crosses, ca.logic_not(left[-2]))  # then the later phase begins with its nominal
    own |= {name: ca.if_else(crosses, 0.0, own[name]) for name in ("estimate", "overdue") if name in own}
    which: Any = ca.Function.conditional("which", steps[:-1], steps[-1])
    inside = ca.fmin(ca.fmax(asked - starts[after], 0.0), lengths[after])
    flies = ca.logic_and(valid, ca.logic_not(crosses))
    gone = which(after, *own.values(), ca.if_else(crosses, inside, since), measured, inside, flies)
    gone = [ca.if_else(ca.logic_and(gone[-3], flies), starts[after] + gone[0], asked), after, *gone[1:]]
    crossed = ca.logic_and(crosses, ca.logic_not(lost))
    time, phase, *fields, more, good, missing = (ca.if_else(crossed, a, b) for a, b in zip(left, gone, strict=True))
    more = ca.logic_and(more, ca.logic_or(time > last, phase > before))  # whatever is rounded, a step ends
    conditions = [
        *now.conditions, (backwards, "TIME_BACKWARDS"),
        (ca.logic_or(lost, ca.logic_not(good)), "ESTIMATE_LOST"), (missing, "MEASUREMENT_MISSING"),
    ]  # fmt: skip
    found = dict(zip(room.fields, fields, strict=True))
    given = found["control"]  # kept where the time is valid: the next step must not depend on one that is not
    for name in room.kept:
        found[HELD[name]] = ca.if_else(valid, found[HELD[name]], symbols[name])
    status = ca.if_else(more, CONTINUE, status_of(conditions))
    outputs = [ca.if_else(valid, time, last), phase, *found.values(), given, status]
    return ca.Function("step", list(symbols.values()), outputs)


def _room(legs: tuple[Leg, ...]) -> _Room:
    """What is enough for all phases."""
    n, m, r = (max(leg.design.sizes[k] for leg in legs) for k in range(3))
    nx, reads = max(leg.design.statement.nx for leg in legs), any(leg.design.reads for leg in legs)
    always = max(leg.design.always for leg in legs)
    joint = max(leg.design.sizes[0] + leg.design.always for leg in legs)
    return _Room(n=n, m=m, r=r, nx=nx, always=always, joint=joint, reads=reads)


def _padded(value: Expr, rows: int, columns: int = 1) -> Any:
    """A matrix with zeros below and to the right."""
    dense = ca.densify(value)
    result = ca.MX.zeros(rows, columns)
    if dense.numel():
        result[: dense.shape[0], : dense.shape[1]] = dense
    return result


def _given(leg: Leg, room: _Room) -> tuple[list[Any], Given]:
    """What is kept, time of the last step in the phase, measurement: with room, and what the phase takes of it."""
    (n, m, r), a = leg.design.sizes, leg.design.always
    sizes = {**room.kept, "last": 1, "measurement": room.r}
    symbols = {name: ca.MX.sym(name, size) for name, size in sizes.items()}
    own = {"estimate": n, "held": m, "spread": half_length(n + a), "measurement": r, "expected": a}
    taken = {name: symbol[: own.get(name, 1), 0] for name, symbol in symbols.items()}
    return list(symbols.values()), Given.of(taken)


def _fields(leg: Leg, room: _Room, found: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a phase with room."""
    return {name: flat(_padded(found.get(name, ca.MX(0)), *room.shapes[name])) for name in room.fields}


def _step(leg: Leg, room: _Room) -> ca.Function:
    """(what is kept, last, measurement, time, valid) -> time in the phase, fields with room, whether the step goes on,
    whether the estimate is good, whether a row is missing.
    """
    symbols, given = _given(leg, room)
    time, valid = ca.MX.sym("time"), ca.MX.sym("valid")
    found = stepped(leg.design, leg.tables, given, time, valid)
    values = [found.fields["time"], *_fields(leg, room, found.fields).values(), found.more, found.good, found.missing]
    return ca.Function(f"step_{leg.part}", [*symbols, time, valid], [ca.densify(value) for value in values])


def _crossing(legs: tuple[Leg, ...], begins: ca.Function, room: _Room, k: int) -> ca.Function:
    """(what is kept, last, measurement, whether the step ends where the phases meet) -> time, phase, fields and so on.

    Args:
        legs: the phase that is left, and the later one.
        begins: a step of the later phase.
        room: sizes that are enough for every phase.
        k: number of the phase that is left.
    """
    (leg, later), (symbols, given) = legs, _given(legs[0], room)
    assert leg.tangent is not None
    assert leg.noise is not None
    meets = ca.MX.sym("meets")
    given = given._replace(measured=ca.if_else(meets, given.measured, np.nan))
    found = stepped(leg.design, leg.tables, given, ca.MX(leg.tables.duration), ca.MX(1))
    control = ca.MX(ca.DM(later.begun))
    for row, own in leg.kept:
        control[row] = given.held[own]
    gone = found.fields["length"]
    J, n = ca.DM(leg.tangent), leg.design.sizes[0]
    error = unpack_symbolic(found.fields["spread"], n + leg.design.always)[:n, :n]
    spread = ca.diagcat(J @ error @ J.T + ca.DM(leg.noise), ca.MX(later.design.always, later.design.always))
    entered = {"estimate": J @ found.fields["estimate"], "control": control, "length": gone}
    entered |= {"spread": pack_symbolic(spread), "overdue": found.fields["overdue"]}
    start = {name: _padded(entered.get(HELD[name], ca.MX(0)), size) for name, size in room.kept.items()}
    ready = dict(zip(room.fields, begins(*start.values(), 0.0, np.nan, 0.0, 1.0)[1:-3], strict=True))
    on = {**ready, **_fields(later, room, {**entered, "length": -gone})}  # goes on from there
    within, more = _fields(leg, room, found.fields), found.more
    fields = [ca.if_else(more, within[f], ca.if_else(meets, ready[f], on[f])) for f in room.fields]
    time = ca.if_else(more, leg.start + found.fields["time"], later.start)
    goes_on = ca.logic_or(more, ca.logic_not(meets))
    values = [time, k + ca.logic_not(more), *fields, goes_on, found.good, found.missing]
    return ca.Function(f"over_{leg.part}", [*symbols, meets], [ca.densify(value) for value in values])


def _staying(room: _Room) -> ca.Function:
    """The same where a step does not reach the end of the phase: nothing that would count."""
    sizes = {**room.kept, "last": 1, "measurement": room.r, "meets": 1}
    symbols = [ca.MX.sym(name, size) for name, size in sizes.items()]
    fields = [ca.MX.zeros(rows * columns) for rows, columns in (room.shapes[name] for name in room.fields)]
    return ca.Function("stay", symbols, [ca.MX(0), ca.MX(0), *fields, ca.MX(0), ca.MX(1), ca.MX(0)])


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
        *(Port(name=name, rows=size) for name, size in room.kept.items() if name in ABOUT_KEPT),
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
        **{name: (words, ()) for name, words in ABOUT_KEPT.items()},
    }
    fields = []
    for name, (rows, columns) in room.shapes.items():
        (words, entries), unit = about[name], "s" if name in ("length", "elapsed") else ""
        whole = name == "overdue"
        port = Port(name=name, rows=rows, columns=columns, about=words, entries=entries, unit=unit, whole=whole)
        fields.append(port)
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
    shapes = {"time": ca.DM(0), **{name: ca.DM(*size) for name, size in own.items()}}
    values = first_fields(leg.design, leg.tables, shapes, "time")
    found, offset = {name: np.zeros(shape) for name, shape in room.shapes.items()}, 1  # after the time
    for name, (rows, columns) in own.items():
        found[name][:rows, :columns] = values[offset : offset + rows * columns].reshape(rows, columns)
        offset += rows * columns
    parts = [value.ravel() for value in found.values()]
    return np.concatenate([np.zeros(2), *parts, found["control"].ravel(), np.zeros(1)])  # time and phase before


def _points(legs: tuple[Leg, ...], room: _Room, duration: float, random: np.random.Generator, count: int) -> Array:
    """Steps for a comparison: those of each phase, and those that end where two meet or go across."""
    ports = _inputs(legs, room)
    share = max(count // len(legs), 1)
    parts = []
    for k, leg in enumerate(legs):
        own = points(leg.design, leg.tables, random, share if k + 1 < len(legs) else max(count - share * k, 1))
        rows = np.zeros((own.shape[0], sum(port.size for port in ports)))
        offset = 0
        for port in input_ports(leg.design):
            place = span(ports, port.name).start
            rows[:, place : place + port.size] = own[:, offset : offset + port.size]
            offset += port.size
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
