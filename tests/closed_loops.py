"""Closed loops integrated from the covariance equations as they are printed: the truth that tests compare with.

Numpy and scipy only, full matrices, tight tolerances; Jacobians written by hand. Equation numbers are those of
G. T. Schmidt, Sc.D. thesis, M.I.T. 1971. `closed_loop` takes any `System`; the two of the thesis are `lag` (6.12) and
`mars` (chapter 7, with the logarithm of the density as state; `mars_in_density` as printed).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

RELATIVE = 1e-11  # tolerance of the integrations
ABSOLUTE = 1e-16  # of each entry against its scale: variances fall by eight orders of magnitude


@dataclass(frozen=True, kw_only=True)
class System:
    """The actual system dx = f dt + n, m = h + v with its statistics and cost; functions of (x, u), u a vector.

    F, G, M: slopes of rate and measurement; Q(x, u), U: noise densities; weights(x, u): A, B, N, the second derivatives
    of the running cost with the weights in place of missing ones; end: S(T); scale: typical deviations, for tolerances.
    """

    start: np.ndarray
    variance: np.ndarray
    rate: Callable
    F: Callable
    G: Callable
    M: Callable
    Q: Callable
    U: np.ndarray
    weights: Callable
    end: np.ndarray
    running: Callable = lambda x, u: 0.0
    terminal: Callable = lambda x: 0.0
    scale: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Loop:
    """Histories at the times `t` (time first) and costs of one loop."""

    t: np.ndarray
    x: np.ndarray
    u: np.ndarray
    E: np.ndarray
    S: np.ndarray
    Xhat: np.ndarray
    Z: np.ndarray
    C: np.ndarray
    K: np.ndarray
    gains: Callable
    """K and C at any time."""
    deterministic: float
    """k[x(T)] + int L dt."""
    feedback: float
    """Half the integral of tr(B C X C'), X the covariance of the estimate."""
    cost: float
    """(6.3-14), with the terms in Z of 6.11."""
    equivalent: float
    """(E-20) with X-hat(0) = 0; equal to `cost` for the design's own statistics and gains."""
    innovations: float
    """k + int L + 1/2 tr S(T) E(T) + 1/2 int tr(A E + S K U K'); equal to `cost` under the same conditions."""

    @property
    def X(self):
        """Covariance of the deviations of the actual system from the nominal."""
        return self.E + self.Xhat - self.Z - self.Z.transpose(0, 2, 1)

    @property
    def matrix_terms(self):
        """What the expected cost adds to the deterministic one."""
        return self.cost - self.deterministic

    def rms(self, index):
        """Terminal standard deviation of one component of the augmented state."""
        return float(np.sqrt(self.X[-1, index, index]))


class Piecewise:
    """Dense outputs one after the other, of all steps at once: most of the time is spent on looking values up."""

    def __init__(self, pieces):
        self.steps = sorted((step for piece in pieces for step in piece.interpolants), key=lambda step: step.t_min)
        self.ends = [step.t_max for step in self.steps[:-1]]

    def __call__(self, t):
        return self.steps[bisect_right(self.ends, t)](t)


def integrate(rate, start, times, tolerance):
    """Dense solution of dz/dt = rate(t, z) through the times, forward or backward, and its last value."""
    pieces, value = [], np.asarray(start, dtype=float)
    for begin, end in pairwise(times):
        # Evaluated a hair inside, so that a control that jumps at the break has the value of this piece.
        low, high = min(begin, end), max(begin, end)
        inside = 1e-12 * (high - low)

        def slope(t, z, low=low + inside, high=high - inside):
            return rate(min(max(t, low), high), z)

        run = solve_ivp(slope, (begin, end), value, method="DOP853", rtol=RELATIVE, atol=tolerance, dense_output=True)
        assert run.success, run.message
        pieces.append(run.sol)
        value = run.y[:, -1]
    return Piecewise(pieces), value


def nominal(system, control, duration, *, breaks: Sequence[float] = ()):
    """x(t) as a function of t, along the control u(t) (a callable) that is smooth between the breaks."""
    times = [0.0, *breaks, duration]
    return integrate(lambda t, x: system.rate(x, as_vector(control, t)), system.start, times, ABSOLUTE * system.scale)[
        0
    ]


def expansion(system, x, u):
    """F, G, M, A, B, N."""
    return (*(function(x, u) for function in (system.F, system.G, system.M)), *system.weights(x, u))


def nominal_and_filter(system, control, ends):
    """x and E of the design as one function of t, forward (2.5-3)."""
    n, U_inverse = system.start.size, np.linalg.inv(system.U)

    def rate(t, z):
        x, E, u = z[:n], z[n:].reshape(n, n), as_vector(control, t)
        F, M = system.F(x, u), system.M(x, u)
        E_rate = F @ E + E @ F.T + system.Q(x, u) - E @ M.T @ U_inverse @ M @ E
        return np.concatenate([system.rate(x, u), E_rate.ravel()])

    first = np.concatenate([system.start, system.variance.ravel()])
    square = np.outer(system.scale, system.scale)
    return integrate(rate, first, ends, ABSOLUTE * np.concatenate([system.scale, square.ravel()]))[0]


def cost_to_go(system, control, ends, forward):
    """S of the design as a function of t, backward along the nominal (6.3-20)."""
    n = system.start.size

    def rate(t, z):
        S = z.reshape(n, n)
        F, G, _, A, B, N = expansion(system, forward(t)[:n], as_vector(control, t))
        H = G.T @ S + N.T
        return (-F.T @ S - S @ F + H.T @ np.linalg.solve(B, H) - A).ravel()

    square = np.outer(system.scale, system.scale)
    tolerance = ABSOLUTE * max(float(np.abs(system.end * square).max()), 1e-300) / square
    return integrate(rate, system.end.ravel(), ends[::-1], tolerance.ravel())[0]


def loop_rates(system, actual, x, S, u, K, C, E, X, Z):
    """Rates of E, Xhat and Z with the true statistics (A-13 .. A-15), and the integrands of the costs."""
    F, G, M, A, B, N = expansion(system, x, u)
    Q, noise = actual.Q(x, u), K @ actual.U @ K.T
    estimator, controller = F - K @ M, F - G @ C
    dE = estimator @ E + E @ estimator.T + noise + Q
    dX = controller @ X + X @ controller.T - K @ M @ Z - (K @ M @ Z).T + noise
    dZ = estimator @ Z + Z @ controller.T - E @ M.T @ K.T + noise
    fed = np.trace(B @ C @ X @ C.T)
    cross = -2 * np.trace(N @ C @ X) + 2 * np.trace(N @ C @ Z.T)
    integrands = [
        system.running(x, u),
        0.5 * fed,
        0.5 * (np.trace(A @ (E + X - Z - Z.T)) + cross),
        0.5 * (np.trace(S @ Q) + np.trace(C.T @ B @ C @ E)),
        0.5 * (np.trace(A @ E) + np.trace(S @ noise)),
    ]
    return np.concatenate([dE.ravel(), dX.ravel(), dZ.ravel(), integrands])


def closed_loop(
    system: System,
    control: Callable,
    duration: float,
    *,
    truth: System | None = None,
    feedback: Callable | None = None,
    filter: Callable | None = None,
    breaks: Sequence[float] = (),
    times: np.ndarray | None = None,
) -> Loop:
    """Nominal, covariances and costs along a control history.

    Args:
        system: what filter and feedback are designed for.
        control: u(t), a number or a vector, smooth between the breaks.
        duration: T.
        truth: statistics of the actual system (`variance`, `Q`, `U`) where they are not the design's (6.11).
        feedback: gain C(t) in place of B^-1 (G' S + N').
        filter: gain K(t) in place of the Kalman gain of the design.
        breaks: increasing times inside (0, T) at which the control is not smooth.
        times: where histories are wanted; 101 of them by default.
    """
    n, m = system.start.size, as_vector(control, 0.0).size
    actual = truth or system
    ends = [0.0, *breaks, duration]
    square = np.outer(system.scale, system.scale)
    size = max(float(np.abs(system.end * square).max()), 1e-300)
    U_inverse = np.linalg.inv(system.U)
    forward = nominal_and_filter(system, control, ends)
    backward = cost_to_go(system, control, ends, forward)

    def at(t):
        """x, S and u, and the gains K and C."""
        ahead, S, u = forward(t), backward(t).reshape(n, n), as_vector(control, t)
        x, E = ahead[:n], ahead[n:].reshape(n, n)
        _, G, M, _, B, N = expansion(system, x, u)
        K = E @ M.T @ U_inverse if filter is None else np.atleast_2d(filter(t))
        return x, S, u, K, np.linalg.solve(B, G.T @ S + N.T) if feedback is None else np.atleast_2d(feedback(t))

    def gains(t):
        """K and C."""
        return at(t)[3:]

    def loop(t, z):
        return loop_rates(system, actual, *at(t), *z[: 3 * n * n].reshape(3, n, n))

    first = np.concatenate([actual.variance.ravel(), np.zeros(2 * n * n + 5)])
    tolerance = ABSOLUTE * np.concatenate([np.tile(square.ravel(), 3), np.full(5, size)])
    last, final = integrate(loop, first, ends, tolerance)
    E, X, Z = final[: 3 * n * n].reshape(3, n, n)
    running, fed, spread, equivalent, innovations = final[3 * n * n :]
    x_end, S_start = forward(duration)[:n], backward(0.0).reshape(n, n)
    deterministic = float(system.terminal(x_end) + running)

    t = np.linspace(0.0, duration, 101) if times is None else np.asarray(times, dtype=float)
    matrices = np.array([last(s)[: 3 * n * n].reshape(3, n, n) for s in t])
    K, C = (np.array(values) for values in zip(*(gains(s) for s in t), strict=True))
    return Loop(
        t=t,
        x=np.array([forward(s)[:n] for s in t]),
        u=np.array([as_vector(control, s) for s in t]).reshape(t.size, m),
        E=matrices[:, 0],
        S=np.array([backward(s).reshape(n, n) for s in t]),
        Xhat=matrices[:, 1],
        Z=matrices[:, 2],
        C=C,
        K=K,
        gains=gains,
        deterministic=deterministic,
        feedback=float(fed),
        cost=float(deterministic + fed + spread + 0.5 * np.trace(system.end @ (E + X - Z - Z.T))),
        equivalent=float(deterministic + equivalent + 0.5 * np.trace(S_start @ actual.variance)),
        innovations=float(deterministic + innovations + 0.5 * np.trace(system.end @ E)),
    )


def lower(matrix):
    """Half-vector: the columns of the lower triangle."""
    return np.concatenate([matrix[j:, j] for j in range(matrix.shape[0])])


def as_vector(control, t):
    """u(t) with shape (m,)."""
    return np.atleast_1d(np.asarray(control(t), dtype=float))


def piecewise_linear(nodes, values):
    """A control linear between nodes, and its breaks."""
    nodes, values = np.asarray(nodes, dtype=float), np.asarray(values, dtype=float)
    return lambda t: np.interp(t, nodes, values), tuple(nodes[1:-1].tolist())


def with_statistics(system, *, variance=None, Q=None, U=None):
    """The system with other statistics: E(0), a constant Q, U."""
    changes = {
        name: np.asarray(value, dtype=float) for name, value in (("variance", variance), ("U", U)) if value is not None
    }
    if Q is not None:
        changes["Q"] = lambda x, u: np.asarray(Q, dtype=float)
    return replace(system, **changes)


# --- first-order lag with unknown inverse time constant (6.12) --------------------------------------------------------


def lag(*, terminal_weight=2.0, parameter_variance=5.0, process_noise=1.0, measurement_noise=1.0, mean=1.0):
    """x = (x, b): dx/dt = -b x + u + n, m = x + v, L = u^2/2."""
    zero = np.zeros((2, 2))
    return System(
        start=np.array([0.0, mean]),
        variance=np.diag([1.0, parameter_variance]),
        rate=lambda x, u: np.array([-x[1] * x[0] + u[0], 0.0]),
        F=lambda x, u: np.array([[-x[1], -x[0]], [0.0, 0.0]]),
        G=lambda x, u: np.array([[1.0], [0.0]]),
        M=lambda x, u: np.array([[1.0, 0.0]]),
        Q=lambda x, u: np.diag([process_noise, 0.0]),
        U=np.array([[measurement_noise]]),
        weights=lambda x, u: (zero, np.eye(1), np.zeros((2, 1))),
        end=np.diag([terminal_weight, 0.0]),
        running=lambda x, u: 0.5 * u[0] ** 2,
        scale=np.ones(2),
    )


def least_energy(final=1.0, duration=10.0, b=1.0):
    """The control of quadratic synthesis: u = 2 b x(T) exp(b (t - T)) / (1 - exp(-2 b T))."""
    return lambda t: 2 * b * final * np.exp(b * (t - duration)) / (1 - np.exp(-2 * b * duration))


# --- Mars entry (chapter 7), feet, radians, seconds, slugs ------------------------------------------------------------

GRAVITY, RADIUS, BALLISTIC, SURFACE_DENSITY, SCALE_HEIGHT = 12.3, 11.0951e6, 1.023, 4.8e-5, 30000.0
START = (328000.0, 0.0, 15000.0, -0.19)  # h, theta, v, gamma
DENSITY_VARIANCE, DENSITY_NOISE = 8.55e-22, 4.5e-15  # recommended
ACCELEROMETER_NOISE = 0.02
MARS_WEIGHTS = (1e-4 / 5280.0**2, 500.0)  # of altitude and range


def flight(x, u, rho):
    """Rates of h, theta, v, gamma, and their slopes by those four, by the density and by the lift-to-drag ratio."""
    h, _, v, gamma = x[:4]
    sine, cosine, r = np.sin(gamma), np.cos(gamma), RADIUS + h
    g = GRAVITY * (RADIUS / r) ** 2
    half = 0.5 * BALLISTIC
    rates = [
        v * sine,
        v * cosine / r,
        -g * sine - half * rho * v**2,
        -g * cosine / v + v * cosine / r + half * rho * v * u,
    ]
    slopes = [
        [0, 0, sine, v * cosine],
        [-v * cosine / r**2, 0, cosine / r, -v * sine / r],
        [2 * g * sine / r, 0, -2 * half * rho * v, -g * cosine],
        [
            2 * g * cosine / (v * r) - v * cosine / r**2,
            0,
            g * cosine / v**2 + cosine / r + half * rho * u,
            (g / v - v / r) * sine,
        ],
    ]
    return np.array(rates), np.array(slopes), np.array([0, 0, -half * v**2, half * v * u]), half * rho * v


def accelerations(x, u, rho):
    """Slopes of the two accelerometers by h, theta, v, gamma and rho (7.5-13)."""
    along = -0.5 * BALLISTIC * rho * x[2] ** 2
    across = -along * u
    angle = x[1] - x[3]
    T = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    rows = [
        [0, across, 2 * along / x[2], -across, along / rho],
        [0, -along, 2 * across / x[2], along, across / rho],
    ]
    return T @ np.array(rows)


def mars(*, regularization=0.0, control_weight=0.1, density_variance=DENSITY_VARIANCE, density_noise=DENSITY_NOISE):
    """x = (h, theta, v, gamma, ln rho), u the lift-to-drag ratio; L = w (u - 1/2)^2 / 2."""
    rho_0 = SURFACE_DENSITY * np.exp(-START[0] / SCALE_HEIGHT)
    position = 2.56e8

    def rate(x, u):
        four, _, _, _ = flight(x, u[0], np.exp(x[4]))
        return np.append(four, -four[0] / SCALE_HEIGHT)

    def F(x, u):
        rho = np.exp(x[4])
        _, slopes, by_density, _ = flight(x, u[0], rho)
        result = np.zeros((5, 5), dtype=slopes.dtype)
        result[:4, :4], result[:4, 4] = slopes, by_density * rho
        result[4] = -result[0] / SCALE_HEIGHT
        return result

    def G(x, u):
        result = np.zeros((5, 1))
        result[3] = flight(x, u[0], np.exp(x[4]))[3]
        return result

    def M(x, u):
        rho = np.exp(x[4])
        return accelerations(x, u[0], rho) * np.array([1, 1, 1, 1, rho])

    def Q(x, u):
        return np.diag([0, 0, 0, 0, density_noise * np.exp(-x[4])])

    zero = np.zeros((5, 5))
    return System(
        start=np.array([*START, np.log(rho_0)]),
        variance=np.diag([position, position / (RADIUS + START[0]) ** 2, 10.0, 4.44e-8, density_variance / rho_0**2]),
        rate=rate,
        F=F,
        G=G,
        M=M,
        Q=Q,
        U=ACCELEROMETER_NOISE * np.eye(2),
        weights=lambda x, u: (zero, np.array([[control_weight]]), np.zeros((5, 1))),
        end=np.diag([*MARS_WEIGHTS, 0.0, 0.0, 0.0]),
        running=lambda x, u: 0.5 * regularization * (u[0] - 0.5) ** 2,
        scale=np.array([16000.0, 16000.0 / 11.1e6, 100.0, 0.01, 1.0]),
    )


def mars_in_density(**options):
    """The same with the density itself as fifth state, (7.2-1 .. 7.2-5) with F = f_x."""
    logarithmic = mars(**options)
    rho_0 = float(np.exp(logarithmic.start[4]))
    density_noise = options.get("density_noise", DENSITY_NOISE)

    def rate(x, u):
        four, _, _, _ = flight(x, u[0], x[4])
        return np.append(four, -x[4] / SCALE_HEIGHT * four[0])

    def F(x, u):
        four, slopes, by_density, _ = flight(x, u[0], x[4])
        result = np.zeros((5, 5), dtype=slopes.dtype)
        result[:4, :4], result[:4, 4] = slopes, by_density
        result[4, :4] = -x[4] / SCALE_HEIGHT * slopes[0]
        result[4, 4] = -four[0] / SCALE_HEIGHT
        return result

    def G(x, u):
        result = np.zeros((5, 1))
        result[3] = flight(x, u[0], x[4])[3]
        return result

    variance = logarithmic.variance.copy()
    variance[4, 4] *= rho_0**2
    return replace(
        logarithmic,
        start=np.array([*START, rho_0]),
        variance=variance,
        rate=rate,
        F=F,
        G=G,
        M=lambda x, u: accelerations(x, u[0], x[4]),
        Q=lambda x, u: np.diag([0, 0, 0, 0, density_noise * x[4]]),
        # A typical density makes a poor scale for all of them: it grows by five orders of magnitude on the way down.
        scale=np.array([*logarithmic.scale[:4], rho_0]),
    )
