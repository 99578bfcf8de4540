"""What a method found of several phases, as solutions of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.links import ChainOutcome, completed, link_residual
from covocp.extremal.mean_effect import noted
from covocp.extremal.phase_loops import PhaseLoop, phase_loops
from covocp.solution.phases import PhasesSolution
from covocp.solution.solution import Solution
from covocp.statement.chain import Chain


def phases_solution(chain: Chain, outcome: ChainOutcome, method: str, *, assess: bool = True) -> PhasesSolution:
    """An outcome as solutions of the phases; link residuals are nan where nothing was chosen.

    Args:
        chain: the phases.
        outcome: what was found.
        method: by which.
        assess: whether the mesh errors of the phases are estimated.
    """
    extremals = tuple(_as_declared(chain, i, extremal) for i, extremal in enumerate(outcome.extremals))
    outcome = replace(outcome, extremals=extremals)
    loops: tuple[PhaseLoop | None, ...] = (None,) * len(outcome.extremals)
    if chain.statements[0].loop is not None:
        loops = phase_loops(outcome.extremals, chain.links)
    try:
        passed = completed(outcome, chain.links)
    except (RuntimeError, ArithmeticError, ValueError):  # costates of a last iterate that is not finite
        if outcome.converged:
            raise
        passed = None
    phases = []
    for i, (st, terms, closed) in enumerate(zip(chain.statements, outcome.cost_terms, loops, strict=True)):
        prefix = f"{st.name}: "
        own = {name.removeprefix(prefix): v for name, v in outcome.violations.items() if name.startswith(prefix)}
        entry = None if passed is None else passed[i]
        within = None if entry is None else entry.within
        if within is not None and closed is not None:
            within = replace(within, deviations=closed.start, handed=closed.handed)
        single = Outcome(
            extremal=outcome.extremals[i] if entry is None else entry.extremal,
            cost_terms=terms,
            converged=outcome.converged,
            message=outcome.message,
            violations=own,
            stats={**_of_phase(outcome.stats, i), **noted(None if closed is None else closed.mean)},
        )
        phases.append(Solution.of(single, method, within, closed, assess=assess))
    residuals = (
        ()
        if passed is None or outcome.given
        else tuple(link_residual(passed[i], passed[i + 1], link) for i, link in enumerate(chain.links))
    )
    return PhasesSolution(
        name=chain.name,
        method=method,
        converged=outcome.converged,
        message=outcome.message,
        phases=tuple(phases),
        link_residuals=residuals or (float("nan"),) * len(chain.links),
        violations=dict(outcome.violations),
        stats=dict(outcome.stats),
        links=chain.links,
    )


def _as_declared(chain: Chain, i: int, extremal: Extremal) -> Extremal:
    """An extremal whose statement has the values that were declared, and of what passes between phases what passed.

    Methods run on statements with the values that were solved for; a solution is told from others by the declared ones.
    """
    passed = [*(chain.links[i - 1].parameters if i else ()), *(chain.links[i].weights if i < len(chain.links) else ())]
    values = chain.statements[i].values.copy()
    values[passed] = extremal.parameters[passed]
    if np.array_equal(values, extremal.statement.values, equal_nan=True):
        return extremal
    return replace(extremal, stated=replace(extremal.statement, values=values))


def _of_phase(stats: Mapping[str, Any], i: int) -> dict[str, Any]:
    """The counts of all phases as those of one of them: of meshes its own intervals."""
    meshes = stats.get("mesh_intervals")
    return dict(stats) if meshes is None else {**stats, "mesh_intervals": tuple(entry[i] for entry in meshes)}
