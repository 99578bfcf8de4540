"""The default mesh, graded at both ends where covariance or feedback are steep there.

From a large initial variance E falls like 1/(t + t0), t0 = U/E(0), as soon as something is measured; towards a weighted
end the feedback C rises like 1/(T - t + b/S(T)). Both are solutions of Riccati equations, V = F E + E F' + Q - E W E
(S backward), and their time scales are those of this equation: in the directions y in which E and E W E are diagonal
together the measurement alone would let the variance fall at the rate lambda (eigenvalues of E W), while it truly
changes at the relative rate r = y'V y / y'E y. Where E has settled r is zero, where nothing is measured lambda: the
smaller of the two says how fast what matters changes. It is measured along the guess, and the base intervals at both
ends are divided so that its integral over each part is about the same (a fixed ratio of neighbouring intervals where
E falls like 1/t).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array, stacked, unpack
from covocp.base.quadrature import covariance_after, interpolated
from covocp.base.short_repr import short_repr
from covocp.statement.interval import repeated
from covocp.statement.statement import Statement
from covocp.transcription.choosing import IMPLICIT_SUBSTEPS, choose_step
from covocp.transcription.first_guess import controls_guess, starts
from covocp.transcription.instants import completed, with_instants
from covocp.transcription.mesh import Graded, Mesh, Options, explicit_substeps
from covocp.transcription.starts import own_start
from covocp.transcription.stiffness import stiffness
from covocp.transcription.trajectory import Trajectory

# Change of ln E in a part of an interval: ratio 1.5 of neighbouring parts. Ratio 2 leaves errors of the expected cost
# of 5e-5 to 1.4e-3, this one of 1e-5 to 3e-4 (benchmarks/measurements/expected_cost.py).
CHANGE = 0.4
# An interval is divided where more than this many parts are asked for: where the time scale is below the interval.
DIVIDED = 1.5
# Most parts at each end, the shortest of them in durations, and how many base intervals an end reaches over.
MOST_PARTS = 48
SHORTEST = 1e-9
REACH = 10
# Points in which an end is looked at: ratio of neighbouring ones, first one in base intervals.
POINT_RATIO, FIRST_POINT = 1.5, 1e-10
# A free duration may become longer than its guess, and the same times a smaller share of it: by this factor.
LONGER = 3.0
# Intervals of the trajectory along which the time scales are measured.
COARSE = 20
# Share of the largest variance, in units of the variances themselves, below which a direction is known exactly.
KNOWN = 1e-13


def graded(statement: Statement, options: Options, parameters: Array) -> Options:
    """The options with the graded mesh in place of the uniform one, where covariances or gains are steep at its ends.

    Args:
        statement: the problem.
        options: a grid that is given, or already graded, stays as it is.
        parameters: of the statement.

    Returns:
        The options; with the uniform mesh where nothing is steep.
    """
    plain = with_instants(statement, options, parameters)
    if options.grid is not None or not needs_grading(statement):
        return plain
    longest = statement.duration.guess
    if statement.duration.free:
        longest = min(LONGER * longest, statement.duration.upper)
    guess = _guess(statement, options, parameters)
    seen = [
        _steepness(statement, guess, parameters, longest / options.intervals, backward) for backward in (False, True)
    ]
    start, end = (_parts(entry, options.intervals, longest) / longest for entry in seen)
    nodes = completed(
        statement, np.array(sorted({*plain.nodes(), *start, *(1.0 - end)})), parameters, options.intervals
    )
    lengths = longest * np.diff(nodes)
    stiff = float((lengths * np.interp(longest * nodes[:-1], seen[0].times, seen[0].poles)).max())
    return replace(
        options, grid=Graded(nodes=nodes, asked=options.intervals, added=(start.size, end.size), stiffness=stiff)
    )


def needs_grading(statement: Statement) -> bool:
    """Whether the cost sees what a matrix does on the way: only then does it matter how steep the ends are."""
    known = any(
        form is not None and (block.estimation or block.backward)
        for block, form in zip(statement.matrices, statement.riccati, strict=True)
    )
    return (
        known
        and not statement.coupled
        and (statement.loop is not None or statement.running_uses_matrices or bool(statement.summed))
    )


def _guess(statement: Statement, options: Options, parameters: Array) -> Trajectory:
    """The nominal of the first guess on a few intervals; where the end asks for none, its start throughout."""
    nodes = np.linspace(0.0, 1.0, min(COARSE, options.intervals) + 1)
    mesh = Mesh(
        nodes=nodes,
        control=options.control,
        substeps=1,
        segments=(nodes.size - 1,),
        eliminated=True,
        step="gauss",
        readings=np.zeros((statement.readings, nodes.size - 1)),
    )
    if _varies(statement):
        stiff = stiffness(statement, replace(options, grid=nodes), parameters)
        implicit = choose_step(statement, replace(options, substeps="auto"), stiff) == "rodas"
        substeps = IMPLICIT_SUBSTEPS if implicit else explicit_substeps(stiff.nominal)
        mesh = replace(mesh, substeps=substeps, step="rodas" if implicit else "gauss")
        return own_start(statement, mesh, parameters).trajectory
    x0, e0 = starts(statement, mesh, parameters)
    count = np.ones((nodes.size, 1))
    u = controls_guess(statement, nodes, options.control)
    return Trajectory(x=count * x0, u=u, e=count * e0, duration=statement.duration.guess)


def _varies(statement: Statement) -> bool:
    """Whether what runs backward depends on state or control: then the end of the guess must be known."""
    return any(map(statement.varies, statement.behind)) or (
        statement.matrix_end is not None and bool(statement.matrix_end.jac_sparsity(0, 0).nnz())
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Steepness:
    """How fast a Riccati solution changes in what it matters, near one end of the time.

    times: distances from the end [s], rising from 0; rates [1/s] there; poles: 2 rho(F - E W) there [1/s].
    """

    times: Array
    rates: Array
    poles: Array

    __repr__ = short_repr

    def parts(self) -> Array:
        """Integral of rate / CHANGE from the end to each of the times."""
        t, r = self.times, self.rates
        growth = 0.5 * (r[1:] + r[:-1]) * np.diff(t)
        return np.asarray(np.concatenate([[0.0], np.cumsum(growth)]) / CHANGE)


def _steepness(
    statement: Statement, guess: Trajectory, parameters: Array, interval: float, backward: bool
) -> _Steepness:
    """Of the matrices that run in one direction, along the guess; zero where there are none."""
    inside = interval * np.geomspace(FIRST_POINT, 1.0, int(-np.log(FIRST_POINT) / np.log(POINT_RATIO)) + 2)
    reach = min(REACH, round(guess.duration / interval))
    times = np.concatenate([[0.0], inside, interval * np.arange(1.5, reach + 0.1, 0.5)])
    rates, poles = np.zeros(times.size), np.zeros(times.size)
    for block, form in zip(statement.matrices, statement.riccati, strict=True):
        if form is not None and block.backward == backward and (block.estimation or block.backward):
            first = _first_value(statement, guess, parameters, block)
            forms = _forms(form, guess, parameters, times, backward)
            values = _passage(first, forms, times)
            rates = np.maximum(rates, _changes(values, forms))
            drift = forms[0] - values @ forms[2]
            poles = np.maximum(poles, 2 * np.abs(np.linalg.eigvals(drift)).max(axis=1, initial=0.0))
    return _Steepness(times=times, rates=rates, poles=poles)


def _first_value(statement: Statement, guess: Trajectory, parameters: Array, block: Expr) -> Array:
    """E(0), or S(T) along the guess."""
    if not block.backward:
        return unpack(guess.e[0, block.span], block.size)
    assert statement.matrix_end is not None
    ends = np.asarray(statement.matrix_end(guess.x[-1], guess.duration, parameters).full()).ravel()
    offset = sum(statement.matrices[i].length for i in statement.behind if statement.matrices[i].offset < block.offset)
    return unpack(ends[offset : offset + block.length], block.size)


def _forms(
    form: Expr, guess: Trajectory, parameters: Array, times: Array, backward: bool
) -> tuple[Array, Array, Array]:
    """F, Q, W in the direction of travel at some distances from the end, along the guess; (points, n, n) each."""
    duration = guess.duration
    s = np.clip(times / duration, 0.0, 1.0)
    s = 1.0 - s if backward else s
    own = np.linspace(0.0, 1.0, guess.x.shape[0])
    at = own if guess.u.shape[0] == own.size else 0.5 * (own[1:] + own[:-1])
    x, u = (interpolated(values, nodes, s).T for nodes, values in ((own, guess.x), (at, guess.u)))
    values = form.map(s.size)(x, u, (duration * s)[None, :], *repeated(duration, parameters, s.size))
    sign = -1.0 if backward else 1.0
    result = [sign * stacked(v, s.size) for v in values]
    return tuple(np.nan_to_num(v, nan=0.0, posinf=0.0, neginf=0.0) for v in result)  # type: ignore[return-value]


def _passage(first: Array, forms: tuple[Array, Array, Array], times: Array) -> Array:
    """A Riccati solution at all times from its first value, by the two-stage Gauss method."""
    F, Q, W = forms
    size, count = first.shape[0], times.size
    generator = np.block([[-F.transpose(0, 2, 1), W], [Q, F]])
    h = np.diff(times)[:, None, None] * 0.5 * (generator[1:] + generator[:-1])
    square, unit = h @ h / 12, np.eye(2 * size)
    values = np.zeros((count, size, size))
    values[0] = first
    try:
        for k in range(count - 1):
            D = np.linalg.solve(unit - h[k] / 2 + square[k], unit + h[k] / 2 + square[k])
            values[k + 1] = covariance_after(D, values[k])
    except np.linalg.LinAlgError:  # what comes after the point that cannot be stepped from counts as settled
        pass
    values[~np.isfinite(values).all(axis=(1, 2))] = 0.0
    return values


def _changes(E: Array, forms: tuple[Array, Array, Array]) -> Array:
    """Largest of min(lambda, |r|) over the directions in which E and E W E are diagonal together, at each point."""
    F, Q, W = forms
    product = F @ E
    rate = product + product.transpose(0, 2, 1) + Q - E @ W @ E
    units = np.sqrt(np.maximum(np.diagonal(E, axis1=1, axis2=2), 0.0))
    units = np.where(units > 0, units, 1.0)
    pairs = units[:, :, None] * units[:, None, :]
    values, vectors = np.linalg.eigh(E / pairs)
    known = values <= KNOWN * np.maximum(values[:, -1:], np.finfo(float).tiny)
    roots = np.where(known, 0.0, np.sqrt(np.where(known, 1.0, values)))
    root = vectors * roots[:, None, :]
    inverse = vectors * np.where(known, 0.0, 1.0 / np.where(known, 1.0, roots))[:, None, :]
    lambdas, directions = np.linalg.eigh(root.transpose(0, 2, 1) @ (W * pairs) @ root)
    y = inverse @ directions
    relative = np.abs(np.einsum("tik,tij,tjk->tk", y, rate / pairs, y))
    return np.asarray(np.minimum(np.maximum(lambdas, 0.0), relative).max(axis=1, initial=0.0))


def _parts(steepness: _Steepness, intervals: int, longest: float) -> Array:
    """Nodes to add near one end, as distances from it [s]: the base intervals divided while they must be."""
    h = longest / intervals
    parts, times = steepness.parts(), steepness.times
    nodes: list[float] = []
    for k in range(min(REACH, intervals)):
        if (k + 1) * h > times[-1] * (1 + 1e-12):
            break
        inside = (times >= k * h * (1 - 1e-12)) & (times <= (k + 1) * h * (1 + 1e-12))
        own, at = parts[inside], times[inside]
        asked = float(own[-1] - own[0])
        if not asked > DIVIDED:
            break
        count = int(np.clip(np.ceil(asked), 2, MOST_PARTS))
        levels = own[0] + asked * np.arange(1, count) / count
        nodes += np.interp(levels, own, at).tolist()
    chosen = np.array(nodes)
    return chosen[chosen >= SHORTEST * longest]
