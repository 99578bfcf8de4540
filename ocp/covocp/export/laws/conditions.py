"""How well the first-order conditions of a minimum hold at what the NLP solver of an exported law returns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Given
from covocp.transcription.nlp import NLP

# In the NLP's own units: what counts as solved.
INFEASIBLE, STATIONARY = 1e-6, 1e-5
# Of the QP for multipliers: iterations, multipliers that are rounding, and with which one a bound binds at first.
MOST_CHANGES, INACTIVE, BEGUN = 200, 1e-9, 1e-3


def lagrangian_slope(nlp: NLP) -> ca.Function:
    """(variables, parameters, multipliers of the constraints) -> slopes of the Lagrangian without bounds."""
    weights = ca.MX.sym("multipliers", nlp.g.shape[0])
    if nlp.gradient is None:
        slope = ca.gradient(nlp.f + ca.dot(weights, nlp.g), nlp.w)
    else:
        slope = nlp.gradient[1] + ca.mtimes(nlp.jacobian.T, weights)
    return ca.Function("lagrangian_slope", [nlp.w, nlp.p, weights], [ca.densify(slope)])


def residuals(nlp: NLP, at: Mapping[str, Any], duration: Given, slopes: ca.Function | None) -> tuple[Any, Any]:
    """Largest violation of a constraint; largest slope of the Lagrangian, with multipliers of what does not bind.

    Args:
        nlp: the transcription.
        at: by CasADi's names: x, p (with the unit of the cost), g, lbx, ubx, lbg, ubg, and the multipliers lam_x, lam_g
            in that unit.
        duration: of the plan.
        slopes: (x, p) -> f, its slopes, g, its slopes; None: the multipliers are those of the solver in any case.
            Given, they are taken anew at x where with those of the solver the conditions do not hold.
    """
    both = ca.vertcat(at["x"], at["g"])
    lower, upper = ca.vertcat(at["lbx"], at["lbg"]), ca.vertcat(at["ubx"], at["ubg"])
    violation = ca.mmax(ca.fmax(0.0, ca.fmax(lower - both, both - upper)))
    # the larger of NaN and 0 is 0: what has no value would be met
    violation = ca.fmax(violation, ca.mmax(ca.if_else(ca.fabs(both) < np.inf, 0.0, np.inf)))
    violation = ca.fmax(violation, ca.if_else(duration > 0.0, 0.0, 1.0))  # a plan backwards in time is none
    lagrangian = lagrangian_slope(nlp)(at["x"], at["p"], at["lam_g"])
    left = _left(lagrangian + at["lam_x"], both, lower, upper, ca.vertcat(at["lam_x"], at["lam_g"]))
    if slopes is None:
        return violation, left
    slack = upper - both, both - lower
    own = ca.vertcat(at["lam_x"], at["lam_g"])
    own = ca.if_else(ca.if_else(own > 0.0, *slack) < INFEASIBLE, own, 0.0)  # of what does not bind they say nothing
    reached = ca.if_else(slack[0] < INFEASIBLE, BEGUN, ca.if_else(slack[1] < INFEASIBLE, -BEGUN, 0.0))
    better = _with_new_multipliers(nlp, slopes)
    for first in (own, reached):
        again = ca.logic_and(violation <= INFEASIBLE, ca.logic_not(left <= STATIONARY))
        left = better(again, left, at["x"], at["p"], first, lower, upper)
    return violation, left


def _left(lagrangian: Given, both: Given, lower: Given, upper: Given, weights: Given) -> Any:
    """The slopes that are left, and the multipliers of what does not bind or the distance to it, the largest of them.

    Args:
        lagrangian: slopes of the Lagrangian with the multipliers of the bounds.
        both: variables, constraints.
        lower: bounds of both.
        upper: bounds of both.
        weights: multipliers of both.
    """
    slack = ca.if_else(weights > 0.0, upper - both, both - lower)
    loose = ca.mmax(ca.if_else(weights == 0.0, 0.0, ca.fmin(ca.fabs(weights), ca.fabs(slack))))
    largest = ca.norm_inf(ca.if_else(ca.fabs(lagrangian) < np.inf, lagrangian, np.inf))
    return ca.fmax(largest, loose)


def _with_new_multipliers(nlp: NLP, slopes: ca.Function) -> ca.Function:
    """(whether to look again, what is left, x, p, first multipliers, lower, upper) -> what is left, with the better.

    Sqpmethod ends at a step of the length of rounding, of which its line search, to which the cost is then nothing but
    rounding, may have taken a part: the variables are those of the minimum, but the multipliers lie between those of
    its last QPs. Those of min |d|^2 / 2 + f'd within the linearised constraints are the ones by least squares with
    the signs of what binds: with H = 1 the slope of the Lagrangian that they leave is -d, and there is no d at a
    minimum. What they leave is measured at x as that of the solver: whatever this QP returns, nothing else is solved.
    From a first active set that is not about the right one qrqp often finds none.
    """
    n, m = int(nlp.w.shape[0]), int(nlp.g.shape[0])
    sizes = {"left": 1, "x": n, "p": int(nlp.p.shape[0]), "first": n + m, "lower": n + m, "upper": n + m}
    given = [ca.MX.sym(name, size) for name, size in sizes.items()]
    left, x, p, first, lower, upper = given
    _, gradient, g, jacobian = slopes(x, p)
    settings = {
        "print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False, "print_time": False,
        "min_lam": INACTIVE, "max_iter": MOST_CHANGES,
    }  # fmt: skip
    solver = ca.conic("multipliers", "qrqp", {"h": ca.Sparsity.diag(n), "a": jacobian.sparsity()}, settings)
    both = ca.vertcat(x, g)
    low, high = lower - both, upper - both
    found = solver(
        h=ca.MX.eye(n), g=gradient, a=jacobian, lbx=low[:n], ubx=high[:n], lba=low[n:], uba=high[n:],
        lam_x0=first[:n], lam_a0=first[n:],
    )  # fmt: skip
    weights = ca.vertcat(found["lam_x"], found["lam_a"])
    lagrangian = gradient + ca.mtimes(jacobian.T, found["lam_a"]) + found["lam_x"]
    least = ca.fmin(left, _left(lagrangian, both, lower, upper, weights))
    return ca.Function.if_else(
        "stationarity", ca.Function("with_new_multipliers", given, [least]), ca.Function("as_it_is", given, [left])
    )
