"""Panels of attitudes: the rotation vector with its band and what is required at the end, and the angle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from covocp.base.matrices import Array
from covocp.blocks import so3
from covocp.blocks.rotation_chart import rotation_chart, rotation_vectors
from covocp.plot.curves import Curve, Drawn, Panel
from covocp.solution.solution import Solution
from covocp.statement.names import split_entry
from covocp.statement.statement import Block

# Share of a whole turn up to which a band is drawn: there the rotation vector, and how far it spreads, has no end.
WHOLE = 0.95
ENTRIES = (*(f"about {axis}" for axis in "xyz"), "angle")


def attitude_panels(drawn: Sequence[Drawn], block: Block) -> list[Panel]:
    """The rotation vector of an attitude and its length, the angle, whose band would bend at zero: it has none.

    Of an entry of its quaternion that entry.
    """
    if block.size == 1:
        return [_entry_panel([d for d in drawn if d.knows(block.name)], block.name)]
    curves = []
    for d in [d for d in drawn if d.knows(block.name)]:
        quaternions = d.sample[block.name]
        goal = _required(d.solution, block.name, quaternions[-1])
        vectors = rotation_vectors(np.vstack([quaternions, goal]))
        values = np.rad2deg(np.column_stack([vectors, np.linalg.norm(vectors, axis=1)]))
        deviation = _deviation(d, block.name, vectors[: d.t.size])
        curves += [
            Curve(
                t=d.t,
                y=column[: d.t.size],
                deviation=None if deviation is None or i == len(deviation.T) else deviation[:, i],
                order=d.order,
                entry=i,
                target=float(column[-1]) if len(goal) else None,
            )
            for i, column in enumerate(values.T)
        ]
    return [Panel(label=f"{block.name} [°]", entries=ENTRIES, curves=tuple(curves))]


def _entry_panel(drawn: Sequence[Drawn], name: str) -> Panel:
    """An entry of a quaternion; to first order dq = B(q) e with the error e in body axes."""
    owner, k = split_entry(name) or (name, 0)
    curves = []
    for d in drawn:
        quaternions, deviation = d.sample[owner], None
        if d.covariance is not None and d.rows(owner):
            basis = np.array([rotation_chart().basis(q).full()[k] for q in quaternions])
            deviation = np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", basis, d.block(owner, owner), basis), 0.0))
        certain = deviation is None or not np.any(deviation)
        curves.append(Curve(t=d.t, y=quaternions[:, k], deviation=None if certain else deviation, order=d.order))
    label = f"{owner} q{k}"
    return Panel(label=label, entries=(label,), curves=tuple(curves))


def _deviation(drawn: Drawn, name: str, vectors: Array) -> Array | None:
    """Standard deviations of the entries of the rotation vectors [°], (K, 3); None where the attitude is certain.

    To first order dphi = J(phi)^-1 e with the error e in body axes.
    """
    if drawn.covariance is None or not drawn.rows(name):
        return None
    slopes = so3.inverse_left_jacobian(vectors)
    variances = np.einsum("kij,kjl,kil->ki", slopes, drawn.block(name, name), slopes)
    result = np.rad2deg(np.sqrt(np.maximum(variances, 0.0)))
    result[np.linalg.norm(vectors, axis=1) > WHOLE * 2 * np.pi] = np.nan
    return result if np.any(result) else None


def _required(solution: Solution, name: str, last: Array) -> Array:
    """The quaternion that is required at the end, near the last one, (1, 4); (0, 4) where none is, or none is known.

    Its condition is 2 v = 0, with the quaternion +-(w, v), w >= 0, of the last attitude relative to it.
    """
    statement, names = solution.statement, [f"final {name}[{i}]" for i in range(3)]
    if statement is None or not set(names) <= set(statement.end.names):
        return np.zeros((0, 4))
    rows = [statement.end.names.index(entry) for entry in names]
    state, *others = (np.array(values)[:, -1] for values in solution.extremal.columns())

    def missed(quaternion: Array) -> Array:
        state[solution.block(name).span] = quaternion
        return np.asarray(statement.end.function(state, *others).full()).ravel()[rows] / 2

    sine = missed(last)
    length = float(np.linalg.norm(sine))
    turn = 2 * np.arcsin(min(length, 1.0)) * sine / length if length > 0 else sine
    both = [np.asarray(so3.quaternion_step(last, sign * turn)).ravel() for sign in (-1.0, 1.0)]
    return min(both, key=lambda quaternion: float(np.linalg.norm(missed(quaternion))))[None]
