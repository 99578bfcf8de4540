"""What rows of E that stay zero cost: a sensor on a platform that is known exactly looks at two uncertain states.

Each problem is solved with and without these rows, in both formulations; the medians of the processor seconds of first
solves are printed as the table of docs/numerics.md. With the rows and covariances as states Ipopt may not end: its last
iterate then counts.
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings

import casadi as ca
import numpy as np

import covocp as co
import covocp.solving.exact_rows as rows_left_out

PLATFORM = (2, 4)
INTERVALS = 60


def problem(exact: int) -> co.Problem:
    """A chain of `exact` states moves the sensor."""
    ocp = co.Problem(duration=4.0, name="platform")
    p = ocp.state("p", exact, initial=np.linspace(0.2, 0.5, exact))
    x = ocp.state("x", 2, initial=np.ones(2), variance=0.5)
    u = ocp.control("u")
    ocp.dynamics(p, ca.vertcat(p[1:], u) - 0.2 * p)
    ocp.dynamics(x, -0.3 * x + 0.1 * ca.sin(x), noise=0.05)
    ocp.measurement("y", ca.sum1(x) * p[0], noise=0.2)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + 0.1 * p[0] ** 2, terminal=5 * ca.trace(E[x, x]))
    return ocp


def seconds(exact: int, covariances: str, whole: bool) -> tuple[float, int, bool]:
    """Of a first solve; its iterations; whether it converged."""
    find = rows_left_out.carried
    if whole:
        rows_left_out.carried = lambda statement: None
    try:
        ocp, start = problem(exact), time.process_time()
        options = {"intervals": INTERVALS, "covariances": covariances, "max_iterations": 100}
        solution = co.solve(ocp, progress=False, allow_failure=True, **options)
        return time.process_time() - start, int(solution.stats["iterations"]), solution.converged
    finally:
        rows_left_out.carried = find


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    repeats = parser.parse_args().repeats
    warnings.simplefilter("ignore", co.CovocpWarning)
    print("| exact states | covariances | with the rows | without | ratio |\n|---|---|---|---|---|")
    for exact in PLATFORM:
        for covariances in ("eliminated", "states"):
            times, cells = [], []
            for whole in (True, False):
                runs = [seconds(exact, covariances, whole) for _ in range(repeats)]
                times.append(statistics.median(run[0] for run in runs))
                cells.append(f"{times[-1]:.2f} ({runs[0][1]}{'' if runs[0][2] else ', failed'})")
            print(f"| {exact} | {covariances} | {cells[0]} | {cells[1]} | {times[0] / times[1]:.1f} |")


if __name__ == "__main__":
    main()
