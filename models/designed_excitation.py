"""Designed excitation: the path along which gradient and Hessian of an unknown function become best known.

A peak seeker (`covocp.blocks.peak_seeking`) learns of a function by moving. J. J. Ryan, J. L. Speyer, "Peak-Seeking
Control Using Gradient and Hessian Estimates", ACC 2010, fly a circle around the command; here the path is chosen, which
is not in the literature. With positions y from the command, in units of a radius r, and the regressor h of the seeker,

    m = c + h(y)'z + v,  <v v'> = U delta,     z = (M r^2, b r) in units of f, c = f(command) unknown
    dJ/dt = g g' / U,  g = (1, h(y)),          J(0) = diag(0, 1 / variances of z)
    minimise the trace of the covariance of z, (J_zz - J_zc J_cz / J_cc)^-1, at the end

over the paths of at most a length in a given time, with limits of speed and acceleration. J is a symmetric matrix
state; its rate does not depend on it, so nothing in it is stiff, and nothing needs to be known of c. The length is the
integral of sqrt(|v|^2 + (0.05 V)^2), V = length / duration: smooth at rest, and never less than the true one.

Defaults: formation flight, f in counts of drag, a circle of 0.7 m in 120 s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.arguments import checked, one_of, optional, positive, whole
from covocp.base.short_repr import short_repr
from covocp.blocks import kalman, peak_seeking

Array = npt.NDArray[np.float64]
Ends = Literal["rest", "free"]

RADIUS = 0.7  # of the circle, and the unit of positions [m]
DURATION = 120.0  # of the circle [s]
NOISE = 10.0  # density U of the measured values: 10 counts at 10 Hz [counts^2 s]
HESSIAN_VARIANCE, GRADIENT_VARIANCE = 25.0, 900.0  # before [(counts/m^2)^2], [(counts/m)^2]
BANDWIDTH = 0.166  # of the tracker of the formation: its slowest mode [1/s]
SMOOTHING = 0.05  # of the length at rest, as a share of the mean speed
WAVES = 4  # of a guess
PERIOD = 10.0  # of the readings of a filter [s]
WINDOW = 15  # of the seeker
ROUGH_VALUE = 1e6  # variance of c for a filter that needs one [counts^2]


@checked(
    inputs=whole(1, 2),
    radius=positive,
    duration=positive,
    length=optional(positive),
    noise=positive,
    speed=optional(positive),
    acceleration=optional(positive),
    reach=optional(positive),
    ends=one_of("rest", "free"),
)
def problem(
    inputs: int = 2,
    radius: float = RADIUS,
    duration: float = DURATION,
    length: float | None = None,
    noise: float = NOISE,
    prior: npt.ArrayLike | None = None,
    speed: float | None = None,
    acceleration: float | None = None,
    reach: float | None = None,
    ends: Ends = "rest",
    begin: npt.ArrayLike | None = None,
) -> co.Problem:
    """The path of given length and time that makes Hessian and gradient at the command best known.

    `co.solve(problem(), covariances="states")` is the quick way: the matrix is a sum, its second derivatives are cheap.

    Args:
        inputs: n, 1 or 2.
        radius: r, unit of positions in the cost [m].
        duration: T [s].
        length: largest length of the path [m]; None: of a circle of the radius, for one input of a sine (4 r).
        noise: U, power spectral density of the noise of the measured values [f^2 s].
        prior: variances of (M_11, .., M_12, .., b_1, ..) before, (p,) [(f/m^2)^2, (f/m)^2]; None: 25 and 900.
        speed: largest speed [m/s]; None: twice length / duration.
        acceleration: largest acceleration, the bandwidth of the tracker [m/s^2]; None: 0.166/s times length / duration.
        reach: largest distance from the command [m]; None: any.
        ends: "rest": the path begins and ends at the command at rest; "free": anywhere, in motion.
        begin: position and velocity at the start, (2 n,) [m, m/s], for a path that is given; the end is free then.

    Returns:
        The problem, with states "position" [m], "velocity" [m/s], "length" [m], the matrix "information" J of
        (c, M r^2, b r), shape (p + 1, p + 1), [1/f^2], and control "acceleration" [m/s^2].

    Raises:
        ProblemError: an argument does not fit.
    """
    size = peak_seeking.parameters(inputs).size
    most = _length(inputs, radius) if length is None else float(length)
    mean = most / duration
    fastest, strongest = speed or 2.0 * mean, acceleration or BANDWIDTH * mean
    if fastest < mean and begin is None and length is not None:
        raise co.ProblemError(
            "The path cannot be so long at this speed.",
            expected=f"speed of at least length / duration = {mean:.3g} m/s",
            received=f"speed = {fastest:.3g} m/s",
            remedy="give a larger speed=, or a shorter length=",
        )
    first, last = _ends(inputs, ends, begin)
    ocp = co.Problem(duration, name=f"designed excitation, {inputs} input" + "s" * (inputs > 1))
    guess = start(inputs, 1, radius=radius, duration=duration)
    x = ocp.state("position", inputs, initial=first[0], final=last, scale=radius, guess=guess["position"], unit="m")
    v = ocp.state("velocity", inputs, initial=first[1], final=last, scale=mean, guess=guess["velocity"], unit="m/s")
    passed = ocp.state("length", initial=0.0, scale=most, unit="m")
    a = ocp.control("acceleration", inputs, scale=strongest, guess=guess["acceleration"], unit="m/s^2")
    ocp.dynamics(x, v)
    ocp.dynamics(v, a)
    ocp.dynamics(passed, mean * ca.sqrt(ca.sumsqr(v / mean) + SMOOTHING**2))
    known = np.append(0.0, 1.0 / _scaled(inputs, prior, radius))
    J = ocp.symmetric("information", size + 1, initial=np.diag(known))
    g = ca.vertcat(1, peak_seeking.regressor(x / radius))
    ocp.dynamics(J, g @ g.T / noise)
    if begin is None:
        ocp.subject_to(passed / most, upper=1.0, at="final", name="path length")
    ocp.subject_to(ca.sumsqr(v) / fastest**2, upper=1.0, name="speed")
    ocp.subject_to(ca.sumsqr(a) / strongest**2, upper=1.0, name="bandwidth")
    if reach is not None:
        ocp.subject_to(ca.sumsqr(x) / reach**2, upper=1.0, name="reach")
    ocp.minimize(terminal=ca.trace(ca.inv(J[1:, 1:] - J[1:, 0] @ J[0, 1:] / J[0, 0])))
    return ocp


def _length(inputs: int, radius: float) -> float:
    """Of one period of a circle, or of a sine along a line [m]."""
    return (2.0 * np.pi if inputs == 2 else 4.0) * radius


def _ends(inputs: int, ends: str, begin: npt.ArrayLike | None) -> tuple[tuple[Any, Any], Any]:
    """Initial position and velocity, and what both are at the end.

    Raises:
        ProblemError: the beginning has another size.
    """
    if begin is not None:
        numbers = np.asarray(begin, dtype=float).ravel()
        if numbers.shape != (2 * inputs,) or not np.isfinite(numbers).all():
            raise co.ProblemError(
                "The beginning of the path does not fit.",
                expected=f"begin = {2 * inputs} finite numbers: position [m], velocity [m/s]",
                received=f"{begin!r}"[:80],
                remedy="correct begin=",
            )
        return (numbers[:inputs], numbers[inputs:]), None
    return ((0.0, 0.0), 0.0) if ends == "rest" else ((None, None), None)


def _scaled(inputs: int, prior: npt.ArrayLike | None, radius: float) -> Array:
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
    return np.asarray(variances * _units(inputs, radius) ** 2)


def _units(inputs: int, radius: float) -> Array:
    """(r^2, .., r, ..): z = units * zeta, (p,)."""
    size = peak_seeking.parameters(inputs).size
    return np.repeat([radius**2, radius], [size - inputs, inputs])


@checked(inputs=whole(1, 2), seed=whole(0, None), radius=positive, duration=positive)
def start(
    inputs: int = 2, seed: int = 0, *, radius: float = RADIUS, duration: float = DURATION
) -> dict[str, Callable[[Array], Array]]:
    """A random smooth path to start a solver from: a sum of half waves, zero at both ends.

    Args:
        inputs: n.
        seed: of its four waves.
        radius: of which its waves are fractions [m].
        duration: T [s].

    Returns:
        "position" [m], "velocity" [m/s] and "acceleration" [m/s^2] as functions of s = t/T, (K, n), as
        `co.solve(guess=)` takes them.

    Raises:
        ProblemError: an argument does not fit.
    """
    heights = 0.35 * radius * np.random.default_rng(seed).normal(size=(WAVES, inputs))
    rates = np.pi * np.arange(1, WAVES + 1)

    def waves(wave: Callable[[Array], Array], factor: Any) -> Callable[[Array], Array]:
        return lambda s: wave(np.multiply.outer(np.ravel(s), rates)) * factor @ heights

    return {
        "position": waves(np.sin, np.ones(WAVES)),
        "velocity": waves(np.cos, rates / duration),
        "acceleration": waves(np.sin, -((rates / duration) ** 2)),
    }


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
            inside: Any = ca.fmin(ca.fmax(t, self.t[0]), self.t[-1])
            columns: Any = [ca.pw_lin(inside, ca.DM(self.t), ca.DM(column)) for column in self.position.T]
            return ca.vertcat(*columns)
        return np.stack([np.interp(t, self.t, column) for column in self.position.T], axis=-1)

    def moved(self, offset: npt.ArrayLike) -> Path:
        """The same path about another point of expansion, (n,) [m] from the command."""
        return Path(t=self.t, position=self.position - np.asarray(offset, dtype=float))


def path(solution: co.Solution, step: float = 0.5) -> Path:
    """The path of a solution as a command history.

    Args:
        solution: of `problem`.
        step: between its times, about [s].

    Returns:
        The path.
    """
    times = np.linspace(0.0, solution.duration, max(2, round(solution.duration / step) + 1))
    return Path(t=times, position=np.asarray(solution.at(times)["position"]).reshape(times.size, -1))


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
    rows = _rows(flown.position / radius)
    rates = rows[:, :, None] * rows[:, None, :] / noise
    steps = np.diff(flown.t)[:, None, None]
    J = np.concatenate([0.0 * rates[:1], np.cumsum(0.5 * steps * (rates[1:] + rates[:-1]), axis=0)])
    J += np.diag(np.append(0.0, 1.0 / _scaled(inputs, prior, radius)))
    J[0, 0, 0] = 1.0  # nothing is measured yet: c and z are not connected
    known = J[:, 1:, 1:] - J[:, 1:, :1] * J[:, :1, 1:] / J[:, :1, :1]
    return np.asarray(np.linalg.inv(known))


def _rows(y: Array) -> Array:
    """(1, h(y)') of positions in radii, (..., n) to (..., p + 1)."""
    flat = y.reshape(-1, y.shape[-1])
    regressor = ca.SX.sym("y", flat.shape[1])
    row = ca.Function("row", [regressor], [ca.vertcat(1, peak_seeking.regressor(regressor))])
    return np.asarray(row.map(len(flat))(flat.T).full().T.reshape(*y.shape[:-1], -1))


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
    variances, rng = _scaled(flown.position.shape[1], prior, radius), np.random.default_rng(seed)
    z = rng.normal(size=(runs, variances.size)) * np.sqrt(variances)
    c = 100.0 * rng.normal(size=runs)
    times = flown.t[0] + period * (np.arange(count)[:, None] + (np.arange(100) + 0.5) / 100)
    positions = np.asarray(flown.at(times))
    rows = _rows(positions / radius).mean(axis=1)
    values = rows @ np.column_stack([c, z]).T + np.sqrt(noise / period) * rng.normal(size=(count, runs))
    once, P = _used_once(rows, values, np.append(ROUGH_VALUE, variances), noise / period)
    units = _units(positions.shape[-1], radius)
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
