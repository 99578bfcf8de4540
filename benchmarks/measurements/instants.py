"""A system whose position is sampled once a second against the same system measured all the time: time of a solve.

    python benchmarks/measurements/instants.py

Both are solved in turn in one process, first solves and re-solves, medians of processor seconds; the sampled one has
the variance of a reading that the continuous one would collect in a second. Last, the cost with its gradient, once:
what a solve takes beside it depends on how many iterations the two problems happen to need.
"""

from __future__ import annotations

import statistics
import time

import casadi as ca
import numpy as np

import covocp as co
from covocp.transcription.scales import choose_scales
from covocp.transcription.transcribing import transcribe

ROUNDS, EVALUATIONS, DURATION = 5, 30, 10.0


def problem(masses: int, sampled: bool, expected: bool) -> co.Problem:
    """A chain of masses with an unknown stiffness, pushed at one end, its last place measured."""
    ocp = co.Problem(DURATION)
    x = ocp.state("x", masses, initial=np.zeros(masses), variance=np.full(masses, 0.1))
    v = ocp.state("v", masses, initial=np.zeros(masses), variance=np.full(masses, 0.1))
    k = ocp.unknown("k", mean=1.0, variance=0.05)
    u = ocp.control("u", guess=0.1)
    springs = 2 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    ocp.dynamics(x, v)
    ocp.dynamics(v, -k * (ca.DM(springs) @ x) - 0.1 * v + np.eye(masses, 1) * u, noise=np.full(masses, 0.01))
    ocp.measurement("place", x[masses - 1], 0.2, **({"every": 1.0} if sampled else {}))
    if expected:
        ocp.minimize_expected((x[masses - 1] - 1) ** 2 + 0.1 * u**2, x[masses - 1] ** 2)
    else:
        E = ocp.estimation_covariance()
        ocp.minimize(0.1 * u**2, 20 * E[k, k])
    return ocp


def once(masses: int, sampled: bool, expected: bool) -> tuple[float, float, float, int]:
    """Seconds of a first solve, of a re-solve and of the cost with its gradient; iterations."""
    begin = time.process_time()
    solver = co.Solver(problem(masses, sampled, expected), intervals=100)
    solution = solver.solve(progress=False)
    first = time.process_time() - begin
    begin = time.process_time()
    solver.solve(progress=False)
    again = time.process_time() - begin
    return first, again, evaluation(solution), solution.stats["iterations"]


def evaluation(solution: co.Solution) -> float:
    """Seconds of the cost of the nonlinear program with its gradient."""
    statement, mesh, trajectory = solution.statement, solution.mesh, solution.trajectory
    assert statement is not None
    scales = choose_scales(statement, mesh, trajectory, statement.values)
    nlp = transcribe(statement, mesh, scales, "compiled")
    w, p = nlp.pack(trajectory), np.append(statement.values, 1.0)
    function = ca.Function("f", [nlp.w, nlp.p], [nlp.f, ca.gradient(nlp.f, nlp.w)])
    begin = time.process_time()
    for k in range(EVALUATIONS):  # the last point is remembered
        function(w * (1 + 1e-9 * k), p)
    return (time.process_time() - begin) / EVALUATIONS


def main() -> None:
    """Print the table."""
    print("states  cost        first solve [s]: ratio   re-solve: ratio   f and gradient [ms]: ratio    iterations")
    for masses, expected in ((1, False), (2, False), (4, False), (1, True), (2, True)):
        runs = [[once(masses, sampled, expected) for sampled in (False, True)] for _ in range(ROUNDS)]
        words = f"{2 * masses:6d}  {'expected' if expected else 'estimation':10s}"
        for i, unit in enumerate((1.0, 1.0, 1e3)):
            both = [unit * statistics.median(run[s][i] for run in runs) for s in (0, 1)]
            words += f"{both[0]:8.3f} {both[1]:6.3f} {both[1] / both[0]:5.2f}"
        print(words, f"{runs[0][0][3]:8d} {runs[0][1][3]:4d}")


if __name__ == "__main__":
    main()
