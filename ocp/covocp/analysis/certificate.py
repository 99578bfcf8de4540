"""Certificate of global optimality for the identification of constant parameters.

The information Lambda of the parameters is quadratic in the control (`reduction`; specification, section 5), and
tr(C Lambda^-1) is convex in Lambda. With S^c = Lambda*^-1 C Lambda*^-1 at a solution u*, every control therefore costs

    J(u) >= q(u) = quadratic cost of x and u + tr(C Lambda*^-1) - tr(S^c (Lambda(u) - Lambda*)),

and q, quadratic in u, touches J at u*. Where the second variation of q is not negative on the controls that keep the
terminal conditions, the least value of q with the multipliers of the (convex) inequalities is a lower bound for every
admissible control of finite energy, on whatever mesh or none; how far it is below J(u*) is the gap. For the cost
int u^2/2 that second variation is the operator I - sum_ij S^c_ij (G_ij + G_ij') of consequence (i).

All of it is computed on meshes finer than the solution's, with controls that may jump (`stages`), on two of them: how
the numbers change from one to the other is their error, and part of the tolerance and of the gap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal

import casadi as ca
import numpy as np

from covocp.analysis.conditions import why_not
from covocp.analysis.constraint_duals import evaluated
from covocp.analysis.lower_bound import Bound
from covocp.analysis.mesh_bound import both_ends, divided, mesh_residual
from covocp.analysis.reduction import Reduction, parts, resolved
from covocp.base.arguments import checked, truth
from covocp.base.checks import check_kind
from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, standard_deviations, unpack
from covocp.base.pages import lines_as_html
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.base.threads import one_at_a_time
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import refined
from covocp.solution.phases import check_whole
from covocp.solution.solution import Solution
from covocp.statement.statement import Conditions
from covocp.transcription.first_guess import simulate_states
from covocp.transcription.scales import needed_controls, unvanishing

Verdict = Literal["global minimum (certified)", "not certified", "does not apply"]

# The tolerance of the eigenvalue is this multiple of its change from one mesh to the next, plus its error on the finer
# one and the roundoff of the eigenproblem.
SAFETY = 2.0
# Of eigenvalues, which have no unit; of a cost it is a share of what its terms add up to without their signs.
ROUNDOFF = 1e-9
# Intervals of the coarser of the two meshes, at least.
INTERVALS = 100
# Below this an eigenvalue is negative, and not what the mesh leaves of zero.
# Above these nothing is certified: what another control could save, relative to J; what a constraint is violated by,
# relative to its limit or to what its values are made of; what solvers leave of a limit where all these are zero,
# relative to the units that the cost gives (Ipopt relaxes bounds by 1e-8).
LARGEST_FALL = 1e-3
LARGEST_GAP = 1e-3
LARGEST_VIOLATION = 1e-6
LEFT_AT_ZERO = 1e-7
# Controls that move no state by more than this share of its standard deviation do nothing: what they cost is no gap
# either, so that a cost which is zero but for what the solver leaves of it has a size.
NOTHING_MOVES = 1e-5


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """Whether a solution is a global minimum; numbers are None where they were not computed.

    Attributes:
        verdict: in three words.
        reason: what decided it, a sentence.
        smallest_eigenvalue: of the second variation of the bound q on controls of finite energy that keep the terminal
            conditions, relative to the energy int u' L_uu u dt.
        tolerance: down to minus this the eigenvalue counts as zero; from its change by halving the mesh.
        stationarity: norm of the slope of the Lagrangian in the energy metric, between the nodes as well, relative to
            sqrt(2 |J|); where the terms of J cancel, to what is left of them by rounding.
        consistency: largest relative difference between Lambda^-1 and E_bb(T) of the solution.
        gap: no admissible control of finite energy costs less by more than this [cost]; inf where nothing is known,
            None where the theory does not apply.
        mesh_gap: no admissible control on the mesh of the solution does by more than this [cost]; None where that is
            not known.
    """

    verdict: Verdict
    reason: str
    smallest_eigenvalue: float | None = None
    tolerance: float | None = None
    stationarity: float | None = None
    consistency: float | None = None
    gap: float | None = None
    mesh_gap: float | None = None

    __repr__ = short_repr

    @property
    def certified(self) -> bool:
        """Whether the solution is a global minimum up to the gap."""
        return self.verdict == "global minimum (certified)"

    def __str__(self) -> str:
        """A sentence."""
        if self.smallest_eigenvalue is None:
            return f"{self.verdict}: {self.reason}"
        numbers = (
            f"smallest eigenvalue {self.smallest_eigenvalue:.3g} (known to {self.tolerance:.2g}), "
            f"stationarity residual {self.stationarity:.2g}, "
            f"Lambda^-1 against E_bb(T) {self.consistency:.2g}"
        )
        return f"{self.verdict}: {self.reason}; {numbers}"

    def _repr_html_(self) -> str:
        """What a notebook shows: the same sentence."""
        return lines_as_html(str(self))


@one_at_a_time
@checked(progress=truth)
def certify(solution: Solution, *, progress: bool = True) -> Certificate:
    """Try to prove that a solution is a global minimum (specification, section 5, consequence (i)).

    Args:
        solution: of a problem that identifies constant parameters.
        progress: whether to show on a terminal what is computed.

    Returns:
        The certificate; "does not apply" says which condition of the theory fails. "not certified" does not mean that a
        better control exists.

    Raises:
        CovocpError: where the solution was read from a file without its problem.
        ProblemError: where it is no solution.
    """
    check_kind(solution, Solution, "certify(solve(problem))")
    check_whole(solution, "certify()")
    extremal = solution.extremal
    obstacle = why_not(extremal.statement, solution.parameters)
    if obstacle:
        return Certificate(verdict="does not apply", reason=obstacle)
    if not solution.converged:
        reason = f"the solution did not converge ({solution.message})"
        return Certificate(verdict="not certified", reason=reason, gap=np.inf)
    broken = violations(solution)
    if broken:
        name = max(broken, key=lambda key: broken[key])
        reason = f"it violates the constraints of the problem: {name} by {broken[name]:.3g}"
        return Certificate(verdict="not certified", reason=reason, gap=np.inf)
    with Progress(f"certifying {solution.name}", progress) as reporter:
        try:
            return _certified(solution, reporter)
        except np.linalg.LinAlgError:
            reason = "the running cost is not strictly convex in the control at all times"
            return Certificate(verdict="does not apply", reason=reason)


def _certified(solution: Solution, reporter: Progress) -> Certificate:
    """The numbers and the verdict of a solution that meets the constraints."""
    extremal, cost = refined(solution.extremal), solution.cost  # limits act at all nodes of this
    mesh = resolved(extremal.statement, extremal.mesh, extremal.parameters)
    extremal, w = replace(extremal, mesh=mesh), both_ends(extremal)
    pieces = max(1, int(np.ceil(INTERVALS / mesh.intervals)))
    bounds, eigenvalues, errors = [], [], []
    for factor in (pieces, 2 * pieces):
        reporter.say(f"{factor * mesh.intervals} intervals")
        bounds.append(Bound.at(extremal, *divided(mesh, w, factor)))
        eigenvalue, error = bounds[-1].smallest(bounds[-1].curvature)
        eigenvalues.append(eigenvalue)
        errors.append(error)
    eigenvalue = min(eigenvalues)
    tolerance = SAFETY * (_difference(eigenvalues) + max(errors)) + ROUNDOFF
    reporter.say("what other controls can save")

    def reach() -> float:
        return bounds[-1].reach(max(0.0, cost - bounds[-1].cost))

    gaps = [cost - b.cost + b.slack + b.room(e, tolerance, reach) for b, e in zip(bounds, eigenvalues, strict=True)]
    gap = max(0.0, gaps[-1]) + _difference(gaps)
    mesh_gap = _on_the_mesh(solution.extremal, eigenvalue, tolerance, reach)
    mesh_gap = mesh_gap if mesh_gap is None else min(mesh_gap, gap)
    nx, size = extremal.statement.nx, extremal.statement.matrices[0].size
    covariance = unpack(extremal.trajectory.e[-1], size)[nx:, nx:]
    information = Reduction(extremal.statement, mesh, extremal.parameters).covariance(extremal.trajectory.u)[2]
    consistency = float(np.abs(np.linalg.inv(information) - covariance).max() / np.abs(covariance).max())
    least = max(ROUNDOFF * bounds[-1].magnitude, float(np.finfo(float).tiny))
    allowed = LARGEST_GAP * abs(cost) + max(least, _cost_of_nothing(solution.extremal))
    verdict, reason = _judge(eigenvalue, gap, mesh_gap, allowed)
    return Certificate(
        verdict=verdict,
        reason=reason,
        smallest_eigenvalue=eigenvalue,
        tolerance=tolerance,
        stationarity=float(np.linalg.norm(bounds[-1].slope) / np.sqrt(2 * max(abs(cost), least))),
        consistency=consistency,
        gap=gap,
        mesh_gap=mesh_gap,
    )


def _difference(pair: list[float]) -> float:
    """Of two numbers; none where both are infinite."""
    return 0.0 if pair[0] == pair[1] else abs(pair[1] - pair[0])


def _judge(eigenvalue: float, gap: float, mesh_gap: float | None, allowed: float) -> tuple[Verdict, str]:
    """Verdict and reason from the numbers; `allowed`: the largest gap that is none [cost]."""
    if gap <= allowed:
        on_mesh = "" if mesh_gap is None else f" (on its own mesh: {mesh_gap:.2g})"
        return (
            "global minimum (certified)",
            f"no admissible control of finite energy costs less by more than {gap:.2g}{on_mesh}",
        )
    if eigenvalue < -LARGEST_FALL:
        return (
            "not certified",
            "the quadratic lower bound of the cost falls along a direction that keeps the terminal conditions, "
            "so a better control may exist",
        )
    if mesh_gap is not None and mesh_gap <= allowed:
        return (
            "not certified",
            f"on its own mesh no admissible control costs less by more than {mesh_gap:.2g}, but a freer one may by up "
            f"to {gap:.2g}: use more intervals",
        )
    return "not certified", f"the residuals of the solution leave room for controls that cost less by {gap:.2g}"


def violations(solution: Solution) -> Mapping[str, float]:
    """What a solution violates its problem by, by name, beyond a share of the natural size of it.

    It is looked at where limits are imposed: at the nodes, and at the points between them. A limit counts with its own
    size, that of the values along the whole way, and what they are made of: of a state its standard deviation, of a
    condition its terms. Where all of these are zero, what is left by rounding and by the solver counts with the unit of
    the control that the cost gives. So no unit decides, and a limit of zero that is met up to rounding is met.
    """
    extremal = refined(solution.extremal)
    st, t = extremal.statement, extremal.trajectory
    x0, xf, _, _ = st.boundary_values(extremal.parameters)
    deviations = standard_deviations(unpack(t.e, st.matrices[0].size))[:, : st.nx]
    share = LEFT_AT_ZERO / LARGEST_VIOLATION
    least_x, least_u = (share * unit for unit in _units(extremal, sum(map(abs, solution.cost_terms.values()))))
    states = np.maximum(np.maximum(np.abs(t.x), deviations).max(axis=0), least_x)
    controls = np.maximum(np.abs(t.u).max(axis=0), least_u)
    groups = [
        (st.control_names, t.u, *st.control_bounds, controls, ""),
        (st.state_names, t.x, *st.state_bounds, states, ""),
    ]
    for given, values, words in ((x0, t.x[:1], "initial value of "), (xf, t.x[-1:], "final value of ")):
        lower, upper = (np.where(np.isnan(given), free, given) for free in (-np.inf, np.inf))
        groups.append((st.state_names, values, lower, upper, states, words))
    terms = np.concatenate([states, controls])
    for conditions, _, values in extremal.inequalities():
        assert isinstance(conditions, Conditions)  # at instants none: they have no certificate
        sizes = np.maximum(np.abs(values).max(axis=0), _terms(extremal, conditions, terms))
        groups.append((conditions.names, values, conditions.lower, conditions.upper, sizes, ""))
    result = dict(solution.violations)
    for names, values, lower, upper, sizes, words in groups:
        limits = [np.where(np.isfinite(bound), np.abs(bound), 0.0) for bound in (lower, upper)]
        excess = np.maximum(lower - values, values - upper).max(axis=0)
        allowed = LARGEST_VIOLATION * np.maximum.reduce([sizes, *limits])
        for name, value, most in zip(names, excess, allowed, strict=True):
            if value > most:
                result[words + name] = max(float(value), result.get(words + name, 0.0))
    return result


def _units(extremal: Extremal, cost: float) -> tuple[Array, Array]:
    """Units of states (nx,) and controls (nu,) that do not vanish with them, for a size of the cost.

    A control is constant and costs by its energy int L_uu u^2/2 dt as much as the solution, or moves a state by its
    magnitude where that is less; states have the response to these, or their magnitude.
    """
    st, t, p = extremal.statement, extremal.trajectory, extremal.parameters
    energy = _energies(extremal)
    u = np.sqrt(2 * cost / np.where(energy > 0, energy, np.inf))
    magnitudes = unvanishing(st, extremal.mesh, t, p)
    needed = needed_controls(st, extremal.mesh, t, magnitudes, p)
    lower, upper = st.control_bounds
    u = np.minimum(u, np.where(needed > 0, needed, np.inf))
    u = np.minimum(u, np.where(upper > lower, 0.5 * (upper - lower), np.inf))
    start, base = (t.x[0], t.e[0]), t.u
    along = simulate_states(st, extremal.mesh, *start, base, t.duration, p)
    moved = [
        np.abs(simulate_states(st, extremal.mesh, *start, base + row, t.duration, p) - along).max(axis=0)
        for row in np.diag(u)
    ]
    return np.minimum(np.max(moved, axis=0, initial=0.0), magnitudes), u


def _energies(extremal: Extremal) -> Array:
    """int L_uu dt of each control, (nu,): twice what it costs where it is one all the time."""
    st, times = extremal.statement, extremal.time
    given = parts(st, extremal.parameters)
    diagonal = ca.diag(ca.hessian(given.running, given.z)[0][st.nx :, st.nx :])
    at_zero = ca.densify(ca.substitute(diagonal, given.z, ca.DM.zeros(given.z.shape)))
    energies = ca.Function("energies", [given.time], [at_zero]).map(times.size)(times.reshape(1, -1)).full()
    return np.asarray(extremal.trajectory.duration * energies.mean(axis=1))


def _cost_of_nothing(extremal: Extremal) -> float:
    """The least cost of a constant control that moves some state by `NOTHING_MOVES` of its deviation; 0 without one."""
    st, t = extremal.statement, extremal.trajectory
    deviations = standard_deviations(unpack(t.e, st.matrices[0].size))[:, : st.nx].max(axis=0)
    units = np.where(deviations > 0, deviations, np.inf)
    needed = needed_controls(st, extremal.mesh, t, units, extremal.parameters)
    costs = 0.5 * _energies(extremal) * (NOTHING_MOVES * needed) ** 2
    return float(min(costs[costs > 0], default=0.0))


def _terms(extremal: Extremal, conditions: Conditions, sizes: Array) -> Array:
    """The largest term of affine conditions, (rows,), for sizes of state and control, (nx + nu,)."""
    z = np.hstack([extremal.trajectory.x, extremal.controls])
    _, maps = evaluated(extremal, conditions, z, extremal.time)
    return np.asarray((np.abs(maps) * sizes).max(axis=(0, 2)))


def _on_the_mesh(extremal: Extremal, eigenvalue: float, tolerance: float, reach: Callable[[], float]) -> float | None:
    """What another control on the mesh of the solution can save; None where the eigenvalue leaves it open.

    The slope on the mesh is the tolerance of the solver; the second variation is that on all controls, or larger.
    """
    residual, slack = mesh_residual(extremal, both_ends(extremal))
    least = eigenvalue - tolerance
    if np.isinf(least):
        return max(0.0, slack)
    if least > 0:
        return max(0.0, slack + 0.5 * residual**2 / least)
    radius = reach()
    room = slack + residual * radius - 0.5 * least * radius**2
    return max(0.0, room) if np.isfinite(room) else None
