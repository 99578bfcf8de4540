"""Angles that turn full circle between two nodes: local minima that the piecewise form of a control makes.

Where a control is an angle, its values at two neighbouring nodes may belong to one course and yet differ by a turn:
what lies between them runs through all directions. As long as the interval is short this costs little, so that no
small change of the nodes gains anything; the cost is off by the length of the interval all the same.

Bounds that are one turn apart exclude no direction. A course that would turn through one of them has to stop there, or
to make such a turn: a warning says to leave them out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from covocp.base.errors import warn_user
from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal
from covocp.transcription.trajectory import Trajectory

# Turns in radians and in degrees.
TURNS = (2.0 * np.pi, 360.0)
# Changes from node to node that may be part of a turn, and what may be left of a turn, both as shares of it.
STEEP, LEFT = 1 / 8, 1 / 4
# Difference below which two values are the same, as a share of the largest one along the nodes.
SAME = 1e-9
# Share of a turn by which a value may be off a bound that holds it, and the distance of bounds off a turn.
SAME_TURN = 1e-5
# Share of a turn after which an angle on which something depends makes a difference.
NO_TURN = 0.3


def unwound(extremal: Extremal) -> Trajectory | None:
    """The trajectory without the turns of its controls; None where there are none, or where they are no angles."""
    st, t = extremal.statement, extremal.trajectory
    _mention_bounds(extremal)
    if extremal.mesh.control != "linear" or not st.nu or st.coupled:
        return None
    u = t.u.copy()
    for i in range(st.nu):
        for turn in TURNS:
            course = _without_turns(t.u[:, i], turn)
            if course is None or not _is_angle(extremal, i, turn):
                continue
            lower, upper = (bound[i] for bound in st.control_bounds)
            shifts = turn * np.arange(-3, 4)
            inside = [s for s in shifts if (course + s >= lower).all() and (course + s <= upper).all()]
            if inside:
                u[:, i] = course + min(inside, key=abs)
    return None if np.array_equal(u, t.u) else replace(t, u=u)


def _mention_bounds(extremal: Extremal) -> None:
    """Warn of bounds of angles that exclude no direction, where a course is held by one of them."""
    st, u = extremal.statement, extremal.trajectory.u
    lower, upper = st.control_bounds
    for i, name in enumerate(st.control_names):
        for turn in TURNS:
            if not abs(upper[i] - lower[i] - turn) <= SAME_TURN * turn:
                continue
            held = np.minimum(u[:, i] - lower[i], upper[i] - u[:, i]) <= SAME_TURN * turn
            if held.any() and _is_angle(extremal, i, turn) and not _is_angle(extremal, i, NO_TURN * turn):
                warn_user(
                    f"Bounds of '{name}' are one turn apart: leave them out. They exclude no direction, but they hold "
                    "an angle that would turn through one of them."
                )


def _without_turns(values: Array, turn: float) -> Array | None:
    """A course without the steep pieces that make whole turns; None where it has none."""
    steps = np.diff(values)
    course, shift, k, found = values.copy(), 0.0, 0, False
    while k < steps.size:
        end = k
        while end < steps.size and np.sign(steps[end]) == np.sign(steps[k]) and abs(steps[end]) > STEEP * turn:
            end += 1
        change = float(values[end] - values[k])
        turns = round(change / turn)
        if end > k and turns and abs(change - turns * turn) < LEFT * turn:
            found, shift = True, shift - turns * turn
            course[k : end + 1] = np.linspace(course[k], values[end] + shift, end - k + 1)
        k = max(end, k + 1)
        course[k:] = values[k:] + shift
    return course if found else None


def _is_angle(extremal: Extremal, i: int, turn: float) -> bool:
    """Whether nothing along the nodes changes when a control makes one turn more."""
    st, count = extremal.statement, extremal.mesh.intervals + 1
    columns = [np.asarray(column) for column in extremal.columns()]
    turned = list(columns)
    turned[1] = columns[1] + turn * (np.arange(st.nu) == i)[:, None]
    functions = [function.map(count) for function in (st.rates, *([st.path.function] if st.path.size else []))]
    for function in functions:
        pairs = zip(function.call(columns), function.call(turned), strict=True)
        for one, other in ((np.asarray(a), np.asarray(b)) for a, b in pairs):
            if not (np.abs(one - other) <= SAME * np.abs(one).max(axis=1, keepdims=True)).all():
                return False
    return True
