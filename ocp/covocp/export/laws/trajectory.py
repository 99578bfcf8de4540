"""The histories of a solution as a law: a time in, the nominal and its covariances out."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Given
from covocp.base.matrices import Array, unpack_symbolic
from covocp.export.laws.history import History, Nominal, time_status
from covocp.export.laws.law import QUATERNION, Law, Port, flat
from covocp.export.text.names import identifier
from covocp.solution.solution import Solution
from covocp.statement.statement import Block

# What a sample may return.
STATUSES = ("OK", "TIME_BEFORE", "TIME_AFTER", "TIME_NOT_FINITE", "FAILED")
# Share of the duration by which the points of the comparison reach beyond it.
BEYOND = 0.1


def sample_law(solution: Solution, tables: History, tolerance: float, part: str = "") -> Law:
    """The law (time) -> states, controls, matrices (whole, not as half-vectors), status.

    Args:
        solution: where the names come from.
        tables: its nominal.
        tolerance: largest relative deviation.
        part: of what the solution is a part, its name in C; "": of nothing.
    """
    time = ca.MX.sym("time")
    clock = tables.clock(time)
    nominal = tables.at(clock.time)
    taken = {"time", "status"}
    ports, values = (
        [Port(name="time", unit="s", about="of the values: the one asked for, within the range")],
        [clock.time],
    )
    for block, value in named_values(solution, nominal):
        ports.append(block_port(block, taken))
        values.append(value)
    ports.append(Port(name="status", about="as returned", whole=True))
    core = ca.Function("sample", [time], [*values, time_status(clock)])
    return Law(
        name=f"sample_{part}" if part else "sample",
        kind="sample",
        about=(
            "Nominal at a time: states and matrices by cubic Hermite polynomials between the nodes, and between more "
            "times where an interval holds a fast change; controls "
            + ("linear." if tables.u.shape[0] == tables.nodes.size else "constant in each interval."),
        ),
        core=core,
        inputs=(Port(name="time", unit="s"),),
        outputs=tuple(ports),
        constants={f"{part}_DURATION [s]" if part else "DURATION [s]": tables.duration},
        statuses=STATUSES,
        points=lambda random, count: times(tables, random, count)[:, None],
        tolerance=tolerance,
    )


def named_values(solution: Solution, nominal: Nominal) -> list[tuple[Block, Any]]:
    """The symbols of a solution that change, each with its flat column at some time."""
    known = [block for block in solution.blocks if block.kind in ("state", "control", "matrix")]
    return [(block, flat(_value(block, nominal))) for block in known]


def block_port(block: Block, taken: set[str]) -> Port:
    """The port of one of the user's symbols."""
    about: str = block.kind if block.role == "moving" else block.role
    if block.kind == "matrix":
        about = "covariance of the error of the estimate" if block.estimation else about
        rows = ", ".join(block.labels)
        about += f", rows {rows}" if rows else ""
        return Port(
            name=identifier(block.name, taken), rows=block.size, columns=block.size, unit=block.unit, about=about
        )
    about = f"{about} '{block.name}'" + (f", {QUATERNION}" if block.tangent else "")
    unit = "" if block.tangent else block.unit  # that of its rotation vector
    return Port(name=identifier(block.name, taken), rows=block.size, unit=unit, about=about)


def _value(block: Block, nominal: Given) -> Any:
    """The expression of a symbol."""
    column = {"state": nominal.x, "control": nominal.u, "matrix": nominal.e}[block.kind]
    ends = [0, block.span.start, block.span.stop, int(column.shape[0])]
    part = ca.vertsplit(column, ends)[1]
    return unpack_symbolic(part, block.size) if block.kind == "matrix" else part


def times(tables: History, random: np.random.Generator, count: int) -> Array:
    """Times for a comparison: both ends, nodes, outside, NaN, infinity, random ones."""
    end = tables.duration
    near = np.nextafter(tables.nodes[1:-1][:2], 0.0)
    edges = [0.0, end, -0.5 * end, 2.0 * end, np.nan, np.inf, -np.inf, np.nextafter(end, np.inf), -1e-12 * end]
    edges += [*tables.nodes[1:4].tolist(), *near.tolist(), *tables.knots[1:4].tolist()]
    rest = random.uniform(-BEYOND * end, (1.0 + BEYOND) * end, max(0, count - len(edges)))
    return np.concatenate([edges, rest])[:count]
