"""Jumps of the model that a solution meets where it compares states, controls or matrices.

Where a trajectory crosses g(x, u, E) = 0 and H jumps there, the costates of an optimum jump by dH/g' times the slope of
g. Derivatives of the rates have no such term, on whichever side: what is stationary by them is so by mistake unless
H is the same on both sides. Comparisons of the time, of parameters and of states that nothing chosen moves need none.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.pieces import Borders, borders_of, calls, expanded, may_jump
from covocp.base.short_repr import short_repr
from covocp.extremal.costates import discrete_costates
from covocp.extremal.crossings import BESIDE, MOVING, Met, Path, changed, columns_of, crossings, felt
from covocp.extremal.dense_output import mapped
from covocp.extremal.extremal import Extremal
from covocp.extremal.nodes import rates_along
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT

# Jump of H in its largest terms that counts; without costates that of a rate in its largest value.
LEAST = 1e-5


@dataclass(frozen=True, kw_only=True)
class Jump:
    """A comparison at which the model jumps, as often as a solution meets it.

    Attributes:
        words: what is compared, such as 'x > 0'; empty where that is long or not known.
        names: entries of state, control and matrices that it depends on; none where that is not known.
        times: when it is met [s], rising.
        intervals: of the mesh, in which it is.
        crossed: whether it is crossed somewhere; else the border is reached only.
        what: jumps most in what it does to the cost: the name of a state, of an entry of a matrix, or empty for the
            running cost.
        share: by how much, relative to the larger of both values.
        size: of the jump of H, in its largest terms.
    """

    words: str
    names: tuple[str, ...]
    times: tuple[float, ...]
    intervals: tuple[int, ...]
    crossed: bool
    what: str
    share: float
    size: float

    __repr__ = short_repr


@lru_cache(maxsize=2)  # of the solution that is looked at, and a phase beside it
def met_jumps(extremal: Extremal, linked: bool, optimised: bool) -> tuple[Jump, ...]:
    """Jumps of rates, matrices' rates and running cost with state, control or matrices that a solution meets.

    What costs nothing to jump is left out. Remembered: all who ask of a solution must give the same.

    Args:
        extremal: the solution.
        linked: whether its start is the end of a phase before it.
        optimised: whether its multipliers belong to its cost; else jumps of the states' rates are looked for.

    Returns:
        One for each comparison, the largest first; nothing where it cannot be told.
    """
    st = extremal.statement
    if not compares(st) or not all(np.isfinite(v).all() for v in (extremal.trajectory.x, extremal.trajectory.e)):
        return ()
    function, borders = _read(st)
    if borders is None and not calls(function):
        return ()
    try:
        if borders is None:
            path = Path.of(extremal, matrices=False)
            return _weighed(path, borders, list(felt(path)), optimised)
        path = Path.of(extremal, matrices=bool(borders.ends.jac_sparsity(0, 2).nnz()))
        return _weighed(path, borders, list(crossings(path, borders, linked)), optimised)
    except RuntimeError:  # CasADi's, of a linear system that is singular there
        return ()


@lru_cache(maxsize=KEPT)
def compares(statement: Statement) -> bool:
    """Whether rates or running cost may jump by what they compare."""
    parts = [statement.nominal, *statement.riccati]  # of fewer operations than what they make together
    functions = [part for part in parts if part is not None]
    if len(functions) < len(parts) or statement.running_uses_matrices:
        functions = [statement.rates]
    return any(may_jump(function) for function in functions)


@lru_cache(maxsize=KEPT)
def _read(statement: Statement) -> tuple[ca.Function, Borders | None]:
    """The rates, as scalar operations where they consist of such, and their borders."""
    function = expanded(statement.rates)
    return function, borders_of(function, MOVING)


def _weighed(path: Path, borders: Borders | None, met: list[Met], optimised: bool) -> tuple[Jump, ...]:
    """Jumps by what they do to H, those that do something, one for each comparison."""
    if not met:
        return ()
    extremal = path.extremal
    st, nodes = extremal.statement, extremal.mesh.nodes
    sizes = (st.nx, st.nu, st.ne, 1, 1, st.np)
    both = np.hstack([np.array([entry.sides[i] for entry in met]).T for i in (0, 1)])
    values = np.vstack(mapped(st.rates, *np.split(both, np.cumsum(sizes)[:-1])))
    low, high = values[:, : len(met)], values[:, len(met) :]
    some = np.flatnonzero(changed(path, low, high))
    if not some.size:
        return ()
    met, low, high = [met[j] for j in some], low[:, some], high[:, some]
    rates = rates_along(extremal)[0]
    if optimised:
        costates = discrete_costates(extremal)[0]
        weights = np.hstack([costates.state, costates.matrices])
        terms = np.abs(weights * rates).sum(axis=1).max()
        k = np.array([entry.interval for entry in met])
        h = nodes[k + 1] - nodes[k]
        c = (np.array([entry.s for entry in met]) - nodes[k]) / h
        own = np.vstack([(weights[k] + c[:, None] * (weights[k + 1] - weights[k])).T, np.ones((1, len(met)))])
    else:
        terms, largest = 1.0, np.abs(rates).max(axis=0)
        known = (np.arange(largest.size) < st.nx) & (largest > 0)
        own = np.append(np.where(known, 1.0 / np.where(known, largest, 1.0), 0.0), 0.0)[:, None]
    acting = own * (high - low)
    terms = np.maximum(terms, np.maximum(np.abs(low[-1]), np.abs(high[-1])) if optimised else 0.0)
    total = np.abs(acting.sum(axis=0)) / np.where(terms > 0, terms, 1.0)
    grouped: dict[tuple[str, tuple[str, ...]], list[int]] = {}
    for j in np.flatnonzero(total > LEAST):
        grouped.setdefault(_told(st, borders, met[j].border), []).append(int(j))
    jumps = []
    for (words, names), group in grouped.items():
        worst = max(group, key=lambda j: total[j])
        i = int(np.argmax(np.abs(acting[:, worst])))
        share = abs(high[i, worst] - low[i, worst]) / max(abs(high[i, worst]), abs(low[i, worst]))
        jumps.append(
            Jump(
                words=words,
                names=names,
                times=tuple(sorted({met[j].s * extremal.trajectory.duration for j in group})),
                intervals=tuple(sorted({k for j in group for k in _around(nodes, met[j])})),
                crossed=any(met[j].crossed for j in group),
                what=(*st.state_names, *st.matrix_names, "")[i],
                share=float(share),
                size=float(total[worst]),
            )
        )
    return tuple(sorted(jumps, key=lambda jump: -jump.size))


def _around(nodes: Array, met: Met) -> list[int]:
    """The interval in which a border is met; both beside a node."""
    k, h = met.interval, nodes[met.interval + 1] - nodes[met.interval]
    before = k > 0 and met.s - nodes[k] <= BESIDE * h
    after = k + 2 < nodes.size and nodes[k + 1] - met.s <= BESIDE * h
    return [k, *([k - 1] if before else []), *([k + 1] if after else [])]


def _told(statement: Statement, borders: Borders | None, row: int) -> tuple[str, tuple[str, ...]]:
    """What is compared, in words, and the entries that it depends on."""
    if borders is None:
        return "", ()
    names = (statement.state_names, statement.control_names, statement.matrix_names)
    entries = [ca.vertcat(*(ca.SX.sym(name) for name in own)) if own else ca.SX(0, 1) for own in names]
    others = [ca.SX.sym("time"), ca.SX.sym("duration"), _parameters(statement)]
    depends = [own[c] for own, i in zip(names, MOVING, strict=True) for c in columns_of(borders, row, i)]
    return borders.words([*entries, *others], row), tuple(depends)


def _parameters(statement: Statement) -> Any:
    """Known parameters and unknowns by their names, where they are all vectors; else by numbers."""
    blocks = [b for kind in ("parameter", "unknown") for b in statement.of_kind(kind)]
    parts = [ca.SX.sym(b.name, b.length) for b in blocks]
    symbols = ca.vertcat(*parts) if parts else ca.SX(0, 1)
    return symbols if symbols.numel() == statement.np else ca.SX.sym("parameter", statement.np)
