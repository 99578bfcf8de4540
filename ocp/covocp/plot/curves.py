"""What figures are made of: curves and panels as plain numbers, and solutions sampled for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.base.threads import cached
from covocp.solution.reading import expression_between, other_loop
from covocp.solution.sample import Sample
from covocp.solution.solution import Solution
from covocp.statement.names import block_of
from covocp.statement.statement import Block
from covocp.transcription.before_reading import ESTIMATE

# Curves are sampled at the nodes, on coarser meshes at least this often.
SAMPLES = 200
# Vectors up to this size get a panel an entry, larger ones share one.
SEPARATE_ENTRIES = 3
LONGEST_LABEL = 40
# The gain of a feedback with constraints is a control, or a constant state, of this name.
GAIN = "C"


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One curve.

    Args:
        t: times [s], or whatever else it is drawn over.
        y: values, the shape of t.
        deviation: standard deviation, the shape of t; None: no band.
        needed: distances below and above, (2, K), that a probability asks limits to have; None: none does.
        order: number of its solution.
        entry: number of its entry in a panel of several.
        steps: whether the value holds until the next time.
        target: value asked for at the end.
    """

    t: Array
    y: Array
    deviation: Array | None = None
    needed: Array | None = None
    order: int = 0
    entry: int = 0
    steps: bool = False
    target: float | None = None

    __repr__ = short_repr


class Bound(NamedTuple):
    """One bound of a quantity.

    value: of it. order: number of the phase that has it; 0 where solutions do not follow each other. span: along the
    abscissa; None: all of it.
    """

    value: float
    order: int = 0
    span: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Ellipse:
    """A covariance (2, 2) of abscissa and ordinate about a point (2,) of a path, of the solution of some number."""

    centre: Array
    covariance: Array
    order: int

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One pair of axes.

    Args:
        label: of the ordinate.
        entries: names of its entries; one: all curves are of the same.
        curves: what is drawn.
        bounds: of the quantity, those of all solutions.
        legend: whether the entries are explained in it.
        key: name of what it shows where that is one entry of one symbol; "" otherwise.
        path: whether it is one state over another.
        equal: whether a unit is as long along both axes.
        ellipses: covariances along a path.
    """

    label: str
    entries: tuple[str, ...]
    curves: tuple[Curve, ...]
    bounds: tuple[Bound, ...] = ()
    legend: bool = True
    key: str = ""
    path: bool = False
    equal: bool = False
    ellipses: tuple[Ellipse, ...] = ()

    __repr__ = short_repr


class Covariances(NamedTuple):
    """Of deviations at some times, (K, n, n): E, X = E + Xhat - Z - Z', Xhat, Z; without feedback E is X."""

    E: Array
    X: Array
    Xhat: Array
    Z: Array


class Drawn:
    """A solution sampled for drawing; `phase`: of several that follow each other, which are one to what is drawn."""

    def __init__(self, solution: Solution, order: int, *, phase: bool = False) -> None:
        """Choose the times."""
        self.solution, self.order, self.phase = solution, order, phase
        self.covariance = next((b for b in solution.blocks if b.estimation and b.covariance), None)
        nodes, parts = np.unique(solution.t), -(-SAMPLES // solution.mesh.intervals)
        if solution.mesh.control == "constant":  # rates jump at the nodes, which a smooth curve would follow
            parts = 1
        inner = nodes[:-1, None] + np.diff(nodes)[:, None] * np.arange(parts) / parts
        regular = np.append(inner.ravel(), nodes[-1])
        # where something happens between the nodes
        knots = solution.dense.knots if self.known_between else solution.mesh.nodes
        t = np.union1d(regular, knots[~np.isin(knots, solution.mesh.nodes)] * solution.duration)
        # before and after what is read at an instant
        self.t = np.sort(np.concatenate([t, solution.t[solution.mesh.instants]]))
        self.early = np.flatnonzero(np.diff(self.t) == 0.0)

    @property
    def known_between(self) -> bool:
        """Whether what is drawn is known between the nodes: not where a loop has other statistics than its design's."""
        return self.solution.loop is None or other_loop(self.solution) is None

    def bounds(self, values: Iterable[float]) -> list[Bound]:
        """Those of some values that are bounds at all, as bounds of this solution."""
        return [Bound(float(value), self.order if self.phase else 0) for value in values if np.isfinite(value)]

    def knows(self, name: str) -> bool:
        """Whether a name, or the vector of an entry, is in the solution."""
        return block_of(name, self.solution.blocks) is not None

    @cached
    def sample(self) -> Sample:
        """Values between the nodes."""
        sample = self.solution.at(self.t)
        if not self.early.size:
            return sample
        before, values = self.solution.at(self.t[self.early], "before"), {}
        for name, value in sample.values.items():
            values[name] = value.copy()
            values[name][self.early] = before.values[name]
        return replace(sample, values=values)

    def rows(self, name: str) -> list[int]:
        """Rows of the covariance that belong to a state or an unknown."""
        if self.covariance is None:
            return []
        labels = self.covariance.labels
        return [i for i, label in enumerate(labels) if name in (label, label.split("[")[0])]

    def deviation(self, block: Block) -> Array | None:
        """Half the width of a band at the times, (K, size); None where nothing is uncertain.

        Of a state: of the actual system. Of an unknown constant: of the estimate, which alone changes. Of a control:
        what the feedback adds to it; of one that is constant between the nodes at these.
        """
        loop, rows = self.solution.loop, self.rows(block.name)
        if self.covariance is None or (loop is None and block.kind == "control"):
            return None
        if loop is not None and block.kind == "control":
            gain, estimate = loop.gain[:, block.span], loop.Xhat
            if self.solution.mesh.control != "constant":  # which is drawn at the nodes
                gain, estimate = self.between(gain), self.covariances.Xhat
            variances = np.einsum("kui,kij,kuj->ku", gain, estimate, gain)
        else:
            variances = (self.covariances.E if block.kind == "unknown" else self.covariances.X)[:, rows, rows]
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    @cached
    def covariances(self) -> Covariances:
        """Those of the deviations at the times, between the nodes as the integrator has them where it does.

        Of a closed loop it has E, and Xhat only where this is a state. Else the sum X of both is drawn through its
        nodes, which no measurement moves: what E falls by Xhat rises by, however fast, so Xhat is the rest.
        """
        loop = self.solution.loop
        assert self.covariance is not None
        if loop is None:
            E = self.sample[self.covariance.name]
            return Covariances(E, E, np.zeros_like(E), np.zeros_like(E))
        Z = self.between(loop.Z)
        both = Z + Z.transpose(0, 2, 1)
        if not self.known_between:
            E, Xhat = self.between(loop.E), self.between(loop.Xhat)
            return Covariances(E, E + Xhat - both, Xhat, Z)
        # The loop is propagated by more steps than the program has: at its nodes E is what it says.
        E = self.sample[self.covariance.name] + self.between(loop.E - self.solution.values[self.covariance.name])
        if ESTIMATE in self.sample.values:
            Xhat = self.sample[ESTIMATE]
            return Covariances(E, E + Xhat - both, Xhat, Z)
        X = self.between(loop.X)
        Xhat = X - E + both
        Xhat[np.isin(self.t, self.solution.t)] = loop.Xhat  # without the roundoff of a difference
        return Covariances(E, X, Xhat, Z)

    def block(self, a: Given, b: Given) -> Array:
        """Covariance of the actual deviations between two symbols at the times, (K, size of a, size of b)."""
        if self.covariance is None or not all(isinstance(key, str) and self.rows(key) for key in (a, b)):
            return self.between(self.solution.covariance(a, b))  # says what is wrong with them
        return self.covariances.X[:, self.rows(a)][:, :, self.rows(b)]

    def between(self, values: Array) -> Array:
        """Values at the times from those at the nodes, time first; without overshoot: variances stay positive."""
        ends = zip(_ends(self.solution.mesh.instants, values.shape[0]), _ends(self.early, self.t.size), strict=True)
        return np.concatenate([_between(self.solution.t[k], values[k], self.t[i]) for k, i in ends])

    def expression(self, key: Any) -> tuple[Array, Array, Array]:
        """Times, values of an expression of the symbols and their deviations (0 where nothing is uncertain), (K, rows).

        Where controls are held it jumps with them: each interval has times of its own, from after its begin to before
        its end.
        """
        solution, size = self.solution, key.shape[0] * key.shape[1]
        known = self.covariance is not None and key.shape[1] == 1
        spread = self.spread(key)[0] if known else np.zeros((self.t.size, size))
        if not self.known_between:
            return self.t, self.between(solution[key].reshape(solution.t.size, size)), spread
        solution[key]  # says what is wrong with it
        if solution.mesh.control != "constant":
            values = expression_between(solution, key, self.t).reshape(-1, size)
            if self.early.size:
                early = expression_between(solution, key, self.t[self.early], before=True)
                values[self.early] = early.reshape(-1, size)
            return self.t, values, spread
        places = np.union1d(self.t, np.linspace(0.0, solution.duration, SAMPLES + 1))
        times = np.column_stack([places[:-1], places[1:]])
        sides = [expression_between(solution, key, times[:, i], before=i == 1).reshape(-1, size) for i in (0, 1)]
        k = np.searchsorted(self.t, times[:, 0], side="right") - 1
        shares = ((times - self.t[k, None]) / (self.t[k + 1] - self.t[k])[:, None])[:, :, None]
        bands = spread[k, None] + shares * (spread[k + 1] - spread[k])[:, None]
        return times.ravel(), np.stack(sides, axis=1).reshape(-1, size), bands.reshape(-1, size)

    def spread(self, key: Given) -> tuple[Array, Array, Array]:
        """Root mean squares at the times, each (K, size): deviation, its error of the estimate, its estimate.

        The deviation of an expression g(x, b, u) is g_x dx + g_u du, with dx = x' - e and du = -C x'.
        """
        loop, known = self.solution.loop, self.covariances
        by_state, by_control = self._slopes(key)
        by_estimate = by_state if loop is None else by_state - by_control @ loop.gain
        by_state, by_estimate = self.between(by_state), self.between(by_estimate)
        error = np.einsum("kri,kij,krj->kr", by_state, known.E, by_state)
        estimate = np.einsum("kri,kij,krj->kr", by_estimate, known.Xhat, by_estimate)
        total = error + estimate - 2 * np.einsum("kri,kij,krj->kr", by_state, known.Z, by_estimate)
        roots = (np.sqrt(np.maximum(values, 0.0)) for values in (total, error, estimate))
        return next(roots), next(roots), next(roots)

    def _slopes(self, key: Given) -> tuple[Array, Array]:
        """Slopes of a name or an expression by the augmented state (K, rows, n) and by the control (K, rows, nu)."""
        solution, augmented = self.solution, self.solution.augmented
        controls = tuple(b for b in solution.blocks if b.kind == "control" and not (solution.loop and b.name == GAIN))
        count, width = solution.t.size, sum(b.size for b in controls)
        if isinstance(key, str):
            block = solution.block(key)
            own = block.size if block.kind == "control" else len(self.rows(key))
            by_state, by_control = np.zeros((own, len(augmented))), np.zeros((own, width))
            if block.kind == "control":
                by_control[:, block.span] = np.eye(block.size)
            else:
                by_state[:, self.rows(key)] = np.eye(own)
            return tuple(np.tile(v, (count, 1, 1)) for v in (by_state, by_control))  # type: ignore[return-value]
        statement = solution.extremal.statement  # not known where the solution was read from a file alone
        states = dict.fromkeys(label.split("[")[0] for label in augmented)
        results = []
        for names, size in ((states, len(augmented)), ([b.name for b in controls], width)):
            slope = ca.densify(ca.horzcat(*(statement.slope(key, name) for name in names)))
            results.append(solution[slope].reshape(count, key.shape[0] * key.shape[1], size))
        return results[0], results[1]

    def target(self, block: Block) -> Array:
        """What a state should be at the end, NaN where it is free."""
        if block.kind != "state":
            return np.full(block.size, np.nan)
        return self.solution.targets[block.span]


def shortened(expression: Given) -> str:
    """An expression as a label."""
    text = str(expression)
    return text if len(text) <= LONGEST_LABEL else text[: LONGEST_LABEL - 3] + "..."


def units_in(solutions: Iterable[Solution]) -> dict[str, str]:
    """Units by name of what is in solutions, and of what is measured where their problem is known."""
    units: dict[str, str] = {}
    for solution in solutions:
        measured = () if solution.statement is None else solution.statement.measurements
        units |= {block.name: block.unit for block in (*solution.blocks, *measured)}
    return units


def unit_of(name: str, units: Mapping[str, str]) -> str:
    """The unit of a symbol as it stands on an axis; "" where none is known."""
    word = _unit(name, units)
    return f" [{word}]" if word else ""


def _unit(name: str, units: Mapping[str, str]) -> str:
    """The unit of a symbol, or of the vector that it is an entry of; "" where none is known."""
    return units.get(name) or units.get(name.split("[")[0], "")


def product_unit(owners: list[str], units: Mapping[str, str]) -> str:
    """Unit of a covariance between two symbols."""
    words = [_unit(owner, units) for owner in owners]
    if not all(words):
        return ""
    words = [_bracketed(word) for word in words]
    return f" [{words[0]}²]" if words[0] == words[-1] else f" [{words[0]} {words[1]}]"


def ratio_unit(above: str, below: str, units: Mapping[str, str]) -> str:
    """Unit of a gain from one symbol to another."""
    words = _unit(above, units), _unit(below, units)
    return f" [{_bracketed(words[0])}/{_bracketed(words[1])}]" if all(words) else ""


def filter_unit(state: str, measurement: str, units: Mapping[str, str]) -> str:
    """Unit of a gain K = E M' U^-1 of the continuous filter: of the state per measured value and second."""
    above, below = _unit(state, units), _unit(measurement, units)
    if not above or not below:
        return ""
    return " [1/s]" if above == below else f" [{_bracketed(above)}/({_bracketed(below)} s)]"


def _bracketed(word: str) -> str:
    """A unit that may stand in a product."""
    return word if word.isalnum() else f"({word})"


def _ends(last: Given, count: int) -> list[slice]:
    """The stretches of so many places that end at some of them."""
    stops = [*(int(k) + 1 for k in last), count]
    return [slice(begin, stop) for begin, stop in zip([0, *stops], stops, strict=False)]


def _between(nodes: Array, values: Array, times: Array) -> Array:
    """Values at the times from those at the nodes of a stretch in which nothing jumps."""
    from scipy.interpolate import PchipInterpolator

    if nodes.size == 1:
        return np.repeat(values, times.size, axis=0)
    if times.size == nodes.size or not np.isfinite(values).all():
        columns = values.reshape(values.shape[0], -1).T
        flat = np.array([np.interp(times, nodes, column) for column in columns]).T
        return flat.reshape(times.size, *values.shape[1:])
    result = np.asarray(PchipInterpolator(nodes, values, axis=0)(times))
    nearest = np.minimum(np.searchsorted(nodes, times), nodes.size - 1)
    known = nodes[nearest] == times
    result[known] = values[nearest[known]]  # without the roundoff of a polynomial
    return result
