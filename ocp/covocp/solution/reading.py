"""What a key of a solution stands for, and the values along its nominal by the names of the problem."""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from covocp.base.expressions import Given
from covocp.base.matrices import Array, unpack
from covocp.base.threads import one_at_a_time
from covocp.extremal.closed_loop import ClosedLoop
from covocp.extremal.spread_limits import scattered
from covocp.solution.origin import Origin
from covocp.statement.interval import repeated
from covocp.statement.names import name_of, sizes_of, unknown_name
from covocp.statement.statement import Block
from covocp.statement.time_data import TimeData

if TYPE_CHECKING:
    from covocp.solution.solution import Solution


def other_loop(solution: Solution) -> ClosedLoop | None:
    """The loop under other statistics than the design's, of which the matrices are; None: there are no others."""
    return solution.loop if solution.origin is Origin.OTHER_TRUTH else None


def name_in(
    solution: Solution,
    key: Given,
    blocks: tuple[Block, ...] | None = None,
    *,
    missing_ok: bool = False,
    others: tuple[str, ...] = (),
) -> str:
    """Name of a symbol, a name or an entry among some blocks; None: among all values.

    others: further names that could be meant, told where none is found.
    """
    names = tuple(solution.values) if blocks is None else tuple(b.name for b in blocks)
    sizes = sizes_of(solution.blocks if blocks is None else blocks)
    if blocks is None:
        sizes |= {entry.name: entry.values.shape[1] for entry in _data(solution)}
    return name_of(key, solution.symbols, names, missing_ok=missing_ok, sizes=sizes, others=others)


def by_name(solution: Solution, t: Array, x: Array, u: Array, e: Array) -> dict[str, Array]:
    """Values by name at some times; x (K, nx), u (K, nu), e (K, ne)."""
    sources = {"state": x, "control": u}
    result: dict[str, Array] = {"time": t, "duration": np.full(t.shape, solution.duration)}
    for b in solution.blocks:
        if b.kind == "matrix":
            result[b.name] = unpack(e[:, b.span], b.size)
            continue
        values = sources[b.kind][:, b.span] if b.kind in sources else np.tile(solution.parameters[b.span], (t.size, 1))
        if b.tangent:  # of unit length, which interpolation keeps up to its error
            values = values / np.linalg.norm(values, axis=1, keepdims=True)
        result[b.name] = values[:, 0] if b.size == 1 else values
    return result | {entry.name: entry.at(t) for entry in _data(solution)}


@one_at_a_time
def expression_values(solution: Solution, expression: ca.MX) -> Array:
    """Values of an expression of the problem's symbols, (K,) or (K, rows, columns) without axes of one entry.

    Raises:
        ProblemError: it contains a symbol of another problem.
    """
    extremal, other = solution.extremal, other_loop(solution)
    statement = extremal.statement
    try:
        function = statement.expression(expression, scattered=other is not None)
    except RuntimeError as error:
        raise unknown_name(expression, tuple(solution.values), solution.symbols) from error
    count = extremal.mesh.nodes.size
    arguments = extremal.columns()
    if other is not None and function.n_in() > len(arguments):
        arguments = (*arguments, scattered(other).T)
    value = np.asarray(function.map(count)(*arguments).full())
    return _shaped(value, expression, count)


@one_at_a_time
def expression_between(solution: Solution, expression: ca.MX, t: Array, *, before: bool = False) -> Array:
    """Values of an expression at some times [s], (K,) or (K, rows, columns); where something jumps after it, or before.

    Not of a solution under other statistics, whose matrices are known at the nodes only.
    """
    extremal, mesh = solution.extremal, solution.mesh
    z = solution.dense.at(mesh.placed(t / solution.duration), before=before)
    u, nx = solution.controls_at(t, before=before), extremal.trajectory.x.shape[1]
    rest = repeated(solution.duration, extremal.parameters, t.size)
    function = extremal.statement.expression(expression, scattered=False)
    value = function.map(t.size)(z[:, :nx].T, u.T, z[:, nx:].T, t[None, :], *rest)
    return _shaped(np.asarray(value.full()), expression, t.size)


def _shaped(value: Array, expression: ca.MX, count: int) -> Array:
    """Values of an expression side by side as (count,) or (count, rows, columns), without axes of one entry."""
    rows, columns = expression.shape
    shaped = value.reshape(rows, count, columns).transpose(1, 0, 2)
    return np.asarray(shaped.reshape([count, *(n for n in (rows, columns) if n > 1)]))


def _data(solution: Solution) -> tuple[TimeData, ...]:
    """What is given over time and used; () for a solution read from a file."""
    return solution.statement.data if solution.statement is not None else ()
