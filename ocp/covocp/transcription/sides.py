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
from covocp.transcription.path_rows import Course, inward, reads_time, row_gradients, slopes_along, states_read
from covocp.transcription.steering import Run

# Directions across the way at most; how far to look along them, in magnitudes of the states, at so many places, or so
# many at most where there are several magnitudes.
DIRECTIONS = 2
NEAREST, FARTHEST, PLACES, MOST_PLACES = 1e-3, 4.0, 40, 120
# Directions that cost so much more energy than the cheapest one, squared, are none; so are lengths below this share.
REACHED, SHORT = 1e-6, 1e-3
# Squared lengths below this share of those that states have while the final values may move are rounding; what moves
# the final values in no other direction than this share of the others do, moves them in that one as well.
ROUNDED, ALIKE = 1e-12, 1e-10
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
        steps = _steps(along, list(states_read(along.run.statement)[row]), direction, normal)
        both = [_push(along, row, nodes, deepest, sign * direction, sign * normal, steps) for sign in (1.0, -1.0)]
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
    read, states = list(states_read(st)[row]), slopes_along(along)[0]
    if not np.isfinite(states).all():
        return None
    root, inverse = _metric(run, states, int(deepest), read, fixed)
    if not root.size:
        return None
    chord = inverse @ (along.x[nodes[-1]] - along.x[nodes[0]])[read]
    slope = np.asarray(row_gradients(st)(*along.points(np.array([deepest]), along.x[[deepest]])).full())[row, read]
    towards = root.T @ np.nan_to_num(slope)
    way = [chord / np.linalg.norm(chord)] if np.linalg.norm(chord) > 0 else []
    across = _perpendicular([towards, *_outward(along, row, int(deepest), root, way)], way, DIRECTIONS)
    if reads_time(st)[row] or not across:  # before or after what moves, or the only way there is
        across += way
    directions, normals = np.zeros((st.nx, len(across))), np.zeros((st.nx, len(across)))
    directions[read], normals[read] = root @ np.array(across).T, inverse.T @ np.array(across).T
    return directions, normals


def _outward(along: Course, row: int, node: int, root: Array, way: list[Array]) -> Array:
    """Unit vectors, those first along which a condition is soonest met: by its curvature across the way."""
    rest = np.eye(root.shape[1])
    second = inward(along, row, node)
    if second is None:
        return rest
    read = list(states_read(along.run.statement)[row])
    beside = rest - sum((np.outer(one, one) for one in way), start=np.zeros_like(rest))
    curved = beside @ root.T @ second[np.ix_(read, read)] @ root @ beside
    return np.vstack([np.linalg.eigh(curved)[1].T, rest]) if np.isfinite(curved).all() else rest


def _metric(run: Run, states: Array, node: int, read: list[int], fixed: tuple[int, ...]) -> tuple[Array, Array]:
    """A square root of the covariance that states at a node have of controls of unit energy, and its inverse.

    Each state is measured by what moves it while the final values may move, which is sound where its scale is not: a
    coordinate that is zero but for rounding. At a node whose states are fixed nothing but rounding is left of that.
    """
    own, last = (part / np.sqrt(run.weights) for part in (states[node][read], states[-1][list(fixed)]))
    scale, ends = (np.linalg.norm(part, axis=1) for part in (own, last))
    scale, ends = (np.where(sizes > 0, sizes, 1.0)[:, None] for sizes in (scale, ends))
    own, last = own / scale, last / ends
    if fixed:
        own = own - own @ np.linalg.pinv(last, rcond=ALIKE) @ last
    values, vectors = np.linalg.eigh(own @ own.T)
    moved = values > max(REACHED * values.max(initial=0.0), ROUNDED)
    lengths, vectors = np.sqrt(values[moved])[::-1], vectors[:, moved][:, ::-1]
    return scale * vectors * lengths, (vectors / lengths).T / scale[:, 0]


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


def _steps(along: Course, read: list[int], direction: Array, normal: Array) -> Array:
    """How far to look in a direction: in units of what states are, the nearest that may count first, evenly apart.

    Units are those of each state, and of the run along the direction; where the states that a condition reads are of
    one kind, such as coordinates, also the largest of them: the way across may be longer than the goal lies aside.
    Where they are not, that looks too far as well, which costs a few places.
    """
    scale, sizes = along.run.divisors[read], np.abs(direction[read])
    travelled = np.ptp(along.x @ normal)
    reaches = np.array([1.0 / (sizes / scale).max(), scale.max() / sizes.max(), travelled])
    reaches = reaches[np.isfinite(reaches) & (reaches > 0)]
    near, far = NEAREST * reaches.min(), FARTHEST * reaches.max()
    count = 1 + int(np.ceil(np.log(far / near) / np.log(FARTHEST / NEAREST) * (PLACES - 1)))
    return np.geomspace(near, far, min(count, MOST_PLACES))


def _push(
    along: Course,
    row: int,
    nodes: NDArray[np.intp],
    deepest: np.intp,
    direction: Array,
    normal: Array,
    steps: Array,
) -> Push | None:
    """A push in one direction as far as the condition is met there; None where it is met nowhere near."""
    places = along.x[nodes][:, None, :] + steps[None, :, None] * direction
    at = np.repeat(nodes, steps.size)
    rows = along.run.statement.path.function.map(at.size)(*along.points(at, places.reshape(at.size, -1)))
    values = np.asarray(rows.full())[row].reshape(nodes.size, steps.size)
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
