"""The constrained attitude filter against its programs by a conic solver: one update, two zones, N = 10, in one run.

    python benchmarks/peers/attitude_seeking.py            prints a table; needs a C compiler and clarabel
    python benchmarks/peers/attitude_seeking.py --quick    a quarter of the updates

The compiled row is the whole law: window, Kalman filter, zones, (R), and the desired attitude. The rows of the solver
are the program alone, its data made before the clock starts: the literal matrix inequality, and (R) as a second-order
cone program; their solutions agree with that of the law (checked). Medians over updates, which take turns. Targets: at
most 15 microseconds, and at least 1000 and 10 times faster.
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
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

import casadi as ca
import numpy as np
from attitude_programs import Case, Literal, Reduced
from buffers import bound
from report import git, processor, version
from theta_d import compiled

from covocp.blocks import attitude_seeking, so3
from covocp.models import antenna_pointing
from covocp.models.antenna.patch import Patch

FLIGHTS = 60.0  # s, of 128 flights
MOST, RATIOS = 15e-6, {"clarabel, matrix inequality": 1000.0, "clarabel, cone program": 10.0}
WINDOW, SPACING, UPDATES, CALLS = 10, 2, 40, 200
KAPPA, NOISE, LARGEST, PENALTY = 0.05, 0.05, 0.25, 1e5
TOLERANCE = {"clarabel, matrix inequality": 2e-3, "clarabel, cone program": 1e-4}


def seeker() -> attitude_seeking.AttitudeSeeker:
    """The recommended law with the zones of the paper."""
    return attitude_seeking.constrained(antenna_pointing.ZONES)


def readings(generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes of a slow random walk near the peak, and the powers there with their noise."""
    q, found = so3.to_quaternion(so3.principal(3, 1.5) @ so3.principal(1, 0.3)), []
    for _ in range(WINDOW * SPACING + 1):
        q = so3.quaternion_step(q, 0.03 * generator.standard_normal(3))
        q = q / np.linalg.norm(q)
        found.append(q)
    attitudes = np.array(found)
    return attitudes, Patch().evaluate(attitudes)[0] + NOISE * generator.standard_normal(len(found))


def case_of(attitudes: np.ndarray, powers: np.ndarray) -> Case:
    """The numbers of the update that the law makes of these readings, from its prior."""
    newest = so3.from_quaternion(attitudes[-1])
    past = [len(powers) - 1 - SPACING * j for j in range(1, WINDOW + 1)]
    H = np.array([so3.log(newest @ so3.from_quaternion(attitudes[i]).T) for i in past])
    rows = attitude_seeking.zone_rows(newest, attitude_seeking.zones_of(antenna_pointing.ZONES))
    R = NOISE**2 * (np.eye(WINDOW) + 1.0)
    y = powers[-1] - powers[past]
    return Case(
        H, R, 1.02 * np.eye(3), np.zeros(3), y, rows.matrix, rows.bounds.ravel(), KAPPA, PENALTY, LARGEST
    )  # fmt: skip


def of_law(update: ca.Function, step: ca.Function, memory: np.ndarray) -> Callable[[np.ndarray, float], np.ndarray]:
    """The compiled functions called through their buffers, `CALLS` times: no object is made in a call."""
    own, attitude, power, new, desired = memory.copy(), np.zeros(4), np.zeros(1), np.zeros(memory.size), np.zeros(4)
    learning, acting = bound(update, (own, attitude, power), new), bound(step, (new,), desired)

    def run(reading: np.ndarray, value: float) -> np.ndarray:
        attitude[:], power[:] = reading, value
        for _ in range(CALLS):
            learning()
            acting()
        return new

    def begin(given: np.ndarray) -> None:
        own[:] = given

    run.begin = begin  # type: ignore[attr-defined]
    return run


def measured(law: attitude_seeking.AttitudeSeeker, in_c: Sequence[ca.Function], updates: int) -> dict[str, list[float]]:
    """Times of each update by the names of the rows, solutions compared."""
    run, generator = of_law(in_c[0], in_c[1], law.initial()), np.random.default_rng(0)
    times: dict[str, list[float]] = {"covocp, compiled law": [], **{name: [] for name in RATIOS}}
    for _ in range(updates):
        attitudes, powers = readings(generator)
        memory = law.initial()
        for q, power in zip(attitudes[:-1], powers[:-1], strict=True):
            memory = law.read(memory, q, power)
        run.begin(memory)  # type: ignore[attr-defined]
        start = time.perf_counter()
        new = run(attitudes[-1], powers[-1])
        times["covocp, compiled law"].append((time.perf_counter() - start) / CALLS)
        b, case = law.estimate(new).gradient, case_of(attitudes, powers)
        for name, program in zip(RATIOS, (Literal(case), Reduced(case)), strict=True):
            start = time.perf_counter()
            found = program.solve()[0]
            times[name].append(time.perf_counter() - start)
            other = case.before + found @ case.residual if found.ndim == 2 else found
            assert np.abs(other - b).max() < TOLERANCE[name], name
    return times


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a quarter of the updates")
    options = parser.parse_args(arguments)
    load, law = os.getloadavg()[0], seeker()
    with tempfile.TemporaryDirectory() as directory:
        in_c = [compiled(function, Path(directory)) for function in (law.update, law.step)]
        times = measured(law, in_c, UPDATES // 4 if options.quick else UPDATES)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    own = medians["covocp, compiled law"]
    print("| an update, two zones, N = 10 | µs | times the law |\n|---|---|---|")
    for name, seconds in medians.items():
        print(f"| {name} | {1e6 * seconds:.1f} | {seconds / own:.0f} |")
    met = own <= MOST and all(medians[name] / own >= ratio for name, ratio in RATIOS.items())
    wanted = " and ".join(f"{ratio:g}" for ratio in RATIOS.values())
    print(f"\ntargets, at most {1e6 * MOST:g} µs and {wanted} times faster: {'met' if met else 'MISSED'}")
    start = time.process_time()
    antenna_pointing.simulate("constrained", runs=128)
    flown = time.process_time() - start
    verdict = "met" if flown <= FLIGHTS else "MISSED"
    print(f"128 flights of 200 s: {flown:.1f} s of processor time, target {FLIGHTS:g} s {verdict}")
    print(
        f"commit {git('rev-parse', '--short=12', 'HEAD') or 'unknown'}, Python {platform.python_version()}, "
        f"{', '.join(version(package) for package in ('casadi', 'numpy', 'clarabel'))}, {processor()}, load {load:.1f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
