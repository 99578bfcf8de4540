"""Nonlinear programs of one statement or of a chain of them, as one object that solvers drive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.statement.chain import Chain, Link
from covocp.transcription.before_reading import ESTIMATE
from covocp.transcription.nlp import NLP, VIOLATION, Rows, Scales, check_costs
from covocp.transcription.pieces import joined_pieces
from covocp.transcription.separable import Piece
from covocp.transcription.trajectory import Multipliers, Trajectory

# What each part of a program has, one after the other.
Arrays = tuple[Array, ...]
Trajectories = tuple[Trajectory, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Program:
    """Transcribed statements, with the rows that link the end of each to the start of the next.

    Minimise f(w, p) subject to bounds on w and g(w, p); everything scaled. `w` and `p` stack those of the parts, then
    the scale of the cost; `g` stacks those of the parts, then the links. Where matrices are eliminated the half-vectors
    at the start of a part are no variables: expressions of the part before stand for them among its parameters. What
    runs backward in a part stands, at its start, among the parameters of the part before. `gradient`, f and
    its slopes by w, and `jacobian`, those of g, are there where CasADi's own take longer, else None. `pieces`,
    where there are some, add up to f and g.
    """

    parts: tuple[NLP, ...]
    links: tuple[Link, ...]
    w: Any
    p: Any
    f: Any
    g: Any
    link_rows: tuple[Rows, ...]
    gradient: tuple[Any, Any] | None
    jacobian: Any
    pieces: tuple[Piece, ...] = ()

    __repr__ = short_repr

    @property
    def scales(self) -> tuple[Scales, ...]:
        """Of each part."""
        return tuple(part.scales for part in self.parts)

    @property
    def rows(self) -> tuple[Rows, ...]:
        """Of all parts, then of the links."""
        return (*(rows for part in self.parts for rows in part.rows), *self.link_rows)

    @cached_property
    def chosen(self) -> list[int]:
        """Variables that are controls or durations."""
        places: list[int] = []
        for part, span in zip(self.parts, self._spans, strict=True):
            count = part.mesh.control_nodes * part.statement.nu + int(part.statement.duration.free)
            places += range(span.stop - count, span.stop)
        return places

    def p_of(self, parameters: Arrays, cost_scale: float) -> Array:
        """The parameters of the program."""
        return np.append(np.concatenate(parameters), cost_scale)

    def pack(self, trajectories: Trajectories) -> Array:
        """The scaled variables of trajectories."""
        return np.concatenate([part.pack(t) for part, t in zip(self.parts, trajectories, strict=True)])

    def pack_multipliers(
        self, multipliers: Sequence[Multipliers], costates: Sequence[tuple[Array, Array]]
    ) -> tuple[Array, Array]:
        """Multipliers of the program (for a cost scale of 1) from those of the statements and the costates."""
        pairs = [part.pack_multipliers(m, c) for part, m, c in zip(self.parts, multipliers, costates, strict=True)]
        links = []
        for link, part, (state, matrices) in zip(self.links, self.parts[1:], costates[1:], strict=True):
            for kind, entries in _linked(link, part).items():
                start = (state if kind == "link_x" else matrices)[0, entries]
                links.append(-start * _scale(part.scales, kind, entries))
        return np.concatenate([own for own, _ in pairs]), np.concatenate([*(own for _, own in pairs), *links])

    def unpack(self, w: Array, parameters: Arrays) -> tuple[Trajectories, dict[str, Any]]:
        """The trajectories, the cost terms of each part and together, and all constraint values, of some variables."""
        found: list[Trajectory] = []
        costs: list[dict[str, Any]] = []
        rows: list[Array] = []
        used: list[Array] = []
        parameters = self._weighed(w, parameters)
        for i, (part, span) in enumerate(zip(self.parts, self._spans, strict=True)):
            used.append(parameters[i])
            if i:
                given = self._given(i - 1, found[-1], used[-2], used[-1])
                used[-1] = self.links[i - 1].filled(used[-1], given[1])
            trajectory, values = part.unpack(w[span], used[-1])
            if i:
                rows += self._link_values(i - 1, trajectory, given)
            found.append(trajectory)
            costs.append(values)
        values = {name: sum(entry[name] for entry in costs) for name in ("running", "terminal")}
        g = np.concatenate([*(entry["g"] for entry in costs), *rows])
        return tuple(found), {**values, "parts": costs, "g": g}

    def filled(self, trajectories: Trajectories, parameters: Arrays) -> Arrays:
        """The parameters of each part, with the half-vectors that the parts beside it give."""
        for i, link in enumerate(self.links):
            if link.weights:
                start = trajectories[i + 1].e[0, list(link.behind)]
                parameters = (*parameters[:i], link.weighed(parameters[i], start), *parameters[i + 1 :])
        result = [parameters[0]]
        for i in range(len(self.links)):
            given = self._given(i, trajectories[i], result[-1], parameters[i + 1])
            result.append(self.links[i].filled(parameters[i + 1], given[1]))
        return tuple(result)

    def _weighed(self, w: Array, parameters: Arrays) -> Arrays:
        """The parameters of each part, with the half-vectors that run backward from the part after it."""
        result, spans = list(parameters), self._spans
        for i in range(len(self.links) - 1, -1, -1):
            backward = self.parts[i + 1].backward
            if self.links[i].weights and backward is not None:
                start = backward(w[spans[i + 1]], np.append(result[i + 1], 1.0))
                result[i] = self.links[i].weighed(result[i], np.asarray(start.full()).ravel())
        return tuple(result)

    def each(self, trajectories: Trajectories, parameters: Arrays) -> Iterator[tuple[NLP, Trajectory, Array]]:
        """The parts, with the trajectory and the parameters of each."""
        yield from zip(self.parts, trajectories, self.filled(trajectories, parameters), strict=True)

    def bounds(self, parameters: Arrays) -> dict[str, Array]:
        """Bounds of w and g (nlpsol's names) for these parameters, read-only; those of the last ones are kept."""
        return _bounds(self, *(own.tobytes() for own in parameters))

    def _made_bounds(self, parameters: Arrays) -> dict[str, Array]:
        """The same, made."""
        found = [part.bounds(own) for part, own in zip(self.parts, parameters, strict=True)]
        for i, link in enumerate(self.links):
            part, entries = self.parts[i + 1], _linked(link, self.parts[i + 1]).get("link_e")
            if not entries:
                continue
            offset = len(part.mesh.starts) * part.statement.nx  # matrices at the start: rows give them
            places = [offset + k for k in entries]
            lower = part.statement.matrix_lower.copy()
            for block in part.statement.matrices:  # given by what is semidefinite, and zero where a state appears
                if part.statement.loop is not None and block.name == ESTIMATE:
                    lower[block.span] = -np.inf
            found[i + 1]["lbx"][places] = lower[entries] / part.scales.e[entries]
            found[i + 1]["ubx"][places] = np.inf
        joined = {name: np.concatenate([entry[name] for entry in found]) for name in found[0]}
        zero = np.zeros(sum(rows.lower.size for rows in self.link_rows))
        return {**joined, "lbg": np.append(joined["lbg"], zero), "ubg": np.append(joined["ubg"], zero)}

    def violations(self, g: Array, parameters: Arrays) -> dict[str, float]:
        """Largest violation of each violated constraint, in its own unit, by name (of several parts with theirs)."""
        result: dict[str, float] = {}
        bounds = self.bounds(parameters)
        excess = np.maximum(np.maximum(bounds["lbg"] - g, g - bounds["ubg"]), 0.0)
        excess = np.where(np.isfinite(g), excess, np.inf)
        for part, own, span in zip(self.parts, parameters, self._row_spans, strict=True):
            prefix = f"{part.statement.name}: " if self.links else ""
            result |= {prefix + name: value for name, value in part.violations(excess[span], own).items()}
        values = g[g.size - sum(rows.lower.size for rows in self.link_rows) :]
        offset = 0
        for rows in self.link_rows:
            for i, name in enumerate(rows.names):
                value = abs(float(values[offset + i])) if np.isfinite(values[offset + i]) else np.inf
                if value > VIOLATION:
                    result[name] = value * float(rows.scale[i])
            offset += rows.lower.size
        return dict(sorted(result.items(), key=lambda entry: -entry[1]))

    def unpack_multipliers(
        self, lam_x: Array, lam_g: Array, trajectories: Trajectories, parameters: Arrays
    ) -> tuple[Multipliers, ...]:
        """Multipliers of the statements from those of the program (for a cost scale of 1)."""
        spans = zip(self._spans, self._row_spans, strict=True)
        return tuple(
            part.unpack_multipliers(lam_x[span], lam_g[rows], trajectory, own)
            for (part, trajectory, own), (span, rows) in zip(self.each(trajectories, parameters), spans, strict=True)
        )

    def link_multipliers(self, lam_g: Array) -> tuple[Array, ...]:
        """Multipliers of the states that each link gives (for a cost scale of 1): minus the costates there."""
        offset, result = sum(part.g.shape[0] for part in self.parts), []
        for link, part in zip(self.links, self.parts[1:], strict=True):
            size = len(link.states)
            result.append(lam_g[offset : offset + size] / part.scales.x[list(link.states)])
            offset += sum(len(entries) for entries in _linked(link, part).values())
        return tuple(result)

    def bounds_at_ends(self, lam_x: Array) -> tuple[tuple[Array, Array], ...]:
        """Multipliers of the bounds on the states where each part begins and ends (for a cost scale of 1)."""
        return tuple(part.bounds_at_ends(lam_x[span]) for part, span in zip(self.parts, self._spans, strict=True))

    def units(self, scales: tuple[Scales, ...]) -> Array:
        """Other magnitudes of the variables, in the units of this program, an entry for each variable."""
        return np.concatenate([part.units(own) for part, own in zip(self.parts, scales, strict=True)])

    def row_units(self, scales: tuple[Scales, ...]) -> Array:
        """Other magnitudes of what the rows of g compare, in units of these rows; 1 where rows have no magnitude."""
        own = [part.row_units(own) for part, own in zip(self.parts, scales, strict=True)]
        for link, part, later in zip(self.links, self.parts[1:], scales[1:], strict=True):
            for kind, entries in _linked(link, part).items():
                own.append(_scale(later, kind, entries) / _scale(part.scales, kind, entries))
        return np.concatenate(own)

    def check_finite(self, w: Array, parameters: Arrays) -> None:
        """The cost must be finite where a solver starts.

        Raises:
            OutsideDomainError: names the part that is not.
        """
        trajectories, values = self.unpack(w, parameters)
        for part, trajectory, costs in zip(self.parts, trajectories, values["parts"], strict=True):
            check_costs(part.statement, trajectory, costs["running"], costs["terminal"])

    def _given(self, i: int, trajectory: Trajectory, parameters: Array, later: Array) -> tuple[Array, Array]:
        """What a link gives along a trajectory of the part before it."""
        last = (trajectory.x[-1], trajectory.e[-1], trajectory.duration)
        return self.links[i].values(*last, parameters, later)

    def _link_values(self, i: int, trajectory: Trajectory, given: tuple[Array, Array]) -> list[Array]:
        """Values of the rows of a link."""
        part, result = self.parts[i + 1], []
        starts = {"link_x": (trajectory.x[0], given[0]), "link_e": (trajectory.e[0], given[1])}
        for kind, entries in _linked(self.links[i], part).items():
            value, wanted = starts[kind]
            result.append((value[entries] - wanted) / _scale(part.scales, kind, entries))
        return result

    @cached_property
    def _spans(self) -> list[slice]:
        """The variables of each part."""
        return _consecutive([part.w.shape[0] for part in self.parts])

    @cached_property
    def _row_spans(self) -> list[slice]:
        """The rows of g of each part."""
        return _consecutive([part.g.shape[0] for part in self.parts])


@lru_cache(maxsize=2)
def _bounds(program: Program, *parameters: bytes) -> dict[str, Array]:
    """What each look at a point asks for: of the last programs and parameters, which are given by their bytes."""
    made = program._made_bounds(tuple(np.frombuffer(own) for own in parameters))
    for values in made.values():
        values.flags.writeable = False
    return made


def alone(nlp: NLP) -> Program:
    """The program of one statement."""
    common = {name: getattr(nlp, name) for name in ("w", "p", "f", "g", "gradient", "jacobian", "pieces")}
    return Program(parts=(nlp,), links=(), link_rows=(), **common)


def joined(chain: Chain, parts: tuple[NLP, ...]) -> Program:
    """The program of a chain.

    Args:
        chain: statements and links.
        parts: the transcribed statements, all with matrices eliminated or none.
    """
    w = ca.MX.sym("w", sum(part.w.shape[0] for part in parts))
    p = ca.MX.sym("p", sum(part.statement.np for part in parts) + 1)
    variables = _split(w, [part.w.shape[0] for part in parts])
    *known, cost_scale = _split(p, [*(part.statement.np for part in parts), 1])
    for i in range(len(parts) - 2, -1, -1):
        backward = parts[i + 1].backward
        if chain.links[i].weights and backward is not None:
            start = backward(variables[i + 1], ca.vertcat(known[i + 1], 1.0))
            known[i] = _with(known[i], chain.links[i].weights, start)
    cost: Any = 0
    groups: list[tuple[Any, bool]] = []
    link_rows: list[Rows] = []
    ends: tuple[Any, ...] = ()
    for i, (part, own_w, own) in enumerate(zip(parts, variables, known, strict=True)):
        if i:
            given = chain.links[i - 1].function(*ends, own)
            own = _with(own, chain.links[i - 1].parameters, given[1])
        arguments = [own_w, ca.vertcat(own, 1.0)]
        x, e, _, duration, running, terminal, g = part.evaluate.call(arguments, True, False)
        if i:
            link_rows += _link_rows(chain.links[i - 1], part, (x[:, 0], e[:, 0]), given)
        cost += running + terminal
        dense = sum(rows.lower.size for rows in part.rows if rows.dense)
        sparse_rows, dense_rows = _split(g, [g.shape[0] - dense, dense])
        groups += [(sparse_rows, False), (dense_rows, True)]
        ends = (x[:, -1], e[:, -1], duration, own)
    groups.append((ca.vertcat(ca.MX(0, 1), *(rows.expression for rows in link_rows)), False))
    g = ca.vertcat(*(group for group, _ in groups))
    jacobian = None
    if any(is_dense and group.shape[0] for group, is_dense in groups):
        jacobian = ca.vertcat(*(ca.jacobian(group, w) for group, _ in groups))
    return Program(
        parts=parts,
        links=chain.links,
        w=w,
        p=p,
        f=cost / cost_scale,
        g=g,
        link_rows=tuple(link_rows),
        gradient=None,
        jacobian=jacobian,
        pieces=joined_pieces(chain.links, parts),
    )


def _linked(link: Link, part: NLP) -> dict[str, list[int]]:
    """Entries of the initial state, and of the half-vectors where these are variables, that rows of a link give."""
    entries = {"link_x": list(link.states), "link_e": [] if part.mesh.eliminated else list(link.matrices)}
    return {kind: chosen for kind, chosen in entries.items() if chosen}


def _scale(scales: Scales, kind: str, entries: list[int]) -> Array:
    """Magnitudes of what rows of a link compare."""
    return np.asarray((scales.x if kind == "link_x" else scales.e)[entries])


def _link_rows(link: Link, part: NLP, start: tuple[Any, Any], given: tuple[Any, Any]) -> list[Rows]:
    """The rows of a link: initial values that are variables less what the part before gives."""
    sides = {"link_x": (start[0], given[0]), "link_e": (start[1], given[1])}
    names = {"link_x": link.names[: len(link.states)], "link_e": link.names[len(link.states) :]}
    result = []
    for kind, entries in _linked(link, part).items():
        value, wanted = sides[kind]
        scale, zero = _scale(part.scales, kind, entries), np.zeros(len(entries))
        gap = (value[entries] - wanted) / ca.DM(scale)
        result.append(Rows(kind=kind, expression=gap, lower=zero, upper=zero, names=names[kind], scale=scale))
    return result


def _with(column: Any, entries: tuple[int, ...], values: Any) -> Any:
    """A column with other values in some consecutive entries."""
    if not entries:
        return column
    first, count = entries[0], len(entries)
    before, _, after = _split(column, [first, count, column.shape[0] - first - count])
    return ca.vertcat(before, values, after)


def _split(column: Any, lengths: list[int]) -> list[Any]:
    """Parts of a column of these lengths; slices of a column of one entry without any would be rows."""
    return list(ca.vertsplit(column, np.cumsum([0, *lengths]).tolist()))


def _consecutive(lengths: list[int]) -> list[slice]:
    """Slices of these lengths one behind the other."""
    return [slice(i, j) for i, j in pairwise(np.cumsum([0, *lengths]).tolist())]
