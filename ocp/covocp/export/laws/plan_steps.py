"""Whether the steps of an exported solver are short enough for the plan it found: the plan run again by halves of them.

Steps are chosen at the export. A start, a parameter or a duration that makes the plant faster, or its covariances,
leaves them where they are, and the conditions of a minimum then hold for a plant that is none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr, Given, sequence_of
from covocp.base.matrices import Array
from covocp.export.laws.law import LARGEST
from covocp.passage.written import Tape
from covocp.statement.conditions import Columns, Conditions
from covocp.statement.interval import Interval
from covocp.statement.offsets import offset_of
from covocp.transcription.limit_units import ALONG, row_units
from covocp.transcription.nlp import NLP
from covocp.transcription.shooting import interval_columns, matrices_along
from covocp.transcription.steps import full_interval, nominal_interval

# Change of a state at a node, relative to its range along the plan, of the cost, and of what conditions on covariances
# compare, or what limits are passed by between nodes, in units of these limits, above which steps are long.
NODES, COST, ROWS = 4e-3, 0.01, 0.01
# So many times what steps are off at the export itself, which was told there, is allowed where that is more.
AS_AT_EXPORT = 3.0
# Parts of an interval, at least, at whose ends limits along the path are looked at.
BETWEEN = 8
# Range of what hardly varies, in its unit.
LEAST_RANGE = 1e-3


def changes_by_halves(nlp: NLP, p: Given, evaluated: Sequence[Any], held: Given, tape: Tape | None = None) -> Any:
    """What halving the steps changes of a plan: of the states, of the cost, of what limits compare, (3, 1).

    States count by what all intervals by themselves are off, together, or by one run along the controls where that is
    less: what a plant forgets is no error, and what an unstable one makes of an error is none of the steps. Covariances
    pass once along all nodes of the plan. Limits along the path count by what passes them between the nodes, too.

    Args:
        nlp: the transcription.
        p: parameters of the statement.
        evaluated: states, half-vectors, controls at the nodes, duration, running and terminal cost of the plan.
        held: multipliers of final states that are prescribed, (nx, 1): what it costs to miss them.
        tape: takes the passages, as that of the transcription; None: they are CasADi's operations.
    """
    st, mesh = nlp.statement, nlp.mesh
    if not st.nx or (st.nominal is None and not st.coupled):
        return ca.MX(ca.DM.zeros(3, 1))
    x, e, u, duration, running, terminal = evaluated[:6]
    common = interval_columns(mesh, u, duration, p)
    if st.coupled:
        finer = full_interval(st, 2 * mesh.substeps, mesh.step, mesh.linear_solver)
    else:
        finer = nominal_interval(st, 2 * mesh.substeps, mesh.step)
    nodes = ca.vertcat(x, e) if st.coupled else x
    scales = np.concatenate([nlp.scales.x, nlp.scales.e]) if st.coupled else nlp.scales.x
    ends, fine, costs = finer.map(mesh.intervals)(nodes[:, :-1], *common)
    along = sequence_of(finer, mesh.intervals)(nodes[:, 0], *common)[0] - nodes[:, 1:]
    off = ca.sum2(ca.fabs(ends - nodes[:, 1:]))
    run = ca.vertcat(*[ca.mmax(ca.fabs(along[i, :])) for i in range(nodes.shape[0])])
    ranges = ca.vertcat(*[ca.mmax(nodes[i, :]) - ca.mmin(nodes[i, :]) for i in range(nodes.shape[0])])
    moved = ca.fmin(off, run) / ca.fmax(ranges, LEAST_RANGE * ca.DM(scales))
    taken = ca.fmin(1.0, off / ca.fmax(run, np.finfo(float).tiny))  # of what one run is off
    last = along[:, -1] * taken
    if st.coupled:
        passed = ca.horzcat(e[:, 0], e[:, 1:] + (along * ca.repmat(taken, 1, mesh.intervals))[st.nx :, :])
    elif st.matrices:
        passed, paid = _passed(nlp, (x, e, fine, common, p), tape)
        costs = costs + paid
    else:
        passed = e
    change = st.terminal(x[:, -1] + last[: st.nx], passed[:, -1], duration, p) - terminal + ca.sum2(costs) - running
    change = ca.fmax(ca.fabs(change), ca.fabs(change - ca.dot(held, last[: st.nx])))
    size = ca.fmax(ca.fabs(running + terminal), np.finfo(float).tiny)
    rows = ca.MX(0.0)
    if st.matrices:  # what is no number would be lost among comparisons
        known = ca.sum1(ca.sum2(ca.fabs(passed))) <= LARGEST
        rows = ca.if_else(known, _rows(nlp, (x, u, duration, p), (e, passed)), ca.inf)
    return ca.vertcat(ca.mmax(ca.vertcat(0.0, moved)), change / size, ca.fmax(rows, _between(nlp, x, common, p)))


def _passed(nlp: NLP, along: tuple[Any, ...], tape: Tape | None) -> tuple[Any, Any]:
    """Half-vectors at the nodes and running costs of the intervals by steps of half the length."""
    x, e, fine, common, p = along
    finer = replace(nlp.mesh, substeps=2 * nlp.mesh.substeps)
    given = (nlp.statement, finer, x, fine, Interval(*common), p, e[:, 0])
    if tape is None:
        return matrices_along(*given)
    own = tape.beside()
    found: list[Any] = list(matrices_along(*given, passage=own.passed_by))
    symbols: list[Any] = []
    values: list[Any] = []
    for call in own.calls:
        arguments = ca.substitute(list(call.arguments), symbols, values) if symbols else call.arguments
        after = call.forward(*(ca.densify(argument) for argument in arguments))[: call.after.numel()]
        symbols.append(call.after)
        values.append(ca.reshape(after, *call.after.shape))
    return tuple(ca.substitute(found, symbols, values))


def _rows(nlp: NLP, along: tuple[Any, ...], matrices: tuple[Any, Any]) -> Any:
    """By how much other matrices change what conditions compare, in units of their limits, where these are near."""
    st = nlp.statement
    changes = [ca.MX(0.0)]
    for conditions, at, shares in _conditions(nlp):
        if conditions.uses_matrices:
            units = ca.DM(row_units(st, conditions, nlp.scales, shares))
            told, found = (_compared(nlp, conditions, at, along, e) for e in matrices)
            lower, upper = (ca.repmat(ca.DM(v), 1, len(at)) for v in (conditions.lower, conditions.upper))
            unit = ca.repmat(units, 1, len(at))
            near = ca.fmax(*(ca.fmax(lower - value, value - upper) for value in (told, found))) > -ROWS * unit
            changes.append(ca.mmax(ca.if_else(near, ca.fabs(found - told) / unit, 0.0)))
    known = np.flatnonzero(~np.isnan(st.boundary_values(st.values)[3])).tolist()
    if known:
        told, found = (e[known, -1] for e in matrices)
        least = LEAST_RANGE * ca.DM(nlp.scales.e[known])
        changes.append(ca.mmax(ca.fabs(found - told) / ca.fmax(ca.fabs(told), least)))
    return ca.mmax(ca.vertcat(*changes))


def _between(nlp: NLP, x: Expr, common: Interval, p: Given) -> Any:
    """By how much limits along the path, of no matrices, are passed between the nodes, in units of these limits."""
    st, mesh, path = nlp.statement, nlp.mesh, nlp.statement.path
    own = path.size and not path.uses_matrices and not path.equations.all()
    if st.coupled or not (own or st.bounded_states):
        return ca.MX(0.0)
    steps = mesh.substeps * -(-BETWEEN // mesh.substeps)
    _, fine, _ = nominal_interval(st, steps, mesh.step).map(mesh.intervals)(x[:, :-1], *common)
    inside = common.substeps(steps)
    at = [k * steps + j for k in range(mesh.intervals) for j in range(1, steps)]
    places, count = inside.columns(at), len(at)
    states, time = fine[:, [k - 1 for k in at]], places.duration * places.s
    found = [ca.MX(0.0)]
    if own:
        seen = Columns(states, places.start, ca.DM(st.ne, count), time)
        values = path.columns(seen, common.duration[0], p)
        unit = ca.repmat(ca.DM(row_units(st, path, nlp.scales)), 1, count)
        offset = offset_of(path) if path.of_zero.any() else None
        if offset is not None:
            beside = ca.fabs(offset.map(count)(time, places.duration, ca.repmat(p, 1, count)))
            of_zero = ca.repmat(ca.DM(path.of_zero.astype(float)), 1, count)
            unit = ca.if_else(ca.logic_and(of_zero, beside > 0), ca.fmin(unit, beside), unit)
        free = np.where(path.equations, np.inf, 0.0)  # which hold at the nodes alone
        found.append(_passed_by(values, path.lower - free, path.upper + free, unit))
    bounded = st.bounded_states
    if bounded:
        lower, upper = (bound[bounded] for bound in st.state_bounds)
        unit = ca.repmat(ca.DM(nlp.scales.x[bounded]), 1, count)
        found.append(_passed_by(states[bounded, :], lower, upper, unit))
    return ca.mmax(ca.vertcat(*found))


def _passed_by(values: Expr, lower: Array, upper: Array, unit: Expr) -> Any:
    """The most by which columns of values pass their limits, in units of their own; inf where one is no number."""
    numbers = (np.nan_to_num(limit, posinf=LARGEST, neginf=-LARGEST) for limit in (lower, upper))
    low, high = (ca.repmat(ca.DM(limit), 1, values.shape[1]) for limit in numbers)
    share = ca.fmax(low - values, values - high) / unit
    return ca.if_else(ca.mmin(share <= LARGEST), ca.fmax(0.0, ca.mmax(share)), ca.inf)


def _conditions(nlp: NLP) -> Iterator[tuple[Conditions, list[int], tuple[float, ...]]]:
    """All conditions, the nodes at which they hold, and where on the horizon these are."""
    st, last = nlp.statement, nlp.mesh.intervals
    yield st.path, list(range(last + 1)), ALONG
    yield st.start, [0], (0.0,)
    yield st.end, [last], (1.0,)
    for part, node in zip(st.inside.parts, st.inside.nodes_among(nlp.mesh.nodes), strict=True):
        yield part.conditions, [node], (part.place,)


def _compared(nlp: NLP, conditions: Conditions, at: list[int], along: tuple[Any, ...], e: Expr) -> Any:
    """What the rows of conditions are at some nodes."""
    x, u, duration, p = along
    if nlp.statement.nu and nlp.mesh.control != "linear":
        u = ca.horzcat(u, u[:, -1])
    controls = u if nlp.statement.nu else ca.MX(0, nlp.mesh.intervals + 1)
    time = duration * ca.DM(nlp.mesh.nodes).T
    return conditions.columns(Columns(*(v[:, at] for v in (x, controls, e, time))), duration, p)


def final_multipliers(nlp: NLP, of_bounds: Given, scale: float) -> Any:
    """Multipliers of final states in units of cost and states, of those of the bounds of all variables of the NLP."""
    nx, last = nlp.statement.nx, len(nlp.mesh.starts) - 1
    return scale * ca.MX(of_bounds)[nx * last : nx * (last + 1)] / ca.DM(nlp.scales.x)


def limits(nlp: NLP, w: Array, of_bounds: Array, scale: float) -> Array:
    """What halving the steps may change of a plan: more where it changes more of that of the export, w, itself."""
    variables, p = ca.MX.sym("w", w.size), ca.MX.sym("p", nlp.statement.np)
    held = final_multipliers(nlp, ca.DM(of_bounds), scale)
    evaluated: Any = nlp.evaluate(variables, ca.vertcat(p, 1.0))
    found = ca.Function("told", [variables, p], [changes_by_halves(nlp, p, evaluated, held)])(w, nlp.statement.values)
    own = np.fmin(np.asarray(found.full()).ravel(), LARGEST)  # where that is no number anything that is one is allowed
    return np.asarray(np.maximum([NODES, COST, ROWS], AS_AT_EXPORT * own))


def are_long(nlp: NLP, p: Given, evaluated: Sequence[Any], held: Given, most: Array, tape: Tape | None = None) -> Any:
    """Whether halving the steps changes more than that; so it does where the run by halves has no end."""
    told = changes_by_halves(nlp, p, evaluated, held, tape)
    return ca.logic_not(ca.mmin(told <= ca.DM(most)))
