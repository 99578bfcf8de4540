"""Phases with expected costs whose nominal is that of the deterministic problem: what is found from there.

As `from_classical` has it for one problem: where filter and feedback are the same along every nominal, through all
phases and jumps, the deterministic problem has the optimum; where it is a quadratic program it is soon had, while a
Hessian of limited memory creeps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.fine_mesh import refined
from covocp.extremal.given_controls import missed
from covocp.extremal.links import ChainOutcome, completed
from covocp.problem.expected_cost import deterministic
from covocp.problem.phases import Phases, with_declarations
from covocp.solving.from_classical import impatient, is_stationary, run_around, shared_multipliers
from covocp.solving.given_nominal import is_path
from covocp.solving.phases_given import values_of
from covocp.statement.chain import Chain, Link
from covocp.transcription.mesh import Mesh

Arrays = tuple[Array, ...]


class DeterministicChain(NamedTuple):
    """The deterministic problem of phases, and its parameters, which are fewer than those of the whole."""

    chain: Chain
    values: Arrays


def without_noise(phases: Phases, chain: Chain, parameters: Mapping[str, Any]) -> DeterministicChain | None:
    """The deterministic problem of phases where it is a quadratic program that has their optimum; None where it is not.

    Args:
        phases: with expected costs.
        chain: of these.
        parameters: values of parameters and unknowns other than the declared ones, by name.
    """
    own = [problem.declarations for problem in phases.problems]
    if any(phase.expected is None for phase in own) or not all(map(impatient, chain.statements)):
        return None
    if not all(map(_passes_alike, chain.links)):
        return None
    try:
        found = with_declarations(phases, [deterministic(phase) for phase in own]).chain()
        return DeterministicChain(found, values_of(found, parameters))
    except CovocpError:  # a phase whose cost depends on nothing that can be chosen
        return None


def _passes_alike(link: Link) -> bool:
    """Whether states pass by an affine jump, and deviations by the same tangent and noise from everywhere."""
    names = [link.function.name_in(i) for i in range(link.function.n_in())]
    x, e, *rest = [ca.MX.sym(name, link.function.size1_in(i)) for i, name in enumerate(names)]
    states, matrices = link.function(x, e, *rest)
    if any(ca.which_depends(states, x, 2)) or ca.jacobian_sparsity(matrices, x).nnz():
        return False
    tangent = link.deviations
    return tangent is None or not any(tangent.jac_sparsity(k, 0).nnz() for k in range(tangent.n_out()))


@dataclass(frozen=True, kw_only=True, eq=False)
class AroundClassical:
    """Filter and feedback of all phases around the nominal of the deterministic problem, with its multipliers."""

    outcome: ChainOutcome
    links: tuple[Link, ...]

    __repr__ = short_repr

    def optimum(self, *, strict: bool) -> ChainOutcome | None:
        """The outcome where the expected cost is stationary; None where it is not.

        Args:
            strict: as exactly as a run would have it.
        """
        if not self._is_path():
            return None
        parts = zip(completed(self.outcome, self.links), self.outcome.cost_terms, strict=True)
        held = (is_stationary(own.extremal, terms, strict=strict, within=own.within) for own, terms in parts)
        return self.outcome if all(held) else None

    def _is_path(self) -> bool:
        """Whether the states are a path of the system through all phases, which meets the conditions.

        With the parameters of the whole: multipliers of a quadratic program are the same wherever it lies.
        """
        before: Extremal | None = None
        sizes: dict[str, float] = {}  # a state that has decayed is met as exactly as where it was large
        for extremal in self.outcome.extremals:
            for name, size in zip(
                extremal.statement.state_names, np.abs(extremal.trajectory.x).max(axis=0), strict=True
            ):
                sizes[name] = max(float(size), sizes.get(name, 0.0))
        for k, extremal in enumerate(self.outcome.extremals):
            st, x, parameters = extremal.statement, extremal.trajectory.x, extremal.parameters
            start = st.boundary_values(parameters)[0]
            start = np.where(np.isnan(start), x[0], start)
            if before is not None:
                t, link = before.trajectory, self.links[k - 1]
                given = link.values(t.x[-1], t.e[-1], t.duration, before.parameters, parameters)[0]
                start[list(link.states)] = given
            own = np.array([sizes[name] for name in st.state_names])
            if not is_path(st, extremal, start, parameters, own) or missed(refined(extremal)):
                return False
            before = extremal
        return True


def around_classical(
    chain: Chain, meshes: Sequence[Mesh], values: Arrays, found: ChainOutcome
) -> AroundClassical | None:
    """What runs around the nominal of the deterministic problem; None where that is none, or of another form.

    Args:
        chain: of the expected costs.
        meshes: of their phases.
        values: of their parameters.
        found: the outcome of the deterministic problem.
    """
    if not found.converged or not all(mesh.eliminated for mesh in meshes):
        return None
    outcomes, filled = _along(chain, meshes, values, found)
    extremals = []
    for outcome, mesh, own, parameters in zip(outcomes, meshes, found.extremals, filled, strict=True):
        statement = outcome.extremal.statement
        multipliers = shared_multipliers(statement, mesh, own) if outcome.converged else None
        if multipliers is None:
            return None
        extremals.append(replace(outcome.extremal, multipliers=multipliers, parameters=parameters))
    if len(extremals) != len(chain.statements):
        return None
    around = replace(found, extremals=tuple(extremals), cost_terms=tuple(outcome.cost_terms for outcome in outcomes))
    return AroundClassical(outcome=around, links=chain.links)


def _along(
    chain: Chain, meshes: Sequence[Mesh], values: Arrays, found: ChainOutcome
) -> tuple[list[Outcome], list[Array]]:
    """Runs along a nominal: E from the first phase to the last, then S from the last to the first; until one fails."""
    outcomes: list[Outcome] = []
    filled: list[Array] = []
    for i, (st, mesh, value) in enumerate(zip(chain.statements, meshes, values, strict=True)):
        if i:
            t = outcomes[-1].extremal.trajectory
            link = chain.links[i - 1]
            value = link.filled(value, link.values(t.x[-1], t.e[-1], t.duration, filled[-1], value)[1])
        around = run_around(st, mesh, found.extremals[i], value)
        if around is None:
            return [], []
        outcomes.append(around)
        filled.append(value)
    for i in range(len(chain.links) - 1, -1, -1):
        link = chain.links[i]
        if link.weights:
            filled[i] = link.weighed(filled[i], outcomes[i + 1].extremal.trajectory.e[0, list(link.behind)])
            around = run_around(chain.statements[i], meshes[i], found.extremals[i], filled[i])
            if around is None:
                return [], []
            outcomes[i] = around
    return outcomes, filled
