"""A system whose position is sampled once a second against the same system measured all the time: time of a solve.

    python benchmarks/measurements/instants.py

Both are solved in turn in one process, first solves and re-solves, medians; the sampled one has the variance of a
reading that the continuous one would collect in a second.
"""

from __future__ import annotations

import statistics
import time

import casadi as ca
import numpy as np

import covocp as co

ROUNDS, DURATION = 5, 10.0


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


def once(masses: int, sampled: bool, expected: bool) -> tuple[float, float, float]:
    """Seconds of a first solve and of a re-solve, cost."""
    begin = time.process_time()
    solver = co.Solver(problem(masses, sampled, expected), intervals=100)
    solution = solver.solve(progress=False)
    first = time.process_time() - begin
    begin = time.process_time()
    solver.solve(progress=False)
    return first, time.process_time() - begin, solution.cost


def main() -> None:
    """Print the table."""
    print("states  cost       first solve [s]: continuous, sampled, ratio    re-solve: continuous, sampled, ratio")
    for masses, expected in ((1, False), (2, False), (4, False), (1, True), (2, True)):
        runs = [[once(masses, sampled, expected) for sampled in (False, True)] for _ in range(ROUNDS)]
        first, again = ([statistics.median(run[s][i] for run in runs) for s in (0, 1)] for i in (0, 1))
        words = "expected" if expected else "estimation"
        print(
            f"{2 * masses:6d}  {words:10s} {first[0]:8.3f} {first[1]:8.3f} {first[1] / first[0]:6.2f}"
            f"{again[0]:24.3f} {again[1]:8.3f} {again[1] / again[0]:6.2f}"
        )


if __name__ == "__main__":
    main()
