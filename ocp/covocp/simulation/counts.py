"""How many runs violate each constraint of the problem, beside what the covariances promise."""

from __future__ import annotations

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.simulation.constraints import Place, Row
from covocp.simulation.sampling import share_band


@dataclass(frozen=True, kw_only=True)
class Count:
    """How many runs violate one constraint, or a bound, of the problem.

    name: of the constraint, or of the state or control whose bound it is. place: "path", "initial", "final" or
    "inside", at an instant. bound: whether it is a bound. chance: whether it is of a condition on a probability. joint:
    of several rows that hold together; what is promised is then an upper bound. What contains an integral is promised
    nothing (NaN).
    runs: that violate it, at any instant of the path; share: of all runs.
    at_end: runs that violate it at the end, those that left the domain among them, and end_share; promised_end: what
    the covariances promise for normal deviations, (low, high): the confidence band of the probability that the runs
    have. For "initial" and "inside" all of these are those of the start and of the instant, most_time.
    most: largest share at one stored time, most_time [s]; promised_most: what is promised there.
    """

    name: str
    place: Place
    bound: bool
    runs: int
    share: float
    at_end: int
    end_share: float
    promised_end: float
    low: float
    high: float
    most: float
    most_time: float
    promised_most: float
    chance: bool = False
    joint: bool = False

    @property
    def as_promised(self) -> bool:
        """Whether what is promised at the end is inside the confidence band of the runs; where nothing is, true."""
        if np.isnan(self.promised_end):
            return True
        return self.low <= self.promised_end and (self.joint or self.promised_end <= self.high)


def count(
    rows: tuple[Row, ...], violated: Given, at_end: Given, violating: Array, promise: Array, t: Array, level: float
) -> tuple[Count, ...]:
    """The counts of all inequalities.

    Args:
        rows: the inequalities.
        violated: whether a run violates each at some instant, (R, rows).
        at_end: whether it does at the end, (R, rows).
        violating: share of the runs that do at each stored time, (K, rows).
        promise: probability by the covariances, (K, rows).
        t: stored times [s].
        level: probability of the bands.
    """
    result, runs = [], violated.shape[0]
    for i, row in enumerate(rows):
        once = row.among(t)
        hits = int(np.count_nonzero((violated if row.place in ("initial", "inside") else at_end)[:, i]))
        k = int(np.argmax(violating[:, i])) if once is None else once
        low, high = share_band(hits, runs, level)
        result.append(
            Count(
                name=row.name,
                place=row.place,
                bound=row.bound,
                runs=int(np.count_nonzero(violated[:, i])),
                share=float(violated[:, i].mean()),
                at_end=hits,
                end_share=hits / runs,
                promised_end=float(promise[-1 if once is None else once, i]),
                low=float(low),
                high=float(high),
                most=float(violating[k, i]),
                most_time=float(t[k]),
                promised_most=float(promise[k, i]),
                chance=row.chance,
                joint=bool(row.parts),
            )
        )
    return tuple(result)
