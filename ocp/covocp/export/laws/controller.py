"""Perturbation filter and feedback of a closed loop as a law, for any time between two steps.

The control that a step returns is held until the next one, so it is the mean of the nominal control over the step that
comes, taken to be as long as the last one, and the feedback of the estimate: the nominal at the time of the call, held,
would be half a step behind. A step from time s to t = s + h, with y the estimate of the
deviation from the nominal, computes

    y- :  y' = F y + G (u_held - u(time)) over [s, t], a step of the two-stage Gauss method from each node of the mesh
          to the next (`prediction`): order 4 where u jumps or has kinks too, stable for any h
    a  :  a' = h(x, u) + M y- + H (u_held - u), from a(s) = 0: what is to be measured, integrated by the same stages
    P- :  P' = F P + P F' + Q                of the error before the measurement, from E(s) of the design, by the same
                                             stages
    A, B                                     covariance of the error of a, the noise of the measurement included, and
                                             between those of y- and a
    L  =  h B A^-1                           best gain of the mean of the measurement; h P- M' (h M P- M' + U)^-1 and
                                             K h to first order. It never adds to P-: stable for any h, and right where
                                             a first measurement tells more than all that was known before
    y+ =  y- + L (m - a/h)
    u  =  mean of u over [t, t + h] - C y+,  within the limits, where there are some

with F, G, Q, M, H, U and the measurement h expected there from the model's own functions along the nominal, and C at t.
A measurement m stands for the h seconds before it: it is the mean over them, white noise of density U included, and is
compared with the mean that is expected (at the end of a step the nominal is half a step ahead of it). What is read at
an instant is compared with what is expected then, m - h - M y- - H (u_held - u), and has its variance. Where a
row did not come, or a mean over a long step tells less than all that was measured in it, E of the design is not what is
known: P is kept where it is another, and the next step begins with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.matrices import Array, half_length, pack, pack_symbolic, stacked, unpack_symbolic
from covocp.export.laws.design import Design, DesignAt, measured_blocks
from covocp.export.laws.history import History, Nominal
from covocp.export.laws.law import LARGEST, QUATERNION, Law, Port, flat, span, status_of
from covocp.export.laws.limits import clipped, limit_constants, limits_notes, limits_text
from covocp.export.laws.prediction import CONTINUE, SCALAR_SIZE, Ahead, Piece, next_piece, predicted, solved
from covocp.export.laws.trajectory import times
from covocp.statement.entries import entry_names, error_names
from covocp.statement.statement import Statement

# What is kept of a step that is under way, and after a reading that did not come.
ABOUT_KEPT = {
    "length": "of the last step, and so what is expected of the coming one; 0 before the first one: set it after init "
    "where it is known, and call a first step at time zero",
    "elapsed": "how long a step has been under way that goes on after a node; 0 between two calls",
    "expected": "integral of what is to be measured since a step that is under way began; 0 between two calls",
    "spread": "half-vector of the covariance of the errors of estimate and integral, which counts in the place of E of "
    "the design within a step, and where overdue is 1",
    "overdue": "1 where the variances of the estimate are not those of the design, as a row of the measurement did not "
    "come or a step was long: the next step begins with spread then",
}
STATUSES = (
    "OK", "MEASUREMENT_MISSING", "TIME_BEFORE", "TIME_AFTER", "TIME_BACKWARDS", "TIME_NOT_FINITE", "ESTIMATE_LOST",
    "FAILED",
)  # fmt: skip
HELD = {
    "estimate": "estimate", "last": "time", "held": "control", "length": "length", "elapsed": "elapsed",
    "expected": "expected", "spread": "spread", "overdue": "overdue",
}  # fmt: skip
# Variances of the error that differ from those of the design by this share of them, or by this share of the largest
# ones on the way, are no others: the design counts.
NEAR, SLIGHT = 1e-2, 1e-6
# A length of a step by which anything may be divided, in single precision too.
SHORTEST = 1e-30
# Time or index of the last step before the first one, where something is read at time zero.
NO_STEP = -1.0
ABOUT = (
    "Perturbation filter and feedback. The control returned is held until the next call, so it is the mean of the "
    "nominal control over the coming step, taken to be as long as the last one, u_mean - C y. Before the first step no "
    "length is known and it is the nominal control of time zero; where steps differ in length the control is early or "
    "late by half of their difference: the estimate knows it, and the feedback acts on it. From the last call at s to "
    "this one at t = s + h the estimate y of the deviation from the nominal is predicted by y' = F y + G (u_held - "
    "u), a step of the two-stage Gauss method from each node of the mesh to the next, stable for any h. The "
    "measurement m is the mean of what is measured from s to t, and is compared with the mean a/h that is expected, "
    "a' = h(x, u) + M y + H (u_held - u). The estimate is corrected by L (m - a/h), L = h B A^-1, A "
    "the covariance of the error of a (U h of noise in it), B that between it and the estimate's: from E(s) of the "
    "design by P' = F P + P F' + Q. To first order L is h P M' (h M P M' + U)^-1.",
    "A row of the measurement that is not finite is left out, and what is known without it is kept for the next steps; "
    "readings beyond 1e30 count as not finite. The first "
    "measurement that counts is that of the first call after time zero: it stands for the time from zero to then.",
)
ABOUT_INSTANTS = (
    "Rows of the measurement that are read at instants are compared with what is expected at the time of the call "
    "and count with their variance in every call in which they are "
    "finite, in a second one at the same time as another reading: give each reading once, NaN after it. NaN between "
    "the instants is no missing row. A reading that comes after its instant, or in a second call at it, is weighed by "
    "what is known without it.",
)
ABOUT_FIRST = (
    "Something is read at time zero: give it to a first step at time zero, which corrects the estimate and the control "
    "by it. Before that step the time of the last one is -1.",
)
ABOUT_ATTITUDES = (
    f"An attitude is {QUATERNION}; its three rows of the estimate are the rotation vector, in body axes, by which it "
    "differs from the nominal."
)


def controller_law(design: Design, tables: History, tolerance: float) -> Law:
    """The law (struct of the last step, measurement, time) -> control and all that the struct keeps."""
    ports = input_ports(design)
    symbols = {port.name: ca.MX.sym(port.name, port.size) for port in ports}
    time, given = symbols["time"], Given.of(symbols)
    begun = ca.fmax(given.last, 0.0)
    clock = tables.clock(time, begun)
    backwards = clock.time < begun
    valid = ca.if_else(backwards, 0.0, clock.within)
    found = stepped(design, tables, given, clock.time, valid)
    conditions = [
        *clock.conditions, (backwards, "TIME_BACKWARDS"), (ca.logic_not(found.good), "ESTIMATE_LOST"),
        (found.missing, "MEASUREMENT_MISSING"),
    ]  # fmt: skip
    fields = {**found.fields, "status": ca.if_else(found.more, CONTINUE, status_of(conditions))}
    core = ca.Function("step", list(symbols.values()), [flat(v) for v in fields.values()])
    return Law(
        name="step",
        kind="controller",
        about=(
            *about(design, (*ABOUT, *(ABOUT_INSTANTS if design.reads else ()))),
            limits_text(*(design.statement, design.limits)),
        ),
        notes=limits_notes(*(design.statement, design.limits)),
        constants=limit_constants(*(design.statement, design.limits)),
        core=core,
        inputs=ports,
        outputs=field_ports(design, fields),
        statuses=STATUSES,
        held={name: kept for name, kept in HELD.items() if name in symbols},
        start=first_fields(design, tables, fields, "time"),
        points=lambda random, count: points(design, tables, random, count),
        tolerance=tolerance,
    )


class Given(NamedTuple):
    """What a step begins with: the fields of the struct that it goes on from, and what is measured.

    estimate; length: of the last step, negative within a step that has come over the end of a phase: what of it lay
    before; last: time of the last step (`NO_STEP`: there was none), or of the node that this one has come to; held:
    control since then; measured; elapsed: how long this step has been under way already; expected: integral of what is
    to be measured in that time; spread: half-vector of the covariance of the errors of estimate and integral at `last`,
    which counts in the place of E of the design where a step is under way or something is overdue; overdue: 1 where a
    row that was due did not come.
    """

    estimate: Any
    last: Any
    held: Any
    measured: Any
    length: Any
    elapsed: Any
    expected: Any
    spread: Any
    overdue: Any

    @staticmethod
    def of(values: Mapping[str, Any]) -> Given:
        """Of inputs by name; nothing is expected where all is read at instants."""
        estimate, last, held, measured = (values[name] for name in ("estimate", "last", "held", "measurement"))
        expected = values.get("expected", ca.MX(0, 1))
        kept = values["length"], values["elapsed"], expected, values["spread"], values["overdue"]
        return Given(estimate, last, held, measured, *kept)


class Stepped(NamedTuple):
    """What a step makes: fields of the struct by name, whether it goes on, whether the estimate may be used, whether a
    row is missing.
    """

    fields: dict[str, Any]
    more: Any
    good: Any
    missing: Any


def stepped(design: Design, tables: History, given: Given, time: Expr, valid: Expr) -> Stepped:
    """One step to a time, or to the next node of the mesh where one lies before it.

    Args:
        design: the model.
        tables: the nominal.
        given: what it begins with.
        time: within the range, no earlier than the last one [s].
        valid: where it is zero nothing is predicted, counted and fed back.
    """
    m = design.sizes[1]
    piece = next_piece(design, tables, ca.fmax(given.last, 0.0), time, valid)
    begun = Ahead(given.estimate, given.expected, _known(design, tables, given, piece))
    ahead = predicted(design, tables, begun, given.held, piece)
    # a prediction that overflows is not gone on with: the step ends with the nominal control of its time
    more = ca.logic_and(piece.more, finite(ahead.estimate, ahead.expected))
    end = ca.if_else(more, piece.end, time)
    now = tables.at(end)
    due = design.due(end, tables.margin * tables.duration)
    counts = ca.logic_and(valid, ca.logic_not(piece.more))
    taken = ca.if_else(counts, given.measured, 2.0 * LARGEST)  # what was read when nobody knows corrects nothing
    elapsed = given.elapsed + piece.length
    found = _corrected(design, ahead, (given.held, taken, elapsed, due), now, end)
    feedback = found.C @ found.y
    good = finite(found.y, feedback)
    nominal = now.u[:m]
    gone = ca.fmax(-given.length, 0.0) + elapsed
    length = ca.if_else(ca.logic_or(more, gone <= 0.0), given.length, gone)
    coming = tables.mean_control(end, ca.fmin(end + length, tables.duration))[:m]
    moved = ca.if_else(valid, coming, nominal) - ca.if_else(ca.logic_and(good, valid), feedback, 0.0)
    fields = {
        "time": ca.if_else(valid, end, given.last),
        "estimate": ca.if_else(more, ahead.estimate, ca.if_else(good, found.y, given.estimate)),
        "control": ca.if_else(more, given.held, clipped(moved, design.limits)),
        "nominal_state": now.x,
        "nominal_control": nominal,
        "feedback_gain": found.C,
        "filter_gain": found.L,
        "length": length,
        "elapsed": ca.if_else(more, elapsed, 0.0),
        "spread": ca.if_else(valid, ca.if_else(more, pack_symbolic(ahead.spread), found.spread), given.spread),
    }
    if design.always:
        fields["expected"] = ca.if_else(more, ahead.expected, 0.0)
    fields["overdue"] = ca.if_else(ca.logic_and(valid, ca.logic_not(more)), found.apart, given.overdue != 0.0)
    return Stepped(fields=fields, more=more, good=good, missing=found.missing)


def _known(design: Design, tables: History, given: Given, piece: Piece) -> Any:
    """Covariance of the errors of the estimate, and of the integral of what is to be measured, where a piece begins."""
    known = design.error(tables.at(piece.begin).e)
    if design.reads_first:  # the tables have what is known after it
        known = ca.if_else(given.last < 0.0, ca.DM(design.prior), known)
    own = ca.logic_or(given.elapsed > 0.0, given.overdue)
    n, a = design.sizes[0], design.always
    return ca.if_else(own, unpack_symbolic(given.spread, n + a), ca.diagcat(known, ca.MX.zeros(a, a)))


def about(design: Design, own: tuple[str, ...]) -> tuple[str, ...]:
    """What is said of a law, with what its attitudes are and that something is read at time zero."""
    turns = (ABOUT_ATTITUDES,) if any(block.tangent for block in design.statement.states) else ()
    return (*own, *turns, *(ABOUT_FIRST if design.reads_first else ()))


def finite(*values: Expr) -> Any:
    """Whether an estimate, and the control that follows from it, may be used; false for NaN, which mmax leaves out."""
    return sum(ca.sum1(ca.fabs(value)) for value in values) <= LARGEST


def input_ports(design: Design) -> tuple[Port, ...]:
    """Ports of the inputs of a step; those that are held take the place of fields of the struct."""
    (n, m, r), a = design.sizes, design.always
    sizes = {"estimate": n, "last": 1, "held": m, "measurement": r, "time": 1, "length": 1}
    sizes |= {"elapsed": 1, "spread": half_length(n + a), **({"expected": a} if a else {}), "overdue": 1}
    ports = {name: Port(name=name, rows=rows) for name, rows in sizes.items()}
    ports["measurement"] = measurement_port(design)
    ports["time"] = Port(name="time", unit="s", about="of the measurement")
    return tuple(ports.values())


def measurement_port(design: Design) -> Port:
    """The port of what is measured."""
    rows = entry_names(design.measured)
    return Port(name="measurement", rows=design.sizes[2], entries=with_units(design.statement, rows))


def field_ports(design: Design, fields: dict[str, Any]) -> tuple[Port, ...]:
    """Ports of the fields of the struct."""
    st, (n, m, r) = design.statement, design.sizes
    shapes = {"feedback_gain": (m, n), "filter_gain": (n, r), "estimate": (n, 1), "nominal_state": (st.nx, 1)}
    shapes |= {"control": (m, 1), "nominal_control": (m, 1), "expected": (design.always, 1)}
    shapes |= {"spread": (half_length(n + design.always), 1)}
    units = {"time": "s", "length": "s", "elapsed": "s"}
    about = {
        "time": "of the last step",
        "estimate": "of the deviation of the state (and of unknown constants) from the nominal",
        "control": "given out by the last step and held since; overwrite it where another one was applied",
        "nominal_state": "the nominal at that time",
        "nominal_control": "the nominal at that time",
        "feedback_gain": "C",
        "filter_gain": "L of the last step; zero for rows that were left out",
        **ABOUT_KEPT,
        "index": "of the last sample",
        "passed": "samples over which a step that is under way has gone; 0 between two calls",
        "status": "of the last step",
    }
    controls = with_units(st, st.control_names[:m])
    entries = {
        "estimate": with_units(st, design.labels),
        "nominal_state": with_units(st, st.state_names),
        "control": controls,
        "nominal_control": controls,
    }
    ports = []
    for name in fields:
        rows, columns = shapes.get(name, (1, 1))
        unit, listed = units.get(name, ""), entries.get(name, ())
        whole = name in ("index", "passed", "overdue", "status")
        port = Port(name=name, rows=rows, columns=columns, unit=unit, about=about[name], entries=listed, whole=whole)
        ports.append(port)
    return tuple(ports)


def with_units(statement: Statement, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of entries, or of rows of an error, with the units of their symbols: of an attitude that of the error."""
    blocks = (*statement.blocks, *measured_blocks(statement))
    units = {name: block.unit for block in blocks for name in (error_names if block.tangent else entry_names)((block,))}
    return tuple(f"{name} [{units[name]}]" if units.get(name) else name for name in names)


def first_fields(
    design: Design,
    tables: History,
    fields: dict[str, Any],
    last: str,
    gain: Array | None = None,
    control: Array | None = None,
) -> Array:
    """First values of the fields: the filter at the mean, the nominal at time zero, its control within the limits.

    Where the coming step is known the first control is another one, (m,).

    Where something is read at time zero the field `last`, that of the last step, says that there was none. The gain is
    that of the design, where another one is flown (m, n) that one.
    """
    m = design.sizes[1]
    zeros = {name: np.zeros(int(np.prod(value.shape))) for name, value in fields.items()}
    x, u, e = (values[0] for values in tables.rows(np.zeros(1)))
    zeros |= {
        "control": np.clip(u[:m] if control is None else control, *design.limits),
        "nominal_control": u[:m],
        "nominal_state": x,
    }
    if design.reads_first:
        zeros[last] = np.array([NO_STEP])
    zeros["feedback_gain"] = np.ravel(design.gain(x, u, e, 0.0)[0].full() if gain is None else gain)
    return np.concatenate(list(zeros.values()))


def solved_in_units(spread: Expr, right: Expr) -> Any:
    """`solved` for a covariance, in units of its standard deviations."""
    units = ca.diag(1.0 / ca.sqrt(ca.diag(spread)))
    return units @ solved(units @ spread @ units, units @ right)


class _Corrected(NamedTuple):
    """Estimate after the measurement, feedback gain, filter gain, half-vector of P after it, whether a row is missing,
    whether P is another than the design expects.
    """

    y: Any
    C: Any
    L: Any
    spread: Any
    missing: Any
    apart: Any


def _corrected(design: Design, ahead: Ahead, given: tuple[Any, ...], now: Nominal, time: Expr) -> _Corrected:
    """What a measurement tells.

    Args:
        design: the model.
        ahead: what is predicted.
        given: control held, measurement, length of the step, which rows are there.
        now: the nominal.
        time: of the measurement.
    """
    st, (n, m, r), always = design.statement, design.sizes, design.always
    kind = design.symbolic if r <= SCALAR_SIZE else ca.MX
    y, held, measured, h = kind.sym("y", n), kind.sym("held", m), kind.sym("measurement", r), kind.sym("h")
    seen, due = kind.sym("a", always), kind.sym("due", r)
    x, u, e, t = kind.sym("x", st.nx), kind.sym("u", st.nu), kind.sym("e", st.ne), kind.sym("t")
    model = design.model(x, u, t)
    E, (C, designed) = kind.sym("E", n + always, n + always), design.gain(x, u, e, t)
    if r == 0:  # a phase that measures nothing: prediction alone, which the feedback goes on acting on
        gain = ca.Function("feedback", [x, u, e, t], [ca.densify(C), ca.densify(designed)])
        C, known = gain(now.x, now.u, now.e, time)
        apart = ca.sum1(_apart(design, ahead.spread, known)) > 0
        return _Corrected(ahead.estimate, C, ca.MX(n, 0), pack_symbolic(ahead.spread), ca.MX(0), apart)
    present, read = ca.fabs(measured) <= LARGEST, slice(always, r)
    some = ca.fmax(h, SHORTEST)
    at_end = model.h[read, 0] + model.M[read, :] @ y + model.H[read, :] @ (held - u[:m])
    residual = ca.if_else(present, measured - ca.vertcat(seen / some, at_end), 0.0)
    # sqrt(h) of a mean, so that its noise is U; no time has passed of which one at the same time could tell
    roots = ca.vertcat(ca.repmat(ca.sqrt(some), always, 1), kind.ones(r - always))
    there = present * ca.vertcat(ca.repmat(h > 0, always, 1), kind.ones(r - always))
    of_means = ca.horzcat(kind(always, n), ca.DM.eye(always) / ca.sqrt(some))
    rows = ca.diag(there) @ ca.vertcat(of_means, ca.horzcat(model.M[read, :], kind(r - always, always)))
    noise = ca.diagcat(kind(always, always), model.U[read, read])
    spread = rows @ E @ rows.T + ca.diag(there) @ noise @ ca.diag(there) + ca.diag(1 - there)
    L = solved_in_units(spread, rows @ E[:, :n]).T @ ca.diag(there)
    left = ca.horzcat(ca.DM.eye(n), kind(n, always)) - L @ rows
    after = left @ E @ left.T + L @ noise @ L.T
    absent = due * (1 - present)
    flags = [ca.sum1(absent) > 0, ca.sum1(_apart(design, after, designed)) > 0]
    kept = pack_symbolic(ca.diagcat(after, kind(always, always)))
    L = L @ ca.diag(roots)
    outputs = [ca.densify(v) for v in (y + L @ residual, C, L, kept, *flags)]
    function = ca.Function("correct", [y, seen, E, held, measured, h, due, x, u, e, t], outputs)
    return _Corrected(*function(*ahead, *given, now.x, now.u, now.e, time))


def _apart(design: Design, error: Any, designed: Any) -> Any:
    """Which variances of the error are others than those of the design."""
    return ca.fabs(ca.diag(error - designed)) > NEAR * ca.diag(designed) + SLIGHT * ca.DM(design.units) ** 2


def points(design: Design, tables: History, random: np.random.Generator, count: int) -> Array:
    """Steps for a comparison: estimates and measurements as the design expects them, and what should not happen."""
    n, m, r = design.sizes
    ports = input_ports(design)
    time = times(tables, random, count)
    known = np.clip(np.nan_to_num(time, posinf=tables.duration, neginf=0.0), 0.0, tables.duration)
    steps = tables.duration * 10.0 ** random.uniform(-4.0, -1.5, count)
    last = np.clip(known - np.where(random.uniform(size=count) < 0.1, -steps, steps), 0.0, tables.duration)
    x, u, e = (values.T for values in tables.rows(known))
    model = design.model(x, u, known[None, :])
    expected, M, U = model.h, model.M, model.U
    C, E = (np.asarray(v.full()) for v in design.gain.map(count)(x, u, e, known[None, :]))
    rows = np.zeros((count, sum(port.size for port in ports)))
    for k in range(count):
        deviation = _root(E[:, k * n : (k + 1) * n]) @ random.standard_normal(n)
        estimate = deviation * random.uniform(0.0, 2.0)
        lengths = np.where(np.arange(r) < design.always, np.sqrt(steps[k]), 1.0)
        noise = _root(np.asarray(U[:, k * r : (k + 1) * r].full())) @ random.standard_normal(r) / lengths
        seen = np.asarray(expected[:, k].full()).ravel() + np.asarray(M[:, k * n : (k + 1) * n].full()) @ deviation
        rows[k, span(ports, "estimate")] = estimate
        rows[k, span(ports, "held")] = u[:m, k] - C[:, k * n : (k + 1) * n] @ estimate
        rows[k, span(ports, "measurement")] = seen + noise
    if design.reads_first:
        first = random.uniform(size=count) < 0.2
        last[first] = NO_STEP
        time[first & (random.uniform(size=count) < 0.5)] = 0.0
    elapsed = (random.uniform(size=count) < 0.2) * steps
    rows[:, span(ports, "length")] = ((random.uniform(size=count) < 0.8) * random.permutation(steps))[:, None]
    rows[:, span(ports, "elapsed")] = elapsed[:, None]
    kept, seen = _under_way(design, model, E, rows[:, span(ports, "estimate")], elapsed)
    rows[:, span(ports, "spread")] = kept * random.uniform(0.5, 2.0, (count, 1))
    if design.always:
        rows[:, span(ports, "expected")] = seen
    rows[:, span(ports, "overdue")] = random.uniform(size=(count, 1)) < 0.2
    rows[:, span(ports, "last")] = last[:, None]
    rows[:, span(ports, "time")] = time[:, None]
    for k, wrong in zip(range(count // 3, count), (np.nan, np.inf, -np.inf, 1e200, np.nan, 1e29), strict=False):
        rows[k, span(ports, "measurement")] = wrong
    for k in range(count // 2, min(count, count // 2 + 2 * r)):
        rows[k, span(ports, "measurement").start + k % r] = np.nan
    if count > 30:
        rows[-1, span(ports, "estimate")] = np.nan
        rows[-2, span(ports, "estimate")] = 1e300
    return rows


def _under_way(design: Design, model: DesignAt, E: Array, estimates: Array, elapsed: Array) -> tuple[Array, Array]:
    """Spread and integral of what is to be measured that steps under way may have, (count, ...), as all were constant.

    Args:
        design: the model.
        model: at each step, side by side.
        E: covariances of the errors, side by side.
        estimates: (count, n).
        elapsed: how long they have been under way [s], (count,).
    """
    count, a = elapsed.size, design.always
    h, M, U = (stacked(v, count) for v in (model.h, model.M, model.U))
    M, own, s = M[:, :a], stacked(ca.DM(E), count), elapsed[:, None, None]
    across = s * (M @ own)
    spread = np.block([[own, across.mT], [across, s * (across @ M.mT) + s * U[:, :a, :a]]])
    return pack(spread), ((h[:, :a] + M @ estimates[:, :, None]) * s)[:, :, 0]


def _root(covariance: Array) -> Array:
    """A factor of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.clip(values, 0.0, None)))
