"""What the cost and the rows of a program consist of where all segments are single intervals, see `separable`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.statement.interval import Interval
from covocp.statement.statement import Conditions, Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.nlp import NLP, Rows, Scales, inside_kind
from covocp.transcription.separable import COST, Piece, Whole
from covocp.transcription.shooting import advancing

if TYPE_CHECKING:
    from covocp.statement.chain import Link


def is_separable(statement: Statement, mesh: Mesh) -> bool:
    """Whether a program consists of such pieces: each interval a segment, all that moves a variable."""
    whole = len(mesh.segments) == mesh.intervals and not (mesh.eliminated and statement.matrices)
    return whole and (statement.tied is None or not statement.tied.matrices)


class _Places:
    """Where the variables of a program lie, and what rows it has."""

    def __init__(self, statement: Statement, mesh: Mesh, scales: Scales, rows: tuple[Rows, ...]) -> None:
        self.statement, self.mesh = statement, mesh
        sizes = (statement.nx, statement.ne, statement.nu)
        counts = (mesh.intervals + 1, mesh.intervals + 1, mesh.control_nodes)
        ends = np.cumsum([0, *(size * count for size, count in zip(sizes, counts, strict=True))])
        shapes = zip(ends, counts, sizes, strict=False)
        self.x, self.e, u = (a + np.arange(count * size).reshape(count, size).T for a, count, size in shapes)
        self.u = u[:, list(mesh.stand_ins)]
        if mesh.control != "linear":
            self.u = np.hstack([self.u, self.u[:, -1:]])
        self.time = np.full((int(statement.duration.free), 1), ends[-1])
        whole = [np.tile(scales.x, counts[0]), np.tile(scales.e, counts[1])]
        whole.append(np.broadcast_to(scales.u, (counts[2], sizes[2])).ravel())
        self.units = np.concatenate([*whole, np.full(int(statement.duration.free), scales.duration)])
        offsets = np.cumsum([0, *(entry.lower.size for entry in rows)])
        self.rows = {entry.kind: np.arange(a, b) for entry, a, b in zip(rows, offsets[:-1], offsets[1:], strict=True)}
        self.scales = np.concatenate([np.ones(0), *(entry.scale for entry in rows)])

    def rows_of(self, kind: str, count: int) -> Whole:
        """Rows of a kind, a column for each of some places; none where there are none."""
        found = self.rows.get(kind, np.zeros(0, dtype=np.intp))
        return np.asarray(found.reshape(count, -1).T if count else found.reshape(0, 0))

    def piece(
        self,
        kind: Any,
        parts: Sequence[Whole],
        others: Sequence[tuple[int, Any]],
        rows: Whole,
        values: Callable[..., Any],
    ) -> Piece:
        """A piece.

        Args:
            kind: of its symbols.
            parts: positions of its variables, a group for each of the first arguments of `values`.
            others: size and columns of each of its other arguments.
            rows: of the program, or `COST`.
            values: (*parts, *others, parameters) -> what it gives.
        """
        count = rows.shape[1]
        places = np.vstack([np.broadcast_to(part, (part.shape[0], count)) for part in parts])
        by = kind.sym("v", places.shape[0])
        own = ca.vertsplit(by, np.cumsum([0, *(part.shape[0] for part in parts)]).tolist())
        symbols = [kind.sym(f"c{i}", size) for i, (size, _) in enumerate(others)]
        parameters = kind.sym("p", self.statement.np)
        return Piece(
            by=by,
            others=tuple(symbols),
            parameters={0: parameters},
            values=ca.densify(values(*own, *symbols, parameters)),
            variables=places,
            units=self.units[places],
            constants=tuple(columns for _, columns in others),
            rows=rows,
            scales=np.where(rows == COST, 1.0, self.scales[rows] if self.scales.size else 1.0),
        )


def pieces(statement: Statement, mesh: Mesh, scales: Scales, rows: tuple[Rows, ...]) -> tuple[Piece, ...]:
    """The pieces of a program that `is_separable`: together they are all its rows and its cost.

    Args:
        statement: the problem.
        mesh: of it.
        scales: magnitudes in which the program works.
        rows: of the program.
    """
    places = _Places(statement, mesh, scales, rows)
    found = [_intervals(places), _terminal(places)]
    n = mesh.intervals
    given = [("path", statement.path, range(n + 1)), ("start", statement.start, [0]), ("end", statement.end, [n])]
    instants = zip(statement.inside.parts, statement.inside.nodes_among(mesh.nodes), strict=True)
    given += [(inside_kind(i), part.conditions, [k]) for i, (part, k) in enumerate(instants)]
    found += [_conditions(places, kind, own, list(nodes)) for kind, own, nodes in given if own.size]
    if "backward_ends" in places.rows:
        found.append(_backward_ends(places))
    return tuple(found)


def _intervals(places: _Places) -> Piece:
    """Of each interval: its end less what follows, limits inside it, its running cost."""
    statement, mesh, n = places.statement, places.mesh, places.mesh.intervals
    advance = advancing(statement, mesh)
    kinds = ["gap_x", "gap_e", "bounds_inside", "path_inside"]
    rows = np.vstack([*(places.rows_of(kind, n) for kind in kinds), np.full((1, n), COST)])
    linear, free = mesh.control == "linear", statement.duration.free
    parts = [places.x[:, :n], places.e[:, :n], places.x[:, 1:], places.e[:, 1:], places.u[:, :n]]
    parts += [*([places.u[:, 1:]] if linear else []), places.time]
    reading = ca.DM(mesh.readings) if mesh.readings.size else ca.DM(0, n)
    others = [(1, ca.DM(mesh.nodes[:-1]).T), (1, ca.DM(np.diff(mesh.nodes)).T)]
    others.append((statement.readings, reading))

    def values(x: Expr, e: Expr, next_x: Expr, next_e: Expr, *rest: Expr) -> Any:
        a, b, T, s, ds, read, p = rest if linear else (rest[0], *rest)
        interval = Interval(a, b, s, ds, T if free else statement.duration.guess, p, read)
        end, fine, cost = advance(ca.vertcat(x, e), *interval)
        return ca.vertcat(end - ca.vertcat(next_x, next_e), *_inside(statement, mesh, fine, interval), cost)

    return places.piece(_kind(advance, statement.path.function), parts, others, rows, values)


def _inside(statement: Statement, mesh: Mesh, fine: Expr, interval: Interval) -> list[Any]:
    """Bounded states, then conditions along the path, at the points inside an interval where limits are imposed."""
    stride, nx = mesh.substeps // mesh.points, statement.nx
    columns = [fine[:, j * stride - 1] for j in range(1, mesh.points)]
    bounded = [column[:nx][statement.bounded_states] for column in columns if statement.bounded_states]
    path = []
    for j, column in enumerate(columns, 1):
        if statement.path.size:
            part, e = interval.part(j / mesh.points, 1.0), column[nx:]
            at = (column[:nx], part.start, e, interval.duration * part.s, interval.duration, interval.parameters)
            path.append(statement.path.function(*at))
    return [*bounded, *path]


def _terminal(places: _Places) -> Piece:
    """The terminal cost."""
    statement, n = places.statement, places.mesh.intervals
    free = statement.duration.free

    def values(x: Expr, e: Expr, T: Expr, p: Expr) -> Any:
        return statement.terminal(x, e, T if free else statement.duration.guess, p)

    parts = (places.x[:, n:], places.e[:, n:], places.time)
    return places.piece(_kind(statement.terminal), parts, (), np.full((1, 1), COST), values)


def _conditions(places: _Places, kind: str, conditions: Conditions, nodes: list[int]) -> Piece:
    """Conditions at some nodes."""
    statement, free = places.statement, places.statement.duration.free

    def values(x: Expr, u: Expr, e: Expr, T: Expr, s: Expr, p: Expr) -> Any:
        duration = T if free else statement.duration.guess
        return conditions.function(x, u, e, duration * s, duration, p)

    parts = (places.x[:, nodes], places.u[:, nodes], places.e[:, nodes], places.time)
    others = [(1, ca.DM(places.mesh.nodes[nodes]).T)]
    rows = places.rows_of(kind, len(nodes))
    return places.piece(_kind(conditions.function), parts, others, rows, values)


def _backward_ends(places: _Places) -> Piece:
    """Matrices that run backward, at the end, less what they are there."""
    statement, n = places.statement, places.mesh.intervals
    function, entries, free = statement.matrix_end, statement.entries(statement.behind), statement.duration.free
    assert function is not None

    def values(x: Expr, e: Expr, T: Expr, p: Expr) -> Any:
        return e - function(x, T if free else statement.duration.guess, p)

    parts = (places.x[:, n:], places.e[entries, n:], places.time)
    return places.piece(_kind(function), parts, (), places.rows_of("backward_ends", 1), values)


def joined_pieces(links: Sequence[Link], parts: Sequence[NLP]) -> tuple[Piece, ...]:
    """The pieces of a program of several parts: theirs, then those of the links; none where one has none.

    What runs backward in a part is in the terminal cost of that before it: then it is no sum of pieces.
    """
    if not all(part.pieces for part in parts) or any(link.weights for link in links):
        return ()
    variables = np.cumsum([0, *(part.w.shape[0] for part in parts)])
    rows = np.cumsum([0, *(part.g.shape[0] for part in parts)])
    found = []
    for i, part in enumerate(parts):
        found += [piece.shifted(i, variables[i], rows[i]) for piece in part.pieces]
    row = rows[-1]
    for i, (link, before, after) in enumerate(zip(links, parts[:-1], parts[1:], strict=True)):
        piece = _link(link, i, (before, after), variables[i : i + 2], row)
        row += piece.rows.shape[0]
        found += [piece] if piece.rows.size else []
    return tuple(found)


def _link(link: Link, number: int, parts: tuple[NLP, NLP], offsets: Whole, row: int) -> Piece:
    """The rows of a link: initial values that are variables less what the part before gives."""
    before, after = (_Places(part.statement, part.mesh, part.scales, part.rows) for part in parts)
    n, kind = before.mesh.intervals, _kind(link.function)
    matrices = list(link.matrices) if after.e.size else []
    ends = [before.x[:, n], before.e[:, n], before.time[:, 0]]
    starts = [after.x[list(link.states), 0], after.e[matrices, 0]]
    own = np.concatenate([*(each + offsets[0] for each in ends), *(each + offsets[1] for each in starts)])
    units = np.concatenate([*(before.units[each] for each in ends), *(after.units[each] for each in starts)])
    by = kind.sym("v", own.size)
    x, e, T, *start = ca.vertsplit(by, np.cumsum([0, *(each.size for each in (*ends, *starts))]).tolist())
    symbols = {number + i: kind.sym("p", part.statement.np) for i, part in enumerate(parts)}
    duration = before.statement.duration
    given = link.function(x, e, T if duration.free else duration.guess, *symbols.values())
    sizes = (len(link.states), len(matrices))
    values = ca.vertcat(*(a - b[:size] for a, b, size in zip(start, given, sizes, strict=True)))
    return Piece(
        by=by,
        others=(),
        parameters=symbols,
        values=ca.densify(values),
        variables=own[:, None],
        units=units[:, None],
        constants=(),
        rows=row + np.arange(sum(sizes))[:, None],
        scales=np.concatenate([after.units[each] for each in starts])[:, None],
    )


def _kind(*functions: ca.Function) -> Any:
    """Of symbols that these functions take: scalars where they can."""
    return ca.SX if all(function.is_a("SXFunction") for function in functions) else ca.MX
