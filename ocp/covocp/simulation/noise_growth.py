"""What noise that varies with state and control adds to the spread of runs: linear theory takes it at the nominal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.grown_noise import Grown, grown_noise
from covocp.extremal.phase_loops import phase_loops
from covocp.simulation.actual import System
from covocp.simulation.run_parts import Setting
from covocp.solution.phases import PhasesSolution
from covocp.solution.solution import Solution

Find = Callable[[], Grown | None]


def of_solution(solution: Solution) -> Grown | None:
    """What it adds along a solution; None without a loop in it."""
    if solution.loop is None or solution.extremal.statement.loop is None:
        return None
    return grown_noise(solution.extremal, solution.loop)


def of_phase(solution: PhasesSolution, number: int) -> Grown | None:
    """What it adds along one of several phases, with what those before have added; None without a loop in all."""
    extremals = [phase.extremal for phase in solution]
    if any(extremal.statement.loop is None for extremal in extremals):
        return None
    return phase_loops(extremals, solution.links)[number].grown


def grown_at_end(find: Find, setting: Setting) -> Array:
    """What it adds to the covariance of the deviation and its estimate at the end, (2n, 2n).

    Zero where no density bends; NaN where one does and what it adds is not known: without feedback, for another system
    than the design's, under a law of the user's.
    """
    design, actual = setting.design, setting.actual
    none = np.zeros((2 * design.size, 2 * design.size))
    if not _bends(actual):
        return none
    found = find() if actual is design and setting.flown is None else None
    unknown = found is None or found.end.shape != none.shape or not np.isfinite(found.end).all()
    return np.full_like(none, np.nan) if unknown or found is None else found.end


def _bends(system: System) -> bool:
    """Whether densities, or variances of what is read, are not linear in state, control and unknowns."""
    st = system.statement
    symbolic: Any = st.symbolic
    point = [symbolic.sym(f"a{i}", size) for i, size in enumerate((st.nx, st.nu, 1, 1, st.np))]
    own = ca.vertsplit(point[4], [0, st.np - st.unknowns, st.np])[1]
    model = system.model(*point)
    values = ca.veccat(model.Q, model.U, system.read(*point).R)
    return any(ca.which_depends(values, ca.veccat(*point[:2], own), 2, False))
