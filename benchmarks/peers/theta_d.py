"""θ-D against the Riccati equation solved at every step: time of one control of the agile aircraft, in one run.

    python benchmarks/peers/theta_d.py            prints a table; needs a C compiler for the compiled rows
    python benchmarks/peers/theta_d.py --quick    fewer repetitions

Every law gets the same states in the same order; each time is the median over batches, per call, and the batches of the
laws take turns. Target: the compiled θ-D law is at least 100 times faster than scipy's `solve_continuous_are`.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
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
from scipy.linalg import solve_continuous_are

from covocp.blocks import theta_d
from covocp.models import agile_aircraft

TARGET = 100.0
BATCHES = 40
# Calls in a batch: of the Riccati solver, and of the laws that take less than a microsecond or two.
SLOW, FAST = 25, 2000


def states(count: int) -> np.ndarray:
    """Random states around the trajectory of scenario 1."""
    generator = np.random.default_rng(1)
    return generator.standard_normal((count, 5)) * np.array([10.0, 0.2, 0.3, 0.2, 20.0])


def riccati_batch(samples: np.ndarray) -> None:
    """u = -R^-1 B' P(x) x with the Riccati equation of A0 + x_2 A_NL."""
    A0, bilinear, B, _ = agile_aircraft.matrices()
    scenario = agile_aircraft.regulation()
    R = np.array([[scenario.R]])
    for x in samples[:SLOW]:
        P = solve_continuous_are(A0 + x[1] * bilinear, B, scenario.Q, R)
        -(B.T @ P @ x) / scenario.R


def buffered(law: ca.Function) -> Callable[[np.ndarray], None]:
    """A law called through its buffers: no object is made in a call."""
    x, t, u = np.zeros(5), np.zeros(1), np.zeros(1)
    evaluate = bound(law, (x, t), u)

    def batch(samples: np.ndarray) -> None:
        for sample in samples[:FAST]:
            x[:] = sample
            evaluate()

    return batch


def compiled(law: ca.Function, directory: Path) -> ca.Function:
    """The same law from generated C."""
    name = f"{law.name()}_{law.n_instructions()}"
    generator = ca.CodeGenerator(f"{name}.c")
    generator.add(law)
    generator.generate(f"{directory}/")
    library = directory / f"{name}.so"
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", library, directory / f"{name}.c", "-lm"], check=True)
    return ca.external(law.name(), str(library))


def laws(directory: Path) -> dict[str, tuple[Callable[[np.ndarray], None], int]]:
    """Batches by the names of the rows, with the number of calls in each."""
    A0, bilinear, B, _ = agile_aircraft.matrices()
    scenario = agile_aircraft.regulation()
    x = ca.SX.sym("x", 5)
    arguments = x, A0, x[1] * ca.DM(bilinear), B, scenario.Q, scenario.R
    found = {"Riccati equation at every x, scipy": (riccati_batch, SLOW)}
    for form in ("polynomial", "operator"):
        law = theta_d.regulator(*arguments, k=agile_aircraft.FACTOR, l=agile_aircraft.DECAY, form=form)
        found[f"θ-D, {form} form, three terms, CasADi"] = (buffered(law), FAST)
        found[f"θ-D, {form} form, three terms, compiled"] = (buffered(compiled(law, directory)), FAST)
    law = theta_d.regulator(*arguments, terms=10)
    found["θ-D, polynomial form, ten terms, compiled"] = (buffered(compiled(law, directory)), FAST)
    return found


def measure(batches: dict[str, tuple[Callable[[np.ndarray], None], int]], count: int) -> dict[str, float]:
    """Median time of a call [s], by row."""
    samples = states(FAST)
    times: dict[str, list[float]] = {name: [] for name in batches}
    for _ in range(count):
        for name, (batch, calls) in batches.items():
            start = time.perf_counter()
            batch(samples)
            times[name].append((time.perf_counter() - start) / calls)
    return {name: float(np.median(values)) for name, values in times.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a quarter of the batches")
    options = parser.parse_args(arguments)
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as directory:
        times = measure(laws(Path(directory)), BATCHES // 4 if options.quick else BATCHES)
    reference = next(iter(times.values()))
    print("| law of the agile aircraft, five states | a call, µs | times faster |\n|---|---|---|")
    for name, seconds in times.items():
        print(f"| {name} | {1e6 * seconds:.3f} | {reference / seconds:.0f} |")
    ratio = reference / times["θ-D, polynomial form, three terms, compiled"]
    print(f"\ncompiled θ-D law {ratio:.0f} times faster: target {TARGET:g} {'met' if ratio >= TARGET else 'MISSED'}")
    print(
        f"commit {git('rev-parse', '--short=12', 'HEAD') or 'unknown'}, Python {platform.python_version()}, "
        f"{', '.join(version(package) for package in ('casadi', 'numpy', 'scipy'))}, {processor()}, load {load:.1f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
