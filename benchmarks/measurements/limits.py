"""How far solves are from what the machine can do, how they grow, and how many there are a second from a plan.

    python benchmarks/measurements/limits.py [rounds]

Processor time, medians. The limit of a solve is one passage of its covariance forward and one of its slopes back in
compiled code, times the evaluations of its run. Solves from the plan are unassessed; by hand: the same problem as a
multiple-shooting program of CasADi with exact derivatives, called again from its solution, by Ipopt and by fatrop.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from passage import median_of

import covocp as co
from covocp.base.buffered import Buffered
from covocp.base.matrices import half_length
from covocp.models import mass_chain, unknown_lag
from covocp.passage.sweep import entries_of, passed_by

SWEEPS, AGAIN, PENDULUM_INTERVALS = 20, 100, 20


def sweep_seconds(rows: int, steps: int) -> float:
    """Seconds of one passage of the chain's covariance forward, and of the slopes of two of its last entries back."""
    m = (rows - 2) // 2
    D = np.eye(m) - np.eye(m, k=-1)
    F = np.zeros((rows, rows))
    F[:m, m : 2 * m] = np.eye(m)
    F[m : 2 * m, :m], F[m : 2 * m, m : 2 * m] = -2.0 * D.T @ D, -0.3 * D.T @ D
    F[m : 2 * m, 2 * m :] = 0.1
    Q, W = np.zeros((rows, rows)), np.zeros((rows, rows))
    Q[m : 2 * m, m : 2 * m], W[m - 1, m - 1] = 0.002 * np.eye(m), 100.0
    H = ca.sparsify(ca.DM(0.1 * np.block([[-F.T, W], [Q, F]])))
    half = half_length(rows)
    e, wide = ca.MX.sym("e", half), ca.repmat(H.sparsity(), 1, steps)
    points = [ca.MX.sym(name, wide) for name in ("h1", "h2")]
    passed = passed_by(e, entries_of(points, rows))
    value = passed[half - 1, -1] + passed[half - 3, -1]
    slopes = [ca.jtimes(value, point, ca.DM(1.0), True) for point in points]
    both = Buffered(ca.Function("both", [e, *points], [value, *slopes]))
    start = np.zeros(half)
    start[np.cumsum([0, *range(rows, 1, -1)])] = 0.1
    entries = np.asarray(ca.repmat(H, 1, steps).nonzeros())
    scale = iter(np.linspace(0.9, 1.1, SWEEPS + 1))
    return median_of(lambda: both(start, *[next(scale) * entries] * 2), SWEEPS)


def distance(rounds: int) -> None:
    """First solves and solves again beside the limit."""
    print("rows   limit [ms]   first solve, again (times the limit): ipopt | reduced")
    for rows in (4, 12, 30):
        line = []
        for method in ("ipopt", "reduced"):
            firsts, agains, limit = [], [], 0.0
            for _ in range(rounds):
                begin = time.process_time()
                solver = co.Solver(mass_chain.problem(masses=(rows - 2) // 2), method, intervals=50)
                solution = solver.solve(progress=False)
                firsts.append(time.process_time() - begin)
                agains.append(median_of(lambda solver=solver: solver.solve(progress=False), 3))  # type: ignore[misc]
                steps = solution.mesh.intervals * solution.mesh.substeps
                limit = sweep_seconds(rows, steps) * (solution.stats["iterations"] + 1)
            first, again = statistics.median(firsts), statistics.median(agains)
            line.append(f"{1e3 * first:7.1f} ({first / limit:4.0f}), {1e3 * again:7.1f} ({again / limit:4.0f})")
        print(f"{rows:4d} {1e3 * limit:10.2f}      {' | '.join(line)}", flush=True)


def growth(rounds: int) -> None:
    """Seconds by the number of intervals, chain of 12 rows."""
    print("intervals   first solve   again   (Ipopt)")
    for intervals in (50, 500, 5000):
        few = rounds if intervals < 5000 else 1
        firsts, agains = [], []
        for _ in range(few):
            begin = time.process_time()
            solver = co.Solver(mass_chain.problem(masses=5), intervals=intervals)
            solver.solve(progress=False)
            firsts.append(time.process_time() - begin)
            agains.append(median_of(lambda solver=solver: solver.solve(progress=False), 1))  # type: ignore[misc]
        print(f"{intervals:9d} {statistics.median(firsts):13.3f} {statistics.median(agains):7.3f}", flush=True)


def pendulum() -> co.Problem:
    """A pendulum brought to rest within bounds of its torque."""
    ocp = co.Problem(2.0, name="pendulum")
    a, w = ocp.state("a", initial=0.3), ocp.state("w", initial=0.0)
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(a, w)
    ocp.dynamics(w, 9.81 * 0.2 * ca.sin(a) + u - 0.1 * w)
    ocp.minimize(running=a**2 + 0.1 * w**2 + 0.05 * u**2)
    return ocp


def by_hand(plugin: str) -> Callable[[], Any]:
    """The pendulum as a program of CasADi, called again from its solution."""
    n, h = PENDULUM_INTERVALS, 2.0 / PENDULUM_INTERVALS
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")

    def rate(z: Any) -> Any:
        slope = ca.vertcat(z[1], 9.81 * 0.2 * ca.sin(z[0]) + u - 0.1 * z[1])
        return ca.vertcat(slope, z[0] ** 2 + 0.1 * z[1] ** 2 + 0.05 * u**2)

    z = ca.vertcat(x, 0)
    k1 = rate(z)
    k2 = rate(z + h / 2 * k1)
    k3 = rate(z + h / 2 * k2)
    end = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + h * k3))
    step = ca.Function("step", [x, u], [end[:2], end[2]])
    variables, rows, cost, lower, upper, equal = [], [], 0.0, [], [], []
    point = ca.MX.sym("x0", 2)
    variables.append(point)
    lower, upper = [-np.inf] * 2, [np.inf] * 2
    for i in range(n):
        control = ca.MX.sym(f"u{i}")
        after, paid = step(point, control)
        following = ca.MX.sym(f"x{i + 1}", 2)
        rows.append(following - after)
        if i == 0:  # fatrop wants the conditions of an instant behind what leads to the next one
            rows.append(point - ca.DM([0.3, 0.0]))
        point = following
        variables += [control, point]
        cost += paid
        lower += [-3.0, -np.inf, -np.inf]
        upper += [3.0, np.inf, np.inf]
        equal += [True, True, True, True] if i == 0 else [True, True]
    options: dict[str, Any] = {"print_time": False, "calc_lam_p": False}
    if plugin == "ipopt":
        warm = {"warm_start_init_point": "yes", "mu_init": 1e-6, "warm_start_bound_push": 1e-8}
        options["ipopt"] = {"print_level": 0, "sb": "yes", **warm, "warm_start_mult_bound_push": 1e-8}
    else:
        options |= {"structure_detection": "auto", "equality": equal, "fatrop": {"print_level": 0}}
    nlp = {"x": ca.vertcat(*variables), "f": cost, "g": ca.vertcat(*rows)}
    solver = ca.nlpsol("by_hand", plugin, nlp, options)
    limits = {"lbx": lower, "ubx": upper, "lbg": 0.0, "ubg": 0.0}
    known = solver(x0=0.1, **limits)
    start = {"x0": known["x"], "lam_x0": known["lam_x"], "lam_g0": known["lam_g"]}
    return lambda: solver(**start, **limits)


def rates(rounds: int) -> None:
    """Solves a second from the plan."""
    print("solves a second from the plan")
    problems = {"lag (5.2), 100 intervals": (unknown_lag.problem, 100)}
    problems[f"pendulum, {PENDULUM_INTERVALS} intervals"] = (pendulum, PENDULUM_INTERVALS)
    for name, (problem, intervals) in problems.items():
        found = {}
        for method in ("ipopt", "reduced"):
            solver = co.Solver(problem(), method, intervals=intervals)
            plan = solver.solve(progress=False)
            plan = solver.solve(guess=plan, progress=False, assess=False)
            again = lambda: solver.solve(guess=plan, progress=False, assess=False)  # noqa: B023, E731
            found[method] = 1 / statistics.median(median_of(again, AGAIN) for _ in range(rounds))
        print(f"  {name}: " + ", ".join(f"{method} {rate:.0f}" for method, rate in found.items()), flush=True)
    for plugin in ("ipopt", "fatrop"):
        again = by_hand(plugin)
        print(f"  pendulum by hand, {plugin}: {1 / median_of(again, AGAIN):.0f}", flush=True)


def main(rounds: int = 5) -> None:
    """Print the tables."""
    distance(rounds)
    growth(rounds)
    rates(rounds)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
