"""A trajectory run again with shorter integration steps: what its own steps are off."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.dataclass import dataclass
from covocp.base.expressions import sequence_of
from covocp.base.matrices import Array, as_array
from covocp.base.short_repr import short_repr
from covocp.passage.sweep import values_by
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.numbers import segments_of_numbers
from covocp.transcription.sequences import NUMERIC_RUN
from covocp.transcription.shooting import compiled_steps, interval_columns, shoot
from covocp.transcription.steering import compiled_along, nominal_states
from covocp.transcription.steps import nominal_interval
from covocp.transcription.trajectory import Trajectory

# Meshes whose functions are kept.
MESHES = 4
# Runs before these are made.
FEW = 2
# What starts the segments, and what is wanted of them, by the names of `shoot`: at the ends of the parts, at the nodes.
_STARTS = ("x", "e", "u", "duration", "parameters")
_GIVEN, _AT_NODES = ("gap_x", "gap_e", "cost"), ("x", "e")


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """What shorter integration steps make of a trajectory.

    Attributes:
        jumps: at the ends of the segments, (segments, nx, or nx + ne where the matrices are variables).
        running: running cost.
        costs: running cost of each interval, (N,).
        states: at the nodes, (N + 1, nx); those at which a segment starts are as given.
        matrices: half-vectors at the nodes, (N + 1, ne); the same where they are variables.
    """

    jumps: Array
    running: float
    costs: Array
    states: Array
    matrices: Array

    __repr__ = short_repr


def refined_run(statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: Array, parts: int = 2) -> Refined:
    """Run the segments of a trajectory again with shorter integration steps.

    The intervals are divided, not the substeps multiplied: so the functions of the transcription serve again.

    Args:
        statement: the problem.
        mesh: of the trajectory.
        trajectory: where each segment starts from, and the controls.
        parameters: of the statement.
        parts: parts of each interval.
    """
    starts, runs = list(mesh.starts), _runs(statement, mesh, parts)
    t, u = trajectory, _divided(mesh, trajectory.u, parts)
    values = runs.segments(t.x[starts].T, t.e[starts].T, u.T, np.array([[t.duration]]), parameters[:, None])
    gap_x, gap_e, cost, x, e = values
    costs = cost.reshape(mesh.intervals, parts).sum(axis=1)
    return Refined(
        jumps=np.hstack([gap_x.T, gap_e.T]),
        running=float(cost.sum()),
        costs=costs,
        states=x.T,
        matrices=e.T,
    )


def refined_states(
    statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: Array, parts: int = 2
) -> Array:
    """The states at the nodes, (N + 1, nx), of one run from the start along the same controls with shorter steps.

    NaN or inf where it diverges.
    """
    runs, u = _runs(statement, mesh, parts), _divided(mesh, trajectory.u, parts)
    return runs.states(trajectory.x[0], u, trajectory.duration, parameters)[::parts]


@lru_cache(maxsize=MESHES)
def in_one_segment(mesh: Mesh) -> Mesh:
    """The mesh with one segment from the start to the end."""
    return replace(mesh, segments=(mesh.intervals,))


class _Runs:
    """Runs on one mesh, each of its intervals in some parts; those that come often by functions that are kept.

    To make these takes as long as some runs do without.
    """

    def __init__(self, statement: Statement, mesh: Mesh, parts: int) -> None:
        self._statement, self._mesh, self._parts = statement, mesh.divided(parts), parts
        self._made: Matrices | None = None
        self._asked: Counter[str] = Counter()

    def segments(self, *start: Array) -> list[Array]:
        """Run all segments: `_GIVEN` and `_AT_NODES` from `_STARTS`."""
        st, mesh = self._statement, self._mesh
        kept = not st.matrices or compiled_steps(mesh)  # a long sequence of CasADi's steps takes memory for all of it
        found = self._of_numbers(*start)
        if found is not None:
            return found
        if not kept or not self._often("segments"):
            return [as_array(v) for v in self._shot([ca.DM(array) for array in start])]
        if self._made is None:
            symbols = [ca.MX.sym(name, *array.shape) for name, array in zip(_STARTS, start, strict=True)]
            self._made = Matrices(ca.Function("runs", symbols, self._shot(symbols)))
        return self._made.evaluated(*start)

    def _of_numbers(self, x: Array, e: Array, u: Array, duration: Array, parameters: Array) -> list[Array] | None:
        """The same by the compiled library alone, where it can."""
        given = u, float(duration.item()), parameters[:, 0]
        found = segments_of_numbers(self._statement, self._mesh, x, e[:, 0], given, self._parts)
        if found is None:
            return None
        return [found.gaps, np.zeros((0, found.gaps.shape[1])), found.costs[None], found.x, found.e]

    def _shot(self, start: list[Any]) -> list[Any]:
        variables = SimpleNamespace(**dict(zip(_STARTS, start, strict=True)))
        values = shoot(self._statement, self._mesh, variables, passage=values_by)
        return [*(values[name] for name in _GIVEN), *(values[name][:, :: self._parts] for name in _AT_NODES)]

    def _often(self, name: str) -> bool:
        self._asked[name] += 1
        return self._asked[name] > FEW

    def states(self, x: Array, u: Array, duration: float, parameters: Array) -> Array:
        """The states at the ends of all intervals, run from a state, which is the first of them."""
        st, mesh, count = self._statement, self._mesh, self._mesh.intervals
        along = compiled_along(st, mesh, x, u, duration, parameters)
        if along is not None:
            return np.vstack([x, along[0].T])
        if self._often("states"):
            return nominal_states(st, mesh, x, u, duration, parameters)
        common = interval_columns(mesh, ca.DM(u.T), ca.DM(duration), ca.DM(parameters))
        advance = nominal_interval(st, mesh.substeps, mesh.step)
        values: list[Any] = [ca.DM(x)]
        lengths = [min(NUMERIC_RUN, count - first) for first in range(0, count, NUMERIC_RUN)]
        pieces = [ca.horzsplit(column, NUMERIC_RUN) for column in common]
        for length, *columns in zip(lengths, *pieces, strict=True):
            values.append(sequence_of(advance, length).call([values[-1][:, -1], *columns])[0])
        return as_array(ca.horzcat(*values)).T


@lru_cache(maxsize=MESHES)
def _runs(statement: Statement, mesh: Mesh, parts: int) -> _Runs:
    return _Runs(statement, mesh, parts)


def _divided(mesh: Mesh, u: Array, parts: int) -> Array:
    """The same controls on the mesh with each interval in equal parts."""
    c = np.arange(parts) / parts
    if mesh.control == "constant":
        return np.repeat(u, parts, axis=0)
    between = u[:-1, None, :] + c[None, :, None] * np.diff(u, axis=0)[:, None, :]
    return np.vstack([between.reshape(mesh.intervals * parts, u.shape[1]), u[-1:]])
