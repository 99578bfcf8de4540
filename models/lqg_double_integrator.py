"""Double integrator under noise, measured in its position: regulator, filter and both together in closed form.

K. M. Passino, lecture notes on recursive least squares, the Kalman filter and LQG. Sampled at T = 0.5 s, a control and
a noise that are held over the sample:

    x+ = Phi x + Gamma u + Gamma1 w,   y = H x + v,   Phi = [1 T; 0 1],   Gamma = Gamma1 = [T^2/2; T],   H = [1 0]
    variances: R_w = 0.2 [m^2/s^4], R_v = 0.05 [m^2];   cost of a step: x'Q1 x + Q2 u^2, Q1 = diag(1, 0.1), Q2 = 0.4

| quantity                     | value, row by row                           |
|------------------------------|---------------------------------------------|
| M, before a measurement      | 0.08454367 0.08201941 0.08201941 0.12807764 |
| L, filter gain               | 0.62837346 0.60961180                       |
| P, after a measurement       | 0.03141867 0.03048059 0.03048059 0.07807764 |
| S, cost to go                | 2.89771131 1.27475488 1.27475488 1.57824709 |
| K, u = -K x                  | 1.00040881 1.44944797                       |
| average cost of a step, LQG  | 0.40347843                                  |

`sampled` holds these matrices, for `riccati.lqg`. `problem` poses the system that is sampled here in continuous time,
over a finite horizon: the noises are white with the densities R_w T and R_v T, and the cost is that of a second. Its
optimum is the regulator of the Riccati equation, along the trajectory without noise (certainty equivalence): `exact`.
With the defaults J = 4.71219870, of which 1.16829403 without noise.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

Array = npt.NDArray[np.float64]

STEP = 0.5  # T [s]
PROCESS_VARIANCE = 0.2  # R_w [m^2/s^4]
MEASUREMENT_VARIANCE = 0.05  # R_v [m^2]
STATE_WEIGHT = (1.0, 0.1)  # Q1, of position [1/m^2] and speed [s^2/m^2]
CONTROL_WEIGHT = 0.4  # Q2 [s^4/m^2]
# Gauss points of the integrals of `exact`: converged to rounding for durations of up to 20 s.
INTEGRATION_POINTS = 80


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """The sampled system; the fields are the arguments of `riccati.lqg`."""

    transition: Array
    B: Array
    H: Array
    noise: Array
    R: Array
    state_weight: Array
    control_weight: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Exact:
    """The optimum in closed form; histories have the shape of `t` first."""

    t: Array
    """[s]"""
    x: Array
    """Nominal position [m] and speed [m/s], (..., 2)."""
    u: Array
    """Nominal control [m/s^2]."""
    S: Array
    """Cost to go, (..., 2, 2)."""
    gain: Array
    """C of du = -C dx, (..., 1, 2)."""
    E: Array
    """Covariance of the estimate, (..., 2, 2)."""
    filter_gain: Array
    """E H'/U, (..., 2, 1)."""
    cost: float
    """Expected cost."""
    nominal_cost: float
    """What it would be without noise and with an exact initial estimate."""

    __repr__ = short_repr


def sampled(step: float = STEP) -> Sampled:
    """The sampled double integrator of the notes.

    Args:
        step: T [s].

    Returns:
        Its matrices, noises and weights.
    """
    push = np.array([[step**2 / 2], [step]])
    return Sampled(
        transition=np.array([[1.0, step], [0.0, 1.0]]),
        B=push,
        H=np.array([[1.0, 0.0]]),
        noise=PROCESS_VARIANCE * push @ push.T,
        R=np.array([[MEASUREMENT_VARIANCE]]),
        state_weight=np.diag(STATE_WEIGHT),
        control_weight=np.array([[CONTROL_WEIGHT]]),
    )


def problem(
    duration: float = 10.0,
    position: float = 1.0,
    speed: float = 0.0,
    initial_variance: float = 0.1,
    process_noise: float = PROCESS_VARIANCE * STEP,
    measurement_noise: float = MEASUREMENT_VARIANCE * STEP,
) -> co.Problem:
    """The double integrator in continuous time, with the expected cost over a finite horizon.

    Args:
        duration: [s].
        position: at the start [m].
        speed: at the start [m/s].
        initial_variance: of the estimates of position [m^2] and speed [m^2/s^2] at the start.
        process_noise: power spectral density of the acceleration [m^2/s^3].
        measurement_noise: power spectral density of the measured position [m^2 s].

    Returns:
        The problem, with states "position" and "speed", control "u", measurement "y" and covariance "E".

    Raises:
        ProblemError: where a variance or density is negative, the measurement noise or the duration not positive.
    """
    ocp = co.Problem(duration, name="double integrator, regulator and filter")
    r = ocp.state("position", initial=position, variance=initial_variance, unit="m")
    v = ocp.state("speed", initial=speed, variance=initial_variance, unit="m/s")
    u = ocp.control("u", unit="m/s^2")
    ocp.dynamics(r, v)
    ocp.dynamics(v, u, noise=process_noise)
    ocp.measurement("y", r, noise=measurement_noise, unit="m")
    ocp.estimation_covariance()
    ocp.minimize_expected(running=STATE_WEIGHT[0] * r**2 + STATE_WEIGHT[1] * v**2 + CONTROL_WEIGHT * u**2)
    return ocp


def exact(
    duration: float = 10.0,
    position: float = 1.0,
    speed: float = 0.0,
    initial_variance: float = 0.1,
    process_noise: float = PROCESS_VARIANCE * STEP,
    measurement_noise: float = MEASUREMENT_VARIANCE * STEP,
    t: npt.ArrayLike | None = None,
) -> Exact:
    """The optimum by the exponentials of the two Hamiltonian matrices, those of regulator and filter.

    J = x'S x + tr(S E) at the start + the integral of tr(S Q) + tr(E K'R K), K = R^-1 B'S.

    Args:
        duration: [s]; the exponentials lose a digit every 2 s.
        position: at the start [m].
        speed: at the start [m/s].
        initial_variance: of both estimates at the start.
        process_noise: density of the acceleration [m^2/s^3].
        measurement_noise: density of the measured position [m^2 s].
        t: times in [0, duration], any shape; 101 of them by default.

    Returns:
        Histories and costs.
    """
    times = np.asarray(np.linspace(0.0, duration, 101) if t is None else t, dtype=float)
    A, B, H = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    Q, R, noise = np.diag(STATE_WEIGHT), CONTROL_WEIGHT, process_noise * B @ B.T

    def cost_to_go(at: Array) -> Array:
        return _riccati(A.T, Q, B @ B.T / R, np.zeros((2, 2)), duration - at)

    def covariance(at: Array) -> Array:
        return _riccati(A, noise, H.T @ H / measurement_noise, initial_variance * np.eye(2), at)

    start = np.array([position, speed])
    first = cost_to_go(np.zeros(()))
    hamiltonian = np.block([[A, -B @ B.T / R], [-Q, -A.T]])
    flow = _exponentials(hamiltonian, times) @ np.concatenate([start, first @ start])
    nodes, weights = np.polynomial.legendre.leggauss(INTEGRATION_POINTS)
    S, E = (history(duration * (nodes + 1) / 2) for history in (cost_to_go, covariance))
    losses = np.trace(S @ noise + E @ S @ B @ B.T @ S / R, axis1=-2, axis2=-1)
    nominal_cost = float(start @ first @ start)
    gain = B.T @ cost_to_go(times) / R
    return Exact(
        t=times,
        x=flow[..., :2],
        u=-(gain @ flow[..., :2, None])[..., 0, 0],
        S=cost_to_go(times),
        gain=gain,
        E=covariance(times),
        filter_gain=covariance(times) @ H.T / measurement_noise,
        cost=nominal_cost + initial_variance * float(np.trace(first)) + duration / 2 * float(weights @ losses),
        nominal_cost=nominal_cost,
    )


def _riccati(F: Array, Q: Array, W: Array, start: Array, times: Array) -> Array:
    """Solution of dE/dt = F E + E F' + Q - E W E at some times: E = Y X^-1, X' = -F'X + W Y, Y' = Q X + F Y."""
    flow = _exponentials(np.block([[-F.T, W], [Q, F]]), times) @ np.vstack([np.eye(2), start])
    solution = np.swapaxes(
        np.linalg.solve(np.swapaxes(flow[..., :2, :], -1, -2), np.swapaxes(flow[..., 2:, :], -1, -2)), -1, -2
    )
    return np.asarray(0.5 * (solution + np.swapaxes(solution, -1, -2)))


def _exponentials(matrix: Array, times: Array) -> Array:
    """exp(matrix t) at some times."""
    from scipy.linalg import expm

    return np.asarray(expm(matrix * times[..., None, None]))
