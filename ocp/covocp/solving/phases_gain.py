"""Where the gains of several phases start that are optimised: from the best ones of weights that meet the conditions.

As `gain_start` has it for one problem: first all phases are solved with the best gain, E standing for X in the
conditions, or without these; then the weights of X are raised and lowered along that nominal, all phases together, and
S carries what those of a later phase ask of the ones before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from covocp.base.errors import CovocpError, Interrupted, without_warnings
from covocp.base.expressions import Given
from covocp.base.matrices import Array, distinct
from covocp.extremal.phase_loops import phase_loops
from covocp.problem.closed_loop_covariance import reasons, with_best_gain
from covocp.problem.declarations import Declarations
from covocp.problem.expected_cost import ESTIMATE, GAIN
from covocp.problem.phase_chances import with_phase_chances
from covocp.problem.phase_feedback import gains_of
from covocp.problem.phases import Phases, with_declarations
from covocp.solution.phases import PhasesSolution
from covocp.solution.report import ASKED
from covocp.solving.gain_start import ROUNDS, Row, beyond, close_enough, ended, raised, rows_of, spread_halves, weighted
from covocp.solving.phases_evaluated import Runs, run_all, solved
from covocp.solving.phases_given import given_of_each, values_of
from covocp.statement.chain import Chain
from covocp.statement.names import stacked_parameters
from covocp.transcription.grading import graded
from covocp.transcription.mesh import Options

Solve = Callable[[Phases], PhasesSolution]


def declared(phases: Phases) -> list[Declarations]:
    """What is declared in each phase, with conditions on probabilities as constraints."""
    return with_phase_chances([problem.stated for problem in phases.problems], phases.jumps)


def best_gains(phases: Phases, guesses: Sequence[Any], solve: Solve) -> PhasesSolution | None:
    """The solution with the best gains; None where no gain asks for it, a guess says what it is, or there is none.

    Args:
        phases: that are to be solved.
        guesses: of the phases.
        solve: solves others from the same guess on the same meshes, without raising where it does not converge.

    Raises:
        Interrupted: after Ctrl-C (carries what was found of the best gains until then).
    """
    own = declared(phases)
    if own[0].expected is None or gains_of(own) is None or not all(map(_leaves_open, guesses)):
        return None
    for conditions in (True, False):
        if not conditions and not any(reasons(phase) for phase in own):
            break
        best = [_best(phase, conditions=conditions) for phase in own]
        try:
            with without_warnings():  # they concern another solution
                found = solve(with_declarations(phases, best))
        except CovocpError:  # E alone may pass the limits; or they may be what keeps the nominal in its domain
            continue
        except Interrupted as error:
            text = f"{error} It has the best gain in all phases, from which the one that was asked for was to start."
            raise Interrupted(text, solution=error.solution) from None
        if found.converged:
            return found
    return None


def _leaves_open(guess: Given) -> bool:
    """Whether a guess says nothing of the gain and of what is estimated."""
    return guess is None or (isinstance(guess, Mapping) and not any(str(key) in (GAIN, ESTIMATE) for key in guess))


def meeting_conditions(phases: Phases, best: PhasesSolution, parameters: Mapping[str, Any]) -> PhasesSolution:
    """A solution along the same nominal whose gains nearly meet the conditions on X alone; `best` if none is needed.

    Args:
        phases: with the conditions.
        best: solution with the best gains, without them.
        parameters: values of parameters other than the declared ones, by name.
    """
    own = declared(phases)
    rows = [rows_of(phase) if reasons(phase) else [] for phase in own]
    if not any(rows) or any(phase.loop is None for phase in best):
        return best
    parts = [
        weighted(phase, _of(k)) if listed else _best(phase, conditions=False)
        for k, (phase, listed) in enumerate(zip(own, rows, strict=True))
    ]
    try:
        with without_warnings():
            return _searched(with_declarations(phases, parts), rows, best, parameters)
    except (CovocpError, RuntimeError):  # a weight that no gain exists for: the best gain is a start as well
        return best


def graded_for(best: PhasesSolution, asked: Sequence[Options]) -> tuple[Options, ...]:
    """The options with meshes that are graded for the best gains: towards the end these are as steep as S is."""
    pairs = zip(best, asked, strict=True)
    return tuple(graded(phase.extremal.statement, own, phase.parameters) for phase, own in pairs)


def told(phases: Phases, solution: PhasesSolution, best: PhasesSolution | None) -> PhasesSolution:
    """A solution that says why its gains are free and, where it failed, which limits of X no gain may keep."""
    own = declared(phases)
    asked = [reasons(phase) for phase in own]
    if not any(asked):
        return solution
    changed = []
    for k, (phase, listed) in enumerate(zip(own, asked, strict=True)):
        text = ", ".join(listed) or "conditions or costs of " + _others(solution, asked, k)
        assert phase.expected is not None
        free = listed or phase.expected.gain is None  # else a Gain says what it is
        changed.append(replace(solution[k], stats={**solution[k].stats, **({ASKED: text} if free else {})}))
    result = replace(solution, phases=tuple(changed))
    if solution.converged or best is None:
        return result
    more = "".join(beyond(phase, entry) for phase, entry in zip(own, best, strict=True))
    return replace(result, message=ended(solution.message, more))


def _others(solution: PhasesSolution, asked: Sequence[tuple[str, ...]], k: int) -> str:
    """The phases other than one that ask for free gains."""
    return ", ".join(f"'{phase.name}'" for i, phase in enumerate(solution) if asked[i] and i != k)


def _of(k: int) -> str:
    """What tells the weights of a phase from those of the others."""
    return f", phase {k + 1}"


def _best(own: Declarations, *, conditions: bool) -> Declarations:
    """A phase with the best gain, whose conditions on X are left out or have E in place of it."""
    found = with_best_gain(own, conditions=conditions)
    if found is None:
        assert own.expected is not None
        return replace(own, expected=replace(own.expected, gain=None))
    return replace(found, constraints=tuple(replace(c, chance=None) for c in found.constraints))


def _searched(
    phases: Phases, rows: list[list[Row]], best: PhasesSolution, parameters: Mapping[str, Any]
) -> PhasesSolution:
    """The solution along the nominal of `best` with weights of X that come closest to the conditions."""
    loops = [phase.loop for phase in best]
    least = [spread_halves(loop, fed=False) for loop in loops if loop is not None]
    weights: list[Array] = [np.zeros(len(listed)) for listed in rows]
    chain, nominals = phases.chain(), list(best)
    meshes = [phase.mesh for phase in best]
    options = tuple(Options(grid=distinct(own.nodes), control=own.control) for own in meshes)  # type: ignore[arg-type]
    given, closest, found = values_of(chain, parameters), np.inf, None
    runs: Runs | None = None
    for turn in range(ROUNDS):
        worst, values = 0.0, dict(parameters)
        for k, (listed, loop) in enumerate(zip(rows, loops, strict=True)):
            if not listed or loop is None:
                continue
            halves = spread_halves(loop, fed=True)
            shares, weights[k], slopes = raised(listed, weights[k], best[k], halves, least[k])
            worst = float(np.max([worst, *shares]))  # NaN where one is
            values |= {name + _of(k): value for name, value in slopes.items()}
        if runs is not None and worst < closest:
            closest, found = worst, runs
        if (turn == 0 and worst <= 1.0) or close_enough(worst, turn):
            break
        before = given if runs is None else runs.parameters  # with the weights that the later phases ask for
        runs = run_all(chain, nominals, options, _with_values(chain, before, values))
        extremals = [outcome.extremal for outcome in runs.outcomes]
        loops = [entry.loop for entry in phase_loops(extremals, chain.links)]
        if any(loop is None for loop in loops):
            break
    return best if found is None else solved(chain, found)


def _with_values(chain: Chain, before: Sequence[Array], values: Mapping[str, Any]) -> tuple[Array, ...]:
    """The parameters of each phase with other values of some."""
    return tuple(
        stacked_parameters(replace(st, values=own), given)
        for st, own, given in zip(chain.statements, before, given_of_each(chain.statements, values), strict=True)
    )
