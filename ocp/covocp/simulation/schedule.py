"""The times of a simulation, and what filter and feedback use at each of them: the same for all runs.

The steps divide the intervals of the mesh, so that no step contains a kink or a jump of the nominal control. The
nominal and its covariances between the nodes are those of `Solution.at`.
"""

from __future__ import annotations

from typing import Any, Literal

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.gains import kalman_gain
from covocp.base.matrices import Array, pack, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.blocks.arithmetic import apply
from covocp.blocks.updates import definite_gain
from covocp.simulation.actual import System
from covocp.solution.solution import Solution
from covocp.statement.interval import one_sided
from covocp.statement.statement import Statement

FilterKind = Literal["perturbation", "extended"]
Estimator = FilterKind | Literal["law"]

# A division is rounded up unless it is whole to this accuracy: 5 s into steps of 0.25 s are 20, not 21.
WHOLE = 1e-9
MOST_STEPS = 10**7  # of a run; their times alone fill a memory


@dataclass(frozen=True, kw_only=True, eq=False)
class Grid:
    """Steps within the intervals of a mesh.

    t: times, (N + 1,); interval: of the mesh, for each step, (N,). share: what a step of no length takes of what is
        read at its instant, if anything is, (N,); of the others zero. seen: longest step in each that still sees how
        the model changes with the time [s], (N,); inf where any does.
    """

    t: Array
    interval: Any
    share: Array
    seen: Array

    __repr__ = short_repr

    @property
    def steps(self) -> int:
        """Number of steps N."""
        return self.t.size - 1

    @property
    def h(self) -> Array:
        """Lengths of the steps [s], (N,)."""
        return np.asarray(np.diff(self.t))

    def divided(self, parts: Given) -> Grid:
        """Each step divided into equal parts, a number or one for each step."""
        counts = np.broadcast_to(np.asarray(parts, dtype=int), (self.steps,))
        step = np.repeat(np.arange(self.steps), counts)
        inside = np.arange(step.size) - np.repeat(np.cumsum(counts) - counts, counts)
        starts = self.t[step] + self.h[step] * (inside / counts[step])
        share = self.share[step] / counts[step]
        return Grid(t=np.append(starts, self.t[-1]), interval=self.interval[step], share=share, seen=self.seen[step])

    def parts(self, length: Given, most: int | None = None) -> Any:
        """Into how many parts each step must be divided so that none is longer than `length` or than what sees the
        model; into `most` at most.

        Raises:
            ProblemError: without `most`, too many in all.
        """
        needed = np.maximum(1.0, np.ceil(self.h / np.minimum(length, self.seen) - WHOLE))
        if most is not None:
            return np.fmin(needed, most).astype(int)
        if not float(np.sum(needed)) <= MOST_STEPS:
            raise ProblemError(
                "The simulation would need too many steps.",
                expected=f"at most {MOST_STEPS:.0e} steps a run",
                received=f"{float(np.sum(needed)):.1e} steps of {float(np.min(length)):.2g} s",
                remedy="give a longer step=, or leave it out",
            )
        return needed.astype(int)


def base_grid(solution: Solution, points: int, step: float | None = None, samples: Array | None = None) -> Grid:
    """The intervals of the mesh, divided so that some points are about equally spread; no finer than a given step.

    No interval contains one of the samples.
    """
    nodes = t = solution.t
    if samples is not None:
        new = np.abs(samples[:, None] - nodes).min(axis=1) > WHOLE * solution.duration
        t = np.sort(np.concatenate([nodes, samples[new]]))
    read = np.diff(t) == 0.0
    follow = np.searchsorted(t, t[:-1], side="right") - 1 - np.arange(t.size - 1)  # at the same time
    interval = np.searchsorted(nodes, t[:-1], side="right") - 1 - follow
    mesh = Grid(t=t, interval=interval, share=read.astype(float), seen=np.full(interval.shape, np.inf))
    parts = mesh.parts(solution.duration / max(1, points - 1))
    return mesh.divided(parts if step is None else np.minimum(parts, mesh.parts(step)))


def stored_times(grid: Grid, points: int, samples: Given, instants: tuple[float, ...] = ()) -> tuple[Array, Any]:
    """The grid's nearest times to `points` equally spread ones, and the intervals of the mesh that begin there.

    The first and the last are among them, and some instants, shares of T; where there are samples (indices of the
    grid), only these else.
    """
    among = np.arange(grid.steps + 1) if not samples.size else np.union1d(samples, [0, grid.steps])
    t = grid.t[among]
    wanted = np.linspace(t[0], t[-1], points)
    after = np.clip(np.searchsorted(t, wanted), 1, t.size - 1)
    nearer = wanted - t[after - 1] < t[after] - wanted
    at = among[np.unique(after - nearer)]
    held = [np.flatnonzero(np.abs(grid.t - place * grid.t[-1]) <= WHOLE * grid.t[-1]) for place in instants]
    at = np.unique(np.concatenate([at, *held]))
    read = np.flatnonzero(grid.share)  # before and after what is read there
    at = np.unique(np.concatenate([at, read[np.isin(read + 1, at)], read[np.isin(read, at)] + 1]))
    at = at[~(np.isin(at, read) & np.isin(at - 1, read) & (grid.t[at] == grid.t[at - 1]))]  # of three the outer ones
    return grid.t[at], grid.interval[np.minimum(at, grid.steps - 1)]


def indices(grid: Grid, times: Array) -> Any:
    """Where some times lie in a grid; of those that are the same the last is after what happens there."""
    first, own = np.searchsorted(grid.t, times), np.searchsorted(times, times)
    others = np.searchsorted(grid.t, times, side="right") - 1 - first
    count = np.searchsorted(times, times, side="right") - 1 - own
    return first + (np.arange(times.size) - own) * others // np.maximum(count, 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Nominal:
    """What the functions of a statement need at some times t (K,): x (K, nx), u (K, nu), e (K, ne).

    told: the times that a model is told, (K,). At the ends of an interval they are the limits from inside it, as while
        solving: what compares the time may jump there.
    """

    x: Array
    u: Array
    e: Array
    t: Array
    told: Array

    __repr__ = short_repr

    def columns(self, duration: float, parameters: Array) -> tuple[Any, ...]:
        """Arguments (state, control, matrices, time, duration, parameters), a column for each time."""
        count = self.t.size
        fixed = np.full((1, count), duration), np.tile(parameters[:, None], (1, count))
        return (self.x.T, self.u.T, self.e.T, self.told[None, :], *fixed)


def nominal_at(solution: Solution, t: Array, interval: Given) -> Nominal:
    """The nominal at some times, control and model those of the given interval, which matters where they jump."""
    x, e = _states_at(solution, t)
    return Nominal(x=x, u=_controls_at(solution, t, interval), e=e, t=t, told=_inside(solution, t, interval))


def _inside(solution: Solution, t: Array, interval: Given) -> Array:
    """Times, (K,), the ends of their intervals as the limits from inside."""
    start, end = solution.t[interval], solution.t[np.asarray(interval) + 1]
    low, high = (start + one_sided(c) * (end - start) for c in (0.0, 1.0))
    return np.asarray(np.clip(t, low, high))


def _states_at(solution: Solution, t: Array) -> tuple[Array, Array]:
    """States (K, nx) and half-vectors (K, ne); of times that follow each other and are the same those before the last
    one are before what is read there."""
    blocks = {kind: [b for b in solution.blocks if b.kind == kind] for kind in ("state", "matrix")}

    def values(sample: Given, count: int) -> tuple[Array, Array]:
        x = np.hstack([sample[b.name].reshape(count, b.size) for b in blocks["state"]])
        return x, np.hstack([pack(sample[b.name]) for b in blocks["matrix"]])

    x, e = values(solution.at(t), t.size)
    early = np.flatnonzero(np.append(t[1:] == t[:-1], False))
    if early.size:
        x[early], e[early] = values(solution.at(t[early], "before"), early.size)
    return x, e


def _controls_at(solution: Solution, t: Array, interval: Given) -> Array:
    """Controls (K, nu) of the given intervals."""
    nodes, u = solution.t, solution.controls
    if solution.mesh.control == "constant":
        return np.asarray(u[interval])
    h = np.diff(nodes)[interval]
    c = np.where(h > 0, (t - nodes[interval]) / np.where(h > 0, h, 1.0), 0.0)[:, None]
    return np.asarray(u[interval] + c * (u[interval + 1] - u[interval]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Coefficients:
    """What filter and feedback use at one time, stacked in a column of `rows` entries.

    function: (state, control, matrices, time, duration, parameters, length h of the step, readings) -> the column.
    shapes: of the parts by name, in their order: "t", the nominal "x", "u" and, where a constraint uses them, the
        matrices "e", the gain "C", "extra", the weights B - L_uu of the feedback, and "weighed", those
        of deviations in A and N that are not in L; for the perturbation filter its gain "K", its model "F", "G", "M",
        "Hu", "h", the measurement that is expected along the nominal, and "early",
        E M'(M E M' + 2 U/h)^-1, its gain for what is measured during the first half of a step; of what is read at an
        instant its gain "Kr", its model "Hr", "Hru" and the reading "hr" that is expected.
    """

    function: ca.Function
    shapes: dict[str, tuple[int, int]]

    __repr__ = short_repr

    @property
    def rows(self) -> int:
        """Entries of the column."""
        return int(self.function.size1_out(0))

    def split(self, column: Given) -> dict[str, Any]:
        """The parts of a symbolic column by name."""
        sizes = [rows * columns for rows, columns in self.shapes.values()]
        pieces = ca.vertsplit(column, np.cumsum([0, *sizes]).tolist())
        return {
            name: ca.reshape(piece, *shape) for (name, shape), piece in zip(self.shapes.items(), pieces, strict=True)
        }


def coefficients(design: System, kind: Estimator) -> Coefficients:
    """What filter and feedback of a design use, for a kind of filter; a law of its own uses nothing of them."""
    st, n, m = design.statement, design.size, design.fed_back
    symbolic: Any = st.symbolic
    sizes = (st.nx, st.nu, st.ne, 1, 1, st.np)
    x, u, e, t, T, p = a = [symbolic.sym(f"a{i}", k) for i, k in enumerate(sizes)]
    loop = st.loop
    parts = {
        "t": t,
        "x": x,
        "u": u,
        "e": e if any(c.uses_matrices for c in st.conditions) else symbolic.zeros(0, 1),
        "C": symbolic.zeros(m, n) if loop is None or kind == "law" else loop.gain(*a),
        "extra": symbolic.zeros(0, 0) if loop is None else loop.extra_control(x, u, t, T, p),
        "weighed": symbolic.zeros(0, 0)
        if loop is None or loop.weighed is None
        else ca.horzcat(*loop.weighed(x, u, t, T, p)),
    }
    step, reading = symbolic.sym("step"), symbolic.sym("reading", st.readings)
    if kind == "perturbation":
        at, E = design.model(x, u, t, T, p), unpack_symbolic(estimation_half(st, e), n)
        parts |= {"K": kalman_gain(E, at.M, at.U), "F": at.F, "G": at.G, "M": at.M, "Hu": at.Hu, "h": at.h}
        parts["early"] = early_gain(E, at.M, at.U, step)
        read = design.read(x, u, t, T, p)
        gain = read_gain(st, E, read.H, read.R, reading)
        parts |= {"Kr": gain, "Hr": read.H, "Hru": read.Hu, "hr": read.h}
    shapes = {name: (int(value.shape[0]), int(value.shape[1])) for name, value in parts.items()}
    assert shapes["C"] == (m, n)
    return Coefficients(
        function=ca.Function("coefficients", [*a, step, reading], [ca.veccat(*map(ca.densify, parts.values()))]),
        shapes=shapes,
    )


def read_gain(statement: Statement, E: Given, H: Given, R: Given, reading: Given) -> Any:
    """Gain E H'(H E H' + R/r)^-1 of what is read at an instant, (n, s), r the share of each; zero where it is none."""
    if not H.shape[0]:
        return type(E).zeros(E.shape[0], 0)
    taken = by_rows(statement, reading)
    H = ca.repmat(ca.sqrt(taken), 1, H.shape[1]) * H
    gain = apply(lambda E, H, R: (definite_gain(E, H, R),), E, H, ca.densify(R))[0]
    return gain * ca.repmat(ca.sqrt(taken).T, E.shape[0], 1)


def by_rows(statement: Statement, reading: Given) -> Any:
    """The share that is taken of each value that can be read."""
    assert statement.samples is not None
    return ca.vertcat(*(ca.repmat(reading[j], b.size, 1) for j, b in enumerate(statement.samples.blocks)))


def estimation_half(statement: Given, e: Given) -> Any:
    """Half-vector of the estimation covariance out of all of them."""
    return e[next(b for b in statement.matrices if b.estimation).span]


def early_gain(E: Given, M: Given, U: Given, h: Given) -> Any:
    """Gain E M'(M E M' + 2 U/h)^-1, (n, r), of what half a step measures, E known before it; bounded at any h."""
    if not M.shape[0]:
        return type(E).zeros(E.shape[0], 0)
    return apply(lambda E, M, U, h: (definite_gain(h * E, M, 2 * U),), E, M, ca.densify(U), h)[0]


def table(solution: Solution, grid: Grid, chosen: Coefficients) -> tuple[Array, Array]:
    """The columns at the starts and at the ends of all steps, (N, rows) each."""
    x, e = _states_at(solution, grid.t)
    read = readings_of(solution, grid)
    _read_in_parts(solution, grid, x, e, read)
    at_all = Matrices(chosen.function.map(grid.steps))  # of both sides: made once
    sides = []
    for part in (slice(0, -1), slice(1, None)):
        t = grid.t[part]
        u = _controls_at(solution, t, grid.interval)
        at = Nominal(x=x[part], u=u, e=e[part], t=t, told=_inside(solution, t, grid.interval))
        columns = at.columns(solution.duration, solution.parameters)
        (values,) = at_all.evaluated(*columns, grid.h[None, :], read)
        sides.append(np.ascontiguousarray(values.T))
    return sides[0], sides[1]


def readings_of(solution: Solution, grid: Grid) -> Array:
    """What the steps of a grid take of each measurement at instants, (measurements, N)."""
    taken = solution.mesh.readings
    return np.asarray(taken[:, grid.interval] * grid.share if taken.size else np.zeros((0, grid.steps)))


def _read_in_parts(solution: Solution, grid: Grid, x: Array, e: Array, read: Array) -> None:
    """Half-vectors (in place) between the parts in which something is read at one instant."""
    samples = solution.extremal.statement.samples
    if samples is None:
        return
    u, fixed = _controls_at(solution, grid.t[:-1], grid.interval), (solution.duration, solution.parameters)
    for k in np.flatnonzero(grid.share[:-1] * grid.share[1:] * (np.diff(grid.interval) == 0)):
        after, _ = samples.update(x[k], u[k], e[k], grid.t[k], *fixed, read[:, k])
        e[k + 1] = np.asarray(after.full()).ravel()
