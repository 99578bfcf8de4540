"""A method that sees no rows of covariances that stay zero; what it is given and what it returns have them."""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import Any, cast

from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Extremal, Guess, Merit, Outcome, Prepared
from covocp.solving.methods import METHODS
from covocp.statement.exact_rows import Carried, carried
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.trajectory import Multipliers, Trajectory


def made_ready(method: str, statement: Statement, options: Options, parameters: Array, **own: Any) -> Prepared:
    """A problem made ready for a method, without rows of covariances that stay zero.

    Args:
        method: its name.
        statement: the problem.
        options: of the mesh.
        parameters: values (np,) that the mesh is made for.
        own: options of the method.

    Raises:
        ProblemError: as `prepare` of the method.
    """
    prepare = importlib.import_module(METHODS[method]).prepare
    found = carried(statement)
    if found is None:
        return cast(Prepared, prepare(statement, options, parameters, **own))
    return WithoutRows(statement, found, cast(Prepared, prepare(found.statement, options, parameters, **own)))


class WithoutRows:
    """A problem made ready for a method without rows that stay zero; guesses and outcomes are those of the whole."""

    def __init__(self, statement: Statement, rows: Carried, prepared: Prepared) -> None:
        """Keep the whole statement, what is carried of it, and the method with the latter."""
        self._statement, self._rows, self._prepared = statement, rows, prepared

    @property
    def mesh(self) -> Mesh:
        """The resolved mesh."""
        return self._prepared.mesh

    def solve(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Solve for these parameters from this guess."""
        outcome = self._prepared.solve(parameters, self._cut(guess), progress)
        found = outcome.extremal
        multipliers = found.multipliers
        return replace(
            outcome,
            extremal=Extremal(
                stated=self._statement,
                mesh=found.mesh,
                trajectory=replace(found.trajectory, e=self._rows.filled(found.trajectory.e)),
                parameters=found.parameters,
                multipliers=replace(
                    multipliers,
                    final_matrices=self._rows.filled(multipliers.final_matrices),
                    matrices=self._rows.filled(multipliers.matrices),
                    # costates of matrices are swept over all segments: the method knows none of the rows left out
                    gaps=multipliers.gaps[:, : self._statement.nx],
                ),
            ),
        )

    def merit(self, parameters: Array, trajectory: Trajectory) -> Merit:
        """What the controls of a trajectory cost, and how they meet the conditions."""
        return self._prepared.merit(parameters, self._taken(trajectory))

    def _taken(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory without the rows."""
        return replace(trajectory, e=self._rows.taken(trajectory.e))

    def _cut(self, guess: Guess) -> Guess:
        """A guess without the rows."""
        trajectory = self._taken(guess.trajectory)
        multipliers: Multipliers | None = guess.multipliers
        if multipliers is not None:
            multipliers = replace(
                multipliers,
                final_matrices=self._rows.taken(multipliers.final_matrices),
                matrices=self._rows.taken(multipliers.matrices),
            )
        costates = guess.costates and (guess.costates[0], self._rows.taken(guess.costates[1]))
        scales = guess.scales and replace(guess.scales, e=self._rows.taken(guess.scales.e))
        return replace(guess, trajectory=trajectory, multipliers=multipliers, costates=costates, scales=scales)
