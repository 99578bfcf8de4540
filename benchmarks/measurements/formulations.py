"""Where the border between the two formulations lies: eliminated matrices against half-vector states, first solves.

Each problem is solved by both formulations, in random order, with everything else at its default; the medians of five
go into docs/formulations.md. `transcription/choosing.py` takes its rule from this table.
"""

from __future__ import annotations

import argparse
import random
import statistics
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import covocp as co
from covocp.models import (
    chord_test,
    damped_oscillator,
    free_time_integrator,
    mass_chain,
    noisy_integrator,
    unknown_gain,
    unknown_lag,
)

OUTPUT = Path(__file__).parents[2] / "docs" / "formulations.md"
FORMULATIONS = ("eliminated", "states")
CASES: dict[str, tuple[Callable[[], co.Problem], int]] = {
    "noisy integrator": (lambda: noisy_integrator.problem(1.0, 0.0), 100),
    "free terminal time": (lambda: free_time_integrator.problem(), 100),
    "chord test": (lambda: chord_test.problem(), 100),
    "unknown gain": (lambda: unknown_gain.problem(), 100),
    "first-order lag, x(T) = 0": (lambda: unknown_lag.problem(), 100),
    "first-order lag, x(T) = 1": (lambda: unknown_lag.problem(final=1.0), 100),
    "damped oscillator": (lambda: damped_oscillator.problem(), 100),
    "one mass": (lambda: mass_chain.problem(masses=1), 50),
    "three masses": (lambda: mass_chain.problem(masses=3), 50),
}


def seconds(make: Callable[[], co.Problem], intervals: int, covariances: str) -> tuple[float, float, int, int]:
    """Time from the problem to the solution, cost, iterations, entries of the half-vectors."""
    start = time.perf_counter()
    problem = make()
    solution = co.solve(problem, intervals=intervals, covariances=covariances, progress=False)
    elapsed = time.perf_counter() - start
    return elapsed, solution.cost, int(solution.stats["iterations"]), problem.statement().ne


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    warnings.simplefilter("ignore", co.CovocpWarning)
    runs = [(name, kind) for name in CASES for kind in FORMULATIONS for _ in range(repeats)]
    random.Random(1).shuffle(runs)
    results: dict[tuple[str, str], list[tuple[float, float, int, int]]] = {}
    for name, kind in runs:
        make, intervals = CASES[name]
        results.setdefault((name, kind), []).append(seconds(make, intervals, kind))
    lines = [
        "# Eliminated covariances against covariances as states",
        "",
        f"First solves with default options, medians of {repeats} in random order, seconds (iterations).",
        "Written by `benchmarks/measurements/formulations.py`.",
        "",
        "| problem | entries | eliminated | states | ratio | difference of the costs |",
        "|---|---|---|---|---|---|",
    ]
    for name in CASES:
        one, two = (results[name, kind] for kind in FORMULATIONS)
        times = [statistics.median(run[0] for run in group) for group in (one, two)]
        cells = [f"{t:.3f} ({group[0][2]})" for t, group in zip(times, (one, two), strict=True)]
        gap = abs(one[0][1] - two[0][1]) / abs(one[0][1])
        lines.append(f"| {name} | {one[0][3]} | {cells[0]} | {cells[1]} | {times[1] / times[0]:.2f} | {gap:.0e} |")
    OUTPUT.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
