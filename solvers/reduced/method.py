"""The reduced method: sequential quadratic programming in the controls alone, on the compiled passage of covariances.

States at the starts of the shooting segments follow from the controls by linearised continuity, matrices by their
passage, so that the quadratic subproblems have the controls, free initial values, decisions and a free duration as
variables and nothing else. Their Hessian is dense: at first that of the running cost, then learnt by damped updates
(Nocedal and Wright, Numerical Optimization, 2006, procedure 18.2), and kept for the next solve that starts at a plan.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from covocp.base.arguments import checked, positive, whole
from covocp.base.errors import ProblemError
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.residuals import LIMIT, Residuals
from covocp.extremal.extremal import Guess, Merit, Outcome
from covocp.passage.sweep import passed_by
from covocp.solvers.at_point import AtPoint
from covocp.solvers.endings import Ending
from covocp.solvers.reached import Magnitudes, Point, Round
from covocp.solvers.reduced.engine import Engine
from covocp.solvers.reduced.statuses import Status
from covocp.solvers.rounds import share_for
from covocp.solvers.runs import Kind, Runs
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.program import Arrays, Program, Trajectories, alone
from covocp.transcription.scales import choose_scales, evened
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.trajectory import Trajectory
from covocp.transcription.transcribing import transcribe

TOLERANCE = 3e-7
# What is left at a point is judged by residuals of the first order, larger than the tolerance by this factor.
LIMIT_PER_TOLERANCE = LIMIT / TOLERANCE
# Control values from which on a dense Hessian is no longer the way.
MOST_CONTROLS = 2000
# Costs and slopes that are more than so many times more or less than one have a unit of their own.
FAR_COST = 1e4


@checked("the method 'reduced'", tolerance=positive, max_iterations=whole(0))
def prepare(
    statement: Statement,
    options: Options,
    parameters: Array | None = None,
    *,
    tolerance: float = TOLERANCE,
    max_iterations: int = 1000,
) -> ReducedSolver:
    """Make a problem ready; its functions are built at the first guess, which gives the scales.

    The run has converged when the subproblem promises no more than tolerance^2 of the cost (or of what the controls
    spend of it, where that is more), rows are met to 1e-8 of their units, and what is left in the scale of the point
    that was reached holds (`covocp.base.residuals`).

    Args:
        statement: the problem.
        options: mesh; matrices are eliminated.
        parameters: values (np,) that the mesh is made for; None: the declared ones.
        tolerance: see above.
        max_iterations: of one run.

    Returns:
        The solver; `solve` may be called often.

    Raises:
        ProblemError: an option is wrong, matrices cannot be eliminated, or there are too many control values.
    """
    mesh = _resolved(statement, options, statement.values if parameters is None else parameters)
    count = mesh.control_nodes * statement.nu
    if count > MOST_CONTROLS:
        raise ProblemError(
            "The method 'reduced' has a dense Hessian in the control values.",
            expected=f"at most {MOST_CONTROLS} of them",
            received=f"{count}: {mesh.control_nodes} places, {statement.nu} entries of the controls",
            remedy="use fewer intervals, or method='ipopt'",
        )
    return ReducedSolver(statement, mesh, float(tolerance), int(max_iterations))


def _resolved(statement: Statement, options: Options, parameters: Array) -> Mesh:
    """The mesh, matrices eliminated.

    Raises:
        ProblemError: they cannot be.
    """
    if not statement.matrices:
        return resolve_mesh(statement, options, parameters)
    if options.covariances == "states":
        raise ProblemError(
            "The method 'reduced' has no matrices as variables.",
            expected="covariances='eliminated' or 'auto'",
            received="'states'",
            remedy="leave covariances= out, or use method='ipopt'",
        )
    try:
        return resolve_mesh(statement, replace(options, covariances="eliminated"), parameters)
    except ProblemError as error:
        if options.covariances == "eliminated" or "eliminated" not in str(error):
            raise
        raise ProblemError(
            "The method 'reduced' needs matrices that follow from the nominal.",
            expected="matrices that can be eliminated",
            received=str(error.received),
            remedy="use method='ipopt'",
        ) from error


class ReducedRuns(Runs):
    """Runs of the sequence of subproblems in place of those of an NLP solver of CasADi."""

    _OF_PROGRAM = (*Runs._OF_PROGRAM, "_unit")

    def __init__(self, statement: Statement, mesh: Mesh, tolerance: float, most: int) -> None:
        """Keep the settings; see `prepare`."""

        def build(scales: Magnitudes | None, trajectories: Trajectories, parameters: Arrays) -> Program:
            if scales is None:
                scales = (choose_scales(statement, mesh, trajectories[0], parameters[0]),)
            return alone(transcribe(statement, mesh, evened(scales[0], mesh), passed_by))

        super().__init__(build, "reduced", {}, True, max(LIMIT, LIMIT_PER_TOLERANCE * tolerance))
        self._open = True
        self._tolerance, self._most = tolerance, most
        self._unit: float | None = None

    def _make(self, functions: dict[str, Any], kind: Kind = "cold") -> Engine:
        """The sequence on the present program; it needs no functions of another."""
        assert self._nlp is not None
        assert self._monitor is not None
        return Engine(self._nlp, self._tolerance, self._most, self._monitor)

    def _solver(self, warm: bool, bold: bool = False) -> Engine:
        """The same for all starts: what was learnt stays."""
        engine = super()._solver(False)
        assert isinstance(engine, Engine)
        engine.tolerance = self._tolerance * self._strictness
        return engine

    def _together(self) -> AtPoint | None:
        """Those of the sequence on the present program."""
        engine = self._solvers.get("cold")
        return None if engine is None else engine.functions

    def _judged(self, nlp: Program, point: Point, parameters: Arrays, again: bool = False) -> Round:
        """As of Ipopt, but a cost beside whose penalties no step is seen any more has not converged."""
        found = super()._judged(nlp, point, parameters, again)
        lost = found.converged and found.residuals is not None and not found.settled and found.residuals.too_steep
        return replace(found, converged=False, residuals=None) if lost else found

    def _tighten(self, found: Residuals) -> None:
        """All by the tolerance: nothing here is compared with one. What led to no step at all is not asked again."""
        self._strictness *= share_for(found.worst / LIMIT)
        engine = self._solvers.get("cold")
        if isinstance(engine, Engine) and engine.stats()["iter_count"] == 0:
            engine.forget()

    def _transcribe(self, scales: Magnitudes | None, trajectories: Trajectories, parameters: Arrays) -> None:
        """The program in these scales; its cost gets a unit at the first run."""
        super()._transcribe(scales, trajectories, parameters)
        self._unit = None

    def _cost_scale(self, w0: Array, parameters: Arrays) -> float:
        """A unit of the cost in which its curvature is of the order of one: what is learnt of it, and what is compared.

        One, where the cost and its slopes are not far from that. The same for all runs of a program, whose Hessian is
        kept; a power of two, which rounds nothing.
        """
        if self._unit is None:
            assert self._nlp is not None
            with np.errstate(all="ignore"):
                value, slope = self._first_order().cost(w0, parameters)
                size = max(abs(value), float(np.abs(slope[self._nlp.chosen]).max(initial=0.0)))
                near = 1.0 / FAR_COST <= size <= FAR_COST
                size = 1.0 if near else self._curvature_along(self._first_order(), w0, parameters)
            self._unit = float(np.exp2(np.rint(np.log2(size)))) if 0.0 < size < np.inf else 1.0
        return self._unit

    def _ending(self, name: str) -> Ending | None:
        """The ending in these words, or of that name: that iterates diverge is told as of Ipopt."""
        return next((status for status in Status if str(status) == name), None) or super()._ending(name)


class ReducedSolver:
    """A problem made ready for the reduced method."""

    def __init__(self, statement: Statement, mesh: Mesh, tolerance: float, most: int) -> None:
        """Keep the settings; see `prepare`."""
        self._mesh = mesh
        self._runs = ReducedRuns(statement, mesh, tolerance, most)

    @property
    def mesh(self) -> Mesh:
        """The resolved mesh."""
        return self._mesh

    def solve(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Solve for these parameters from this guess; the last iterate is returned whatever happens."""
        return self._runs.outcome(parameters, guess, progress)

    def merit(self, parameters: Array, trajectory: Trajectory) -> Merit:
        """What the controls of a trajectory cost, and how they meet the conditions."""
        return self._runs.merit((parameters,), (trajectory,))
