"""The stacked vectors x, u, e, t, T, p of a problem, and what the user's expressions become in them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import TABLE, Expr
from covocp.base.geometry import Geometry
from covocp.base.matrices import half_length
from covocp.base.short_repr import short_repr
from covocp.problem.closed_loop_covariance import floored
from covocp.problem.declarations import Declarations
from covocp.statement.statement import INPUTS


@dataclass(frozen=True, kw_only=True)
class Stacked:
    """The stacked symbols x, u, e, t, T, p, and what the user's expressions become in them.

    geometry: of the states that are estimated, the first of all; unknowns: entries of these; tables: whether the
    user's expressions look something up in tables.
    """

    inputs: tuple[Any, ...]
    geometry: Geometry
    unknowns: int
    tables: bool
    substitute: Callable[..., list[Any]]
    symbolic: type

    __repr__ = short_repr

    def augmented_jacobian(self, expression: Expr) -> Any:
        """Jacobian with respect to the augmented state (states, then unknowns)."""
        x, p = self.inputs[0], self.inputs[5]
        rows = self.geometry.size
        by_state = self.geometry.tangent_slope(x[:rows], ca.jacobian(expression, x)[:, :rows])
        return ca.horzcat(by_state, ca.jacobian(expression, p)[:, p.shape[0] - self.unknowns :])

    def function(self, name: str, expressions: list[Any], *, without: tuple[str, ...] = ()) -> ca.Function:
        """A function of the stacked vectors, with named inputs."""
        kept = [(symbol, label) for symbol, label in zip(self.inputs, INPUTS, strict=True) if label not in without]
        expressions = self._bare(
            expressions, [s for s, label in zip(self.inputs, INPUTS, strict=True) if label in without]
        )
        outputs = [f"out{i}" for i in range(len(expressions))]
        return ca.Function(name, [k[0] for k in kept], expressions, [k[1] for k in kept], outputs)

    def _bare(self, expressions: list[Any], others: list[Any]) -> list[Any]:
        """Expressions without symbols on which no entry of them depends: those of a call name all that it was made of.

        X at the end is a block of the covariance that the gain, a control, makes the rest of.
        """
        if self.symbolic is not ca.MX:
            return expressions
        entries = ca.veccat(*expressions)
        unused = [s for s in others if not ca.jacobian_sparsity(entries, s).nnz()]
        return list(ca.substitute(expressions, unused, [ca.MX.zeros(s.shape) for s in unused]))

    def with_spread(self, name: str, expressions: list[Any], size: int) -> ca.Function:
        """A function of the stacked vectors and of the half-vector of X, of so many rows: the user's expressions."""
        half = self.symbolic.sym("spread", half_length(size))  # type: ignore[attr-defined]
        values = self.substitute(*expressions, spread=floored(half, size))
        return ca.Function(name, [*self.inputs, half], [ca.vertcat(*values)], [*INPUTS, "spread"], ["out0"])


def stack(problem: Declarations) -> Stacked:
    """Stacked symbols, SX where every expression can be expanded, and the substitution of the user's symbols."""
    groups: list[Any] = [problem.states, problem.controls, problem.matrices, problem.parameters, problem.unknowns]
    own: list[Any] = [entry.symbol for group in groups for entry in group] + [problem.time]
    if problem.free_duration is not None:
        own.append(problem.duration)
    every = _every(problem)
    try:
        return _written(problem, own, every, ca.SX)
    except RuntimeError:  # interpolation tables and external functions have no SX form
        return _written(problem, own, every, ca.MX)


def _every(problem: Declarations) -> list[Any]:
    """Every expression of the user's."""
    every: list[Any] = [entry.rate for entry in problem.rates.values()]
    every += [entry.noise for entry in problem.rates.values() if entry.noise is not None]
    every += [value for m in problem.measurements for value in (m.expression, m.noise)]
    every += [m.information for m in problem.measurements if m.information is not None]
    every += [c.expression for c in problem.constraints] + list(problem.cost or ())
    return every + [slope for c in problem.constraints if c.chance is not None for slope in c.chance.slopes or ()]


def _written(problem: Declarations, own: list[Any], every: list[Any], symbolic: Any) -> Stacked:
    """The stacked symbols of a type, and the substitution of the user's symbols."""
    groups: list[Any] = [problem.states, problem.controls, problem.matrices, [*problem.parameters, *problem.unknowns]]
    x, u, e, p = (
        symbolic.sym(name, sum(entry.symbol.shape[0] for entry in group))
        for name, group in zip(("x", "u", "e", "p"), groups, strict=True)
    )
    t, duration = symbolic.sym("t"), symbolic.sym("T")
    arguments: list[Any] = []
    for group, vector in zip(groups, (x, u, e, p), strict=True):
        offsets = np.cumsum([0, *(entry.symbol.shape[0] for entry in group)]).tolist()
        arguments += [vector[i:j] for i, j in pairwise(offsets)]
    arguments += [t, duration] if problem.free_duration is not None else [t]
    known, spread_of_loop = own, None if problem.spread is None else problem.spread.value
    if spread_of_loop is not None:
        known = [*own, problem.spread.symbol]  # type: ignore[union-attr]
        arguments += ca.Function("spread", own, [spread_of_loop]).call(arguments, True, False)
    everything = ca.Function("everything", known, every)
    values = everything.call(arguments, True, False)
    # To write one of them alone takes as long as to write all of them. The expressions are kept: others could come to
    # lie where they were, and have their hashes.
    written = {v.__hash__(): (v, value) for v, value in zip(every, values, strict=True) if isinstance(v, ca.MX)}

    def substitute(*expressions: Any, spread: Any = None) -> list[Any]:
        """The expressions in the stacked symbols; with another covariance of the closed loop where one is given."""
        if spread is None and all(isinstance(v, ca.MX) and v.__hash__() in written for v in expressions):
            return [written[v.__hash__()][1] for v in expressions]
        function = ca.Function("substitute", known, list(expressions))
        return list(function.call(arguments if spread is None else [*arguments[:-1], spread], True, False))

    return Stacked(
        inputs=(x, u, e, t, duration, p),
        geometry=Geometry.of(entry for entry in problem.states if entry.estimated),
        unknowns=sum(entry.size for entry in problem.unknowns),
        tables=any(function.name().startswith(TABLE) for function in everything.find_functions()),
        substitute=substitute,
        symbolic=symbolic,
    )
