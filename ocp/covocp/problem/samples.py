"""Measurements that are taken at instants: what they tell, as functions of the stacked vectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.matrices import pack_symbolic, unpack_symbolic
from covocp.problem.declarations import Declarations, Measurement
from covocp.problem.stacked import Stacked
from covocp.statement.statement import Block, Samples

# The covariance of the estimate of an expected cost, which gains what the error loses.
ESTIMATE = "Xhat"


def measured_blocks(measurements: Sequence[Measurement]) -> tuple[Block, ...]:
    """Where each of some measurements lies among their values."""
    sizes = [entry.expression.shape[0] for entry in measurements]
    offsets = np.cumsum([0, *sizes]).tolist()
    return tuple(
        Block(name=entry.name, kind="measurement", size=size, offset=offset, unit=entry.unit)
        for entry, size, offset in zip(measurements, sizes, offsets, strict=False)
    )


def samples(problem: Declarations, stacked: Stacked) -> Samples | None:
    """The measurements at instants as functions; None where there are none."""
    taken = problem.sampled
    if not taken:
        return None
    value = ca.vertcat(*stacked.substitute(*(entry.expression for entry in taken)))
    slope = ca.densify(stacked.augmented_jacobian(value))
    variances = [_entries(entry) for entry in stacked.substitute(*(entry.noise for entry in taken))]
    blocks = measured_blocks(taken)
    reading = stacked.symbolic.sym("reading", len(taken))  # type: ignore[attr-defined]
    outputs = _updated(problem, stacked, [slope[block.span, :] for block in blocks], variances, reading)
    names = ["state", "control", "matrices", "time", "duration", "parameters", "reading"]
    return Samples(
        blocks=blocks,
        places=tuple(entry.instants for entry in taken),
        measurement=stacked.function(
            "sampled", [value, slope, ca.densify(ca.diagcat(*variances))], without=("matrices",)
        ),
        groups=tuple(
            tuple(block.offset + row for row in rows)
            for block, variance in zip(blocks, variances, strict=True)
            for rows, _ in _uncorrelated(variance)
        ),
        update=ca.Function("update", [*stacked.inputs, reading], outputs, names, ["after", "cost"]),
    )


def _updated(problem: Declarations, stacked: Stacked, slopes: list[Any], variances: list[Any], reading: Expr) -> Any:
    """Half-vectors after the readings, and what these add to the cost."""
    halves = ca.vertsplit(stacked.inputs[2], _offsets(problem))
    parts = dict(zip((entry.name for entry in problem.matrices), halves, strict=True))
    estimation = next((entry for entry in problem.matrices if entry.estimation), None)
    if estimation is None:
        return [stacked.inputs[2], stacked.symbolic(0)]
    before = unpack_symbolic(parts[estimation.name], estimation.size)
    after = before
    for j, (H, R) in enumerate(zip(slopes, variances, strict=True)):
        for rows, variance in _uncorrelated(R):
            after = _read(after, H[rows, :], variance, reading[j])
    lost, cost = before - after, stacked.symbolic(0)
    parts[estimation.name] = pack_symbolic(after)
    if problem.expansion is not None and ESTIMATE in parts:
        parts[ESTIMATE] = parts[ESTIMATE] + pack_symbolic(lost)
    feedback = next((entry for entry in problem.matrices if entry.backward is not None), None)
    if problem.expansion is not None and feedback is not None:
        S = unpack_symbolic(parts[feedback.name], feedback.size)
        cost = ca.trace(S @ lost) / 2
    return [ca.vertcat(*parts.values()), cost]


def _offsets(problem: Declarations) -> list[int]:
    """Where the half-vectors begin among all, and where the last one ends."""
    return [0, *np.cumsum([entry.symbol.shape[0] for entry in problem.matrices]).tolist()]


def _uncorrelated(variance: Expr) -> list[tuple[list[int], Any]]:
    """Rows of a measurement one by one where their noises are independent, which needs no matrix inverse."""
    size = variance.shape[0]
    if variance.sparsity().is_diag():
        return [([i], ca.densify(variance[i, i])) for i in range(size)]
    return [(list(range(size)), ca.densify(variance))]


def _entries(variance: Expr) -> Any:
    """A variance without the entries that are zero, where that can be told: those of a call have no numbers."""
    if isinstance(variance, ca.SX):
        return ca.sparsify(variance)
    return variance if ca.symvar(variance) else ca.MX(ca.sparsify(ca.evalf(variance)))


def _read(E: Expr, H: Expr, R: Expr, reading: Expr) -> Any:
    """E after one reading, K = E H' (H E H' + R)^-1, in Joseph's form; R / reading where only a part is taken."""
    seen = E @ H.T
    spread = reading * (H @ seen) + R
    K = seen / spread if spread.shape == (1, 1) else seen @ ca.inv(spread)
    left = ca.DM.eye(E.shape[0]) - reading * (K @ H)
    return left @ E @ left.T + reading * (K @ R @ K.T)
