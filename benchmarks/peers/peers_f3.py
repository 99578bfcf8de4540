"""Reference script: expected cost with E and S as states of the nonlinear program (F3), in plain CasADi.

As an expert writes it: z = (x, half-vector of E, half-vector of S), two classical Runge-Kutta steps an interval as one
expanded SX function that is mapped over the intervals, a node of multiple shooting at every interval, piecewise-linear
control, exact Hessian. E starts at E(0), S ends at S(T); the guess is propagated along a given control.
"""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from peers_loops import Array, Loop
from peers_packed import packing

SUBSTEPS = 2


def unpack(half: ca.SX, n: int) -> ca.SX:
    """Symmetric matrix of a half-vector."""
    return ca.tril2symm(ca.SX(ca.Sparsity.lower(n), half))


def rates(loop: Loop) -> ca.Function:
    """(z, u) -> dz/dt and the integrand of the cost."""
    n = loop.n
    rows, columns = packing(n)
    E_unit, S_unit = np.outer(loop.d, loop.d), np.outer(loop.s, loop.s)
    half_E, half_S = ca.SX.sym("E", len(rows)), ca.SX.sym("S", len(rows))
    E, S = unpack(half_E, n) * E_unit, unpack(half_S, n) * S_unit
    GS = loop.G.T @ S
    FE, FS = loop.F @ E, loop.F.T @ S
    fed = GS.T @ GS / loop.B  # C' B C
    E_rate = (FE + FE.T + loop.Q - E @ loop.W @ E) / E_unit
    S_rate = (fed - FS - FS.T) / S_unit
    packed = [ca.vertcat(*[matrix[i, j] for i, j in zip(rows, columns, strict=True)]) for matrix in (E_rate, S_rate)]
    integrand = loop.running + (ca.trace(S @ loop.Q) + ca.trace(fed @ E)) / 2
    z = ca.vertcat(loop.x, half_E, half_S)
    return ca.Function("rates", [z, loop.u], [ca.vertcat(loop.rate, *packed), integrand])


def interval(loop: Loop, h: float) -> ca.Function:
    """(z, control at start, control at end) -> z at the end and the cost of the interval; h may be negative."""
    f = rates(loop)
    z, u0, u1 = ca.SX.sym("z", f.size1_in(0)), ca.SX.sym("u0"), ca.SX.sym("u1")
    value, cost, step = z, ca.SX(0), h / SUBSTEPS
    for j in range(SUBSTEPS):
        ua, um, ub = (u0 + (j + c) / SUBSTEPS * (u1 - u0) for c in (0.0, 0.5, 1.0))
        k1, c1 = f(value, ua)
        k2, c2 = f(value + step / 2 * k1, um)
        k3, c3 = f(value + step / 2 * k2, um)
        k4, c4 = f(value + step * k3, ub)
        value = value + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        cost = cost + step / 6 * (c1 + 2 * c2 + 2 * c3 + c4)
    return ca.Function("interval", [z, u0, u1], [value, cost])


def propagated(loop: Loop, h: float, u: Array, E0: Array, end: Array) -> Array:
    """Values of z at the nodes along a control: x and E forward, S backward along them; (nz, intervals + 1)."""
    forward, backward = interval(loop, h), interval(loop, -h)
    nx, half = loop.nx, E0.size
    nodes = [np.concatenate([loop.start, E0, np.zeros(half)])]
    for ua, ub in pairwise(u):
        nodes.append(np.asarray(forward(nodes[-1], ua, ub)[0]).ravel())
        nodes[-1][nx + half :] = 0.0
    nodes[-1][nx + half :] = end
    for k in range(u.size - 1, 0, -1):
        nodes[k - 1][nx + half :] = np.asarray(backward(nodes[k], u[k], u[k - 1])[0]).ravel()[nx + half :]
    return np.array(nodes).T


def solve(loop: Loop, intervals: int) -> dict[str, Any]:
    """Build and solve; cost, iterations and seconds of building and solving."""
    start = time.perf_counter()
    h, nx = loop.duration / intervals, loop.nx
    picked = packing(loop.n)
    E0, end = (loop.E0 / np.outer(loop.d, loop.d))[picked], (loop.end / np.outer(loop.s, loop.s))[picked]
    step = interval(loop, h)
    nz, half = step.size1_in(0), E0.size
    U, Z = ca.MX.sym("U", 1, intervals + 1), ca.MX.sym("Z", nz, intervals + 1)
    after, costs = step.map(intervals)(Z[:, :-1], U[:, :-1], U[:, 1:])
    weights = np.array([(1.0 if i == j else 2.0) for i, j in zip(*picked, strict=True)])
    at_start = weights * (loop.E0 * np.outer(loop.s, loop.s))[picked]  # tr S(0) E(0) over the half-vector of S
    cost = ca.sum2(costs) + ca.dot(at_start, Z[nx + half :, 0]) / 2
    nlp = {"x": ca.vertcat(U.T, ca.vec(Z)), "f": cost, "g": ca.vec(after - Z[:, 1:])}
    options: dict[str, Any] = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    solver = ca.nlpsol("solver", "ipopt", nlp, options)
    u = loop.guess(np.linspace(0.0, loop.duration, intervals + 1))
    guess = propagated(loop, h, u, E0, end)
    lower, upper = np.full((nz, intervals + 1), -np.inf), np.full((nz, intervals + 1), np.inf)
    for bound in (lower, upper):
        bound[: nx + half, 0] = np.concatenate([loop.start, E0])
        bound[nx + half :, -1] = end
        for i, value in loop.final.items():
            bound[i, -1] = value
    low, high = (np.full(intervals + 1, bound) for bound in loop.bounds)
    built = time.perf_counter()
    result = solver(
        x0=np.concatenate([u, guess.ravel(order="F")]),
        lbx=np.concatenate([low, lower.ravel(order="F")]),
        ubx=np.concatenate([high, upper.ravel(order="F")]),
        lbg=0,
        ubg=0,
    )
    stats = solver.stats()
    return {
        "cost": float(result["f"]) * loop.cost,
        "iterations": stats["iter_count"],
        "status": stats["return_status"],
        "build": built - start,
        "solve": time.perf_counter() - built,
    }
