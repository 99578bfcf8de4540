"""Slopes through the shooting segments by the stages of their Runge-Kutta steps, in compiled code.

Differentiated by CasADi a segment passes each of its directions through thousands of scalar operations. Here the slopes
of the rates at all stages are had once, a few nonzeros each, and pass through compiled code: forward for the slopes of
the ends of the segments (`segment_slopes`), back for the slopes of a cost (`cost_slopes`).
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr, minus, plus, times
from covocp.base.matrices import Array, stacked
from covocp.base.quadrature import classical_step
from covocp.base.short_repr import short_repr
from covocp.passage.columns import in_columns
from covocp.passage.transitions import Steps, passed_back, transitions
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT, slopes_wanted
from covocp.transcription.mesh import Mesh
from covocp.transcription.shooting import compiled_steps
from covocp.transcription.steps import nominal_interval

# Shares of a step at which its stages are.
STAGES = (0.0, 0.5, 0.5, 1.0)
# States from which on it is less work where no covariance passes in compiled code.
SMALLEST_ALONE = 4


def is_staged(statement: Statement, mesh: Mesh) -> bool:
    """Whether segments can be differentiated so: states alone, in a plain space, by explicit steps."""
    alone = mesh.eliminated and not statement.coupled and statement.nu > 0 and statement.nx > 0
    return alone and statement.geometry.plain and mesh.step != "rodas" and compiled_steps(mesh)


@dataclass(frozen=True, kw_only=True)
class Staged:
    """The segments of a program, their slopes by the stages, and what those are slopes by.

    steps: of the segments. slopes: nonzeros of the stages' slopes, a column for each. count: segments. spans: of what
    the segments start from and take (linear in the variables), what each of them has. linear: slopes of that by the
    variables, constant.
    """

    steps: Steps
    slopes: Any
    count: int
    spans: tuple[tuple[int, ...], ...]
    linear: ca.DM

    __repr__ = short_repr

    def segment_slopes(self) -> Any:
        """Slopes of the states at the ends of all segments by the variables, (nx segments, variables), sparse."""
        nx = self.steps.rows
        rows = [s * nx + r for s, own in enumerate(self.spans) for _ in own for r in range(nx)]
        columns = [c for own in self.spans for c in own for _ in range(nx)]
        order = np.lexsort((rows, columns))  # nonzeros of a sparsity lie column by column
        shape = ca.Sparsity.triplet(nx * self.count, self.linear.shape[0], rows, columns)
        dense = ca.vec(transitions(self.steps, self.slopes))
        return ca.mtimes(ca.sparsity_cast(dense[order.tolist()], shape), self.linear)

    def cost_slopes(self, by_states: Expr, by_costs: Expr) -> Any:
        """Slopes by the variables of what has these slopes by the states after all steps, and by the running costs.

        Args:
            by_states: (nx, N substeps).
            by_costs: of the intervals, (1, N).
        """
        own = self.linear[[c for span in self.spans for c in span], :]
        return ca.mtimes(own.T, passed_back(self.steps, self.slopes, by_states, by_costs))


def staged(
    statement: Statement, mesh: Mesh, states: tuple[Expr, Expr], intervals: Interval, w: Expr, starts: Expr
) -> Staged:
    """The segments of a program.

    Args:
        statement: a problem that `is_staged`.
        mesh: of it.
        states: at the nodes, (nx, N + 1), and at the ends of all substeps, (nx, N substeps).
        intervals: a column for each.
        w: the variables.
        starts: states at the starts of the segments, linear in w.
    """
    x, fine = states
    nx, nu, free = statement.nx, statement.nu, int(statement.duration.free)
    function, pattern = _stage_slopes(statement, whole=mesh.substeps == 1)
    linear = mesh.control == "linear"
    active, places, spans = [], [], []
    first_control = starts.numel() + free
    last_control = first_control + nu * mesh.intervals  # where the controls at the ends of the intervals begin
    inside: list[Expr] = [ca.vec(starts), *([intervals.duration[0]] if free else []), ca.vec(intervals.start)]
    slope = ca.jacobian(ca.vertcat(*inside, *([ca.vec(intervals.end)] if linear else [])), w)
    (constant,) = ca.Function("linear", [w], [slope]).call([ca.DM.zeros(w.shape[0])])
    rows, times = list(range(first_control)), range(starts.numel(), first_control)
    for s, (i, j) in enumerate(pairwise(mesh.starts)):
        for first in range(nx + free, nx + free + (j - i) * nu, nu):
            after = first + nu if linear else first
            places.append((*range(first, first + nu), *range(after, after + nu), *range(nx, nx + free)))
            active.append(after + nu)
        controls = [*range(first_control + i * nu, first_control + j * nu)]
        if linear:
            controls += range(last_control + (j - 1) * nu, last_control + j * nu)
        spans.append((*range(s * nx, (s + 1) * nx), *times, *range(len(rows), len(rows) + len(controls))))
        rows += controls
    steps = Steps(
        rows=nx,
        pattern=pattern,
        steps=mesh.substeps,
        lengths=tuple(mesh.segments),
        places=tuple(places),
        active=tuple(active),
    )
    return Staged(
        steps=steps,
        slopes=_slopes_along(statement, mesh, function, x, fine, intervals),
        count=len(mesh.segments),
        spans=tuple(spans),
        linear=constant[rows, :],
    )


def interval_transitions(statement: Statement, mesh: Mesh, x: Array, intervals: Interval) -> tuple[Array, Array, Array]:
    """Slopes of the state after each interval by that before it and by the controls at its two ends.

    Args:
        statement: a problem that `is_staged`.
        mesh: of it.
        x: states before the intervals, numbers (nx, N).
        intervals: a column for each, numbers.

    Returns:
        (N, nx, nx), (N, nx, nu), (N, nx, nu).
    """
    n, nx, nu, free = mesh.intervals, statement.nx, statement.nu, int(statement.duration.free)
    run = Matrices(nominal_interval(statement, mesh.substeps, mesh.step).map(n))
    fine = run.evaluated(x, *intervals)[1]
    function, pattern = _stage_slopes(statement, whole=mesh.substeps == 1)
    rest = (*range(nx + free, nx + free + 2 * nu), *range(nx, nx + free))
    steps = Steps(
        rows=nx,
        pattern=pattern,
        steps=mesh.substeps,
        lengths=(1,) * n,
        places=(rest,) * n,
        active=(nx + free + 2 * nu,) * n,
    )
    slopes = _slopes_along(statement, mesh, function, ca.DM(x), ca.DM(fine), Interval(*map(ca.DM, intervals)))
    values = stacked(transitions(steps, slopes), n)
    return values[..., :nx], values[..., nx + free : nx + free + nu], values[..., nx + free + nu :]


def _slopes_along(
    statement: Statement, mesh: Mesh, function: ca.Function, x: Expr, fine: Expr, intervals: Interval
) -> Any:
    """What `_stage_slopes` gives along all steps: x at the nodes, fine at the ends of the substeps, a column each."""
    n, m = mesh.intervals, mesh.substeps
    before = x[:, :n]
    if m == 1:
        return in_columns(statement, function, n).call([before, *intervals])[0]
    inside: Expr = ca.reshape(fine, statement.nx * m, n)
    before = ca.reshape(ca.vertcat(before, inside[: statement.nx * (m - 1), :]), statement.nx, n * m)
    shares = ca.DM(np.tile([[(j + c) / m for j in range(m)] for c in STAGES], (1, n)))
    return in_columns(statement, function, n * m).call([before, *intervals.substeps(m), shares])[0]


@lru_cache(maxsize=KEPT)
def _stage_slopes(statement: Statement, *, whole: bool) -> tuple[ca.Function, tuple[tuple[int, ...], tuple[int, ...]]]:
    """Slopes of h times the rates of state and cost at the stages of a step.

    Returns:
        (x, *interval: of the step, shares of the control interval at its stages unless it is a `whole` one) -> nonzeros
        of the slopes by the state, by the controls at both ends and, where it is free, by T, a column for each stage;
        rows and columns of the nonzeros.
    """
    symbolic: Any = statement.symbolic
    x, part, rates = symbolic.sym("x", statement.nx), Interval.symbols(statement), _rate_slopes(statement)
    shares = symbolic.sym("shares", 0 if whole else len(STAGES))
    stages: list[Any] = []

    def rate(value: Expr, c: float) -> Expr:
        stages.append((value, c))
        return statement.nominal.call(part.at(c, value))[0]  # type: ignore[union-attr]

    classical_step(rate, x, part.h)
    found = []
    for k, (value, c) in enumerate(stages):
        moved, by_x, by_u, by_time, by_duration = rates.call(part.at(c, value))
        share, h = c if whole else shares[k], part.h
        blocks = [times(h, by_x), times(times(minus(1, share), h), by_u), times(times(share, h), by_u)]
        if statement.duration.free:
            own = plus(times(by_time, part.place(c)), by_duration)
            blocks.append(plus(times(part.ds, moved), times(h, own)))
        found.append(ca.horzcat(*blocks))
    pattern = found[0].sparsity()
    for slope in found:
        pattern = pattern + slope.sparsity()
    shape = ca.Sparsity.dense(pattern.nnz(), 1)
    columns = ca.horzcat(
        *(s.nz[:] if s.sparsity() == pattern else ca.sparsity_cast(ca.project(s, pattern), shape) for s in found)
    )
    row, column = pattern.get_triplet()
    given, wanted = [x, *part], slopes_wanted(statement, 1)
    if not whole:
        given, wanted = [*given, shares], {"is_diff_in": [*wanted["is_diff_in"], False]}
    function = ca.Function("stage_slopes", given, [columns], wanted)
    return function, (tuple(row), tuple(column))


@lru_cache(maxsize=KEPT)
def _rate_slopes(statement: Statement) -> ca.Function:
    """(x, u, t, T, p) -> rates of state and running cost, their slopes by x, by u, by t and by T."""
    assert statement.nominal is not None
    kind: Any = statement.symbolic
    sizes = (statement.nx, statement.nu, 1, 1, statement.np)
    symbols = [kind.sym(f"a{i}", size) for i, size in enumerate(sizes)]
    rates = ca.vertcat(*statement.nominal(*symbols))
    offsets = np.cumsum([0, *sizes[:4]]).tolist()
    slopes = ca.horzsplit(ca.jacobian(rates, ca.vertcat(*symbols[:4])), offsets)
    return ca.Function("rate_slopes", symbols, [ca.densify(rates), *slopes])
