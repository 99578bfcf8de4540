"""What a solution reaches of its conditions on probabilities: margins and probabilities by the linearised spread."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.normal import inside, margin, shown_probability
from covocp.base.residuals import PASSED
from covocp.statement.chances import ChanceLimits
from covocp.transcription.limit_units import limit_units

if TYPE_CHECKING:
    from covocp.base.pages import Section
    from covocp.solution.solution import Solution

# Share of the risk by which a probability may be missed before it is called so: the tolerance of the solver.
ROUNDED = 1e-3
# Share of the deviation that a limit may be passed by (`PASSED`) without changing a probability. Where the deviation is
# less, the limit counts from where the solver left it.
SMALL = 1e-3


@dataclass(frozen=True, kw_only=True)
class Reached:
    """A condition on a probability at the node where it is least, of one row or of several rows together.

    name: of the condition, of the row where there are several. place: "path", "initial" or "final".
    asked, reached: probability, of several rows by Boole's bound. time: of that node [s]. margin: by how much
        each limit could be drawn in there, in the unit of the expression; NaN of several rows. deviation: the standard
        deviation there, NaN of several rows.
    """

    name: str
    place: str
    asked: float
    reached: float
    time: float
    margin: float
    deviation: float

    @property
    def met(self) -> bool:
        """Whether the probability is reached, but for the tolerance of a solver."""
        return 1.0 - self.reached <= (1.0 - self.asked) * (1.0 + ROUNDED) + 1e-12


def reached(solution: Solution) -> tuple[Reached, ...]:
    """What a solution with its problem reaches, at the nodes: each row, and the rows that hold together."""
    st = solution.statement
    result: list[Reached] = []
    if st is None or (solution.loop is None and any(limits.matrix is None for limits in st.chances)):
        return ()
    for limits in st.chances:
        at = {"path": slice(None), "initial": slice(0, 1), "final": slice(-1, None)}[limits.place]
        t, values, deviations = solution.t[at], *(v[at] for v in _scatter(solution, limits))
        shares = []
        for i, name in enumerate(limits.names):
            y, s = values[:, i], deviations[:, i]
            pair = float(limits.lower[i]), float(limits.upper[i])
            rooms = margin(y, s, *pair, limits.each)
            allowed = _allowed(*pair)
            missed = np.where((rooms >= -allowed) & (SMALL * s <= allowed), np.maximum(-rooms, 0.0), 0.0)
            shares.append(inside(y, s, pair[0] - missed, pair[1] + missed))
            # where it is least; of several nodes at which it is the same, as 1 where nothing scatters, the tightest
            k = int(np.lexsort((np.where(np.isfinite(rooms), rooms, -np.inf), shares[-1]))[0])
            result.append(
                Reached(
                    name=name,
                    place=limits.place,
                    asked=limits.each,
                    reached=float(shares[-1][k]),
                    time=float(t[k]),
                    margin=float(rooms[k]),
                    deviation=float(s[k]),
                )
            )
        if limits.joint:
            together = np.clip(1.0 - np.sum([1.0 - share for share in shares], axis=0), 0.0, 1.0)
            k = int(np.argmin(together))
            result.append(
                Reached(
                    name=limits.name,
                    place=limits.place,
                    asked=limits.probability,
                    reached=float(together[k]),
                    time=float(t[k]),
                    margin=np.nan,
                    deviation=np.nan,
                )
            )
    return tuple(result)


def _allowed(lower: float, upper: float) -> float:
    """By how much a limit may be passed and be met, in the unit of the expression: solvers do so by some 1e-8."""
    ends = np.array([lower]), np.array([upper])
    return PASSED * max(float(limit_units(*ends)[0]), *(abs(v) for v in (lower, upper) if np.isfinite(v)))


def widths(solution: Solution, limits: ChanceLimits) -> tuple[Array, Array]:
    """Values along the nominal, and the distance from the nearer limit that the probability asks for, (K, k) each.

    The distance is less than what is there where the condition holds with room to spare, and more where it does not
    hold. Joint rows have their own share of the risk.
    """
    values, deviations = _scatter(solution, limits)
    needed = np.empty_like(values)
    for i, (lower, upper) in enumerate(zip(limits.lower, limits.upper, strict=True)):
        nearest = np.minimum(upper - values[:, i], values[:, i] - lower)
        needed[:, i] = nearest - margin(values[:, i], deviations[:, i], float(lower), float(upper), limits.each)
    return values, needed


def _scatter(solution: Solution, limits: ChanceLimits) -> tuple[Array, Array]:
    """Values along the nominal and their standard deviations at the nodes, (K, k) each."""
    columns = solution.extremal.columns()
    count, rows = solution.t.size, len(limits.names)
    y, by_state, by_control = (np.asarray(v.full()) for v in limits.function.map(count)(*columns))
    J = by_state.reshape(rows, count, -1).transpose(1, 0, 2)
    if limits.matrix is not None:
        return y.T, _root(np.einsum("kri,kij,krj->kr", J, solution.values[limits.matrix], J))
    loop = solution.loop
    assert loop is not None
    Ju = by_control.reshape(rows, count, loop.gain.shape[1]).transpose(1, 0, 2)
    fed = Ju @ loop.gain  # the control is that of the nominal less C y, y the estimate of the deviation d = y - e
    square = np.einsum("kri,kij,krj->kr", J, loop.X, J) + np.einsum("kri,kij,krj->kr", fed, loop.Xhat, fed)
    return y.T, _root(square - 2.0 * np.einsum("kri,kij,krj->kr", J, loop.Xhat - loop.Z, fed))


def _root(square: Array) -> Array:
    return np.sqrt(np.maximum(square, 0.0))


def chance_section(entries: tuple[Reached, ...]) -> Section:
    """A table of what is reached, and what it means."""
    from covocp.base.pages import Sentence, Table, number

    if not entries:
        return []
    columns = ["chance", "asked", "reached", "margin", "deviation", "at t [s]", ""]
    rows = []
    for q in entries:
        numbers = ["-" if np.isnan(v) else number(v, 4) for v in (q.margin, q.deviation)]
        place = {"initial": "start", "final": "end"}.get(q.place, "path")
        rows.append([q.name, shown_probability(q.asked), shown_probability(q.reached), *numbers, number(q.time, 4)])
        rows[-1].append(place if q.met else f"{place}, NOT MET")
    note = (
        "Reached: by the linearised spread, at each node by itself; margin: what each limit could be drawn in by at "
        "the node where it is least. simulate() counts the runs."
    )
    return [Table(columns=columns, rows=rows, words=(0, len(columns) - 1)), Sentence(note, "")]
