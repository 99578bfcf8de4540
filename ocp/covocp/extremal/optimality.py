"""Residuals of the necessary conditions, gathered in one record."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import warn_user
from covocp.base.matrices import Array, standard_deviations
from covocp.base.residuals import VANISHING, complementary
from covocp.extremal.adjoint_steps import explicit_pairs
from covocp.extremal.closed_loop import ClosedLoop
from covocp.extremal.control_error import ACTIVE, estimate_control_error, kinds_of
from covocp.extremal.cost_sizes import RESOLVED, ZERO_COST, absolute_cost, variable_cost
from covocp.extremal.costates import discrete_costates, integrated_costates, passage_end
from covocp.extremal.curvature import smallest_curvature
from covocp.extremal.decisions import decision_slopes
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import prolongation, refined
from covocp.extremal.finer_cost import change_on_finer_mesh
from covocp.extremal.hamiltonian import Costates, along, by_controls_at, duration_slope, terms_of
from covocp.extremal.inside import instant_control_slopes, instant_duration_slope
from covocp.extremal.jumps import met_jumps
from covocp.extremal.links import Within
from covocp.extremal.mesh_error import node_error
from covocp.extremal.path_limits import acting
from covocp.extremal.readings import stretches
from covocp.extremal.slope_terms import slope_sizes
from covocp.extremal.worth import worth_telling
from covocp.statement.interval import model_symbols
from covocp.transcription.scales import choose_scales
from covocp.transcription.steering import quadrature_weights

# Share of a bound of T within which T may be held by it.
BESIDE = 0.05
# A stationarity above which it is asked what it does to the cost.
LARGE_SLOPE = 1e-5
# Terms of H over the time, in the duality gap, up to which they are those of multipliers that the solver left.
OF_MULTIPLIERS = 1e3
# Costs below this count as zero.
NO_COST = 1e-12
# Share of the largest deviation of a state below which what is left of it is rounding; squared, of that of any state.
KNOWN = 1e-12


@dataclass(frozen=True, kw_only=True)
class Optimality:
    """How well a solution meets the necessary conditions; None where one does not apply.

    Attributes:
        stationarity: largest slope of the Lagrangian by a control value, per unit of time (H_u in the mean over the
            neighbourhood of a node, at least the mean one), bounds' multipliers included; relative to the largest sum
            of the absolute terms of H_u (or |H_uu| |u|, where more); or, where that is less, the change of the cost if
            all controls change by their magnitudes, relative to a tenth of what of it is variable, no constants
            (`cost_sizes.variable_cost`): what is zero has no terms.
        complementarity: sum of |multiplier| times distance from the bound over all inequalities, relative to the
            cost: a multiplier of a bound that is not active makes a slope look like none.
        control_slope: root mean square of H_u at the nodes with free controls, None where a condition along the path or
            the bound of a state acts; of the order of the square of the
            interval for piecewise-linear controls; same normalisation.
        costate_difference: largest difference between the costates of the multipliers and those integrated backward,
            relative to the largest costate of each kind: back to the last interval that would take too many explicit
            steps (a large prior, an accurate sensor), None where that is the last of all.
        hamiltonian_variation: (largest - smallest H) / (largest sum of the absolute terms of H); None where the problem
            depends on time explicitly.
        transversality: k_T + H(T) with all multipliers, relative to the largest terms of H; None for a fixed duration.
        mesh_error: relative change of the cost by halving the integration steps.
        node_error: largest change of a state or of an entry of a matrix at a node by halving the integration steps,
            relative to its range, at the end of a covariance to its own deviations.
        control_error: estimated relative cost of the piecewise form of the control, 1/2 int H_u H_uu^-1 H_u dt; of
            controls in which H is not convex, int of what H is above its least value with the controls beside (nan of
            one constant control without bounds); where a condition along the path or the bound of a state acts, the
            change by a finer mesh, with what limits that are missed between the nodes are worth; nan where that was
            not to be had. None where implicit steps pass a nominal so stiff that H is not known pointwise, and H_uu is
            not positive.
        smallest_eigenvalue: of all covariances at all nodes; inf without covariances.
        curvature: smallest eigenvalue of the reduced Hessian, on the null space of all constraints that hold, relative
            to its largest; 0 where its sign is below its error, or where what a negative one is worth between the
            bounds of the controls is less than the mesh leaves or 1e-5 of the cost; None where nothing is left to move,
            or it cannot be had; nan where it would take too long. Negative: the solution is a saddle.
        decisions: largest slope of the Lagrangian by a decision: int H_d dt, the slopes of all end terms, and the
            multipliers of its bounds; relative to the sum of the absolute terms or, where that is less, to a tenth of
            what of the cost is variable by the magnitude of the decision; None without decisions.
        cost_identity: relative difference of the cost that was optimised, integrated from E and S, and the expected
            cost (E-1) from the covariances of the loop; None without a closed loop.
        cross_covariance: largest correlation of the estimate and its error, zero for the gains of the filter; None
            without a closed loop.
        conservation: largest relative error of the variances E + Xhat that no control changes, such as those of unknown
            constants; None where there are none.
    """

    stationarity: float | None
    control_slope: float | None
    costate_difference: float | None
    hamiltonian_variation: float | None
    transversality: float | None
    mesh_error: float
    node_error: float
    control_error: float | None
    smallest_eigenvalue: float
    curvature: float | None
    complementarity: float | None = None
    decisions: float | None = None
    cost_identity: float | None = None
    cross_covariance: float | None = None
    conservation: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """The values by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __str__(self) -> str:
        """One line a residual."""
        return "\n".join(
            f"{name.replace('_', ' '):24s}{'-' if value is None else format(value, '.3g')}"
            for name, value in self.as_dict().items()
        )


def assess(
    extremal: Extremal,
    costates: Costates,
    mesh_error: float,
    smallest_eigenvalue: float,
    loop: ClosedLoop | None = None,
    cost_identity: float | None = None,
    within: Within | None = None,
    seconds: float = np.inf,
) -> Optimality:
    """Evaluate all necessary conditions along an extremal.

    Args:
        extremal: the solution.
        costates: of its multipliers.
        mesh_error: estimated before.
        smallest_eigenvalue: of its covariances.
        loop: its closed loop.
        cost_identity: difference of its cost and of that from the covariances of the loop.
        within: what the rest of a chain says of it. The curvature, which is one of all together, is then not computed.
        seconds: about as long as the curvature may take.

    Returns:
        The record.
    """
    st = extremal.statement
    slope, curvature, values, sizes = _at_nodes(extremal, costates)
    scale = max(float(sizes.max(initial=0.0)), np.finfo(float).tiny)
    others = 0.0 if within is None else within.size
    size, gap = absolute_cost(extremal) + others, duality_gap(extremal)
    control_slope: float | None = 0.0
    control_error: float | None = 0.0
    if st.nu and acting(extremal):
        known = change_on_finer_mesh(extremal, max(size, gap), within)
        control_slope, control_error = None, np.nan if known is None else known
    elif st.nu:
        kinds = kinds_of(extremal)
        control_slope = float(np.sqrt(np.mean(np.where(kinds.nodes, slope, 0.0) ** 2))) / scale
        control_error = estimate_control_error(extremal, (kinds.free, kinds.bounded), max(size, gap))
    found = Optimality(
        stationarity=_stationarity(extremal, _left(extremal), scale, within) if st.nu else 0.0,
        control_slope=control_slope,
        costate_difference=_costate_difference(extremal, costates),
        hamiltonian_variation=_variation(extremal, values, size) if st.autonomous else None,
        transversality=_transversality(extremal, costates, values, within) if st.duration.free else None,
        mesh_error=mesh_error,
        node_error=node_error(extremal),
        control_error=control_error,
        smallest_eigenvalue=smallest_eigenvalue,
        curvature=_curvature(extremal, seconds, mesh_error, control_error) if within is None else None,
        complementarity=complementarity(extremal, others),
        decisions=_decisions(extremal, costates, within),
        cost_identity=cost_identity,
        **_loop_identities(loop),
    )
    terms = float(values[:, 1].max())  # costs may cancel
    unknown = size <= gap <= NO_COST and terms * extremal.trajectory.duration <= OF_MULTIPLIERS * gap
    nothing = max(size, terms) <= ZERO_COST or unknown
    return _of_nothing(found) if nothing else found


def mention_saddle(curvature: float | None) -> None:
    """Warn of a point that meets the first conditions, of negative curvature (relative to the largest)."""
    if curvature is not None and curvature < 0:
        warn_user(
            f"This is no minimum: the reduced Hessian has a negative curvature, {curvature:.1e} of its largest. "
            "Start elsewhere, or go on from there by method='ipopt' (guess=)."
        )


def stationarity_of(extremal: Extremal, within: Within | None = None) -> float:
    """The stationarity of an extremal, without the other conditions.

    Args:
        extremal: with multipliers, of a chain the completed ones.
        within: what the rest of a chain says of it; None: it is alone.
    """
    if not extremal.statement.nu:
        return 0.0
    sizes = _at_nodes(extremal, discrete_costates(extremal)[0]).sizes
    scale = max(float(sizes.max(initial=0.0)), np.finfo(float).tiny)
    return _stationarity(extremal, _left(extremal), scale, within)


def _left(extremal: Extremal) -> Array:
    """Slopes of the Lagrangian by the control values, all multipliers included."""
    return discrete_costates(extremal)[1] + _limit_slopes(extremal) + extremal.multipliers.controls


def _stationarity(extremal: Extremal, slopes: Array, scale: float, within: Within | None) -> float:
    """The largest slope of the Lagrangian per unit of time in units of the terms of H_u, or all of them in the cost."""
    shares = quadrature_weights(extremal.mesh)[:, None]
    times = np.maximum(shares, shares.mean()) * extremal.trajectory.duration  # what acts for less time is not seen
    value = float((np.abs(slopes) / times).max(initial=0.0)) / scale
    if not LARGE_SLOPE < value < np.inf:
        return value
    units = choose_scales(extremal.statement, extremal.mesh, extremal.trajectory, extremal.parameters).u
    changed = float((np.abs(slopes) * units).sum())
    cost = variable_cost(extremal) + (0.0 if within is None else within.variable)
    return min(value, changed / max(VANISHING * cost, np.finfo(float).tiny))


def complementarity(extremal: Extremal, others: float = 0.0) -> float:
    """Sum of |multiplier| times distance from the bound, of controls, states, matrices and conditions, by the cost.

    Args:
        extremal: the solution.
        others: size of the cost of the rest of a chain.
    """
    return duality_gap(extremal) / max(absolute_cost(refined(extremal)) + others, NO_COST)


def duality_gap(extremal: Extremal) -> float:
    """Sum of |multiplier| times distance from the bound: no cost is known better than to this."""
    extremal = refined(extremal)  # limits act at all its nodes
    st, t, m = extremal.statement, extremal.trajectory, extremal.multipliers
    groups: list[tuple[Array, Array, Array, Array]] = [
        (m.controls, t.u, *st.control_bounds),
        (m.states, t.x, *st.state_bounds),
        (m.matrices, t.e, st.matrix_lower, np.full(st.ne, np.inf)),
    ]
    for conditions, place, values in extremal.inequalities():
        groups.append((np.atleast_2d(getattr(m, place)), values, conditions.lower, conditions.upper))
    total = 0.0
    for weights, values, lower, upper in groups:
        kept, distance = complementary(weights, values, lower, upper)
        total += float(np.sum(np.abs(kept) * distance))
    return total


def identities(
    extremal: Extremal,
    mesh_error: float,
    smallest_eigenvalue: float,
    loop: ClosedLoop | None,
    cost_identity: float | None,
) -> Optimality:
    """What holds along a nominal that was not chosen for this cost: no condition of optimality does."""
    return Optimality(
        stationarity=None,
        control_slope=None,
        costate_difference=None,
        hamiltonian_variation=None,
        transversality=None,
        mesh_error=mesh_error,
        node_error=node_error(extremal),
        control_error=None,
        smallest_eigenvalue=smallest_eigenvalue,
        curvature=None,
        cost_identity=cost_identity,
        **_loop_identities(loop),
    )


def _loop_identities(loop: ClosedLoop | None) -> dict[str, float | None]:
    """What must hold along every nominal: it checks the integration, not the optimum [spec of chapter 6, 2.1]."""
    if loop is None:
        return {}
    errors, estimates = (standard_deviations(v) for v in (loop.E, loop.X))
    own = np.maximum(errors, estimates).max(axis=0)  # of what is known exactly rounding is left
    least = np.maximum(KNOWN * own, KNOWN**2 * own.max(initial=0.0))
    errors, estimates = (np.where(v > least, v, 0.0) for v in (errors, estimates))
    size = errors[:, :, None] * estimates[:, None, :]
    cross = np.abs(loop.Z) / np.where(size > 0.0, size, np.inf)
    return {
        "cross_covariance": float(cross.max(initial=0.0)),
        "conservation": loop.conservation,
    }


class _AtNodes(NamedTuple):
    """H_u (K, nu), H_uu (K, nu, nu), H and the sum of its absolute terms (K, 2), sizes of H_u (K, nu)."""

    slope: Array
    curvature: Array
    values: Array
    sizes: Array


def _at_nodes(extremal: Extremal, costates: Costates) -> _AtNodes:
    """The Hamiltonian and its slopes at the nodes."""
    st = extremal.statement
    slope, curvature, size = by_controls_at(st, extremal.columns(), costates)
    terms = terms_of(st, extremal.columns(), costates)
    sizes = slope_sizes(size, curvature, extremal.controls)
    return _AtNodes(slope, curvature, np.column_stack([terms.sum(axis=1), np.abs(terms).sum(axis=1)]), sizes)


def _limit_slopes(extremal: Extremal) -> Array:
    """Slopes by the control values of path constraints and conditions at instants times their multipliers."""
    st, mesh = extremal.statement, extremal.mesh
    if mesh.points > 1:
        return np.asarray(prolongation(mesh).T @ _limit_slopes(refined(extremal)))
    result = instant_control_slopes(extremal)
    if not st.path.size:
        return mesh.gathered(result)
    symbols = model_symbols(st)
    weights = symbols[0].sym("mu", st.path.size)
    slope = ca.gradient(ca.dot(weights, st.path.function(*symbols)), symbols[1])
    function = ca.Function("slopes", [*symbols, weights], [ca.densify(slope)])
    count = mesh.intervals + 1
    values = np.asarray(function.map(count)(*extremal.columns(), extremal.multipliers.path.T).full()).T
    result += values[: mesh.control_nodes]
    if mesh.control == "constant":
        result[-1] += values[-1]
    return mesh.gathered(result)


def _costate_difference(extremal: Extremal, costates: Costates) -> float | None:
    """Largest relative difference to the costates that are integrated backward, where explicit steps reach."""
    pairs, first = explicit_pairs(extremal)
    if first == extremal.mesh.intervals:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        other = integrated_costates(extremal, pairs)
        both = ((costates.state, other.state), (costates.matrices, other.matrices))
        differences = [np.abs(one - two)[first:].max() / np.abs(one).max() for one, two in both if one.any()]
    largest = float(np.max(differences, initial=0.0))
    return largest if np.isfinite(largest) else None


def _of_nothing(found: Optimality) -> Optimality:
    """The conditions where nothing costs anything: what is left of their slopes is roundoff, and met."""
    named = ("stationarity", "control_slope", "hamiltonian_variation", "transversality", "control_error", "decisions")
    return replace(found, **{name: 0.0 for name in named if getattr(found, name) is not None})


def _variation(extremal: Extremal, values: Array, size: float) -> float:
    """Variation of H relative to its terms; where something is read or holds at an instant it may jump.

    Terms that are nothing beside the size of the cost over the time are what rounding left of them.
    """
    largest = float(np.max([np.ptp(values[part, 0]) for part in stretches(extremal)]))
    least = RESOLVED * size / max(extremal.trajectory.duration, np.finfo(float).tiny)
    return largest / max(float(values[:, 1].max()), least, np.finfo(float).tiny)


def _transversality(extremal: Extremal, costates: Costates, values: Array, within: Within | None) -> float:
    """k_T + slope of the end conditions and of a link + int H_T dt + H(T), relative to the largest terms of H."""
    mesh = extremal.mesh
    if mesh.points > 1:  # costates jump inside the intervals
        extremal = refined(extremal)
        costates = discrete_costates(extremal)[0]
    st, trajectory = extremal.statement, extremal.trajectory
    duration = ca.MX.sym("T")
    value = st.terminal(trajectory.x[-1], trajectory.e[-1], duration, extremal.parameters)
    if st.end.size:
        arguments = (trajectory.x[-1], trajectory.u[-1], trajectory.e[-1], duration, duration, extremal.parameters)
        value += ca.dot(ca.DM(extremal.multipliers.end), st.end.function(*arguments))
    slope = float(ca.Function("slope", [duration], [ca.gradient(value, duration)])(trajectory.duration))
    slope += instant_duration_slope(extremal)
    behind = st.entries(st.behind)
    slope += passage_end(extremal, costates.matrices[-1, behind])[1]
    (explicit,) = along(duration_slope(st), extremal, costates)
    slope += float(np.trapezoid(explicit[:, 0], extremal.time))
    slope += 0.0 if within is None else within.by_duration
    jumps = mesh.instants  # H jumps where something is read or holds, and the instant moves with T
    moved = mesh.nodes[jumps] @ (values[np.array(jumps, dtype=np.intp) + 1, 0] - values[jumps, 0])
    residual = slope + float(values[-1, 0]) - float(moved)
    bound = st.duration.lower if residual > 0 else st.duration.upper
    distance = abs(trajectory.duration - bound)
    near = distance <= ACTIVE * bound < np.inf
    if not near and distance <= BESIDE * bound < np.inf:  # solvers stay off a bound by what the cost hardly sees
        cost = variable_cost(extremal) + (0.0 if within is None else within.variable)
        near = distance * abs(residual) <= ACTIVE * cost
    if near:
        residual = 0.0  # the bound holds what would go on
    return abs(residual) / max(float(values[:, 1].max()), abs(slope), float(np.finfo(float).tiny))


def _decisions(extremal: Extremal, costates: Costates, within: Within | None) -> float | None:
    if not extremal.statement.decisions:
        return None
    if within is None:
        return decision_slopes(extremal, costates).relative
    return decision_slopes(extremal, costates, within.start, within.variable).relative


def _curvature(extremal: Extremal, seconds: float, *errors: float | None) -> float | None:
    """Of a solution that is optimised, and no part of a chain; errors: of its cost, those that are known."""
    if met_jumps(extremal, False, True):  # whose moments no derivative sees
        return np.nan
    result = smallest_curvature(extremal, seconds)
    if result is None:
        return None
    error = sum(share for share in errors if share is not None and np.isfinite(share))
    if result.verdict == "flat" or (result.verdict == "saddle" and not worth_telling(extremal, result, error)):
        return 0.0
    return result.value / max(result.largest, np.finfo(float).tiny)
