"""What users give by mistake, and calls of everything public into which one of these goes at a time."""

from __future__ import annotations

import datetime
import decimal
import fractions
import functools
import inspect
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import covocp as co
from covocp.blocks import attitude_seeking, kalman, peak_seeking, riccati, so3, theta_d
from covocp.simulation.laws import extended_filter, gain_filter
from covocp.solving.methods import method_options
from covocp.transcription.mesh import Options

SMALL: dict[str, Any] = {"intervals": 2, "substeps": 2, "progress": False}


def raising(*_: Any) -> Any:
    """A function that fails."""
    raise ZeroDivisionError("in the user's function")


def of_nothing() -> float:
    """A function of another signature."""
    return 0.0


FOREIGN = co.Problem(1.0).state("foreign", initial=0.0)

# Made anew for each call: some are used up, and some functions might change them.
VALUES: dict[str, Callable[[], Any]] = {
    "None": lambda: None,
    "a word": lambda: "x",
    "another word": lambda: "no such word",
    "an empty text": lambda: "",
    "bytes": lambda: b"3",
    "True": lambda: True,
    "0": lambda: 0,
    "3": lambda: 3,
    "-1": lambda: -1,
    "half": lambda: 0.5,
    "nan": lambda: float("nan"),
    "inf": lambda: float("inf"),
    "1e300": lambda: 1e300,
    "10**30": lambda: 10**30,
    "10**400": lambda: 10**400,
    "complex": lambda: 1 + 2j,
    "a fraction": lambda: fractions.Fraction(1, 3),
    "a decimal": lambda: decimal.Decimal("0.1"),
    "an empty list": lambda: [],
    "a list of words": lambda: ["x", "y"],
    "a list of None": lambda: [None, None],
    "a ragged list": lambda: [[1.0, 2.0], [3.0]],
    "a dict": dict,
    "a dict of numbers": lambda: {"x": 1.0},
    "a dict by number": lambda: {3: object()},
    "a set": lambda: {1, 2},
    "a generator": lambda: (i for i in range(3)),
    "an object": object,
    "a class": lambda: float,
    "an array": lambda: np.array([1.0, 2.0, 3.0]),
    "an empty array": lambda: np.zeros(0),
    "an array of objects": lambda: np.array([None, "x"], dtype=object),
    "an array of words": lambda: np.array(["path", "end"]),
    "a complex array": lambda: np.array([1 + 2j]),
    "a masked array": lambda: np.ma.masked_array([1.0, 2.0], mask=[False, True]),
    "a cube": lambda: np.zeros((2, 2, 2)),
    "a date": lambda: datetime.date(2024, 1, 1),
    "an array of dates": lambda: np.array(["2024-01-01"], dtype="datetime64[D]"),
    "a path": lambda: Path("x"),
    "a function that raises": lambda: raising,
    "a function of nothing": lambda: of_nothing,
    "an SX": lambda: ca.SX.sym("s"),
    "an MX": lambda: ca.MX.sym("m"),
    "an MX of a wrong shape": lambda: ca.MX.sym("m", 2, 3),
    "a DM of a wrong shape": lambda: ca.DM.ones(2, 3),
    "a function of CasADi": lambda: ca.Function("f", [ca.SX.sym("a")], [ca.SX(1)]),
    "a symbol of another problem": lambda: FOREIGN,
    "another problem": lambda: co.Problem(1.0),
    "an error": lambda: ValueError("x"),
}

# Those that say little that others do not.
RARE = (
    *("another word", "an empty text", "0", "half", "a fraction", "a decimal", "a list of None", "a dict of numbers"),
    *("10**30", "bytes", "a set", "a date"),
    *("a class", "an empty array", "an array of dates", "an MX", "another problem", "an error", "a function of CasADi"),
)


def stated(**given: dict[str, Any]) -> co.Problem:
    """A small problem with one of everything; by name of the method what is given to it instead."""

    def to(method: str, **arguments: Any) -> dict[str, Any]:
        return arguments | given.get(method, {})

    ocp = co.Problem(**to("Problem", duration=1.0, name="small"))
    ocp.parameter(**to("parameter", name="a", value=1.0))
    x = ocp.state(**to("state", name="x", initial=1.0, final=0.5, variance=0.5))
    b = ocp.unknown(**to("unknown", name="b", mean=0.1, variance=0.2))
    u = ocp.control(**to("control", name="u"))
    d = ocp.decision(**to("decision", name="d", guess=0.5, lower=0.1, upper=2.0)) if "decision" in given else 1.0
    if given.keys() & {"attitude", "cosine", "error"}:
        turned = {"name": "C", "initial": np.eye(3), "rate": ca.MX.zeros(3), "variance": 0.1}
        attitude = ocp.attitude(**to("attitude", **turned))
        if "attitude" not in given:
            attitude.cosine(**to("cosine", body_axis=[1, 0, 0], direction=[0, 0, 1]))
            attitude.error(**to("error", reference=np.eye(3)))
    if "symmetric" in given:
        ocp.symmetric(**to("symmetric", name="S", size=2, initial=np.eye(2)))
        ocp.dynamics("S", ca.MX.zeros(2, 2))
    if "Problem" not in given:  # names that clash are told by their own arguments
        own = ocp.declarations
        x, b, u = (group[0].symbol for group in (own.states, own.unknowns, own.controls))
    if "data" in given:
        ocp.data(**to("data", name="w", times=[0.0, 1.0], values=[1.0, 2.0]))
    ocp.dynamics(**to("dynamics", symbol=x, rate=u - b * x, noise=0.1))
    ocp.measurement(**to("measurement", name="m", expression=x, noise=0.1))
    total = ocp.integral(**to("integral", expression=u**2)) if "integral" in given else 0.0
    if given.keys() & {"minimize_expected", "Gain", "X", "deviation"}:
        gain = co.Gain(**given["Gain"]) if "Gain" in given else None
        X = ocp.closed_loop_covariance()
        if "X" in given:
            X[given["X"]["key"]]
        if "deviation" in given:
            X.deviation(**to("deviation", symbol=u))
        ocp.minimize_expected(**to("minimize_expected", running=u**2, terminal_weight={"x": 1.0}, gain=gain))
    else:
        E = ocp.estimation_covariance(**to("estimation_covariance"))
        if "E" in given:
            E[given["E"]["key"]]
        ocp.minimize(**to("minimize", running=u**2 + d**2, terminal=E[x, x] + total))
    if "subject_to" in given:
        ocp.subject_to(**to("subject_to", expression=u, lower=-50.0, upper=50.0))
    if "chance" in given:
        ocp.chance(**to("chance", expression=x, lower=-50.0, upper=50.0, probability=0.9))
    return ocp


# Arguments that nothing but their own method reads, and those that are read when the problem is solved.
READ_AT_ONCE = ("name", "unit", "lower", "upper", "shape", "size")
READ_LATER = ("guess", "initial", "final", "duration", "scale", "variance", "mean", "value", "gain")


def in_statement(method: str, argument: str, value: Any, solved: bool = False) -> Any:
    """One wrong value in a statement, which is solved where it is taken and read then."""
    ocp = stated(**{method: {argument: value}})
    if argument != "guess" and not (solved and (argument in READ_LATER or method == "Gain")):
        return ocp if argument in READ_AT_ONCE and method != "Gain" else ocp.statement()
    return co.solve(ocp, max_iterations=1, allow_failure=True, **SMALL)


def arguments_of(function: Any) -> list[str]:
    """Names of the arguments, options in ** not."""
    kinds = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    return [n for n, p in inspect.signature(function).parameters.items() if n != "self" and p.kind not in kinds]


@functools.cache
def made() -> dict[str, Any]:
    """What calls are made on, made once."""
    ocp = stated()
    solver = co.Solver(ocp, **{k: v for k, v in SMALL.items() if k != "progress"})
    solution = solver.solve(progress=False)
    closed = co.solve(stated(minimize_expected={}), **SMALL)
    runs = co.simulate(closed, 64, seed=1, step=0.1, progress=False)
    s = ca.SX.sym("s")
    folder = Path(tempfile.mkdtemp())
    package = co.export_c(ca.Function("twice", [s], [2 * s], ["s"], ["t"]), folder / "twice")
    pair = ca.SX.sym("a"), ca.SX.sym("b")
    return {
        "ocp": ocp,
        "solver": solver,
        "solution": solution,
        "closed": closed,
        "runs": runs,
        "sample": solution.at(0.5),
        "comparison": co.compare(ocp, ["ipopt"], **SMALL),
        "package": package,
        "folder": folder,
        "plant": ca.Function("plant", [*pair], [-pair[0] + pair[1]]),
        "law": ca.Function("law", [*pair], [-pair[0]]),
        "observer": gain_filter(
            ca.Function("p", [*pair], [pair[1] - pair[0]]), lambda x, t: np.eye(1), np.eye(1), [0.0]
        ),
        "x": ca.SX.sym("x", 2),
    }


Call = Callable[[Any], Any]


def called(function: Call, /, **valid: Any) -> Iterator[tuple[str, Call]]:
    """A call for each argument of a function, the others valid."""
    for argument in arguments_of(function):
        yield argument, lambda value, argument=argument: function(**{**valid, argument: value})


def statements(solved: bool = False) -> Iterator[tuple[str, str, Call]]:
    """Of what states a problem."""
    given = functools.partial(in_statement, solved=solved)
    symbols = ("state", "attitude", "unknown", "parameter", "control", "decision", "integral", "symmetric")
    for method in (*symbols, "estimation_covariance", "dynamics"):
        for argument in arguments_of(getattr(co.Problem, method)):
            yield f"Problem.{method}", argument, functools.partial(given, method, argument)
    for method in ("data", "measurement", "minimize", "minimize_expected", "subject_to", "chance"):
        for argument in arguments_of(getattr(co.Problem, method)):
            yield f"Problem.{method}", argument, functools.partial(given, method, argument)
    for argument in arguments_of(co.Gain):
        yield "Gain", argument, functools.partial(given, "Gain", argument)
    for argument in ("duration", "name"):
        yield "Problem", argument, functools.partial(given, "Problem", argument)
    for method, argument in (("cosine", "body_axis"), ("cosine", "direction"), ("error", "reference")):
        yield f"Attitude.{method}", argument, functools.partial(given, method, argument)
    yield "EstimationCovariance", "[]", functools.partial(given, "E", "key")
    yield "EstimationCovariance", "[a, ]", lambda value: given("E", "key", (value, "x"))
    yield "ClosedLoopCovariance", "[]", functools.partial(given, "X", "key")
    yield "ClosedLoopCovariance", "[a, ]", lambda value: given("X", "key", (value, "x"))
    for argument in ("symbol", "smallest"):
        yield "ClosedLoopCovariance.deviation", argument, functools.partial(given, "deviation", argument)
    for argument, call in called(co.Free, guess=1.0, lower=0.5, upper=2.0):
        yield "Free", argument, call


def solving() -> Iterator[tuple[str, str, Call]]:
    """Of what solves."""
    ocp, solver = made()["ocp"], made()["solver"]
    few: dict[str, Any] = {**SMALL, "max_iterations": 1, "allow_failure": True}
    options = [*(f.name for f in fields(Options)), *method_options("ipopt"), "guess", "nominal", "progress"]
    options += ["allow_failure", "parameters", "starts", "seed"]
    for name in ("problem", "method", *options):
        extra = {"guess": "multistart"} if name in ("starts", "seed") else {}
        extra |= {"starts": 0} if name == "seed" else {}
        yield "solve", name, lambda v, n=name, e=extra: co.solve(**({"problem": ocp, **few, **e} | {n: v}))
    for name in method_options("gradient"):
        yield "solve gradient", name, lambda v, n=name: co.solve(ocp, "gradient", **(few | {n: v}))
    for method in ("reduced", "auto"):
        for name in method_options(method):
            yield f"solve {method}", name, lambda v, m=method, n=name: co.solve(ocp, m, **(few | {n: v}))
    for argument, call in called(solver.solve, progress=False, allow_failure=True):
        if argument not in ("starts", "seed"):
            yield "Solver.solve", argument, call
    yield "Solver.solve", "parameters, values", lambda v: solver.solve({"a": v}, progress=False, allow_failure=True)
    yield "Solver.solve", "guess, values", lambda v: solver.solve(guess={"u": v}, progress=False, allow_failure=True)
    yield (
        "Solver.solve",
        "initial, values",
        lambda v: solver.solve(initial={"x": v}, progress=False, allow_failure=True),
    )
    yield "Solver.solve", "means, values", lambda v: solver.solve(means={"b": v}, progress=False, allow_failure=True)
    yield "Solver.solve", "guess, states", lambda v: solver.solve(guess={"x": v}, progress=False, allow_failure=True)
    for argument, call in called(co.compare, problem=ocp, methods=["ipopt"], **SMALL):
        yield "compare", argument, call
    for argument, call in called(co.evaluate, problem=ocp, nominal={"u": 1.0}, intervals=2):
        yield "evaluate", argument, call
    yield "evaluate", "nominal, values", lambda v: co.evaluate(ocp, nominal={"u": v}, intervals=2)
    yield "evaluate", "truth of a solution", lambda v: co.evaluate(made()["closed"], truth=v)
    for argument, call in called(co.worth, problem=stated(minimize_expected={}), intervals=2):
        yield "worth", argument, call
    yield "certify", "solution", co.certify


def in_phases() -> Iterator[tuple[str, str, Call]]:
    """Of several phases: what states them, what solves them, and what asks for results."""
    few: dict[str, Any] = {**SMALL, "max_iterations": 1, "allow_failure": True}

    def parts() -> tuple[co.Problem, co.Problem]:
        first, second = co.Problem(1.0, name="first"), co.Problem(1.0, name="second")
        for ocp in (first, second):
            x, u = (
                ocp.state("x", initial=1.0 if ocp is first else None, variance=0.1 * (ocp is first)),
                ocp.control("u"),
            )
            ocp.dynamics(x, u, noise=0.1)
            E = ocp.estimation_covariance()
            ocp.minimize(running=u**2, terminal=E[x, x])
        return first, second

    def jumping(**given: Any) -> Any:
        first, second = parts()
        phases, before = co.Phases([first, second]), first.states[0].symbol
        phases.jump(**{"x": second.states[0].symbol, "expression": 0.5 * before, "noise": 0.1, **given})
        return co.solve(phases, **few)

    def solved(**given: Any) -> Any:
        return co.solve(**{"problem": co.Phases(parts(), name="both"), **few, **given})

    yield "Phases", "problems", co.Phases
    yield "Phases", "one of the problems", lambda v: co.Phases([parts()[0], v])
    yield "Phases", "name", lambda v: co.Phases(parts(), name=v)
    for argument in ("x", "expression", "noise"):
        yield "Phases.jump", argument, lambda v, n=argument: jumping(**{n: v})
    for argument in ("method", "intervals", "guess", "nominal", "progress", "allow_failure", "parameters", "tolerance"):
        yield "solve phases", argument, lambda v, n=argument: solved(**{n: v})
    yield "solve phases", "guess of one", lambda v: solved(guess=[v, None])
    yield "solve phases", "intervals of one", lambda v: solved(intervals=[v, 2])
    solution = solved()
    yield "PhasesSolution", "[]", solution.__getitem__
    for argument, call in called(solution.at, t=0.5, side="after"):
        yield "PhasesSolution.at", argument, call
    for name in ("costates", "over", "sigmas", "units", "title", "path"):
        yield "PhasesSolution.plot", name, lambda v, n=name: solution.plot("x", **{n: v})
    yield "PhasesSolution.plot", "names", solution.plot
    yield "PhasesSolution.save", "path", solution.save
    few_runs = {"runs": 2, "seed": 1, "step": 0.5, "progress": False}
    for name in ("runs", "seed", "truth", "law", "period", "limits", "filter", "step", "store", "paths", "batch"):
        yield "simulate phases", name, lambda v, n=name: co.simulate(solution, **{**few_runs, n: v})
    sample = co.simulate(solution, 2, 1, step=0.5, progress=False)
    yield "PhasesMonteCarlo", "[]", sample.__getitem__
    for name in ("units", "title", "path"):
        yield "PhasesMonteCarlo.plot", name, lambda v, n=name: sample.plot("x", **{n: v})
    yield "PhasesMonteCarlo.plot", "names", sample.plot
    yield "certify", "phases", lambda _: co.certify(co.Phases(parts()))
    yield "certify", "a solution of phases", lambda _: co.certify(solution)
    yield "evaluate phases", "nominal", lambda v: co.evaluate(co.Phases(parts()), nominal=v)
    yield "compare", "a solution of phases", lambda _: co.compare(solution)
    yield "compare phases", "methods", lambda v: co.compare(co.Phases(parts()), v, **few)


def results() -> Iterator[tuple[str, str, Call]]:
    """Of what asks for results."""
    solution, closed, runs = made()["solution"], made()["closed"], made()["runs"]
    names = ("at", "controls_at", "block", "costate", "multiplier", "covariance", "deviation", "check_path", "save")
    for name in names:
        valid = {"covariance": {"a": "x"}, "controls_at": {"times": 0.5}}.get(name, {})
        for argument, call in called(getattr(solution, name), **valid):
            yield f"Solution.{name}", argument, call
    for name in ("solution", "sample", "comparison"):
        yield name, "[]", made()[name].__getitem__
    figure = ("labels", "costates", "gains", "over", "sigmas", "units", "title", "path")
    for name in figure:
        yield "Solution.plot", name, lambda v, n=name: closed.plot("x", **{n: v})
        yield "Comparison.plot", name, lambda v, n=name: made()["comparison"].plot("x", **{n: v})
    yield "Solution.plot", "names", closed.plot
    yield "Comparison.plot", "names", made()["comparison"].plot
    for name in ("mean", "bias", "mean_band", "covariance", "deviation", "deviation_band", "predicted_deviation"):
        for argument, call in called(
            getattr(runs, name), **{n: "x" for n in ("key", "a") if n in arguments_of(getattr(runs, name))}
        ):
            yield f"MonteCarlo.{name}", argument, call
    for name in ("error_covariance", "terminal", "robust_deviation", "share_beyond", "rows"):
        valid = {n: "x" for n in ("key", "a") if n in arguments_of(getattr(runs, name))}
        for argument, call in called(getattr(runs, name), **valid | ({"value": 1.0} if name == "share_beyond" else {})):
            yield f"MonteCarlo.{name}", argument, call
    for name in ("sigmas", "units", "title", "path"):
        yield "MonteCarlo.plot", name, lambda v, n=name: runs.plot("x", **{n: v})
    yield "MonteCarlo.plot", "names", runs.plot
    for argument, call in called(co.load, path="nowhere.npz"):
        yield "load", argument, call


def sampled_simulations() -> Iterator[tuple[str, str, Call]]:
    """Of the loop at two rates, and of the law that flies in it."""
    x, held, t, none = ca.SX.sym("x"), ca.SX.sym("held"), ca.SX.sym("t"), ca.SX.sym("none", 0)
    seeker = peak_seeking.seeker(**SEEKER)
    loop = {
        "plant": ca.Function("plant", [x, held, t, none], [held - x]),
        "sensor": ca.Function("sensor", [x, t, none], [ca.vertcat(x, x**2)]),
        "law": seeker.law(),
    }
    times = {"initial": [1.0], "memory": seeker.initial(), "held": 0.0, "step": 0.5, "period": 1.0, "duration": 2.0}
    for argument, call in called(co.simulate_sampled, **loop, **times, runs=2, seed=0, average=True, every=1):
        yield "simulate_sampled", argument, call
    for argument, call in called(peak_seeking.seeker, **SEEKER):
        yield "seeker", argument, call
    reading = {"memory": seeker.initial(), "position": 1.0, "value": 2.0}
    for argument in reading:
        yield "Seeker.update", argument, lambda v, n=argument: seeker.update(**{**reading, n: v})


def attitude_seekers() -> Iterator[tuple[str, str, Call]]:
    """Of the laws of attitude seeking: zones, options and readings."""
    zone = {"body": (0, 1, 0), "direction": (1, 0, 0), "degrees": 20.0, "kind": "inclusion", "margin": 0.0}
    for argument, call in called(attitude_seeking.zone, **zone):
        yield "zone", argument, call
    for name in ("zones", "margin", "curvature", "method", "settings"):
        yield "projected", name, lambda v, n=name: attitude_seeking.projected(**{"zones": [], "window": 1, n: v})
    for name in attitude_seeking.Options.__annotations__:
        yield "unconstrained", name, lambda v, n=name: attitude_seeking.unconstrained(**{"spacing": 1, n: v})
    law = attitude_seeking.unconstrained(window=2)
    reading = {"memory": law.initial(), "attitude": (1.0, 0.0, 0.0, 0.0), "power": 2.0}
    for argument in reading:
        yield "AttitudeSeeker.update", argument, lambda v, n=argument: law.update(**{**reading, n: v})
    yield "AttitudeSeeker.initial", "attitude", law.initial


SEEKER: dict[str, Any] = {
    "n": 1, "window": 3, "noise": 1.0, "drift": 0.1, "prior_covariance": 1.0, "prior": [0.0, 0.0], "start": 1,
    "transport": True, "reuse": True, "newton": "plain", "smallest_curvature": 0.1, "largest_step": 1.0,
    "descent_gain": 1.0, "switch": 1.0, "definite": True, "maximum": False, "position_noise": 0.0,
}  # fmt: skip


def simulations() -> Iterator[tuple[str, str, Call]]:
    """Of what simulates."""
    closed = made()["closed"]
    for argument, call in called(
        co.simulate, solution=closed, runs=64, seed=1, step=0.5, store=2, paths=2, progress=False
    ):
        yield "simulate", argument, call
    for name in ("b", "a"):
        yield (
            "simulate",
            f"truth, {name}",
            lambda v, n=name: co.simulate(closed, 64, 1, step=0.5, store=2, progress=False, truth={n: v}),
        )
    yield (
        "simulate",
        "limits, u",
        lambda v: co.simulate(closed, 64, 1, step=0.5, store=2, progress=False, limits={"u": (v, 1.0)}),
    )
    plant, law = made()["plant"], made()["law"]
    valid = {"plant": plant, "law": law, "initial": [1.0], "duration": 1.0, "samples": 3}
    for argument, call in called(co.simulate_law, **valid):
        yield "simulate_law", argument, call
    noisy = {**valid, "runs": 2, "step": 0.25}
    for argument in ("runs", "step", "process_noise", "measurement_noise", "seed", "observer", "law", "running"):
        yield "simulate_law with noise", argument, lambda v, n=argument: co.simulate_law(**{**noisy, n: v})
    yield from sampled_simulations()
    yield from attitude_seekers()
    eye = np.eye(1)
    for argument, call in called(gain_filter, dynamics=plant, gain=lambda x, t: eye, H=eye, initial=[0.0]):
        yield "gain_filter", argument, call
    for argument, call in called(extended_filter, dynamics=plant, H=eye, W=eye, V=eye, initial=[0.0], covariance=eye):
        yield "extended_filter", argument, call


def exports() -> Iterator[tuple[str, str, Call]]:
    """Of what makes C code."""
    function, solution, ocp = made()["plant"], made()["closed"], made()["ocp"]
    package = made()["package"]
    number = iter(range(10**6))

    def export(what: Any, **given: Any) -> Any:
        given.setdefault("directory", made()["folder"] / f"made{next(number)}")
        return co.export_c(**{"what": what, **given})

    yield "export_c", "what", export
    for name in arguments_of(co.export_c)[1:]:
        for what, thing in (("function", function), ("solution", solution), ("problem", ocp)):
            mesh = {"intervals": 2, "substeps": 2} if what == "problem" else {}
            yield f"export_c of a {what}", name, lambda v, n=name, t=thing, m=mesh: export(t, **m, **{n: v})
    yield "export_c", "ranges, values", lambda v: export(function, ranges={"a": v})
    yield "export_c", "units, values", lambda v: export(function, units={"a": v})
    for name in ("tool", "flags"):
        yield "CPackage.build", name, lambda v, n=name: package.build(**{n: v})
    for name in ("samples", "seed"):
        yield "CPackage.check", name, lambda v, n=name: package.check(**{"samples": 1, n: v})
    yield "CPackage.time", "seconds", lambda v: None if isinstance(v, (int, float)) and v > 0 else package.time(v)
    yield "CPackage.reference", "call", lambda v: package.reference()(v)


def laws() -> Iterator[tuple[str, str, Call]]:
    """Of filters and laws by themselves."""
    plant, one = made()["plant"], np.eye(1)
    x = made()["x"]
    z = ca.SX.sym("z")
    measured = ca.Function("h", [z], [z])
    two, b = np.eye(2), np.array([[0.0], [1.0]])
    factor = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-(x[0] ** 2), 0))
    series = {"x": x, "A0": np.array([[0.0, 1.0], [0.0, -0.1]]), "A": factor, "Q": two}
    valid: dict[Any, dict[str, Any]] = {
        kalman.diffuse_start: {"size": 2},
        kalman.discretise: {"A": two, "Q": two, "step": 0.1},
        kalman.extended: {"f": plant, "h": measured, "noise": one, "R": one, "step": 0.1},
        kalman.extended_rate: {"f": plant, "h": measured, "noise": one, "R": one},
        kalman.factor: {"covariance": two},
        kalman.joseph: {"covariance": two, "gain": b, "H": b.T, "R": one},
        kalman.least_squares_start: {"regressors": two, "outputs": [1.0, 2.0]},
        kalman.predict: {"estimate": [0.0, 0.0], "covariance": two, "transition": two, "noise": two},
        kalman.predict_factor: {"estimate": [0.0, 0.0], "factor": two, "transition": two, "noise_factor": two},
        kalman.rate: {"E": two, "F": two, "M": b.T, "Q": two, "U": one},
        kalman.recursive_least_squares: {"estimate": [0.0], "covariance": one, "regressor": [1.0], "output": 1.0},
        kalman.steady_state: {"transition": 0.5 * two, "H": b.T, "noise": two, "R": one},
        kalman.update: {"estimate": [0.0, 0.0], "covariance": two, "measurement": 1.0, "H": b.T, "R": one},
        kalman.update_factor: {"estimate": [0.0, 0.0], "factor": two, "measurement": 1.0, "H": b.T, "R_factor": one},
        riccati.continuous: {"A": two, "B": two, "Q": two, "R": two},
        riccati.discrete: {"A": two, "B": two, "Q": two, "R": two},
        riccati.lyapunov: {"A": -two, "Q": two},
        riccati.lyapunov_certificate: {"closed_loop": -two},
        riccati.dual: {},
        riccati.Control: {"transition": two, "input": b, "state_weight": two, "control_weight": one},
        riccati.integral_states: {"A": two, "B": b, "output": b.T},
        riccati.lqg: {
            "transition": two,
            "B": b,
            "H": b.T,
            "noise": two,
            "R": one,
            "state_weight": two,
            "control_weight": one,
        },
        riccati.lqr: {"A": two, "B": two, "Q": two, "R": two},
        riccati.rate: {"S": two, "A": two, "B": b, "Q": two, "R": one},
        riccati.recursion: {"S": two, "A": two, "B": b, "Q": two, "R": one},
        riccati.reference_input: {"A": np.array([[0.0, 1.0], [-1.0, -1.0]]), "B": b, "output": np.array([[1.0, 0.0]])},
        riccati.undetectable: {"A": two, "H": b.T},
        riccati.unstabilisable: {"A": two, "B": b},
        so3.antisymmetric_part: {"matrix": np.eye(3)},
        so3.body_gradient: {"function": ca.trace, "matrix": np.eye(3)},
        so3.cross: {"vector": np.ones(3)},
        so3.exp: {"vector": np.ones(3)},
        so3.from_quaternion: {"quaternion": [1.0, 0.0, 0.0, 0.0]},
        so3.increment: {"first": np.ones(3), "middle": np.ones(3), "last": np.ones(3), "h": 0.1},
        so3.inverse_left_jacobian: {"vector": np.ones(3)},
        so3.is_rotation: {"matrix": np.eye(3), "tolerance": 1e-6},
        so3.left_jacobian: {"vector": np.ones(3)},
        so3.log: {"matrix": np.eye(3)},
        so3.principal: {"axis": 1, "angle": 0.1},
        so3.project: {"matrix": np.eye(3)},
        so3.quaternion_product: {"first": [1.0, 0.0, 0.0, 0.0], "second": [1.0, 0.0, 0.0, 0.0]},
        so3.quaternion_step: {"quaternion": [1.0, 0.0, 0.0, 0.0], "vector": np.ones(3)},
        so3.runge_kutta_step: {
            "dynamics": lambda C, x: (x, x),
            "matrix": np.eye(3),
            "state": np.ones(3),
            "h": 0.1,
        },
        so3.to_quaternion: {"matrix": np.eye(3)},
        so3.vee: {"matrix": np.zeros((3, 3))},
        theta_d.expansion: {**series, "B": b, "R": one},
        theta_d.regulator: {**series, "B": b, "R": one},
        theta_d.filter_gain: {"x": x, "A0": series["A0"], "A": factor, "H": b.T, "W": two, "V": one},
        theta_d.filter_expansion: {"x": x, "A0": series["A0"], "A": factor, "H": b.T, "W": two, "V": one},
        theta_d.servo: {"x": x, "A0": series["A0"], "A": factor, "B": b, "output": b.T, "Q": np.eye(3), "R": one},
        theta_d.integral_states: {"x": x, "A0": series["A0"], "A": factor, "B": b, "output": b.T},
        theta_d.check_factorisation: {"x": x, "A0": series["A0"], "A": factor, "f": (ca.DM(series["A0"]) + factor) @ x},
        theta_d.convergence: {**series, "B": b, "R": one, "states": np.ones((2, 2))},
    }
    for function, given in valid.items():
        for argument, call in called(function, **given):
            yield function.__module__.split(".")[-1] + "." + function.__name__, argument, call


def solved_statements() -> Iterator[tuple[str, str, Call]]:
    """Those of `statements` that are solved here only: the others are the same calls in both."""
    for function, argument, call in statements(solved=True):
        if argument != "guess" and (argument in READ_LATER or function == "Gain"):
            yield function, argument, call


# Name of the function, name of the argument, and the call with a value for it.
CASES: dict[str, Callable[[], Iterator[tuple[str, str, Call]]]] = {
    function.__name__: function for function in (statements, solving, in_phases, results, simulations, exports, laws)
}
SLOW = {"statements that are solved": solved_statements}
