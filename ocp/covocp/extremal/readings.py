"""Measurements at instants along a trajectory: what is read, and the gains with which the design's filter takes it.

At an instant the estimate y and its error e jump with what is new in the reading, v its noise [Joseph's form of E]:

    y+ = y + K (v - H e),    e+ = e + K (v - H e),    K = E H' (H E H' + R)^-1.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.gains import innovation_gain
from covocp.base.matrices import Array, stacked, unpack
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal


@dataclass(frozen=True, kw_only=True, eq=False)
class Readings:
    """What is read at one instant.

    interval: of no length, in which it is read; rows: of all values that can be read, those that are.
    H: their slopes by the augmented state, (r, n); R: variance of their noise, (r, r); gain: K of the design, (n, r).
    """

    interval: int
    rows: list[int]
    H: Array
    R: Array
    gain: Array

    __repr__ = short_repr

    def jump(self, variance: Array) -> tuple[Array, Array]:
        """Transition of (e, y) and the covariance that a noise of this variance gives both, (2n, 2n) each."""
        n = self.gain.shape[0]
        fed = self.gain @ self.H
        transition = np.block([[np.eye(n) - fed, np.zeros((n, n))], [-fed, np.eye(n)]])
        own = self.gain @ variance @ self.gain.T
        return transition, np.block([[own, own], [own, own]])


def readings_along(extremal: Extremal) -> list[Readings]:
    """What is read along a trajectory, instant by instant; none where nothing is estimated."""
    st, mesh = extremal.statement, extremal.mesh
    if st.samples is None or not st.estimated or not mesh.readings.any():
        return []
    block, at = st.estimation, [k for k in mesh.instants if mesh.readings[:, k].any()]
    columns = [np.asarray(column)[:, at] for column in extremal.columns()]
    x, u, _, *rest = columns
    _, H, R = (stacked(v, len(at)) for v in st.samples.measurement.map(len(at))(x, u, *rest))
    E = unpack(extremal.trajectory.e[at][:, block.span], block.size)
    result = []
    for k, interval in enumerate(at):
        rows = read_rows(extremal, interval)
        own, noise = H[k][rows], R[k][np.ix_(rows, rows)]
        gain = innovation_gain(E[k], own, noise, np.linalg.solve)[0]
        result.append(Readings(interval=interval, rows=rows, H=own, R=noise, gain=gain))
    return result


def read_rows(extremal: Extremal, interval: int) -> list[int]:
    """Rows of all values that can be read at instants, those that an interval reads."""
    samples: Any = extremal.statement.samples
    taken = zip(samples.blocks, extremal.mesh.readings[:, interval], strict=True)
    return [row for block, part in taken if part for row in range(block.span.start, block.span.stop)]


def stretches(extremal: Extremal) -> list[slice]:
    """The nodes between the instants: what is constant along a trajectory may jump where something is read or holds."""
    ends = [-1, *extremal.mesh.instants, extremal.mesh.intervals]
    found = [slice(begin + 1, end + 1) for begin, end in pairwise(ends)]
    return [part for part in found if part.stop - part.start > 1] or found[:1]
