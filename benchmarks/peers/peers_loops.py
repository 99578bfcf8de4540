"""The closed loops of Schmidt 6.12 and chapter 7 in plain CasADi, for the peers: nothing here imports covocp.

Along the nominal dx/dt = f(x, u) run E forward and S backward,

    dE/dt = F E + E F' + Q - E W E,   W = M' U^-1 M,      -dS/dt = F' S + S F - C' B C,   C = B^-1 G' S,

and the expected cost is int L dt + 1/2 tr S(0) E(0) + 1/2 int tr(S Q + C' B C E) dt, (E-20). Everything is in units of
what is typical, because the numbers of chapter 7 span 22 orders of magnitude: x in units given below, E in units of
their products times d_i d_j, S in the inverse ones times s_i s_j, cost in a unit of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Mars entry: feet, radians, seconds, slugs; the logarithm of the density is the fifth state.
DURATION = 915.0
GRAVITY, RADIUS, BALLISTIC, SCALE_HEIGHT = 12.3, 11.0951e6, 1.023, 30000.0
START_DENSITY = 4.8e-5 * float(np.exp(-328000.0 / SCALE_HEIGHT))
START = np.array([328000.0, 0.0, 15000.0, -0.19, np.log(START_DENSITY)])
TARGETS = {0: 29600.0, 1: 0.5983}
VARIANCES = np.array([2.56e8, 2.56e8 / (RADIUS + START[0]) ** 2, 10.0, 4.44e-8, 8.55e-22 / START_DENSITY**2])
DENSITY_NOISE, ACCELEROMETER_NOISE = 4.5e-15, 0.02
END_WEIGHTS = np.array([1e-4 / 5280.0**2, 500.0, 0.0, 0.0, 0.0])
CONTROL_WEIGHT, REGULARIZATION, HALF_LIFT = 0.1, 1e-5, 0.5
UNITS = np.array([16000.0, 16000.0 / 11.1e6, 100.0, 0.01, 1.0])
REFERENCE_COST = 6.57e-4  # of constant lift


@dataclass(frozen=True, kw_only=True)
class Loop:
    """A closed loop in its units: `nx` nominal states, `n` augmented ones (nominal, then unknown constants)."""

    x: ca.SX  # (nx,)
    u: ca.SX  # scalar
    rate: ca.SX  # f(x, u), (nx,)
    F: ca.SX  # (n, n)
    G: ca.SX  # (n, 1)
    W: ca.SX  # (n, n)
    Q: ca.SX  # (n, n)
    running: ca.SX  # L, in units of the cost
    B: float  # in units of the cost
    start: Array  # x(0)
    E0: Array  # E(0), (n, n)
    end: Array  # S(T), (n, n)
    final: dict[int, float]  # entries of x(T) that are given
    duration: float  # s
    bounds: tuple[float, float]  # of the control
    guess: Callable[[Array], Array]  # control over the time in seconds
    d: Array  # unit of E_ij: d_i d_j
    s: Array  # unit of S_ij: s_i s_j
    cost: float  # unit of the cost

    @property
    def nx(self) -> int:
        """Number of nominal states."""
        return int(self.x.numel())

    @property
    def n(self) -> int:
        """Size of the covariance."""
        return int(self.E0.shape[0])


def mars() -> Loop:
    """Mars entry with the recommended data, w = 1e-5."""
    scaled, u = ca.SX.sym("x", 5), ca.SX.sym("u")
    h, _, v, gamma, log_density = ca.vertsplit(scaled * UNITS)
    sine, cosine, distance = ca.sin(gamma), ca.cos(gamma), RADIUS + h
    gravity = GRAVITY * (RADIUS / distance) ** 2
    drag = 0.5 * BALLISTIC * ca.exp(log_density) * v**2
    lift = drag * u
    rate = ca.vertcat(
        v * sine,
        v * cosine / distance,
        -gravity * sine - drag,
        (v / distance - gravity / v) * cosine + lift / v,
        -v * sine / SCALE_HEIGHT,
    )
    rate = rate / UNITS
    # [7.5-13]; the rotation into inertial axes drops out of M' U^-1 M, because U is a multiple of the identity.
    slope = ca.vertcat(ca.horzcat(0, lift, -2 * drag / v, -lift, -drag), ca.horzcat(0, drag, 2 * lift / v, -drag, lift))
    slope = slope @ np.diag(UNITS)
    noise = ca.SX(5, 5)
    noise[4, 4] = DENSITY_NOISE * ca.exp(-log_density) / UNITS[4] ** 2
    return Loop(
        x=scaled,
        u=u,
        rate=rate,
        F=ca.jacobian(rate, scaled),
        G=ca.jacobian(rate, u),
        W=slope.T @ slope / ACCELEROMETER_NOISE,
        Q=noise,
        running=0.5 * REGULARIZATION / REFERENCE_COST * (u - HALF_LIFT) ** 2,
        B=CONTROL_WEIGHT / REFERENCE_COST,
        start=START / UNITS,
        E0=np.diag(VARIANCES / UNITS**2),
        end=np.diag(END_WEIGHTS * UNITS**2 / REFERENCE_COST),
        final={i: value / UNITS[i] for i, value in TARGETS.items()},
        duration=DURATION,
        bounds=(0.0, 1.0),
        guess=lambda t: np.full(t.shape, HALF_LIFT),
        d=np.array([1.0, 1.0, 0.03, 0.05, 0.03]),
        s=np.array([1.0, 1.0, 8.0, 8.0, 25.0]),
        cost=REFERENCE_COST,
    )


def lag() -> Loop:
    """First-order lag with unknown inverse time constant b, section 6.12; well scaled as it is."""
    x, u, b = ca.SX.sym("x"), ca.SX.sym("u"), 1.0
    return Loop(
        x=x,
        u=u,
        rate=-b * x + u,
        F=ca.vertcat(ca.horzcat(-b, -x), ca.SX(1, 2)),
        G=ca.SX(ca.DM([1.0, 0.0])),
        W=ca.SX(ca.diag(ca.DM([1.0, 0.0]))),
        Q=ca.SX(ca.diag(ca.DM([1.0, 0.0]))),
        running=0.5 * u**2,
        B=1.0,
        start=np.zeros(1),
        E0=np.diag([1.0, 5.0]),
        end=np.diag([2.0, 0.0]),
        final={0: 1.0},
        duration=10.0,
        bounds=(-np.inf, np.inf),
        guess=lambda t: 2 * b * np.exp(b * (t - 10.0)) / (1 - np.exp(-2 * b * 10.0)),  # of least energy
        d=np.ones(2),
        s=np.ones(2),
        cost=1.0,
    )
