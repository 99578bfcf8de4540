"""Packages of C code that several tests share: exported and compiled once, every warning an error."""

from __future__ import annotations

import atexit
import shutil
import subprocess
import tempfile
import warnings
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np

import covocp as co
from covocp.blocks import kalman, theta_d
from covocp.export import CPackage, export_c
from covocp.models import agile_aircraft, mars_entry, unknown_lag

FOLDER = Path(tempfile.mkdtemp(prefix="covocp_export_"))
atexit.register(shutil.rmtree, FOLDER, ignore_errors=True)
STRICT = ["-Werror"]
# Numbers do not depend on what a compiler makes faster, which takes it four times as long.
QUICK = [*STRICT, "-O0"]
SANITIZE = ["-g1", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]
PLANNER = {"intervals": 12, "substeps": 2}  # substeps="auto" depends on the parameters
STEP = 0.1
TRANSITION = np.array([[1.0, STEP], [0.0, 1.0]])
NOISE = np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]])
H, R = np.eye(2), np.diag([0.2, 1.0])
# A damped swing seen by three rows, two of them correlated, one of which sees the control.
SWING = SimpleNamespace(
    F=np.array([[0.0, 1.0], [-1.0, -0.4]]),
    G=np.array([0.0, 1.0]),
    Q=np.diag([0.0, 0.2]),
    P0=np.diag([0.3, 0.5]),
    M=np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]]),
    H=np.array([0.2, 0.0, 0.0]),
    U=np.array([[0.2, 0.09, 0.0], [0.09, 0.1, 0.0], [0.0, 0.0, 0.4]]),
    control=0.3,
    period=0.05,
)


@lru_cache
def lag() -> co.Solution:
    """The lag with feedback, its time constant nearly known."""
    return co.solve(unknown_lag.steering(parameter_variance=0.05), intervals=80, progress=False)


@lru_cache
def open_lag(control: str = "linear") -> co.Solution:
    """The lag without feedback."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # the mesh of constant controls is coarse
        return co.solve(unknown_lag.problem(), intervals=30, control=control, progress=False)


@lru_cache
def mars() -> co.Solution:
    """Mars entry with constant lift-to-drag ratio, and its feedback."""
    return co.evaluate(mars_entry.problem(), nominal=mars_entry.reference())


@lru_cache
def swing(unit: float = 1.0) -> co.Solution:
    """The swing; unit: of what is measured."""
    s = SWING
    ocp = co.Problem(duration=2.0, name="swing")
    x = ocp.state("x", 2, initial=np.zeros(2), variance=np.diag(s.P0))
    u = ocp.control("u")
    ocp.dynamics(x, ca.DM(s.F) @ x + ca.DM(s.G) * u, noise=np.diag(s.Q))
    ocp.measurement("pair", unit * (x + ca.DM(s.H[:2]) * u), noise=unit**2 * s.U[:2, :2])
    ocp.measurement("difference", unit * (x[0] - x[1]), noise=unit**2 * s.U[2, 2])
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: np.array([2.0, 1.0])})
    return co.evaluate(ocp, nominal={"u": s.control})


def filter_functions() -> list[ca.Function]:
    """Kalman filters: discrete in all forms, with missing readings, continuous, extended."""
    x, P, y = ca.SX.sym("x", 2), ca.SX.sym("P", 2, 2), ca.SX.sym("y", 2)
    predict = ca.Function("predict", [x, P], kalman.predict(x, P, TRANSITION, NOISE), ["x", "P"], ["estimate", "E"])
    names = ["x", "P", "y"], ["estimate", "E"]
    updates = [
        ca.Function(f"update_{form}", [x, P, y], kalman.update(x, P, y, H, R, form=form, missing="skip"), *names)
        for form in ("joseph", "standard", "sequential", "information")
    ]
    rate = ca.Function("rate", [P], [kalman.rate(P, ca.DM(TRANSITION), H, NOISE, R)], ["P"], ["change"])
    f = ca.Function("f", [x], [ca.vertcat(x[0] + STEP * ca.sin(x[1]), 0.9 * x[1])])
    h = ca.Function("h", [x], [ca.atan(x)])
    ahead, after = kalman.extended(f, h, NOISE, R, missing="skip")
    named = [
        ca.Function(f"extended_{part.name()}", part.sx_in(), part.call(part.sx_in(), True, False))
        for part in (ahead, after)
    ]
    return [predict, *updates, rate, *named]


def theta_d_functions() -> list[ca.Function]:
    """θ-D regulator, servo and filter gain of the agile aircraft."""
    x = ca.SX.sym("x", 5)
    A0, bilinear, B, measured = agile_aircraft.matrices()
    A = x[1] * ca.DM(bilinear)
    track, level = agile_aircraft.tracking(), agile_aircraft.regulation()
    return [
        theta_d.regulator(x, A0, A, B, level.Q, level.R),
        theta_d.servo(x, A0, A, B, [0, 0, 0, 1, 0], track.Q, track.R, k=1.0, l=0.01),
        theta_d.filter_gain(x, A0, A, measured, track.W, track.V, k=1.0, l=0.01),
    ]


@lru_cache
def package(name: str) -> CPackage:
    """A package by name, compiled."""
    makers = {
        "lag": lambda p: export_c(lag(), p),
        "lag_sampled": lambda p: export_c(lag(), p, period=0.01),
        "lag_single": lambda p: export_c(lag(), p, precision="single"),
        "mars": lambda p: export_c(mars(), p),
        "mars_sampled": lambda p: export_c(mars(), p, period=0.915),
        "mars_single": lambda p: export_c(mars(), p, precision="single", limits="bounds"),
        "swing": lambda p: export_c(swing(), p, period=SWING.period),
        "history": lambda p: export_c(open_lag(), p),
        "steps": lambda p: export_c(open_lag("constant"), p),
        "filters": lambda p: export_c(filter_functions(), p),
        "theta": lambda p: export_c(theta_d_functions(), p, ranges={"x": (-0.5, 0.5), "t": (0.0, 30.0)}),
        "planner": lambda p: export_c(unknown_lag.problem(weight=10.0), p, **PLANNER),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # the mesh of the planner is coarse
        made = makers[name](FOLDER / name)
    made.build(flags=STRICT)
    return made


def quick(made: CPackage) -> CPackage:
    """A package, compiled at once as what flies it or compares it needs, not as `python` and `check` would."""
    made.build(flags=QUICK)
    return made


@lru_cache
def sanitized(name: str) -> tuple[Path, ...]:
    """Object code of a package under the sanitizers; none where the compiler has no sanitizers."""
    made, objects = package(name), []
    effort = "-Og" if name.startswith("mars") or name.endswith("sampled") else "-O0"  # those that run long
    for stem in (name, f"{name}_casadi"):
        objects.append(FOLDER / f"{name}_sanitized_{stem}.o")
        command = ["cc", "-std=c99", effort, *SANITIZE, "-fno-omit-frame-pointer", "-c"]
        built = subprocess.run(
            [*command, made.directory / f"{stem}.c", "-o", objects[-1]], capture_output=True, text=True
        )
        if built.returncode and "sanitize" in built.stderr:
            return ()
        assert built.returncode == 0, built.stderr
    return tuple(objects)
