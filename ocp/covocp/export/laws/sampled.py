"""Perturbation filter and feedback for samples of a fixed period: everything but a few products is done beforehand.

For the samples t_k = k period, with y the estimate of the deviation and w the control held since the last sample,

    y-_k = Phi_k y_(k-1) + Gamma_k w + g_k,          g_k = - int Phi G u dt: the nominal goes on, the control is held
    y_k  = y-_k + L_k (m_k - h_k - M_k y_(k-1) - H_k w),           u_k  =  mean of u - C(t_k) y_k,

the mean over the period that comes, the control within the limits, where there are some. Held at its value at t_k the
nominal control would be half a period behind.

The measurement m_k is the mean over the period before, and h_k + M_k y_(k-1) + H_k w the mean that is expected: of h(x,
u) + M y- + H (w - u) along the nominal, y- as it moves in the period. What is read at an instant is expected there.

Phi, Gamma, g, h, M, H by the two-stage Gauss method between the nodes of the mesh. L_k = B A^-1 is the gain of the
discrete filter: A the covariance of what is new in the mean, its noise of one period included, B that between it and
the error of y-, from E(0) by the same method; P- M' (M P- M' + U/period)^-1 for a short period. C(t_k) is
the gain of the control that is held over a period: the best one by the discrete Riccati recursion (`sampled_gain`), or
that of the design where its gain was constrained.

Of a measurement whose rows p are there the gain is B_.p A_pp^-1, both of the full filter. As B = L A, that is
L A_.p A_pp^-1: the residuals that are missing are expected from the others. Only A has to be known, and only a system
of the size of the measurement is solved, where a row is missing.

Where samples are left out the measurement is the mean since the last step: of the means of the periods, with the gain
of the last of them.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError
from covocp.base.expressions import Expr
from covocp.base.matrices import Array, pack, stacked, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.export.laws.controller import (
    NO_STEP,
    STATUSES,
    about,
    field_ports,
    finite,
    first_fields,
    measurement_port,
    points,
)
from covocp.export.laws.design import Design
from covocp.export.laws.history import History
from covocp.export.laws.law import LARGEST, Law, Port, flat, span, stacked_size, status_of
from covocp.export.laws.limits import clipped, limit_constants, limits_notes, limits_text
from covocp.export.laws.moves import WHOLE, Moves, Period
from covocp.export.laws.prediction import CONTINUE, SCALAR_SIZE, solved
from covocp.export.laws.sampled_gain import flown_covariances, flown_means, sampled_gains

MOST_SAMPLES = 200_000
# Share of a period by which an instant may miss a sample.
SAME_INSTANT = 1e-6
OWN_STATUSES = (*STATUSES, "SAMPLES_SKIPPED", "READING_IGNORED")
HELD = {"estimate": "estimate", "last": "index", "held": "control", "expected": "expected", "passed": "passed"}
ABOUT = (
    "Perturbation filter and feedback for samples of a fixed period; call it once a period. The time chooses the "
    "nearest sample; samples that were left out are predicted over, one loop for each, and the status says so, as the "
    "gain is that of one period. The control returned is held until the next call, so it is the mean of the nominal "
    "control over the coming period, u_mean - C y. The estimate y of the deviation from the nominal is predicted by "
    "Phi y + Gamma u_held + g and corrected by L (m - what is expected), L of the discrete filter whose measurements "
    "have the noise of one period. The measurement m is the mean of what is measured since the last call, and is "
    "compared with the mean that is expected up to the sample: a call that is late by d is told h' d more than that, "
    "and takes it for a deviation.",
    "A row of the measurement that is not finite is left out (readings beyond 1e30 count as not finite): L is then "
    "the gain of the other rows in the filter with all of them. At time zero the control is the mean of the nominal.",
)
ABOUT_INSTANTS = (
    "Rows of the measurement that are read at instants are compared with what is expected then, and count with "
    "their variance at the sample of their instant "
    "alone, and once. Between the instants they are left out, whatever they are, without a status; NaN is no missing "
    "row then. A reading that comes later than its sample is lost.",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Tables, a row for each sample from 0 to K: nominal and gains there, transition from the sample before.

    parts: by name, (K + 1, rows, columns); period [s]; times: of the samples (K + 1,) [s]; flown: covariance of the
    deviation from the nominal there, as the loop flies with these gains, (K + 1, n, n); lag: its mean, which comes from
    holding the control, (K + 1, n).
    """

    parts: dict[str, Array]
    period: float
    times: Array
    flown: Array
    lag: Array

    __repr__ = short_repr

    @property
    def count(self) -> int:
        """K."""
        return int(self.parts["u"].shape[0]) - 1

    def at(self, k: Expr) -> dict[str, Any]:
        """The matrices of a sample, MX expressions; flat by columns as CasADi has them, so that none is turned."""
        flat_rows = np.hstack([part.transpose(0, 2, 1).reshape(part.shape[0], -1) for part in self.parts.values()])
        column = ca.MX(ca.DM(flat_rows.T))[:, k]
        result, offset = {}, 0
        for name, part in self.parts.items():
            rows, columns = part.shape[1:]
            result[name] = ca.reshape(column[offset : offset + rows * columns], rows, columns)
            offset += rows * columns
        return result


def sampled_law(design: Design, tables: History, samples: Samples, tolerance: float) -> Law:
    """The law (estimate, last sample, held control, measurement, time) -> control and all that the struct keeps."""
    (n, m, r), always = design.sizes, design.always
    period = samples.period
    y, last, held = ca.MX.sym("estimate", n), ca.MX.sym("last"), ca.MX.sym("held", m)
    measured, time = ca.MX.sym("measurement", r), ca.MX.sym("time")
    summed, given = ca.MX.sym("expected", always), ca.MX.sym("passed")
    least = NO_STEP if design.reads_first else 0.0
    begun = ca.fmax(last, least)  # a struct that was never set must not lead out of the tables
    passed = ca.fmin(ca.fmax(given, 0.0), float(samples.count))  # nor to a count that is no int
    clock = tables.clock(time, ca.fmax(begun, 0.0) * period)
    wanted = ca.fmin(ca.fmax(ca.floor(clock.time / period + 0.5), 0.0), float(samples.count))
    backwards = wanted < begun
    valid = ca.if_else(backwards, 0.0, clock.within)
    ahead = ca.if_else(valid, wanted > begun, 0.0)
    index = ca.if_else(valid, begun + ahead, wanted)
    more = ca.if_else(ahead, wanted > index, 0.0)
    at = samples.at(index)
    finite_rows = ca.fabs(measured) <= LARGEST
    present = finite_rows if "due" not in at else ca.if_else(at["due"], finite_rows, 1.0)
    missing = ca.sum1(present) < r
    before = ca.if_else(ahead, at["Phi"] @ y + at["Gamma"] @ held + at["g"], y)
    expected = at["h"] + at["M"] @ y + at["H"] @ held
    total = summed + expected[:always, 0]  # of the means of all periods since the last step
    residual = measured - ca.vertcat(total / (passed + 1.0), expected[always:, 0])
    L = _gain_of_rows(at, present, missing) * ca.logic_and(ahead, ca.logic_not(more))
    corrected = before + L @ ca.if_else(finite_rows, residual, 0.0)
    feedback = at["C"] @ corrected
    good = finite(corrected, feedback)
    estimate = ca.if_else(good, corrected, y)
    moved = ca.if_else(valid, at["mean"], at["u"]) - ca.if_else(ca.logic_and(good, valid), feedback, 0.0)
    again = ca.logic_and(begun > 0.0, wanted == begun)
    ignored = ca.logic_and(again, ca.sum1(finite_rows[:always, 0]) > 0) if always else ca.MX(0)
    conditions = [
        *clock.conditions, (backwards, "TIME_BACKWARDS"), (ca.logic_not(good), "ESTIMATE_LOST"),
        (missing, "MEASUREMENT_MISSING"), (passed > 0.0 if always else ca.MX(0), "SAMPLES_SKIPPED"),
        (ignored, "READING_IGNORED"),
    ]  # fmt: skip
    kept = ca.if_else(valid, index, begun)
    fields = {
        "time": ca.fmax(kept, 0.0) * period if design.reads_first else kept * period,
        "estimate": estimate,
        "control": ca.if_else(more, held, clipped(moved, design.limits)),
        "index": kept,
        **({"expected": ca.if_else(more, total, 0.0), "passed": ca.if_else(more, passed + 1.0, 0.0)} if always else {}),
        "nominal_state": at["x"],
        "nominal_control": at["u"],
        "feedback_gain": at["C"],
        "filter_gain": L,
        "status": ca.if_else(more, CONTINUE, status_of(conditions)),
    }
    core = ca.Function(
        "step",
        [y, last, held, measured, time, *((summed, given) if always else ())],
        [flat(v) for v in fields.values()],
    )
    return _law(design, tables, samples, core, fields, tolerance)


def _law(
    design: Design, tables: History, samples: Samples, core: ca.Function, fields: dict[str, Any], tolerance: float
) -> Law:
    """What a step is and how it is called, beside its function; `fields`: what it returns, by name."""
    limits, period = (design.statement, design.limits), samples.period
    spoken = f"Period: {period!r} s; {samples.count + 1} samples, the last at {samples.count * period:g} s."
    return Law(
        name="step",
        kind="controller",
        about=(*about(design, (*ABOUT, *(ABOUT_INSTANTS if design.reads else ()))), spoken, limits_text(*limits)),
        notes=limits_notes(*limits),
        constants={"PERIOD [s]": period} | limit_constants(*limits),
        core=core,
        inputs=_ports(design),
        outputs=field_ports(design, fields),
        statuses=OWN_STATUSES,
        held={name: kept for name, kept in HELD.items() if kept in fields},
        start=first_fields(design, tables, fields, "index", samples.parts["C"][0], samples.parts["mean"][0, :, 0]),
        points=lambda random, count: _points(design, tables, samples, random, count),
        tolerance=tolerance,
    )


def _gain_of_rows(at: dict[str, Any], present: Expr, missing: Expr) -> Any:
    """L of the rows that are there, the columns of the others zero; a system is solved only where some are missing."""
    n, r = at["L"].shape
    if r == 1:
        return at["L"] * present
    kind: Any = ca.SX if r <= SCALAR_SIZE else ca.MX
    L, spread, rows = kind.sym("L", n, r), kind.sym("spread", at["spread"].shape[0]), kind.sym("present", r)
    packed = unpack_symbolic(spread, r)
    units = ca.diag(packed)
    correlation = packed - ca.diag(units) + ca.DM.eye(r)
    kept = ca.diag(rows)
    among = kept @ correlation @ kept + ca.diag(1 - rows)
    # S_.p S_pp^-1 in units of the standard deviations of the residuals
    completed = solved(among, kept @ correlation).T @ kept
    masked = (L @ ca.diag(units)) @ completed @ ca.diag(1.0 / units)
    arguments = [L, spread, rows]
    some = ca.Function("some", arguments, [ca.densify(masked)])
    every = ca.Function("every", arguments, [L])
    chosen: Any = ca.Function.if_else("gain", some, every)
    return chosen(missing, at["L"], at["spread"], present)


def discretised(design: Design, tables: History, period: float) -> Samples:
    """Transitions and gains for samples of a period.

    Args:
        design: continuous model and gains along the nominal.
        tables: the nominal.
        period: of the samples [s].

    Raises:
        ExportError: less than one period, or too many.
    """
    count = int(np.floor(tables.duration / period + WHOLE))
    if not 1 <= count <= MOST_SAMPLES:
        raise ExportError(
            "The period of the controller does not fit the duration.",
            expected=f"1 to {MOST_SAMPLES} periods within {tables.duration:g} s",
            received=f"period={period!r}",
            remedy="choose another period; period=None takes any time between two steps",
        )
    t = np.minimum(np.arange(count + 1) * period, tables.duration)
    x, u, e, h, M, H, U, C = _at_samples(design, tables, t)
    due = _due(design, t, period)
    told = due.copy()
    told[0, : design.always] = 0.0  # no time has passed of which a mean could tell
    held_on = tables.duration - t[-1] > WHOLE * period
    moves = Moves.of(design, tables, np.append(t, tables.duration) if held_on else t)
    if design.best_gain:
        C = sampled_gains(moves, design.final_weight, t.size)
    n, m, r = design.sizes
    reads = (h - H @ u[:, :m, None], M, H, U)
    periods = [_told(moves, k, period, [part[k] for part in reads], told[k, :, 0]) for k in range(count + 1)]
    P, gains, spreads = design.prior, [], []
    for own, there in zip(periods, told, strict=True):
        gain, spread, P = _updated(own, P, there)
        gains.append(gain)
        spreads.append(spread)
    L = np.array(gains)
    state, held, offset = (np.array([getattr(own, name) for own in periods]) for name in ("state", "held", "offset"))
    parts = {"x": x[:, :, None], "u": u[:, :m, None], "h": offset[:, n:], "M": state[:, n:], "H": held[:, n:]}
    ends = np.append(t[1:], tables.duration)
    begins, until = ca.MX.sym("begins"), ca.MX.sym("until")
    mean = ca.Function("mean", [begins, until], [tables.mean_control(begins, until)[:m]])
    parts["mean"] = np.asarray(mean.map(t.size)(t[None, :], ends[None, :]).full()).T[:, :, None]
    parts |= {"C": C, "Phi": state[:, :n], "Gamma": held[:, :n], "g": offset[:, :n], "L": L}
    if design.always < r:
        parts["due"] = due
    if r > 1:
        parts["spread"] = _correlations(np.array(spreads))[:, :, None]
    with np.errstate(over="ignore", invalid="ignore"):  # a loop that diverges is told by its numbers
        zero = periods[0]
        flown = flown_covariances(periods, design.prior, C, L, zero.state[n:], zero.noise[n:, n:])
        lag = flown_means(periods, C, parts["mean"][:, :, 0], design.limits)
    return Samples(parts=parts, period=period, times=t, flown=flown, lag=lag)


def _due(design: Design, t: Array, period: float) -> Array:
    """Which values are there at the samples, 1 or 0, (K + 1, r, 1).

    Raises:
        ExportError: an instant is no sample.
    """
    names = [block.name for block in design.measured for _ in range(block.size)]
    rows = []
    for name, times in zip(names, design.instants, strict=True):
        if times is None:
            rows.append(np.ones(t.size))
            continue
        near = np.abs(t[:, None] - times) <= SAME_INSTANT * period
        missed = times[~near.any(axis=0)]
        if missed.size:
            raise ExportError(
                f"'{name}' is read at instants that are no samples of the controller.",
                expected=f"multiples of the period, {period:g} s",
                received=", ".join(f"{value:g} s" for value in missed[:3]) + (", ..." if missed.size > 3 else ""),
                remedy="choose a period that divides the time between the instants; period=None takes any time",
            )
        rows.append(near.any(axis=1).astype(float))
    return np.array(rows).T[:, :, None]


def _told(moves: Moves, k: int, length: float, reads: list[Array], told: Array) -> Period:
    """What is told at sample k: means over the period before, and what is read, by the deviation at the sample before.

    Args:
        moves: between the samples.
        k: number of the sample; nothing moves before the first one.
        length: of a period [s].
        reads: h - H u, M, H, variance of all values at the sample, of which those that are read at instants count.
        told: which values tell something there, 1 or 0, (r,).
    """
    n, m, always = moves.sizes
    if k:
        moved = moves.measuring(k - 1)
    else:
        rest = np.zeros((n + always, n + always))
        moved = Period(state=np.eye(n + always, n), held=rest[:, :0], offset=rest[:, :1], noise=rest)
        moved = moved._replace(held=np.zeros((n + always, m)), offset=np.zeros((n + always, 1)))
    (h, M, H, R), size, there = (part for part in reads), n + always, told[:, None]
    h, M, H, R = (part[always:] for part in (h, M, H, R))
    every = np.vstack([np.eye(n, size), np.eye(size)[n:] / length, M @ np.eye(n, size)])
    every[n:] *= there
    state, held, offset = every @ moved.state, every @ moved.held, every @ moved.offset
    held[size:] += H
    offset[size:] += h
    noise = every @ moved.noise @ every.T
    noise[size:, size:] += R[:, always:] * there[always:] * there[always:].T
    return Period(state=state, held=held, offset=offset, noise=noise)


def _updated(period: Period, P: Array, told: Array) -> tuple[Array, Array, Array]:
    """Gain of what is told, covariance of what is new in it (one where nothing is told), P after it.

    Args:
        period: what is told, by the deviation at the sample before.
        P: covariance of the error there, (n, n).
        told: which values tell something, 1 or 0, (r, 1).
    """
    n = P.shape[0]
    joint = period.state @ P @ period.state.T + period.noise
    spread = joint[n:, n:] + np.diag(1.0 - told[:, 0])
    gain = np.linalg.solve(spread, joint[n:, :n]).T
    left = np.hstack([np.eye(n), -gain])
    after = left @ joint @ left.T
    return np.asarray(gain), spread, 0.5 * (after + after.T)


def _correlations(spreads: Array) -> Array:
    """Covariances as half-vectors of their correlations, standard deviations on the diagonal: floats hold them too."""
    units = np.sqrt(np.diagonal(spreads, axis1=1, axis2=2))
    correlations = spreads / (units[:, :, None] * units[:, None, :])
    rows = np.arange(spreads.shape[1])
    correlations[:, rows, rows] = units
    return pack(correlations)


def _at_samples(design: Design, tables: History, t: Array) -> tuple[Array, ...]:
    """x, u, e, h, M, H, U, C at the samples."""
    x, u, e = tables.rows(t)
    h, M, H, U = (stacked(v, t.size) for v in design.model(x.T, u.T, t[None, :])[2:])
    C = stacked(design.gain.map(t.size)(x.T, u.T, e.T, t[None, :])[0], t.size)
    return x, u, e, h, M, H, U, C


def _ports(design: Design) -> tuple[Port, ...]:
    """Ports of the inputs."""
    (n, m, _), always = design.sizes, design.always
    under_way = (Port(name="expected", rows=always), Port(name="passed")) if always else ()
    return (
        Port(name="estimate", rows=n),
        Port(name="last"),
        Port(name="held", rows=m),
        measurement_port(design),
        Port(name="time", unit="s", about="of the measurement"),
        *under_way,
    )


def _points(design: Design, tables: History, samples: Samples, random: np.random.Generator, count: int) -> Array:
    """As for any time between two steps, the last step at a sample a few periods before."""
    ports, found = _ports(design), points(design, tables, random, count)
    rows = np.zeros((count, stacked_size(ports)))
    shared = span(ports, "time").stop
    rows[:, :shared] = found[:, :shared]
    place, under_way = span(ports, "last"), random.integers(0, 3, count) * (random.uniform(size=count) < 0.2)
    before = random.choice([0, 1, 1, 1, 1, 2, 5, -1], count)
    time = np.nan_to_num(rows[:, shared - 1], nan=0.0, posinf=tables.duration, neginf=0.0)
    index = np.floor(np.clip(time, 0.0, tables.duration) / samples.period + 0.5)
    least = NO_STEP if design.reads_first else 0
    rows[:, place] = np.clip(index - before, least, samples.count)[:, None]
    if design.always:
        seen = samples.parts["h"][np.clip(index, 0, samples.count).astype(int), : design.always, 0]
        rows[:, span(ports, "expected")] = under_way[:, None] * seen
        rows[:, span(ports, "passed")] = under_way[:, None]
    return rows
