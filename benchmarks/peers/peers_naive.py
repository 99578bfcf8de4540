"""What a first script looks like: casadi.Opti, the full covariance a matrix variable at each node, steps in a loop."""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np
from peers_systems import System, at_nodes, minimum_energy


def solve(system: System, intervals: int = 100) -> dict[str, Any]:
    """Build and solve with piecewise-linear control; cost, iterations and seconds of building and solving."""
    start = time.perf_counter()
    h, n = system.duration / intervals, system.n
    rate_and_jacobian = ca.Function("f", [system.x, system.u], [system.rate, system.F])

    def rates(x: ca.MX, E: ca.MX, u: ca.MX) -> tuple[ca.MX, ca.MX]:
        rate, F = rate_and_jacobian(x, u)
        return rate, F @ E + E @ F.T + system.Q - E @ system.W @ E

    opti = ca.Opti()
    x = [opti.variable(system.nx) for _ in range(intervals + 1)]
    E = [opti.variable(n, n) for _ in range(intervals + 1)]
    u = opti.variable(1, intervals + 1)
    opti.subject_to(x[0] == 0)
    opti.subject_to(ca.vec(E[0]) == ca.vec(ca.DM(system.E0)))
    energy = ca.MX(0)
    for k in range(intervals):
        middle = (u[k] + u[k + 1]) / 2
        x1, E1 = rates(x[k], E[k], u[k])
        x2, E2 = rates(x[k] + h / 2 * x1, E[k] + h / 2 * E1, middle)
        x3, E3 = rates(x[k] + h / 2 * x2, E[k] + h / 2 * E2, middle)
        x4, E4 = rates(x[k] + h * x3, E[k] + h * E3, u[k + 1])
        opti.subject_to(x[k + 1] == x[k] + h / 6 * (x1 + 2 * x2 + 2 * x3 + x4))
        opti.subject_to(ca.vec(E[k + 1]) == ca.vec(E[k] + h / 6 * (E1 + 2 * E2 + 2 * E3 + E4)))
        energy += h / 6 * (u[k] ** 2 + u[k] * u[k + 1] + u[k + 1] ** 2)
    opti.subject_to(system.terminal_states(x[-1]) == ca.DM(system.targets()))
    opti.minimize(energy + ca.trace(system.C @ E[-1]))
    opti.set_initial(u, at_nodes(minimum_energy(system, intervals))[None, :])
    for k in range(intervals + 1):
        opti.set_initial(E[k], system.E0)
        for i, value in system.final.items():
            opti.set_initial(x[k][i], value * k / intervals)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    built = time.perf_counter()
    solution = opti.solve()
    stats = solution.stats()
    return {
        "cost": float(np.asarray(solution.value(opti.f)).item()),
        "iterations": stats["iter_count"],
        "status": stats["return_status"],
        "build": built - start,
        "solve": time.perf_counter() - built,
    }
