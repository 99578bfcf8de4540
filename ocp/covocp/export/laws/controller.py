"""Perturbation filter and feedback of a closed loop as a law, for any time between two steps.

The control that a step returns is held until the next one. A step from time s to t = s + h, with y the estimate of the
deviation from the nominal, computes

    y- :  y' = F y + G (u_held - u(time)) over [s, t], one step of the two-stage Gauss method: order 4, stable for any h
    P- =  Phi E(s) Phi' + h Q                of the error before the measurement; Phi of the same step, E of the design
    L  =  h P- M' (h M P- M' + U)^-1         K h to first order; the spectrum of L M is in [0, 1): stable for any h, and
                                             right where a first measurement tells more than all that was known before
    y+ =  y- + L (m - h(x, u, t) - M y- - H (u_held - u(t)))
    u  =  u(t) - C y+,                       within the limits, where there are some

with F, G, Q, M, H, U and the measurement h expected there from the model's own functions along the nominal, and C at t.
A measurement stands for the h seconds before it: white noise of density U, averaged over them. What is read at an
instant has its variance in place of U/h.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.gains import innovation_gain
from covocp.base.linear_solve import COMPILED_SOLVER, linear_solve
from covocp.base.matrices import Array
from covocp.base.quadrature import GAUSS_NODES, gauss_step
from covocp.blocks.updates import without
from covocp.export.laws.design import Design, measured_blocks
from covocp.export.laws.history import History, Nominal
from covocp.export.laws.law import LARGEST, QUATERNION, Law, Port, flat, span, status_of
from covocp.export.laws.limits import clipped, limit_constants, limits_notes, limits_text
from covocp.export.laws.trajectory import times
from covocp.statement.statement import Statement, entry_names, error_names

# Up to this size linear systems are written out in scalars.
SCALAR_SIZE = 8
STATUSES = (
    "OK", "MEASUREMENT_MISSING", "TIME_BEFORE", "TIME_AFTER", "TIME_BACKWARDS", "TIME_NOT_FINITE", "ESTIMATE_LOST",
    "FAILED",
)  # fmt: skip
HELD = {"estimate": "estimate", "last": "time", "held": "control"}
# Time or index of the last step before the first one, where something is read at time zero.
NO_STEP = -1.0
ABOUT = (
    "Perturbation filter and feedback. The control returned is held until the next call. From the last call at s to "
    "this one at t = s + h the estimate y of the deviation from the nominal is predicted by y' = F y + G (u_held - "
    "u), one step of the two-stage Gauss method, stable for any h; it is corrected by L (m - what is expected) with "
    "L = h P M' (h M P M' + U)^-1, P = Phi E(s) Phi' + h Q the covariance of its error before; the control is u - C y.",
    "A row of the measurement that is not finite is left out; readings beyond 1e30 count as not finite. The first "
    "measurement that counts is that of the first call after time zero: it stands for the time from zero to then.",
)
ABOUT_INSTANTS = (
    "Rows of the measurement that are read at instants count with their variance in the step in which they are finite; "
    "NaN between the instants is no missing row.",
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
    """The law (estimate, last time, held control, measurement, time) -> control and all that the struct keeps."""
    n, m, r = design.sizes
    y, last, held = ca.MX.sym("estimate", n), ca.MX.sym("last"), ca.MX.sym("held", m)
    measured, time = ca.MX.sym("measurement", r), ca.MX.sym("time")
    begun = ca.fmax(last, 0.0)
    clock = tables.clock(time, begun)
    backwards = clock.time < begun
    valid = ca.if_else(backwards, 0.0, clock.within)
    found = stepped(design, tables, (y, last, held, measured), clock.time, valid)
    conditions = [
        *clock.conditions, (backwards, "TIME_BACKWARDS"), (ca.logic_not(found.good), "ESTIMATE_LOST"),
        (found.missing, "MEASUREMENT_MISSING"),
    ]  # fmt: skip
    fields = {"time": ca.if_else(valid, clock.time, last), **found.fields, "status": status_of(conditions)}
    inputs = [y, last, held, measured, time]
    core = ca.Function("step", inputs, [flat(v) for v in fields.values()])
    return Law(
        name="step",
        kind="controller",
        about=(*about(design), limits_text(design.statement, design.limits)),
        notes=limits_notes(design.statement, design.limits),
        constants=limit_constants(design.statement, design.limits),
        core=core,
        inputs=input_ports(design),
        outputs=field_ports(design, fields),
        statuses=STATUSES,
        held=HELD,
        start=first_fields(design, tables, fields, "time"),
        points=lambda random, count: points(design, tables, random, count),
        tolerance=tolerance,
    )


class Stepped(NamedTuple):
    """What a step makes: fields of the struct by name, whether the estimate may be used, whether a row is missing."""

    fields: dict[str, Any]
    good: Any
    missing: Any


def stepped(design: Design, tables: History, given: tuple[Any, ...], time: Expr, valid: Expr) -> Stepped:
    """One step to a time.

    Args:
        design: the model.
        tables: the nominal.
        given: estimate, time of the last step (`NO_STEP`: there was none), control held since, measurement.
        time: within the range, no earlier than the last one [s].
        valid: where it is zero nothing is predicted, counted and fed back.
    """
    y, last, held, measured = given
    m = design.sizes[1]
    begun = ca.fmax(last, 0.0)
    h = ca.if_else(valid, time - begun, 0.0)
    middle = [begun + c * h for c in GAUSS_NODES]
    before = design.error(tables.at(begun).e)
    if design.reads_first:  # the tables have what is known after it
        before = ca.if_else(last < 0.0, ca.DM(design.prior), before)
    predicted, spread = _predict(design, (y, before, held), [tables.at(t) for t in middle], middle, h)
    now = tables.at(time)
    due = design.due(time, tables.margin * tables.duration)
    taken = ca.if_else(valid, measured, 2.0 * LARGEST)  # what was read when nobody knows corrects nothing
    corrected, C, L, missing = _corrected(design, (predicted, spread), (held, taken, h, due), now, time)
    feedback = C @ corrected
    good = finite(corrected, feedback)
    nominal = now.u[:m]
    moved = nominal - ca.if_else(ca.logic_and(good, valid), feedback, 0.0)
    fields = {
        "estimate": ca.if_else(good, corrected, y),
        "control": clipped(moved, design.limits),
        "nominal_state": now.x,
        "nominal_control": nominal,
        "feedback_gain": C,
        "filter_gain": L,
    }
    return Stepped(fields=fields, good=good, missing=missing)


def about(design: Design, own: tuple[str, ...] = ABOUT) -> tuple[str, ...]:
    """What is said of a law, with what is read at instants where something is."""
    read = ABOUT_INSTANTS if design.always < design.sizes[2] else ()
    turns = (ABOUT_ATTITUDES,) if any(block.tangent for block in design.statement.states) else ()
    return (*own, *read, *turns, *(ABOUT_FIRST if design.reads_first else ()))


def finite(estimate: Expr, feedback: Expr) -> Any:
    """Whether an estimate and the control that follows from it may be used; false for NaN, which mmax leaves out."""
    return ca.sum1(ca.fabs(estimate)) + ca.sum1(ca.fabs(feedback)) <= LARGEST


def input_ports(design: Design) -> tuple[Port, ...]:
    """Ports of the inputs of a step; those that are held take the place of fields of the struct."""
    n, m, r = design.sizes
    sizes = {"estimate": n, "last": 1, "held": m, "measurement": r, "time": 1}
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
    shapes |= {"control": (m, 1), "nominal_control": (m, 1)}
    units = {"time": "s"}
    about = {
        "time": "of the last step",
        "estimate": "of the deviation of the state (and of unknown constants) from the nominal",
        "control": "given out by the last step and held since; overwrite it where another one was applied",
        "nominal_state": "the nominal at that time",
        "nominal_control": "the nominal at that time",
        "feedback_gain": "C",
        "filter_gain": "L of the last step; zero for rows that were left out",
        "index": "of the last sample",
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
        whole = name in ("index", "status")
        port = Port(name=name, rows=rows, columns=columns, unit=unit, about=about[name], entries=listed, whole=whole)
        ports.append(port)
    return tuple(ports)


def with_units(statement: Statement, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of entries, or of rows of an error, with the units of their symbols: of an attitude that of the error."""
    blocks = (*statement.blocks, *measured_blocks(statement))
    units = {name: block.unit for block in blocks for name in (error_names if block.tangent else entry_names)((block,))}
    return tuple(f"{name} [{units[name]}]" if units.get(name) else name for name in names)


def first_fields(
    design: Design, tables: History, fields: dict[str, Any], last: str, gain: Array | None = None
) -> Array:
    """First values of the fields: the filter at the mean, the nominal at time zero, its control within the limits.

    Where something is read at time zero the field `last`, that of the last step, says that there was none. The gain is
    that of the design, where another one is flown (m, n) that one.
    """
    m = design.sizes[1]
    zeros = {name: np.zeros(int(np.prod(value.shape))) for name, value in fields.items()}
    x, u, e = (values[0] for values in tables.rows(np.zeros(1)))
    zeros |= {
        "control": np.clip(u[:m], *design.limits),
        "nominal_control": u[:m],
        "nominal_state": x,
    }
    if design.reads_first:
        zeros[last] = np.array([NO_STEP])
    zeros["feedback_gain"] = np.ravel(design.gain(x, u, e, 0.0)[0].full() if gain is None else gain)
    return np.concatenate(list(zeros.values()))


def solved(matrix: Expr, right: Expr) -> Any:
    """matrix^-1 right: written out in scalars where the expressions are SX, by QR factors otherwise."""
    return ca.solve(matrix, right) if isinstance(matrix, ca.SX) else linear_solve(matrix, right, COMPILED_SOLVER)


def solved_in_units(spread: Expr, right: Expr) -> Any:
    """`solved` for a covariance, in units of its standard deviations."""
    units = ca.diag(1.0 / ca.sqrt(ca.diag(spread)))
    return units @ solved(units @ spread @ units, units @ right)


def _predict(
    design: Design, given: tuple[Any, Any, Any], nominal: list[Nominal], at: list[Any], h: Expr
) -> tuple[Any, Any]:
    """Estimate and covariance of its error before the measurement, computed in units of typical deviations.

    Args:
        design: the model.
        given: estimate, covariance of its error and control held since the last step.
        nominal: at both Gauss points of the step.
        at: their times [s].
        h: length of the step [s].
    """
    st, (n, m, _) = design.statement, design.sizes
    units, inverse = ca.diag(ca.DM(design.units)), ca.diag(1.0 / ca.DM(design.units))
    kind = design.symbolic if n <= SCALAR_SIZE else ca.MX
    own, error, du, dt = kind.sym("y", n), kind.sym("E", n, n), kind.sym("held", m), kind.sym("h")
    symbols = [[kind.sym("x", st.nx), kind.sym("u", st.nu), kind.sym("t")] for _ in at]
    slopes = [design.model(*three)[:2] for three in symbols]
    points = [dt * (inverse @ F @ units) for F, _ in slopes]
    forcing = [dt * (inverse @ (G @ (du - three[1][:m]))) for (_, G), three in zip(slopes, symbols, strict=True)]
    change, transition = gauss_step(points, forcing, inverse @ own, ca.DM.eye(n), solved)
    value, move = own + units @ change, units @ transition @ inverse
    spread = move @ error @ move.T + dt * design.noise(*symbols[1])
    inputs = [own, error, du, dt, *symbols[0], *symbols[1]]
    function = ca.Function("predict", inputs, [ca.densify(value), ca.densify(spread)])
    nodes = [(now.x, now.u, t) for now, t in zip(nominal, at, strict=True)]
    value, spread = function(*given, h, *nodes[0], *nodes[1])
    return value, spread


def _corrected(
    design: Design, predicted: tuple[Any, Any], given: tuple[Any, ...], now: Nominal, time: Expr
) -> tuple[Any, ...]:
    """Estimate after the measurement, feedback gain, filter gain, whether a row of the measurement is missing.

    Args:
        design: the model.
        predicted: estimate and covariance of its error before.
        given: control held, measurement, length of the step, which rows are there.
        now: the nominal.
        time: of the measurement.
    """
    st, (n, m, r) = design.statement, design.sizes
    kind = design.symbolic if r <= SCALAR_SIZE else ca.MX
    y, held, measured, h = kind.sym("y", n), kind.sym("held", m), kind.sym("measurement", r), kind.sym("h")
    due = kind.sym("due", r)
    x, u, e, t = kind.sym("x", st.nx), kind.sym("u", st.nu), kind.sym("e", st.ne), kind.sym("t")
    model = design.model(x, u, t)
    expected, M, slope, U = model.h, model.M, model.H, model.U
    E, C = kind.sym("E", n, n), design.gain(x, u, e, t)[0]
    if r == 0:  # a phase that measures nothing: prediction alone, which the feedback goes on acting on
        gain = ca.Function("feedback", [x, u, e, t], [ca.densify(C)])
        return predicted[0], gain(now.x, now.u, now.e, time), ca.MX(n, 0), ca.MX(0)
    present = ca.fabs(measured) <= LARGEST
    residual = ca.if_else(present, measured - expected - M @ y - slope @ (held - u[:m]), 0.0)
    if design.always == r:
        L, _ = innovation_gain(h * E, *without(present, M, U), solved_in_units)
    else:  # sqrt(h) of what is measured all the time, so that its noise is U; what is read has its variance
        roots = ca.vertcat(ca.repmat(ca.sqrt(h), design.always, 1), kind.ones(r - design.always))
        L, _ = innovation_gain(E, *without(present, ca.diag(roots) @ M, U), solved_in_units)
        L = L @ ca.diag(roots)
    missing = ca.sum1(due * (1 - present)) > 0
    outputs = [ca.densify(v) for v in (y + L @ residual, C, L, missing)]
    function = ca.Function("correct", [y, E, held, measured, h, due, x, u, e, t], outputs)
    return tuple(function(*predicted, *given, now.x, now.u, now.e, time))


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


def _root(covariance: Array) -> Array:
    """A factor of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.clip(values, 0.0, None)))
