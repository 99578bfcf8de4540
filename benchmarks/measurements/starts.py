"""Do ordinary problems converge from the default start, and to the best of many starts?

    python benchmarks/measurements/starts.py [--starts 20] [--only vehicles|overhead]

Thirty vehicles of constant speed that turn to a point: 5 to 95 % of their reach in that direction, all directions, four
bounds of the turn rate, half of them with a beacon whose distance they measure. The default start against the best of
random starts; then what the ranking of starts costs problems that do not need it. Prints markdown tables.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
import warnings
from pathlib import Path

import numpy as np

import covocp as co
from covocp.transcription.starts import own_start

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from vehicles import DURATION, SPEED, vehicle

BOUNDS = (0.1, 0.2, 0.5, np.inf)
COUNT = 30
GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
MODELS = ("unknown_lag", "mass_chain", "damped_oscillator", "mars_entry", "goddard_rocket", "lqg_double_integrator")


def reach(angle: float, bound: float) -> float:
    """Largest distance in a direction that an arc and a straight line of the vehicle's whole path reach."""
    radius = 0.0 if np.isinf(bound) else SPEED / bound
    distances = np.linspace(0.0, SPEED * DURATION, 2001)[1:]
    x, y = distances * np.cos(angle), np.abs(distances * np.sin(angle))
    off = np.hypot(x, y - radius)
    line = np.sqrt(np.maximum(off**2 - radius**2, 0.0))
    tangent = np.arctan2(y - radius, x) - np.arccos(np.minimum(radius / off, 1.0))
    length = radius * ((tangent + np.pi / 2) % (2 * np.pi)) + line
    return float(distances[(off >= radius) & (length <= SPEED * DURATION)].max())


def cases() -> list[tuple[float, float, float, bool]]:
    """Distance, direction, bound, whether there is a beacon."""
    found = []
    for k in range(COUNT):
        beacon, i = k >= COUNT // 2, k % (COUNT // 2)
        angle, bound = (k * GOLDEN) % (2 * np.pi) - np.pi, BOUNDS[k % len(BOUNDS)]
        share = 0.05 + 0.9 * i / (COUNT // 2 - 1)
        found.append((share * reach(angle, bound), angle, bound, beacon))
    return found


def vehicles(starts: int) -> None:
    """The table of the vehicles."""
    print("| distance m | direction deg | bound 1/s | beacon | iterations | s | cost | best of random starts |")
    print("|---|---|---|---|---|---|---|---|")
    converged = best = 0
    for case in cases():
        problem = vehicle(*case[:3], beacon=case[3])
        begin = time.perf_counter()
        solution = co.solve(problem, progress=False, allow_failure=True)
        seconds = time.perf_counter() - begin
        many = co.solve(problem, guess="multistart", starts=starts, progress=False, allow_failure=True)
        found = [c for c in many.stats["starts"][1:] if np.isfinite(c)]  # the first is the problem's own
        least = min(found, default=np.nan)
        converged += solution.converged
        best += bool(solution.converged and not solution.cost > 1.01 * least)
        print(
            f"| {case[0]:.0f} | {np.degrees(case[1]):.0f} | {case[2]:g} | {'yes' if case[3] else 'no'} | "
            f"{solution.stats['iterations']} | {seconds:.2f} | {solution.cost:.6f} | {least:.6f} ({len(found)}) |",
            flush=True,
        )
    print(f"\n{converged} of {COUNT} converge from the default start, {best} to the best within 1 %.\n")


def overhead() -> None:
    """What the first start costs problems whose first start is fine."""
    print("| model | plain | first start ms | solve ms | share |")
    print("|---|---|---|---|---|")
    for name in MODELS:
        problem = importlib.import_module(f"covocp.models.{name}").problem()
        solver = co.Solver(problem)
        statement, mesh = solver._solved, solver._prepared.mesh
        solver.solve(progress=False, allow_failure=True)
        first, whole = [], []
        for _ in range(5):
            begin = time.perf_counter()
            own = own_start(statement, mesh, statement.values)
            first.append(time.perf_counter() - begin)
            begin = time.perf_counter()
            solver.solve(progress=False, allow_failure=True)
            whole.append(time.perf_counter() - begin)
        a, b = 1e3 * float(np.median(first)), 1e3 * float(np.median(whole))
        print(f"| {name} | {'yes' if own.plain else 'no'} | {a:.1f} | {b:.0f} | {100 * a / b:.1f} % |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--only", choices=("vehicles", "overhead"))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", co.CovocpWarning)
    if arguments.only != "overhead":
        vehicles(arguments.starts)
    if arguments.only != "vehicles":
        overhead()


if __name__ == "__main__":
    main()
