"""Simulations with default settings: time of the extended filter, coverage of a mean's band, counts of constraints.

    python benchmarks/measurements/simulation.py

Prints markdown tables. The counts are those of a loop of Euler and Maruyama that knows the gains only (the problem of
`tests/ocp/test_simulate_constraints.py`, at a finer step and with more runs).
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

import casadi as ca
import numpy as np

import covocp as co

SECONDS = 15.0
RUNS = 4000
SEEDS = 1000


def vehicle() -> co.Problem:
    """Three states, two unknowns, two nonlinear measurements, a filter that starts a thousand times as fast."""
    problem = co.Problem(duration=20.0, name="vehicle, unknown speed and drift")
    x = problem.state("x", initial=0.0, final=15.0, variance=0.25)
    y = problem.state("y", initial=0.0, final=8.0, variance=0.25)
    heading = problem.state("heading", initial=0.3, variance=0.01)
    v = problem.unknown("v", mean=1.0, variance=0.01)
    drift = problem.unknown("drift", mean=0.0, variance=0.0025)
    w = problem.control("w", lower=-1.0, upper=1.0)
    problem.dynamics(x, v * ca.cos(heading), noise=1e-4)
    problem.dynamics(y, v * ca.sin(heading) + drift, noise=1e-4)
    problem.dynamics(heading, w, noise=1e-4)
    problem.measurement("range", ca.sqrt((x - 5) ** 2 + (y - 12) ** 2), noise=1e-3)
    problem.measurement("bearing", ca.atan2(y + 6, x - 20), noise=1e-4)
    problem.minimize_expected(running=0.5 * w**2, terminal_weight={x: 4.0, y: 4.0})
    return problem


def scalar() -> co.Solution:
    """A scalar system whose mean is exp(-0.7)."""
    problem = co.Problem(duration=1.0)
    x, u = problem.state("x", initial=1.0, variance=0.5), problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, -0.7 * x, noise=0.2)
    problem.estimation_covariance()
    problem.minimize(running=(u - 0.1) ** 2)
    return co.solve(problem, intervals=4, progress=False)


def filters() -> None:
    """Time and steps of both filters."""
    solution = co.solve(vehicle(), intervals=50, guess={"w": lambda s: 0.1 * np.cos(3 * s)}, progress=False)
    print(f"| filter | step [s] | steps | {RUNS} runs [s] | target [s] | smallest sample/predicted error |")
    print("|---|---|---|---|---|---|")
    for kind in ("perturbation", "extended"):
        for step in (None, 0.2):
            begin = time.perf_counter()
            sample = co.simulate(solution, RUNS, seed=1, filter=kind, step=step, progress=False)
            seconds = time.perf_counter() - begin
            least = min(entry.ratio for entry in sample.verdict.errors)
            shown = "automatic" if step is None else f"{step:g}"
            print(f"| {kind} | {shown} | {sample.step.grid.steps} | {seconds:.1f} | {SECONDS:g} | {least:.3f} |")


def bands() -> None:
    """Coverage of the band of a mean over many seeds of ten runs."""
    solution, held = scalar(), 0
    for seed in range(SEEDS):
        low, high = co.simulate(solution, 10, seed, step=0.25, store=2, paths=0, progress=False).mean_band("x")
        held += int(low[-1] <= np.exp(-0.7) <= high[-1])
    error = 3 * np.sqrt(0.9973 * 0.0027 / SEEDS)
    print(f"\n| mean's band at ten runs, {SEEDS} seeds | promised | binomial error |\n|---|---|---|")
    print(f"| {100 * held / SEEDS:.2f} % | 99.73 % | {100 * error:.2f} % |")


def counts() -> None:
    """Shares of the runs that violate each constraint, beside those of an independent loop."""
    sys.path[:0] = [str(Path(__file__).parents[2] / "tests" / part) for part in ("", "simulation")]
    import test_simulate_constraints as brute

    brute.RUNS = 20_000
    print("\n| constraint | any time | independent loop | at the end | independent loop | promised |")
    print("|---|---|---|---|---|---|")
    for build, loop in ((brute.corridor, brute.brute_corridor), (brute.estimated, brute.brute_estimated)):
        solution = co.solve(build(), intervals=40, progress=False)
        sample = co.simulate(solution, brute.RUNS, 1, step=0.005, progress=False)
        once, ended = loop(solution, np.random.default_rng(7), 0.005)
        for name, flags in once.items():
            entry = sample.violations[name]
            end = f"{100 * ended[name].mean():.2f} %" if name in ended else "-"
            print(
                f"| {name} | {100 * entry.share:.2f} % | {100 * flags.mean():.2f} % | {100 * entry.end_share:.2f} % "
                f"| {end} | {100 * entry.promised_end:.2f} % |"
            )


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    filters()
    bands()
    counts()
