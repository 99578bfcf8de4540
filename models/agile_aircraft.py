"""Agile aircraft with canard at high angle of attack: five states, bilinear in the angle; θ-D's test case.

M. Xin, S. N. Balakrishnan, "A new state observer and flight control of highly maneuverable aircraft", ACC 2009. Its
matrices are those of W. L. Garrard, D. F. Enns, S. A. Snell, Int. J. Control 56(4), 1992, 799-812, and not printed. The
ones here are fitted to longitudinal data of the same aircraft (S. A. Snell, PhD thesis, Univ. of Minnesota, 1991, in
polynomials of H.-Y. Kang), 10617 kg at 100 m/s and sea level. They trim level at 4.211 deg angle of attack (4.2 in the
paper), canard -4.527 deg, thrust 15423 N, which is constant. Least squares over eight angles from 4.2 to 43 deg leave
at most 0.54 m/s^2, 0.033 rad/s and 0.60 rad/s^2.

    dx/dt = (A_L + x_2 A_NL) x + B u,   y = (x_1, x_5),   J = 1/2 int x'Q x + R u^2 dt
    x = (speed [m/s], angle of attack [rad], pitch rate [rad/s], path angle [rad], canard [deg]), u = canard command
    [deg], all but pitch rate and path angle as differences from trim

Two scenarios: regulation from 30 deg of angle of attack, and a path angle that follows 0, 45, 0 deg. The paper mixes
degrees and radians; `units` says in which of them angle of attack and path angle (and its integral) are weighted. The
tracking shown in the paper needs "deg", and leaves the range of the model: the speed falls by more than 120 m/s.
Regulation, cost of the true state's feedback over the optimal cost, which is 261971.4 (rad) and 329136.3 (deg):

| law                               | rad    | deg    |
|-----------------------------------|--------|--------|
| linear-quadratic regulator of A_L | 1.160  | 1.065  |
| θ-D, k = 1, l = 0.01, three terms | 1.159  | 1.065  |
| θ-D, k = 0, two terms             | 1.0008 | 1.0023 |
| θ-D, k = 0, three terms           | 1.0041 | 1.0007 |
| θ-D, k = 0, four terms            | 1.0047 | 1.0009 |
| state-dependent Riccati equation  | 1.0048 | 1.0009 |
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.blocks import riccati

Array = npt.NDArray[np.float64]

STATES = ("speed", "alpha", "q", "gamma", "canard")
LINEAR = (
    (-0.028976, -18.432615, 0.0, -9.81, 0.0),
    (-0.001941, -1.411375, 1.0, 0.0, -0.000744),
    (0.0, 7.654461, -1.336661, 0.0, 0.099716),
    (0.001941, 1.411375, 0.0, 0.0, 0.000744),
    (0.0, 0.0, 0.0, 0.0, -20.0),
)  # A_L
BILINEAR = (
    (0.0, -49.64249, 0.0, 0.0, 0.0),
    (0.0, 1.117611, 0.0, 0.0, 0.000103),
    (0.0, 2.243327, 0.0, 0.0, -0.014095),
    (0.0, -1.117611, 0.0, 0.0, -0.000103),
    (0.0, 0.0, 0.0, 0.0, 0.0),
)  # A_NL
SPEED_COLUMN = (-0.893783, -0.007923, 0.182082, 0.007923, 0.0)  # of A_NL, where the speed derivatives are fitted too
INPUT = (0.0, 0.0, 0.0, 0.0, 20.0)  # B, 1/s
MEASURED = ("speed", "canard")
FACTOR, DECAY = 1.0, 0.01  # k_1 = k_2, l_1 = l_2 [1/s], of regulator and filter
CLIMB = float(np.deg2rad(45.0))  # rad
RISE_END, FALL_START, FALL_END = 5.0, 15.0, 20.0  # s; the paper does not give the first
HORIZON = 40.0  # s


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Weights and initial values; n = 5, with the integral of the path angle as sixth in Q where it is tracked."""

    start: Array
    """(5,)"""
    estimate: Array
    """Of the filter at the start, (5,)."""
    Q: Array
    R: float
    W: Array
    V: Array
    duration: float
    """[s]"""

    __repr__ = short_repr


class Matrices(NamedTuple):
    """A_L and A_NL, (5, 5), B, (5, 1), H, (2, 5)."""

    linear: Array
    bilinear: Array
    input: Array
    measured: Array


def matrices(speed_column: bool = False) -> Matrices:
    """A_L and A_NL, (5, 5), B, (5, 1), H, (2, 5).

    Args:
        speed_column: the variant whose A_NL has a first column.
    """
    bilinear = np.array(BILINEAR)
    if speed_column:
        bilinear[:, 0] = SPEED_COLUMN
    measured = np.eye(5)[[STATES.index(name) for name in MEASURED]]
    return Matrices(np.array(LINEAR), bilinear, np.array(INPUT)[:, None], measured)


def regulation(units: str = "rad", angle: float = 30.0) -> Scenario:
    """Scenario 1: back from an angle of attack, estimated 5 deg less.

    Args:
        units: "rad" or "deg", in which angles are weighted.
        angle: of attack at the start [deg].

    Raises:
        ProblemError: other units.
    """
    return _scenario(
        units,
        (80.0, 1.0, 1.0, 300.0, 1.0),
        300.0,
        0.1,
        np.array([0, angle, 0, 0, 0]),
        np.array([0, angle - 5, 0, 0, 0]),
    )


def tracking(units: str = "deg") -> Scenario:
    """Scenario 2: a path angle of 0, 45 and 0 deg (`path_command`), estimated 2 deg off as is the angle of attack.

    Args:
        units: "rad" or "deg", in which angles are weighted.

    Raises:
        ProblemError: other units.
    """
    return _scenario(units, (1.0, 1.0, 1.0, 100.0, 1.0, 200.0), 10.0, 0.01, np.zeros(5), np.array([0, 2.0, 0, 2.0, 0]))


def path_command(t: Any) -> tuple[Any, Any]:
    """Path angle to follow: up to 45 deg in 5 s, held to 15 s, back to 0 at 20 s.

    Args:
        t: a number, an array or a CasADi expression [s].

    Returns:
        The angle [rad] and its integral [rad s], like t.
    """
    angle: Any = 0.0
    integral: Any = 0.0
    for start, end, size in ((0.0, RISE_END, CLIMB), (FALL_START, FALL_END, -CLIMB)):
        since = (t - start) / (end - start)
        symbolic = isinstance(t, (ca.SX, ca.MX))
        within = ca.fmin(ca.fmax(since, 0.0), 1.0) if symbolic else np.clip(since, 0.0, 1.0)
        after = ca.fmax(since - 1.0, 0.0) if symbolic else np.maximum(since - 1.0, 0.0)
        angle = angle + size * within
        integral = integral + size * (end - start) * (0.5 * within**2 + after)
    return angle, integral


def problem(units: str = "rad", angle: float = 30.0, duration: float = HORIZON) -> co.Problem:
    """Scenario 1 as an optimal control problem, whose cost θ-D is measured against.

    The cost from the end on is that of the linear-quadratic regulator, 1/2 x(T)' T_0 x(T).

    Args:
        units: "rad" or "deg", in which angles are weighted.
        angle: of attack at the start [deg].
        duration: T [s], 40 or more for an infinite one.

    Returns:
        The problem, with states "speed" [m/s], "alpha" [rad], "q" [rad/s], "gamma" [rad] and "canard" [deg], all but q
        and gamma relative to trim, and control "command" [deg].

    Raises:
        ProblemError: other units, or a duration that is not positive.
    """
    scenario = regulation(units, angle)
    linear, bilinear, column, _ = matrices()
    final = np.asarray(riccati.continuous(linear, column, scenario.Q, scenario.R))
    ocp = co.Problem(duration=duration, name=f"agile aircraft, regulation from {angle:g} deg")
    states = [ocp.state(name, initial=float(value)) for name, value in zip(STATES, scenario.start, strict=True)]
    command = ocp.control("command")
    x = ca.vertcat(*states)
    rates = (ca.DM(linear) + x[1] * ca.DM(bilinear)) @ x + ca.DM(column) * command
    for state, rate in zip(states, ca.vertsplit(rates), strict=True):
        ocp.dynamics(state, rate)
    ocp.minimize(
        running=0.5 * (ca.bilin(ca.DM(scenario.Q), x, x) + scenario.R * command**2),
        terminal=0.5 * ca.bilin(ca.DM(final), x, x),
    )
    return ocp


def _scenario(units: str, weights: tuple[float, ...], R: float, V: float, start: Array, estimate: Array) -> Scenario:
    """Weights in the units asked for; `start` and `estimate` in degrees."""
    if units not in ("rad", "deg"):
        raise co.ProblemError(
            "The angles are weighted in other units.\n"
            '  expected: units = "rad" or "deg"\n'
            f"  received: units = {units!r}\n"
            "  remedy:   correct units"
        )
    degree = 180.0 / np.pi if units == "deg" else 1.0
    scale = np.array([1.0, degree, 1.0, degree, 1.0, degree])
    return Scenario(
        start=np.deg2rad(start),
        estimate=np.deg2rad(estimate),
        Q=np.diag(np.array(weights) * scale[: len(weights)] ** 2),
        R=R,
        W=np.diag(scale[:5] ** -2),
        V=V * np.eye(2),
        duration=HORIZON if len(weights) == 5 else 30.0,
    )
