"""How many intervals does a mesh that refines itself need, how many equal ones, and is the error the one it states?

    python benchmarks/measurements/refinement.py

Prints a table of the plain problems of `benchmarks/peers/plain_problems.py`, whose optima no solver computed, and
the ratio of the true error of the cost to the estimated one, for several tolerances and both forms of the control.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import covocp as co

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "peers"))
from plain_problems import PLAIN, stated

ASKED, FIRST, GROW, MOST = 1e-6, 20, 1.25, 3000
RATIOS = {"linear": (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8), "constant": (1e-2, 1e-3, 1e-4)}


def even(name: str) -> str:
    """The least number of equal intervals, of a series that grows by a quarter, with the error that is asked for."""
    count = FIRST
    while count <= MOST:
        try:
            off = abs(
                co.solve(stated(name), intervals=count, progress=False, tolerance=1e-8).cost / PLAIN[name].optimum - 1
            )
            if off <= ASKED:
                return str(count)
        except co.SolveError:
            pass
        if name == "hypersensitive" and count > 100:
            break
        count = int(GROW * count)
    return f"more than {count if name == 'hypersensitive' else MOST}"


def main() -> None:
    """Measure and print."""
    warnings.simplefilter("ignore")
    print("| problem | refined: intervals | true error | estimated | equal intervals |\n|---|---|---|---|---|")
    for name, plain in PLAIN.items():
        solution = co.solve(stated(name), refine=ASKED, progress=False)
        off = abs(solution.cost / plain.optimum - 1)
        estimate = solution.stats["mesh_errors"][-1]
        print(f"| {name} | {solution.mesh.intervals} | {off:.1e} | {estimate:.1e} | {even(name)} |", flush=True)
    for control, tolerances in RATIOS.items():
        for asked in tolerances:
            found = {}
            for name, plain in PLAIN.items():
                solution = co.solve(stated(name), refine=asked, control=control, progress=False)
                off = abs(solution.cost / plain.optimum - 1)
                found[name] = off / solution.stats["mesh_errors"][-1]
            worst = max(found, key=lambda name: found[name])
            print(f"{control}, {asked:.0e}: true / estimated at most {found[worst]:.2f} ({worst})", flush=True)


if __name__ == "__main__":
    main()
