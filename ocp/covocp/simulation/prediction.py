"""What linear theory predicts for a simulation: covariances of the deviations and of their estimates, and their means.

With d the deviation of the actual system from the nominal and y its estimate, both over the augmented state, slopes of
the actual system marked by a and those of the design without a mark, and u - C y as control (Schmidt 1971, appendix A
and 6.11, for any truth):

    dd = (Fa d - Ga C y + fa - f) dt + dn,
    dy = ((F - K M) y - (G - K hu) C y + K (Ma d - hau C y + ha - h)) dt + K dv.

All of the actual system is taken at the nominal state and at the true means of the unknowns: fa - f and ha - h then
contain what another mean does, so its part of d, which stands in the mean of d too, is taken off again.

Where something is read at an instant y jumps by K (Ha d - (H + (hau - hu) C) y + ha - h + v).

Where the truth is the design, the covariance of d is E + Xhat of (A-31 .. 33) and that of y - d is E. It is d and y - d
that are integrated: the difference of a large d and a y that follows it would be roundoff.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.quadrature import classical_step
from covocp.base.short_repr import short_repr
from covocp.simulation.actual import System
from covocp.simulation.schedule import (
    Grid,
    Nominal,
    by_rows,
    coefficients,
    indices,
    nominal_at,
    readings_of,
    table,
)
from covocp.solution.solution import Solution

# Length of a step times the fastest rate: classical Runge-Kutta then errs by less than 1e-6.
STEP_PER_RATE = 0.1
# Steps of the prediction within one interval of the base grid, at most; where they would be more, and at one end the
# rate is less by this factor, the interval is halved, down to pieces of so few steps: a filter that begins with a large
# variance and an accurate sensor is faster there by orders of magnitude, and only there.
MOST_PARTS = 2000
# Length of a step times the fastest rate up to which classical Runge-Kutta is used: it is stable up to 2.78.
STABLE = 2.0
STEEP, FEW_PARTS = 2.0, 16


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """Mean (K, 2n) and covariance (K, 2n, 2n) of deviation and estimate, stacked, at some times.

    rates: fastest rate of filter, loop and plant in each interval between these times [1/s], (K - 1,).
    step_rates: what a step must resolve: the fastest rate of plant and loop, and that of the filter at its slower end
        of the interval, because a transient of the filter is stepped as a whole.
    """

    mean: Array
    covariance: Array
    rates: Array
    step_rates: Array

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """Rows n of the augmented state."""
        return int(self.mean.shape[1]) // 2

    @property
    def deviation(self) -> Array:
        """Mean square of the deviation about the nominal, X + mean mean', (K, n, n)."""
        return self._about_nominal(np.hstack([np.eye(self.size), np.zeros((self.size, self.size))]))

    @property
    def error(self) -> Array:
        """Mean square of the error of the estimate, E where the truth is the design, (K, n, n)."""
        return self._about_nominal(np.hstack([-np.eye(self.size), np.eye(self.size)]))

    @property
    def estimate(self) -> Array:
        """Mean square of the estimate of the deviation, (K, n, n)."""
        return self._about_nominal(np.hstack([np.zeros((self.size, self.size)), np.eye(self.size)]))

    def at(self, rows: Given) -> Prediction:
        """The prediction at some of its times; the fastest rates stay those of all intervals."""
        return replace(self, mean=self.mean[rows], covariance=self.covariance[rows])

    def _about_nominal(self, chosen: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore"):
            mean = self.mean @ chosen.T
            return np.asarray(chosen @ self.covariance @ chosen.T + mean[:, :, None] * mean[:, None, :])


def predict(
    solution: Solution, design: System, actual: System, grid: Grid, start: tuple[Array, Array] | None = None
) -> Prediction:
    """Integrate mean and covariance along the nominal by classical Runge-Kutta steps, implicit where few can be.

    Args:
        solution: whose nominal, filter and feedback are used.
        design: what they assume.
        actual: what is simulated.
        grid: times of the result; the steps of the integration divide its steps.
        start: mean (2n,) and covariance (2n, 2n) of deviation and estimate; None: those of the actual system, the
            filter at the mean.
    """
    n = design.size
    joint = _joint(design, actual)
    parts = grid.parts(np.inf)
    resolving = grid.divided(parts)
    rates, step_rates = _fastest_rates(solution, joint, resolving, actual, n)
    fine, resolved = _graded(
        resolving, rates, lambda t, interval: _fastest(_evaluate(solution, joint, t, interval, actual, n)[0])
    )
    first = np.cumsum(parts) - parts  # of the parts of each step of the grid
    rates, step_rates = (np.maximum.reduceat(values, first) for values in (rates, step_rates))
    parts = fine.parts(STEP_PER_RATE / np.maximum(resolved, 1e-300), MOST_PARTS)
    fine = fine.divided(parts)
    stiff = fine.h * np.repeat(resolved, parts) > STABLE
    kept = {int(k) for k in indices(fine, grid.t)}
    jumps = _jumps(solution, design, actual, fine)
    sides = [_evaluate(solution, joint, fine.t[:-1] + c * fine.h, fine.interval, actual, n) for c in (0.0, 0.5, 1.0)]
    mean = np.concatenate([design.error(actual.start), np.zeros(n)])
    covariance = np.zeros((2 * n, 2 * n))
    covariance[:n, :n] = actual.variance
    if start is not None:
        mean, covariance = start
    unit, none = np.eye(n), np.zeros((n, n))
    to_error, from_error = (np.block([[unit, none], [sign * unit, unit]]) for sign in (-1.0, 1.0))
    mean, covariance = to_error @ mean, to_error @ covariance @ to_error.T
    means, covariances = [mean], [covariance]
    with np.errstate(over="ignore", invalid="ignore"):  # gains that the mesh does not resolve: the verdict says it
        for k, h in enumerate(fine.h.tolist()):
            if k in jumps:
                transition, noise, offset = jumps[k]
                mean, covariance = transition @ mean + offset, transition @ covariance @ transition.T + noise
            else:
                step = _implicit_step if stiff[k] else _step
                mean, covariance = step(mean, covariance, h, [tuple(part[k] for part in side) for side in sides])
            if k + 1 in kept:
                means.append(mean)
                covariances.append(covariance)
        means_of, covariances_of = np.array(means) @ from_error.T, from_error @ np.array(covariances) @ from_error.T
    return Prediction(mean=means_of, covariance=covariances_of, rates=rates, step_rates=step_rates)


def control_spread(solution: Solution, design: System, prediction: Prediction, nominal: Nominal) -> Array:
    """Mean square of the deviation of the controls fed back, C <y y'> C', (K, m, m), at the times of the prediction."""
    loop, count = design.statement.loop, nominal.t.size
    if loop is None:
        return np.zeros((count, 0, 0))
    gains = np.asarray(loop.gain.map(count)(*nominal.columns(solution.duration, solution.parameters)).full())
    C = gains.reshape(design.fed_back, count, design.size).transpose(1, 0, 2)
    return np.asarray(C @ prediction.estimate @ C.transpose(0, 2, 1))


def _joint(design: System, actual: System) -> ca.Function:
    """(design's six arguments, parameters of the truth) -> drift, noise (2n, 2n), offset (2n,) of (d, y - d)."""
    st, other = design.statement, actual.statement
    symbolic: Any = ca.SX if st.symbolic is ca.SX and other.symbolic is ca.SX else ca.MX
    sizes = (st.nx, st.nu, st.ne, 1, 1, st.np, other.np)
    x, u, e, t, T, p, q = a = [symbolic.sym(f"a{i}", k) for i, k in enumerate(sizes)]
    chosen = coefficients(design, "perturbation")
    c = chosen.split(chosen.function(x, u, e, t, T, p, 0, symbolic.zeros(st.readings)))
    f, F, G, Q, h, M, Hu, U = actual.model(x[: other.nx], u[: other.nu], t, T, q)
    C, K = c["C"], c["K"]
    rate = design.model(x, u, t, T, p).rate
    other_control = ((G - c["G"]) + K @ (c["Hu"] - Hu)) @ C
    wrong = K @ (M - c["M"]) + (c["F"] - F) + other_control
    drift = ca.blockcat([[F - G @ C, -G @ C], [wrong, c["F"] - K @ c["M"] + other_control]])
    noise = ca.blockcat([[Q, -Q], [-Q, Q + K @ U @ K.T]])
    known = ca.DM(np.concatenate([np.zeros(design.states), design.error(actual.start)[design.states :]]))
    moved = f - rate - F @ known
    offset = ca.vertcat(moved, K @ (h - c["h"] - M @ known) - moved)
    return ca.Function("joint", a, [ca.densify(value) for value in (drift, noise, offset)])


def _jumps(solution: Solution, design: System, actual: System, grid: Grid) -> dict[int, tuple[Array, Array, Array]]:
    """Transition (2n, 2n), noise (2n, 2n) and offset (2n,) of the steps of a grid at which something is read."""
    steps = np.flatnonzero(grid.share)
    if not design.sampled or not steps.size:
        return {}
    chosen, n = coefficients(design, "perturbation"), design.size
    function = _read_jump(design, actual)
    before, _ = table(solution, grid, chosen)
    nominal = nominal_at(solution, grid.t, np.append(grid.interval, grid.interval[-1]))
    read = readings_of(solution, grid)
    result = {}
    for k in steps:
        u = nominal_at(solution, grid.t[k : k + 1], grid.interval[k : k + 1]).u[0]
        at = (nominal.x[k], u, before[k], grid.t[k], solution.duration, read[:, k], actual.parameters)
        values = [np.asarray(v.full()) for v in function(*at)]
        result[int(k)] = (values[0].reshape(2 * n, 2 * n), values[1].reshape(2 * n, 2 * n), values[2].ravel())
    return result


def _read_jump(design: System, actual: System) -> ca.Function:
    """(x, u, coefficients, t, T, reading, parameters of the truth) -> transition, noise, offset of (d, y - d)."""
    st, other, n = design.statement, actual.statement, design.size
    symbolic: Any = ca.SX if st.symbolic is ca.SX and other.symbolic is ca.SX else ca.MX
    chosen = coefficients(design, "perturbation")
    sizes = (st.nx, st.nu, chosen.rows, 1, 1, st.readings, other.np)
    x, u, column, t, T, reading, q = a = [symbolic.sym(f"a{i}", k) for i, k in enumerate(sizes)]
    c = chosen.split(column)
    own = actual.read(x[: other.nx], u[: other.nu], t, T, q)
    K, taken = c["Kr"], by_rows(st, reading)
    seen = own.H
    expected = c["Hr"] + (own.Hu - c["Hru"]) @ c["C"]
    none, unit = symbolic.zeros(n, n), symbolic.eye(n)
    share = ca.if_else(taken > 0, 1 / ca.sqrt(ca.fmax(taken, 1e-9)), 0)
    noise = K @ (ca.diag(share) @ own.R @ ca.diag(share)) @ K.T
    known = ca.DM(np.concatenate([np.zeros(design.states), design.error(actual.start)[design.states :]]))
    transition = ca.blockcat([[unit, none], [K @ (seen - expected), unit - K @ expected]])
    offset = ca.vertcat(symbolic.zeros(n), K @ (own.h - c["hr"] - seen @ known))
    values = [ca.densify(v) for v in (transition, ca.blockcat([[none, none], [none, noise]]), offset)]
    return ca.Function("read_jump", a, values)


def _evaluate(
    solution: Solution, joint: ca.Function, t: Array, interval: Given, actual: System, n: int
) -> tuple[Array, Array, Array]:
    """Drift (K, 2n, 2n), noise (K, 2n, 2n) and offset (K, 2n) at some times."""
    columns = nominal_at(solution, t, interval).columns(solution.duration, solution.parameters)
    own = np.tile(actual.parameters[:, None], (1, t.size))
    drift, noise, offset = (np.asarray(v.full()) for v in joint.map(t.size)(*columns, own))
    shaped = [v.reshape(2 * n, t.size, 2 * n).transpose(1, 0, 2) for v in (drift, noise)]
    return shaped[0], shaped[1], offset.T


def _step(mean: Array, covariance: Array, h: float, sides: list[tuple[Array, ...]]) -> tuple[Array, Array]:
    """One Runge-Kutta step of mean' = A mean + b and P' = A P + P A' + Q."""

    def rate(both: Array, c: float) -> Array:
        (drift, noise, offset), (mean, covariance) = sides[round(2 * c)], (both[:, 0], both[:, 1:])
        moved = drift @ covariance
        return np.column_stack([drift @ mean + offset, moved + moved.T + noise])

    after = classical_step(rate, np.column_stack([mean, covariance]), h)
    return after[:, 0], after[:, 1:]


def _implicit_step(mean: Array, covariance: Array, h: float, sides: list[tuple[Array, ...]]) -> tuple[Array, Array]:
    """One implicit Euler step of the same: what is much faster than it has died away at its end."""
    drift, noise, offset = sides[-1]
    moves = np.linalg.inv(np.eye(mean.size) - h * drift)
    return moves @ (mean + h * offset), moves @ (covariance + h * noise) @ moves.T


def _fastest_rates(solution: Solution, joint: ca.Function, grid: Grid, actual: System, n: int) -> tuple[Array, Array]:
    """`Prediction.rates` and `Prediction.step_rates` of each step of a grid, (N,)."""
    sides = [_evaluate(solution, joint, t, grid.interval, actual, n)[0] for t in (grid.t[:-1], grid.t[1:])]
    if not all(np.isfinite(side).all() for side in sides):
        raise ProblemError(
            "The loop of this solution becomes NaN or inf along its nominal.",
            expected="finite dynamics, gains and noise densities",
            received=f"'{solution.name}': {solution.status}",
            remedy="simulate a solution that converged, or mend the truth",
        )
    whole = [_fastest(side) for side in sides]
    # With an estimate that is right the deviation goes by F - G C.
    plant = [_fastest(matrix) for side in sides for matrix in (side[:, :n, :n], side[:, :n, :n] - side[:, :n, n:])]
    return np.maximum(*whole), np.max([*plant, np.minimum(*whole)], axis=0)


def _graded(grid: Grid, rates: Array, fastest: Callable[[Array, Given], Array]) -> tuple[Grid, Array]:
    """Steps that are halved towards where the rate is highest, and the fastest rate in each.

    Args:
        grid: whose steps are halved.
        rates: fastest rate in each of them [1/s].
        fastest: (times, interval of the mesh of each) -> the rate there.
    """
    steep: NDArray[np.bool_] = grid.h * rates > STEP_PER_RATE * MOST_PARTS
    before, after = rates.copy(), rates.copy()
    chosen = np.flatnonzero(steep)
    if chosen.size:
        before[chosen], after[chosen] = (fastest(t[chosen], grid.interval[chosen]) for t in (grid.t[:-1], grid.t[1:]))
    while True:
        most, middle = np.maximum(before, after), grid.t[:-1] + 0.5 * grid.h
        inside = (grid.t[:-1] < middle) & (middle < grid.t[1:])
        uneven = most > STEEP * np.minimum(before, after)
        split = steep & inside & uneven & (grid.h * most > STEP_PER_RATE * FEW_PARTS)
        if not split.any():
            return grid, most
        found = fastest(middle[split], grid.interval[split])
        counts = 1 + split
        first = np.flatnonzero(split) + np.arange(found.size)  # of each pair of halves
        grid, steep = grid.divided(counts), np.repeat(steep, counts)
        before, after = np.repeat(before, counts), np.repeat(after, counts)
        after[first], before[first + 1] = found, found


def _fastest(matrices: Array) -> Array:
    """Largest absolute eigenvalue of each of some matrices, (N,)."""
    return np.asarray(np.abs(np.linalg.eigvals(matrices)).max(axis=1))
