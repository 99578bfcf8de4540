"""The reduced method beside Ipopt: first solves, solves again, from the plan, and from a plan with other parameters.

    python benchmarks/measurements/reduced.py [rounds]

Both in one process and in turn, medians of processor milliseconds.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

import numpy as np

import covocp as co
from covocp.models import damped_oscillator, free_time_integrator, mars_entry, mass_chain, unknown_lag

CHANGE = 0.02  # relative standard deviation of parameters from one solve to the next
AGAIN = 10


def times(problem: Callable[[], co.Problem], method: str, intervals: int) -> list[float]:
    """Seconds of a first solve, of one more, of one from the plan, of one near it; iterations of the last kind."""
    begin = time.process_time()
    solver = co.Solver(problem(), method, intervals=intervals)
    plan = solver.solve(progress=False)
    first = time.process_time() - begin
    again = measured(lambda: solver.solve(progress=False))
    solver.solve(guess=plan, progress=False, assess=False)
    warm = measured(lambda: solver.solve(guess=plan, progress=False, assess=False))
    statement, rng = solver.statement, np.random.default_rng(0)
    names = [block.name for block in statement.blocks if block.kind in ("parameter", "unknown")]
    near, iterations = [], []
    for _ in range(AGAIN):
        changed = statement.values[: len(names)] * (1 + CHANGE * rng.normal(size=len(names)))
        begin = time.process_time()
        plan = solver.solve(dict(zip(names, changed, strict=True)), guess=plan, progress=False, assess=False)
        near.append(time.process_time() - begin)
        iterations.append(plan.stats["iterations"])
    return [first, again, warm, statistics.median(near), statistics.median(iterations) / 1e3]


def measured(run: Callable[[], object]) -> float:
    """Processor seconds of a call."""
    begin = time.process_time()
    run()
    return time.process_time() - begin


def main(rounds: int = 5) -> None:
    """Print the table."""
    cases: list[tuple[str, Callable[[], co.Problem], int]] = [
        (f"chain, {size} rows", lambda n=size: mass_chain.problem(masses=(n - 2) // 2), 50) for size in (4, 12, 30)
    ]
    cases += [("lag", unknown_lag.problem, 100), ("oscillator", damped_oscillator.problem, 100)]
    cases += [("6.12", free_time_integrator.problem, 100), ("Mars entry", mars_entry.problem, 100)]
    print("milliseconds             first    again from the plan, near it, iterations near it")
    for name, problem, intervals in cases:
        rows: dict[str, list[list[float]]] = {"ipopt": [], "reduced": []}
        for _ in range(rounds):
            for method, own in rows.items():
                own.append(times(problem, method, intervals))
        for method, own in rows.items():
            row = [1e3 * statistics.median(column) for column in zip(*own, strict=True)]
            print(f"{name:15s} {method:8s}" + "".join(f"{value:8.1f}" for value in row))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
