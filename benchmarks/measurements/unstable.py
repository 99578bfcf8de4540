"""Do unstable plants converge from runs that a feedback holds, and to what, beside runs that are left to themselves?

    python benchmarks/measurements/unstable.py

Pendulums that are balanced, poles on carts with the force in three units, plants x' = a x + u, and pendulums that are
let down, which nothing holds: iterations and cost from the default start, and from the one without feedback. Prints a
markdown table.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import covocp as co
from covocp.transcription.mesh import Options
from covocp.transcription.starts import own_start
from covocp.transcription.stiffness import resolve_mesh

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "transcription"))
from test_held import balanced_cart, growing, pendulum

INTERVALS = 100


def let_down(start: float, end: float, duration: float) -> co.Problem:
    """A pendulum from near its upper rest to another angle, at rest, with the least energy."""
    ocp = co.Problem(duration, name="let down")
    x = ocp.state("x", 2, initial=[start, 0.0], final=[end, 0.0])
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], 9.81 * ca.sin(x[0]) - 0.1 * x[1] + u))
    ocp.minimize(running=u**2)
    return ocp


def cases() -> Iterator[tuple[str, co.Problem]]:
    """Names and problems."""
    for duration in (5.0, 10.0, 20.0):
        for frequency in (1.0, 2.0, 4.0):
            yield f"pendulum, {frequency:g} rad/s, {duration:g} s", pendulum(frequency, duration)
    for unit in (1e-3, 1.0, 1e3):
        yield f"pole on a cart, 10 s, unit of the force {unit:g}", balanced_cart(unit)
    for rate, duration in ((1.0, 50.0), (2.0, 12.0), (3.0, 8.0), (3.0, 50.0), (5.0, 6.0)):
        yield f"x' = {rate:g} x + u, {duration:g} s", growing(rate, duration)
    for start in (0.05, 0.3):
        for end in (np.pi, 2 * np.pi):
            yield f"let down from {start:g} to {end:.3g}, 5 s", let_down(start, end, 5.0)


def solved(problem: co.Problem, guess: dict[str, Any] | None = None) -> str:
    """Cost, iterations and seconds of a solve, or that it failed."""
    begin = time.perf_counter()
    try:
        found = co.solve(problem, "ipopt", intervals=INTERVALS, guess=guess, progress=False)
        words = f"{found.cost:.6g} | {found.stats['iterations']}"
    except co.SolveError:
        words = "failed | -"
    return f"{words} | {time.perf_counter() - begin:.2f}"


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    print("| problem | held | cost | iterations | s | without: cost | iterations | s |")
    print("|---|---|---|---|---|---|---|---|")
    for name, problem in cases():
        statement = problem.statement()
        mesh = resolve_mesh(statement, Options(intervals=INTERVALS), statement.values)
        held = own_start(statement, mesh, statement.values).held
        left = own_start(statement, mesh, statement.values, hold=False).trajectory
        without = solved(problem, {"x": left.x, "u": left.u})
        print(f"| {name} | {'yes' if held else 'no'} | {solved(problem)} | {without} |", flush=True)


if __name__ == "__main__":
    main()
