"""Ways round what path conditions forbid: which side of each obstacle to pass, before a solver is called.

A solver keeps the side of an obstacle on which it begins. So where a start runs through one that has two sides, runs
are pushed out to each, and brought back to little energy there; of several obstacles the cheapest run goes on first, up
to so many tries. What is found first is then about the cheapest.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.transcription.clearing import Clearing, Push, cleared, energy, in_sizes
from covocp.transcription.path_rows import Course, course
from covocp.transcription.ranking import merit
from covocp.transcription.sides import pushes, stretches
from covocp.transcription.steering import Run

# Runs that are pushed to some side, and ways that are kept, at most.
TRIES, KEPT = 40, 3
# What may be left of the conditions, in their sizes, and of the final values.
LEFT = 0.05
# Largest size of what is beyond a limit, as a share of the magnitude of the condition, where nothing was beyond it.
FAINT = 0.01
# Runs are one whose costs differ by less than the first, relative, and states by less than the second, in their scales,
# or the third in the end.
SAME, NEARBY, KEPT_APART = 2e-3, 0.01, 0.05
# Ways that cost up to so many times more are compared by the method, and where the duration is free.
NEAR, NEAR_FREE = 0.15, 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Detour:
    """A run, the nodes and conditions for which it was cleared, their sizes, and what it costs."""

    along: Course
    meant: NDArray[np.bool_]
    sizes: Array
    cost: float
    violation: float

    __repr__ = short_repr

    @property
    def rank(self) -> tuple[bool, float]:
        """Less is better."""
        return self.violation > LEFT, self.cost


def detours(run: Run, fixed: tuple[int, ...], target: Array, flat: Array, roots: list[Array]) -> list[Array]:
    """Controls of the cheapest ways round what path conditions forbid, the best first; none where nothing has sides.

    Args:
        run: of the nominal, on a coarse mesh.
        fixed: states with final values.
        target: these values.
        flat: controls without energy.
        roots: controls from which the search begins.
    """
    task = Clearing(fixed=fixed, target=target, flat=flat, sizes=np.ones(0), energy=1.0)
    queue: list[tuple[bool, float, int, Detour]] = []
    found: list[Detour] = []
    made = [root for u in roots if (root := _root(run, u, task)) is not None]
    for k, root in enumerate(made):
        heapq.heappush(queue, (*root.rank, k, root))
    pushed = 0
    while queue and len(found) < KEPT:
        best = heapq.heappop(queue)[-1]
        if not np.isfinite(best.cost):
            break
        place = _deepest(best)
        if place is None:
            found += [best] if not best.violation > LEFT and _is_new(best, found, KEPT_APART) else []
        elif pushed < TRIES:
            sides = pushes(best.along, *place, fixed)
            pushed += len(sides)
            for child in _beside(best, *place, sides, task):
                if _is_new(child, made):
                    made.append(child)
                    heapq.heappush(queue, (*child.rank, len(made), child))
    if not pushed or not found:
        return []
    near = NEAR_FREE if run.statement.duration.free else NEAR
    return [one.along.u for one in found if one.cost <= found[0].cost + near * abs(found[0].cost)]


def _root(run: Run, u: Array, task: Clearing) -> Detour | None:
    """A run as it is; None where something along it has no value."""
    along = course(run, u)
    if along is None:
        return None
    return _detour(along, np.zeros(along.values.shape, dtype=bool), FAINT * along.magnitudes, task)


def _detour(along: Course, meant: NDArray[np.bool_], sizes: Array, task: Clearing) -> Detour:
    """A run with what it costs; by its energy where the duration is free, which is then part of the cost."""
    cost, _ = merit(along.run, along.u)
    if along.run.statement.duration.free:
        cost = energy(along.run, along.u, task.flat)
    excess = np.maximum(along.excess / sizes, 0.0)[meant].max(initial=0.0)
    rows = list(task.fixed)
    miss = np.abs((along.x[-1, rows] - task.target) / along.run.divisors[rows]).max(initial=0.0)
    return Detour(along=along, meant=meant, sizes=sizes, cost=cost, violation=float(max(excess, miss)))


def _deepest(detour: Detour) -> tuple[int, NDArray[np.intp]] | None:
    """The condition that is violated most and has not been cleared, and the nodes of it; None where there is none."""
    along, m = detour.along, detour.along.run.statement.path.size
    open_ = along.violated[:, :m] & ~detour.meant[:, :m]
    found = [(row, nodes) for row in range(m) for nodes in stretches(open_[:, row])]
    if not found:
        return None
    depths = along.excess[:, :m] / along.magnitudes[:m]
    return max(found, key=lambda one: float(depths[one[1], one[0]].max()))


def _beside(detour: Detour, row: int, nodes: NDArray[np.intp], sides: list[Push], task: Clearing) -> list[Detour]:
    """The run pushed to each side of a condition; only cleared of that condition where it has but one."""
    along, run = detour.along, detour.along.run
    sizes = detour.sizes.copy()
    sizes[row] = max(sizes[row], float(along.excess[nodes, row].max()))
    meant = detour.meant.copy()
    spare = max(1, nodes.size // 2)
    meant[max(0, nodes[0] - spare) : nodes[-1] + spare + 1, row] = True
    meant[:, run.statement.path.size :] = True
    result: list[Detour] = []
    used = energy(run, along.u, task.flat)
    each: list[Push | None] = [*sides] or [None]
    for push in each:
        unit = used + (push.depth**2 if push is not None else 0.0)
        own = in_sizes(task, sizes, unit if unit > 0 else 1.0)
        following, counted = cleared(along, detour.meant, meant, own, push)
        result.append(_detour(following, counted, sizes, task))
    return result


def _is_new(detour: Detour, found: list[Detour], apart: float = NEARBY) -> bool:
    """Whether no other one that was cleared of the same conditions has about the same states and the same cost."""
    scale, rows = detour.along.run.divisors, detour.meant.any(axis=0)
    alike = [other for other in found if abs(other.cost - detour.cost) <= SAME * abs(detour.cost)]
    alike = [other for other in alike if np.array_equal(other.meant.any(axis=0), rows)]
    return all(np.abs((detour.along.x - other.along.x) / scale).max() > apart for other in alike)
