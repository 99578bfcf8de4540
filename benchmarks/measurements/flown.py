"""Promised and flown deviations of ten closed loops with steep ends: in Python and by the compiled C, two ways each.

The random linear systems of `expected_cost` whose default mesh was graded at both ends. Each controller is
exported for any times and for samples of a period, compiled, and called once a period: short enough that the largest
feedback pole times the period is POLE. The law is linear, so the joint covariance of plant, estimate and held control
follows exactly from what the compiled function answers to unit estimates, controls and measurements at each call, and
from the matrix exponential of the plant with its measurement averaged over the period. In Python the loop flies with
the gains as they are interpolated between the nodes. Printed are the largest factors between the standard deviations,
as flown and as promised, at the end and anywhere at the nodes.

    python benchmarks/measurements/flown.py
"""

from __future__ import annotations

import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from expected_cost import System, problem, random_system
from scipy.linalg import expm

import covocp as co
from covocp.solution.flight import interpolated_flight

LOOPS, POLE, MOST = 10, 0.02, 60_000


def over_period(s: System, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Of the state and the mean of the measurement: slopes by state and held control, covariance from noise."""
    n, m, r = s.F.shape[0], s.G.shape[1], s.M.shape[0]
    drift = np.zeros((n + r, n + r))
    drift[:n, :n], drift[n:, :n] = s.F, s.M
    held = np.block([[drift, np.vstack([s.G, np.zeros((r, m))])], [np.zeros((m, n + r + m))]])
    mean = np.diag([1.0] * n + [1.0 / period] * r)
    slopes = mean @ expm(held * period)[: n + r][:, [*range(n), *range(n + r, n + r + m)]]
    spread = np.block([[s.Q, np.zeros((n, r))], [np.zeros((r, n)), s.U]])
    big = expm(np.block([[-drift, spread], [np.zeros_like(drift), drift.T]]) * period)
    move = big[n + r :, n + r :].T
    return slopes, mean @ move @ big[: n + r, n + r :] @ mean.T


def answers(controller: Any, when: float) -> np.ndarray:
    """Slopes of (estimate, control) after a call by (estimate, control, measurement) before it."""
    places, row = controller._places, np.zeros(controller._size)
    for place, field in controller._kept:
        row[place] = controller._values[field]
    for name in ("estimate", "held"):  # those of the nominal, zero; alone the law may be unstable
        row[places[name]] = 0.0
    row[places["time"]] = when
    results, status = controller._backend(row)
    chosen = [*range(*controller._estimate.indices(10**6)), *range(*controller._control.indices(10**6))]
    columns = []
    names = [name for name in ("estimate", "held", "control", "measurement") if name in places]
    for i in (i for name in names for i in range(places[name].start, places[name].stop)):
        row[i] += 1.0
        columns.append(controller._backend(row)[0][chosen] - results[chosen])
        row[i] -= 1.0
    controller._backend(row)
    controller._values = np.append(results, status)
    return np.array(columns).T


def flown(s: System, controller: Any, period: float, times: np.ndarray) -> np.ndarray:
    """Standard deviations of the state at some times, linear between calls."""
    n, m = s.F.shape[0], s.G.shape[1]
    slopes, noise = over_period(s, period)
    joint = np.zeros((2 * n + m, 2 * n + m))
    joint[:n, :n] = s.prior
    count = round(s.duration / period)
    variances = [np.diagonal(s.prior)]
    for k in range(1, count + 1):
        law = answers(controller, k * period)
        on_estimate, on_control, on_mean = law[:, :n], law[:, n : n + m], law[:, n + m :]
        by_state, by_held = slopes[:, :n], slopes[:, n:]
        move = np.block(
            [
                [by_state[:n], np.zeros((n, n)), by_held[:n]],
                [on_mean @ by_state[n:], on_estimate, on_control + on_mean @ by_held[n:]],
            ]
        )
        enters = np.vstack([np.eye(n, noise.shape[0]), on_mean @ np.eye(noise.shape[0])[n:]])
        joint = move @ joint @ move.T + enters @ noise @ enters.T
        variances.append(np.diagonal(joint)[:n])
    at = period * np.arange(count + 1)
    return np.sqrt(np.array([np.interp(times, at, column) for column in np.array(variances).T]).T)


def factors(found: np.ndarray, promised: np.ndarray) -> tuple[float, float]:
    """The largest factor between two deviations, at the end and anywhere (of a hundredth of the largest, at least)."""
    floor = 0.01 * promised.max(axis=0)
    ratio = np.abs(np.log(np.maximum(found, floor) / np.maximum(promised, floor)))
    return float(np.exp(np.abs(np.log(found[-1] / promised[-1])).max())), float(np.exp(ratio.max()))


def row(seed: int, solution: co.Solution, folder: Path) -> str:
    """The columns of one loop."""
    system, promised = random_system(seed), solution.deviation("x")
    poles = np.abs(np.linalg.eigvals(system.G @ solution.gains["C"])).max()
    count = min(MOST, int(np.ceil(system.duration * poles / POLE)))
    period = system.duration / count
    columns = [f"{100 * (interpolated_flight(solution).worst - 1):.1f} %", f"{count}"]
    for name, options in (("any", {}), ("sampled", {"period": period})):
        package = co.export_c(solution, folder / name, **options)
        package.build()
        assert package.check().ok
        controller = package.python().principal
        found = factors(flown(system, controller, period, solution.t), promised)
        columns += [f"{100 * (value - 1):.1f} %" for value in found]
    return " | ".join(columns)


def main() -> None:
    """Print the table."""
    columns = "Python, anywhere | calls | C, any times: end | anywhere | C, sampled: end | anywhere"
    print(f"| system | nodes added | {columns} | warnings and seconds |")
    print("|---|---|---|---|---|---|---|---|---|")
    seed = done = 0
    while done < LOOPS:
        begin = time.perf_counter()
        with warnings.catch_warnings(record=True) as told, tempfile.TemporaryDirectory() as folder:
            warnings.simplefilter("always")
            solution = co.solve(problem(random_system(seed)), progress=False)
            added = solution.stats.get("nodes_added", (0, 0))
            if min(added) > 0:
                done += 1
                columns = row(seed, solution, Path(folder))
                words = "; ".join(str(w.message) for w in told)
                print(f"| {seed} | {added[0]} + {added[1]} | {columns} | {words}", end="", flush=True)
                print(f" {time.perf_counter() - begin:.0f} s", flush=True)
        seed += 1


if __name__ == "__main__":
    main()
