"""The extended Kalman filter of a problem: its actual system, with the unknowns as states that stay constant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args, overload

import casadi as ca
import numpy as np

from covocp.base.checks import check_kind, column
from covocp.base.errors import ProblemError
from covocp.base.geometry import Geometry
from covocp.base.matrices import Array, unpack
from covocp.blocks.bucy import time_step
from covocp.blocks.extended import Estimated, bucy_slopes, corrected_by, propagated
from covocp.blocks.updates import Form, Missing
from covocp.problem.builder import Problem
from covocp.problem.decisions import decisions_of
from covocp.problem.rates import process_noise
from covocp.statement.names import name_of
from covocp.statement.statement import Statement

Reading = Literal["end", "mean"]
# Share of the noise of a mean that is in what is expected of it: neither this nor the rest is singular then, as the
# information form needs them. Their sum alone counts.
AVERAGED = 0.5
# Values of decisions by symbol or name.
Decided = Mapping[Any, Any] | None


@overload
def extended_filter(
    problem: Problem, *, step: None = None, duration: float | None = None, decisions: Decided = None
) -> ca.Function: ...
@overload
def extended_filter(
    problem: Problem,
    *,
    step: float,
    substeps: int = 1,
    form: Form = "joseph",
    missing: Missing = "raise",
    reading: Reading = "end",
    duration: float | None = None,
    decisions: Decided = None,
) -> tuple[ca.Function, ca.Function]: ...
def extended_filter(
    problem: Problem,
    *,
    step: float | None = None,
    substeps: int = 1,
    form: Form = "joseph",
    missing: Missing = "raise",
    reading: Reading = "end",
    duration: float | None = None,
    decisions: Decided = None,
) -> ca.Function | tuple[ca.Function, ca.Function]:
    """Extended Kalman filter of the actual system of a problem; its rows are those of the estimation covariance.

    The estimate of an attitude is its quaternion, which is corrected by rotations (the multiplicative filter).

    Continuous: the Kalman-Bucy filter with slopes at the estimate [Schmidt 2.5-3]. Discrete: the same model sampled
    (item 8); the noise of a reading, that of the measurement averaged over a step, has the covariance density / step.
    What else a reading is has to be said: by default the value that is measured at the end of the step, else the mean
    over the step, as `simulate` tells it to a law. Half a step of the motion lies between the two, which the filter
    would take for an error of its estimate.
    What is measured at instants is read at the end of a step, with its variance, in the rows below the others; NaN
    where nothing is. What is read at time zero is an update before the first step.

    Args:
        problem: with noise and measurements as declared; parameters have their values.
        step: between readings [s], controls are held over it; None: continuous.
        substeps: of a step.
        form: of the update, see `kalman.update`.
        missing: "raise": readings are trusted, "skip": a row that is NaN is no measurement.
        reading: what a reading is compared with: "end": the value expected at the end of the step, "mean": the mean
            expected over the step. Estimate and covariance between predict and update then have rows for that mean
            below the others: each prediction is followed by an update, all NaN where nothing was measured.
        duration: T [s], where it is free and the system depends on it; None: its guess.
        decisions: their values by symbol or name; needed where there are any.

    Returns:
        Continuous: (x, P, u, y, t) -> dx/dt, dP/dt. Discrete: predict (x, P, u, t) -> x, P a step later, with t at the
        start of it, and update (x, P, y, u, t) -> x, P after the reading, with t at the end.

    Raises:
        ProblemError: no `Problem` or an incomplete one, dynamics that depend on matrices, a step that is not positive,
            a decision without a value; measurements at instants without a step, or where missing ones are not skipped.
    """
    system = _System(problem, duration, decisions)
    _check_instants(problem, step, missing)
    _check_reading(reading, step)
    x, P, u, t = system.symbols
    if step is None:
        value, density = system.measured(x, t, u)
        y = type(x).sym("y", value.shape[0])
        process = (system.rate(x, t, u), system.noise(x, t, u))
        slopes = bucy_slopes(x, P, y, process, (value, density), system.geometry)
        return ca.Function("rate", [x, P, u, y, t], slopes, ["x", "P", "u", "y", "t"], ["dx", "dP"])
    return _sampled(system, time_step(step), substeps, form, missing, means=reading == "mean")


def _sampled(
    system: _System, step: float, substeps: int, form: Form, missing: Missing, *, means: bool
) -> tuple[ca.Function, ca.Function]:
    """Prediction and update; with means the measurement is integrated beside the state, as another one of its rows."""
    x, P, u, t = system.symbols
    names = ["estimate", "covariance"]
    count, n = system.measured(x, t, u)[0].shape[0] if means else 0, P.shape[0]
    start = Estimated(ca.vertcat(x, type(x).zeros(count)), ca.diagcat(P, type(x)(count, count)), t, u)
    geometry = Geometry.stacked(system.geometry, count) if count else system.geometry
    rate, noise = system.averaging(count, step)
    ahead = propagated(rate, noise, start, step, substeps, geometry)
    # between prediction and update
    z, S = type(x).sym("x", x.shape[0] + count), type(x).sym("P", n + count, n + count)
    own, mean = ca.vertsplit(z, [0, x.shape[0], z.shape[0]])
    value, density = system.measured(own, t, u)
    read, variance = system.read(own, t, u)
    y = type(x).sym("y", value.shape[0] + read.shape[0])
    noise_left = ca.diagcat((1.0 - AVERAGED if means else 1.0) * density / step, variance)
    expected = (ca.vertcat(mean if means else value, read), noise_left)
    after = corrected_by(z, S, y, expected, form, missing, geometry) if y.shape[0] else [z, S]
    after = [ca.vertsplit(after[0], [0, x.shape[0], z.shape[0]])[0], after[1][:n, :n]]
    return (
        ca.Function("predict", [x, P, u, t], ahead, ["x", "P", "u", "t"], names),
        ca.Function("update", [z, S, y, u, t], after, ["x", "P", "y", "u", "t"], names),
    )


def _check_reading(reading: Reading, step: float | None) -> None:
    """What a reading is has a meaning where there are steps."""
    if reading not in get_args(Reading) or (reading == "mean" and step is None):
        raise ProblemError(
            "What a reading is does not fit.",
            expected="reading='end', or 'mean' with a step",
            received=f"reading={reading!r}, step={step}",
            remedy="leave reading= out for the continuous filter, or give step=",
        )


def _check_instants(problem: Problem, step: float | None, missing: Missing) -> None:
    """What is measured at instants is not always there."""
    taken = problem.declarations.sampled
    if taken and (step is None or missing != "skip"):
        raise ProblemError(
            f"'{taken[0].name}' is measured at instants: between them it is missing.",
            expected="extended_filter(problem, step=..., missing='skip'), whose rows are NaN where nothing is read",
            received=f"step={step}, missing='{missing}'",
            remedy="give a step that divides the time between the instants, and missing='skip'",
        )


def initial_estimate(problem: Problem, *, decisions: Decided = None) -> tuple[Array, Array]:
    """Where the filter of a problem starts: initial states and means of the unknowns, and their covariance.

    Args:
        problem: with the variances as declared, or with an initial estimation covariance.
        decisions: as in `extended_filter`.

    Returns:
        Estimate, (n,) where all states are vectors, NaN where an initial state is free, and covariance (n, n).

    Raises:
        ProblemError: no `Problem` or an incomplete one, a decision without a value.
    """
    statement = _statement(problem)
    means = _parameters(statement)[1]
    starts = statement.boundary_values(statement.values)
    first, matrices = statement.started(_decided(statement, decisions, starts[0]), statement.values, starts[2])
    estimate = np.concatenate([first[: statement.augmented_geometry.size - means.size], means])
    for block in statement.matrices:
        if block.estimation:
            return estimate, unpack(matrices[block.span], block.size)
    own = problem.declarations
    variances = ca.diagcat(*(entry.variance for entry in own.augmented))
    names = [state.name for state in decisions_of(own)]
    given: list[Any] = [*own.parameters, *decisions_of(own)]
    chosen = [first[block.span] for name in names for block in statement.states if block.name == name]
    covariance = ca.Function("variances", [entry.symbol for entry in given], [variances])
    values = covariance.call([ca.DM(value) for value in (*(entry.value for entry in own.parameters), *chosen)])
    return estimate, np.asarray(values[0].full())


class _System:
    """Rates, process noise and measurement of the augmented state, functions of (x, t, u)."""

    def __init__(self, problem: Problem, duration: float | None, decisions: Decided) -> None:
        statement = _statement(problem)
        if statement.coupled:
            raise ProblemError(
                "The dynamics depend on matrices of the problem.",
                expected="rates of states, unknowns, controls and time",
                received="rates that contain a covariance or another matrix state",
                remedy="build the filter from f and h with kalman.extended",
            )
        kind: Any = statement.symbolic
        known, means = _parameters(statement)
        self.geometry = statement.augmented_geometry
        size, controls = len(statement.augmented), sum(entry.size for entry in problem.declarations.controls)
        estimated = self.geometry.size - means.size
        x, t, u = kind.sym("x", self.geometry.size), kind.sym("t"), kind.sym("u", controls)
        self.symbols = x, kind.sym("P", size, size), u, t
        # what a derived problem adds to states and controls (gains, for instance) moves nothing in the actual system
        behind = np.nan_to_num(_decided(statement, decisions, np.zeros(statement.nx))[estimated:])
        moving, own = ca.vertsplit(x, [0, estimated, self.geometry.size])  # slices of one number are never empty
        state = ca.vertcat(moving, ca.DM(behind))
        control = ca.vertcat(u, kind.zeros(statement.nu - controls))
        length = statement.duration.guess if duration is None else duration
        at = (state, control, t, length, ca.vertcat(known, own))
        nominal: Any = statement.nominal
        rate = ca.vertcat(nominal(*at)[0][:estimated], kind.zeros(means.size))
        self.rate = ca.Function("rate", [x, t, u], [ca.densify(rate)])
        expression = statement.expression(process_noise(problem.declarations))
        noise = expression(state, control, kind.zeros(statement.ne), *at[2:])
        self.noise = ca.Function("noise", [x, t, u], [ca.densify(noise)])
        self.measurement: ca.Function | None = None
        if statement.measurement is not None:
            value, _, density = statement.measurement(*at)
            self.measurement = ca.Function("measurement", [x, t, u], [value, density])
        self.samples: ca.Function | None = None
        if statement.samples is not None:
            read, _, variance = statement.samples.measurement(*at)
            self.samples = ca.Function("samples", [x, t, u], [read, variance])

    def measured(self, x: Any, t: Any, u: Any) -> tuple[Any, Any]:
        """What is measured all the time, and the density of its noise; there may be nothing."""
        if self.measurement is None:
            return type(x)(0, 1), type(x)(0, 0)
        value, density = self.measurement(x, t, u)
        return value, density

    def read(self, x: Any, t: Any, u: Any) -> tuple[Any, Any]:
        """What is read at instants, and its variance; there may be nothing."""
        if self.samples is None:
            return type(x)(0, 1), type(x)(0, 0)
        value, variance = self.samples(x, t, u)
        return value, variance

    def averaging(self, count: int, step: float) -> tuple[ca.Function, ca.Function]:
        """Rate and process noise with the means of measured values below, `AVERAGED` of their noise in them."""
        if not count:
            return self.rate, self.noise
        x, _, u, t = self.symbols
        z = type(x).sym("x", x.shape[0] + count)
        own = ca.vertsplit(z, [0, x.shape[0], z.shape[0]])[0]
        value, density = self.measured(own, t, u)
        rate = ca.vertcat(self.rate(own, t, u), value / step)
        noise = ca.diagcat(self.noise(own, t, u), AVERAGED * density / step**2)
        functions = [ca.Function(name, [z, t, u], [ca.densify(v)]) for name, v in (("rate", rate), ("noise", noise))]
        return functions[0], functions[1]


def _statement(problem: Problem) -> Statement:
    check_kind(problem, Problem, "give the problem itself, not its solution")
    return problem.statement()


def _decided(statement: Statement, decisions: Decided, state: Array) -> Array:
    """The whole state with the values of the decisions.

    Raises:
        ProblemError: one has no value, or what is given is none of them.
    """
    own = {block.name: block for block in statement.states if block.role == "decision"}
    result: Array = state.copy()
    given = {name_of(key, statement.symbols, tuple(own)): value for key, value in (decisions or {}).items()}
    for name, block in own.items():
        if name not in given:
            raise ProblemError(
                f"The filter of a problem needs numbers, and '{name}' is a decision.",
                expected="a value of every decision",
                received=", ".join(given) or "none",
                remedy=f"give decisions={{'{name}': solution['{name}']}}, or another value",
            )
        result[block.span] = column(name, "value", given[name], block.size)
    return result


def _parameters(statement: Statement) -> tuple[Array, Array]:
    """Values of the known parameters, means of the unknowns."""
    count = sum(block.length for block in statement.of_kind("unknown"))
    return statement.values[: statement.np - count], statement.values[statement.np - count :]
