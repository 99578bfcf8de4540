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
from typing import Any, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.arguments import checked, one_of, optional, positive, whole
from covocp.blocks import peak_seeking
from covocp.models.excitation.flights import Flights as Flights
from covocp.models.excitation.flights import fly as fly
from covocp.models.excitation.paths import DURATION, NOISE, RADIUS, Path, scaled_variances
from covocp.models.excitation.paths import circle_and_back as circle_and_back
from covocp.models.excitation.paths import circling as circling
from covocp.models.excitation.paths import classical as classical
from covocp.models.excitation.paths import covariance as covariance

Array = npt.NDArray[np.float64]
Ends = Literal["rest", "free"]

BANDWIDTH = 0.166  # of the tracker of the formation: its slowest mode [1/s]
SMOOTHING = 0.05  # of the length at rest, as a share of the mean speed
WAVES = 4  # of a guess


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
    if begin is not None and (length is not None or ends != "rest"):
        raise co.ProblemError(
            "A path that is given has its own length and end.",
            expected="begin= without length= and ends=",
            received=f"length={length!r}, ends={ends!r}",
            remedy="leave them out, or leave begin= out",
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
    known = np.append(0.0, 1.0 / scaled_variances(inputs, prior, radius))
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
