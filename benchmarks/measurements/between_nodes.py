"""Between the nodes: `Solution.at` against scipy along the same controls, and a limit that a stiff state meets there.

Twelve problems with default steps, five of them stiff or with covariances that fall within a small share of an
interval. Each is integrated by scipy (Radau, one interval at a time, so that no kink of the control lies inside a
step); the errors are relative to the range of each entry of the states and the covariances. Between the nodes a
solution is as accurate as at them, and default steps are as short as that asks for: all errors should be below 1e-4.
"Told" is whether a warning came; the mesh error is that of the cost.

    python benchmarks/measurements/between_nodes.py [motor]

With "motor" the current limit of a motor with unknown constants is followed along the differential equation as well
(some minutes).
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import covocp as co
from covocp.models import bryson_denham, mass_chain

POINTS = 40
Case = tuple[co.Problem, dict[str, Any], dict[str, Any]]


def wave(amplitude: float, cycles: float, offset: float = 0.0) -> Callable[[Any], Any]:
    return lambda s: offset + amplitude * np.sin(2 * np.pi * cycles * s)


def lag(noise: float) -> co.Problem:
    ocp = co.Problem(duration=10.0, name=f"lag, measurement noise {noise:g}")
    x, b = ocp.state("x", initial=0.0, variance=1.0), ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=noise)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[b, b])
    return ocp


def circuit() -> co.Problem:
    ocp = co.Problem(duration=0.5, name="RL circuit, time constant 1/20 interval")
    i, u = ocp.state("i", initial=0.0), ocp.control("u", lower=-12, upper=12)
    ocp.dynamics(i, (u - 1.2 * i) / 0.6e-3)
    ocp.minimize(running=u**2)
    return ocp


def motor(limit: float = np.inf) -> co.Problem:
    L, K, R0, J0, b0 = 0.6e-3, 0.025, 1.2, 1.4e-5, 2.0e-5
    ocp = co.Problem(duration=0.5, name="motor with three unknown constants")
    i, w = ocp.state("i", initial=0.0, lower=-limit, upper=limit), ocp.state("w", initial=0.0)
    R = ocp.unknown("R", mean=R0, variance=(0.3 * R0) ** 2)
    J = ocp.unknown("J", mean=J0, variance=(0.3 * J0) ** 2)
    b = ocp.unknown("b", mean=b0, variance=(0.5 * b0) ** 2)
    u = ocp.control("u", lower=-12, upper=12)
    ocp.dynamics(i, (u - R * i - K * w) / L, noise=1e-2)
    ocp.dynamics(w, (K * i - b * w) / J, noise=1.0)
    ocp.measurement("current", i, noise=0.05**2 * 1e-3)
    ocp.measurement("speed", w, noise=2.0**2 * 1e-3)
    ocp.subject_to(w, lower=-200, upper=200, name="speed limit")
    E = ocp.estimation_covariance()
    constants = ca.vertcat(R, J, b)
    scale = ca.diag(ca.DM([1 / R0, 1 / J0, 1 / b0]))
    ocp.minimize(running=1e-6 * u**2, terminal=ca.log(ca.det(scale @ E[constants, constants] @ scale)))
    return ocp


def van_der_pol() -> co.Problem:
    ocp = co.Problem(duration=12.0, name="van der Pol, mu = 30")
    x, u = ocp.state("x", 2, initial=[2.0, 0.0]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], 30 * (1 - x[0] ** 2) * x[1] - x[0] + u))
    ocp.minimize(running=u**2)
    return ocp


def pendulum() -> co.Problem:
    ocp = co.Problem(duration=6.0, name="pendulum, unknown length")
    x, u = ocp.state("x", 2, initial=[0.5, 0.0], variance=[0.1, 0.1]), ocp.control("u")
    k = ocp.unknown("k", mean=4.0, variance=1.0)
    ocp.dynamics(x, ca.vertcat(x[1], -k * ca.sin(x[0]) - 0.1 * x[1] + u), noise=ca.diag(ca.DM([0.0, 0.01])))
    ocp.measurement("angle", x[0], noise=1e-3)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[k, k])
    return ocp


def phases() -> co.Problem:
    ocp = co.Problem(duration=10.0, name="a rate that jumps at a node")
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, ca.if_else(ocp.time < 5.0, 1.0, -2.0) - 0.3 * x + u)
    ocp.minimize(running=u**2)
    return ocp


def lyapunov() -> co.Problem:
    ocp = co.Problem(duration=5.0, name="matrix state of any rate")
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    P = ocp.symmetric("P", 2, initial=np.eye(2))
    A = ca.vertcat(ca.horzcat(0.0, 1.0), ca.horzcat(-3.0 - x, -0.4))
    ocp.dynamics(x, u)
    ocp.dynamics(P, A @ P + P @ A.T - 0.1 * P @ P @ P)
    ocp.minimize(running=u**2, terminal=P[0, 0])
    return ocp


def loop() -> co.Problem:
    ocp = co.Problem(duration=4.0, name="closed loop, heavy terminal weight")
    x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
    b = ocp.unknown("b", mean=1.0, variance=0.5)
    ocp.dynamics(x, -b * x + u, noise=0.1)
    ocp.measurement("position", x, noise=1e-2)
    ocp.estimation_covariance()
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 100.0})
    return ocp


def cases() -> list[Case]:
    """With default steps."""
    u = {"u": wave(1.0, 2.0)}
    steps = {"u": lambda s: 12 * np.sign(np.sin(8 * np.pi * s) + 1e-9)}
    return [
        (lag(1.0), u, {"intervals": 100}),
        (lag(1e-4), u, {"intervals": 100}),
        (lag(1.0), u, {"intervals": 40, "control": "constant"}),
        (circuit(), steps, {"intervals": 50}),
        (motor(), steps, {"intervals": 50}),
        (van_der_pol(), {"u": wave(2.0, 3.0)}, {"intervals": 400}),
        (pendulum(), u, {"intervals": 60}),
        (phases(), u, {"intervals": 20}),
        (lyapunov(), u, {"intervals": 60}),
        (loop(), u, {"intervals": 100}),
        (mass_chain.problem(), {"u": wave(1.0, 1.0)}, {"intervals": 50}),
        (bryson_denham.problem(), {"u": wave(5.0, 1.0)}, {"intervals": 20}),
    ]


def truth(solution: co.Solution, shares: Any) -> Any:
    """x and e by scipy at the shares of each interval, (N, points, entries)."""
    st, t, T, p = solution.statement, solution.t, solution.duration, solution.parameters
    nx, u, held = st.nx, solution.controls, solution.mesh.control == "constant"
    behind = st.entries(st.behind)
    ahead = [k for k in range(st.ne) if k not in behind]
    result = np.zeros((t.size - 1, shares.size, nx + st.ne))

    def rates(time: float, k: int, x: Any, e: Any) -> tuple[Any, Any]:
        c = (time - t[k]) / (t[k + 1] - t[k])
        inside = t[k] + min(max(c, 1e-9), 1 - 1e-9) * (t[k + 1] - t[k])
        control = u[k] if held else u[k] + c * (u[k + 1] - u[k])
        values = st.rates(x, control, e, inside, T, p)
        return np.asarray(values[0].full()).ravel(), np.asarray(values[1].full()).ravel()

    size = np.abs(np.hstack([solution.trajectory.x, solution.trajectory.e])).max(axis=0) + 1e-30
    paths = []
    z = np.concatenate([solution.trajectory.x[0], solution.trajectory.e[0, ahead]])
    for k in range(t.size - 1):

        def forward(time: float, z: Any, k: int = k) -> Any:
            e = np.zeros(st.ne)
            e[ahead] = z[nx:]
            f, v = rates(time, k, z[:nx], e)
            return np.concatenate([f, v[ahead]])

        span = (t[k], t[k + 1])
        atol = 1e-10 * np.concatenate([size[:nx], size[nx:][ahead]])
        found = solve_ivp(forward, span, z, method="Radau", rtol=1e-9, atol=atol, dense_output=True)
        paths.append(found.sol)
        z = found.y[:, -1]
        at = found.sol(t[k] + shares * (t[k + 1] - t[k])).T
        result[k][:, :nx], result[k][:, [nx + j for j in ahead]] = at[:, :nx], at[:, nx:]
    e = solution.trajectory.e[-1, behind]
    for k in range(t.size - 2, -1, -1) if behind else ():

        def backward(time: float, S: Any, k: int = k) -> Any:
            full = np.zeros(st.ne)
            full[behind] = S
            return rates(time, k, paths[k](time)[:nx], full)[1][behind]

        atol = 1e-10 * size[nx:][behind]
        found = solve_ivp(backward, (t[k + 1], t[k]), e, method="Radau", rtol=1e-9, atol=atol, dense_output=True)
        e = found.y[:, -1]
        result[k][:, [nx + j for j in behind]] = found.sol(t[k] + shares * (t[k + 1] - t[k])).T
    return result


def errors(solution: co.Solution) -> tuple[float, float, float, float]:
    """Largest errors relative to the ranges: of states and of matrices at the nodes, and anywhere."""
    shares = np.unique(np.concatenate([np.geomspace(1e-6, 1.0, POINTS), 1 - np.geomspace(1e-6, 1.0, POINTS)]))
    true = truth(solution, shares)
    nodes = solution.mesh.nodes
    s = nodes[:-1, None] + shares * np.diff(nodes)[:, None]
    difference = np.abs(solution.dense.at(np.clip(s, 0, 1).ravel()).reshape(true.shape) - true)
    span = np.ptp(true.reshape(-1, true.shape[2]), axis=0)
    share = difference / np.where(span > 0, span, 1.0)
    nx = solution.statement.nx
    at_nodes = share[:, [0, -1]]
    parts = (at_nodes[..., :nx], at_nodes[..., nx:], share[..., :nx], share[..., nx:])
    return tuple(float(v.max(initial=0.0)) for v in parts)  # type: ignore[return-value]


def main() -> None:
    print("Largest errors relative to the range of each entry; at the nodes and anywhere.")
    table(cases())
    if "motor" in sys.argv:
        guess = {"u": lambda s: 12 * np.sign(np.sin(8 * np.pi * s) + 1e-9)}
        solution = co.solve(motor(6.0), intervals=50, guess=guess, progress=False)
        true = truth(solution, np.linspace(0, 1, 101))[..., 0]
        print(f"\nmotor, |i| <= 6: {np.abs(true).max():.4f} along the differential equation, {solution.check_path()}")


def table(chosen: list[Case]) -> None:
    columns = "intervals | x at nodes | anywhere | matrices at nodes | anywhere | mesh error | told | knots | ms"
    print(f"| problem | {columns} |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for problem, nominal, options in chosen:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            solution = co.evaluate(problem, nominal=nominal, **options)
        begin = time.perf_counter()
        knots = solution.dense.knots.size
        spent = 1e3 * (time.perf_counter() - begin)
        x0, e0, x, e = errors(solution)
        steps = f"{solution.mesh.intervals} x {solution.mesh.substeps} {solution.mesh.step}"
        numbers = f"{x0:.1e} | {x:.1e} | {e0:.1e} | {e:.1e} | {solution.mesh_error:.1e}"
        print(
            f"| {problem.name} | {steps} | {numbers} | {'yes' if told else 'no'} | {knots} | {spent:.0f} |", flush=True
        )


if __name__ == "__main__":
    main()
