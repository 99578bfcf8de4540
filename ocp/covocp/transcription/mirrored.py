"""Starts that excite to the other side: what is learnt of a system may depend on the side, and no solver changes it.

Near a symmetric run, where little is learnt, controls of both signs learn more, and each sign leads to a minimum of its
own. What else the cost asks for, an initial state or a correlation of the prior, makes one of them cheaper.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import product

import numpy as np

from covocp.base.matrices import Array
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.starts import First, base_run, completed, own_start, stays, targets
from covocp.transcription.steering import steer
from covocp.transcription.trajectory import Trajectory

# Controls of which all combinations of signs are made; of more than these each is turned alone, and all together.
COMBINED = 4


def other_sides(
    statement: Statement, mesh: Mesh, parameters: Array, own: First, *, linked: bool
) -> tuple[Trajectory, ...]:
    """Starts whose controls are bent to other sides, brought to the final values.

    The last ones are kept, as those of `own_start`.

    Args:
        statement: the problem.
        mesh: of it.
        parameters: values (np,).
        own: the problem's own start.
        linked: whether other phases may pay for what is learnt.

    Returns:
        The problem's own start as it is to be compared with them, and they, last all controls to the other side; none
        where what is learnt does not depend on the side, or the start was not bent.
    """
    if stays(statement):
        return _kept(statement, mesh, tuple(parameters), linked)
    return sides_of(statement, mesh, parameters, own, linked=linked)


@lru_cache(maxsize=2)
def _kept(statement: Statement, mesh: Mesh, values: tuple[float, ...], linked: bool) -> tuple[Trajectory, ...]:
    parameters = np.array(values)
    own = own_start(statement, mesh, parameters)
    return sides_of(statement, mesh, parameters, own, linked=linked)


def sides_of(
    statement: Statement, mesh: Mesh, parameters: Array, own: First, *, linked: bool
) -> tuple[Trajectory, ...]:
    """The same of any start, anew; arguments as of `other_sides`."""
    if own.unbent is None or own.held or not learns(statement, linked=linked):
        return ()
    bend = own.trajectory.u - own.unbent
    if not np.isfinite(own.trajectory.x).all() or not bend.any():
        return ()
    run = base_run(statement, mesh, parameters, own.trajectory.x[0], own.unbent)
    fixed, target = targets(run)

    def brought(u: Array) -> Trajectory:
        u = run.clip(u)
        u = steer(run, fixed, target, u)[0] if fixed else u
        return completed(statement, mesh, parameters, u, start=own.trajectory.x[0])

    first = brought(own.trajectory.u) if fixed else own.trajectory
    return (first, *(brought(own.unbent + signs * bend) for signs in _signs(bend)))


def learns(statement: Statement, *, linked: bool) -> bool:
    """Whether cost or conditions, of others too where it is linked, read matrices, and these depend on the nominal."""
    if not statement.matrices or statement.coupled:
        return False
    paid = linked or statement.running_uses_matrices or statement.terminal.jac_sparsity(0, 1).nnz()
    if not paid and not conditions_on_matrices(statement):
        return False
    if any(statement.varies(i) for i in range(len(statement.matrices))):
        return True
    samples = statement.samples
    return samples is not None and any(samples.measurement.jac_sparsity(k, i).nnz() for k in (1, 2) for i in (0, 1))


def conditions_on_matrices(statement: Statement) -> bool:
    """Whether some inequality reads a matrix."""
    return any(c.size and c.function.jac_sparsity(0, 2).nnz() for c in statement.conditions)


def _signs(bend: Array) -> Iterator[Array]:
    """Signs of the bends of the controls (nu,), other than all as they are; of those that are bent."""
    bent = np.flatnonzero(bend.any(axis=0))
    signs = np.ones(bend.shape[1])
    if bent.size <= COMBINED:
        patterns = [np.array(p) for p in product((1.0, -1.0), repeat=bent.size)][1:]
    else:
        patterns = [*(1.0 - 2.0 * row for row in np.eye(bent.size)), -np.ones(bent.size)]
    for pattern in patterns:
        signs[bent] = pattern
        yield signs.copy()
