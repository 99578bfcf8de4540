"""Ways round what path conditions forbid: which side of each obstacle to pass, before a solver is called.

A solver keeps the side of an obstacle on which it begins. So where a start runs through one that has two sides, runs
are pushed out to each, and brought back to little energy there; of several obstacles the cheapest run goes on first, up
to so many tries. What is found first is then about the cheapest.
"""

from __future__ import annotations

import heapq
from dataclasses import field, replace

import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.transcription.clearing import Clearing, Push, cleared, energy, in_sizes
from covocp.transcription.path_rows import Course, course, slopes_along
from covocp.transcription.ranking import merit
from covocp.transcription.sides import pushes, stretches
from covocp.transcription.steering import Run

# Runs that are pushed to some side until there is a way, and after that, and ways that are kept, at most.
TRIES, MORE, KEPT = 40, 10, 3
# What may be left of the conditions, in their sizes, and of the final values.
LEFT = 0.05
# Scales of states are no smaller than this share of what they can be moved by.
NOTICED = 0.01
# Largest size of what is beyond a limit, as a share of the magnitude of the condition, where nothing was beyond it.
FAINT = 0.01
# Runs are one whose costs differ by less than the first, relative, and states by less than the second, in their scales,
# or the third in the end.
SAME, NEARBY, KEPT_APART = 2e-3, 0.01, 0.05
# Ways that cost up to so much more, relative, are compared by the method; where the duration is free; where the cost is
# the energy, up to the last one.
NEAR, NEAR_FREE, EQUAL, EXACT = 0.15, 1.0, 0.05, 0.01


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


def detours(
    run: Run, fixed: tuple[int, ...], target: Array, flat: Array, roots: list[Array]
) -> list[tuple[Array, float]]:
    """Controls of the cheapest ways round what path conditions forbid, the best first; none where nothing has sides.

    And what each costs, NaN where the duration is free: the ways are then compared by their energy.

    Args:
        run: of the nominal, on a coarse mesh.
        fixed: states with final values.
        target: these values.
        flat: controls without energy.
        roots: controls from which the search begins.
    """
    run = _in_moved_scales(run, flat, roots)
    task = Clearing(fixed=fixed, target=target, flat=flat, sizes=np.ones(0), energy=1.0)
    search = _Search(task=task)
    for u in roots:
        search.begin(_root(run, u, task))
    search.dive()
    free = run.statement.duration.free
    found = search.cheapest(NEAR_FREE if free else EQUAL if search.exact else NEAR)
    return [(one.along.u, np.nan if free else one.cost) for one in found] if search.went_on else []


@dataclass(kw_only=True, eq=False)
class _Search:
    """Runs that are open, the cheapest first, and all that were made."""

    task: Clearing
    made: list[Detour] = field(default_factory=list)
    queue: list[tuple[bool, float, int, Detour]] = field(default_factory=list)
    left: int = TRIES
    added: int = 0
    went_on: bool = False

    __repr__ = short_repr

    @property
    def exact(self) -> bool:
        """Whether runs cost their energy, of which they have the least: then the method changes them little."""
        used = np.array([energy(one.along.run, one.along.u, self.task.flat) for one in self.made])
        costs = np.array([one.cost for one in self.made])
        some = np.isfinite(costs) & (used > 0)
        if not some.any():
            return False
        price = costs[some].sum() / used[some].sum()
        return bool((np.abs(costs - price * used)[some] <= EXACT * np.abs(costs[some])).all())

    def begin(self, root: Detour | None) -> None:
        """With a run, where there is one."""
        if root is not None:
            self.made.append(root)
            self.add(root)

    def add(self, detour: Detour) -> None:
        """To those that are open."""
        if np.isfinite(detour.cost):
            self.added += 1
            heapq.heappush(self.queue, (*detour.rank, self.added, detour))

    def beside(self, detour: Detour, *, diving: bool = False) -> list[Detour]:
        """The run pushed to the sides of what it runs through deepest, as far as that is new and tries are left.

        On the way to a first one, two sides of each condition are all where four of each were more tries than are left.
        """
        place = _deepest(detour)
        if place is None or self.left <= 0:
            return []
        sides = pushes(detour.along, *place, self.task.fixed)
        if diving and len(sides) * _conditions(detour) > self.left:
            sides = sides[:2]
        self.left -= max(1, len(sides))
        following = []
        for child in _beside(detour, *place, sides, self.task):
            if _is_new(child, self.made):
                self.made.append(child)
                following.append(child)
        self.went_on |= bool(following)
        return following

    def dive(self) -> None:
        """Go on from the cheapest run, and from the cheapest one beside it, to some way: where many are in the way."""
        best = heapq.heappop(self.queue)[-1] if self.queue else None
        while best is not None:
            following = sorted(self.beside(best, diving=True), key=lambda one: one.rank)
            if _deepest(best) is None:
                self.add(best)
            for other in following[1:]:
                self.add(other)
            best = following[0] if following else None

    def cheapest(self, near: float) -> list[Detour]:
        """The cheapest ways, of which none costs so much more than the first.

        Where the energy is the cost, no run goes on that costs as much as a way that is known: it becomes no cheaper.
        """
        found: list[Detour] = []
        ways = [one.cost for *_, one in self.queue if not one.violation > LEFT and _deepest(one) is None]
        least = (1.0 - EXACT) * min(ways) if ways and self.exact else np.inf
        self.left = min(self.left, MORE)
        while self.queue and len(found) < KEPT:
            best = heapq.heappop(self.queue)[-1]
            if found and best.rank > (False, found[0].cost + near * abs(found[0].cost)):
                break
            if _deepest(best) is not None:
                if not best.cost > least:
                    for child in self.beside(best):
                        self.add(child)
            elif not best.violation > LEFT and _is_new(best, found, KEPT_APART):
                found.append(best)
        return found


def _in_moved_scales(run: Run, flat: Array, roots: list[Array]) -> Run:
    """The run with scales of states that are no smaller than a share of what the roots' energy can move them by.

    A coordinate that shall end at zero but for rounding would count as missed by any run; where nothing tells a scale,
    such as of a speed from rest to rest, this is one in any unit.
    """
    along, used = course(run, roots[0]), max(energy(run, u, flat) for u in roots)
    if along is None or not 0 < used < np.inf:
        return run
    states = slopes_along(along)[0]
    moved = np.sqrt(used) * np.linalg.norm(states / np.sqrt(run.weights), axis=2).max(axis=0)
    if not np.isfinite(moved).all():
        return run
    told = np.where(run.scale > 0, np.maximum(run.scale, NOTICED * moved), moved)
    return replace(run, scale=told)


def _root(run: Run, u: Array, task: Clearing) -> Detour | None:
    """A run as it is, brought to its final values where it misses them; None where something along it has no value."""
    along = course(run, u)
    if along is None:
        return None
    none, sizes = np.zeros(along.values.shape, dtype=bool), FAINT * along.magnitudes
    root = _detour(along, none, sizes, task)
    if not root.violation > LEFT:
        return root
    used = energy(run, u, task.flat)
    nearer = cleared(along, none, none, in_sizes(task, sizes, used if used > 0 else 1.0))[0]
    return _detour(nearer, none, sizes, task)


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


def _conditions(detour: Detour) -> int:
    """How many are violated and have not been cleared."""
    m = detour.along.run.statement.path.size
    return int((detour.along.violated[:, :m] & ~detour.meant[:, :m]).any(axis=0).sum())


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
