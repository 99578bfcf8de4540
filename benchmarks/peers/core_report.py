"""The report of core.py: a table and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
from benchmark import Run
from cases import Case
from report import cases_table, conditions
from targets import figures_table

matplotlib.use("Agg")
from matplotlib import pyplot

PACKAGES = ("casadi", "numpy", "rockit-meco")
LABELS = {
    "covocp": "covocp, defaults",
    "eliminated": "CasADi by hand, covariance eliminated",
    "packed": "CasADi by hand, half-vector of the covariance as states",
    "packed, one iteration": "the same, one iteration",
    "naive": "casadi.Opti, full covariance, steps in a loop",
    "rockit": "rockit, full covariance",
    "rockit, one function": "rockit, rates and Jacobian in one expanded function first",
    "statement": "covocp, model to frozen statement",
}
MARKERS = {
    "covocp": "o",
    "eliminated": "s",
    "packed": "^",
    "packed, one iteration": "v",
    "rockit": "D",
    "rockit, one function": "d",
}

SYSTEMS = """The oscillator is that of Schmidt, section 5.4, with C33 = 1000 (100 intervals); the chain of masses has
n = 2 m + 2 augmented states for m masses (50 intervals). The controls are linear over each interval; rockit's is
constant, its usual form. The scripts by hand are `peers_eliminated.py` (Gauss step, ten segments, limited-memory
Hessian), `peers_packed.py` (mapped SX Runge-Kutta steps, exact Hessian) and `peers_naive.py`. All take the control of
least energy as their guess; the first two also simulate the states along it. They keep Ipopt's tolerance of 1e-8;
covocp's default is 1e-7 on its scaled problem, which saves it up to two iterations."""


def picture(path: Path, cases: Sequence[Case]) -> None:
    """Draw time and peak memory over the size of the covariance, in logarithms."""
    chain = sorted((case for case in cases if case.part == "b"), key=lambda case: case.size)
    chart, both = pyplot.subplots(1, 2, figsize=(11, 5), layout="constrained")
    ticks = sorted({case.size for case in chain})
    for axes, key, label in zip(
        both, ("seconds", "memory"), ("build and solve, s", "peak memory of the process, MB"), strict=True
    ):
        for code, marker in MARKERS.items():
            points = [(case.size, case.median(key)) for case in chain if case.code == code and not case.error]
            if points:
                axes.loglog([n for n, _ in points], [y for _, y in points], marker=marker, label=LABELS[code])
        axes.set_xlabel("n, size of the covariance")
        axes.set_ylabel(label)
        axes.set_xticks(ticks, [str(n) for n in ticks])
        axes.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
        axes.grid(alpha=0.3)
    chart.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize="small")
    chart.suptitle("Chain of masses, 50 intervals: first solve")
    chart.savefig(path, dpi=120)
    pyplot.close(chart)


def write(folder: Path, run: Run) -> None:
    """Write benchmarks.md and benchmarks.png."""
    sections = ["# Benchmarks", conditions(run, "core.py", PACKAGES), SYSTEMS]
    sections += ["## Targets", figures_table(run.figures), "## All cases", cases_table(run.cases, LABELS)]
    if any(case.part == "b" for case in run.cases):
        picture(folder / "benchmarks.png", run.cases)
        sections.append("![Time and memory over the size of the covariance](benchmarks.png)")
    (folder / "benchmarks.md").write_text("\n\n".join(sections) + "\n", encoding="utf-8")
