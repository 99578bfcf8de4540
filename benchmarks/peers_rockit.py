"""The same problem in rockit: full covariance as a matrix state, multiple shooting, one Runge-Kutta step an interval.

rockit's usual form, with a control that is constant over each interval (fewer unknowns than a piecewise-linear one).
"""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np
import rockit
from peers_systems import System, minimum_energy


def solve(system: System, intervals: int = 50) -> dict[str, Any]:
    """Build and solve; cost, iterations and seconds of building and solving."""
    start = time.perf_counter()
    rate_and_jacobian = ca.Function("f", [system.x, system.u], [system.rate, system.F])
    ocp = rockit.Ocp(T=system.duration)
    x, E, u = ocp.state(system.nx), ocp.state(system.n, system.n), ocp.control()
    rate, F = rate_and_jacobian(x, u)
    ocp.set_der(x, rate)
    ocp.set_der(E, F @ E + E @ F.T + system.Q - E @ system.W @ E)
    ocp.subject_to(ocp.at_t0(x) == 0)
    ocp.subject_to(ocp.at_t0(E) == system.E0)
    ocp.subject_to(system.terminal_states(ocp.at_tf(x)) == ca.DM(system.targets()))
    ocp.add_objective(ocp.integral(u**2 / 2) + ca.trace(system.C @ ocp.at_tf(E)))
    ocp.solver("ipopt", {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"})
    ocp.method(rockit.MultipleShooting(N=intervals, M=1, intg="rk"))
    ocp.set_initial(u, minimum_energy(system, intervals)[None, :])
    ocp.set_initial(E, system.E0)
    ramp = np.zeros((system.nx, intervals + 1))
    for i, value in system.final.items():
        ramp[i] = np.linspace(0, value, intervals + 1)
    ocp.set_initial(x, ramp)
    stated = time.perf_counter()
    solution = ocp.solve()  # transcribes, then solves
    seconds = time.perf_counter()
    return {
        "cost": float(np.asarray(solution.value(ocp.objective)).item()),
        "iterations": solution.stats["iter_count"],
        "status": solution.stats["return_status"],
        "build": stated - start,
        "solve": seconds - stated,
    }
