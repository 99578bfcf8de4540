"""The peak seeker against the same update in numpy: time of one reading and step, two inputs, window 15, in one run.

    python benchmarks/peers/peak_seeking.py            prints a table; needs a C compiler for the compiled rows
    python benchmarks/peers/peak_seeking.py --quick    a quarter of the batches

All get the same readings in the same order and give the same increments (checked to 1e-9); each time is the median
over batches, per reading, and the batches take turns. Targets: the compiled functions take less than 20 microseconds,
and are at least 10 times faster than numpy.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import casadi as ca
import numpy as np
from buffers import bound
from report import git, processor, version
from theta_d import compiled

from covocp.blocks import peak_seeking

MOST, RATIO = 20e-6, 10.0
BATCHES, READINGS = 20, 200
WINDOW, NOISE = 15, 1.0
DRIFT = np.array([0.02, 0.02, 0.02, 0.5, 0.5])
PRIOR = np.array([25.0, 25.0, 25.0, 900.0, 900.0])
CURVATURE, STEP = 0.8, 1.5
Batch = Callable[[np.ndarray, np.ndarray], np.ndarray]


def seeker() -> peak_seeking.Seeker:
    """The law of the formation flight, as the paper's filter with exact transport."""
    return peak_seeking.seeker(
        2, WINDOW, noise=NOISE, drift=DRIFT, prior_covariance=PRIOR, prior=np.zeros(5), reuse=False,
        smallest_curvature=CURVATURE, largest_step=STEP,
    )  # fmt: skip


def in_numpy(positions: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The same law by matrices: one batch update with a solve, eigenvalues by LAPACK."""
    zeta, P, increments = np.zeros(5), np.diag(PRIOR), np.zeros((len(values), 2))
    transition = np.eye(5)
    for k in range(1, len(values)):
        d = positions[k] - positions[k - 1]
        transition[3, 0], transition[3, 2], transition[4, 1], transition[4, 2] = d[0], d[1], d[1], d[0]
        zeta, P = transition @ zeta, transition @ P @ transition.T + np.diag(DRIFT)
        steps = positions[max(0, k - WINDOW) : k] - positions[k]
        y = values[max(0, k - WINDOW) : k] - values[k]
        H = np.column_stack([0.5 * steps**2, steps[:, 0] * steps[:, 1], steps])
        gain = np.linalg.solve(H @ P @ H.T + 2 * NOISE * np.eye(len(y)), H @ P).T
        zeta = zeta + gain @ (y - H @ zeta)
        left = np.eye(5) - gain @ H
        P = left @ P @ left.T + 2 * NOISE * gain @ gain.T
        curvatures, directions = np.linalg.eigh([[zeta[0], zeta[2]], [zeta[2], zeta[1]]])
        step = -directions @ ((directions.T @ zeta[3:]) / np.maximum(np.abs(curvatures), CURVATURE))
        increments[k] = step * min(1.0, STEP / np.linalg.norm(step))
    return increments


def by_functions(update: ca.Function, step: ca.Function, memory: np.ndarray) -> Batch:
    """The two functions called through their buffers: no object is made in a call."""
    own, place, value, increment = memory.copy(), np.zeros(2), np.zeros(1), np.zeros(2)
    new = np.zeros(memory.size)
    learning, acting = bound(update, (own, place, value), new), bound(step, (new,), increment)

    def batch(positions: np.ndarray, values: np.ndarray) -> np.ndarray:
        own[:] = memory
        increments = np.zeros((len(values), 2))
        for k in range(len(values)):
            place[:], value[:] = positions[k], values[k]
            learning()
            acting()
            own[:], increments[k] = new, increment
        return increments

    return batch


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a quarter of the batches")
    options = parser.parse_args(arguments)
    load, law, generator = os.getloadavg()[0], seeker(), np.random.default_rng(1)
    positions = np.cumsum(0.5 * generator.standard_normal((READINGS, 2)), axis=0)
    values = 0.5 * np.einsum("ki,i,ki->k", positions, [0.9, 5.2], positions) + generator.standard_normal(READINGS)
    with tempfile.TemporaryDirectory() as directory:
        in_c = [compiled(function, Path(directory)) for function in (law.update, law.step)]
        batches: dict[str, Batch] = {
            "numpy": in_numpy,
            "covocp, CasADi": by_functions(law.update, law.step, law.initial()),
            "covocp, compiled": by_functions(*in_c, law.initial()),
        }
        times: dict[str, list[float]] = {name: [] for name in batches}
        reference = in_numpy(positions, values)
        for _ in range(BATCHES // 4 if options.quick else BATCHES):
            for name, batch in batches.items():
                start = time.perf_counter()
                found = batch(positions, values)
                times[name].append((time.perf_counter() - start) / READINGS)
                assert np.abs(found - reference).max() < 1e-9, name
    medians = {name: float(np.median(values)) for name, values in times.items()}
    print("| update and step, two inputs, window 15 | a reading, µs | times faster |\n|---|---|---|")
    for name, seconds in medians.items():
        print(f"| {name} | {1e6 * seconds:.2f} | {medians['numpy'] / seconds:.1f} |")
    fastest = medians["covocp, compiled"]
    met = fastest < MOST and medians["numpy"] / fastest >= RATIO
    print(f"\ntargets, at most {1e6 * MOST:g} µs and {RATIO:g} times faster: {'met' if met else 'MISSED'}")
    print(
        f"commit {git('rev-parse', '--short=12', 'HEAD') or 'unknown'}, Python {platform.python_version()}, "
        f"{', '.join(version(package) for package in ('casadi', 'numpy', 'scipy'))}, {processor()}, load {load:.1f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
