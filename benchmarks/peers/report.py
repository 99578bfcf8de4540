"""Tables of measurements, and where and how they were made."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmark import Run
from cases import Case

ROOT = Path(__file__).resolve().parents[2]
COLUMNS = {"build": ".3f", "solve": ".3f", "iterations": ".0f", "cost": ".8g", "memory": ".0f"}


def case_row(case: Case, labels: Mapping[str, str]) -> str:
    """One line of the table of cases."""
    cells = [case.part, str(case.size or ""), labels.get(case.code, f"`{case.code}`")]
    if case.error or not case.results:
        cells += [case.error or "not run", *[""] * 7]
    else:
        seconds = sorted(result["seconds"] for result in case.results)
        cells += [f"{case.median():.3f}", f"{seconds[0]:.3f} to {seconds[-1]:.3f}", str(len(seconds))]
        medians = {key: case.median(key) for key in COLUMNS}
        cells += ["" if median is None else format(median, COLUMNS[key]) for key, median in medians.items()]
    return f"| {' | '.join(cells)} |"


def cases_table(cases: Sequence[Case], labels: Mapping[str, str]) -> str:
    """All measured times, as a table; the scripts in words."""
    heads = "part | n | script | total, s | least to most | runs | build, s | solve, s | iterations | cost | peak, MB"
    ordered = sorted(cases, key=lambda case: (case.part, case.size, case.code))
    return "\n".join([f"| {heads} |", "|---" * 11 + "|", *[case_row(case, labels) for case in ordered]])


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


def conditions(run: Run, script: str, packages: Sequence[str]) -> str:
    """Where and how it was measured."""
    changed = " with changes" if git("status", "--porcelain", "--", "ocp", "solvers", "models", "benchmarks") else ""
    return f"""Written by `benchmarks/peers/{script}` in one run on one machine: medians of {run.repeats} runs in random
order, each in a process of its own; a case that takes over 30 s runs once. Times are those of a first solve as a user
waits for it, building included, imports left out. The peak memory is that of the whole process.

- commit {git("rev-parse", "--short=12", "HEAD") or "unknown"}{changed}, {datetime.date.today().isoformat()}
- Python {platform.python_version()}, {", ".join(version(package) for package in packages)}
- {processor()}, {platform.system()}; one thread for linear algebra; load at the start {run.load:.1f}"""
