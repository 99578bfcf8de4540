"""Nodes from local errors: intervals of equal error, and a close pair of nodes on both sides of a jump of a control."""

from __future__ import annotations

from typing import Any

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, distinct
from covocp.base.short_repr import short_repr

# Parts of an interval, at most, and the share of it that a new one is at least: errors are not followed further.
MOST_PARTS, LEAST_PART = 8.0, 1 / 3
# An interval in which a control changes by this share of its range, and this many times as fast as beside it, is part
# of a jump, which so many of them hide at most.
STEEP, FASTER, HIDING = 0.1, 4.0, 4
# Distance of the two nodes from the place of a jump, in the length of the intervals that hid it.
BESIDE = 0.04
# Change of a control over an interval, in its range, from which on thirds are compared with it, not halves.
CHANGING = 0.1
# Share of the parts of an interval that each piece of it has at least.
EVENLY = 0.15
# Nodes closer than this share of the duration are one.
CLOSEST = 1e-10


@dataclass(frozen=True, kw_only=True, eq=False)
class Jump:
    """A jump of a control: it lies between two nodes, and where a sudden one has the same integral."""

    begin: float
    end: float
    place: float

    __repr__ = short_repr

    @property
    def nodes(self) -> tuple[float, float]:
        """Two nodes, one on each side."""
        beside = BESIDE * (self.end - self.begin)
        return self.place - beside, self.place + beside


def divided(nodes: Array, controls: Array, constant: bool) -> Array:
    """The nodes, each once, and others between them: two where a control changes much, else the middle.

    Halves alone would not tell what a jump costs that lies in the middle of an interval, or at a node: with a node
    there a linear control is the same.

    Args:
        nodes: rising, (N + 1,).
        controls: values there, (N + 1, nu), or of the intervals where they are constant over each, (N, nu).
        constant: which of both.
    """
    first = np.flatnonzero(np.diff(nodes, prepend=-1.0))
    own = nodes[first]
    span = np.ptp(controls, axis=0)
    change = np.abs(np.diff(controls, axis=0)) >= CHANGING * np.where(span > 0, span, np.inf)
    steep = np.zeros(nodes.size - 1, dtype=bool)
    if constant:
        steep[1:] |= change.any(axis=1)
        steep[:-1] |= change.any(axis=1)
    else:
        steep |= change.any(axis=1)
    last = np.append(first[1:], nodes.size) - 1  # of nodes that are there twice
    parts = np.where(steep[last[:-1]], 3, 2)
    h = np.diff(own)
    inner = [own[:-1][parts > j] + h[parts > j] * j / parts[parts > j] for j in (1, 2)]
    return np.sort(np.concatenate([own, *inner]))


def remeshed(
    nodes: Array, ends: Array, errors: Array, order: int, allowed: float, jumps: list[Jump], kept: Array
) -> Array:
    """Nodes whose intervals have about the same error, all together what is allowed.

    Args:
        nodes: of a mesh, rising, each once, (N + 1,).
        ends: these and others between them, rising, (M + 1,).
        errors: of the mesh by the pieces between the ends, (M,).
        order: power of the length with which the error of an interval falls.
        allowed: sum of the errors of the new mesh.
        jumps: of controls; the errors where they are hidden are left to their own nodes.
        kept: what must stay a node.

    Returns:
        Rising from 0 to 1.
    """
    pieces, owner = _pieces(nodes, ends, errors, jumps)
    whole = _gathered(pieces, owner, nodes)
    total = float((whole ** (1 / order)).sum())
    each = (allowed / total) ** (order / (order - 1)) if total > 0 else np.inf
    parts = np.clip((whole / each) ** (1 / order), LEAST_PART, MOST_PARTS)
    weights = pieces ** (1 / order)
    weights = np.maximum(weights, EVENLY * _gathered(weights, owner, nodes)[owner])
    sums = _gathered(weights, owner, nodes)[owner]
    shares = np.where(sums > 0, weights / np.where(sums > 0, sums, 1.0), 1.0 / np.bincount(owner)[owner])
    levels = np.append(0.0, np.cumsum(parts[owner] * shares))
    fixed = distinct([0.0, 1.0], kept, *(jump.nodes for jump in jumps))
    fixed = fixed[np.append(True, np.diff(fixed) > CLOSEST)]
    at = np.interp(fixed, ends, levels)
    result = [np.zeros(1)]
    for first, last, low, high in zip(fixed[:-1], fixed[1:], at[:-1], at[1:], strict=True):
        count = max(1, int(np.ceil(high - low - 1e-9)))
        inner = np.interp(low + (high - low) * np.arange(1, count) / count, levels, ends)
        result += [inner[(inner > first + CLOSEST) & (inner < last - CLOSEST)], np.array([last])]
    return np.concatenate(result)


def demand(nodes: Array, ends: Array, errors: Array, order: int, jumps: list[Jump]) -> float:
    """How much of what several meshes are allowed together one of them takes, in proportion.

    With these shares the intervals of all of them have about the same error: no others have as few.

    Args:
        nodes: of the mesh.
        ends: these and others between them.
        errors: by the pieces between the ends.
        order: power of the length with which the error of an interval falls.
        jumps: of controls.
    """
    return float((_gathered(*_pieces(nodes, ends, errors, jumps), nodes) ** (1 / order)).sum())


def _pieces(nodes: Array, ends: Array, errors: Array, jumps: list[Jump]) -> tuple[Array, Any]:
    """The errors without those where jumps are hidden, and the intervals that the pieces are of."""
    pieces = errors.copy()
    for jump in jumps:
        pieces[(ends[:-1] >= jump.begin - CLOSEST) & (ends[1:] <= jump.end + CLOSEST)] = 0.0
    return pieces, np.searchsorted(nodes, ends[:-1], side="right") - 1


def _gathered(values: Array, owner: Any, nodes: Array) -> Array:
    """Sums of the pieces of each interval."""
    return np.bincount(owner, weights=values, minlength=nodes.size - 1).astype(float)


def jumps_of(nodes: Array, controls: Array, constant: bool) -> list[Jump]:
    """Where controls seem to jump: groups of few intervals in which one changes much faster than beside them.

    Args:
        nodes: rising, (N + 1,).
        controls: values there, (N + 1, nu), or of the intervals where they are constant over each, (N, nu).
        constant: which of both.
    """
    found: list[Jump] = []
    for values in controls.T:
        found += _jumps(nodes, np.append(values, values[-1:]) if constant else values, constant)
    return sorted(found, key=lambda jump: jump.place)


def _jumps(nodes: Array, u: Array, constant: bool) -> list[Jump]:
    """Of one control; of a constant one the values are those at the starts of the intervals."""
    h, change = np.diff(nodes), np.diff(u)
    steep = np.abs(change) >= STEEP * np.ptp(u) if np.ptp(u) > 0 else np.zeros(h.size, dtype=bool)
    found, k = [], 0
    while k < h.size:
        if not steep[k]:
            k += 1
            continue
        begin = k
        while k < h.size and steep[k]:
            k += 1
        # a value close to that before or after the jump makes no steep interval of its own
        first, last = max(begin - 1, 0), min(k + 1, h.size)
        if last - first <= HIDING + 2:
            jump = _placed(nodes, u, first, last, constant)
            if jump is not None:
                found.append(jump)
    return found


def _placed(nodes: Array, u: Array, first: int, last: int, constant: bool) -> Jump | None:
    """The jump between two nodes, from the lines before and after it; None where there is none."""
    h = np.diff(nodes)
    before = 0.0 if first == 0 or constant else (u[first] - u[first - 1]) / h[first - 1]
    after = 0.0 if last == h.size or constant else (u[last + 1] - u[last]) / h[last]
    begin, end = nodes[first], nodes[last]
    width = end - begin
    between = abs(u[last] - u[first]) / width
    if between < FASTER * max(abs(before), abs(after)) or width < CLOSEST:
        return None
    pieces = u[first:last] if constant else 0.5 * (u[first:last] + u[first + 1 : last + 1])
    area = float((pieces * h[first:last]).sum())
    t = np.linspace(0.0, width, 2001)
    left = u[first] * t + 0.5 * before * t**2
    right = u[last] * (width - t) - 0.5 * after * (width - t) ** 2
    miss = left + right - area
    change = np.flatnonzero(np.sign(miss[1:]) != np.sign(miss[:-1]))
    if not change.size:
        return None
    i = int(change[0])
    share = miss[i] / (miss[i] - miss[i + 1])
    place = float(begin + t[i] + share * (t[i + 1] - t[i]))
    margin = BESIDE * width
    return Jump(begin=begin, end=end, place=float(np.clip(place, begin + margin, end - margin)))
