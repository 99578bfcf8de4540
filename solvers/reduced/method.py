"""The reduced method: sequential quadratic programming in the controls, on the compiled passage of the covariances."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from covocp.base.arguments import checked, positive, whole
from covocp.base.errors import ProblemError
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.residuals import LIMIT
from covocp.extremal.costates import without_passage
from covocp.extremal.extremal import Extremal, Guess, Outcome
from covocp.solvers.reached import Magnitudes
from covocp.solvers.reduced.engine import Engine
from covocp.solvers.runs import Runs
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.program import Arrays, Program, Trajectories, alone
from covocp.transcription.scales import choose_scales, evened
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.transcribing import transcribe

LIMIT_PER_TOLERANCE = 100.0


@checked("the method 'reduced'", tolerance=positive, max_iterations=whole(0))
def prepare(
    statement: Statement, options: Options, *, tolerance: float = 3e-7, max_iterations: int = 300
) -> ReducedSolver:
    """Make."""
    if options.covariances == "auto" and statement.matrices:
        options = replace(options, covariances="eliminated")
    mesh = resolve_mesh(statement, options, statement.values)
    return ReducedSolver(statement, mesh, tolerance, max_iterations)


class ReducedRuns(Runs):
    """Runs of the sequence of subproblems."""

    def __init__(self, statement: Statement, mesh: Mesh, tolerance: float, most: int) -> None:
        """Keep the settings."""

        def build(scales: Magnitudes | None, trajectories: Trajectories, parameters: Arrays) -> Program:
            if scales is None:
                scales = (choose_scales(statement, mesh, trajectories[0], parameters[0]),)
            return alone(transcribe(statement, mesh, evened(scales[0], mesh), "compiled"))

        super().__init__(build, "reduced", {}, True, max(LIMIT, LIMIT_PER_TOLERANCE * tolerance))
        self._open = True
        self._tolerance, self._most = tolerance, most

    def _make(self, functions: Any, warm: bool = False) -> Engine:
        assert self._nlp is not None
        assert self._monitor is not None
        return Engine(self._nlp, self._tolerance, self._most, self._monitor)

    def _warm_solver(self) -> Engine:
        """The same for all starts: what was learnt stays."""
        assert isinstance(self._cold, Engine)
        self._cold.tolerance = self._tolerance * self._strictness
        return self._cold

    def _cost_scale(self, solver: Any, w0: Array, parameters: Arrays) -> float:
        """The Hessian has its own magnitude."""
        return 1.0


class ReducedSolver:
    """A problem."""

    def __init__(self, statement: Statement, mesh: Mesh, tolerance: float, most: int) -> None:
        self._statement, self._mesh = statement, mesh
        self._runs = ReducedRuns(statement, mesh, tolerance, most)

    @property
    def mesh(self) -> Mesh:
        """The resolved mesh."""
        return self._mesh

    def solve(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Solve for these parameters from this guess; the last iterate is returned whatever happens."""
        last, counts = self._runs.solve((parameters,), (guess,), progress)
        (trajectory,), values = last.where
        nlp = last.nlp
        (multipliers,) = nlp.unpack_multipliers(last.point.lam_x, last.point.lam_g, last.where[0], (parameters,))
        extremal = Extremal(
            stated=self._statement,
            mesh=self._mesh,
            trajectory=trajectory,
            parameters=parameters,
            multipliers=multipliers,
        )
        return Outcome(
            extremal=without_passage(extremal),
            cost_terms={"terminal": values["terminal"], "running": values["running"]},
            converged=last.converged,
            message=self._runs.message(last),
            violations=last.nlp.violations(values["g"], (parameters,)),
            stats=counts,
        )
