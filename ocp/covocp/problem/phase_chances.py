"""Conditions on probabilities in phases: what scatters there began to do so in the first phase.

With feedback they are conditions on the covariance of the closed loop, whose gain is then optimised in all phases
(`phase_feedback`). Without it the covariance of the actual system goes through all phases up to the last that has such
a condition, as E does, by X+ = J X J' + N. It is a matrix "X" of its own where something is measured in one of them,
else E itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from covocp.base.errors import ProblemError
from covocp.problem.chances import check_uncertain, uncertainties, with_conditions, with_loop_chances, with_open_loop
from covocp.problem.checks import check_name
from covocp.problem.closed_loop_covariance import SPREAD
from covocp.problem.declarations import Declarations
from covocp.problem.phase_feedback import in_phase


def with_phase_chances(phases: Sequence[Declarations], jumps: Sequence[Any]) -> list[Declarations]:
    """The phases with constraints in place of their conditions on probabilities, and with what scatters in them.

    Args:
        phases: as they were stated.
        jumps: `Jump` records.

    Raises:
        ProblemError: nothing scatters in one, a name is taken.
    """
    last = max((k for k, phase in enumerate(phases) if phase.chances), default=-1)
    missing = any(s.name not in phase.rates for phase in phases for s in phase.states if s.role == "moving")
    fed_back = any(phase.expected is not None for phase in phases)
    if missing:
        return list(phases)  # what is wrong with them is said where they are joined and frozen
    measured = any(phase.measurements for phase in phases[: last + 1])
    uncertain: list[Any] = []
    result = list(phases)
    for k, phase in enumerate(phases if last >= 0 else ()):
        uncertain += [*uncertainties(phase), *(jump.noise for jump in jumps if jump.phase == k)]
        try:
            if fed_back and k <= last and phase.expected is not None:
                check_uncertain(phase.chances, uncertain)
                result[k] = with_loop_chances(phase)
            elif fed_back:
                continue  # phases of which only some have an expected cost are refused where they are joined
            elif k > last and measured:  # what has the same name goes on
                check_name(SPREAD, list(phase.taken))
            elif k <= last:
                check_uncertain(phase.chances, uncertain)
                own, covariance, name = with_open_loop(replace(phase, chances=()), measured)
                result[k] = with_conditions(own, phase.chances, covariance, name)
        except ProblemError as error:
            raise in_phase(phase, error) from error
    return result
