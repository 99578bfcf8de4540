"""Perturbation filter and feedback for samples of a fixed period: everything but a few products is done beforehand.

For the samples t_k = k period, with y the estimate of the deviation and w the control held since the last sample,

    y-_k = Phi_k y_(k-1) + Gamma_k w + g_k,          g_k = - int Phi G u dt: the nominal goes on, the control is held
    y_k  = y-_k + L_k (m_k - h_k - M_k y-_k - H_k (w - u_k)),      u_k  =  u(t_k) - C(t_k) y_k,

the control within the limits, where there are some.

Phi, Gamma, g by the two-stage Gauss method between the nodes of the mesh. L_k = P- M' (M P- M' + U/period)^-1 is the
gain of the discrete filter: P from E(0) by the same method, each measurement with the noise of one period. C(t_k) is
the gain of the control that is held over a period: the best one by the discrete Riccati recursion (`sampled_gain`), or
that of the design where its gain was constrained.

Of a measurement whose rows p are there the gain is P- M_p' (M_p P- M_p' + U_pp/period)^-1, P- of the full filter. As
P- M' = L S with S = M P- M' + U/period, that is L S_.p S_pp^-1: the residuals that are missing are expected from the
others. Only S has to be known, and only a system of the size of the measurement is solved, where a row is missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import ExportError
from covocp.base.expressions import Expr
from covocp.base.gains import innovation_gain
from covocp.base.matrices import Array, pack, stacked, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.blocks.updates import joseph_form
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
from covocp.export.laws.moves import WHOLE, Moves
from covocp.export.laws.prediction import CONTINUE, SCALAR_SIZE, solved
from covocp.export.laws.sampled_gain import flown_covariances, sampled_gains

MOST_SAMPLES = 200_000
# Share of a period by which an instant may miss a sample.
SAME_INSTANT = 1e-6
HELD = {"estimate": "estimate", "last": "index", "held": "control"}
ABOUT = (
    "Perturbation filter and feedback for samples of a fixed period; call it once a period. The time chooses the "
    "nearest sample; samples that were left out are predicted over, one loop for each. The control returned is held "
    "until the next call. The estimate y of the deviation from the nominal is predicted by Phi y + Gamma u_held + g "
    "and corrected by L (m - what is expected), L of the discrete filter whose measurements have the noise of one "
    "period; the control is u - C y.",
    "A row of the measurement that is not finite is left out (readings beyond 1e30 count as not finite): L is then "
    "P- M' (M P- M' + U/period)^-1 of the other rows, P- that of the filter with all of them. At time zero the control "
    "is that of the nominal.",
)
ABOUT_INSTANTS = (
    "Rows of the measurement that are read at instants count with their variance at the sample of their instant "
    "alone, and once. Between the instants they are left out, whatever they are, without a status; NaN is no missing "
    "row then. A reading that comes later than its sample is lost.",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Tables, a row for each sample from 0 to K: nominal and gains there, transition from the sample before.

    parts: by name, (K + 1, rows, columns); period [s]; times: of the samples (K + 1,) [s]; flown: covariance of the
    deviation from the nominal there, as the loop flies with these gains, (K + 1, n, n).
    """

    parts: dict[str, Array]
    period: float
    times: Array
    flown: Array

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
    n, m, r = design.sizes
    period = samples.period
    y, last, held = ca.MX.sym("estimate", n), ca.MX.sym("last"), ca.MX.sym("held", m)
    measured, time = ca.MX.sym("measurement", r), ca.MX.sym("time")
    least = NO_STEP if design.reads_first else 0.0
    begun = ca.fmax(last, least)  # a struct that was never set must not lead out of the tables
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
    residual = measured - at["h"] - at["M"] @ before - at["H"] @ (held - at["u"])
    L = _gain_of_rows(at, present, missing) * ca.logic_and(ahead, ca.logic_not(more))
    corrected = before + L @ ca.if_else(finite_rows, residual, 0.0)
    feedback = at["C"] @ corrected
    good = finite(corrected, feedback)
    estimate = ca.if_else(good, corrected, y)
    moved = at["u"] - ca.if_else(ca.logic_and(good, valid), feedback, 0.0)
    conditions = [
        *clock.conditions, (backwards, "TIME_BACKWARDS"), (ca.logic_not(good), "ESTIMATE_LOST"),
        (missing, "MEASUREMENT_MISSING"),
    ]  # fmt: skip
    kept = ca.if_else(valid, index, begun)
    fields = {
        "time": ca.fmax(kept, 0.0) * period if design.reads_first else kept * period,
        "estimate": estimate,
        "control": ca.if_else(more, held, clipped(moved, design.limits)),
        "index": kept,
        "nominal_state": at["x"],
        "nominal_control": at["u"],
        "feedback_gain": at["C"],
        "filter_gain": L,
        "status": ca.if_else(more, CONTINUE, status_of(conditions)),
    }
    core = ca.Function("step", [y, last, held, measured, time], [flat(v) for v in fields.values()])
    limits = (design.statement, design.limits)
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
        statuses=STATUSES,
        held=HELD,
        start=first_fields(design, tables, fields, "index", samples.parts["C"][0]),
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
    M, noise = M * told, _noise_of(design, U, told, period)
    held_on = tables.duration - t[-1] > WHOLE * period
    moves = Moves.of(design, tables, np.append(t, tables.duration) if held_on else t)
    if design.best_gain:
        C = sampled_gains(moves, design.final_weight, t.size)
    n, m, r = design.sizes
    Phi, Gamma, g = np.zeros((count + 1, n, n)), np.zeros((count + 1, n, m)), np.zeros((count + 1, n, 1))
    Phi[0], P, gains, spreads = np.eye(n), design.prior, [], []
    for k in range(count + 1):
        if k:
            Phi[k], Gamma[k], g[k], P = moves.over(k - 1, P)
        gain, spread = innovation_gain(P, M[k], noise[k], np.linalg.solve)
        P = joseph_form(P, gain, M[k], noise[k])
        gains.append(gain)
        spreads.append(spread)
    L = np.array(gains)
    parts = {"x": x[:, :, None], "u": u[:, :m, None], "h": h, "M": M, "H": H, "C": C, "Phi": Phi, "Gamma": Gamma}
    parts |= {"g": g, "L": L}
    if design.always < r:
        parts["due"] = due
    if r > 1:
        parts["spread"] = _correlations(np.array(spreads))[:, :, None]
    with np.errstate(over="ignore", invalid="ignore"):  # a loop that diverges is told by its numbers
        flown = flown_covariances(moves, period, design.prior, C, L, M, H, noise)
    return Samples(parts=parts, period=period, times=t, flown=flown)


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


def _noise_of(design: Design, U: Array, due: Array, period: float) -> Array:
    """Variances of what is measured: of the mean over a period, of what is read; one where nothing is."""
    always = np.arange(U.shape[1]) < design.always
    noise = np.where(always[:, None] & always, U / period, U)
    there = due * due.transpose(0, 2, 1)
    return np.asarray(noise * there + np.eye(U.shape[1]) * (1.0 - due))


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
    n, m, _ = design.sizes
    return (
        Port(name="estimate", rows=n),
        Port(name="last"),
        Port(name="held", rows=m),
        measurement_port(design),
        Port(name="time", unit="s", about="of the measurement"),
    )


def _points(design: Design, tables: History, samples: Samples, random: np.random.Generator, count: int) -> Array:
    """As for any time between two steps, the last step at a sample a few periods before."""
    rows = points(design, tables, random, count)[:, : stacked_size(_ports(design))]
    place = span(_ports(design), "last")
    before = random.choice([0, 1, 1, 1, 1, 2, 5, -1], count)
    time = np.nan_to_num(rows[:, -1], nan=0.0, posinf=tables.duration, neginf=0.0)
    index = np.floor(np.clip(time, 0.0, tables.duration) / samples.period + 0.5)
    least = NO_STEP if design.reads_first else 0
    rows[:, place] = np.clip(index - before, least, samples.count)[:, None]
    return rows
