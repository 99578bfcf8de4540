"""One change in a problem at a time: a file of the solution is refused for each, with the name of what differs."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.base.archive import unpacked
from covocp.base.geometry import Chart, Geometry, Part
from covocp.solution.fingerprint import fingerprint
from covocp.solution.storage import write
from covocp.statement.chain import Link
from covocp.statement.chances import ChanceLimits
from covocp.statement.conditions import Conditions, Inside, Instant
from covocp.statement.statement import Block, Duration, Loop, Samples, Statement, Tied
from covocp.statement.time_data import TimeData

Builder = Callable[..., co.Problem]


def line(ends: tuple[float, float], name: str = "drag") -> co.Table:
    """A straight line between two knots: only its range tells it from another one."""
    return co.table(name, list(ends), [0.01 * end for end in ends])


def estimated(
    *,
    name: str = "m",
    matrix: float = 1.0,
    noise: Any = 0.2,
    when: Any = None,
    unit: str = "m",
    constant: Any = None,
    second: float | None = 0.3,
    correlation: float = 0.1,
    floor: float = 1e6,
    shape: Any = None,
    initial: float = 1e6,
) -> co.Problem:
    """Measurements at instants of a scalar, and of two rows with correlated noise."""
    p = co.Problem(4.0, name="estimated")
    k = p.parameter("k", np.ones((2, 3)) if shape is None else np.ones(shape))
    y = p.state("y", initial=1.0 + ca.fmax(0, k[0, 0] - initial), variance=0.5, unit="m")
    w = p.control("w")
    p.dynamics(y, -y * k[0, 0] + w, noise=0.1)
    p.measurement(name, matrix * y + ca.fmax(0, y - floor), noise=noise, unit=unit, **(when or {"every": 0.5}))
    if second is not None:
        both = np.array([[second, correlation], [correlation, second]])
        p.measurement("pair", ca.vertcat(y, 2 * y), noise=both, at=[1.0, 3.0])
    if constant is not None:
        p.measurement("c", y, noise=constant)
    E = p.estimation_covariance()
    p.minimize(running=w**2, terminal=E[y, y])
    return p


def expected(
    *,
    noise: float = 0.2,
    every: float = 0.5,
    unit: str = "V",
    density: float = 1.0,
    nonlinear: float = 0.1,
    end: float = 0.1,
    weight: float = 1.0,
    control: float = 2.0,
    process: float = 0.1,
    variance: float = 0.5,
) -> co.Problem:
    """A closed loop with both kinds of measurements, and costs that are not linear in its covariance."""
    p = co.Problem(4.0, name="expected")
    y = p.state("y", initial=1.0, variance=variance)
    w = p.control("w")
    p.dynamics(y, -y + w, noise=process)
    p.measurement("m", y, noise=noise, every=every)
    p.measurement("c", y, noise=density, unit=unit)
    X = p.closed_loop_covariance()
    p.minimize_expected(
        running=w**2 + y**2 + nonlinear * ca.sqrt(1 + X[y, y]),
        terminal=y**2 + end * X[y, y] ** 2,
        terminal_weight={y: weight},
        control_weight={w: control},
    )
    return p


def conditioned(
    *,
    probability: float = 0.9,
    joint: bool = False,
    slope: float = 1.0,
    limit: float = 9.0,
    gate: float = 2.0,
    side: Any = "before",
    between: Any = None,
    factor: float = 1.0,
    place: Any = "path",
    kind: Any = "linear",
    data_unit: str = "N",
    middle: float = 0.0,
    ends: tuple[float, float] = (-50.0, 50.0),
    integrand: float = 1.0,
    lowest: float = -3.0,
    symbol_unit: str = "",
) -> co.Problem:
    """Conditions of every kind, data, a table, a decision and an integral."""
    p = co.Problem(4.0, name="conditioned")
    y = p.state("y", initial=None, variance=0.5, unit=symbol_unit)
    d = p.decision("d", guess=0.5, lower=lowest, upper=3.0)
    w = p.control("w")
    given = p.data("given", [0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 0.0, middle, 0.0, 0.0], kind=kind, unit=data_unit)
    p.dynamics(y, -y + w + given - 0.1 * line(ends)(y), noise=0.01)
    p.measurement("m", y, noise=1.0)
    p.estimation_covariance()
    spent = p.integral(integrand * w**2, name="spent")
    p.subject_to(factor * y - d, equals=0.0, at="initial", name="start")
    p.subject_to(y + 0.1 * w, at=gate, lower=-5.0, side=side, name="gate")
    p.subject_to(y, upper=20.0, at=place, between=between if place == "path" else None, name="lid")
    p.chance(ca.vertcat(slope * y, -y), upper=limit, probability=probability, joint=joint, at="final", name="safe")
    p.minimize(running=w**2 + (y - 1) ** 2 + d**2, terminal=spent)
    return p


def turning(*, noise: float = 0.001, sensor: float = 0.01, target: float = 1.0, rate: float = 1.0) -> co.Problem:
    """An attitude that is measured at instants."""
    p = co.Problem(1.0, name="turning")
    omega = p.control("omega", 3, guess=0.1)
    final = np.array([[np.cos(target), np.sin(target), 0], [-np.sin(target), np.cos(target), 0], [0, 0, 1.0]])
    C = p.attitude("C", initial=np.eye(3), final=final, rate=rate * omega, variance=0.01, noise=noise)
    p.measurement("star", C.matrix @ ca.DM([1, 0, 0]), noise=sensor, every=0.5)
    p.estimation_covariance()
    p.minimize(running=ca.sumsqr(omega))
    return p


def constrained(
    *,
    structure: Any = ((True, True),),
    constant: bool = False,
    upper: float = 9.0,
    stated: Any = None,
    smallest: float = 0.0,
    start: float = 1.0,
    energy: float = 0.0,
    growth: float = 0.1,
    lower: float = 1e-6,
    longest: float = 3.0,
    prior: float = 0.5,
) -> co.Problem:
    """A gain with constraints, information, a matrix of the user's own, a free duration, decisions at the start."""
    p = co.Problem(co.Free(2.0, 1.0, longest), name="constrained")
    d = p.decision("d", guess=0.5, lower=-2.0, upper=2.0)
    x = p.state("x", 2, initial=ca.vertcat(start * d, 0.0), variance=[0.5, prior])
    u = p.control("u")
    M = p.symmetric("M", 1, initial=1.0, lower=lower)
    p.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, 0.1])
    p.dynamics(M, -M + growth * x[0] ** 2)
    p.measurement("m", x[0], **(stated or {"information": 1.0}))
    p.measurement("late", x[0], noise=0.1 * (1 + p.time), at=[0.5], relative=True)
    p.chance(x[0], upper=9.0, probability=0.9, smallest=smallest, at="final", name="safe")
    gain = co.Gain(structure=[list(row) for row in structure], constant=constant, upper=upper, guess=0.5)
    p.minimize_expected(running=u**2 + x[0] ** 2 + energy * d**2, terminal=ca.sumsqr(x), gain=gain)
    return p


CHANGES: list[tuple[Builder, dict[str, Any], str]] = [
    (estimated, {"noise": 20.0}, "the noise of the measurement 'm'"),
    (estimated, {"noise": 0.2001}, "the noise of the measurement 'm'"),
    (estimated, {"matrix": 3.0}, "the measurement 'm'"),
    (estimated, {"when": {"every": 1.0}}, "the instants .* of the measurement 'm'"),
    (estimated, {"when": {"at": [0.5, 1.0, 1.5]}}, "the instants .* of the measurement 'm'"),
    (estimated, {"when": {"at": [0.51 * k for k in range(1, 8)]}}, "the instants .* of the measurement 'm'"),
    (estimated, {"name": "z"}, r"the symbols differ(?s:.*)z \(1\) at instants"),
    (estimated, {"unit": "km"}, "the unit of the measurement 'm'"),
    (estimated, {"second": None}, "the symbols"),
    (estimated, {"constant": 1.0}, "the symbols"),
    (estimated, {"second": 0.4}, "the noise of the measurement 'pair'"),
    (estimated, {"correlation": 0.0}, "the noise of the measurement 'pair'"),
    (estimated, {"floor": 2e6}, "the places where the equations switch"),
    (estimated, {"initial": 2e6}, "the places where the equations switch"),
    (estimated, {"shape": (3, 2)}, "the shape of 'k'"),
    (expected, {"noise": 20.0}, "the noise of the measurement 'm'"),
    (expected, {"every": 1.0}, "the instants .* of the measurement 'm'"),
    (expected, {"unit": "mV"}, "the unit of the measurement 'c'"),
    (expected, {"density": 2.0}, "the noise of the measurement 'c'"),
    (expected, {"nonlinear": 0.2}, "the running cost"),
    (expected, {"end": 0.2}, "the expected terminal cost"),
    (expected, {"weight": 2.0}, "the weight of the deviations at the end"),
    (expected, {"control": 3.0}, "the weight of the fed-back control"),
    (expected, {"process": 0.2}, "the process noise of 'y'"),
    (expected, {"variance": 0.6}, r"the initial value of 'E"),
    (conditioned, {"probability": 0.8}, "the probability of 'safe'"),
    (conditioned, {"joint": True, "probability": 0.8}, "the rows of 'safe'"),
    (conditioned, {"slope": 1.1}, r"the value in probability of 'safe\[0\]'"),
    (conditioned, {"limit": 9.5}, r"the limits in probability of 'safe\[0\]'"),
    (conditioned, {"gate": 2.5}, "the instant of 'gate'"),
    (conditioned, {"side": "after"}, "the instant of 'gate'"),
    (conditioned, {"between": "auto"}, "what 'lid' says between the nodes"),
    (conditioned, {"place": "final"}, r"the constraints \(path\)"),
    (conditioned, {"factor": 2.0}, "the constraint 'start'"),
    (conditioned, {"kind": "cubic"}, "the interpolation of the data 'given'"),
    (conditioned, {"data_unit": "kN"}, "the unit of the data 'given'"),
    (conditioned, {"middle": 0.1}, "the values of the data 'given'"),
    (conditioned, {"ends": (-60.0, 60.0)}, "the range of table 'drag'"),
    (conditioned, {"integrand": 1.1}, "the rate of 'spent'"),
    (conditioned, {"lowest": -4.0}, "the lower bound of 'd'"),
    (conditioned, {"symbol_unit": "m"}, r"the symbols differ(?s:.*)state y \(1\) in no unit(?s:.*)state y \(1\) in m"),
    (constrained, {"structure": ((True, False),)}, "the"),
    (constrained, {"constant": True}, "the symbols"),
    (constrained, {"upper": 8.0}, "the upper bound of 'C"),
    (constrained, {"stated": {"information": 2.0}}, "the noise of the measurement 'm'"),
    (constrained, {"stated": {"noise": 2.0}}, "the noise of the measurement 'm'"),
    (constrained, {"smallest": 0.01}, "the constraint 'safe'"),
    (constrained, {"start": 2.0}, r"the initial value of 'x\[0\]'"),
    (constrained, {"energy": 0.1}, "the running cost"),
    (constrained, {"growth": 0.2}, "the rate of 'M'"),
    (constrained, {"lower": 1e-5}, r"the lower bound of 'M"),
    (constrained, {"longest": 4.0}, "the bounds of the duration"),
    (constrained, {"prior": 0.6}, r"the initial value of 'E\[x\[1\], x\[1\]\]'"),
    (turning, {"noise": 0.002}, "the process noise of 'C"),
    (turning, {"sensor": 0.02}, "the noise of the measurement 'star'"),
    (turning, {"target": 1.1}, r"the constraint 'final C"),
    (turning, {"rate": 1.1}, "the rate of 'C'"),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A file of some trajectory of each problem, by the name of its function."""
    folder, found = tmp_path_factory.mktemp("told"), {}
    for build in (estimated, expected, conditioned, constrained, turning):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", co.CovocpWarning)  # the meshes are coarse, and nothing is optimised
            found[build.__name__] = co.evaluate(build(), intervals=10).save(folder / f"{build.__name__}.npz")
    return found


@pytest.mark.parametrize(
    ("build", "change", "named"), CHANGES, ids=lambda value: getattr(value, "__name__", str(value))
)
def test_each_change_is_seen_and_named(
    files: dict[str, Path], build: Builder, change: dict[str, Any], named: str
) -> None:
    with pytest.raises(co.ProblemError, match=f"of another problem: .*{named}"):
        co.load(files[build.__name__], build(**change))


@pytest.mark.parametrize("build", [estimated, expected, conditioned, constrained, turning])
def test_the_problem_itself_is_the_one_that_was_solved(files: dict[str, Path], build: Builder) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*violates", category=co.CovocpWarning)
        assert co.load(files[build.__name__], build()).statement is not None


# --- files of versions that kept less ---------------------------------------------------------------------------------


def earlier(path: Path, build: Builder, target: Path) -> Path:
    """The same file as it was written before anything but the first things were kept."""
    solution = co.load(path)
    kept = fingerprint(build().statement(), solution.trajectory, solution.parameters, ())
    tree: dict[str, Any] = unpacked(replace(solution, stored_problem=kept).save(target).read_bytes())[0]
    for name in ("words", "aspects"):
        del tree["stored_problem"][name]
    return write(tree, target)


def test_an_earlier_file_is_loaded_and_what_it_does_not_tell_is_said(files: dict[str, Path], tmp_path: Path) -> None:
    path = earlier(files["estimated"], estimated, tmp_path / "estimated.npz")
    with pytest.warns(
        co.CovocpWarning, match="says nothing of measurements at instants, pieces of initial values, which were not"
    ):
        loaded = co.load(path, estimated())
    again = loaded.save(tmp_path / "again.npz")
    assert co.load(again, estimated()).statement is not None  # without a word: now it tells them
    with pytest.raises(co.ProblemError, match="the noise of the measurement 'm'"):
        co.load(again, estimated(noise=20.0))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"when": {"every": 1.0}}, "the instants of 'm' differ"),
        ({"noise": 20.0}, "what 'm' tells at t = 0.5 s differs"),
        ({"matrix": 3.0}, "what 'm' tells at t = 0.5 s differs"),
        ({"second": 0.4}, "what 'm', 'pair' tells at t = 1 s differs"),
        ({"second": None}, "the instants of 'measurement 2 at instants' differ"),
        ({"constant": 1.0}, "the symbols"),
    ],
    ids=str,
)
def test_instants_and_readings_of_an_earlier_file_are_those_of_its_own_values(
    files: dict[str, Path], tmp_path: Path, change: dict[str, Any], named: str
) -> None:
    path = earlier(files["estimated"], estimated, tmp_path / "estimated.npz")
    with pytest.raises(co.ProblemError, match=named):
        co.load(path, estimated(**change))


@pytest.mark.parametrize(
    ("build", "options"),
    [
        (estimated, {}),
        (estimated, {"method": "gradient"}),
        (estimated, {"control": "constant"}),
        (estimated, {"covariances": "states"}),
        (estimated, {"points": 2}),
        (expected, {}),
        (turning, {}),
    ],
    ids=lambda part: getattr(part, "__name__", str(part)),
)
def test_an_earlier_file_of_a_solution_is_not_refused(build: Builder, options: dict[str, Any], tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        solution = co.solve(build(), intervals=10, progress=False, **options)
        path = earlier(solution.save(tmp_path / "now.npz"), build, tmp_path / "earlier.npz")
        assert solution.converged
        assert co.load(path, build()).statement is not None


@pytest.mark.parametrize(
    ("build", "unknown"),
    [
        (expected, "measurements at instants"),
        (turning, "measurements at instants"),
        (conditioned, "probabilities of chance conditions, ranges of tables"),
        (
            lambda: conditioned(between="auto"),
            "probabilities of chance conditions, constraints between the nodes, rang",
        ),
    ],
)
def test_an_earlier_file_is_asked_for_no_more_than_its_problem_has(
    build: Builder, unknown: str, tmp_path: Path
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        path = co.evaluate(build(), intervals=10).save(tmp_path / "now.npz")
    with pytest.warns(co.CovocpWarning) as told:
        co.load(earlier(path, build, tmp_path / "earlier.npz"), build())
    assert [f"says nothing of {unknown}" in str(entry.message) for entry in told].count(True) == 1


# --- nothing is forgotten ---------------------------------------------------------------------------------------------

# What each field of a statement is compared by; "-": it is no part of a problem, or follows from the others.
COMPARED: dict[type, dict[str, str]] = {
    Statement: {
        "name": "-",
        "blocks": "symbols, entry by entry",
        "duration": "numbers",
        "values": "numbers",
        "nominal": "- rates and running cost",
        "rates": "values",
        "terminal": "values",
        "boundary": "values, pieces",
        "tied": "values, pieces",
        "matrix_end": "values",
        "loop": "values",
        "riccati": "values of the process noise; else they follow from the rates",
        "sources": "- rates",
        "measurement": "values",
        "measurements": "symbols, units",
        "information": "- the noise is its inverse",
        "samples": "symbols, numbers, values",
        "data": "numbers, words",
        "tables": "numbers",
        "path": "numbers, values",
        "start": "numbers, values",
        "end": "numbers, values",
        "inside": "numbers, values",
        "chances": "numbers, words, values",
        "state_bounds": "numbers",
        "control_bounds": "numbers",
        "matrix_lower": "numbers",
        "guesses": "-",
        "scales": "-",
        "augmented": "symbols",
        "coupled": "- rates",
        "symbolic": "-",
        "autonomous": "- rates",
        "noise_varies": "- noise",
        "running_uses_matrices": "- running cost",
        "geometry": "- the tangents among the symbols",
        "symbols": "- blocks",
        "expression": "- blocks",
        "matrix_parameters": "words",
    },
    Block: dict.fromkeys(
        ["name", "kind", "size", "offset", "labels", "covariance", "estimation", "backward", "unit", "tangent", "role"],
        "entry by entry",
    ),
    Duration: {"guess": "numbers, where it is fixed", "lower": "numbers", "upper": "numbers"},
    Tied: {"states": "names", "matrices": "names", "function": "values", "slopes": "- function"},
    Loop: {
        "expansion": "values of weights; F, G, Q follow from rates and noise",
        "gain": "values",
        "running": "values",
        "terminal": "values",
        "extra_control": "- weights less running cost",
        "weighed": "- part of the weights",
        "by_parts": "- rates and costs",
        "spread": "- in the expected running cost",
        "spread_end": "- in the expected terminal cost",
        "shared": "- gain",
    },
    Samples: {
        "blocks": "symbols, units",
        "places": "numbers",
        "measurement": "values, pieces",
        "groups": "- noise",
        "update": "- measurement",
    },
    Conditions: {
        "function": "values",
        "names": "numbers by name, in order",
        "lower": "numbers",
        "upper": "numbers",
        "uses_matrices": "- function",
        "realised": "- function",
        "scattered": "- function",
        "between": "numbers",
    },
    Inside: {"parts": "one by one"},
    Instant: {"place": "numbers", "late": "numbers", "apart": "- function", "conditions": "as others"},
    ChanceLimits: {
        "name": "numbers by name",
        "names": "numbers by name",
        "place": "- that of the constraint",
        "lower": "numbers",
        "upper": "numbers",
        "probability": "numbers",
        "each": "- probability and rows",
        "joint": "words",
        "function": "values",
        "matrix": "- symbols",
    },
    TimeData: {
        "name": "numbers by name",
        "unit": "words",
        "kind": "words",
        "times": "numbers",
        "values": "numbers",
        "expression": "- the others",
    },
    Geometry: {"parts": "- symbols"},
    Part: {"rows": "- symbols", "tangent": "- symbols", "chart": "- the one of all attitudes"},
    Chart: dict.fromkeys(
        ["kind", "size", "tangent", "move", "difference", "basis", "velocity", "course", "drift", "like"],
        "- the one of all attitudes",
    ),
    Link: {
        "states": "names",
        "matrices": "names",
        "parameters": "- symbols",
        "names": "names",
        "function": "values, pieces",
        "behind": "- symbols",
        "weights": "- symbols",
        "deviations": "- function",
    },
}


@pytest.mark.parametrize("kind", COMPARED, ids=lambda kind: kind.__name__)
def test_every_field_is_compared_or_known_to_follow(kind: type) -> None:
    """A field that is new must be compared, or it must be said here why it need not be."""
    assert {field.name for field in fields(kind)} == set(COMPARED[kind])
