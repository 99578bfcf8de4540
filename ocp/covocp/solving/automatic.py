"""The method "auto": the reduced one where measurements show it faster, Ipopt elsewhere and where that finds no way."""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol, cast

from covocp.base.arguments import checked, optional, positive, whole
from covocp.base.errors import CovocpError
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess, Merit, Outcome, Prepared
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.trajectory import Trajectory

if TYPE_CHECKING:
    from covocp.extremal.links import ChainOutcome
    from covocp.statement.chain import Chain

IPOPT, REDUCED = "covocp.solvers.ipopt", "covocp.solvers.reduced"
# Control values from which on the dense Hessian of the reduced method takes longer than its sweeps.
MOST_CONTROLS = 400

KINDS = {"tolerance": optional(positive), "max_iterations": optional(whole(0))}


class PreparedChain(Protocol):
    """What `prepare_chain` of a method's module returns."""

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """The resolved meshes."""

    def solve(self, parameters: tuple[Array, ...], guesses: tuple[Guess, ...], progress: Progress) -> ChainOutcome:
        """Solve for these parameters from these guesses."""


@checked("the method 'auto'", **KINDS)
def prepare(
    statement: Statement,
    options: Options,
    parameters: Array | None = None,
    *,
    tolerance: float | None = None,
    max_iterations: int | None = None,
) -> Automatic:
    """Make a problem ready for whichever method is faster.

    Args:
        statement: the problem.
        options: mesh and formulation.
        parameters: values (np,) that the mesh is made for; None: the declared ones.
        tolerance: of the method that solves; None: its own.
        max_iterations: of the method that solves; None: its own.

    Returns:
        The solver; which method solved is `Solution.method`.

    Raises:
        ProblemError: an option is wrong.
    """
    given = {"tolerance": tolerance, "max_iterations": max_iterations}
    own = {name: value for name, value in given.items() if value is not None}
    return Automatic(statement, options, parameters, own)


@checked("the method 'auto'", **KINDS)
def prepare_chain(
    chain: Chain,
    options: tuple[Options, ...],
    *,
    tolerance: float | None = None,
    max_iterations: int | None = None,
) -> PreparedChain:
    """Make several problems ready for Ipopt; arguments and errors as of `prepare`.

    Args:
        chain: the problems.
        options: mesh and formulation of each.
        tolerance: of Ipopt.
        max_iterations: of Ipopt.
    """
    module = importlib.import_module(IPOPT)
    made = module.prepare_chain(chain, options, tolerance=tolerance, max_iterations=max_iterations)
    return cast(PreparedChain, made)


def is_suited(statement: Statement, mesh: Mesh) -> bool:
    """Whether the reduced method was measured to be faster: covariances that pass along the nominal, few conditions.

    benchmarks/measurements/reduced.py: with weights that run backward and on plain problems, which have exact second
    derivatives, it is not.
    """
    covariances = bool(statement.matrices) and mesh.eliminated and not statement.behind
    limits = statement.path.size or statement.bounded_states
    return covariances and not limits and mesh.control_nodes * statement.nu <= MOST_CONTROLS


class Automatic:
    """A problem made ready for both methods; each builds its program when it is first asked."""

    def __init__(self, statement: Statement, options: Options, parameters: Array | None, own: dict[str, Any]) -> None:
        """Keep what the methods need; see `prepare`."""
        self._ipopt: Prepared = importlib.import_module(IPOPT).prepare(statement, options, parameters, **own)
        self._reduced: Prepared | None = None
        if is_suited(statement, self.mesh):
            self._reduced = importlib.import_module(REDUCED).prepare(statement, options, parameters, **own)

    @property
    def mesh(self) -> Mesh:
        """The resolved mesh, the same for both."""
        return self._ipopt.mesh

    def solve(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Solve for these parameters from this guess; the last iterate is returned whatever happens."""
        spent = 0.0
        if self._reduced is not None:
            try:
                outcome = self._reduced.solve(parameters, guess, progress)
            except CovocpError:  # Ipopt says what is wrong, or finds a way
                pass
            else:
                if outcome.converged or progress.stop:
                    return _named(outcome, "reduced", 0.0)
                spent = float(outcome.stats.get("solve_seconds", 0.0))
        return _named(self._ipopt.solve(parameters, guess, progress), "ipopt", spent)

    def merit(self, parameters: Array, trajectory: Trajectory) -> Merit:
        """What the controls of a trajectory cost, and how they meet the conditions."""
        return (self._reduced or self._ipopt).merit(parameters, trajectory)


def _named(outcome: Outcome, method: str, spent: float) -> Outcome:
    """The outcome with the method that found it, and the time that another one took in vain."""
    stats = {**outcome.stats, "method": method}
    if spent and "solve_seconds" in stats:
        stats["solve_seconds"] += spent
    return replace(outcome, stats=stats)
