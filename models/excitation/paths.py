"""Paths around a command: of the paper and as designed, and the covariance of what they teach."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.arguments import checked, positive, whole
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.blocks import peak_seeking

Array = npt.NDArray[np.float64]

RADIUS = 0.7  # of the circle, and the unit of positions [m]
DURATION = 120.0  # of the circle [s]
NOISE = 10.0  # density U of the measured values: 10 counts at 10 Hz [counts^2 s]
HESSIAN_VARIANCE, GRADIENT_VARIANCE = 25.0, 900.0  # before [(counts/m^2)^2], [(counts/m)^2]


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """A path around the command, as a command history; K times.

    Attributes:
        t: (K,) [s].
        position: from the command, (K, n) [m].
    """

    t: Array
    position: Array

    __repr__ = short_repr

    @property
    def length(self) -> float:
        """Of the polygon through the positions [m]."""
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum())

    def at(self, t: Any) -> Any:
        """Positions at times, straight between those of the path and held outside.

        Args:
            t: a number or an array [s], or an expression (1, 1).

        Returns:
            (..., n) [m], of an expression (n, 1).
        """
        if isinstance(t, (ca.SX, ca.MX)):
            time = ca.SX.sym("t")
            inside: Any = ca.fmin(ca.fmax(time, self.t[0]), self.t[-1])
            columns: Any = [ca.pw_lin(inside, ca.DM(self.t), ca.DM(column)) for column in self.position.T]
            return ca.Function("path", [time], [ca.vertcat(*columns)])(t)
        return np.stack([np.interp(t, self.t, column) for column in self.position.T], axis=-1)

    def moved(self, offset: npt.ArrayLike) -> Path:
        """The same path about another point of expansion, (n,) [m] from the command."""
        return Path(t=self.t, position=self.position - np.asarray(offset, dtype=float))


@checked(inputs=whole(1, 2), radius=positive, duration=positive, step=positive)
def classical(inputs: int = 2, *, radius: float = RADIUS, duration: float = DURATION, step: float = 0.5) -> Path:
    """The excitation of the paper: a circle around the command, for one input a sine.

    Args:
        inputs: n.
        radius: of the circle, amplitude of the sine [m].
        duration: of one period [s].
        step: between its times, about [s].

    Returns:
        The path, in motion at both ends.

    Raises:
        ProblemError: an argument does not fit.
    """
    times = np.linspace(0.0, duration, max(2, round(duration / step) + 1))
    if inputs == 2:
        return Path(t=times, position=peak_seeking.circle(times, radius, duration))
    return Path(t=times, position=peak_seeking.sine(times, radius, duration)[:, None])


@checked(radius=positive, duration=positive, step=positive)
def circle_and_back(radius: float = RADIUS, duration: float = DURATION, step: float = 0.5) -> Path:
    """A circle that is flown from its centre and back to it, all at one speed.

    Args:
        radius: [m]; the length is 2 (pi + 1) radius.
        duration: of all of it [s].
        step: between its times, about [s].

    Returns:
        The path.

    Raises:
        ProblemError: an argument does not fit.
    """
    times = np.linspace(0.0, duration, max(2, round(duration / step) + 1))
    s = times / duration * 2.0 * (np.pi + 1.0)  # length in radii
    angle = np.clip(s - 1.0, 0.0, 2.0 * np.pi)
    distance = radius * np.minimum(1.0, np.minimum(s, 2.0 * (np.pi + 1.0) - s))
    return Path(t=times, position=distance[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1))


def circling(radius: float = RADIUS, duration: float = DURATION) -> dict[str, Any]:
    """The circle as what `problem` and `co.evaluate` take.

    Args:
        radius: [m].
        duration: [s].

    Returns:
        "begin": position and velocity at its start; "nominal": its acceleration as a function of s = t/T.
    """
    rate = 2.0 * np.pi / duration

    def acceleration(s: Array) -> Array:
        angle = 2.0 * np.pi * np.ravel(s)
        return -radius * rate**2 * np.stack([np.sin(angle), np.cos(angle)], axis=-1)

    return {"begin": [0.0, radius, radius * rate, 0.0], "nominal": {"acceleration": acceleration}}


@checked(noise=positive, radius=positive)
def covariance(
    flown: Path, *, noise: float = NOISE, prior: npt.ArrayLike | None = None, radius: float = RADIUS
) -> Array:
    """Covariance of (M r^2, b r) along a path, with f measured all the time and c unknown.

    Args:
        flown: the path.
        noise: U [f^2 s].
        prior: variances before, as for `problem`.
        radius: r [m].

    Returns:
        At the times of the path, (K, p, p) [f^2].

    Raises:
        ProblemError: an argument does not fit.
    """
    inputs = flown.position.shape[1]
    along = regressor_rows(flown.position / radius)
    rates = along[:, :, None] * along[:, None, :] / noise
    steps = np.diff(flown.t)[:, None, None]
    J = np.concatenate([0.0 * rates[:1], np.cumsum(0.5 * steps * (rates[1:] + rates[:-1]), axis=0)])
    J += np.diag(np.append(0.0, 1.0 / scaled_variances(inputs, prior, radius)))
    J[0, 0, 0] = 1.0  # nothing is measured yet: c and z are not connected
    known = J[:, 1:, 1:] - J[:, 1:, :1] * J[:, :1, 1:] / J[:, :1, :1]
    return np.asarray(np.linalg.inv(known))


def scaled_variances(inputs: int, prior: npt.ArrayLike | None, radius: float) -> Array:
    """Variances of (M r^2, b r) before, (p,).

    Raises:
        ProblemError: they are not p positive numbers.
    """
    layout = peak_seeking.parameters(inputs)
    hessians = layout.size - inputs
    usual = [HESSIAN_VARIANCE] * hessians + [GRADIENT_VARIANCE] * inputs
    variances = np.asarray(usual if prior is None else prior, dtype=float).ravel()
    if variances.shape != (layout.size,) or not (np.isfinite(variances).all() and (variances > 0).all()):
        raise co.ProblemError(
            "The variances before do not fit.",
            expected=f"prior = {layout.size} finite numbers > 0, of (M_11, .., b_{inputs})",
            received=f"{prior!r}"[:80],
            remedy="correct prior=",
        )
    return np.asarray(variances * unit_factors(inputs, radius) ** 2)


def unit_factors(inputs: int, radius: float) -> Array:
    """(r^2, .., r, ..): z = units * zeta, (p,)."""
    size = peak_seeking.parameters(inputs).size
    return np.repeat([radius**2, radius], [size - inputs, inputs])


def regressor_rows(y: Array) -> Array:
    """(1, h(y)') of positions in radii, (..., n) to (..., p + 1)."""
    flat = y.reshape(-1, y.shape[-1])
    regressor = ca.SX.sym("y", flat.shape[1])
    row = ca.Function("row", [regressor], [ca.vertcat(1, peak_seeking.regressor(regressor))])
    return np.asarray(row.map(len(flat))(flat.T).full().T.reshape(*y.shape[:-1], -1))
