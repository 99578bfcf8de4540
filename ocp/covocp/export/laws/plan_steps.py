"""Whether the steps of an exported solver are short enough for the plan it found: the plan run again by halves of them.

Steps are chosen at the export. A start, a parameter or a duration that makes the plant faster leaves them where they
are, and the conditions of a minimum then hold for a plant that is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Given, sequence_of
from covocp.base.matrices import Array
from covocp.export.laws.law import LARGEST
from covocp.transcription.nlp import NLP
from covocp.transcription.shooting import interval_columns
from covocp.transcription.steps import full_interval, nominal_interval

# Change of a state at a node, relative to its range along the plan, and of the cost, above which steps are long.
NODES, COST = 4e-3, 0.01
# So many times what steps are off at the export itself, which was told there, is allowed where that is more.
AS_AT_EXPORT = 3.0
# Range of what hardly varies, in its unit.
LEAST_RANGE = 1e-3
# Entries of matrices up to which their own cost on the way is taken by shorter steps too: those of six rows.
MOST_ENTRIES = 21


def changes_by_halves(nlp: NLP, p: Given, evaluated: Sequence[Any], held: Given) -> Any:
    """What halving the steps changes of a plan: of the states at the nodes, and of the cost, relative, (2, 1).

    States count by what all intervals by themselves are off, together, or by one run along the controls where that is
    less: what a plant forgets is no error, and what an unstable one makes of an error is none of the steps.

    Args:
        nlp: the transcription.
        p: parameters of the statement.
        evaluated: states, half-vectors, controls at the nodes, duration, running and terminal cost of the plan.
        held: multipliers of final states that are prescribed, (nx, 1): what it costs to miss them.
    """
    st, mesh = nlp.statement, nlp.mesh
    if st.coupled or st.nominal is None or not st.nx:
        return ca.MX(ca.DM([0.0, 0.0]))
    x, e, u, duration, running, terminal = evaluated[:6]
    common = interval_columns(mesh, u, duration, p)
    finer = nominal_interval(st, 2 * mesh.substeps, mesh.step)
    ends, _, costs = finer.map(mesh.intervals)(x[:, :-1], *common)
    along = sequence_of(finer, mesh.intervals)(x[:, 0], *common)[0] - x[:, 1:]
    off = ca.sum2(ca.fabs(ends - x[:, 1:]))
    run = ca.vertcat(*[ca.mmax(ca.fabs(along[i, :])) for i in range(st.nx)])
    moved = ca.fmin(off, run)
    ranges = ca.vertcat(*[ca.mmax(x[i, :]) - ca.mmin(x[i, :]) for i in range(st.nx)])
    nodes = moved / ca.fmax(ranges, LEAST_RANGE * ca.DM(nlp.scales.x))
    last = along[:, -1] * ca.fmin(1.0, off / ca.fmax(run, np.finfo(float).tiny))
    change = st.terminal(x[:, -1] + last, e[:, -1], duration, p) - terminal
    own = st.matrices and not st.behind and st.samples is None and st.ne <= MOST_ENTRIES
    if not st.running_uses_matrices:
        change += ca.sum2(costs) - running
    elif own:
        whole = full_interval(st, 2 * mesh.substeps, mesh.step, mesh.linear_solver).map(mesh.intervals)
        change += ca.sum2(whole(ca.vertcat(x, e)[:, :-1], *common)[2]) - running
    change = ca.fmax(ca.fabs(change), ca.fabs(change - ca.dot(held, last)))
    size = ca.fmax(ca.fabs(running + terminal), np.finfo(float).tiny)
    return ca.vertcat(ca.mmax(ca.vertcat(0.0, nodes)), change / size)


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
    return np.asarray(np.maximum([NODES, COST], AS_AT_EXPORT * own))


def are_long(nlp: NLP, p: Given, evaluated: Sequence[Any], held: Given, most: Array) -> Any:
    """Whether halving the steps changes more than that; so it does where the run by halves has no end."""
    told = changes_by_halves(nlp, p, evaluated, held)
    return ca.logic_not(ca.logic_and(told[0] <= float(most[0]), told[1] <= float(most[1])))
