"""Filters flown along a path: what they find of functions drawn from the prior, and what they predict."""

from __future__ import annotations

from typing import Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.arguments import checked, positive, whole
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.blocks import kalman, peak_seeking
from covocp.models.excitation.paths import (
    NOISE,
    RADIUS,
    Path,
    covariance,
    regressor_rows,
    scaled_variances,
    unit_factors,
)

Array = npt.NDArray[np.float64]

PERIOD = 10.0  # of the readings of a filter [s]
WINDOW = 15  # of the seeker
ROUGH_VALUE = 1e6  # variance of c for a filter that needs one [counts^2]


@dataclass(frozen=True, kw_only=True, eq=False)
class Flights:
    """What filters make of readings along a path, of functions drawn from the prior; errors of (M r^2, b r) [f].

    Attributes:
        once: errors of a filter that uses each reading once, (runs, p).
        once_covariance: what it predicts, (p, p) [f^2].
        seeker: errors of the filter of `blocks.peak_seeking`, at the command, (runs, p).
        seeker_covariance: what it predicts, (p, p) [f^2].
        continuous: covariance for f measured all the time, the cost of `problem`, (p, p) [f^2].
    """

    once: Array
    once_covariance: Array
    seeker: Array
    seeker_covariance: Array
    continuous: Array

    __repr__ = short_repr

    def measured(self, name: Literal["once", "seeker"] = "once") -> tuple[float, float]:
        """Mean of the squared length of the errors of a filter, and its standard error [f^2]."""
        squares = np.sum((self.once if name == "once" else self.seeker) ** 2, axis=1)
        return float(squares.mean()), float(squares.std(ddof=1) / np.sqrt(squares.size))

    def __str__(self) -> str:
        """Predicted and measured."""
        predicted = (self.once_covariance, self.seeker_covariance)
        lines = [f"measured all the time: {np.trace(self.continuous):.3f}"]
        for name, label, P in zip(("once", "seeker"), ("each reading once", "peak seeker"), predicted, strict=True):
            mean, error = self.measured("once" if name == "once" else "seeker")
            lines.append(f"{label:<21}: predicted {np.trace(P):.3f}, measured {mean:.3f} +- {error:.3f}")
        return "\n".join(lines)


@checked(
    runs=whole(2, 10**6),
    seed=whole(0, None),
    noise=positive,
    radius=positive,
    period=positive,
    window=whole(1, 10**3),
)
def fly(
    flown: Path,
    *,
    runs: int = 2000,
    seed: int = 0,
    noise: float = NOISE,
    prior: npt.ArrayLike | None = None,
    radius: float = RADIUS,
    period: float = PERIOD,
    window: int = WINDOW,
) -> Flights:
    """Monte Carlo of the filters along a path: quadratic functions drawn from the prior, readings that are means.

    Args:
        flown: the path; a period that its end cuts off is not read.
        runs: number of functions.
        seed: of functions and noise.
        noise: U, so that a mean has the variance U / period [f^2 s].
        prior: variances before, as for `problem`; c is unknown.
        radius: r [m].
        period: of the readings, each the mean of position and value over it [s].
        window: N of the seeker, which takes the mean of the values for the value at the mean of the positions.

    Returns:
        Errors and what the filters predict.

    Raises:
        ProblemError: an argument does not fit, a path shorter than two periods.
    """
    count = int(np.floor((flown.t[-1] - flown.t[0]) / period + 1e-9))
    if count < 2:
        raise co.ProblemError(
            "The path is too short for readings.",
            expected="two periods or more",
            received=f"{flown.t[-1] - flown.t[0]:g} s of path, period = {period:g} s",
            remedy="give a longer path, or a shorter period=",
        )
    variances, rng = scaled_variances(flown.position.shape[1], prior, radius), np.random.default_rng(seed)
    z = rng.normal(size=(runs, variances.size)) * np.sqrt(variances)
    c = 100.0 * rng.normal(size=runs)
    times = flown.t[0] + period * (np.arange(count)[:, None] + (np.arange(100) + 0.5) / 100)
    positions = np.asarray(flown.at(times))
    rows = regressor_rows(positions / radius).mean(axis=1)
    values = rows @ np.column_stack([c, z]).T + np.sqrt(noise / period) * rng.normal(size=(count, runs))
    once, P = _used_once(rows, values, np.append(ROUGH_VALUE, variances), noise / period)
    units = unit_factors(positions.shape[-1], radius)
    sought, Q = _sought(positions.mean(axis=1), values, variances / units**2, noise / period, window)
    return Flights(
        once=once[:, 1:] - z,
        once_covariance=P[1:, 1:],
        seeker=sought * units - z,
        seeker_covariance=Q * np.outer(units, units),
        continuous=covariance(flown, noise=noise, prior=prior, radius=radius)[-1],
    )


def _used_once(rows: Array, values: Array, prior: Array, noise: float) -> tuple[Array, Array]:
    """Estimates of (c, z) of all runs, (runs, p + 1), and their covariance, by each reading once."""
    size, runs = prior.size, values.shape[1]
    x, P, y = ca.SX.sym("x", size), ca.SX.sym("P", size, size), ca.SX.sym("y")
    h = ca.SX.sym("h", size)
    new = kalman.update(x, P, y, h.T, ca.DM(noise))
    update = ca.Function("update", [x, P, y, h], [ca.densify(entry) for entry in new])
    mapped = update.map("all", "serial", runs, [1, 3], [])
    estimate, before = ca.DM.zeros(size, runs), ca.diag(ca.DM(prior))
    for row, value in zip(rows, values, strict=True):
        estimate, covariances = mapped(estimate, before, value[None], row)
        before = covariances[:, :size]  # the same in all runs
    return estimate.full().T, before.full()


def _sought(positions: Array, values: Array, prior: Array, noise: float, window: int) -> tuple[Array, Array]:
    """Parameters at the command that the seeker finds in all runs, (runs, p), and their covariance by its account."""
    inputs, runs = positions.shape[1], values.shape[1]
    law = peak_seeking.seeker(
        inputs,
        window,
        noise=noise,
        drift=0.0,
        prior=np.zeros(prior.size),
        prior_covariance=prior,
        newton="never",
        descent_gain=1.0,
    )
    memory, place, value = ca.SX.sym("memory", law.initial().size), ca.SX.sym("x", inputs), ca.SX.sym("f")
    step = ca.Function("step", [memory, place, value], [law.update(memory, place, value)])
    mapped = step.map("all", "serial", runs, [1], [])
    memories = ca.repmat(ca.DM(law.initial()), 1, runs)
    for position, reading in zip(positions, values, strict=True):
        memories = mapped(memories, position, reading[None])
    found = law.estimate(memories.full().T)
    _, moved = peak_seeking.transport(found.parameters[0], found.covariance[0], -positions[-1])
    back = found.parameters.copy()
    back[:, -inputs:] -= found.hessian @ positions[-1]
    return back, np.asarray(moved)
