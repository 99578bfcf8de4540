"""Where a gain that is optimised starts: from the best one of another solution, or of weights that meet the conditions.

The feedback of a gain of zero leaves an unstable plant to itself, and the root of its deviations has no slope there.
The best gain is had from a Riccati equation, and a gain that meets conditions g(X) <= c at the least cost is the best
one of a problem with the weights of X that the multipliers of the conditions are. So along the nominal of the best gain
without conditions these weights are raised and lowered until the conditions on X alone are nearly met; what is left,
and the nominal, is the solver's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError, SolveError, without_warnings
from covocp.base.expressions import Given
from covocp.base.matrices import Array, distinct, pack, unpack
from covocp.base.progress import Progress
from covocp.base.quadrature import interpolated
from covocp.base.short_repr import short_repr
from covocp.extremal.closed_loop import ClosedLoop, close_loop
from covocp.extremal.extremal import Outcome
from covocp.extremal.given_controls import evaluate_controls, evaluation_mesh
from covocp.problem.builder import Problem
from covocp.problem.closed_loop_covariance import SMALLEST_VARIANCE, reasons, used_in, with_best_gain
from covocp.problem.declarations import Declarations, Parameter, Place
from covocp.problem.expected_cost import ESTIMATE, GAIN, statement_of
from covocp.solution.origin import METHOD
from covocp.solution.solution import Solution
from covocp.solving.attempts import with_stats
from covocp.statement.names import stacked_parameters
from covocp.statement.statement import Block, Statement
from covocp.transcription.mesh import Options

if TYPE_CHECKING:
    from covocp.solving.solver import Solver

# Parameters of the problem with weights of X: on the way and at the end.
WEIGHTS: dict[Place, str] = {"path": "weights of X on the way", "final": "weights of X at the end"}
# Rounds in which weights are raised and lowered; the factor by which one round may change them.
ROUNDS, LARGEST_FACTOR = 16, 30.0
# A condition counts as met up to this share of what feedback can take from it.
MET = 0.05
# Share by which a limit must be passed before a problem is refused: more than steps and tolerances explain.
SURELY = 1e-5
# Multiples of E up to which it is seen whether a condition rises with X, and how many of them.
LARGEST_SPREAD, SPREADS = 1e4, 40
# Eigenvalue of a slope, relative to the largest, that is zero but for rounding.
ROUNDOFF = 1e-9


class GainStart(Protocol):
    """What makes the solution with the best gain, and what a run starts from."""

    def __call__(self, guess: Given, reporter: Progress, *, along: bool = ...) -> tuple[Solution | None, Given]:
        """Both, from what the user gave; `along`: also where that is a solution, from there."""


def with_best_gain_problems(problem: Problem) -> tuple[Problem, ...]:
    """The problem with the best gain, with E for X in its conditions, and without them; none where none asks for X."""
    chosen = [with_best_gain(problem.declarations, conditions=kept) for kept in (True, False)]
    problems = tuple(Problem.of(declarations) for declarations in chosen if declarations is not None)
    for one in problems:
        one.doubts_told = True  # of the problem that they are made from
    return problems


def best_gain(
    solvers: tuple[Solver, ...],
    parameters: Mapping[str, Any] | None,
    guess: Given,
    reporter: Progress,
    *,
    along: bool = False,
) -> Solution | None:
    """The solution with the best gain, without the conditions that ask for another: where a free gain starts.

    Args:
        solvers: of the problems with the best gain, in the order in which they are tried.
        parameters: as the user gave them.
        guess: likewise; one that says where the gain starts needs no other.
        reporter: of the iterations, with the limits of all runs together.
        along: whether it is wanted all the same, where a solution is given.
    """
    from covocp.solving.warm_start import Later

    named = isinstance(guess, Mapping) and not any(str(key) in (GAIN, ESTIMATE) for key in guess)
    plan = {"guess": guess.plan, "elapsed": guess.elapsed} if isinstance(guess, Later) else {"guess": guess}
    for solver in solvers if guess is None or named or along else ():
        if reporter.stop:
            break
        seconds, iterations = reporter.left
        run = {**plan, "time_limit": seconds, "iteration_limit": iterations, "allow_failure": True}
        try:
            with without_warnings():  # they concern another solution
                best: Solution = solver.solve(parameters, progress=False, **run)
        except CovocpError:  # E alone may pass the limits; or they may be what keeps the nominal in its domain
            continue
        reporter.count(int(best.stats["iterations"]))
        if best.converged:
            return best
    return None


def with_gain_told(problem: Problem, outcome: Outcome, best: Solution | None) -> Outcome:
    """An outcome that says why its gain is free and, where it failed, which limits of X no gain may keep.

    Args:
        problem: that was solved.
        outcome: of the run.
        best: solution with the best gain, where the run started.
    """
    asked = reasons(problem.declarations)
    if not asked:
        return outcome
    from covocp.solution.report import ASKED

    outcome = with_stats(outcome, **{ASKED: ", ".join(asked)})
    if outcome.converged:
        return outcome
    return replace(outcome, message=ended(outcome.message, beyond(problem.declarations, best)))


def ended(message: str, more: str) -> str:
    """A message with more at its end."""
    return message.rstrip(".") + more if more else message


def beyond(own: Declarations, best: Solution | None, *, surely: bool = False) -> str:
    """Which limits of X no gain may keep along the nominal of the best gain, as the end of a message; or nothing.

    Args:
        own: the problem.
        best: solution with the best gain.
        surely: only those that rise with X, and are passed by more than steps and tolerances explain.
    """
    if best is None or best.loop is None or own.spread is None:
        return ""
    from covocp.solving.below_error import chances_below

    least = spread_halves(best.loop, fed=False)
    told = []
    for row in rows_of(own):
        floor = row.over(best, least)[0]
        k = int(np.argmax(floor))
        more = SURELY * max(abs(floor[k]), abs(row.limit)) if surely else 0.0
        if floor[k] > row.limit + more and (not surely or _rises(row, best, least)):
            t = best.t[-floor.size :][k]
            told.append(f"'{row.name}' is {floor[k]:.4g} at {t:.4g} s with E for X, above its limit {row.limit:.4g}")
    listed = "; ".join([*told, *([] if surely else chances_below(own, best))])
    return f"; no feedback takes X below E: along the nominal of the best gain {listed}" if listed else ""


def _rises(row: Row, best: Solution, least: Array) -> bool:
    """Whether a condition rises with X from E on: seen along multiples of E, which are all there is of one variance."""
    slopes = [row.over(best, times * least)[1] for times in np.geomspace(1.0, LARGEST_SPREAD, SPREADS)]
    constant = all(np.allclose(slope, slopes[0], rtol=ROUNDOFF, atol=0.0) for slope in slopes)
    size = round((np.sqrt(8 * least.shape[1] + 1) - 1) / 2)
    halves = 0.5 + 0.5 * np.eye(size)  # an entry beside the diagonal stands for two
    matrices = np.array([[unpack(part, size) * halves for part in slope] for slope in slopes])
    entries = np.abs(matrices).max(axis=(0, 1))
    alone = np.count_nonzero(entries) == 1 and np.trace(entries) > 0
    values = np.linalg.eigvalsh(matrices)
    return (constant or alone) and bool((values[..., 0] >= -ROUNDOFF * np.abs(values).max()).all())


def gain_first(
    solvers: tuple[Solver, ...],
    problem: Problem,
    statement: Statement,
    parameters: Mapping[str, Any],
    guess: Given,
    reporter: Progress,
    *,
    allow_failure: bool,
    along: bool = False,
) -> tuple[Solution | None, Given]:
    """The solution with the best gain where X asks for a gain, and what a run starts from.

    Args:
        solvers: of the problems with the best gain.
        problem: with the conditions.
        statement: the same.
        parameters: values of parameters other than the declared ones, by name.
        guess: that the user gave.
        reporter: of iterations.
        allow_failure: whether what is impossible is tried all the same.
        along: whether the best gain is wanted where a solution is given, too.

    Raises:
        SolveError: no feedback can keep a limit of X.
    """
    first = best_gain(solvers, parameters, guess, reporter, along=along)
    if first is None:
        return None, guess
    if not allow_failure:
        check_possible(problem.declarations, statement, first)
    return first, first if reporter.stop else meeting_conditions(problem, first, parameters)


def check_possible(own: Declarations, statement: Statement, best: Solution | None) -> None:
    """Conditions that no feedback meets, where nothing that is chosen changes what the filter learns.

    Args:
        own: the problem.
        statement: the same.
        best: solution with the best gain, without these conditions.

    Raises:
        SolveError: names them, with their values for the error of the filter alone; `best` is on it.
    """
    impossible = "" if estimation_varies(statement) else beyond(own, best, surely=True)
    if impossible:
        raise SolveError(
            f"'{statement.name or 'The problem'}' has no solution{impossible}. What the filter learns does not depend "
            "on the nominal here: widen the limit, or measure more. On this error (.solution): the best without it.",
            solution=best,
        )


def estimation_varies(statement: Statement) -> bool:
    """Whether what the filter knows at the end depends on what is chosen: the nominal, the duration, its start."""
    estimation = [i for i, block in enumerate(statement.matrices) if block.estimation]
    read = None if statement.samples is None else statement.samples.measurement
    if not estimation or statement.duration.free or statement.varies(estimation[0]) or statement.tied is not None:
        return True
    return read is not None and any(read.jac_sparsity(k, i).nnz() for k in (1, 2) for i in (0, 1))


def free_gain_block(statement: Statement) -> Block | None:
    """The entries of a gain that is optimised: a control, or a state that is constant; None where there are none."""
    if statement.loop is None or statement.behind:
        return None
    return next((b for b in (*statement.controls, *statement.states) if b.name == GAIN), None)


def gain_entries(statement: Statement, block: Block, solution: Solution, at: Array) -> Array:
    """The entries of a free gain at some places t/T, (K, size), from the gains of a solution, within their bounds."""
    assert statement.loop is not None
    assert solution.loop is not None
    constant = block.kind == "state"
    bounds = statement.state_bounds if constant else statement.control_bounds
    rows, columns = (np.array(v) for v in statement.loop.gain.jac_sparsity(0, 0 if constant else 1).get_triplet())
    inside = (columns >= block.span.start) & (columns < block.span.stop)
    chosen = rows[inside][np.argsort(columns[inside])]  # entries of the gain, column by column
    gains = solution.loop.gain.transpose(0, 2, 1).reshape(solution.t.size, -1)[:, chosen]
    values = interpolated(gains, solution.t / solution.duration, at)
    if constant:
        values = np.tile(np.mean(values, axis=0), (at.size, 1))
    return np.asarray(np.clip(values, bounds[0][block.span], bounds[1][block.span]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """A condition on X alone, g(X) <= limit, and its name.

    known: names of the parameters and unknowns; function: (time, these, half-vector of X) -> g, its slope by X.
    """

    name: str
    place: Place
    limit: float
    known: tuple[str, ...]
    function: ca.Function

    __repr__ = short_repr

    def over(self, along: Solution, halves: Array) -> tuple[Array, Array]:
        """g and its slopes where it holds along a solution, (K,) and (K, entries)."""
        at = slice(None) if self.place == "path" else slice(-1, None)
        time, halves = along.t[at], halves[at]
        given = {b.name: along.parameters[b.span] for b in along.blocks if b.kind in ("parameter", "unknown")}
        parameters = np.concatenate([np.zeros(0), *(given[name] for name in self.known)])
        columns = (time[None, :], np.tile(parameters[:, None], (1, time.size)), halves.T)
        value, slope = (np.asarray(v.full()) for v in self.function.map(time.size)(*columns))
        return value.ravel(), slope.reshape(time.size, -1)


def meeting_conditions(problem: Problem, best: Solution, parameters: Mapping[str, Any]) -> Solution:
    """A solution along the same nominal whose gain nearly meets the conditions on X alone; `best` where none is needed.

    Args:
        problem: with the conditions.
        best: solution with the best gain, without them.
        parameters: values of parameters other than the declared ones, by name.
    """
    own = problem.declarations
    rows = rows_of(own)
    if not rows or best.loop is None:
        return best
    try:
        statement = statement_of(weighted(own))
        found = _searched(statement, rows, best, parameters)
    except (CovocpError, RuntimeError):  # a weight that no gain exists for: the best gain is a start as well
        return best
    return best if found is None else found


def rows_of(own: Declarations) -> list[Row]:
    """The conditions on X alone that have an upper limit, row by row."""
    if own.spread is None:
        return []
    constants: list[Any] = [*own.parameters, *own.unknowns]
    known = [entry.symbol for entry in constants]
    p, half = ca.vertcat(ca.MX(0, 1), *known), own.spread.symbol
    stacked = ca.MX.sym("p", p.shape[0])
    allowed = {s.__hash__() for s in (*known, own.time, half)}
    rows = []
    for c in own.constraints:
        for i in range(c.lower.size):
            row = c.expression[i]
            alone = all(s.__hash__() in allowed for s in ca.symvar(row))
            if not used_in(own, row) or not alone or not np.isfinite(c.upper[i]) or c.at not in WEIGHTS:
                continue
            inner = ca.Function("row", [own.time, *known, half], [row, ca.densify(ca.jacobian(row, half))])
            parts = ca.vertsplit(stacked, np.cumsum([0, *(s.shape[0] for s in known)]).tolist()) if known else []
            arguments = [own.time, stacked, half]
            function = ca.Function("row", arguments, inner.call([own.time, *parts, half]))
            name = c.name if c.lower.size == 1 else f"{c.name}[{i}]"
            own_names = tuple(entry.name for entry in constants)
            rows.append(Row(name=name, place=c.at, limit=float(c.upper[i]), known=own_names, function=function))
    return rows


def weighted(own: Declarations, of: str = "") -> Declarations:
    """A problem with the best gain and weights of X that are parameters; with `of` at the end of their names."""
    result = with_best_gain(own, conditions=False)
    assert result is not None
    assert result.expected is not None
    assert result.spread is not None
    spread, costs = result.spread, {}
    n = spread.states
    for place, name in WEIGHTS.items():
        size = spread.symbol.shape[0]
        symbol = ca.MX.sym(name, size)
        entry = Parameter(name=name + of, symbol=symbol, size=size, where="", unit="", value=np.zeros(size))
        result = result.adding(parameters=entry)
        kept = ca.DM.ones(size) if place == "path" else ca.DM(pack(np.pad(np.ones((n, n)), (0, spread.size - n))))
        costs[place] = ca.dot(ca.sparsify(kept) * symbol, spread.symbol)
    assert result.expected is not None
    expected = replace(
        result.expected,
        running=result.expected.running + costs["path"],
        terminal=result.expected.terminal + costs["final"],
    )
    return replace(result, expected=expected)


def _searched(statement: Statement, rows: list[Row], best: Solution, parameters: Mapping[str, Any]) -> Solution | None:
    """The solution along the nominal of `best` with weights of X that come closest to the conditions; None: no need."""
    options = Options(grid=distinct(best.mesh.nodes), control=best.mesh.control)  # type: ignore[arg-type]
    assert best.loop is not None
    loop = best.loop
    outcome: Outcome | None = None
    least = spread_halves(loop, fed=False)
    weights = np.zeros(len(rows))
    closest, found = np.inf, outcome
    for turn in range(ROUNDS):
        shares, weights, slopes = raised(rows, weights, best, spread_halves(loop, fed=True), least)
        worst = float(np.max(shares))  # NaN where one is
        if turn == 0 and worst <= 1.0:
            return None
        if outcome is not None and worst < closest:
            closest, found = worst, outcome
        if close_enough(worst, turn):
            break
        values = stacked_parameters(statement, {**parameters, **slopes})
        mesh = evaluation_mesh(statement, options, values)
        outcome = evaluate_controls(statement, mesh, best.trajectory.u, best.duration, values, best.trajectory.x[0])
        closed = close_loop(outcome.extremal) if outcome.converged else None
        if closed is None:
            break
        loop = closed
    return None if found is None else Solution.of(found, METHOD, assess=False)


def close_enough(worst: float, turn: int) -> bool:
    """Whether weights with which the worst condition leaves so much are near enough in a round, or are no use."""
    return not np.isfinite(worst) or (turn > 0 and worst <= 1.0 + MET and (worst >= 1.0 - MET or turn > ROUNDS // 2))


def raised(
    rows: list[Row], weights: Array, best: Solution, halves: Array, least: Array
) -> tuple[list[float], Array, dict[str, Array]]:
    """Of each condition what feedback leaves, as a share of what it may leave; other weights, and the weights of X.

    Args:
        rows: the conditions.
        weights: of each so far.
        best: whose times and parameters count.
        halves: half-vectors of X at the nodes.
        least: those that no feedback can better, E.
    """
    t, after = best.t, weights.copy()
    unit = abs(best.cost) if best.cost else 1.0
    shares = []
    slopes = {name: np.zeros(halves.shape[1]) for name in WEIGHTS.values()}
    for i, row in enumerate(rows):
        value, slope = row.over(best, halves)
        floor = row.over(best, least)[0]
        room = np.maximum(row.limit - floor, MET * np.abs(row.limit - value) + np.finfo(float).tiny)
        share = (value - floor) / room
        k = int(np.argmax(share))
        shares.append(float(share[k]))
        if not weights[i] and shares[i] > 1.0:
            reduced = max(float(value[k] - floor[k]), np.finfo(float).tiny)
            after[i] = unit / reduced / (float(t[-1]) if row.place == "path" else 1.0)
        else:
            after[i] *= float(np.clip(shares[i] ** 2, 1.0 / LARGEST_FACTOR, LARGEST_FACTOR))
        slopes[WEIGHTS[row.place]] += after[i] * slope[k]
    return shares, after, slopes


def spread_halves(loop: ClosedLoop, *, fed: bool) -> Array:
    """Half-vectors of the covariance of states, unknowns and controls at the nodes; with or without the feedback."""
    moved = loop.gain @ loop.Xhat if fed else 0.0 * loop.gain
    inner = loop.X if fed else loop.E
    top = np.concatenate([inner, -moved.transpose(0, 2, 1)], axis=2)
    bottom = np.concatenate([-moved, moved @ loop.gain.transpose(0, 2, 1)], axis=2)
    joint = np.concatenate([top, bottom], axis=1)
    diagonal = np.arange(joint.shape[1])
    joint[:, diagonal, diagonal] = np.maximum(joint[:, diagonal, diagonal], SMALLEST_VARIANCE)
    return pack(joint)
