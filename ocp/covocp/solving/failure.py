"""What is said of a run that did not converge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import casadi as ca
import numpy as np

from covocp.base.errors import SolveError
from covocp.base.progress import Progress
from covocp.extremal.densities import impossible_density, impossible_in_phases
from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.given_controls import missed
from covocp.extremal.open_loop import matrices_along_controls
from covocp.solution.solution import Solution
from covocp.transcription.halved_steps import refined_run

if TYPE_CHECKING:
    from covocp.extremal.links import ChainOutcome

# A violation that has not fallen for so many iterations, which are this share of the run, is not on its way to zero.
MANY, MOST = 100, 0.5
# Violations that are named.
NAMED = 10
# How rows begin that keep a state or matrix in one piece.
GAP = "continuity of "
# Share of a value that it may be beyond its limit by rounding.
GIVEN = 1e-9
CONTRADICT = "the constraints may contradict"

AnyOutcome = TypeVar("AnyOutcome", Outcome, "ChainOutcome")


def failure(name: str, method: str, outcome: Outcome, solution: Solution, other_way: str) -> SolveError:
    """The error of a run that did not converge, with its last iterate.

    Args:
        name: of the problem.
        method: that ran.
        outcome: of the run.
        solution: the last iterate.
        other_way: a line about another method; empty: none.
    """
    from covocp.solution.report import stated_first
    from covocp.solving.decisions import bent_cost, bent_data, far_away

    along = _passed_along(outcome) | _passed_by_integrals(outcome)
    violations = along | {row: max(value, along.get(row, 0.0)) for row, value in outcome.violations.items()}
    lines = [f"  {row}: {value:.6g}" for row, value in stated_first(violations)[:NAMED]]
    violated = "\n  violated constraints, by their largest violation:\n" + "\n".join(lines) if lines else ""
    noise = impossible_noises([outcome.extremal], outcome.message)
    given = passed_at_the_start(outcome)
    other_way = "" if given else other_way
    return SolveError(
        f"'{name or 'The problem'}' was not solved by {method}: {outcome.message}."
        f"{violated}{given}{far_away(solution)}{bent_data(solution)}{bent_cost(solution)}{noise}{other_way}"
        "\n  The last iterate is on this error (.solution): plot it, save it, or use it as a guess.",
        solution=solution,
        violations=violations,
    )


def passed_at_the_start(outcome: Outcome) -> str:
    """A line for each limit along the path that what is given at the start passes, whatever the controls are."""
    st, p = outcome.extremal.statement, outcome.extremal.parameters
    x0, _, e0, _ = st.boundary_values(p)
    function, t = st.path.function, outcome.extremal.trajectory
    chosen = {0: np.isnan(x0), 1: np.ones(st.nu, bool), 2: np.isnan(e0), 4: np.array([st.duration.free])}
    given = np.ones(st.path.size, bool)
    for place, free in chosen.items():
        rows, columns = function.jac_sparsity(0, place).get_triplet()
        given[[row for row, column in zip(rows, columns, strict=True) if free[column]]] = False
    if not given.any():
        return ""
    known = function(np.nan_to_num(x0), t.u[0], np.nan_to_num(e0), 0.0, t.duration, p)
    values, lines = np.asarray(ca.DM(known).full()).ravel(), []
    for k in np.flatnonzero(given).tolist():
        name, value, low, high = st.path.names[k], values[k], st.path.lower[k], st.path.upper[k]
        excess = max(low - value, value - high)
        if name in outcome.violations and excess > GIVEN * max(abs(value), outcome.violations[name]):
            side = f"at most {high:.6g}" if value > high else f"at least {low:.6g}"
            lines.append(f"\n  {name} is {value:.6g} at the start, by what is given there, and shall be {side}.")
    return "".join(lines)


def _passed_along(outcome: Outcome) -> dict[str, float]:
    """Limits that the covariances pass which the last controls give, where only the gaps of matrices are left.

    A run whose limits contradict may end with what it cannot have in these gaps, at a covariance that is none of the
    problem: that meets the limits.
    """
    extremal, st = outcome.extremal, outcome.extremal.statement
    gaps = {name.removeprefix(GAP) for name in outcome.violations if name.startswith(GAP)}
    if not gaps or not gaps <= set(st.matrix_names):
        return {}
    try:
        along = matrices_along_controls(extremal)
        given = replace(extremal, trajectory=replace(extremal.trajectory, e=along))
        return missed(given) if np.isfinite(along).all() else {}
    except (RuntimeError, ArithmeticError, ValueError, np.linalg.LinAlgError):  # an iterate without values
        return {}


def _passed_by_integrals(outcome: Outcome) -> dict[str, float]:
    """Limits that integrals pass along the last iterate, where what they pass is spread over their gaps.

    An integral is one whole: all gaps together are what an iterate has left out of it. A run whose limits contradict
    has its share of that at each node, and meets the limit.
    """
    extremal, st = outcome.extremal, outcome.extremal.statement
    entries = [k for b in st.states if b.role == "integral" for k in range(b.span.start, b.span.stop)]
    gaps = [k for k in entries if GAP + st.state_names[k] in outcome.violations]
    if not gaps:
        return {}
    try:
        jumps = refined_run(st, extremal.mesh, extremal.trajectory, extremal.parameters, parts=1).jumps[:, gaps]
        left_out = np.cumsum(jumps, axis=0)
        x, begins = extremal.trajectory.x.copy(), np.array(extremal.mesh.starts[:-1])
        before = np.searchsorted(begins, np.arange(len(x)), side="right") - 1
        before[-1] = len(begins)
        x[:, gaps] += np.vstack([np.zeros(len(gaps)), left_out])[before]
        if not np.isfinite(x).all():
            return {}
        given = replace(extremal, trajectory=replace(extremal.trajectory, x=x))
        believed, found = missed(extremal), missed(given)
    except (RuntimeError, ArithmeticError, ValueError, np.linalg.LinAlgError):  # an iterate without values
        return {}
    return {name: value for name, value in found.items() if value > believed.get(name, 0.0)}


def with_stalled(outcome: AnyOutcome, reporter: Progress) -> AnyOutcome:
    """An outcome that did not converge, whose message tells where its violation has long not fallen any more."""
    iterations = int(outcome.stats.get("iterations", -1))
    stalled = 0 if outcome.converged else reporter.stalled(iterations)
    if stalled < max(MANY, MOST * iterations) or CONTRADICT in outcome.message or not outcome.violations:
        return outcome
    told = f"but in the last {stalled} of {iterations} iterations the violation has not fallen: {CONTRADICT}"
    return replace(outcome, message=f"{outcome.message}; {told}")


def possible(outcome: Outcome) -> tuple[Outcome, bool]:
    """An outcome, not converged where a noise along it is none, and whether that is so."""
    found = impossible_density(outcome.extremal) if outcome.converged else ""
    message = f"the solution found means nothing: {found}"
    return (replace(outcome, converged=False, message=message) if found else outcome), bool(found)


def impossible_noises(extremals: Sequence[Extremal], said: str) -> str:
    """A line on a noise along the last iterate that none can be: where it has led a run, nothing else is the reason.

    Args:
        extremals: of the run, one for each phase.
        said: what is said already.
    """
    try:
        found = impossible_density(extremals[0]) if len(extremals) == 1 else impossible_in_phases(extremals, ())
    except (RuntimeError, ArithmeticError, ValueError, np.linalg.LinAlgError):  # an iterate without values
        return ""
    return "" if not found or found in said else f"\n  Along the last iterate {found}."
