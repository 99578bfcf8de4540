"""Runs whose cost and trajectory are all that a test looks at."""

from __future__ import annotations

from typing import Any

import covocp as co


def optimum(problem: co.Problem, method: str = "ipopt", guess: Any = None, **options: Any) -> co.Solution:
    """What `solve` finds, without what it looks at after a run: mesh errors, curvature, doubts take longer."""
    return co.Solver(problem, method, **options).solve(guess=guess, progress=False, assess=False)
