"""How fast is the core? Everything in one run on one machine, against peers written in plain CasADi and against rockit.

    python benchmarks/peers/core.py               all, medians of five runs in random order; writes docs/benchmarks.*
    python benchmarks/peers/core.py --quick       one run of each, small sizes; prints only
    python benchmarks/peers/core.py --only b      one part: a (oscillator), b (chain of masses), c (building, import)

Every case runs in a process of its own (case.py), so that first solves are compared and each has its own peak memory.
The exit code is always 0; what misses its target is printed. rockit comes with the `benchmark` extra; without it those
cases are left out.
"""

from __future__ import annotations

import sys
from pathlib import Path

from benchmark import Benchmark, Run
from cases import Case
from core_cases import SIZES, building_cases, chain_cases, oscillator_cases
from core_targets import judge


def parts(quick: bool) -> dict[str, list[Case]]:
    """The cases by part."""
    sizes = [4, 8] if quick else list(SIZES)
    return {"a": oscillator_cases(), "b": chain_cases(sizes), "c": building_cases(sizes[-1])}


def write(folder: Path, run: Run) -> None:
    """Write the report."""
    import core_report  # matplotlib

    core_report.write(folder, run)


if __name__ == "__main__":
    benchmark = Benchmark(description=__doc__ or "", quick="n = 4 and 8 only", parts=parts, judge=judge, write=write)
    sys.exit(benchmark.main())
