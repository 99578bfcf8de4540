"""The constraints of the problem in the runs: which are looked at, who violates them, and what covariances promise.

A run is looked at with its own state, unknowns and control, and the matrices that the solution has; the covariance X of
the closed loop is zero in it, whose deviations have happened: x + 3 sqrt(X[x, x]) <= 2 counts runs with x > 2. An
integral is that of the run: of what it did, not of the nominal; what covariances promise of it is not computed. An
equality is met by no noisy run exactly, and what no run changes (a covariance, an open-loop control) is the same in
all: neither is counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from scipy import special

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.matrices import Array, unpack
from covocp.base.pickling import pickled_without
from covocp.base.residuals import PASSED
from covocp.base.short_repr import short_repr
from covocp.simulation.actual import System
from covocp.simulation.prediction import Prediction
from covocp.simulation.run_parts import Run, part
from covocp.simulation.schedule import Nominal
from covocp.solution.solution import Solution
from covocp.statement.chances import ChanceLimits
from covocp.statement.entries import entry_names
from covocp.statement.statement import Conditions, Statement
from covocp.transcription.limit_units import limit_units
from covocp.transcription.scales import magnitudes

Place = Literal["path", "initial", "final", "inside"]
# Limits count as kept within this share of their size.
MARGIN = 1e-9
# Share of its unit by which runs may pass a limit of what is known exactly, besides what the nominal may (`PASSED`):
# they take other steps. It is known exactly where its spread is less than the second share.
STEPPED, ROUNDED = 1e-6, 1e-12
# Share of the duration by which a time may miss an instant and be it.
SAME = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """One inequality lower <= value <= upper that runs can violate.

    bound: whether it is the bound of a state or of a control, whose name it has.
    chance: whether it is of a condition on a probability. parts: of rows that hold together the positions of these;
        it is kept where all of them are. integral: whether integrals are in it, of which covariances promise nothing.
    instant: of one that holds inside the horizon, as a share of T; late: whether after what happens there.
    """

    name: str
    place: Place
    lower: float
    upper: float
    bound: bool
    chance: bool = False
    parts: tuple[int, ...] = ()
    integral: bool = False
    instant: float | None = None
    late: bool = True

    def among(self, t: Array) -> int | None:
        """Where the time of what is looked at once lies among some times from 0 to T; None: not, or along the path."""
        if self.instant is None:
            return {"initial": 0, "final": t.size - 1}.get(self.place)
        at = np.flatnonzero(np.abs(t - self.instant * t[-1]) <= SAME * t[-1])
        return int(at[-1 if self.late else 0]) if at.size else None


@pickled_without(function=ca.Function)
@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """The inequalities that runs can violate, in their order: of the path, the start, the end, the instants.

    function: (state, control, matrices, time, duration, parameters) -> their values.
    left_out: names of the constraints that are not counted, and why. chances: conditions on probabilities in `rows`.
    sums: entries of the state that are integrals and are gathered in each run.
    """

    rows: tuple[Row, ...]
    function: ca.Function
    left_out: Mapping[str, str]
    chances: tuple[ChanceLimits, ...] = ()
    sums: tuple[int, ...] = ()

    __repr__ = short_repr

    def at(self, *places: Place) -> list[int]:
        """Positions of the rows of some places."""
        return [i for i, row in enumerate(self.rows) if row.place in places]


def counted_rows(design: System) -> Rows:
    """The inequalities of a design's problem that its runs can violate."""
    return _counted(design.statement, design.entries, design.fed_back)


@lru_cache(maxsize=8)
def _counted(st: Statement, states: int, fed_back: int) -> Rows:
    symbolic: Any = st.symbolic
    sizes = (st.nx, st.nu, st.ne, 1, 1, st.np)
    a = [symbolic.sym(f"a{i}", k) for i, k in enumerate(sizes)]
    unknowns = [k for b in st.of_kind("unknown") for k in range(b.span.start, b.span.stop)]
    gathered = [k for b in st.states if b.role == "integral" for k in range(b.span.start, b.span.stop)]
    own = ca.vertcat(a[0][:states], a[1][:fed_back], a[5][unknowns])
    # An integral of what is the same in all runs is left to the solution, whose quadrature is another one.
    moved = [] if st.nominal is None else st.nominal(a[0], a[1], *a[3:])[0]
    sums = [k for k in gathered if ca.depends_on(moved[k], own)]
    varying, summed = a[0][sums, :], a[2][st.entries(st.summed), :]
    rows, values, left_out, needed = [], [], {}, False
    for name, value, low, high in _bounds(st, a, (states, fed_back)):
        rows.append(Row(name=name, place="path", lower=low, upper=high, bound=True))
        values.append(value)
    places: list[tuple[Place, Conditions]] = [("path", st.path), ("initial", st.start), ("final", st.end)]
    instants: list[dict[str, Any]] = [{"instant": part.place, "late": part.late} for part in st.inside.parts]
    places += [("inside", part.conditions) for part in st.inside.parts]
    for (place, conditions), instant in zip(places, [{}, {}, {}, *instants], strict=True):
        function = conditions.function if conditions.realised is None else conditions.realised
        column = function(*a)
        for i, name in enumerate(conditions.names):
            if any(name in limits.names for limits in st.chances):
                continue
            low, high = float(conditions.lower[i]), float(conditions.upper[i])
            if low == high:
                left_out[name] = "an equality, which no noisy run meets exactly"
            elif ca.depends_on(column[i], summed):
                left_out[name] = "an integral of covariances along the nominal"
            elif not ca.depends_on(column[i], ca.vertcat(own, varying)):
                left_out[name] = "the same in all runs"
            else:
                whole = bool(ca.depends_on(column[i], varying))
                rows.append(Row(name=name, place=place, lower=low, upper=high, bound=False, integral=whole, **instant))
                values.append(column[i])
                needed |= whole
    for limits in st.chances:
        _add_chance(limits, limits.function(*a)[0], rows, values)
    function = ca.Function("conditions", a, [ca.densify(ca.vertcat(symbolic(0, 1), *values))])
    own_sums = tuple(sums) if needed else ()
    return Rows(rows=tuple(rows), function=function, left_out=left_out, chances=st.chances, sums=own_sums)


def _add_chance(limits: ChanceLimits, column: Any, rows: list[Row], values: list[Any]) -> None:
    """Rows of a condition on a probability: the expression itself, and whether all of them hold together."""
    first = len(rows)
    for i, name in enumerate(limits.names):
        low, high = float(limits.lower[i]), float(limits.upper[i])
        rows.append(Row(name=name, place=limits.place, lower=low, upper=high, bound=False, chance=True))
        values.append(column[i])
    if limits.joint:
        parts = tuple(range(first, len(rows)))
        name, place = limits.name, limits.place  # it is kept where its parts are, and has no limits of its own
        rows.append(Row(name=name, place=place, lower=-np.inf, upper=np.inf, bound=False, chance=True, parts=parts))
        values.append(0)


class _Bound(NamedTuple):
    """An entry that has bounds."""

    name: str
    value: Any
    lower: float
    upper: float


def _bounds(st: Statement, a: list[Any], sizes: tuple[int, int]) -> list[_Bound]:
    """Names, values and limits of the states and fed-back controls that have bounds."""
    found = []
    pairs = ((st.states, a[0], st.state_bounds), (st.controls, a[1], st.control_bounds))
    for (blocks, column, (lower, upper)), size in zip(pairs, sizes, strict=True):
        names = entry_names(blocks)
        for i in range(size):
            if np.isfinite(lower[i]) or np.isfinite(upper[i]):
                found.append(_Bound(names[i], column[i], float(lower[i]), float(upper[i])))
    return found


def violations(run: Run, z: Given, fed: Given, c: dict[str, Any]) -> Any:
    """One for each inequality that a run violates, (rows,); what is no number violates it.

    Args:
        run: its symbols.
        z: its state.
        fed: the controls that it applies.
        c: coefficients at this time.
    """
    design, solution = run.setting.design, run.setting.solution
    chosen = counted_rows(design)
    if not chosen.rows:
        return run.symbolic(0, 1)
    rest = ca.vertsplit(part(c["x"], design.entries))
    for i, k in enumerate(run.sums):
        rest[k - design.entries] = z[run.spans["sums"]][i]
    state = ca.vertcat(z[run.spans["x"]], *rest)
    u = ca.vertcat(fed, part(c["u"], design.fed_back))
    known = ca.DM(solution.parameters[: solution.parameters.size - design.unknowns])
    matrices = c["e"] if c["e"].shape[0] else run.symbolic.zeros(design.statement.ne)  # no constraint uses them
    values = chosen.function(state, u, matrices, c["t"], solution.duration, ca.vertcat(known, run.own))
    allowed = margins(solution, design).tolist()
    flags: list[Any] = []
    for i, row in enumerate(chosen.rows):
        own = beyond(values[i], row.lower, row.upper, allowed[i])
        flags.append(ca.mmax(ca.vertcat(*(flags[k] for k in row.parts))) if row.parts else own)
    return ca.vertcat(*flags)


def beyond(value: Given, low: float, high: float, allowed: float = 0.0) -> Any:
    """One unless a value is inside its limits, but for rounding and for what is allowed besides."""
    inside: Any = 1.0
    if np.isfinite(low):
        inside = value >= low - MARGIN * max(1.0, abs(low)) - allowed
    if np.isfinite(high):
        inside = ca.logic_and(inside, value <= high + MARGIN * max(1.0, abs(high)) + allowed)
    return ca.logic_not(inside)


@lru_cache(maxsize=2)
def margins(solution: Solution, design: System) -> Array:
    """By how much a run may pass each limit and have kept it, (rows,): no more than its nominal was allowed to.

    What is active is met by a solver to its accuracy only; all runs of what is known exactly would violate it then, and
    half of those of the rest by as little. Of what is known exactly runs may differ from that by their steps.
    """
    chosen, st = counted_rows(design), design.statement
    if not chosen.rows:
        return np.zeros(0)
    columns, count = solution.extremal.columns(), solution.t.size
    values, slopes = (np.asarray(v.full()) for v in _linearised(st, design).map(count)(*columns))
    spread = _largest_spread(solution, design, slopes.reshape(len(chosen.rows), count, -1))
    units, result = _units(chosen, solution, values), np.zeros(len(chosen.rows))
    for i, row in enumerate(chosen.rows):
        once = row.among(solution.t)
        own = values[i] if once is None else values[i, once : once + 1]
        excess = float(np.max(np.maximum(row.lower - own, own - row.upper)))
        if 0.0 < excess <= PASSED * units[i]:
            result[i] = excess
        if spread[i] <= ROUNDED * units[i]:
            result[i] = max(result[i], STEPPED * units[i])
    return result


def asked_margins(solution: Solution, least: Array, most: Array) -> Array:
    """The same of the fed-back controls that a run asks for, between what counts as all that there is, (m,)."""
    u = solution.trajectory.u[:, : least.size]
    excess = np.maximum(least - u, u - most).max(axis=0, initial=0.0)
    limits = np.abs(np.where(np.isfinite([least, most]), [least, most], 0.0)).max(axis=0, initial=0.0)
    allowed = PASSED * np.maximum(_scales(solution)[1][: least.size], limits)
    return np.asarray(np.where(excess <= allowed, excess, 0.0))


def _scales(solution: Solution) -> tuple[Array, Array]:
    """Units in which solvers meet the bounds of states and controls."""
    found = magnitudes(solution.extremal.statement, solution.trajectory, solution.parameters, reached=True)
    return found.x, found.u


def _units(chosen: Rows, solution: Solution, values: Array) -> Array:
    """Units in which a solver meets each limit: that of the state or control, of a condition that of its limits."""
    st = solution.extremal.statement
    lower, upper = (np.array([getattr(row, side) for row in chosen.rows]) for side in ("lower", "upper"))
    limits = np.where(np.isfinite([lower, upper]), np.abs([lower, upper]), 0.0).max(axis=0)
    units = limit_units(lower, upper)
    for names, scales in zip((st.state_names, st.control_names), _scales(solution), strict=True):
        for i, row in enumerate(chosen.rows):
            if row.bound and row.name in names:
                units[i] = scales[names.index(row.name)]
    return np.asarray(np.maximum(units, limits))


def _largest_spread(solution: Solution, design: System, slopes: Array) -> Array:
    """An upper bound of the standard deviation of each inequality at any node, by the design, (rows,)."""
    n, loop = design.size, solution.loop
    E = unpack(solution.trajectory.e[:, design.covariance], n)
    actual, estimate = (E, np.zeros_like(E)) if loop is None else (loop.X, loop.Xhat)
    scatter = np.hstack([np.sqrt(np.diagonal(v, axis1=1, axis2=2).clip(0.0)) for v in (actual, estimate)])
    return np.asarray(np.einsum("rkj,kj->rk", np.abs(slopes), scatter).max(axis=1, initial=0.0))


def promised(solution: Solution, design: System, nominal: Nominal, prediction: Prediction) -> Array:
    """Probability that each inequality is violated at some times, for normal deviations and to first order, (K, rows).

    Args:
        solution: whose feedback is used.
        design: its system.
        nominal: at these times.
        prediction: of deviation and estimate there, of what is simulated.
    """
    chosen, count, st = counted_rows(design), nominal.t.size, design.statement
    if not chosen.rows:
        return np.zeros((count, 0))
    columns = nominal.columns(solution.duration, solution.parameters)
    values, slopes = (np.asarray(v.full()) for v in _linearised(st, design).map(count)(*columns))
    rows = len(chosen.rows)
    slopes = slopes.reshape(rows, count, 2 * design.size).transpose(1, 0, 2)
    centre = values.T + np.einsum("kri,ki->kr", slopes, prediction.mean)
    spread = np.sqrt(np.einsum("kri,kij,krj->kr", slopes, prediction.covariance, slopes).clip(0.0))
    result, allowed = np.zeros((count, rows)), margins(solution, design)
    for i, row in enumerate(chosen.rows):
        for limit, sign in ((row.lower, -1.0), (row.upper, 1.0)):
            if np.isfinite(limit):
                over = sign * (centre[:, i] - limit) - allowed[i]
                with np.errstate(divide="ignore", invalid="ignore"):
                    share = special.ndtr(over / spread[:, i])
                known = spread[:, i] == 0.0
                share[known] = over[known] > MARGIN * max(1.0, abs(limit))
                result[:, i] += share
    for i, row in enumerate(chosen.rows):
        if row.integral:
            result[:, i] = np.nan
        if row.parts:  # Boole's bound
            result[:, i] = np.minimum(result[:, list(row.parts)].sum(axis=1), 1.0)
    return result


def _linearised(st: Statement, design: System) -> ca.Function:
    """(all six) -> values of the inequalities, and their slopes by deviation and estimate, (rows, 2n)."""
    symbolic: Any = st.symbolic
    sizes = (st.nx, st.nu, st.ne, 1, 1, st.np)
    a = [symbolic.sym(f"a{i}", k) for i, k in enumerate(sizes)]
    values = counted_rows(design).function(*a)
    unknowns = [k for b in st.of_kind("unknown") for k in range(b.span.start, b.span.stop)]
    of_state, of_control, of_parameters = (ca.jacobian(values, a[i]) for i in (0, 1, 5))
    whole = ca.vertcat(a[0][: design.entries], symbolic.zeros(design.unknowns))
    slopes = ca.horzcat(of_state[:, : design.entries], of_parameters[:, unknowns])
    slopes = design.geometry.tangent_slope(whole, slopes)
    fed = symbolic(values.shape[0], design.size)
    if st.loop is not None:
        fed = -of_control[:, : design.fed_back] @ st.loop.gain(*a)
    return ca.Function("linearised", a, [values, ca.densify(ca.horzcat(slopes, fed))])
