"""What a user must know about numbers that look right: a coarse mesh, covariances that none can be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from covocp.base.errors import CovocpError, warn_user
from covocp.base.residuals import LEFT, MUCH_LEFT
from covocp.extremal.coarse_controls import cost_of_form
from covocp.extremal.extremal import Extremal
from covocp.extremal.given_controls import without_value
from covocp.extremal.links import Within
from covocp.extremal.mesh_error import (
    COARSE_MESH,
    LONG_STEPS,
    OPTIMISED,
    Unseen,
    mesh_error,
    node_error,
    parted,
    unseen,
    unstable,
)
from covocp.solution.flight import NOTICED, gains_are_steep, interpolated_flight
from covocp.solution.jumps import coarse_elsewhere, mention_jumps
from covocp.solution.origin import METHOD
from covocp.solution.solution import Solution
from covocp.solution.spread import mention_spread
from covocp.transcription.scales import choose_scales

# Relative difference of the cost and of that of the loop's own covariances above which these are not resolved.
COARSE_LOOP = 1e-2
# Share of a limit by which the path may pass it between the points where it is imposed.
PASSED = 1e-2
LOST_LOOP = (
    "The covariances of the closed loop leave the range of numbers along this solution: what is printed as standard "
    "deviation is that of the error of the estimate alone. The cost and E do not depend on them. Use more intervals, "
    "or units in which initial variances and densities of the noise differ less."
)
# The method whose slopes are integrated, not those of its cost on the mesh; stationarity from which the two differ.
OWN_SLOPES, NOT_STATIONARY = "gradient", 1e-3
# Share of their magnitudes below which the controls do nothing.
NOTHING = 1e-6
# Shares of the cost: what the form of the controls may take without a word, and from where on its estimate is crude.
COARSE_CONTROLS, FAR_OFF = 1e-2, 0.3
REFINE = "Let refine=1e-4 put nodes where they are needed, or use more intervals."
REMEDY = "Leave grid= out: the default mesh is graded where gains are steep; or use more intervals."


def mention_doubts(solution: Solution) -> None:
    """Warn of what is wrong with a solution that was found, or with a nominal that was evaluated."""
    error, fine, jumps = solution.mesh_error, False, mention_jumps(solution)
    alone, by_steps = _flown_alone(solution) if np.isfinite(error) and not jumps else ("", False)
    if alone:
        warn_user(alone)
    if not np.isfinite(error):
        warn_user(_unknown_error(solution))
    elif solution.statement is not None and (hidden := _hidden(solution)) is not None:
        warn_user(_too_fast(solution, hidden))
    elif jumps and not coarse_elsewhere(solution, jumps):
        pass  # the steps are long where it jumps, and no others are right there
    elif not (error <= COARSE_MESH or by_steps):
        warn_user(_coarse(solution, error))
    elif alone:
        pass  # said already, with what the steps are off at the nodes
    elif solution.statement is not None and (moved := node_error(solution.extremal, closely=False)) > LONG_STEPS:
        warn_user(
            f"The integration steps are long: halving them moves a state or a covariance at a node by {moved:.1e} of "
            "its range, or at the end of itself. Use more intervals or substeps."
        )
    else:
        fine = True
        _mention_loop(solution)
    mention_spread(solution)
    if not jumps:
        _mention_slopes(solution, fine)
        if solution.optimised and solution.statement is not None:
            mention_form(solution.extremal, solution.within)
    _mention_tables(solution)
    if solution.smallest_eigenvalue < 0 and not solution.semidefinite:
        other = "" if solution.mesh.step in ("gauss", "rodas") else "covariance_step='gauss' or "
        warn_user(
            f"A covariance is indefinite (smallest eigenvalue {solution.smallest_eigenvalue:.3g}); use "
            f"{other}more intervals."
        )


def _coarse(solution: Solution, error: float) -> str:
    """What shorter integration steps change, and what helps."""
    statement, remedy = solution.statement, "Use more intervals or substeps."
    if solution.method != METHOD and "refine" not in solution.stats:
        remedy = "Let refine=1e-4 put nodes where they are needed, or use more intervals or substeps."
    if statement is None or statement.autonomous:
        changes = f"changes the cost by {error:.1e} (relative)"
        return f"The mesh is too coarse: halving the integration steps {changes}. {remedy}"
    node = _node(solution)
    running = parted(solution.extremal, 1).running  # that of a loop is told by other terms
    paid = mesh_error(solution.extremal, running, solution.within, of_states=False)
    changes = f"changes the cost by {paid:.1e} (relative)"
    if error > paid:
        changes += f" and moves a state by {error:.1e} of its range between two nodes"
    if paid <= COARSE_MESH:
        return f"The integration steps are long: halving them {changes}. {node}Use more substeps (substeps=)."
    return f"The mesh is too coarse: halving the integration steps {changes}. {node}{remedy}"


def _node(solution: Solution) -> str:
    """What helps where a rate may jump with the time within the steps, a sentence; "" where they are only too long."""
    from covocp.extremal.step_order import is_smooth

    return "" if is_smooth(solution.extremal, solution.within) else "Put a node where a rate jumps (grid=). "


def mention_form(
    extremal: Extremal, within: Within | None = None, cost: str = "the cost", remedy: str = REFINE
) -> None:
    """Warn of controls that change faster than their nodes can say, where that costs much.

    Args:
        extremal: the solution.
        within: what the rest of a chain says of it.
        cost: which it is.
        remedy: what helps, a sentence.
    """
    try:
        with np.errstate(all="ignore"):
            paid = cost_of_form(extremal, COARSE_CONTROLS, within)
    except (CovocpError, RuntimeError, ArithmeticError, ValueError):  # the report says that it is not known
        return
    if paid is None:
        return
    much = f"about {paid:.1e} of {cost}" if paid < FAR_OFF else f"much of {cost}, by a crude estimate"
    warn_user(
        f"The controls change faster than the mesh resolves: being linear between its nodes costs {much}. {remedy}"
    )


def mention_gap(stats: Mapping[str, Any]) -> None:
    """Warn of a cost that may be above the least one by what bounds leave of it."""
    left = float(stats.get(LEFT, 0.0))
    if left > MUCH_LEFT:
        warn_user(
            f"The cost may be above the least one: {left:.1e} of it is left where multipliers push at bounds that are "
            "not reached. Start again from this solution (guess=), or make the largest weights of the cost smaller, or "
            "conditions of them."
        )


def _hidden(solution: Solution) -> Unseen | None:
    """What the steps do not see of a model that changes with the time, where that is much."""
    found = unseen(solution.extremal, solution.within)
    much = found is not None and (found.moved > LONG_STEPS or max(found.cost, solution.mesh_error) > COARSE_MESH)
    return found if much else None


def _too_fast(solution: Solution, found: Unseen) -> str:
    """What changes too fast for the steps, by how much they may be off, what helps."""
    mesh = solution.mesh
    step = np.diff(solution.t).max() / mesh.substeps
    moves = f"move '{found.name}' at a node by {found.moved:.1e} of its range" if found.moved else ""
    costs = f"change the cost by {found.cost:.1e} (relative)" if found.cost else ""
    changes = " and ".join(filter(None, (moves, costs)))
    return (
        f"The model changes with the time faster than the integration steps see, of {step:.3g} s: they meet it near "
        f"one place of its period. Steps of other lengths {changes}: by so much states and cost may be off. Use more "
        f"substeps (substeps=, now {mesh.substeps}) or intervals, more than three steps to what oscillates fastest, or "
        "put its mean in its place."
    )


def _flown_alone(solution: Solution) -> tuple[str, bool]:
    """What becomes of errors of the steps along the controls alone, where that is much; whether shorter ones help."""
    found = unstable(solution.extremal) if solution.statement is not None else None
    if found is None:
        return "", False
    left, cost = found
    differs = cost is not None and abs(cost - solution.cost) > COARSE_MESH * abs(solution.cost)
    if left <= (OPTIMISED if differs else LONG_STEPS):  # a cost that differs at nodes that are right is one of the mesh
        return "", False
    far = f"leaves the nodes by {left:.1e} of the range of a state" if np.isfinite(left) else "diverges"
    if cost is None:  # roundoff does as much: no steps are short enough
        return f"The plant is unstable: a run along these controls alone {far}. Fly them with a feedback.", False
    paid = f" and costs {cost:.6g} instead of {solution.cost:.6g}" if differs else ""
    return (
        f"What the steps are off grows: a run along these controls alone {far}{paid}. Use more intervals or substeps, "
        "or, where the plant is unstable, fly them with a feedback."
    ), True


def _mention_slopes(solution: Solution, fine: bool) -> None:
    """Warn of a point that is stationary by the slopes of the method alone, or of no minimum, where it has its own.

    fine: whether the mesh seems to be; else it was said why slopes and costs differ.
    """
    if not solution.optimised or solution.method != OWN_SLOPES or solution.statement is None:
        return
    extremal = solution.extremal
    t = extremal.trajectory
    units = choose_scales(extremal.statement, extremal.mesh, t, extremal.parameters).u
    if not (np.abs(t.u) > NOTHING * units).any():  # slopes are those of roundoff
        return
    try:
        found = solution.optimality
    except (CovocpError, RuntimeError, ArithmeticError, ValueError):  # the report says that it is not known
        return
    if fine and found.stationarity is not None and found.stationarity > NOT_STATIONARY:
        warn_user(
            f"The point is stationary by the slopes that the method integrates, not by those of its cost on this mesh "
            f"(stationarity {found.stationarity:.1e}). Use more intervals, or method='ipopt' from there (guess=)."
        )


def _unknown_error(solution: Solution) -> str:
    """What is not finite where the error of the mesh is no number."""
    said = "How much the mesh costs is not known: "
    undefined = without_value(solution.extremal) if solution.statement is not None else {}
    if undefined:
        name, time = min(undefined.items(), key=lambda item: item[1])
        return f"{said}'{name}' is NaN or inf, first at t = {time:.4g} s. Keep what it depends on where it has a value."
    halves = (
        f"{said}with integration steps of half the length a state, a covariance or the cost becomes NaN or inf. Use "
        "more intervals or substeps."
    )
    from covocp.extremal.step_order import moved_by_halves

    if solution.statement is not None and np.isinf(moved_by_halves(solution.extremal)):
        return halves
    costates = np.hstack([solution.costates.state, solution.costates.matrices])
    broken = np.flatnonzero(~np.isfinite(costates).all(axis=1))
    if broken.size:  # they are integrated from the end: what is last in time came first
        return (
            f"{said}the costates are NaN or inf up to t = {solution.t[broken[-1]]:.4g} s, where a rate, a cost or a "
            "condition has no finite slope. Keep what it depends on away from there."
        )
    return halves


def _mention_tables(solution: Solution) -> None:
    """Warn of tables that are read where they have no values."""
    left = solution.left_tables()
    if not left:
        return
    more = f", and {len(left) - 1} more" if len(left) > 1 else ""
    if not left[0].defined:
        warn_user(f"The {left[0].name} is read at NaN or inf at t = {left[0].time:.4g} s{more}: it has no value there.")
        return
    warn_user(
        f"The {left[0].name} is read beyond its knots, by {left[0].by:.3g} at t = {left[0].time:.4g} s{more}: its "
        "outermost piece goes on there, which no value supports. Give it knots that reach so far, or keep what it "
        "depends on between them (subject_to)."
    )


def mention_limits(solution: Solution) -> None:
    """Warn of limits that the path passes between the points where they are imposed."""
    passed = [entry for entry in solution.passed_limits() if entry.share > PASSED]
    if not passed:
        return
    more = f", and {len(passed) - 1} more" if len(passed) > 1 else ""
    if not passed[0].defined:
        warn_user(
            f"Between the points where it is imposed '{passed[0].name}' is NaN or inf at t = {passed[0].time:.4g} s"
            f"{more}: its limit does not hold there. Bound what it is made of, impose it at more points of each "
            f"interval (points={2 * solution.mesh.points}, method 'ipopt'), or use more intervals."
        )
        return
    where = "At points where" if passed[0].imposed else "Between the points where"
    remedy = passed[0].remedy(solution.mesh.points)
    warn_user(
        f"{where} it is imposed the limit of '{passed[0].name}' is passed by {passed[0].by:.3g} "
        f"({100 * passed[0].share:.2g} % of it) at t = {passed[0].time:.4g} s{more}. {remedy[0].upper()}{remedy[1:]}."
    )


def _mention_loop(solution: Solution) -> None:
    """The covariances of a closed loop, and the deviations from them, may be worse than its cost."""
    if solution.loop is None:
        if solution.statement is not None and solution.statement.loop is not None:
            warn_user(LOST_LOOP)
        return
    difference = solution.cost_identity
    if difference is not None and not difference <= COARSE_LOOP:
        warn_user(
            f"The mesh does not resolve the gains: the covariances of the closed loop give a cost that differs by "
            f"{difference:.1e} (relative) from the one that was integrated, so do the deviations. {REMEDY}"
        )
        return
    if not gains_are_steep(solution):
        return
    flight = interpolated_flight(solution)
    if flight.worst > 1.0 + NOTICED:
        warn_user(f"The mesh does not resolve the gains: {flight.words}. {REMEDY}")
