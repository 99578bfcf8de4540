"""What is measured: the cases, and how one of them is run in a process of its own."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SCRIPT = Path(__file__).resolve().parent / "case.py"
LONG_RUN = 30.0  # seconds; a case that takes longer runs once
TIMEOUT = 900.0  # seconds
# Threads of a linear algebra library that wait for a busy core made the same run take ten times as long.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
SIZES = {4: 1, 8: 3, 12: 5, 20: 9, 30: 14}  # size n of the covariance: masses
LARGEST_STATED = 12  # largest n at which the covariance as states is solved to the end
ONE_ITERATION = 20  # n at which the covariance as states is given one iteration
CHAIN_INTERVALS, OSCILLATOR_INTERVALS = 50, 100


@dataclass(frozen=True, kw_only=True)
class Case:
    """One thing to measure: a script in its own process, with the results of its runs."""

    part: str
    code: str
    size: int = 0  # n of the covariance
    options: dict[str, Any] = field(default_factory=dict)  # what case.py reads; empty: `code` is a statement to run
    results: list[dict[str, Any]] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Its name in the log."""
        return " ".join([self.part, self.code, *([f"n={self.size}"] if self.size else [])])

    @property
    def finished(self) -> bool:
        """Whether more runs are useless: it fails, or it takes too long."""
        return any("error" in result or result["seconds"] > LONG_RUN for result in self.results)

    @property
    def error(self) -> str | None:
        """Why it failed."""
        return next((result["error"] for result in self.results if "error" in result), None)

    def median(self, key: str = "seconds") -> float | None:
        """Median of one entry of the results."""
        values = [result[key] for result in self.results if result.get(key) is not None]
        return statistics.median(values) if values and self.error is None else None

    def run(self) -> dict[str, Any]:
        """Run once in a child process; the result, or the last line of its error."""
        command = [str(SCRIPT), json.dumps(self.options)] if self.options else ["-c", self.code]
        # Compiled modules are kept, as in an installed package: else every import of the checkout compiles its sources.
        environment = {name: text for name, text in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        settings: dict[str, Any] = {"capture_output": True, "text": True, "timeout": TIMEOUT, "check": False}
        start = time.perf_counter()
        try:
            child = subprocess.run([sys.executable, *command], env=environment | ONE_THREAD, **settings)
        except subprocess.TimeoutExpired:
            return {"error": f"stopped after {TIMEOUT:.0f} s"}
        seconds = time.perf_counter() - start
        if child.returncode:
            return {"error": (child.stderr.strip().splitlines() or [f"exit code {child.returncode}"])[-1]}
        if not self.options:
            return {"seconds": seconds}
        result: dict[str, Any] = json.loads(child.stdout.strip().splitlines()[-1])
        return result


def oscillator_cases() -> list[Case]:
    """Part a: damped oscillator, unknown damping and stiffness."""
    options = {"system": "oscillator", "intervals": OSCILLATOR_INTERVALS}
    codes = ("covocp", "packed", "naive", "eliminated")
    return [Case(part="a", code=code, size=4, options={"code": code, **options}) for code in codes]


def chain_cases(sizes: Sequence[int]) -> list[Case]:
    """Part b: chain of masses."""
    cases = []
    for n in sizes:
        options = {"system": "chain", "masses": SIZES[n], "intervals": CHAIN_INTERVALS}
        codes = ["covocp", "eliminated", *(["packed", "rockit"] if n <= LARGEST_STATED else [])]
        cases += [Case(part="b", code=code, size=n, options={"code": code, **options}) for code in codes]
        if n == LARGEST_STATED:
            one_function = {"code": "rockit", **options, "wrapped": True}
            cases.append(Case(part="b", code="rockit, one function", size=n, options=one_function))
        if n == ONE_ITERATION:
            one = {"code": "packed", **options, "max_iter": 1}
            cases.append(Case(part="b", code="packed, one iteration", size=n, options=one))
    return cases


def building_cases(largest: int) -> list[Case]:
    """Part c: from the model to its frozen statement, and the import."""
    systems: dict[int, dict[str, Any]] = {
        4: {"system": "oscillator"},
        largest: {"system": "chain", "masses": SIZES[largest]},
    }
    return [
        *[Case(part="c", code="statement", size=n, options={"code": "statement", **s}) for n, s in systems.items()],
        Case(part="c", code="import covocp"),
        Case(part="c", code="import casadi, numpy"),
    ]
