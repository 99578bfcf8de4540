"""The solver of a problem as a law: initial state, parameters and a guess in, a plan out.

The transcription is that of every shooting method, its NLP solver one of CasADi's that has C code. The status is not
the solver's own opinion: it follows from the first-order conditions of a minimum at what it returns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError, no_export_option
from covocp.base.expressions import Given
from covocp.base.linear_solve import COMPILED_SOLVER
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.export.compiled.linking import PLUGINS, Linking
from covocp.export.laws.conditions import INFEASIBLE, STATIONARY, lagrangian_slope, residuals
from covocp.export.laws.law import CODES, QUATERNION, Law, Port, flat, span
from covocp.export.laws.nlp_plugins import hessians, plugin_functions, plugin_settings, refused_option
from covocp.export.laws.plan_steps import are_long, final_multipliers, limits
from covocp.export.laws.replanning import Replannable, replannable, stacked, unit_quaternion
from covocp.export.laws.solver_bounds import coarse, narrowed, nlp_bounds, outside
from covocp.export.text.names import identifier
from covocp.passage.written import Tape
from covocp.problem.builder import Problem
from covocp.solution.solution import Solution
from covocp.solving.solver import Solver
from covocp.transcription.choosing import GROWTH, segment_lengths
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.nlp import NLP
from covocp.transcription.pieces import is_separable
from covocp.transcription.scales import choose_scales, evened
from covocp.transcription.shooting import compiled_steps
from covocp.transcription.stiffness import nominal_along
from covocp.transcription.transcribing import transcribe, written_out

# Cost in units of its slope that counts as zero, and where the slope is taken, in units of the variables.
ROUNDING, APART = 1e-6, 1e-2
# Directions in which the curvature of the cost is looked at, and how far, in units of the variables.
DIRECTIONS, NEAR = 8, 1e-3
# Distance and multiplier of a bound that is not reached at the solution of the export.
UNREACHED = 1e-5
TOLERANCE = 1e-8
# Problems near that of the export by which a solver is tried, and how many of them it may fail to solve.
TRIALS, FAILURES = 6, 3
MOST_POINTS = 12
SEED = 1971
HESSIANS = ("exact", "limited-memory")  # that sqpmethod takes; of another word it says nothing
# Shooting segments where covariances are eliminated, unless changes grow much: with the states at the starts of ten of
# them a QP takes three to eight times longer (lag, oscillator, chains of 4 to 12 rows). With one segment fewer plans of
# Mars entry from starts 20 % away were found: 9 of 11.
FEW_SEGMENTS = 2
STATUS_NAMES = tuple(CODES)
RESIDUALS = ("infeasibility", "stationarity")
# Share of what counts as met by which residuals may differ at the same plan: CasADi's C code of Ipopt leaves another
# slope there, of a stiff plant one of 2e-7 for one of 6e-9.
SAME_RESIDUAL = 0.1
STATUSES = ("OK", "ARGUMENT_NOT_FINITE", "NOT_CONVERGED", "FAILED", "COARSE")
SOLVED = (CODES["OK"], CODES["COARSE"])  # the conditions hold
ABOUT = (
    "A plan from a new start. Begins at the guess (the variables of an earlier plan, or NULL) and returns the nodes of "
    "the plan, its cost, and how well the first-order conditions of a minimum hold (in the solver's units). A saddle "
    "fulfils them too: start from a plan, not from a symmetric guess such as zero. Where it fails, or an argument is "
    "not finite, the plan made at the export is returned, and the status says so.",
)
# What is said of a problem with an expected cost: its plan is no controller.
NOMINAL = (
    "The plan is the nominal only, without gains: the feedback that the expected cost assumes is not in it, so it "
    "cannot be flown in closed loop by itself."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Task:
    """What the core is made of.

    Attributes:
        made: the problem and the arguments of its solver.
        nlp: its transcription.
        solution: of the export.
        scale: of the cost in the solver.
        unit: of the cost, in which it is judged what counts as solved.
        multipliers: of the solution in units of the NLP, of the variables and of the constraints.
        written: the transcription that is written out, with the passages of its tape; None: `nlp` itself.
        steps: what halving the steps may change of a plan, of states and of the cost.
    """

    made: Replannable
    nlp: NLP
    solution: Solution
    scale: float
    unit: float
    multipliers: tuple[Array, Array]
    written: tuple[NLP, Tape] | None
    steps: Array

    __repr__ = short_repr

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in their order."""
        st = self.nlp.statement
        return tuple(b.name for b in (*st.of_kind("parameter"), *st.of_kind("unknown")))


# Options of the export of a problem: those of the mesh and of the plugin, all of them.
OF_SOLVE = frozenset({entry.name for entry in fields(Options)} | {"plugin_options"})
OPTIONS = tuple(sorted(OF_SOLVE | {"name", "overwrite", "tolerance", "method"}))


def solver_law(problem: Problem, method: str, options: Mapping[str, Any]) -> tuple[Law, Linking | None]:
    """The solver of a problem, and what has to be linked with it.

    Args:
        problem: to be solved again and again.
        method: a plugin of CasADi's nlpsol that has C code.
        options: of the mesh; plugin_options.

    Raises:
        ExportError: unknown method or option, or a method that does not solve the problem from its own solution.
        ProblemError: options of the mesh that mean nothing.
        SolveError: the problem itself has no solution.
    """
    if not isinstance(method, str) or method not in PLUGINS:
        raise ExportError(
            f"The method {method!r} has no C code.",
            expected="one of " + ", ".join(map(repr, PLUGINS)),
            received=f"method={method!r}",
            remedy="'sqpmethod' needs nothing else; the others are linked",
        )
    for name in options:
        if name not in OF_SOLVE:
            raise no_export_option("a problem", name, options[name], OPTIONS)
    made = replannable(problem)
    chosen = {name: value for name, value in options.items() if name != "plugin_options"}
    solution = Solver(made.fixed, **chosen).solve(progress=False)
    own = _plugin_options(options)
    alone = solution.mesh.eliminated and len(made.statement.matrices) > 0
    failed = ""
    condensed = alone and chosen.get("segments", "auto") == "auto"
    tries = [
        (exact, mesh, False)
        for exact in hessians(method, own, alone=alone)
        for mesh in ([_condensed(solution)] if condensed and not exact else []) + [solution.mesh]
    ]
    if method == "sqpmethod":
        tries += [(False, mesh, True) for exact, mesh, _ in tries if not exact]
    for exact, mesh, curved in tries:
        task = _task(made, solution, mesh, limited=not exact, curved=curved)
        law = _law(task, method, plugin_settings(method, exact, own, task.unit / task.scale))
        failure = _failure(law)
        if not failure:
            return law, PLUGINS[method]
        failed = f"{task.nlp.w.shape[0]} variables, {task.nlp.g.shape[0]} constraints; {failure}"
    raise ExportError(
        f"The method '{method}' does not solve '{problem.name}' again from its own solution.",
        expected="a plan near that of the export, for initial values near those of the problem",
        received=failed,
        remedy=("another method" if method == "ipopt" else "method='ipopt' (linked)")
        + ", fewer intervals, or plugin_options such as {'max_iter': 1000}",
    )


def _plugin_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the plugin.

    Raises:
        ExportError: they are no mapping, or ask for a Hessian that there is not.
    """
    given = options.get("plugin_options")
    if given is not None and not isinstance(given, Mapping):
        raise ExportError(
            "The option 'plugin_options' is no mapping.",
            expected="a dict of options of the plugin by name, such as {'max_iter': 1000}",
            received=repr(given)[:100],
            remedy="correct plugin_options=",
        )
    own = dict(given or {})
    asked = own.get("hessian_approximation", HESSIANS[0])
    if asked not in HESSIANS:
        raise ExportError(
            "The option 'hessian_approximation' of the plugin has an unknown value.",
            expected=" or ".join(map(repr, HESSIANS)),
            received=repr(asked)[:100],
            remedy="correct plugin_options=",
        )
    return own


def _failure(law: Law) -> str:
    """Why it does not solve the problem of the export again, or most of those near it; "" where it does."""
    failures = 0
    for number, row in enumerate(law.points(np.random.default_rng(SEED), TRIALS)):
        values = law.values(row[None, :])[0]
        failures += int(values[-1]) not in SOLVED
        if failures > (FAILURES if number else 0):
            left = ", ".join(f"{name} {values[span(law.outputs, name)][0]:.1e}" for name in RESIDUALS)
            status = STATUS_NAMES[int(values[-1])]
            return f"{status} {'at the problems near it' if number else 'at its own solution'}, {left}"
    return ""


def _condensed(solution: Solution) -> Mesh:
    """The mesh of a solution with few segments: the QP solvers take the states at their starts for dense variables."""
    mesh, extremal = solution.mesh, solution.extremal
    along = nominal_along(extremal.statement, mesh.nodes, extremal.columns(), mesh.nodes, solution.duration)
    grown = float(np.nan_to_num(mesh.intervals * along.growing / GROWTH, posinf=mesh.intervals))
    count = min(max(FEW_SEGMENTS, int(np.ceil(grown))), len(mesh.segments))
    return replace(mesh, segments=segment_lengths(mesh.intervals, count))


def _task(made: Replannable, solution: Solution, mesh: Mesh, *, limited: bool, curved: bool = False) -> _Task:
    """Transcription near a reference solution; `limited`: for slopes of first order; `curved`: scaled by curvature.

    Curvature that is learnt step by step begins with one: where that of the cost is larger by orders of magnitude, as
    from a large prior, the first steps lead astray.
    """
    statement = made.statement
    mesh = replace(mesh, linear_solver=COMPILED_SOLVER)
    scales = choose_scales(statement, mesh, solution.trajectory, statement.values)
    alone = mesh.eliminated and len(statement.matrices) > 0
    if alone:
        scales = evened(scales, mesh)
    written = None
    if limited and alone and not statement.coupled and compiled_steps(solution.mesh):  # what `mesh` writes out is not
        nlp = written_out(statement, mesh, scales, Tape("evaluated"))
        tape = Tape("written")
        written = written_out(statement, mesh, scales, tape), tape
    else:
        nlp = transcribe(statement, mesh, scales, taken=is_separable(statement, mesh))
    unit = _cost_scale(nlp, solution)
    scale = max(unit, _curvature(nlp, solution)) if curved else unit
    timed = any(entry.port.name == "duration" for entry in made.entries)
    multipliers = _multipliers(nlp, solution, scale, timed=timed)
    return _Task(
        made=made,
        nlp=nlp,
        solution=solution,
        scale=scale,
        unit=unit,
        multipliers=multipliers,
        written=written,
        steps=limits(nlp, nlp.pack(solution.trajectory), multipliers[0], scale),
    )


def _multipliers(nlp: NLP, solution: Solution, scale: float, *, timed: bool) -> tuple[Array, Array]:
    """Multipliers of the solution: those of constraints, then those of bounds that are reached, by stationarity.

    `timed`: whether the duration is a variable that an argument fixes.

    Small ones, as an interior-point method leaves them at all bounds, would each cost the QP solver an iteration.
    """
    costates, p = solution.costates, np.append(nlp.statement.values, scale)
    _, constraints = nlp.pack_multipliers(solution.multipliers, (costates.state, costates.matrices))
    weights, bounds, w = constraints / scale, nlp.bounds(nlp.statement.values), nlp.pack(solution.trajectory)
    weights[np.abs(weights) < UNREACHED] = 0.0
    left = -np.asarray(lagrangian_slope(nlp)(w, p, weights).full()).ravel()
    reached = ((w > bounds["ubx"] - UNREACHED) & (left > 0.0)) | ((w < bounds["lbx"] + UNREACHED) & (left < 0.0))
    reached[-1] |= timed
    return np.where(reached & (np.abs(left) > UNREACHED), left, 0.0), weights


def _cost_scale(nlp: NLP, solution: Solution) -> float:
    """Size of the cost; where that is zero, or nothing but rounding, of its slope near the solution."""
    size = float(np.abs(list(solution.cost_terms.values())).sum())
    near = (1.0 + APART) * nlp.pack(solution.trajectory) + APART
    gradient = lagrangian_slope(nlp)(near, np.append(nlp.statement.values, 1.0), 0.0)
    slope = float(np.abs(np.asarray(gradient.full())).max(initial=0.0))
    if not np.isfinite(slope) or size > ROUNDING * slope:
        return size or 1.0
    return slope or 1.0


def _curvature(nlp: NLP, solution: Solution) -> float:
    """Typical second derivative of the cost in units of the variables, near the solution."""
    w, p, slope = nlp.pack(solution.trajectory), np.append(nlp.statement.values, 1.0), lagrangian_slope(nlp)
    random, found = np.random.default_rng(SEED), []
    for _ in range(DIRECTIONS):
        step = NEAR * random.standard_normal(w.size)
        change = np.asarray((slope(w + step, p, 0.0) - slope(w, p, 0.0)).full())
        found.append(float(np.linalg.norm(change) / max(np.linalg.norm(step), np.finfo(float).tiny)))
    return float(np.nan_to_num(np.median(found), posinf=0.0))


@dataclass(frozen=True, kw_only=True)
class _Core:
    """The function of the law; its inputs are those of `entries` and the guess."""

    function: ca.Function
    results: tuple[Port, ...]

    __repr__ = short_repr


def _core(task: _Task, nlp: NLP, method: str, settings: dict[str, Any], tape: Tape | None = None) -> _Core:
    """The function for these settings, on one form of the transcription; `tape`: as of `changes_by_halves`."""
    entries = task.made.entries
    try:
        parts = {"x": nlp.w, "p": nlp.p, "f": nlp.f, "g": nlp.g}
        solver = ca.nlpsol("nlp", method, parts, {**plugin_functions(nlp, method, settings), **settings})
    except RuntimeError as error:
        raise ExportError(
            f"The plugin '{method}' refuses the problem or its settings.",
            expected="a plugin of this CasADi, and options that it has",
            received=refused_option(str(error)),
            remedy="correct plugin_options, or take another method",
        ) from error
    symbols = {entry.port.name: ca.MX.sym(entry.port.name, entry.port.size) for entry in entries}
    guess = ca.MX.sym("guess", nlp.w.shape[0])
    turned = {  # from the quaternion, not its opposite, that the guess begins with
        entry.port.name: unit_quaternion(symbols[entry.port.name], guess[entry.attitude])
        for entry in entries
        if entry.attitude is not None
    }
    p = ca.vertcat(ca.MX(0, 1), *stacked(task.made, symbols | turned, task.names))
    bounds = nlp_bounds(task.nlp, p, symbols.get("duration"))
    start = ca.fmin(ca.fmax(guess, bounds["lbx"]), bounds["ubx"])
    given: dict[str, Any] = {"x0": start, "lam_x0": task.multipliers[0], "lam_g0": task.multipliers[1]}
    given |= {"p": ca.vertcat(p, task.scale), **(narrowed(bounds) if method == "fatrop" else bounds)}
    result = solver(**given)
    evaluated: Any = nlp.evaluate(result["x"], ca.vertcat(p, 1.0))
    weights = {name: task.scale / task.unit * result[name] for name in ("lam_x", "lam_g")}
    at = {"x": result["x"], "p": ca.vertcat(p, task.unit), "g": evaluated[-1], **bounds, **weights}
    slopes = solver.get_function("nlp_jac_fg") if method == "sqpmethod" else None
    violation, left = residuals(nlp, at, symbols.get("duration", 1.0), slopes)
    violation = ca.fmax(violation, outside(task.nlp, p))
    outputs = _results(task, result["x"], evaluated, (violation, left))
    bad = ca.logic_not(ca.logic_and(violation <= INFEASIBLE, left <= STATIONARY))
    held = final_multipliers(nlp, result["lam_x"], task.scale)
    long, uncertain = are_long(nlp, p, evaluated, held, task.steps, tape), coarse(nlp, p, evaluated)
    long = long if uncertain is None else ca.logic_or(long, uncertain)
    good = ca.if_else(long, CODES["COARSE"], CODES["OK"])
    values = [value for _, value in outputs] + [ca.if_else(bad, CODES["NOT_CONVERGED"], good)]
    function = ca.Function("solve", [*symbols.values(), guess], [flat(v) for v in values])
    return _Core(function=function, results=(*(port for port, _ in outputs), Port(name="status")))


def _law(task: _Task, method: str, settings: dict[str, Any]) -> Law:
    """The law for these settings."""
    nlp, entries = task.nlp, task.made.entries
    made = _core(task, nlp, method, settings, None if task.written is None else Tape("evaluated"))
    core, code, plain = made.function, None, None
    if task.written is not None:
        code = _core(task, task.written[0], method, settings, task.written[1]).function

        def plain() -> ca.Function:
            return _core(task, transcribe(nlp.statement, nlp.mesh, nlp.scales), method, settings).function

    ports = (*(entry.port for entry in entries), Port(name="guess", rows=int(nlp.w.shape[0]), about="where to start"))
    default = np.concatenate([*(entry.value for entry in entries), nlp.pack(task.solution.trajectory)])
    columns = core(*np.split(default, np.cumsum([port.size for port in ports])[:-1]))
    safe = np.concatenate([np.asarray(c.full()).ravel() for c in columns])
    return Law(
        name="solve",
        kind="solver",
        about=ABOUT if task.made.fixed.declarations.expected is None else (*ABOUT, NOMINAL),
        core=core,
        inputs=ports,
        outputs=made.results,
        statuses=STATUSES,
        instead=task.made.instead,
        safe=safe,
        defaults=default,
        points=lambda random, count: _points(task, default, random, count),
        most=MOST_POINTS,
        tolerance=TOLERANCE,
        code=code,
        passages=None if task.written is None else task.written[1].written(),
        plain=plain,
    )


def _results(
    task: _Task, variables: Given, evaluated: Sequence[Any], residuals: tuple[Any, Any]
) -> list[tuple[Port, Any]]:
    """Results of the solver with their values: times, controls, states, cost, residuals, variables."""
    nlp = task.nlp
    x, _, u, duration, running, terminal, _ = evaluated
    last = {
        "cost": (running + terminal, "of the plan"),
        "infeasibility": (residuals[0], "largest violation of a constraint, in the solver's units"),
        "stationarity": (residuals[1], "largest slope of the Lagrangian that is left, in the solver's units"),
        "variables": (variables, "of the solver, the guess of a next call"),
    }
    taken = {entry.port.name for entry in task.made.entries} | {"guess", "time", "status", *last}
    times = Port(name="time", rows=nlp.mesh.nodes.size, unit="s", about="of the nodes")
    results = [(times, duration * ca.DM(nlp.mesh.nodes))]
    for blocks, source, what in ((nlp.statement.controls, u, "control"), (nlp.statement.states, x, "state")):
        for block in blocks:
            name = identifier(block.name if block.name not in taken else f"{what}_{block.name}", taken)
            if block.role == "decision":
                port = Port(name=name, rows=block.size, unit=block.unit, about=f"decision '{block.name}'")
                results.append((port, source[block.span, 0]))
                continue
            about = f"{what} '{block.name}', a row for each {_where(what, nlp)}"
            about += f": {QUATERNION}" if block.tangent else ""
            unit = "" if block.tangent else block.unit  # that of its rotation vector
            port = Port(name=name, rows=int(source.shape[1]), columns=block.size, unit=unit, about=about)
            results.append((port, source[block.span, :].T))
    for n, (v, about) in last.items():  # of residuals, how far they are below what counts as met is rounding
        met = {"infeasibility": INFEASIBLE, "stationarity": STATIONARY}.get(n, 0.0)
        least = SAME_RESIDUAL * met / TOLERANCE
        results.append((Port(name=n, rows=int(v.shape[0]), about=about, least=least), v))
    return results


def _where(what: str, nlp: NLP) -> str:
    """Of which times the rows of a result are."""
    return "interval" if what == "control" and nlp.mesh.control == "constant" else "node"


def _points(task: _Task, default: Array, random: np.random.Generator, count: int) -> Array:
    """The arguments of the export, then others near them; one that is not finite."""
    rows = np.tile(default, (count, 1))
    offset = 0
    for entry in task.made.entries:
        size = entry.port.size
        rows[1:, offset : offset + size] += entry.deviation * random.uniform(-1.0, 1.0, (count - 1, size))
        if entry.limits is not None:
            rows[1:, offset : offset + size] = np.clip(rows[1:, offset : offset + size], *entry.limits)
        if entry.port.columns > 1:
            rows[1:, offset : offset + size] *= random.uniform(0.9, 1.1, (count - 1, 1))
        offset += size
    if count > TRIALS and offset:
        rows[TRIALS, 0] = np.nan
    return rows
