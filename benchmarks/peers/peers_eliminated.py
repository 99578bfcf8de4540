"""Reference script: the covariance eliminated from the nonlinear program, in plain CasADi (about a hundred lines).

The variables are the controls and the nominal state at the start of each segment. The covariance is propagated along
the nominal by the two-stage Gauss method in its positive semidefinite form (Dieci and Eirola, Numer. Math. 67, 1994):
with E = Y X^-1,

    d/dt [X; Y] = [-F', W; Q, F] [X; Y],    E+ = (Y21 + Y22 E) (X11 + X12 E)^-1,

where the step matrix [X11, X12; Y21, Y22] depends on the nominal alone: it is computed for all intervals by one map.
"""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np
from peers_systems import System, at_nodes, minimum_energy

IPOPT: dict[str, Any] = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
LIMITED_MEMORY: dict[str, Any] = {
    "ipopt.hessian_approximation": "limited-memory",
    "ipopt.limited_memory_max_history": 20,
}


def nominal_step(system: System, h: float) -> ca.Function:
    """One classical Runge-Kutta step of the nominal, (x, control at start, control at end) -> x+; control linear."""
    f = ca.Function("f", [system.x, system.u], [system.rate])
    x, u0, u1 = ca.SX.sym("x", system.nx), ca.SX.sym("u0"), ca.SX.sym("u1")
    um = (u0 + u1) / 2
    k1 = f(x, u0)
    k2 = f(x + h / 2 * k1, um)
    k3 = f(x + h / 2 * k2, um)
    k4 = f(x + h * k3, u1)
    return ca.Function("step", [x, u0, u1], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])


def gauss_points(system: System, h: float) -> ca.Function:
    """Matrix [-F', W; Q, F] at the two Gauss points, (x, x+, control at start, control at end) -> A1, A2."""
    f = ca.Function("f", [system.x, system.u], [system.rate])
    hamiltonian = ca.blockcat([[-system.F.T, ca.SX(ca.DM(system.W))], [ca.SX(ca.DM(system.Q)), system.F]])
    A = ca.Function("A", [system.x, system.u], [ca.densify(hamiltonian)])
    x0, x1 = ca.SX.sym("x0", system.nx), ca.SX.sym("x1", system.nx)
    u0, u1 = ca.SX.sym("u0"), ca.SX.sym("u1")
    r0, r1 = f(x0, u0), f(x1, u1)
    values = []
    for s in (0.5 - np.sqrt(3) / 6, 0.5 + np.sqrt(3) / 6):  # cubic Hermite interpolation of the nominal
        x = (
            (1 + 2 * s) * (1 - s) ** 2 * x0
            + s * (1 - s) ** 2 * h * r0
            + s**2 * (3 - 2 * s) * x1
            - s**2 * (1 - s) * h * r1
        )
        values.append(A(x, (1 - s) * u0 + s * u1))
    return ca.Function("gauss_points", [x0, x1, u0, u1], values)


def step_matrix(system: System, h: float) -> ca.Function:
    """Step matrix of the Gauss method, (x, x+, control at start, control at end) -> (2n, 2n)."""
    x0, x1, u0, u1 = ca.MX.sym("x0", system.nx), ca.MX.sym("x1", system.nx), ca.MX.sym("u0"), ca.MX.sym("u1")
    A1, A2 = gauss_points(system, h)(x0, x1, u0, u1)
    size = 2 * system.n
    a12, a21 = 0.25 - np.sqrt(3) / 6, 0.25 + np.sqrt(3) / 6
    identity = ca.MX.eye(size)
    left = ca.blockcat([[identity - h / 4 * A1, -h * a12 * A1], [-h * a21 * A2, identity - h / 4 * A2]])
    stages = ca.solve(left, ca.vertcat(A1, A2), "lapacklu")
    return ca.Function("step_matrix", [x0, x1, u0, u1], [identity + h / 2 * (stages[:size, :] + stages[size:, :])])


def covariance_step(n: int) -> ca.Function:
    """E+ from E and the step matrix."""
    E, step = ca.MX.sym("E", n, n), ca.MX.sym("step", 2 * n, 2 * n)
    X = step[:n, :n] + step[:n, n:] @ E
    Y = step[n:, :n] + step[n:, n:] @ E
    return ca.Function("covariance_step", [E, step], [ca.solve(X.T, Y.T, "lapacklu")])


def solve(system: System, intervals: int = 50, segments: int = 10, control: str = "linear") -> dict[str, Any]:
    """Build and solve; cost, iterations and seconds of building and solving."""
    start = time.perf_counter()
    h, nx, per_segment = system.duration / intervals, system.nx, intervals // segments
    U = ca.MX.sym("U", 1, intervals + (control == "linear"))
    u0, u1 = (U[:, :-1], U[:, 1:]) if control == "linear" else (U, U)
    step = nominal_step(system, h)
    S = ca.MX.sym("S", nx, segments - 1)  # the state at the start of the first segment is given
    starts = ca.horzcat(ca.DM.zeros(nx, 1), S)
    ends = []
    segment = step.mapaccum("segment", per_segment)
    inputs = [ca.horzsplit(u, per_segment) for u in (u0, u1)]
    for k in range(segments):
        ends.append(segment(starts[:, k], inputs[0][k], inputs[1][k]))
    after = ca.horzcat(*ends)
    before = ca.horzcat(*[ca.horzcat(starts[:, k], ends[k][:, :-1]) for k in range(segments)])
    matrices = step_matrix(system, h).map(intervals)(before, after, u0, u1)
    E = covariance_step(system.n).mapaccum("covariances", intervals)(system.E0, matrices)[:, -system.n :]
    energy = h / 6 * ca.sum2(u0**2 + u0 * u1 + u1**2)
    cost = energy + ca.trace(ca.DM(system.C) @ E)
    gaps = ca.horzcat(*[end[:, -1] for end in ends[:-1]]) - S if segments > 1 else ca.MX(nx, 0)
    constraints = ca.vertcat(ca.vec(gaps), system.terminal_states(after[:, -1]) - ca.DM(system.targets()))
    nlp: dict[str, Any] = {"x": ca.vertcat(U.T, ca.vec(S)), "f": cost, "g": constraints}
    solver = ca.nlpsol("solver", "ipopt", nlp, {**IPOPT, **LIMITED_MEMORY})
    guess = minimum_energy(system, intervals)
    nodes = at_nodes(guess) if control == "linear" else guess
    ends_of = (nodes[:-1], nodes[1:]) if control == "linear" else (nodes, nodes)
    states = np.asarray(step.mapaccum(intervals)(np.zeros(nx), *[u[None, :] for u in ends_of]))
    x0 = np.concatenate([nodes, states[:, per_segment - 1 : -1 : per_segment].ravel(order="F")])
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
