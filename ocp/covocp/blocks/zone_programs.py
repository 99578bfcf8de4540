"""Small programs of guidance between pointing zones, written out: as scalar operations, with no solver in C.

A gradient b moves the attitude by d = kappa b. Zones are rows A d >= beta, section 3 of the specification of attitude
seeking; the step bound is |kappa b| <= d_max. All programs here come down to the box problem

    min mu'G mu / 2 - g'mu,  0 <= mu <= s

of the multipliers of at most three rows, which is solved by going through its active sets. Projections between more
zones are left to OSQP, in units in which they are of size 1, and where it does not find the optimum, among them all
programs that have none, the same is done with every three of the rows: a vector of three numbers needs no more.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations, product
from typing import Any, NamedTuple

import casadi as ca

from covocp.base.expressions import Expr
from covocp.blocks.arithmetic import TINY, where
from covocp.blocks.eigenvalues import symmetric_eigen

# 3^3 active sets, each a few operations, in every halving.
MOST_ROWS = 3
# Halvings of the interval of ln(lambda), which is shorter than 50: what is left is below 1e-10.
HALVINGS = 40
# Smallest lambda that is looked for, over the smallest eigenvalue of Lambda: it changes b by as much.
LEAST = 1e-10
# Steps of sequential programming for the quadratic condition, which converges quadratically.
CORRECTIONS = 6
# Below this surprise r'S^-1 r no gain can move the estimate.
SILENT = 1e-6
# Shares of a step that sequential programming leaves too much; more would be a zone that cannot be met.
SHORTER = 1e-3
# A row shorter than this says nothing about where to turn: its axis is in the middle of the cone, or opposite to it,
# and what is left of x * z is rounding.
SHORTEST_ROW = 1e-12
# Rows whose G leaves less than this of a pivot depend on one another, up to rounding.
DEPENDENT = 1e-13
# Of a program of size 1: what is left is about 1e-9. Polishing would write to the console.
OSQP: dict[str, Any] = {
    "error_on_fail": False,
    "osqp": {"verbose": False, "eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 4000, "polish": False},
}
# Residuals of the conditions of optimality up to which its answer is taken.
OPTIMAL = 1e-7


class Rows(NamedTuple):
    """Zones seen from an attitude.

    matrix: A, (m, 3) [cosine units/rad].
    bounds: beta, (m, 1) [cosine units].
    """

    matrix: Any
    bounds: Any


class Constrained(NamedTuple):
    """The solution of (R).

    gradient: b, (3,) [W/rad].
    multiplier: lambda of the step bound.
    multipliers: mu of the rows, (m,).
    slack: zeta, (m,) [cosine units].
    """

    gradient: Any
    multiplier: Any
    multipliers: Any
    slack: Any


class _Weighted(NamedTuple):
    """The quadratic cost (b - b*)'Lambda (b - b*) / 2 along the eigenvectors of Lambda.

    values: of Lambda, (3, 1).
    vectors: as columns, (3, 3).
    linear: Lambda b*, along them, (3, 1).
    """

    values: Any
    vectors: Any
    linear: Any


def box_problem(G: Expr, g: Expr, limits: Expr = None, *, dependent: float = 0.0) -> Any:
    """Multipliers of least mu'G mu / 2 - g'mu between 0 and limits, by enumeration.

    Each active set gives one candidate, cut off at the limits so that it is feasible; the best of them is the solution,
    because the right active set is among them. A set whose block of G is singular has a subset as good.

    Args:
        G: SX, positive semidefinite, (m, m), m <= 3.
        g: SX, (m, 1).
        limits: SX or DM, (m, 1); None: none.
        dependent: share of an entry of the diagonal of G; where elimination leaves no more, rows count as dependent.

    Returns:
        mu, SX, (m, 1).
    """
    count = g.shape[0]
    best, least = ca.SX.zeros(count, 1), ca.SX(0)
    choices = (0, 1) if limits is None else (0, 1, 2)
    for kinds in product(choices, repeat=count):
        if not any(kinds):
            continue
        mu = _candidate(G, g, limits, kinds, dependent)
        cost = ca.dot(mu, 0.5 * (G @ mu) - g)
        better = cost < least  # also false where the cost is no number
        best, least = ca.if_else(better, mu, best), ca.if_else(better, cost, least)
    return best


def _candidate(G: Expr, g: Expr, limits: Expr, kinds: tuple[int, ...], dependent: float) -> Any:
    """Multipliers of one active set; of each row 0: zero, 1: between, 2: at its limit."""
    free = [i for i, kind in enumerate(kinds) if kind == 1]
    mu = ca.SX.zeros(len(kinds), 1)
    for i, kind in enumerate(kinds):
        if kind == 2:
            mu[i] = limits[i]
    if free:
        right = g[free] - (G @ mu)[free] if any(kind == 2 for kind in kinds) else g[free]
        found = _solved(G[free, free], right, dependent)
        for k, i in enumerate(free):
            mu[i] = ca.fmax(found[k], 0) if limits is None else ca.fmin(ca.fmax(found[k], 0), limits[i])
    return mu


def _solved(M: Expr, right: Expr, dependent: float) -> Any:
    """M^-1 right of at most three rows by elimination; what a pivot of zero would decide is zero."""
    rows, values = ca.SX(M), ca.SX(right)
    count = rows.shape[0]
    for k in range(count):
        if dependent > 0 and k:
            rows[k, k] = where(rows[k, k] > dependent * M[k, k], rows[k, k])
        for i in range(k + 1, count):
            share = _over(rows[i, k], rows[k, k])
            rows[i, k:] = rows[i, k:] - share * rows[k, k:]
            values[i] = values[i] - share * values[k]
    found = ca.SX.zeros(count, 1)
    for k in reversed(range(count)):
        rest = values[k] - (rows[k, k + 1 :] @ found[k + 1 :] if k + 1 < count else 0)
        found[k] = _over(rest, rows[k, k])
    return found


def _over(value: Expr, divisor: Expr) -> Any:
    """value / divisor, 0 where the divisor is not positive."""
    return where(divisor > 0, value / ca.if_else(divisor > 0, divisor, 1))


def projection(gradient: Expr, rows: Rows, kappa: float, *, curvature: bool = False) -> Any:
    """The nearest gradient whose step fits to the rows, section 5.

    Args:
        gradient: SX, b, (3, 1) [W/rad].
        rows: of at most three zones.
        kappa: [rad^2/W].
        curvature: rows with the quadratic condition, A d - |d|^2 / 2 >= beta.

    Returns:
        b + kappa A'mu of least distance to b, SX, (3, 1).
    """
    cost = _Weighted(ca.SX.ones(3, 1), ca.SX.eye(3), ca.SX(gradient))
    return _corrected(cost, rows, kappa, _unbounded, curvature=curvature).gradient


def projection_by_solver(gradient: Expr, matrix: Expr, bounds: Expr, kappa: float) -> Any:
    """As `projection`, of any number of rows, by OSQP.

    Args:
        gradient: MX, b, (3, 1) [W/rad].
        matrix: MX, A, (m, 3).
        bounds: MX, beta, (m, 1).
        kappa: [rad^2/W].

    Returns:
        MX, (3, 1).
    """
    step = ca.MX.sym("step", 3)
    rows, limits = ca.MX.sym("A", *matrix.shape), ca.MX.sym("beta", matrix.shape[0])
    lengths = ca.sqrt(ca.sum2(rows**2))
    told = lengths > SHORTEST_ROW
    units = ca.if_else(told, lengths, 1)
    directions = rows * ca.repmat(told / units, 1, 3)
    distances = ca.if_else(told, limits / units, 0)
    size = ca.fmax(ca.norm_2(step), ca.fmax(0, ca.mmax(distances)))
    size = ca.if_else(size > 0, size, 1)
    arguments = [step / size, directions, distances / size]
    found = size * _projected_to_planes(matrix.shape[0])(*arguments)
    left = ca.mmin(directions @ step - distances)
    kept = ca.Function("kept", [step, rows, limits], [ca.if_else(left >= 0, step, found, True)])
    return kept(kappa * gradient, matrix, bounds) / kappa


def _projected_to_planes(count: int) -> ca.Function:
    """(e, a (m, 3), beta (m,)) -> the nearest vector to e with a e >= beta, rows of length one or zero, all of size 1.

    What OSQP says is looked at: v = e + a'mu, mu >= 0, a v >= beta, mu'(a v - beta) = 0.
    """
    e, a, beta = ca.MX.sym("e", 3), ca.MX.sym("a", count, 3), ca.MX.sym("beta", count)
    shape = {"h": ca.Sparsity.dense(3, 3), "a": ca.Sparsity.dense(count, 3)}
    found = ca.conic("projection", "osqp", shape, OSQP)(h=ca.MX.eye(3), g=-e, a=a, lba=beta)
    v, mu = found["x"], ca.fmax(0, -found["lam_a"])
    left = a @ v - beta
    residual = ca.fmax(ca.norm_inf(v - e - a.T @ mu), ca.fmax(ca.mmax(ca.fabs(mu * left)), -ca.mmin(left)))
    # also false where the residual is no number
    best = ca.if_else(residual <= OPTIMAL, v, _by_threes(count)(e, a, beta), True)
    return ca.Function("projected", [e, a, beta], [best])


def _by_threes(count: int) -> ca.Function:
    """The same by the active sets of every three rows.

    The multipliers of all active sets are feasible in the dual program, so the best of them is its solution where there
    is one. Where rows contradict one another it is what the enumeration of three takes: of active sets without
    contradiction the one that moves the vector the most.
    """
    e, three, best = ca.SX.sym("e", 3), ca.SX.sym("rows", 4 * MOST_ROWS), ca.SX.sym("best", 4)
    rows = ca.reshape(three, 4, MOST_ROWS).T
    a, beta = rows[:, :3], rows[:, 3]
    G, g = a @ a.T, beta - a @ e
    mu = box_problem(G, g, dependent=DEPENDENT)
    tried = ca.vertcat(ca.dot(mu, 0.5 * (G @ mu) - g), a.T @ mu)
    step = ca.Function("three", [best, e, three], [ca.if_else(tried[0] < best[0], tried, best)])
    whole = max(count, MOST_ROWS)  # rows of zero, where there are fewer than three, do nothing
    chosen = [k for rows in combinations(range(whole), MOST_ROWS) for k in rows]
    place, matrix, bounds = ca.MX.sym("e", 3), ca.MX.sym("a", count, 3), ca.MX.sym("beta", count)
    table = ca.horzcat(ca.horzcat(matrix, bounds).T, ca.MX.zeros(4, whole - count))
    sets = len(chosen) // MOST_ROWS
    threes = ca.reshape(table[:, chosen], 4 * MOST_ROWS, sets)
    last = step.mapaccum("threes", sets)(ca.MX.zeros(4), ca.repmat(place, 1, sets), threes)[:, -1]
    return ca.Function("by_threes", [place, matrix, bounds], [place + last[1:]])


def reduced(
    estimate: Expr,
    covariance: Expr,
    rows: Rows,
    *,
    kappa: float,
    penalty: float,
    largest_step: float,
    curvature: bool = False,
) -> Constrained:
    """The solution of (R), section 7: the estimate that the zones and the step bound leave.

    Args:
        estimate: SX, b* of the filter without zones, (3, 1) [W/rad].
        covariance: SX, P* = Lambda^-1, positive definite, (3, 3) [(W/rad)^2].
        rows: of at most three zones.
        kappa: [rad^2/W].
        penalty: s of each row.
        largest_step: d_max [rad].
        curvature: rows with the quadratic condition, A d - |d|^2 / 2 >= beta.

    Returns:
        As SX.
    """

    def solve(cost: _Weighted, rows: Rows, kappa: float) -> Constrained:
        return _bounded(cost, rows, kappa, penalty, largest_step / kappa)

    return _corrected(_weighted(estimate, covariance), rows, kappa, solve, curvature=curvature)


def _corrected(
    cost: _Weighted, rows: Rows, kappa: float, solve: Callable[..., Constrained], *, curvature: bool
) -> Constrained:
    """A program with linear rows, or with quadratic ones by sequential programming.

    At d_j the condition A d - |d|^2 / 2 >= beta is (A - d_j') d >= beta - |d_j|^2 / 2, and its multipliers add
    kappa^2 sum(mu) to the Hessian. What is left at the end is shortened until the condition holds exactly.
    """
    found = solve(cost, rows, kappa)
    if not curvature or not rows.matrix.shape[0]:
        return found
    for _ in range(CORRECTIONS):
        d, weight = kappa * found.gradient, kappa**2 * ca.sum1(found.multipliers)
        along = cost.vectors.T @ found.gradient
        bent = _Weighted(cost.values + weight, cost.vectors, cost.linear + weight * along)
        tangent = Rows(rows.matrix - ca.repmat(d.T, rows.matrix.shape[0], 1), rows.bounds - 0.5 * ca.sumsqr(d))
        found = solve(bent, tangent, kappa)
    d = kappa * found.gradient
    share = _feasible_share(rows, d)
    left = rows.bounds - share * (rows.matrix @ d) + 0.5 * share**2 * ca.sumsqr(d)
    return found._replace(gradient=share * found.gradient, slack=ca.fmax(0, left))


def _feasible_share(rows: Rows, d: Expr) -> Any:
    """The largest share of a step, at least 1 - SHORTER, that keeps the quadratic condition of zones that hold now."""
    share, square = ca.SX(1), ca.sumsqr(d)
    along = rows.matrix @ d
    for i in range(rows.matrix.shape[0]):
        beta, slope = rows.bounds[i], along[i]
        misses = ca.logic_and(beta <= 0, slope - 0.5 * square < beta)
        root = slope + ca.sqrt(ca.fmax(slope**2 - 2 * beta * square, 0))
        share = ca.if_else(misses, ca.fmin(share, _over(root, square)), share)
    return ca.if_else(share > 1 - SHORTER, share, 1)


def _unbounded(cost: _Weighted, rows: Rows, kappa: float) -> Constrained:
    """Hard rows, no step bound."""
    told = ca.sum2(ca.SX(rows.matrix) ** 2) > SHORTEST_ROW**2
    A, beta = kappa * ((ca.repmat(told, 1, 3) * rows.matrix) @ cost.vectors), ca.SX(rows.bounds)
    scaled = A @ ca.diag(1 / cost.values)
    mu = box_problem(scaled @ A.T, beta - scaled @ cost.linear, dependent=DEPENDENT)
    along = (cost.linear + A.T @ mu) / cost.values
    return Constrained(cost.vectors @ along, ca.SX(0), mu, ca.fmax(0, beta - A @ along))


def _weighted(estimate: Expr, covariance: Expr) -> _Weighted:
    eigen = symmetric_eigen(covariance)
    largest = ca.mmax(eigen.values)
    values = 1 / ca.fmax(eigen.values, ca.fmax(1e-15 * largest, TINY))
    return _Weighted(values, eigen.vectors, values * (eigen.vectors.T @ estimate))


def _bounded(cost: _Weighted, rows: Rows, kappa: float, penalty: float, radius: float) -> Constrained:
    """Bisection of ln(lambda) on |b(lambda)| = rho, which falls; lambda = 0 where the bound is not active."""
    A, beta, s = (
        kappa * (ca.SX(rows.matrix) @ cost.vectors),
        ca.SX(rows.bounds),
        ca.DM.ones(rows.matrix.shape[0], 1) * penalty,
    )

    def solution(bound: Expr) -> tuple[Any, Any]:
        inverse = 1 / (cost.values + bound)
        scaled = A @ ca.diag(inverse)
        mu = box_problem(scaled @ A.T, beta - scaled @ cost.linear, s) if A.shape[0] else ca.SX(0, 1)
        return inverse * (cost.linear + A.T @ mu), mu

    free, free_mu = solution(ca.SX(0))
    most = ca.sqrt(ca.sumsqr(cost.linear)) + (ca.sqrt(ca.sumsqr(ca.fabs(A).T @ s)) if A.shape[0] else 0)
    low = LEAST * ca.mmin(cost.values)
    high = ca.fmax(most / radius, low)
    for _ in range(HALVINGS):
        middle = ca.sqrt(low) * ca.sqrt(high)
        b, _ = solution(middle)
        outside = ca.sumsqr(b) > radius**2
        low, high = ca.if_else(outside, middle, low), ca.if_else(outside, high, middle)
    bound, bound_mu = solution(high)
    active = ca.sumsqr(free) > radius**2
    along, mu = ca.if_else(active, bound, free), ca.if_else(active, bound_mu, free_mu)
    length = ca.sqrt(ca.sumsqr(along))
    along = along * ca.if_else(length > radius, radius / length, 1)  # rounding
    return Constrained(cost.vectors @ along, where(active, high), mu, ca.fmax(0, beta - A @ along))
