"""A case to be measured, and how cases are run: each in a process of its own, in random order."""

from __future__ import annotations

import json
import os
import random
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
SEED = 1  # of the order of the runs


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
