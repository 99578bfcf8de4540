"""What default settings call solved, measured against truth: a table for each of three questions.

- *Unstable plants*: x' = a x + u with x(0) = x(T) = 1, whose optimum is sqrt(a^2 + 1) for long durations; both methods.
- *Premature*: random starts and scalings of six problems. A cost that is called converged is a stationary value: a
  restart with a tolerance of 1e-10 gains nothing, and the value is among those found from other starts.
- *Random problems* (tests/random_problems.py): restart, both formulations, both methods.

`convergence.py [--only plants premature random] [--seeds 200] [--gradient 50] [--starts 200]`
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import covocp as co
from covocp.models import brachistochrone, chord_test, damped_oscillator, noisy_integrator, unknown_gain, unknown_lag

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from random_problems import draw

SIX: dict[str, Callable[[], co.Problem]] = {
    "lag, x(T) = 1": lambda: unknown_lag.problem(final=1.0, weight=10.0),
    "unknown gain": unknown_gain.problem,
    "noisy integrator": noisy_integrator.problem,
    "chord test": chord_test.problem,
    "damped oscillator": damped_oscillator.problem,
    "brachistochrone": brachistochrone.problem,
}

MOST = 300  # iterations from a random start: beyond them it has failed, and says so


def attempt(problem: co.Problem, method: str = "ipopt", **options: Any) -> co.Solution | None:
    """A solution, or None where the method says that it failed."""
    try:
        return co.solve(problem, method, progress=False, **options)
    except co.CovocpError:
        return None


def plant(a: float, duration: float) -> co.Problem:
    """x' = a x + u from 1 to 1, J = int (u^2 + x^2)/2."""
    ocp = co.Problem(duration=duration)
    x, u = ocp.state("x", initial=1.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, a * x + u)
    ocp.minimize(running=0.5 * u**2 + 0.5 * x**2)
    return ocp


def plants() -> None:
    """24 unstable plants by both methods."""
    print("| method | right within 1 % | failed, and said so | wrong |\n|---|---|---|---|")
    for method in co.methods():
        count: Counter[str] = Counter()
        for a in (1.0, 2.0, 3.0):
            for duration in (4.0, 6.0, 7.0, 8.0, 9.0, 10.0, 12.0, 16.0):
                found = attempt(plant(a, duration), method, intervals=50)
                right = found is not None and abs(found.cost / np.hypot(a, 1) - 1) < 1e-2
                count["failed" if found is None else "right" if right else "wrong"] += 1
        print(f"| {method} | {count['right']} | {count['failed']} | {count['wrong']} |", flush=True)


def premature(starts: int) -> None:
    """Random starts and scalings: what is called converged is stationary."""
    print("\n| problem | starts | converged | failed, and said so | basins | largest gain of a restart | wrong |")
    print("|---|---|---|---|---|---|---|")
    for name, make in SIX.items():
        random = np.random.default_rng(1)
        gains, costs, failed = [], [], 0
        count = starts // len(SIX) + (list(SIX).index(name) < starts % len(SIX))
        for _ in range(count):
            found = attempt(make(), intervals=30, guess=_start(make(), random), max_iterations=MOST)
            if found is None:
                failed += 1
                continue
            again = co.solve(make(), intervals=30, guess=found, tolerance=1e-10, progress=False, allow_failure=True)
            gains.append(abs(found.cost - again.cost) / abs(found.cost))
            costs.append(found.cost)
        basins = len({f"{cost:.5g}" for cost in costs})
        wrong = sum(gain > 1e-5 for gain in gains)
        print(
            f"| {name} | {count} | {len(costs)} | {failed} | {basins} | {max(gains, default=0.0):.1e} | {wrong} |",
            flush=True,
        )


def _start(problem: co.Problem, random: np.random.Generator) -> dict[str, Any]:
    """A guess of the controls: two random cosines, of a size between 1e-3 and 1e6 of the unit."""
    size = 10 ** random.uniform(-3, 6)
    s = np.linspace(0, 1, 31)[:, None]

    def wave(count: int) -> Any:
        return size * sum(random.normal(size=(1, count)) * np.cos(np.pi * k * s) for k in range(3))

    return {block.name: wave(block.size) for block in problem.statement().controls}


def random_problems(seeds: int, gradient: int) -> None:
    """Restart, formulations, methods."""
    rows: dict[str, list[float]] = {"restart with 1e-10": [], "states against eliminated": [], "gradient": []}
    failures: Counter[str] = Counter()
    others: Counter[str] = Counter()
    for seed in range(seeds):
        found = attempt(draw(seed).problem, intervals=30)
        if found is None:
            failures["restart with 1e-10"] += 1
            continue
        other = {"intervals": 30, "progress": False, "allow_failure": True}
        again = co.solve(draw(seed).problem, **other, guess=found, tolerance=1e-10)
        rows["restart with 1e-10"].append((found.cost - again.cost) / abs(found.cost))
        for name, method, options in (
            ("states against eliminated", "ipopt", {"covariances": "states"}),
            ("gradient", "gradient", {}),
        ):
            if name == "gradient" and len(rows[name]) + failures[name] >= gradient:
                continue
            second = attempt(draw(seed).problem, method, intervals=30, **options)
            if second is None:
                failures[name] += 1
                continue
            gap = abs(second.cost / found.cost - 1)
            if gap > 1e-6:  # another minimum, where shooting stays when it starts there
                there = co.solve(draw(seed).problem, **other, guess=second)
                if there.converged and abs(there.cost / second.cost - 1) < 1e-6:
                    others[name] += 1
                    gap = abs(there.cost / second.cost - 1)
            rows[name].append(gap)
    print("\n| question | answers | failed, and said so | other minima | largest difference |\n|---|---|---|---|---|")
    for name, values in rows.items():
        largest = max(values, default=0.0)
        print(f"| {name} | {len(values)} | {failures[name]} | {others[name]} | {largest:.1e} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=["plants", "premature", "random"])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--gradient", type=int, default=50)
    parser.add_argument("--starts", type=int, default=200)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if "plants" in options.only:
        plants()
    if "premature" in options.only:
        premature(options.starts)
    if "random" in options.only:
        random_problems(options.seeds, options.gradient)


if __name__ == "__main__":
    main()
