"""The functions of a peak seeker as expressions: what a reading changes in its memory, and the step that follows."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import half_indices, half_length
from covocp.base.short_repr import short_repr
from covocp.blocks.arithmetic import beside, where
from covocp.blocks.checked_function import CheckedFunction
from covocp.blocks.differences import independent, is_usable
from covocp.blocks.eigenvalues import is_definite, symmetric_eigen
from covocp.blocks.factors import in_turn, triangular
from covocp.blocks.quadratic import gradient, hessian, parameters, regressor_row, transition

Array = NDArray[np.float64]


class Memory(NamedTuple):
    """Where things are in the memory of a seeker.

    positions: of the last `window` readings, the newest first, each (n,).
    values: of these readings.
    readings: their number so far, up to one more than the window.
    point: of the expansion, (n,).
    parameters: zeta, (p,).
    factor: lower triangular L with L L' = P, column by column, (p (p + 1) / 2,).
    """

    positions: slice
    values: slice
    readings: slice
    point: slice
    parameters: slice
    factor: slice

    @classmethod
    def of(cls, inputs: int, window: int) -> Memory:
        """The layout for a number of inputs and a window."""
        size = parameters(inputs).size
        ends = np.cumsum([0, window * inputs, window, 1, inputs, size, half_length(size)]).tolist()
        return cls(*(slice(*pair) for pair in pairwise(ends)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Settings:
    """The arguments of `seeker`, checked."""

    inputs: int
    window: int
    noise: float
    drift_factor: Array
    start: int
    with_prior: bool
    transport: bool
    reuse: bool
    newton: str
    smallest_curvature: float
    largest_step: float | None
    descent_gain: float
    switch: float | None
    definite: bool
    sign: float
    position_noise: float

    __repr__ = short_repr


class _Parts(NamedTuple):
    """A memory as matrices."""

    positions: Expr
    values: Expr
    readings: Expr
    point: Expr
    zeta: Expr
    lower: Expr


def _parts(memory: Expr, settings: Settings, layout: Memory) -> _Parts:
    """A memory taken apart; positions (N, n)."""
    size = parameters(settings.inputs).size
    lower = ca.SX(size, size)
    for k, (i, j) in enumerate(zip(*half_indices(size), strict=True)):
        lower[int(i), int(j)] = memory[layout.factor.start + k]
    positions = ca.reshape(memory[layout.positions], settings.inputs, settings.window).T
    return _Parts(
        positions,
        memory[layout.values],
        memory[layout.readings],
        memory[layout.point],
        memory[layout.parameters],
        lower,
    )


def _joined(parts: _Parts) -> Expr:
    """A memory put together."""
    half = [parts.lower[int(i), int(j)] for i, j in zip(*half_indices(parts.lower.shape[0]), strict=True)]
    return ca.vertcat(ca.vec(parts.positions.T), parts.values, parts.readings, parts.point, parts.zeta, *half)


def update_function(settings: Settings, layout: Memory) -> CheckedFunction:
    """(memory, position, value) -> memory."""
    memory = ca.SX.sym("memory", layout.factor.stop)
    position, value = ca.SX.sym("position", settings.inputs), ca.SX.sym("value")
    old = _parts(memory, settings, layout)
    located = ca.SX(1)
    for i in range(settings.inputs):
        located = ca.logic_and(located, is_usable(position[i]))
    there = ca.logic_and(located, is_usable(value))
    x, f = ca.if_else(located, position, old.point), where(there, value)
    moved = _moved(old, x, settings)
    new = _updated(moved, x, f, there, settings)
    kept = _Parts(
        positions=ca.if_else(there, ca.vertcat(x.T, old.positions[:-1, :]), old.positions),
        values=ca.if_else(there, ca.vertcat(f, old.values[:-1]), old.values),
        readings=ca.fmin(old.readings + there, settings.window + 1),
        point=x,
        zeta=ca.if_else(there, new.zeta, moved.zeta),
        # W is for the time between readings, also those that are missing; without W these change no bit.
        lower=new.lower if np.any(settings.drift_factor) else ca.if_else(there, new.lower, moved.lower),
    )
    names: Any = (["memory", "position", "value"], ["memory_out"])
    function = ca.Function("update", [memory, position, value], [ca.densify(_joined(kept))], *names)
    return CheckedFunction(function, ("position", "value"))


def _in_motion(old: _Parts, settings: Settings) -> Expr:
    """Whether the estimate is one at the point of the memory: from the first reading with a prior, else the update."""
    return old.readings > (0 if settings.with_prior else settings.start)


def _moved(old: _Parts, x: Expr, settings: Settings) -> _Parts:
    """The estimate at a new point, (4) without W; F is triangular, so the factor stays so."""
    if not settings.transport:
        return old._replace(point=x)
    F = transition(where(_in_motion(old, settings), x - old.point))
    return old._replace(point=x, zeta=F @ old.zeta, lower=F @ old.lower)


def _updated(old: _Parts, x: Expr, f: Expr, there: Expr, settings: Settings) -> _Parts:
    """W of (4), then the differences of a new reading to those in the window, one row after the other, (2) and (3)."""
    drift = ca.SX(ca.sparsify(ca.DM(settings.drift_factor))) * _in_motion(old, settings)
    lower = triangular(beside(old.lower, drift)) if drift.nnz() else old.lower
    steps, residuals = old.positions - ca.repmat(x.T, settings.window, 1), old.values - f
    rows = regressor_row(steps)
    # The mean square of the gradient, which is not known exactly, is that of its estimate and its variances.
    steepness = ca.sumsqr(gradient(old.zeta)) + ca.sumsqr(lower[-settings.inputs :, :])
    noise = settings.noise + settings.position_noise**2 * steepness
    enough = ca.logic_and(there, old.readings >= settings.start)
    used = ca.vertcat(*(ca.logic_and(enough, old.readings > j) for j in range(settings.window)))
    if settings.reuse:
        rows, residuals, variances = independent(rows, residuals, used, settings.window * noise)
    else:
        rows, variances = where(ca.repmat(used, 1, rows.shape[1]), rows), 2 * noise * ca.DM.ones(settings.window)
    zeta, root = in_turn(old.zeta, lower, where(used, residuals - rows @ old.zeta), rows, variances)
    return old._replace(zeta=zeta, lower=triangular(root))


def step_function(settings: Settings, layout: Memory) -> CheckedFunction:
    """(memory) -> increment."""
    memory = ca.SX.sym("memory", layout.factor.stop)
    parts = _parts(memory, settings, layout)
    M, b = settings.sign * hessian(parts.zeta), settings.sign * gradient(parts.zeta)
    if settings.newton == "modified":
        step = _modified_step(M, b, settings.smallest_curvature)
    else:
        step = -settings.descent_gain * b
        if settings.newton == "plain":
            step = ca.if_else(_is_trusted(M, parts.lower, settings), _plain_step(M, b), step)
    if settings.largest_step is not None:
        length = ca.sqrt(ca.sumsqr(step))
        step = step * ca.if_else(length > settings.largest_step, settings.largest_step / length, 1)
    increment = where(parts.readings > settings.start, step)
    names: Any = (["memory"], ["increment"])
    return CheckedFunction(ca.Function("step", [memory], [ca.densify(increment)], *names))


def _modified_step(M: Expr, b: Expr, smallest: float) -> Expr:
    """(6): - Q diag(1 / max(|lambda|, smallest)) Q'b."""
    eigen = symmetric_eigen(M)
    return -eigen.vectors @ ((eigen.vectors.T @ b) / ca.fmax(ca.fabs(eigen.values), smallest))


def _plain_step(M: Expr, b: Expr) -> Expr:
    """(5): - M^-1 b; where M is singular it has no value, and `_is_trusted` has refused it."""
    eigen = symmetric_eigen(M)
    return -eigen.vectors @ ((eigen.vectors.T @ b) / ca.if_else(eigen.values == 0, 1, eigen.values))


def _is_trusted(M: Expr, lower: Expr, settings: Settings) -> Expr:
    """Whether a plain Newton step is taken, (5): P has a singular value of at most `switch`, and M is definite."""
    trusted = is_definite(M) if settings.definite else _is_regular(M)
    if settings.switch is not None:
        excess = lower @ lower.T - settings.switch * ca.SX.eye(lower.shape[0])
        trusted = ca.logic_and(trusted, ca.logic_not(is_definite(excess)))
    return trusted


def _is_regular(M: Expr) -> Expr:
    """Whether no eigenvalue is zero."""
    values = symmetric_eigen(M).values
    regular = ca.SX(1)
    for i in range(M.shape[0]):
        regular = ca.logic_and(regular, values[i] != 0)
    return regular
