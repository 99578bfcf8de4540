"""Write the measurements of core.py and their judgement as a table and a picture."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path

import matplotlib
from cases import Case
from targets import Figure, figures_table

matplotlib.use("Agg")
from matplotlib import pyplot

ROOT = Path(__file__).resolve().parent.parent
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
COLUMNS = {"build": ".3f", "solve": ".3f", "iterations": ".0f", "cost": ".8g", "memory": ".0f"}
MARKERS = {
    "covocp": "o",
    "eliminated": "s",
    "packed": "^",
    "packed, one iteration": "v",
    "rockit": "D",
    "rockit, one function": "d",
}


def case_row(case: Case) -> str:
    """One line of the table of cases."""
    cells = [case.part, str(case.size or ""), LABELS.get(case.code, f"`{case.code}`")]
    if case.error or not case.results:
        cells += [case.error or "not run", *[""] * 7]
    else:
        seconds = sorted(result["seconds"] for result in case.results)
        cells += [f"{case.median():.3f}", f"{seconds[0]:.3f} to {seconds[-1]:.3f}", str(len(seconds))]
        medians = {key: case.median(key) for key in COLUMNS}
        cells += ["" if median is None else format(median, COLUMNS[key]) for key, median in medians.items()]
    return f"| {' | '.join(cells)} |"


def cases_table(cases: Sequence[Case]) -> str:
    """All measured times, as a table."""
    heads = "part | n | script | total, s | least to most | runs | build, s | solve, s | iterations | cost | peak, MB"
    ordered = sorted(cases, key=lambda case: (case.part, case.size, case.code))
    return "\n".join([f"| {heads} |", "|---" * 11 + "|", *[case_row(case) for case in ordered]])


def version(package: str) -> str:
    """Installed version of a package."""
    try:
        return f"{package} {importlib.metadata.version(package)}"
    except importlib.metadata.PackageNotFoundError:
        return f"{package} not installed"


def processor() -> str:
    """Name of the processor and number of its cores that may be used."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor() or platform.machine()}, {os.cpu_count()} cores"


def git(*arguments: str) -> str:
    """What git answers about the checkout, empty where there is none."""
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def heading(repeats: int, load: float) -> str:
    """Where and how it was measured."""
    changed = " with changes" if git("status", "--porcelain", "--", "ocp", "solvers", "models", "benchmarks") else ""
    return f"""# Benchmarks

Written by `benchmarks/core.py` in one run on one machine: medians of {repeats} runs in random order, each in a process
of its own; a case that takes over 30 s runs once. Times are those of a first solve as a user waits for it, building
included, imports left out. The peak memory is that of the whole process.

- commit {git("rev-parse", "--short=12", "HEAD") or "unknown"}{changed}, {datetime.date.today().isoformat()}
- Python {platform.python_version()}, {", ".join(version(package) for package in PACKAGES)}
- {processor()}, {platform.system()}; one thread for linear algebra; load at the start {load:.1f}

The oscillator is that of Schmidt, section 5.4, with C33 = 1000 (100 intervals); the chain of masses has n = 2 m + 2
augmented states for m masses (50 intervals). The controls are linear over each interval; rockit's is constant, its
usual form. The scripts by hand are `peers_eliminated.py` (Gauss step, ten segments, limited-memory Hessian),
`peers_packed.py` (mapped SX Runge-Kutta steps, exact Hessian) and `peers_naive.py`. All take the control of least
energy as their guess; the first two also simulate the states along it. They keep Ipopt's tolerance of 1e-8; covocp's
default is 1e-7 on its scaled problem, which saves it up to two iterations."""


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


def write(folder: Path, cases: Sequence[Case], figures: Sequence[Figure], repeats: int, load: float) -> None:
    """Write benchmarks.md and benchmarks.png."""
    folder.mkdir(parents=True, exist_ok=True)
    sections = [heading(repeats, load), "## Targets", figures_table(figures), "## All cases", cases_table(cases)]
    if any(case.part == "b" for case in cases):
        picture(folder / "benchmarks.png", cases)
        sections.append("![Time and memory over the size of the covariance](benchmarks.png)")
    (folder / "benchmarks.md").write_text("\n\n".join(sections) + "\n", encoding="utf-8")
