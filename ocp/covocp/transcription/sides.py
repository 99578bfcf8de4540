"""To which sides a run may leave what a path condition forbids.

A condition has two sides where what it forbids lies between two places that it allows: a wall has one, a tree has two,
a ball has as many as there are directions across the way.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from covocp.base.matrices import Array
from covocp.statement.conditions import beyond
from covocp.transcription.clearing import Push
from covocp.transcription.path_rows import Course, reads_time, row_gradients, slopes_along, states_read
from covocp.transcription.steering import Run

# Directions across the way at most; how far to look along them, in magnitudes of the states, at so many places.
DIRECTIONS = 2
NEAREST, FARTHEST, PLACES = 1e-3, 4.0, 40
# Directions that cost so much more energy than the cheapest one, squared, are none; so are lengths below this share.
REACHED, SHORT = 1e-6, 1e-3
# So much farther than the place where a condition is met a run is pushed, so that its other nodes meet it as well.
FARTHER = 1.1


def stretches(marked: NDArray[np.bool_]) -> Iterator[NDArray[np.intp]]:
    """The nodes of each run of marks without a break."""
    places = np.flatnonzero(marked)
    if places.size:
        yield from np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)


def pushes(along: Course, row: int, nodes: NDArray[np.intp], fixed: tuple[int, ...]) -> list[Push]:
    """Pushes of a run out of what a condition forbids at some nodes, to each side; none where it has but one side."""
    deepest = nodes[int(np.argmax(along.excess[nodes, row]))]
    axes = _axes(along, row, nodes, deepest, fixed)
    if axes is None:
        return []
    directions, normals = axes
    found: list[Push] = []
    sided = False
    for direction, normal in zip(directions.T, normals.T, strict=True):
        both = [_push(along, row, nodes, deepest, sign * direction, sign * normal) for sign in (1.0, -1.0)]
        sided |= all(push is not None for push in both)
        found += [push for push in both if push is not None]
    return found if sided else []


def _axes(
    along: Course, row: int, nodes: NDArray[np.intp], deepest: np.intp, fixed: tuple[int, ...]
) -> tuple[Array, Array] | None:
    """Directions across the way in which states can be moved, a column each (nx, d), and their normals.

    Both in the metric of the energy that it takes to move them while the final values stay, which knows no units.
    """
    run, st = along.run, along.run.statement
    read = list(states_read(st)[row])
    root, inverse = _metric(run, slopes_along(along)[0], int(deepest), read, fixed)
    if not root.size:
        return None
    chord = inverse @ (along.x[nodes[-1]] - along.x[nodes[0]])[read]
    slope = np.asarray(row_gradients(st)(*along.points(np.array([deepest]), along.x[[deepest]])).full())[row, read]
    towards = root.T @ np.nan_to_num(slope)
    way = [chord / np.linalg.norm(chord)] if np.linalg.norm(chord) > 0 else []
    across = _perpendicular([towards, *np.eye(root.shape[1])], way, DIRECTIONS)
    if reads_time(st)[row] or not across:  # before or after what moves, or the only way there is
        across += way
    directions, normals = np.zeros((st.nx, len(across))), np.zeros((st.nx, len(across)))
    directions[read], normals[read] = root @ np.array(across).T, inverse.T @ np.array(across).T
    return directions, normals


def _metric(run: Run, states: Array, node: int, read: list[int], fixed: tuple[int, ...]) -> tuple[Array, Array]:
    """A square root of the covariance that states at a node have of controls of unit energy, and its inverse."""
    scale, ends = run.divisors[read], run.divisors[list(fixed)]
    own = states[node][read] / scale[:, None] / np.sqrt(run.weights)
    last = states[-1][list(fixed)] / ends[:, None] / np.sqrt(run.weights)
    if fixed:
        own = own - own @ np.linalg.pinv(last) @ last
    values, vectors = np.linalg.eigh(own @ own.T)
    moved = values > max(REACHED * values.max(initial=0.0), np.finfo(float).tiny)
    lengths, vectors = np.sqrt(values[moved])[::-1], vectors[:, moved][:, ::-1]
    return scale[:, None] * vectors * lengths, (vectors / lengths).T / scale


def _perpendicular(candidates: list[Array], to: list[Array], most: int) -> list[Array]:
    """Unit vectors along the candidates, perpendicular to some and to each other, at most so many."""
    found: list[Array] = []
    for candidate in candidates:
        rest = candidate.copy()
        for other in (*to, *found):
            rest -= (rest @ other) * other
        if len(found) < most and np.linalg.norm(rest) > max(SHORT * np.linalg.norm(candidate), np.finfo(float).tiny):
            found.append(rest / np.linalg.norm(rest))
    return found


def _push(
    along: Course, row: int, nodes: NDArray[np.intp], deepest: np.intp, direction: Array, normal: Array
) -> Push | None:
    """A push in one direction as far as the condition is met there; None where it is met nowhere near."""
    reach = np.abs(direction / along.run.divisors).max()
    steps = np.geomspace(NEAREST, FARTHEST, PLACES) / reach
    places = along.x[nodes][:, None, :] + steps[None, :, None] * direction
    at = np.repeat(nodes, PLACES)
    rows = along.run.statement.path.function.map(at.size)(*along.points(at, places.reshape(at.size, -1)))
    values = np.asarray(rows.full())[row].reshape(nodes.size, PLACES)
    met = beyond(values, along.lower[row], along.upper[row]) <= 0
    if not met[nodes == deepest].any():
        return None
    first = np.where(met.any(axis=1), steps[met.argmax(axis=1)], 0.0)
    lengths = FARTHER * np.where(first > 0, first, first.max())
    return Push(
        nodes=nodes,
        normals=np.tile(normal, (nodes.size, 1)),
        levels=along.x[nodes] @ normal + lengths,
        depth=float(lengths.max()),
    )
