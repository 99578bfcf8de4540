"""The residuals of the necessary conditions in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.pages import Section, Sentence, Table
from covocp.extremal.path_limits import acting
from covocp.solution.jumps import jumps_of
from covocp.solution.origin import Origin
from covocp.statement.separation import quadratic, separates

if TYPE_CHECKING:
    from covocp.solution.solution import Solution

RESIDUALS = {
    "stationarity": "stationarity (relative)",
    "complementarity": "complementarity (relative to the cost)",
    "control_slope": "H_u at the nodes, root mean square (relative)",
    "costate_difference": "costates: multipliers against backward integration (relative)",
    "hamiltonian_variation": "variation of the Hamiltonian along the path (relative)",
    "transversality": "condition of the free duration, k_T + H(T) (relative)",
    "decisions": "condition of the decisions, int H_d dt + end terms (relative)",
    "mesh_error": "cost: change by halving the integration steps (relative)",
    "node_error": "nodes: change by halving the integration steps (of the range)",
    "control_error": "cost: estimated effect of the piecewise form of the controls (relative)",
    "smallest_eigenvalue": "smallest eigenvalue of the covariances at all nodes",
    "cost_identity": "expected cost: as optimised against from the covariances (relative)",
    "cross_covariance": "correlation of the estimate and its error, zero by the statistics of the design",
    "conservation": "variances E + Xhat that no control changes: error (relative)",
    "curvature": "smallest curvature of the reduced Hessian (relative to its largest)",
}
# The change where rates depend on the time: halves may miss in the cost what they see in the states.
OR_STATES = "cost, or states between nodes: change by halving the steps (relative)"

# Of costates that nothing is compared with.
UNCHECKED = "not checked: explicit steps back would be too many; costates near the end may be off"
# Of nodes and costs that are no run along the controls.
STEPS = "LARGE: the integration steps are too long, or an unstable plant amplifies them: more intervals or substeps"
# Of the optimum of a quadratic program.
OTHER_SUM = "large: on so coarse a mesh, as the cost is summed up otherwise than where this is optimal: more intervals"
# Where to begin to worry about a residual, and what a large one means.
WORRIES: dict[str, tuple[float, str]] = {
    "stationarity": (1e-3, "LARGE: not yet stationary; a smaller tolerance=, or start again from it"),
    "complementarity": (
        1e-3,
        "LARGE: multipliers push at bounds that are not reached; a smaller tolerance=, or start again from it",
    ),
    "costate_difference": (
        1e-2,
        "large: the costates change within an interval (a constraint takes hold, a stiff start or end); costs and "
        "controls may be right all the same: worry if the mesh error is large, or if it stays on twice the intervals",
    ),
    "hamiltonian_variation": (
        1e-2,
        "large: the controls or costates change within an interval; worry if it stays on twice the intervals",
    ),
    "transversality": (1e-2, "LARGE: the duration is not the best one, or the mesh too coarse: more intervals"),
    "decisions": (1e-4, "LARGE: the decisions are not the best ones yet; a smaller tolerance=, or start from here"),
    "control_slope": (
        0.1,
        "large: the controls change within an interval; what that costs is the effect of their piecewise form below",
    ),
    "mesh_error": (2e-4, STEPS),
    "node_error": (1e-2, STEPS),
    "control_error": (1e-3, "large: the cost is off by about that: more intervals, or refine="),
    "cost_identity": (1e-3, "LARGE: the expected cost is known to no more than this: more intervals"),
    "cross_covariance": (
        1e-2,
        "large: the gains change faster than the steps that check them; worry if the expected costs differ as well",
    ),
    "conservation": (1e-3, "LARGE: the covariances are known to no more than this: more intervals"),
}


def residual_section(solution: Solution) -> Section:
    """The residuals of the necessary conditions, and what a large one means."""
    try:
        values = solution.optimality.as_dict()
    except (CovocpError, RuntimeError, ArithmeticError, ValueError) as error:
        return [Sentence(f"necessary conditions: not evaluated ({str(error).splitlines()[0][:100]})")]
    rows = []
    for name, value in values.items():
        if value is None and name == "costate_difference" and values["stationarity"] is not None:
            rows.append([RESIDUALS[name], "-", UNCHECKED])
        if value is None or (name == "smallest_eigenvalue" and np.isinf(value)):
            continue
        rows.append(
            [
                _words(solution, name),
                "-" if np.isnan(value) else f"{value:.2e}",
                _verdict(solution, name, value),
            ]
        )
    return [Table(columns=["necessary conditions", "", ""], rows=rows, words=(0, 2))]


def _words(solution: Solution, name: str) -> str:
    """What a residual is of."""
    statement = solution.statement
    if name == "mesh_error" and statement is not None and not statement.autonomous:
        return OR_STATES
    return RESIDUALS.get(name, name.replace("_", " "))


def _verdict(solution: Solution, name: str, value: float) -> str:
    """What a sign means, and what a residual does that is larger than usual."""
    if name == "smallest_eigenvalue":
        return "semidefinite" if solution.semidefinite else "INDEFINITE"
    if name == "mesh_error" and np.isnan(value) and solution.converged:
        return "not assessed"
    if name == "control_error" and np.isnan(value) and solution.converged:
        return _not_known(solution)
    if name == "curvature" and np.isnan(value):
        return _unknown_curvature(solution)
    if name == "curvature" and solution.converged:
        return "minimum" if value > 0 else "NOT A MINIMUM" if value < 0 else "flat: sign or gain below the error"
    if name == "cross_covariance" and solution.origin is Origin.OTHER_TRUTH:
        return "by other statistics than the design's"
    level, words = WORRIES.get(name, (np.inf, ""))
    if name == "control_error" and solution.mesh.control == "constant":
        words += ", or control='linear'"
    statement = solution.statement
    if name == "stationarity" and statement is not None and separates(statement) and quadratic(statement):
        words = OTHER_SUM
    return words if solution.converged and abs(value) > level else ""


def _unknown_curvature(solution: Solution) -> str:
    """Why it is not known whether a solution is a minimum."""
    if jumps_of(solution):
        return "NOT KNOWN: the model jumps with the state, and slopes do not see when"
    return "NOT KNOWN: it would take longer than the solution, solve again with fewer intervals"


def _not_known(solution: Solution) -> str:
    """What is said in place of the effect of the form of the controls: which limits act, and what tells more."""
    reason = ""
    if solution.statement is not None:
        shares = acting(solution.extremal)
        if not shares:
            alone = solution.trajectory.u.shape[0] == 1
            return "NOT KNOWN, with one control value to compare: more intervals" if alone else ""
        where = max(shares, key=lambda name: shares[name])
        reason = f", as '{where}' acts in {100 * shares[where]:.2g} % of the time"
    return f"NOT KNOWN{reason}: compare the cost with that of twice the intervals, or refine="
