"""Certificate of global optimality for the identification of constant parameters.

The information Lambda of the parameters is quadratic in the control (`reduction`; specification, section 5), and
tr(C Lambda^-1) is convex in Lambda. With S^c = Lambda*^-1 C Lambda*^-1 at a solution u*, every control therefore costs

    J(u) >= q(u) = quadratic cost of x and u + tr(C Lambda*^-1) - tr(S^c (Lambda(u) - Lambda*)),

and q, quadratic in u, touches J at u*. Where u* is stationary (the multipliers of convex inequalities included) and
the second variation of q is not negative on the controls that keep the terminal conditions, u* is a global minimum. For
the cost int u^2/2 that second variation is the operator I - sum_ij S^c_ij (G_ij + G_ij') of consequence (i).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from covocp.checks import check_kind
from covocp.extremal import Extremal
from covocp.matrices import Array, unpack
from covocp.mesh import Mesh
from covocp.reducible import condition, terminal_slopes, terminal_weight, why_not
from covocp.reduction import Forms, Reduction
from covocp.solution import Solution
from covocp.statement import Conditions

Verdict = Literal["global minimum (certified)", "not certified", "does not apply"]

# The tolerance of the eigenvalue is this multiple of its estimated errors, plus the roundoff of the eigenproblem; costs
# below the roundoff count as zero.
SAFETY = 2.0
ROUNDOFF = 1e-9
# The eigenvalue is first order in S^c, this is second order in Lambda^-1, and Lambda is second order in the control.
PER_INFORMATION = 2.0
PER_CONTROL = 4.0
# Above these nothing is certified: tolerance of an eigenvalue that counts as zero; what another control could save,
# relative to J.
LARGEST_TOLERANCE = 1e-3
LARGEST_GAP = 1e-3


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """Whether a solution is a global minimum; numbers are None where the theory does not apply.

    Attributes:
        verdict: in three words.
        reason: what decided it, a sentence.
        smallest_eigenvalue: of the second variation of the bound q on controls that keep the terminal conditions,
            relative to the energy int u' L_uu u dt; the lesser of those on the solution's mesh and on the halved one.
        tolerance: down to minus this the eigenvalue counts as zero; from its change by halving the mesh, the
            consistency and the stationarity residual.
        stationarity: norm of the slope of the Lagrangian in the energy metric, relative to sqrt(2 |J|).
        consistency: largest relative difference between Lambda^-1 and E_bb(T) of the solution.
        gap: no control on the mesh of the solution costs less by more than this [cost].
    """

    verdict: Verdict
    reason: str
    smallest_eigenvalue: float | None = None
    tolerance: float | None = None
    stationarity: float | None = None
    consistency: float | None = None
    gap: float | None = None

    @property
    def certified(self) -> bool:
        """Whether the solution is a global minimum up to the tolerance and the gap."""
        return self.verdict == "global minimum (certified)"

    def __str__(self) -> str:
        """A sentence."""
        if self.smallest_eigenvalue is None:
            return f"{self.verdict}: {self.reason}"
        numbers = (
            f"smallest eigenvalue {self.smallest_eigenvalue:.3g} (known to {self.tolerance:.2g} by mesh and solver), "
            f"stationarity residual {self.stationarity:.2g}, "
            f"Lambda^-1 against E_bb(T) {self.consistency:.2g}"
        )
        return f"{self.verdict}: {self.reason}; {numbers}"


def certify(solution: Solution) -> Certificate:
    """Try to prove that a solution is a global minimum (specification, section 5, consequence (i)).

    Args:
        solution: of a problem that identifies constant parameters.

    Returns:
        The certificate; "does not apply" says which condition of the theory fails. "not certified" does not mean that a
        better control exists.

    Raises:
        CovocpError: where the solution was read from a file without its problem.
        ProblemError: where it is no solution.
    """
    check_kind(solution, Solution, "certify(solve(problem))")
    extremal = solution.extremal
    obstacle = why_not(extremal.statement, solution.parameters)
    if obstacle:
        return Certificate(verdict="does not apply", reason=obstacle)
    if not solution.converged:
        return Certificate(verdict="not certified", reason=f"the solution did not converge ({solution.message})")
    u, block = extremal.trajectory.u, extremal.statement.matrices[0]
    bound = Bound.at(extremal, extremal.mesh, u)
    halved = Bound.at(extremal, *halve(extremal.mesh, u))
    nx = extremal.statement.nx
    covariance = unpack(extremal.trajectory.e[-1], block.size)[nx:, nx:]
    consistency = float(np.abs(np.linalg.inv(bound.information) - covariance).max() / np.abs(covariance).max())
    slopes, slack = bound.inequalities(extremal)
    residual = float(np.linalg.norm(bound.directions.T @ (bound.slope + slopes)))
    scale = float(np.sqrt(2 * max(abs(solution.cost), ROUNDOFF)))
    eigenvalue = min(bound.eigenvalue, halved.eigenvalue)
    errors = abs(bound.eigenvalue - halved.eigenvalue) + PER_INFORMATION * consistency + PER_CONTROL * residual / scale
    tolerance = SAFETY * errors + ROUNDOFF
    reach = bound.reach()
    gap = slack + residual * reach + 0.5 * max(0.0, tolerance - eigenvalue) * reach**2
    verdict, reason = _judge(eigenvalue, tolerance, gap, abs(solution.cost))
    return Certificate(
        verdict=verdict,
        reason=reason,
        smallest_eigenvalue=eigenvalue,
        tolerance=tolerance,
        stationarity=residual / scale,
        consistency=consistency,
        gap=gap,
    )


def _judge(eigenvalue: float, tolerance: float, gap: float, cost: float) -> tuple[Verdict, str]:
    """Verdict and reason from the numbers."""
    if eigenvalue < -tolerance:
        return (
            "not certified",
            "the quadratic lower bound of the cost falls along a direction that keeps the terminal conditions, "
            "so a better control may exist",
        )
    if eigenvalue < tolerance and tolerance > LARGEST_TOLERANCE:
        return (
            "not certified",
            "mesh or solution are too inaccurate to tell the sign of the eigenvalue: use more intervals, "
            "covariance_step='gauss' or a smaller tolerance of the solver",
        )
    if not gap <= LARGEST_GAP * cost + ROUNDOFF:
        return "not certified", f"the residuals of the solution leave room for controls that cost less by {gap:.2g}"
    return "global minimum (certified)", f"no admissible control costs less by more than {gap:.2g}"


def halve(mesh: Mesh, u: Array) -> tuple[Mesh, Array]:
    """The mesh with every interval halved, and the same control on it."""
    middles = 0.5 * (mesh.nodes[1:] + mesh.nodes[:-1])
    nodes = np.sort(np.concatenate([mesh.nodes, middles]))
    if mesh.control == "constant":
        return replace(mesh, nodes=nodes), np.repeat(u, 2, axis=0)
    finer = np.empty((nodes.size, u.shape[1]))
    finer[::2], finer[1::2] = u, 0.5 * (u[1:] + u[:-1])
    return replace(mesh, nodes=nodes), finer


@dataclass(frozen=True, kw_only=True)
class Bound:
    """The quadratic lower bound q at a control, on one mesh; V control values.

    Attributes:
        reduction: the mesh and the statement.
        forms: its quadratic forms with the weight S^c.
        information: Lambda* (nb, nb).
        directions: basis of the changes of control that keep the terminal conditions, orthonormal in the energy metric,
            (V, number).
        curvature: Hessian of q on that basis; `own`: of the cost of x and u alone.
        slope: gradient of q, and of J, by the control values (V,); `own_slope`: of the cost of x and u alone.
        uncertain: tr(C Lambda*^-1), the part of the cost that q has been linearised in.
    """

    reduction: Reduction
    forms: Forms
    information: Array
    directions: Array
    curvature: Array
    own: Array
    slope: Array
    own_slope: Array
    uncertain: float

    @staticmethod
    def at(extremal: Extremal, mesh: Mesh, u: Array) -> Bound:
        """The bound at control values u (N + 1 or N, nu) of a mesh."""
        st, parameters = extremal.statement, extremal.parameters
        reduction = Reduction(st, mesh, parameters)
        information = reduction.covariance(u)[2]
        covariance = np.linalg.inv(information)
        weight = terminal_weight(st, parameters)[st.nx :, st.nx :]
        forms = reduction.forms(covariance @ weight @ covariance)
        size, w = reduction.size, np.append(u.ravel(), 1.0)
        last = forms.nodes[-1]
        gradient, hessian = terminal_slopes(st, parameters, last @ w)
        own = forms.running + last.T @ hessian @ last
        slope = forms.running @ w + forms.slope + last.T @ gradient
        rows = [last[~np.isnan(st.boundary_values(parameters)[1])], _terminal_equalities(reduction, forms, u)]
        directions = _directions(np.vstack(rows)[:, :size], forms.energy[:size, :size])
        own, falls = own[:size, :size], forms.information[:size, :size]
        return Bound(
            reduction=reduction,
            forms=forms,
            information=information,
            directions=directions,
            curvature=directions.T @ (own - falls) @ directions,
            own=directions.T @ own @ directions,
            slope=(slope - forms.information @ w)[:size],
            own_slope=slope[:size],
            uncertain=float(np.trace(weight @ covariance)),
        )

    @property
    def eigenvalue(self) -> float:
        """Smallest eigenvalue of the second variation; inf where no other control is admissible."""
        return float(np.linalg.eigvalsh(self.curvature)[0]) if self.curvature.size else np.inf

    def reach(self) -> float:
        """How far, in the energy metric, a control that costs no more can be from u*: q without the matrix bounds it.

        J(u) <= J* and tr(C Lambda^-1) >= 0 give slope d + own d^2/2 <= tr(C Lambda*^-1) for the distance d.
        """
        if not self.own.size:
            return 0.0
        slope, curvature = float(np.linalg.norm(self.directions.T @ self.own_slope)), np.linalg.eigvalsh(self.own)[0]
        if curvature <= 0:
            return np.inf
        return float((slope + np.sqrt(slope**2 + 2 * curvature * self.uncertain)) / curvature)

    def inequalities(self, extremal: Extremal) -> tuple[Array, float]:
        """Slope by the control values of the inequalities times their multipliers, and the cost of their slack."""
        st, multipliers, trajectory = extremal.statement, extremal.multipliers, extremal.trajectory
        size, count = self.reduction.size, extremal.mesh.intervals + 1
        weights, slack = _acting(multipliers.controls, trajectory.u, *st.control_bounds)
        slope = weights.ravel()
        states = multipliers.states.copy()
        states[-1] += np.where(np.isnan(st.boundary_values(extremal.parameters)[1]), multipliers.final, 0.0)
        weights, more = _acting(states, trajectory.x, *st.state_bounds)
        slope, slack = slope + np.einsum("ki,kij->j", weights, self.forms.nodes[:, :, :size]), slack + more
        for conditions, given, at in (
            (st.path, multipliers.path, range(count)),
            (st.start, multipliers.start[None, :], (0,)),
            (st.end, multipliers.end[None, :], (count - 1,)),
        ):
            if not conditions.size:
                continue
            values, maps = _rows(self.reduction, self.forms, conditions, extremal.controls, at)
            weights, more = _acting(given, values, conditions.lower, conditions.upper)
            slope, slack = slope + np.einsum("ki,kij->j", weights, maps[:, :, :size]), slack + more
        return slope, slack


def _acting(multipliers: Array, values: Array, lower: Array, upper: Array) -> tuple[Array, float]:
    """Multipliers of bounds that exist, and the sum of multiplier times distance from the bound [cost]."""
    above = np.where(np.isfinite(upper), np.maximum(multipliers, 0.0), 0.0)
    below = np.where(np.isfinite(lower), np.maximum(-multipliers, 0.0), 0.0)
    high, low = np.where(np.isfinite(upper), upper, 0.0), np.where(np.isfinite(lower), lower, 0.0)
    return above - below, float(np.sum(np.abs(above * (high - values)) + np.abs(below * (values - low))))


def _rows(reduction: Reduction, forms: Forms, conditions: Conditions, controls: Array, at: Any) -> tuple[Array, Array]:
    """Values of affine conditions at some nodes (k, rows) and their slopes by (control values, 1), (k, rows, V + 1)."""
    st, mesh, duration = reduction.statement, reduction.mesh, reduction.statement.duration.guess
    z, time, expression = condition(st, conditions, reduction.parameters)
    function = ca.Function("rows", [z, time], [ca.densify(expression), ca.densify(ca.jacobian(expression, z))])
    values, maps = [], []
    for node in at:
        last = node == mesh.intervals
        control = reduction.values(node - last, float(last), None)
        whole = np.vstack([forms.nodes[node], control])
        x = forms.nodes[node] @ np.append(controls[: mesh.control_nodes].ravel(), 1.0)
        value, slope = function(np.concatenate([x, controls[node]]), duration * mesh.nodes[node])
        values.append(np.asarray(value.full()).ravel())
        maps.append(np.asarray(slope.full()) @ whole)
    return np.array(values), np.array(maps)


def _terminal_equalities(reduction: Reduction, forms: Forms, u: Array) -> Array:
    """Slopes of the terminal conditions of subject_to that are equalities, (rows, V + 1)."""
    end = reduction.statement.end
    if not end.size:
        return np.zeros((0, reduction.size + 1))
    controls = u if u.shape[0] > reduction.mesh.intervals else np.vstack([u, u[-1:]])
    rows = _rows(reduction, forms, end, controls, (reduction.mesh.intervals,))[1][0]
    return np.asarray(rows[end.lower == end.upper])


def _directions(rows: Array, energy: Array) -> Array:
    """Basis of the null space of the rows, orthonormal in the energy metric."""
    from scipy.linalg import null_space, solve_triangular  # here: importing scipy takes longer than all of covocp

    sizes = np.linalg.norm(rows, axis=1)
    kept = rows[sizes > 0] / sizes[sizes > 0][:, None]
    basis = null_space(kept) if kept.size else np.eye(energy.shape[0])
    factor = np.linalg.cholesky(basis.T @ energy @ basis)
    return np.asarray(solve_triangular(factor, basis.T, lower=True).T)
