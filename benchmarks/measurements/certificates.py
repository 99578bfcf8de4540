"""Certificates against finer meshes: none may be contradicted beyond its gap; and what certifying takes.

    python benchmarks/measurements/certificates.py            # prints two tables in Markdown

Identification problems on meshes of 1 to 100 intervals, held and linear controls. For each the best cost known is that
of 400 intervals (linear controls), less its own estimated mesh error; a certificate is contradicted where the solution
costs more than that by more than its gap.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import casadi as ca

import covocp as co
from covocp.models import damped_oscillator, unknown_lag

MESHES = (1, 2, 3, 5, 8, 12, 16, 25, 40, 60, 80, 100)
FINE = 400


def tracked(weight: float) -> co.Problem:
    """The lag with a running cost of the state and a bound on the control."""
    ocp = co.Problem(5.0, name=f"tracked lag, {weight:g}")
    x = ocp.state("x", initial=0.5, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=2.0)
    u = ocp.control("u", lower=-1.5, upper=1.5, guess=lambda s: 1.0 - s)
    ocp.dynamics(x, -b * x + u, noise=0.5)
    ocp.measurement("position", x, noise=0.5)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + 0.2 * (x - 1) ** 2, terminal=weight * E[b, b])
    return ocp


def lidded(lid: float) -> co.Problem:
    """The lag under a lid."""
    ocp = co.Problem(10.0, name=f"lag below {lid:g}")
    x = ocp.state("x", initial=0.0, final=0.3, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u", guess=lambda s: 0.3 + 0.1 * s)
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=0.3 * E[b, b])
    ocp.subject_to(x, upper=lid, name="lid")
    return ocp


def gain_of_input() -> co.Problem:
    """An unknown gain of the input, which is measured through a time-dependent mode."""
    ocp = co.Problem(4.0, name="gain of the input")
    x = ocp.state("x", 2, initial=[0.3, 0.0], final=[1.0, None], variance=0.1)
    g = ocp.unknown("g", mean=1.0, variance=0.5)
    u = ocp.control("u", guess=lambda s: 1.0 - 2 * s)
    ocp.dynamics(x, ca.vertcat(x[1], -x[0] - 0.4 * x[1] + g * u), noise=0.05)
    ocp.measurement("position", x[0] + 0.2 * x[1] * ca.cos(ocp.time), noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=2 * E[g, g])
    return ocp


PROBLEMS: dict[str, Callable[[], co.Problem]] = {
    **{f"lag to 1, weight {w:g}": lambda w=w: unknown_lag.problem(weight=w, final=1.0) for w in (0.1, 1.0, 10.0)},
    "lag to 0, weight 10": lambda: unknown_lag.problem(weight=10.0, final=0.0),
    "oscillator, stiffness": lambda: damped_oscillator.problem(0.0, 1000.0, naming="equations"),
    "tracked lag, weight 0.1": lambda: tracked(0.1),
    "tracked lag, weight 1": lambda: tracked(1.0),
    "lag below 0.32": lambda: lidded(0.32),
    "gain of the input": gain_of_input,
}


def main() -> None:
    """Both tables."""
    warnings.simplefilter("ignore")
    print("| problem | runs | certified | contradicted | largest excess / gap | median gap / cost |")
    print("|---|---|---|---|---|---|")
    total = [0, 0, 0]
    for name, problem in PROBLEMS.items():
        best = co.solve(problem(), intervals=FINE, progress=False, tolerance=1e-9, guess=None)
        least = best.cost * (1 - best.mesh_error)
        runs = certified = wrong = 0
        ratios, gaps = [], []
        for intervals in MESHES:
            for control in ("linear", "constant"):
                try:
                    solution = co.solve(problem(), intervals=intervals, control=control, progress=False)
                except co.CovocpError:
                    continue
                runs += 1
                certificate = co.certify(solution)
                if not certificate.certified or certificate.gap is None:
                    continue
                certified += 1
                excess = solution.cost - least
                wrong += excess > certificate.gap
                ratios.append(excess / certificate.gap)
                gaps.append(certificate.gap / solution.cost)
        total = [total[0] + runs, total[1] + certified, total[2] + wrong]
        worst, middle = (f"{max(ratios):.2g}", f"{sorted(gaps)[len(gaps) // 2]:.1e}") if gaps else ("-", "-")
        print(f"| {name} | {runs} | {certified} | {wrong} | {worst} | {middle} |", flush=True)
    print(f"| all | {total[0]} | {total[1]} | {total[2]} | | |")
    print("\n| intervals | certify, CPU s |")
    print("|---|---|")
    for intervals in (100, 200, 400, 1000):
        solution = co.solve(unknown_lag.problem(final=1.0), intervals=intervals, progress=False)
        begin = time.process_time()
        co.certify(solution, progress=False)
        print(f"| {intervals} | {time.process_time() - begin:.2f} |")


if __name__ == "__main__":
    main()
