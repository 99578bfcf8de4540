"""Hand-written multiple shooting with the half-vector of the covariance as states: the strong peer of the stated form.

Good practice in plain CasADi: one SX Runge-Kutta step of (x, half-vector of E), mapped over the intervals; one shooting
gap an interval; exact Hessian; the guess is a simulation along the minimum-energy control. No bounds on the variances:
they guard against indefinite iterates, which do not occur from this guess, and their barrier triples the iterations.
"""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np
from peers_systems import Array, System, at_nodes, minimum_energy


def packing(n: int) -> tuple[list[int], list[int]]:
    """Rows and columns of the half-vector (column by column, row >= column)."""
    pairs = [(i, j) for j in range(n) for i in range(j, n)]
    return [i for i, _ in pairs], [j for _, j in pairs]


def packed_step(system: System, h: float) -> ca.Function:
    """One classical Runge-Kutta step of z = (x, half-vector of E), (z, control at start, control at end) -> z+."""
    n, nx = system.n, system.nx
    half = ca.SX.sym("E", n * (n + 1) // 2)
    E = ca.tril2symm(ca.SX(ca.Sparsity.lower(n), half))
    FE = system.F @ E
    measured = [int(i) for i in np.flatnonzero(np.diag(system.W))]
    EM = E[:, measured]
    E_rate = FE + FE.T + ca.DM(system.Q) - EM @ ca.DM(system.W[np.ix_(measured, measured)]) @ EM.T
    packed_rate = ca.vertcat(*[E_rate[i, j] for i, j in zip(*packing(n), strict=True)])
    f = ca.Function("f", [ca.vertcat(system.x, half), system.u], [ca.vertcat(system.rate, packed_rate)])
    z, u0, u1 = ca.SX.sym("z", nx + half.numel()), ca.SX.sym("u0"), ca.SX.sym("u1")
    um = (u0 + u1) / 2
    k1 = f(z, u0)
    k2 = f(z + h / 2 * k1, um)
    k3 = f(z + h / 2 * k2, um)
    k4 = f(z + h * k3, u1)
    return ca.Function("step", [z, u0, u1], [z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])


def initial(system: System) -> Array:
    """Initial value of (x, half-vector of E)."""
    return np.concatenate([np.zeros(system.nx), system.E0[packing(system.n)]])


def solve(system: System, intervals: int = 50, control: str = "linear", max_iter: int = 3000) -> dict[str, Any]:
    """Build and solve; cost, iterations and seconds of building and solving."""
    start = time.perf_counter()
    h, z0 = system.duration / intervals, initial(system)
    step = packed_step(system, h)
    U = ca.MX.sym("U", 1, intervals + (control == "linear"))
    Z = ca.MX.sym("Z", z0.size, intervals)  # the values at the first node are given
    u0, u1 = (U[:, :-1], U[:, 1:]) if control == "linear" else (U, U)
    gaps = step.map(intervals)(ca.horzcat(z0, Z[:, :-1]), u0, u1) - Z
    rows, columns = packing(system.n)
    weights = np.array([(1 if i == j else 2) * system.C[i, j] for i, j in zip(rows, columns, strict=True)])
    last = Z[:, -1]
    cost = h / 6 * ca.sum2(u0**2 + u0 * u1 + u1**2) + ca.dot(weights, last[system.nx :])
    constraints = ca.vertcat(ca.vec(gaps), system.terminal_states(last) - ca.DM(system.targets()))
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": max_iter,
    }
    nlp: dict[str, Any] = {"x": ca.vertcat(U.T, ca.vec(Z)), "f": cost, "g": constraints}
    solver = ca.nlpsol("solver", "ipopt", nlp, options)
    guess = minimum_energy(system, intervals)
    nodes = at_nodes(guess) if control == "linear" else guess
    ends = (nodes[:-1], nodes[1:]) if control == "linear" else (nodes, nodes)
    simulated = np.asarray(step.mapaccum(intervals)(z0, *[u[None, :] for u in ends]))
    x0 = np.concatenate([nodes, simulated.ravel(order="F")])
    built = time.perf_counter()
    result = solver(x0=x0, lbg=0, ubg=0)
    stats = solver.stats()
    return {
        "cost": float(result["f"]),
        "iterations": stats["iter_count"],
        "status": stats["return_status"],
        "build": built - start,
        "solve": time.perf_counter() - built,
    }
