"""What a combined design is compared with: the classical one, where that can be run along its controls."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError, Interrupted, warn_user, without_warnings
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.base.threads import cached
from covocp.extremal.extremal import Outcome
from covocp.extremal.given_controls import evaluate_controls, evaluation_mesh
from covocp.solution.origin import Classical
from covocp.solution.solution import Solution
from covocp.solving.attempts import with_stats
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import matrices_function
from covocp.transcription.mesh import Mesh, Options, with_substeps
from covocp.transcription.starts import own_start
from covocp.transcription.stiffness import stiffness

# Share of the cost of the problem's own guess below which costs differ by the solver's tolerance only: one of slopes,
# so that costs have its square. Nothing else tells the size of a cost whose optimum is zero.
ROUNDOFF = 1e-10
# Relative decrease of the cost from which on it is asked whether both are zero.
SUSPICIOUS_GAIN = 0.5
# Relative excess of the cost over the classical design's above which a solution is a spurious stationary point.
WORSE = 1e-6
# Multiple of the error of the mesh up to which an excess may be that of unequal steps: around a given nominal they are
# shorter, and the error is an estimate of the combined design's own.
STEPS = 10.0


class Deterministic(NamedTuple):
    """What solves the deterministic problem for values of the parameters.

    costs: what the classical design costs, and why there is none. nominal: the outcome without noise.
    """

    costs: Callable[[Array], tuple[float, str]]
    nominal: Callable[[Array], Outcome]


@dataclass(frozen=True, kw_only=True, eq=False)
class ClassicalDesign:
    """The classical design of a problem on the mesh of a combined one; its solver is made when it is first asked for.

    Args:
        statement: the problem.
        options: of the mesh.
        make: for some options, what solves for it.
    """

    statement: Statement
    options: Options
    make: Callable[[Options], Deterministic]

    __repr__ = short_repr

    @cached
    def solver(self) -> Deterministic:
        """What solves for it on the mesh."""
        return self.make(self.options)

    def nominal(self, parameters: Array) -> Outcome | None:
        """Its nominal; None where there is none."""
        try:
            with without_warnings():  # they concern another solution
                return self.solver.nominal(parameters)
        except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved
            return None

    def beside(
        self, solution: Solution, mesh: Mesh, parameters: Array, go_on: Callable[[Solution], Solution]
    ) -> Solution:
        """The solution with the cost of the classical design beside it; a worse one is a spurious stationary point.

        Args:
            solution: of the combined design.
            mesh: that it was found on.
            parameters: their values, (np,).
            go_on: what makes a solution more exact.
        """
        try:
            with without_warnings():  # they concern another solution
                classical, missing = self.solver.costs(parameters)
                if left_open(solution, classical):
                    classical = self._on_equal_steps(classical, mesh, parameters)
        except KeyboardInterrupt:
            message = "Interrupted while the classical design was computed. On this error (.solution): a solution."
            raise Interrupted(message, solution=solution) from None
        except CovocpError as error:  # no deterministic cost: there is nothing to compare with
            return with_stats(solution, **Classical(missing=str(error).partition("\n")[0]).counts)
        if missing:
            return with_stats(solution, **Classical(missing=missing).counts)
        worse, excess = is_worse(solution, classical), solution.cost - classical
        suspicious = worse or excess < -SUSPICIOUS_GAIN * abs(classical)
        if suspicious and is_roundoff(excess, self.statement, self.options, parameters):
            return with_stats(solution, **Classical(cost=classical, same=True).counts)
        if worse:  # stationary up to a tolerance only, or spurious: going on from there tells
            solution = go_on(solution)
            worse = is_worse(solution, classical)
        if worse:
            warn_user(
                f"This is a spurious stationary point: its expected cost {solution.cost:.8g} is above that of the "
                f"classical design, {classical:.8g}. Start from it: guess=solve(problem, nominal='deterministic')."
            )
        return with_stats(solution, **Classical(cost=classical).counts)

    def _on_equal_steps(self, classical: float, mesh: Mesh, parameters: Array) -> float:
        """Cost of the classical design with the steps of the combined one, where that is more: they are compared so."""
        options = with_substeps(self.options, mesh, mesh.substeps)
        if options.substeps == self.options.substeps:
            return classical
        cost, missing = self.make(options).costs(parameters)
        return classical if missing else max(classical, cost)


def is_worse(solution: Solution, classical: float) -> bool:
    """Whether a combined design costs more than the classical one, by more than the mesh leaves open."""
    return bool(solution.cost - classical > (WORSE + solution.mesh_error) * abs(classical))


def left_open(solution: Solution, classical: float) -> bool:
    """Whether a combined design costs more than the classical one on shorter steps, by what these may explain."""
    excess = solution.cost - classical
    return bool(WORSE * abs(classical) < excess <= (WORSE + STEPS * solution.mesh_error) * abs(classical))


def is_roundoff(cost: float, statement: Statement, options: Options, parameters: Array) -> bool:
    """Whether a cost, or a difference of costs, is nothing beside the cost of the problem's own guess.

    Without what that grows by where the nominal is unstable: beside e^(2 a T) everything would be nothing. That of a
    guess which is held is the one along its nodes: a run along its controls does not stay there.
    """
    mesh = evaluation_mesh(statement, options, parameters)
    first = own_start(statement, mesh, parameters)
    start = first.trajectory
    if first.held:
        at_ends = matrices_function(statement, mesh)(start.x.T, start.u.T, start.duration, parameters)
        e, running = (np.asarray(value.full()) for value in at_ends)
        beside = running.sum() + float(statement.terminal(start.x[-1], e[:, -1], start.duration, parameters))
    else:
        outcome = evaluate_controls(statement, mesh, start.u, start.duration, parameters, start.x[0])
        grown = stiffness(statement, options, parameters).growing / float(np.diff(options.nodes()).max())
        beside = np.exp(-2.0 * grown) * sum(outcome.cost_terms.values())
    return bool(abs(cost) <= ROUNDOFF * abs(beside))
