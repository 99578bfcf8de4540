"""How long does a step take in C? Controllers, filters, laws and a solver, against CasADi's virtual machine and Python.

    python benchmarks/peers/export.py             measures and writes docs/export_times.md
    python benchmarks/peers/export.py --quick     a tenth of a second for each number; prints only

Nanoseconds of one call, medians of five measurements. The targets are a step of the first-order controller below 1
microsecond, of the Mars controller and an update of the peak seeker below 20; what misses its target is printed, the
exit code is always 0.
"""

from __future__ import annotations

import argparse
import datetime
import os
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from report import git, processor, version

import covocp as co
from covocp.blocks import kalman, peak_seeking, theta_d
from covocp.export import CPackage, export_c
from covocp.models import agile_aircraft, formation_flight, mars_entry, unknown_lag

REPEATS = 5
SEEKER = "peak seeker, 2 inputs, window 15"
TARGETS = {
    ("first-order controller", "step"): 1e3,
    ("Mars controller", "step"): 20e3,
    (SEEKER, "update"): 20e3,
}  # ns
DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "export_times.md"


def packages(folder: Path) -> dict[str, Callable[[], CPackage]]:
    """What is measured, by name."""
    lag = co.solve(unknown_lag.steering(), intervals=100, progress=False)
    mars = co.evaluate(mars_entry.problem(), nominal=mars_entry.reference())
    return {
        "first-order controller": lambda: export_c(lag, folder / "lag"),
        "first-order controller, samples of 10 ms": lambda: export_c(lag, folder / "lag_sampled", period=0.01),
        "Mars controller": lambda: export_c(mars, folder / "mars"),
        "Mars controller, samples of 0.5 s": lambda: export_c(mars, folder / "mars_sampled", period=0.5),
        "Mars controller, single precision": lambda: export_c(mars, folder / "mars_single", precision="single"),
        "Kalman filter, 4 states, 2 readings": lambda: export_c(kalman_functions(), folder / "kalman"),
        "θ-D servo and filter, 5 states": lambda: export_c(theta_d_functions(), folder / "theta"),
        SEEKER: lambda: export_c(peak_seeking_functions(), folder / "seeker"),
        "re-planning of the lag, 20 intervals": lambda: export_c(unknown_lag.problem(), folder / "plan", intervals=20),
    }


def kalman_functions() -> list[ca.Function]:
    """Predict and update of a point in the plane."""
    phi = np.kron(np.eye(2), [[1.0, 0.1], [0.0, 1.0]])
    H = np.kron(np.eye(2), [[1.0, 0.0]])
    x, P, y = ca.SX.sym("x", 4), ca.SX.sym("P", 4, 4), ca.SX.sym("y", 2)
    return [
        ca.Function("predict", [x, P], kalman.predict(x, P, phi, 0.01 * np.eye(4))),
        ca.Function("update", [x, P, y], kalman.update(x, P, y, H, np.eye(2), missing="skip")),
    ]


def theta_d_functions() -> list[ca.Function]:
    """Servo and filter gain of the agile aircraft."""
    x = ca.SX.sym("x", 5)
    A0, bilinear, B, H = agile_aircraft.matrices()
    A, s = x[1] * ca.DM(bilinear), agile_aircraft.tracking()
    return [
        theta_d.servo(x, A0, A, B, [0, 0, 0, 1, 0], s.Q, s.R, k=1.0, l=0.01),
        theta_d.filter_gain(x, A0, A, H, s.W, s.V, k=1.0, l=0.01),
    ]


def peak_seeking_functions() -> list[ca.Function]:
    """Update and step of the formation flight."""
    law = peak_seeking.seeker(2, **peak_seeking.with_changes(formation_flight.RECOMMENDED, {}))
    return [law.update, law.step]


def measured(name: str, package: CPackage, seconds: float) -> tuple[list[str], list[str]]:
    """Rows of the table, and what the targets say."""
    check = package.check()
    runs = [package.time(seconds) for _ in range(REPEATS)]
    rows, verdicts = [], []
    for law in package.laws:
        c, machine, python = (
            statistics.median(getattr(run[law.name], way) for run in runs) for way in ("c", "virtual_machine", "python")
        )
        size, stack = check.build.object_bytes, check.build.stack_bytes
        numbers: list[Any] = [f"{c:,.0f}", f"{machine:,.0f}", f"{python:,.0f}", f"{check.laws[law.name].deviation:.1g}"]
        rows.append(f"| {name} | `{law.name}` | " + " | ".join([*numbers, f"{size}", f"{stack}"]) + " |")
        target = TARGETS.get((name, law.name))
        if target is not None:
            verdict = "meets" if c < target else "MISSES"
            verdicts.append(f"{name}: {c:.0f} ns {verdict} its target of {target:.0f} ns")
    return rows, verdicts


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="short measurements, nothing is written")
    quick = parser.parse_args().quick
    load = os.getloadavg()[0]
    lines = [
        "| what | function | C, ns | virtual machine, ns | Python, ns | deviation | object, bytes | stack, bytes |"
    ]
    lines.append("|---" * 8 + "|")
    verdicts = []
    with tempfile.TemporaryDirectory() as folder:
        for name, make in packages(Path(folder)).items():
            rows, judged = measured(name, make(), 0.1 if quick else 0.5)
            lines += rows
            verdicts += judged
    table = "\n".join(lines)
    print(table)
    print("\n".join(verdicts))
    if quick:
        return
    conditions = f"""Written by `benchmarks/peers/export.py`: medians of {REPEATS} measurements of one call, at points
where nothing is wrong. Virtual machine: CasADi's function without what Python adds. Object and stack are those of the
whole package.

- commit {git("rev-parse", "--short=12", "HEAD") or "unknown"}, {datetime.date.today().isoformat()}
- {version("casadi")}, {version("numpy")}, gcc -O2
- {processor()}, load at the start {load:.1f}"""
    targets = "\n".join(f"- {line}" for line in verdicts)
    DOCUMENT.write_text(f"# Times of exported laws\n\n{conditions}\n\n{table}\n\n{targets}\n", encoding="utf-8")
    print(f"written: {DOCUMENT}")


if __name__ == "__main__":
    main()
