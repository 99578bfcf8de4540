"""The closed loop along a nominal: covariances for any gains and statistics, gains, both forms of the expected cost.

With e the error of the estimate and y the estimate of the deviation (Schmidt's x'), both driven by the gains of the
design, K = E M' U^-1 and C, and by the true statistics E0(0), Q0, U0 (appendix A, 6.11):

    de = (F - K M) e dt + K dv - dn,      dy = (F - G C) y dt - K M e dt + K dv.

and with jumps where something is read at an instant (`readings`).
Their joint covariance [E Z; Z' Xhat] obeys a Lyapunov equation, stepped by the two-stage Gauss method: it is positive
semidefinite at any step size. Where the statistics are the design's, Z = 0 and E is the design's. The cost is had from
it by (E-1), extended by Z (6.11), and from E and S of the design by (E-20).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.gains import kalman_gain
from covocp.base.matrices import Array, as_array, pack_symbolic, stacked, unpack, unpack_symbolic
from covocp.base.quadrature import simpson_weight
from covocp.base.short_repr import short_repr
from covocp.extremal.dense_output import mapped
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import fine_trajectory
from covocp.extremal.joint import Statistics, joint_covariances, loop_of
from covocp.statement.interval import model_symbols, one_sided
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT

# Share of the largest slope below which a direction of the state counts as moved by nothing.
UNMOVED = 1e-10
# Name of what terms add that are not linear in the covariance of the closed loop.
COVARIANCES = "covariances"
# Pairs of substeps for one time constant of filter or loop in an interval, and the most of them.
STEPS_PER_RATE = 1.0
LARGEST_PAIRS = 32


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedLoop:
    """The closed loop at the nodes of a nominal.

    E: covariance of the error of the estimate, (K, n, n); Xhat: of the estimate; Z: between both, <e y'>; gain: C,
        (K, m, n).
    cost: expected cost by (E-1) with Z, by term: "terminal" k, "running" int L dt, "deviations at the end"
        1/2 tr S(T) X(T), "deviations on the way" the integral of A, B, N; "covariances" what the cost has of terms that
        are not linear in the covariance of the closed loop, where it has any.
    conservation: largest relative error of w'(E + Xhat)w, which grows by int w'Qw dt only, over the directions w that
        neither the control nor the state moves (w'F = 0, w'G = 0: constants, or the logarithm of a density plus a
        multiple of the altitude); None where there are none.
    other_cost: the same expected cost by (E-20), from S(0) E(0); None where the gain is not the best one or the
        statistics are not the design's.
    """

    E: Annotated[Array, "nodes augmented augmented"]
    Xhat: Annotated[Array, "nodes augmented augmented"]
    Z: Annotated[Array, "nodes augmented augmented"]
    gain: Annotated[Array, "nodes any augmented"]
    cost: Mapping[str, float]
    other_cost: float | None
    conservation: float | None

    __repr__ = short_repr

    @property
    def X(self) -> Array:
        """Covariance of the deviations of the actual system, E + Xhat - Z - Z'."""
        return np.asarray(self.E + self.Xhat - self.Z - self.Z.transpose(0, 2, 1))

    @property
    def expected_cost(self) -> float:
        """Sum of the terms."""
        return float(sum(self.cost.values()))


def close_loop(extremal: Extremal, truth: Statistics | None = None, start: Array | None = None) -> ClosedLoop | None:
    """Propagate the covariances of the loop along a solution.

    Args:
        extremal: of a statement with a loop.
        truth: the true statistics; None: the design's.
        start: [E Z; Z' Xhat] at the start, (2n, 2n), where a loop has gone before; None: nothing is estimated yet.

    Returns:
        Covariances, gains and costs at the nodes; None where they leave the range of numbers, as along the last iterate
        of a run whose gains ran away.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            loop = _propagated(extremal, truth, start)
    except (RuntimeError, np.linalg.LinAlgError):  # a step that cannot be solved: CasADi's error, or numpy's
        return None
    return loop if np.isfinite(loop.expected_cost) else None


def _propagated(extremal: Extremal, truth: Statistics | None, start: Array | None) -> ClosedLoop:
    """What `close_loop` returns."""
    st, mesh = extremal.statement, extremal.mesh
    size = len(st.augmented)
    statistics = truth if truth is not None else design_statistics(extremal)
    n, m = mesh.intervals, loop_substeps(extremal)
    fine = fine_trajectory(extremal, m)
    values = joint_covariances(extremal, fine, statistics, start)
    cost, other = _costs(extremal, fine, values, truth is None)
    at = values[::m]
    columns = extremal.columns()
    loop = loop_of(st)
    gain = loop.gain.map(n + 1)(*columns)
    return ClosedLoop(
        E=at[:, :size, :size],
        Xhat=at[:, size:, size:],
        Z=at[:, :size, size:],
        gain=stacked(gain, n + 1),
        cost=cost,
        other_cost=other,
        conservation=_conservation(extremal, fine, values, statistics),
    )


def covariances_along(extremal: Extremal, fine: Array, start: Array | None = None) -> Array:
    """Covariances of the deviations at the nodes where the gains are taken from a given course of x, E and S.

    Args:
        extremal: of a statement with a loop.
        fine: x and the half-vectors at the starts of equal parts of all intervals and at the ends, (N, m + 1, size).
        start: as of `close_loop`.

    Returns:
        (N + 1, n, n); not finite where such a loop diverges.
    """
    size = len(extremal.statement.augmented)
    with np.errstate(over="ignore", invalid="ignore"):
        joint = joint_covariances(extremal, fine, design_statistics(extremal), start)[:: fine.shape[1] - 1]
    E, Z, Xhat = joint[:, :size, :size], joint[:, :size, size:], joint[:, size:, size:]
    return np.asarray(E + Xhat - Z - Z.transpose(0, 2, 1))


@lru_cache(maxsize=4)
def loop_substeps(extremal: Extremal) -> int:
    """Even number of steps an interval that resolves filter and feedback: S falls fast before a weighted end."""
    st, count = extremal.statement, extremal.mesh.intervals + 1
    x, u, e, t, duration, p = extremal.columns()
    size = len(st.augmented)
    F, G = (stacked(v, count) for v in loop_of(st).expansion.map(count)(x, u, t, duration, p)[:2])
    C = stacked(loop_of(st).gain.map(count)(x, u, e, t, duration, p), count)
    loops = [F - G @ C]
    if st.measurement is not None:
        _, M, U = (stacked(v, count) for v in st.measurement.map(count)(x, u, t, duration, p))
        E = unpack(extremal.trajectory.e[:, st.estimation.span], size)
        loops.append(F - kalman_gain(E, M, U) @ M)
    rates = [np.abs(np.linalg.eigvals(matrix)).max(axis=1, initial=0.0) for matrix in loops]
    h = np.diff(extremal.time)
    stiff = max(float((np.maximum(rate[1:], rate[:-1]) * h).max(initial=0.0)) for rate in rates)
    pairs = int(np.clip(np.ceil(STEPS_PER_RATE * stiff), max(1, extremal.mesh.substeps // 2), LARGEST_PAIRS))
    return 2 * pairs


def start_covariance(statement: Statement, extremal: Extremal, parameters: Array) -> Array:
    """Half-vectors at the start as a statement has them for the decisions of an extremal."""
    own = statement.boundary_values(parameters).initial_matrices
    return np.asarray(statement.started(extremal.trajectory.x[0], parameters, own)[1])


def design_statistics(extremal: Extremal) -> Statistics:
    """The statistics that the design assumes."""
    st = extremal.statement
    block = st.estimation
    return Statistics(
        initial=unpack(start_covariance(st, extremal, extremal.parameters)[block.span], block.size),
        density=densities(st),
        parameters=extremal.parameters,
        variance=variances(st),
    )


@lru_cache(maxsize=KEPT)
def densities(statement: Statement) -> ca.Function:
    """(state, control, time, duration, parameters) -> densities Q of the process and U of the measurement noise."""
    x, u, _, *rest = model_symbols(statement)
    arguments = [x, u, *rest]
    noise = loop_of(statement).slopes(*arguments).Q
    measured = statement.measurement
    density = ca.DM(0, 0) if measured is None else measured(*arguments)[2]
    return ca.Function("densities", arguments, [noise, ca.densify(density)])


@lru_cache(maxsize=KEPT)
def variances(statement: Statement) -> ca.Function | None:
    """(state, control, time, duration, parameters) -> variance of what is read at instants; None where nothing is."""
    if statement.samples is None:
        return None
    x, u, _, *rest = model_symbols(statement)
    variance = statement.samples.measurement(x, u, *rest)[2]
    return ca.Function("variances", [x, u, *rest], [ca.densify(variance)])


def _conservation(extremal: Extremal, fine: Array, joint: Array, statistics: Statistics) -> float | None:
    """Largest relative error of the variances that only noise changes [2.1 of chapter 6, 3 and 4]."""
    st, mesh = extremal.statement, extremal.mesh
    n, m, size = mesh.intervals, fine.shape[1] - 1, len(st.augmented)
    X = joint[:, :size, :size] + joint[:, size:, size:] - joint[:, :size, size:] - joint[:, size:, :size]
    units = np.sqrt(np.diagonal(X, axis1=1, axis2=2).max(axis=0).clip(0.0))
    uncertain = np.flatnonzero(units)  # what is known exactly never deviates
    if not uncertain.size:
        return None
    units, X = units[uncertain], X[:, uncertain[:, None], uncertain]
    count = n * (m + 1)
    arguments = [column.reshape(count, -1).T for column in _points(extremal, fine)]
    own, true = (np.tile(p[:, None], (1, count)) for p in (extremal.parameters, statistics.parameters))
    F, G = (as_array(v) for v in loop_of(st).expansion.map(count)(*arguments, own)[:2])
    F = F.reshape(size, count, size)[uncertain][:, :, uncertain] * units / units[:, None, None]
    slopes = np.hstack([F.reshape(units.size, -1), G[uncertain] / units[:, None]])
    triangle = np.asarray(np.linalg.qr(slopes.T, mode="r"))  # of a few rows with thousands of columns
    vectors, values, _ = np.linalg.svd(triangle.T)
    values = np.append(values, np.zeros(units.size - values.size))
    kept = vectors[:, values <= UNMOVED * max(float(values.max(initial=0.0)), np.finfo(float).tiny)] / units[:, None]
    if not kept.shape[1]:
        return None
    noise = as_array(statistics.density.map(count)(*arguments, true)[0]).reshape(size, count, size)
    growth = np.einsum("iw,ikj,jw->kw", kept, noise[uncertain][:, :, uncertain], kept).reshape(n, m + 1, -1)
    weights = np.array([simpson_weight(j, m) for j in range(m + 1)])
    grown = np.cumsum(np.einsum("k,j,kjw->kw", np.diff(extremal.time), weights, growth), axis=0)
    variance = np.einsum("iw,kij,jw->kw", kept, X[::m], kept)
    error = np.abs(variance[1:] - variance[0] - grown)
    return float((error / np.maximum(variance[1:], np.finfo(float).tiny)).max())


class _Points(NamedTuple):
    """x, u, t, T at the ends of all substeps, (N, substeps + 1, entries)."""

    x: Array
    u: Array
    time: Array
    duration: Array


def _points(extremal: Extremal, fine: Array) -> _Points:
    """x, u, t, T at the ends of all substeps, with the control of their interval; (N, substeps + 1, entries)."""
    n, points, _ = fine.shape
    u, nodes = extremal.controls, extremal.time
    after = u[:-1] if extremal.mesh.control == "constant" else u[1:]
    c = np.linspace(0.0, 1.0, points)[:, None]
    time = nodes[:-1, None, None] + np.clip(c, one_sided(0.0), one_sided(1.0)) * np.diff(nodes)[:, None, None]
    controls = u[:-1, None, :] + c * (after - u[:-1])[:, None, :]
    x, duration = fine[:, :, : extremal.statement.nx], np.full(time.shape, extremal.trajectory.duration)
    return _Points(x=x, u=controls, time=time, duration=duration)


def _costs(extremal: Extremal, fine: Array, joint: Array, design: bool) -> tuple[dict[str, float], float | None]:
    """Terms of the cost by (E-1) with Z [6.11], and by (E-20) where it holds; integrals by Simpson's rule."""
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    n, m, size = mesh.intervals, fine.shape[1] - 1, len(st.augmented)
    best = bool(st.behind) and design
    x, u, time, duration = (values.reshape(n * (m + 1), -1).T for values in _points(extremal, fine))
    halves, p = fine.reshape(n * (m + 1), -1)[:, st.nx :].T, np.tile(extremal.parameters[:, None], (1, n * (m + 1)))
    covariance = joint[(m * np.arange(n)[:, None] + np.arange(m + 1)).ravel()].reshape(n * (m + 1), -1).T
    weights = np.diff(extremal.time)[:, None] * [simpson_weight(j, m) for j in range(m + 1)]
    along = mapped(_running(st), x, u, halves, time, duration, p, covariance, owner=st)
    running, deviations, other, nonlinear = (float(weights.ravel() @ values[0]) for values in along)
    loop = loop_of(st)
    k, S = (np.asarray(v.full()) for v in loop.terminal(t.x[-1], t.duration, extremal.parameters))
    error, cross, estimate = joint[-1][:size, :size], joint[-1][:size, size:], joint[-1][size:, size:]
    spread = error + estimate - cross - cross.T
    terms = {
        "terminal": float(k.item()),
        "running": running,
        "deviations at the end": 0.5 * float(np.sum(S * spread)),
        "deviations on the way": deviations,
    }
    if loop.spread_end is not None:
        gain = loop.gain(t.x[-1], extremal.controls[-1], t.e[-1], t.duration, t.duration, extremal.parameters)
        last = pack_symbolic(_scattered(ca.DM(joint[-1]), gain))
        at_end = np.asarray(loop.spread_end(t.x[-1], t.duration, extremal.parameters, last).full())
        terms[COVARIANCES] = nonlinear + float(at_end.item())
    if not best:
        return terms, None
    block = st.matrices[st.behind[0]]
    at_start, at_end = (unpack(t.e[node, block.span], size) for node in (0, -1))
    first = joint[0][:size, :size] + joint[0][size:, size:]
    paid_later = 0.5 * float(np.sum((at_end - S) * spread))  # by the phases that follow, where there are some
    return terms, float(k.item()) + running + 0.5 * float(np.sum(at_start * first)) + other - paid_later


@lru_cache(maxsize=KEPT)
def _running(statement: Statement) -> ca.Function:
    """(all six, joint covariance) -> L, its second-order part by (E-1) with Z, 1/2 tr(S Q + C'B C E) of (E-20).

    And what the cost has of terms that are not linear in the covariance of the closed loop.
    """
    symbolic: Any = statement.symbolic
    size = len(statement.augmented)
    six = model_symbols(statement)
    joint = symbolic.sym("joint", 2 * size, 2 * size)
    loop = loop_of(statement)
    plain = (*six[:2], *six[3:])
    at = loop.slopes(*plain)
    A, B, N, Q = at.A, at.B, at.N, at.Q
    C = loop.gain(*six)
    E, Z, Xhat = joint[:size, :size], joint[:size, size:], joint[size:, size:]
    X = E + Xhat - Z - Z.T
    fed = ca.trace(A @ X) + ca.trace(B @ C @ Xhat @ C.T) - 2 * ca.trace(N @ C @ (Xhat - Z.T))
    other = symbolic(0)
    if statement.behind:
        block = statement.matrices[statement.behind[0]]
        S = unpack_symbolic(six[2][block.span], size)
        other = ca.trace(S @ Q) + ca.trace(C.T @ B @ C @ E)
    added = symbolic(0)
    if loop.spread is not None:
        added = loop.spread(*plain, pack_symbolic(_scattered(joint, C)))
    return ca.Function("running", [*six, joint], [loop.running(*plain), fed / 2, other / 2, added])


def _scattered(joint: Expr, gain: Expr) -> Any:
    """Covariance of augmented state and controls from that of error and estimate, [E Z; Z' Xhat]."""
    size = gain.shape[1]
    E, Z, Xhat = joint[:size, :size], joint[:size, size:], joint[size:, size:]
    crossed = (Xhat - Z) @ gain.T
    return ca.densify(ca.blockcat([[E + Xhat - Z - Z.T, -crossed], [-crossed.T, gain @ Xhat @ gain.T]]))
