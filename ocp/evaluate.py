"""What a given nominal costs: costs, covariances and gains along a control history, without optimising.

Quadratic synthesis [Schmidt 6.3] is this with the nominal of the deterministic cost; the effect of incorrect
statistics [6.11] is this with the gains of the design and the covariances of the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.accuracy import finer_steps
from covocp.checks import as_number, check_density, check_kind
from covocp.closed_loop import Statistics, close_loop, densities
from covocp.doubts import mention_doubts
from covocp.errors import ProblemError, describe, evaluating, no_option
from covocp.extremal import Extremal, Outcome
from covocp.forgotten import mention_forgotten
from covocp.grading import graded
from covocp.guess import check_model, controls_guess, evaluate_guess, resolve_mesh, starts
from covocp.lookup import name_of, stacked_parameters
from covocp.matrices import Array, unpack
from covocp.mesh import Mesh, Options
from covocp.nlp import check_costs
from covocp.path_limits import NOTED
from covocp.problem import Problem
from covocp.shooting import single_shooting
from covocp.solution import Solution
from covocp.statement import Statement, entry_names
from covocp.threads import one_at_a_time
from covocp.trajectory import Multipliers, Trajectory

METHOD = "evaluate"
# Miss of a prescribed final value or a bound that is reported, relative to the largest value; of conditions absolute.
MISS = 1e-6
# By how much Ipopt may pass a bound of a variable of the order of 1: a nominal of its is no miss.
RELAXED = 1e-8
# Relative difference of rates or slopes above which the truth is another system.
SAME = 1e-9


@one_at_a_time
def evaluate(
    problem: Problem | Solution,
    *,
    nominal: Any = None,
    truth: Any = None,
    intervals: int = 100,
    parameters: Mapping[str, Any] | None = None,
    **options: Any,
) -> Solution:
    """Evaluate costs, covariances and gains along a given nominal, or a solution under other statistics.

    Args:
        problem: the problem; or a solution, whose nominal and gains are kept.
        nominal: the control: a solution (of any problem with controls of these names), or a dict of control to number,
            array over the nodes, or function of s = t/T; None: the guesses of the controls. The states follow.
        truth: what the statistics really are, for a solution with an expected cost: a problem of the same symbols
            (its variances and noise densities count), or a dict of parameter name to value.
        intervals: number of control intervals, where the nominal is not a solution.
        parameters: values of parameters other than the declared ones, by name.
        options: of the mesh, as in `solve`.

    Returns:
        A solution by the method "evaluate"; terminal conditions that the nominal misses are among its `violations`.

    Raises:
        ProblemError: a control is not given, a name is unknown, `truth` has other symbols.
    """
    if isinstance(problem, Solution):
        if nominal is not None or options or parameters is not None:
            raise ProblemError(
                describe(
                    "evaluate(solution) keeps its nominal, mesh and parameters.",
                    expected="truth=... only",
                    received="nominal=, parameters= or options of the mesh",
                    remedy="evaluate the problem along the solution: evaluate(problem, nominal=solution)",
                )
            )
        solution = problem
    else:
        with evaluating(str(getattr(problem, "name", ""))):
            solution = _along(problem, nominal, intervals, {} if parameters is None else parameters, options)
    return solution if truth is None else _under(solution, truth)


def _along(
    problem: Problem, nominal: Any, intervals: int, parameters: Mapping[str, Any], options: dict[str, Any]
) -> Solution:
    """The problem along a nominal."""
    check_kind(problem, Problem, "evaluate(problem, nominal=...), or evaluate(solution, truth=...)")
    st = problem.statement()
    mention_forgotten(problem)
    values = stacked_parameters(st, parameters)
    given = Options(intervals=intervals, **_known(options))
    if isinstance(nominal, Solution) and not options:
        own = nominal.mesh
        given = replace(given, grid=own.nodes, control=own.control)  # type: ignore[arg-type]
    given = graded(st, given, values)
    mesh = evaluation_mesh(st, given, values)
    u, duration = _controls(st, mesh, nominal, given.grading.get("intervals_asked", 0))
    x0, e0 = starts(st, mesh, values)
    if isinstance(nominal, Solution):
        x0 = _started_like(st, nominal, x0, values)
    check_model(st, x0, u[:1].ravel(), e0, duration, values)
    outcome = evaluate_controls(st, mesh, u, duration, values, x0)
    own_steps = given.substeps == "auto"
    while own_steps and outcome.converged and (finer := finer_steps(outcome.extremal, given)):
        shorter = evaluate_controls(st, evaluation_mesh(st, finer, values), u, duration, values, x0)
        if not shorter.converged:
            break
        outcome, given = shorter, finer
    if outcome.converged:
        check_costs(outcome.extremal.trajectory, outcome.cost_terms["running"], outcome.cost_terms["terminal"])
    solution = Solution.of(replace(outcome, stats=given.grading), METHOD)
    if not solution.converged:
        return solution
    mention_doubts(solution)
    return replace(solution, violations=_with_passed(solution))


def _with_passed(solution: Solution) -> dict[str, float]:
    """What a nominal misses, and the limits that it passes between the nodes."""
    result = dict(solution.violations)
    for entry in solution.passed_limits():
        name = f"bounds of {entry.name}" if entry.name in solution.state_names else entry.name
        if entry.share > NOTED:
            result[name] = max(result.get(name, 0.0), entry.by)
    return result


def _started_like(statement: Statement, nominal: Solution, x0: Array, parameters: Array) -> Array:
    """The initial state, with what is free there as in a solution that has it: constant gains are such states."""
    result, known = x0.copy(), statement.boundary_values(parameters)[0]
    own = {block.name: block for block in nominal.blocks if block.kind == "state"}
    for block in statement.states:
        if block.name in own and own[block.name].size == block.size:
            first = nominal.trajectory.x[0, own[block.name].span]
            result[block.span] = np.where(np.isnan(known[block.span]), first, x0[block.span])
    return result


def _known(options: dict[str, Any]) -> dict[str, Any]:
    """Options of the mesh; others mean nothing here."""
    known = {field.name for field in fields(Options)} - {"intervals", "points"}  # nothing is imposed here
    for name in options:
        if name not in known:
            raise no_option("evaluate()", name, options[name], known)
    return options


def evaluation_mesh(statement: Statement, options: Options, parameters: Array) -> Mesh:
    """One segment over the whole time, with the matrices propagated along it."""
    mesh = resolve_mesh(statement, options, parameters)
    return replace(mesh, segments=(mesh.intervals,), eliminated=True, points=1)


def evaluate_controls(
    statement: Statement, mesh: Mesh, u: Array, duration: float, parameters: Array, start: Array | None = None
) -> Outcome:
    """The outcome of given controls: states and matrices from the start, costs, what is missed.

    Args:
        statement: the problem.
        mesh: of one segment.
        u: control values, (N + 1 or N, nu).
        duration: T [s].
        parameters: of the statement.
        start: state at the start; None: the statement's, free entries guessed.
    """
    x0, e0 = starts(statement, mesh, parameters)
    x0 = x0 if start is None else start
    symbols = [
        ca.MX.sym("u", statement.nu, mesh.control_nodes),
        ca.MX.sym("x0", statement.nx),
        ca.MX.sym("e0", statement.ne),
        ca.MX.sym("T"),
        ca.MX.sym("p", statement.np),
    ]
    x, e, cost = single_shooting(statement, mesh, symbols[0], tuple(symbols[1:]))
    outputs = ca.Function("along", symbols, [x, e, ca.sum2(cost)])(u.T, x0, e0, duration, parameters)
    at_nodes, halves, running = (np.asarray(value.full()) for value in outputs)
    trajectory = Trajectory(x=at_nodes.T, u=u, e=halves.T, duration=duration)
    terminal = float(statement.terminal(trajectory.x[-1], trajectory.e[-1], duration, parameters))
    extremal = Extremal(
        statement=statement,
        mesh=mesh,
        trajectory=trajectory,
        parameters=parameters,
        multipliers=Multipliers.zero(statement, mesh),
    )
    finite = bool(np.isfinite(at_nodes).all() and np.isfinite(halves).all() and np.isfinite(running).all())
    return Outcome(
        extremal=extremal,
        cost_terms={"terminal": terminal, "running": float(running.item())},
        converged=finite,
        message="evaluated along a given nominal" if finite else "the model becomes NaN or inf along this nominal",
        violations=missed(extremal) if finite else {},
        stats={},
    )


def missed(extremal: Extremal) -> dict[str, float]:
    """Prescribed final values, bounds, terminal and path inequalities that the nominal does not meet, by name."""
    st, t = extremal.statement, extremal.trajectory
    result = {}
    target = st.boundary_values(extremal.parameters)[1]
    scale = np.maximum(np.abs(t.x).max(axis=0, initial=0.0), np.abs(np.nan_to_num(target)))
    for name, value, goal, size in zip(st.state_names, t.x[-1], target, scale, strict=True):
        if abs(value - goal) > MISS * size:  # NaN where it is free
            result[f"final value of {name}"] = float(abs(value - goal))
    for names, rows, (lower, upper) in (
        (st.state_names, t.x, st.state_bounds),
        (st.control_names, t.u, st.control_bounds),
    ):
        excess = np.maximum(lower - rows, rows - upper).max(axis=0, initial=0.0)
        allowed = MISS * np.abs(rows).max(axis=0, initial=0.0) + RELAXED
        result |= {f"bounds of {n}": float(v) for n, v, a in zip(names, excess, allowed, strict=True) if v > a}
    columns = [np.asarray(c) for c in extremal.columns()]
    for conditions, at in ((st.path, slice(None)), (st.start, slice(0, 1)), (st.end, slice(-1, None))):
        if not conditions.size:
            continue
        chosen = [c[:, at] for c in columns]
        rows = np.asarray(conditions.function.map(chosen[0].shape[1])(*chosen).full()).T
        excess = np.maximum(conditions.lower - rows, rows - conditions.upper).max(axis=0)
        result |= {n: float(v) for n, v in zip(conditions.names, excess, strict=True) if v > MISS}
    return result


def _controls(statement: Statement, mesh: Mesh, nominal: Any, asked: int) -> tuple[Array, float]:
    """Control values on a mesh, and the terminal time, as given; `asked`: intervals before grading, or 0."""
    nodes, duration = mesh.nodes, statement.duration.guess
    at = nodes if mesh.control == "linear" else 0.5 * (nodes[1:] + nodes[:-1])
    if nominal is None:
        return controls_guess(statement, nodes, mesh.control, sign=0.0), duration
    if isinstance(nominal, Solution):
        duration = nominal.duration if statement.duration.free else duration
        same = nominal.mesh.control == mesh.control and np.array_equal(nominal.mesh.nodes, nodes)
        sample = nominal.at(at * nominal.duration)
        columns = []
        for block in statement.controls:
            if block.name not in {b.name for b in nominal.blocks if b.kind == "control"}:
                raise _not_given(block.name, f"a solution of '{nominal.name}' without it")
            own = nominal.block(block.name)
            columns.append(nominal.trajectory.u[:, own.span] if same else sample[block.name].reshape(-1, block.size))
        return np.concatenate([np.zeros((at.size, 0)), *columns], axis=1), duration
    if not isinstance(nominal, Mapping):
        raise ProblemError(
            describe(
                "The nominal is of an unknown kind.",
                expected="a Solution, or a dict of control to number, array over the nodes or function of s = t/T",
                received=repr(nominal)[:100],
                remedy="correct nominal=",
            )
        )
    names = tuple(block.name for block in statement.controls)
    given = {name_of(key, statement.symbols, names): value for key, value in nominal.items()}
    columns = []
    for block in statement.controls:
        if block.name not in given:
            raise _not_given(block.name, ", ".join(given) or "nothing")
        value = given[block.name]
        value = value if callable(value) else as_number(block.name, "guess", value)
        if asked and mesh.control == "constant" and np.ndim(value) and value.shape[0] == asked:
            value = value[(at * asked).astype(int)]  # one for each interval that was asked for
        columns.append(evaluate_guess(block, value, at))
    return np.concatenate([np.zeros((at.size, 0)), *columns], axis=1), duration


def _not_given(name: str, received: str) -> ProblemError:
    return ProblemError(
        describe(
            f"The nominal does not give the control '{name}'.",
            expected="a history of every control",
            received=received,
            remedy=f"add '{name}' to nominal=",
        )
    )


def _under(solution: Solution, truth: Any) -> Solution:
    """The solution with the covariances and the cost of other statistics, and the gains of its design."""
    if solution.loop is None:
        raise ProblemError(
            describe(
                "truth= needs a closed loop.",
                expected="a solution of a problem with minimize_expected()",
                received=f"'{solution.name}' with a deterministic cost",
                remedy="for an estimator alone, simulate(solution, truth=...) shows the effect",
            )
        )
    loop = close_loop(solution.extremal, true_statistics(solution.extremal, truth))
    if loop is None:
        raise ProblemError(
            describe(
                "The covariances under this truth are no numbers.",
                expected="finite covariances with the gains of the design",
                received="inf or NaN on the way",
                remedy="check the variances and densities of truth=, and that the solution converged",
            )
        )
    return replace(
        solution,
        method=METHOD,
        message="evaluated under other statistics than the design's",
        cost_terms=dict(loop.cost),
        loop=loop,
        stored_optimality=None,
    )


def true_statistics(extremal: Extremal, truth: Any) -> Statistics:
    """Initial covariance and noise densities of a truth.

    Raises:
        ProblemError: where it is neither a problem nor a dict, or has other symbols, initial means, rates, measurements
            or another duration.
    """
    st = extremal.statement
    if isinstance(truth, Mapping):
        other, values = st, stacked_parameters(st, truth, extremal.parameters)
    elif isinstance(truth, Problem):
        other = truth.statement()
        values = other.values
        _check_same(st, other)
    else:
        raise ProblemError(
            describe(
                "The truth is of an unknown kind.",
                expected="a Problem with the same symbols, or a dict of parameter name to value",
                received=repr(truth)[:100],
                remedy="correct truth=",
            )
        )
    _check_system(extremal, other, values)
    block = next((b for b in other.matrices if b.estimation), None)
    if block is None or other.loop is None:
        raise ProblemError(
            describe(
                "The truth has no expected cost, so its statistics are not known.",
                expected="a problem built like the design's, with minimize_expected()",
                received=f"'{other.name}'",
                remedy="build it by the same function with other numbers",
            )
        )
    statistics = Statistics(
        initial=unpack(other.boundary_values(values)[2][block.span], block.size),
        density=densities(other),
        parameters=values,
    )
    _check_densities(extremal, statistics)
    return statistics


def _check_densities(extremal: Extremal, truth: Statistics) -> None:
    """What is truly uncertain must be a covariance or a density, at every node; no noise at all is one too."""
    x, u, _, t, duration, _ = extremal.columns()
    count = extremal.mesh.intervals + 1
    values = truth.density.map(count)(x, u, t, duration, np.tile(truth.parameters[:, None], (1, count)))
    check_density("truth", "initial covariance", truth.initial, definite=False)
    for what, value in zip(("process noise density", "measurement noise density"), values, strict=True):
        numbers = np.asarray(value.full())
        matrices = numbers.reshape(numbers.shape[0], count, -1).transpose(1, 0, 2)
        if matrices.size:
            smallest = np.linalg.eigvalsh(np.nan_to_num(matrices))[:, 0]
            worst = int(np.argmin(np.where(np.isfinite(matrices).all(axis=(1, 2)), smallest, -np.inf)))
            check_density("truth", what, matrices[worst], definite=False)


def _check_same(design: Statement, truth: Statement) -> None:
    """The symbols of both must agree; the linear equations know one system only, so must the rates."""

    def signature(statement: Statement) -> list[tuple[str, str, int]]:
        kinds = ("state", "control", "unknown")
        return [(b.kind, b.name, b.size) for b in statement.blocks if b.kind in kinds]

    measured = (design.measurement_names, truth.measurement_names)
    if signature(design) != signature(truth) or measured[0] != measured[1]:
        raise ProblemError(
            describe(
                "The truth is another system than the design's.",
                expected=", ".join(f"{k} {n} ({s})" for k, n, s in signature(design))
                + "; measured "
                + str(measured[0]),
                received=", ".join(f"{k} {n} ({s})" for k, n, s in signature(truth)) + "; measured " + str(measured[1]),
                remedy="declare the same states, controls, unknowns and measurements in the same order",
            )
        )


def _check_system(design: Extremal, truth: Statement, parameters: Array) -> None:
    """The linear covariance equations know one nominal and one system along it: only its statistics may differ."""
    st = design.statement
    x, u, _, t, duration, own = (np.asarray(column) for column in design.columns())
    count = design.mesh.intervals + 1
    others = np.tile(parameters[:, None], (1, count))
    start, known = truth.boundary_values(parameters)[0], truth.duration
    first, lasts = x[:, :1], design.trajectory.duration if known.free else known.guess
    measured = (", ".join(st.measurement_names),)
    first_loop, other_loop = (None if s.loop is None else s.loop.expansion for s in (st, truth))
    compared: list[tuple[str, tuple[str, ...], Any, Any]] = [
        ("starts elsewhere: the initial mean", st.state_names, first, np.where(np.isnan(start), x[:, 0], start)),
        ("takes another time: the value", ("duration",), duration[:, :1], np.array([lasts])),
    ]
    if unknowns := st.of_kind("unknown"):
        rows = [k for b in unknowns for k in range(b.span.start, b.span.stop)]
        one, two = (values[rows, None] for values in (design.parameters, parameters))
        compared.append(("has another constant: the mean", entry_names(unknowns), one, two))
    functions: tuple[tuple[str, tuple[str, ...], int, Any, Any], ...] = (
        ("moves differently: the rate", st.state_names, 0, st.nominal, truth.nominal),
        ("moves differently: the slope", st.augmented, 0, first_loop, other_loop),
        ("is controlled differently: the slope", st.augmented, 1, first_loop, other_loop),
        ("is measured differently: the slope", measured, 1, st.measurement, truth.measurement),
    )
    for what, names, output, one, two in functions:
        if one is not None and two is not None:
            values = [f.map(count)(x, u, t, duration, p)[output].full() for f, p in ((one, own), (two, others))]
            compared.append((what, names, *values))
    for what, names, one, two in compared:
        two = two.reshape(two.shape[0], -1)
        off = np.array([True])
        if one.shape == two.shape:
            off = np.abs(one - two).max(axis=1) > SAME * np.maximum(np.abs(one).max(axis=1), np.finfo(float).tiny)
        if off.any():
            name = names[min(int(np.flatnonzero(off)[0]), len(names) - 1)]
            raise ProblemError(
                describe(
                    f"The truth {what} of '{name}' along the nominal is another one.",
                    expected="the system of the design, with other variances and noise densities",
                    received=f"'{truth.name}', which differs in more",
                    remedy="use simulate(solution, truth=...), which takes any dynamics",
                )
            )
