"""Problems whose meshes refine themselves: the first mesh, its guesses, tolerances; one problem solved on others.

What is made of the first mesh is in `refined_meshes`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array, distinct
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.extremal.path_limits import limited_along
from covocp.solution.solution import Solution
from covocp.solving.attempts import cost_of, from_starts
from covocp.solving.warm_start import make_guess, make_guesses
from covocp.statement.statement import Statement
from covocp.transcription.grading import graded
from covocp.transcription.instants import completed
from covocp.transcription.mesh import Graded, Mesh, Options
from covocp.transcription.scales import choose_scales
from covocp.transcription.starts import own_start
from covocp.transcription.stiffness import stiffness

if TYPE_CHECKING:
    from covocp.solving.refined_meshes import Measured

# Intervals of the first mesh where none are given.
FIRST = 16
# Tolerance of the method beside that of the mesh, where none is given, and its limits; times its tolerance the error
# that no comparison of meshes shows. The gradient method has one of its own for conditions, which costs are linear in.
SOLVED, LOOSEST, STRICTEST, UNSEEN = 1e-2, 1e-7, 1e-11, 10.0
VIOLATION = "violation_tolerance"
# Length of an interval in times of the nominal above which the first mesh is graded at its ends, and in which ratio.
LONG, LAYER_RATIO = 30.0, 1.7
# Points of an interval at which limits along the path are imposed: with one a control may swing from node to node.
POINTS = 2


@dataclass(frozen=True, eq=False)
class ProblemRuns:
    """How a problem is solved on any mesh.

    Args:
        statement: the problem.
        parameters: of the statement.
        method: its name.
        prepare: makes the method ready for the options of a mesh.
        progress: of the iterations; a Ctrl-C stops it.
    """

    statement: Statement
    parameters: Array
    method: str
    prepare: Callable[[Options], Any]
    progress: Progress

    __repr__ = short_repr

    @property
    def statements(self) -> tuple[Statement, ...]:
        """The problem."""
        return (self.statement,)

    def measured(self, options: Options, prepared: Prepared, outcome: Outcome, least: float) -> Measured:
        """A mesh with what came of it, not measured."""
        from covocp.solving.refined_meshes import Measured

        return Measured(
            options=(options,),
            meshes=(prepared.mesh,),
            prepared=prepared,
            outcome=outcome,
            extremals=(outcome.extremal,),
            cost=cost_of(outcome),
            least=least,
        )

    def cold(self, options: tuple[Options, ...], least: float) -> Measured:
        """From the problem's own start."""
        own = with_layers(self.statement, graded(self.statement, options[0], self.parameters), self.parameters)
        prepared: Prepared = self.prepare(own)
        guesses = first_guesses(own, self.statement, prepared.mesh, self.parameters, None)
        outcome, _ = from_starts(prepared, self.parameters, guesses, self.progress)
        return self.measured(own, prepared, outcome, least)

    def warm(self, options: tuple[Options, ...], start: Measured) -> Measured:
        """From a solution on another mesh."""
        prepared: Prepared = self.prepare(options[0])
        assert isinstance(start.outcome, Outcome)
        solution = Solution.of(start.outcome, self.method, assess=False)
        guess = make_guess(self.statement, prepared.mesh, self.parameters, solution)
        trajectory = start.outcome.extremal.trajectory
        scales = start.scales or (choose_scales(self.statement, start.meshes[0], trajectory, self.parameters),)
        outcome = prepared.solve(self.parameters, replace(guess, scales=scales[0]), self.progress)
        return replace(self.measured(options[0], prepared, outcome, start.least), scales=scales)


def first_options(statement: Statement, options: Options, nominal: str, points: bool) -> Options:
    """The options of the first mesh: limits are imposed at the middles of the intervals too, where that is possible.

    Raises:
        ProblemError: the nominal is another problem's, whose cost is not the one that would be measured.
    """
    if nominal != "combined":
        raise ProblemError(
            "The option 'refine' does not go with nominal='deterministic'.",
            expected="one of both: the error is that of the cost that is minimised",
            received=f"refine={options.refine!r}, nominal={nominal!r}",
            remedy="leave one of them out, or give a grid=",
        )
    if points and options.points == "auto" and options.substeps == "auto" and limited_along(statement):
        return replace(options, points=POINTS)
    return options


def with_layers(statement: Statement, options: Options, parameters: Array) -> Options:
    """The options with nodes closer and closer to both ends, where the nominal is fast beside an interval.

    What it does over a long time it does at the ends, and begins there within its own time.

    Args:
        statement: the problem.
        options: of the first mesh; a grid that was given stays as it is.
        parameters: of the statement.
    """
    if not (options.grid is None or isinstance(options.grid, Graded)):
        return options
    fast = max(stiffness(statement, options, parameters, at_end=at_end).nominal for at_end in (False, True))
    if fast <= LONG:
        return options
    nodes = options.nodes()
    longest = float(np.diff(nodes).max())
    layer = longest / fast * LAYER_RATIO ** np.arange(np.ceil(np.log(fast) / np.log(LAYER_RATIO)))
    whole = completed(statement, distinct(nodes, layer, 1.0 - layer), parameters)
    known = options.grid.stiffness if isinstance(options.grid, Graded) else None
    return replace(options, grid=Graded(nodes=whole, asked=whole.size - 1, stiffness=known, layered=True))


def first_guesses(
    options: Options, statement: Statement, mesh: Mesh, parameters: Array, guess: Given, *, linked: bool = False
) -> Iterator[Guess]:
    """Guesses on the mesh of some options, as `make_guesses`.

    On one with layers the problem's own start comes first, as it is: the others are ranked by runs over the whole time,
    which tell little of a nominal that is fast beside it, and take long.
    """
    if guess is None and isinstance(options.grid, Graded) and options.grid.layered:
        yield Guess(trajectory=own_start(statement, mesh, parameters).trajectory)
    yield from make_guesses(statement, mesh, parameters, guess, linked=linked)


def adapted(known: dict[str, Any], own: dict[str, Any], refine: float) -> dict[str, Any]:
    """The method's own options with tolerances that go with that of the mesh, where none are given.

    Args:
        known: options of the method, with their defaults.
        own: those that are given.
        refine: relative error of the cost that is allowed.
    """
    share = float(np.clip(SOLVED * refine, STRICTEST, LOOSEST))
    if VIOLATION in known:
        return {VIOLATION: share, **own}
    if "plugin" not in known or own.get("plugin", "ipopt") != "ipopt":
        return own
    return dict(own) if own.get("tolerance") is not None else {**own, "tolerance": share}


def unseen(own: dict[str, Any]) -> float:
    """What the tolerances of the method leave of the cost on every mesh alike, relative."""
    return UNSEEN * float(own.get(VIOLATION) or own.get("tolerance") or LOOSEST)
