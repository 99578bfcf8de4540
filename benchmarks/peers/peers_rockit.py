"""The chain of masses in rockit: full covariance as a state, multiple shooting, one Runge-Kutta step an interval.

The model is written as rockit's documentation writes models, as expressions of its own symbols, with a control that is
constant over each interval (fewer unknowns than a piecewise-linear one). `wrapped` puts the rates and the Jacobian into
one expanded CasADi function first, which an expert would do.
"""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np
import rockit
from peers_systems import System, minimum_energy


def _written_out(system: System, y: ca.MX, v: ca.MX, u: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Rate of (y, v) and augmented Jacobian as expressions of rockit's symbols."""
    m = system.nx // 2
    unknown = ca.MX.sym("p", 2)
    k, d = unknown[0], unknown[1]
    forces = []
    for i in range(m):
        stretch = y[i] - (y[i - 1] if i else 0)
        stretch_rate = v[i] - (v[i - 1] if i else 0)
        forces.append(k * stretch + 0.5 * stretch**3 + d * stretch_rate)
    pushes = [(forces[i + 1] if i + 1 < m else 0) - forces[i] + (u if i == 0 else 0) for i in range(m)]
    rate = ca.vertcat(v, *pushes)
    rows = ca.horzcat(*[ca.jacobian(rate, symbol) for symbol in (y, v, unknown)])
    jacobian = ca.vertcat(rows, ca.MX(2, system.n))
    at_means: list[ca.MX] = ca.substitute([rate, jacobian], [unknown], [ca.MX(ca.DM([2.0, 0.3]))])
    return at_means[0], at_means[1]


def solve(system: System, intervals: int = 50, wrapped: bool = False) -> dict[str, Any]:
    """Build and solve; cost, iterations and seconds of building and solving."""
    start = time.perf_counter()
    m = system.nx // 2
    ocp = rockit.Ocp(T=system.duration)
    y, v, E, u = ocp.state(m), ocp.state(m), ocp.state(system.n, system.n), ocp.control()
    x = ca.vertcat(y, v)
    if wrapped:
        rate, F = ca.Function("f", [system.x, system.u], [system.rate, system.F])(x, u)
    else:
        rate, F = _written_out(system, y, v, u)
    ocp.set_der(y, rate[:m])
    ocp.set_der(v, rate[m:])
    ocp.set_der(E, F @ E + E @ F.T + system.Q - E @ system.W @ E)
    ocp.subject_to(ocp.at_t0(x) == 0)
    ocp.subject_to(ocp.at_t0(E) == system.E0)
    ocp.subject_to(system.terminal_states(ocp.at_tf(x)) == ca.DM(system.targets()))
    ocp.add_objective(ocp.integral(u**2 / 2) + ca.trace(system.C @ ocp.at_tf(E)))
    ocp.solver("ipopt", {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"})
    ocp.method(rockit.MultipleShooting(N=intervals, M=1, intg="rk"))
    ocp.set_initial(u, minimum_energy(system, intervals)[None, :])
    ocp.set_initial(E, system.E0)
    ramp = np.zeros((m, intervals + 1))
    ramp[m - 1] = np.linspace(0, system.final[m - 1], intervals + 1)
    ocp.set_initial(y, ramp)
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
