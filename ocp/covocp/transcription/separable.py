"""Slopes of first and second order of a program that is partially separable, piece by piece.

Where all segments are single intervals, cost and rows are those of intervals, of nodes and of the ends: a few functions
of few variables each, at many places. CasADi sees one graph: it passes directions through all of it, for second slopes
as many as an interval has variables, and each of them through every piece. Here each function has its Jacobian and its
second slopes once, by its own variables, and constant sparse matrices add up the numbers of all places.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.passage.columns import Owner, in_columns

Whole = NDArray[np.intp]

# Row of what counts in the cost.
COST = -1
NONE: Mapping[str, Any] = MappingProxyType({})
# Options of CasADi's solvers for functions that they make themselves.
FOR_OWN = ("common_options", "specific_options")
# Variables of a piece, and scalar operations of its values times these, up to which it is written out in scalars: its
# slopes are then had in a quarter to a sixteenth of the time (formation flight, a seeker on a line).
FEW, SHORT = 100, 200_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """A kind of piece: a function of a few variables, and the places where it stands.

    by: symbol of the variables. others: symbols of what else it takes. parameters: symbols of those of some parts of
    the program, by the number of the part. values: expression of them. variables: position of each variable among those
    of the program, a column for each place. units: by which they are multiplied there. constants: columns of the
    others. rows: of the program, to which each value belongs, or `COST`. scales: by which the values are divided there.
    """

    by: Any
    others: tuple[Any, ...]
    parameters: Mapping[int, Any]
    values: Any
    variables: Whole
    units: Array
    constants: tuple[Any, ...]
    rows: Whole
    scales: Array

    __repr__ = short_repr

    @property
    def count(self) -> int:
        """Places where it stands."""
        return int(self.variables.shape[1])

    @property
    def symbols(self) -> list[Any]:
        """What its values depend on."""
        return [self.by, *self.others, *self.parameters.values()]

    def shifted(self, part: int, variables: int, rows: int) -> Piece:
        """The same in a program of several parts, as one of that number, behind so many variables and rows."""
        (parameters,) = self.parameters.values()
        return replace(
            self,
            parameters={part: parameters},
            variables=self.variables + variables,
            rows=np.where(self.rows == COST, COST, self.rows + rows),
        )


def slopes(
    found: tuple[Piece, ...],
    w: Any,
    p: Any,
    height: int,
    *,
    second: bool,
    sizes: Sequence[int] | None = None,
    options: Mapping[str, Any] = NONE,
    owner: Owner | None = None,
) -> dict[str, ca.Function]:
    """Slopes of a program, as CasADi's NLP solvers take them.

    Args:
        found: its pieces.
        w: its variables.
        p: its parameters, the scale of the cost last.
        height: rows of it.
        second: whether second slopes are wanted.
        sizes: how many parameters each part has; None: there is one part.
        options: of CasADi's functions.
        owner: what the functions are not used longer than: they may run in compiled code then (`in_columns`).

    Returns:
        "grad_f" and "jac_g", and "hess_lag" where it is wanted.
    """
    sizes = [p.shape[0] - 1] if sizes is None else sizes
    parameters = ca.vertsplit(p, np.cumsum([0, *sizes, 1]).tolist())
    placed = [_Placed(piece, w, parameters, owner) for piece in found]
    made = {"grad_f": _gradient(placed, w, p), "jac_g": _jacobian(placed, w, p, height)}
    if second:
        made["hess_lag"] = _second(placed, w, p, height)
    return {name: ca.Function(*own, dict(options)) for name, own in made.items()}


class _Placed:
    """A piece, with the variables of a program at its places."""

    def __init__(self, piece: Piece, w: Any, parameters: Sequence[Any], owner: Owner | None) -> None:
        self._owner = owner
        self._parameters = [ca.repmat(parameters[i], 1, piece.count) for i in piece.parameters]
        own = w[piece.variables.ravel(order="F").tolist()] * ca.DM(piece.units.ravel(order="F"))
        self.piece, self._at = piece, ca.reshape(own, *piece.units.shape)
        self._scalar = piece.count > 1 and _is_short(piece)

    def evaluated(self, outputs: list[Any], *more: tuple[Any, Any]) -> list[Any]:
        """Expressions of the piece at all places, a column for each; `more`: further symbols with their columns."""
        piece = self.piece
        function = ca.Function("piece", [*piece.symbols, *(symbol for symbol, _ in more)], outputs)
        function = function.expand() if self._scalar else function
        if piece.count > 1 and self._owner is not None:
            function = in_columns(self._owner, function, piece.count)
        elif piece.count > 1:
            function = function.map(piece.count)
        columns = [self._at, *piece.constants, *self._parameters, *(columns for _, columns in more)]
        return list(function.call(columns))


def _is_short(piece: Piece) -> bool:
    """Whether a piece of matrices can be written out in scalars, and is short then."""
    if isinstance(piece.by, ca.SX) or piece.by.numel() > FEW:
        return False
    try:
        scalar = ca.Function("values", piece.symbols, [piece.values]).expand()
    except RuntimeError:  # of a linear system or a table inside it
        return False
    return bool(scalar.n_instructions() * piece.by.numel() <= SHORT)


class _Function(NamedTuple):
    """What a function is made of."""

    name: str
    inputs: list[Any]
    outputs: list[Any]
    input_names: list[str]
    output_names: list[str]


def _gradient(placed: list[_Placed], w: Any, p: Any) -> _Function:
    """(w, p) -> cost, its slopes."""
    cost: Any = 0
    sums = _Sums(w.shape[0], 1)
    for each in placed:
        piece = each.piece
        if piece.rows[-1, 0] == COST:
            slope = ca.jacobian(piece.values[-1], piece.by)
            value, numbers = each.evaluated([piece.values[-1], _nonzeros(slope)])
            columns = slope.sparsity().get_col()
            cost += ca.sum2(value)
            sums.add(numbers, piece.variables[columns], np.zeros((1, 1), np.intp), piece.units[columns])
    outputs = [cost / p[-1], ca.densify(sums.matrix()) / p[-1]]
    return _Function("nlp_grad_f", [w, p], outputs, ["x", "p"], ["f", "grad_f_x"])


def _jacobian(placed: list[_Placed], w: Any, p: Any, height: int) -> _Function:
    """(w, p) -> rows, their slopes."""
    values: list[Any] = [ca.MX(0, 1)]
    order = [np.zeros(0, np.intp)]
    sums = _Sums(height, w.shape[0])
    for each in placed:
        piece = each.piece
        count = int(np.sum(piece.rows[:, 0] != COST))
        if count:
            slope = ca.jacobian(piece.values[:count], piece.by)
            value, numbers = each.evaluated([piece.values[:count], _nonzeros(slope)])
            values.append(ca.vec(value / ca.DM(piece.scales[:count])))
            order.append(piece.rows[:count].ravel(order="F"))
            row, column = slope.sparsity().get_triplet()
            units = piece.units[column] / piece.scales[row]
            sums.add(numbers, piece.rows[row], piece.variables[column], units)
    g = ca.vertcat(*values)[np.argsort(np.concatenate(order)).tolist()]
    return _Function("nlp_jac_g", [w, p], [g, sums.matrix()], ["x", "p"], ["g", "jac_g_x"])


def _second(placed: list[_Placed], w: Any, p: Any, height: int) -> _Function:
    """(w, p, weight of the cost, weights of the rows) -> upper triangle of the second slopes of their sum."""
    of_cost, of_rows = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", height)
    weights = ca.vertcat(of_rows, of_cost / p[-1])
    sums = _Sums(w.shape[0], w.shape[0])
    for each in placed:
        piece = each.piece
        symbol = type(piece.by).sym("weights", piece.values.shape[0])
        slope, _ = ca.hessian(ca.dot(symbol, piece.values), piece.by)
        row, column = slope.sparsity().get_triplet()
        if row:
            places = np.where(piece.rows == COST, height, piece.rows)
            own = ca.reshape(weights[places.ravel(order="F").tolist()], *places.shape) / ca.DM(piece.scales)
            (numbers,) = each.evaluated([_nonzeros(slope)], (symbol, own))
            i, j = piece.variables[row], piece.variables[column]
            sums.add(numbers, i, j, piece.units[row] * piece.units[column], i <= j)
    inputs, names = [w, p, of_cost, of_rows], ["x", "p", "lam_f", "lam_g"]
    return _Function("nlp_hess_l", inputs, [sums.matrix()], names, ["triu_hess_gamma_x_x"])


class _Sums:
    """A sparse matrix whose entries are sums of numbers of pieces."""

    def __init__(self, height: int, width: int) -> None:
        self._height, self._width = height, width
        self._numbers: list[Any] = [ca.MX(0, 1)]
        self._places, self._factors, self._taken = [np.zeros(0, np.intp)], [np.zeros(0)], [np.zeros(0, bool)]

    def add(self, numbers: Any, rows: Whole, columns: Whole, factors: Array, taken: Any = True) -> None:
        """Numbers, a column for each place, with the entries to which they count, times factors, where taken."""
        self._numbers.append(ca.densify(ca.vec(numbers)))  # CasADi may know that they are all zero
        keys = columns * self._height + rows
        for kept, own in ((self._places, keys), (self._factors, factors), (self._taken, taken)):
            kept.append(np.broadcast_to(own, numbers.shape).ravel(order="F"))

    def matrix(self) -> Any:
        """The matrix."""
        places, factors, taken = (np.concatenate(own) for own in (self._places, self._factors, self._taken))
        entries, where = np.unique(places[taken], return_inverse=True)
        starts = np.searchsorted(entries, self._height * np.arange(self._width + 1)).tolist()
        pattern = ca.Sparsity(self._height, self._width, starts, (entries % self._height).tolist())
        counts = np.concatenate([[0], np.cumsum(taken)]).tolist()
        summed = ca.DM(ca.Sparsity(entries.size, taken.size, counts, where.tolist()), ca.DM(factors[taken]))
        return ca.sparsity_cast(ca.mtimes(summed, ca.vertcat(*self._numbers)), pattern)


def _nonzeros(matrix: Any) -> Any:
    """The nonzeros of an expression as a column."""
    return ca.sparsity_cast(matrix, ca.Sparsity.dense(matrix.nnz(), 1))
