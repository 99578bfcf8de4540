"""What the benchmarks have in common: their options, the run of all cases, the judgement, the report."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cases import Case, measure
from targets import Figure, figures_table

# This process imports neither CasADi nor matplotlib before the end: on Linux a child's peak counts its parent's size.
DOCS = Path(__file__).resolve().parents[2] / "docs"
REPEATS = 5


@dataclass(frozen=True, kw_only=True)
class Run:
    """What was measured."""

    cases: list[Case]
    figures: list[Figure]
    repeats: int
    load: float  # of the machine at the start


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """A benchmark: its description, its cases by part (quick or not), its judgement, what writes its report."""

    description: str
    quick: str  # what --quick leaves out
    parts: Callable[[bool], Mapping[str, Sequence[Case]]]
    judge: Callable[[Sequence[Case]], list[Figure]]
    write: Callable[[Path, Run], None]

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Measure, judge and write; the exit code is 0."""
        parser = argparse.ArgumentParser(
            description=self.description, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        parser.add_argument("--quick", action="store_true", help=f"one run of each case, {self.quick}")
        parser.add_argument("--only", choices=tuple(self.parts(False)), help="one part")
        parser.add_argument("--output", type=Path, help="folder of the report (default: docs, for a run of everything)")
        options = parser.parse_args(arguments)
        parts = self.parts(options.quick)
        cases = [case for part, members in parts.items() if options.only in (None, part) for case in members]
        repeats = 1 if options.quick else REPEATS
        load = os.getloadavg()[0]
        measure(cases, repeats)
        figures = self.judge(cases)
        print(figures_table(figures))
        missed = [figure for figure in figures if figure.holds is False]
        print(f"{len(missed)} of {sum(figure.holds is not None for figure in figures)} targets missed")
        for figure in missed:
            print(f"  MISSED  {figure.what}: {figure.measured} (target {figure.target})")
        everything = not options.quick and options.only is None
        folder = options.output or (DOCS if everything else None)
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            self.write(folder, Run(cases=cases, figures=figures, repeats=repeats, load=load))
        return 0
