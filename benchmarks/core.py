"""How fast is the core? Everything in one run on one machine, against peers written in plain CasADi and against rockit.

    python benchmarks/core.py               all, medians of five runs in random order; writes docs/benchmarks.*
    python benchmarks/core.py --quick       one run of each, small sizes; prints only
    python benchmarks/core.py --only b      one part: a (oscillator), b (chain of masses), c (building, import)

Every case runs in a process of its own (case.py), so that first solves are compared and each has its own peak memory.
The exit code is always 0; what misses its target is printed. rockit comes with the `benchmark` extra; without it those
cases are left out.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
from collections.abc import Sequence
from pathlib import Path

from cases import SIZES, Case, building_cases, chain_cases, oscillator_cases
from targets import figures_table, judge

# This process imports neither CasADi nor matplotlib before the end: on Linux a child's peak counts its parent's size.
DOCS = Path(__file__).resolve().parent.parent / "docs"
REPEATS = 5
SEED = 1


def measure(cases: Sequence[Case], repeats: int) -> None:
    """Run all cases in random order, each `repeats` times; a long one or one that fails once."""
    order = [case for case in cases for _ in range(repeats)]
    random.Random(SEED).shuffle(order)
    for count, case in enumerate(order, start=1):
        if not case.finished:
            result = case.run()
            case.results.append(result)
            said = result.get("error") or f"{result['seconds']:.3f} s"
            print(f"[{count}/{len(order)}] {case.name}: {said}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, judge and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one run of each case, n = 4 and 8 only")
    parser.add_argument("--only", choices=("a", "b", "c"), help="one part")
    parser.add_argument("--output", type=Path, help="folder of the report (default: docs, for a run of everything)")
    options = parser.parse_args(arguments)
    sizes = [4, 8] if options.quick else list(SIZES)
    parts = {"a": oscillator_cases(), "b": chain_cases(sizes), "c": building_cases(sizes[-1])}
    cases = [case for part, members in parts.items() if options.only in (None, part) for case in members]
    repeats = 1 if options.quick else REPEATS
    load = os.getloadavg()[0]
    measure(cases, repeats)
    figures = judge(cases)
    print(figures_table(figures))
    missed = [figure for figure in figures if figure.holds is False]
    print(f"{len(missed)} of {sum(figure.holds is not None for figure in figures)} targets missed")
    for figure in missed:
        print(f"  MISSED  {figure.what}: {figure.measured} (target {figure.target})")
    everything = not options.quick and options.only is None
    folder = options.output or (DOCS if everything else None)
    if folder is not None:
        import report  # matplotlib

        report.write(folder, cases, figures, repeats, load)
    return 0


if __name__ == "__main__":
    sys.exit(main())
