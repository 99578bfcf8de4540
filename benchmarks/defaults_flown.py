"""Promised and flown deviations of ten closed loops with steep ends: in Python and by the compiled C, two ways each.

The random linear systems of `defaults_expected_cost` whose default mesh was graded at both ends. Each controller is
exported for any times and for samples of a period, compiled, and flies in the actual noisy system, which a simulation
integrates with substeps of its own. Printed are the factors between the standard deviations at the end, of the sample
and as promised by the solution; the entry that is farthest off. A sample of N runs knows them to 1/sqrt(2 N).

    python benchmarks/defaults_flown.py [runs]
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from defaults_expected_cost import problem, random_system

import covocp as co

LOOPS, PERIODS = 10, 1000


def factor(runs: co.MonteCarlo, solution: co.Solution) -> float:
    """Sample deviation over the promised one at the end, of the entry where they differ most."""
    ratios = np.ravel(runs.deviation("x")[-1] / solution.deviation("x")[-1])
    return float(ratios[np.argmax(np.abs(np.log(ratios)))])


def flown(solution: co.Solution, folder: Path, runs: int) -> list[float]:
    """Factors of the simulated filter and feedback, of the C code for any times, and of that for samples."""
    period = solution.duration / PERIODS
    settings = {"seed": 7, "progress": False}
    result = [factor(co.simulate(solution, runs, **settings), solution)]
    for name, options in (("any", {}), ("sampled", {"period": period})):
        package = co.export_c(solution, folder / name, **options)
        package.build()
        assert package.check().ok
        law = {"law": package.python()} | ({} if options else {"period": period})
        result.append(factor(co.simulate(solution, runs, **law, **settings), solution))
    return result


def main() -> None:
    """Print the table."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    print(f"{runs} runs: standard deviations are known to {100 / np.sqrt(2 * runs):.1f} %, periods of T/{PERIODS}.\n")
    print("| system | nodes added | in Python | C, any times | C, sampled | warnings | s |")
    print("|---|---|---|---|---|---|---|")
    seed = done = 0
    while done < LOOPS:
        begin = time.perf_counter()
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            solution = co.solve(problem(random_system(seed)), progress=False)
            added = solution.stats.get("nodes_added", (0, 0))
            if min(added) > 0:
                with tempfile.TemporaryDirectory() as folder:
                    factors = flown(solution, Path(folder), runs)
                done += 1
                columns = " | ".join(f"{100 * (value - 1):+.1f} %" for value in factors)
                seconds = time.perf_counter() - begin
                print(f"| {seed} | {added[0]} + {added[1]} | {columns} | {len(told)} | {seconds:.0f} |", flush=True)
        seed += 1


if __name__ == "__main__":
    main()
