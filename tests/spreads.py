"""Problems with conditions on the covariance of the closed loop, and the known optimum of one of them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

import covocp as co

NOISE, DENSITY, TIME = 0.01, 0.01, 5.0
F, G, M = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
START = np.diag([0.2, 0.1])


def wall(limit: float = 2.0) -> tuple[co.Problem, ca.MX]:
    """A wall that the position keeps clear of by three deviations, and the position."""
    ocp = co.Problem(10.0, "wall")
    x, v = ocp.state("x", initial=0.0, final=0.0, variance=0.01), ocp.state("v", initial=0.0, final=0.0, variance=1e-4)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=2e-4)
    ocp.measurement("position", x, noise=0.01)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=0.5 * u**2 + 2 * (x - 1.9) ** 2, terminal_weight={x: 5.0, v: 5.0})
    ocp.subject_to(x + 3 * ca.sqrt(X[x, x]), upper=limit, name="wall")
    return ocp, x


def double_integrator(*, unit: float = 1.0, time: float = TIME, miss: float = 0.0) -> tuple[co.Problem, ca.MX, ca.MX]:
    """From rest to rest; the problem, its position and its control."""
    ocp = co.Problem(time, "double integrator")
    x = ocp.state("x", initial=unit, final=0.0, variance=START[0, 0] * unit**2)
    v = ocp.state("v", initial=0.0, final=0.0, variance=START[1, 1] * unit**2)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=NOISE * unit**2)
    ocp.measurement("position", x, noise=DENSITY * unit**2)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: miss, v: miss})
    return ocp, x, u


def ellipse(limits: tuple[float, float], *, unit: float = 1.0) -> co.Problem:
    """It ends with variances of at most so much, in units squared."""
    ocp, *_ = double_integrator(unit=unit)
    X = ocp.closed_loop_covariance()
    scaled = np.array(limits) * unit**2
    ocp.subject_to(ca.diag(X.matrix) / scaled, upper=1.0, at="final", name="ellipse")
    return ocp


def margin(limit: float, *, smallest: float | None = None) -> co.Problem:
    """Its control stays away from its limits by three deviations of the feedback; None: the root is written out."""
    ocp, _, u = double_integrator(time=4.0, miss=2.0)
    X = ocp.closed_loop_covariance()
    deviation = ca.sqrt(X[u, u]) if smallest is None else X.deviation(u, smallest)
    ocp.subject_to(ca.vertcat(u + 3 * deviation, 3 * deviation - u), upper=limit, name="margin")
    return ocp


def ellipse_by_duality(limits: tuple[float, float]) -> tuple[float, np.ndarray]:
    """Least expected cost of the feedback of the ellipse, and the weights of the end that reach it.

    Of linear systems the least cost for given variances at the end is the greatest, over weights l >= 0 of the end, of
    the cost of the best gain for S(T) = diag(l) less l'limits/2: covariance steering without a gap. The filter is
    integrated by scipy, S is closed, and what readings bend is summed by Gauss' rule.
    """

    def error_rate(_: float, e: np.ndarray) -> np.ndarray:
        E = e.reshape(2, 2)
        return (F @ E + E @ F.T + NOISE * G @ G.T - E @ M.T @ M @ E / DENSITY).ravel()

    points, shares = np.polynomial.legendre.leggauss(60)
    edges = np.linspace(0.0, TIME, 6)  # of five pieces: E changes quickly at first
    times = np.concatenate([a + (b - a) / 2 * (1 + points) for a, b in pairwise(edges)])
    shares = np.tile(shares, 5) * TIME / 10
    E = solve_ivp(error_rate, (0, TIME), START.ravel(), rtol=1e-11, atol=1e-13, t_eval=[*times, TIME], method="LSODA")
    *along, last = E.y.T.reshape(-1, 2, 2)
    gained = np.array([at @ M.T @ M @ at / DENSITY for at in along])
    passed, bent = moved(TIME - times), gramian(TIME - times)

    def cost(weights: np.ndarray) -> float:
        S = passed.transpose(0, 2, 1) @ np.linalg.solve(np.diag(1 / weights) + bent, passed)
        running = 0.5 * shares @ np.einsum("kij,kji->k", S, gained)
        return float(running + 0.5 * weights @ (np.diagonal(last) - np.array(limits)))

    found = minimize(lambda w: -cost(np.exp(w)), np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-4})
    return -float(found.fun), np.exp(found.x)


def moved(h: float | np.ndarray) -> np.ndarray:
    """The transition of the double integrator over so much time; of several times one after the other."""
    one = np.ones_like(h)
    return np.moveaxis(np.array([[one, h], [0 * one, one]]), (0, 1), (-2, -1))


def gramian(h: float | np.ndarray) -> np.ndarray:
    """Of its control, or of noise of density one; of several times one after the other."""
    return np.moveaxis(np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]]), (0, 1), (-2, -1))


PERIOD, VARIANCE = 0.5, 0.02


def ellipse_read(limits: tuple[float, float], *, unit: float = 1.0) -> co.Problem:
    """The ellipse where the position is read each `PERIOD`, and nothing is measured between."""
    ocp = co.Problem(TIME, "ellipse, read at instants")
    x = ocp.state("x", initial=unit, final=0.0, variance=START[0, 0] * unit**2)
    v = ocp.state("v", initial=0.0, final=0.0, variance=START[1, 1] * unit**2)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=NOISE * unit**2)
    ocp.measurement("position", x, noise=VARIANCE * unit**2, every=PERIOD)
    ocp.minimize_expected(running=0.5 * u**2 / unit**2, terminal_weight={x: 0.0, v: 0.0})
    X = ocp.closed_loop_covariance()
    ocp.subject_to(ca.diag(X.matrix) / (np.array(limits) * unit**2), upper=1.0, at="final", name="ellipse")
    return ocp


def ellipse_read_by_duality(limits: tuple[float, float]) -> float:
    """Its least expected cost, in closed form but for the weights of the end: no feedback that bends less is better.

    S(t) = A' (diag(l)^-1 + W)^-1 A, A the transition from t to T and W the Gramian of the control: each reading costs
    tr S (E- - E+)/2. The nominal takes 6/T^3.
    """

    E, lost = START, []
    for _ in range(round(TIME / PERIOD)):
        E = moved(PERIOD) @ E @ moved(PERIOD).T + NOISE * gramian(PERIOD)
        lost.append(E @ M.T @ M @ E / (E[0, 0] + VARIANCE))
        E = E - lost[-1]
    before = np.diagonal(E + lost[-1])  # a reading at the end comes too late for the feedback, X goes on over it

    def cost(weights: np.ndarray) -> float:
        total = 6.0 / TIME**3 + 0.5 * weights @ (before - np.array(limits))
        for k, gained in enumerate(lost[:-1]):
            left = TIME - (k + 1) * PERIOD
            S = moved(left).T @ np.linalg.solve(np.diag(1 / weights) + gramian(left), moved(left))
            total += 0.5 * np.trace(S @ gained)
        return total

    return -float(minimize(lambda w: -cost(np.exp(w)), np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-6}).fun)


SPEED = 0.1


def ellipse_mixed(limits: tuple[float, float], variance: float) -> co.Problem:
    """The ellipse where the speed is measured all the time and the position read each second."""
    ocp = co.Problem(TIME, "ellipse, measured and read")
    x = ocp.state("x", initial=1.0, final=0.0, variance=START[0, 0])
    v = ocp.state("v", initial=0.0, final=0.0, variance=START[1, 1])
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=NOISE)
    ocp.measurement("speed", v, noise=SPEED)
    ocp.measurement("position", x, noise=variance, every=1.0)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 0.0, v: 0.0})
    X = ocp.closed_loop_covariance()
    ocp.subject_to(ca.diag(X.matrix) / np.array(limits), upper=1.0, at="final", name="ellipse")
    return ocp


def ellipse_mixed_by_duality(limits: tuple[float, float], variance: float) -> float:
    """Its least expected cost, as `ellipse_read_by_duality`; what is learnt between the readings costs tr S E W E/2."""
    information = np.diag([0.0, 1.0 / SPEED])

    def rate(_: float, e: np.ndarray) -> np.ndarray:
        E = e.reshape(2, 2)
        return (F @ E + E @ F.T + NOISE * G @ G.T - E @ information @ E).ravel()

    places, weights = np.polynomial.legendre.leggauss(40)
    E, lost = START, []  # (time, what E loses there)
    for k in range(round(TIME)):
        times = np.append(0.5 * (places + 1.0), 1.0)
        passed = solve_ivp(rate, (0.0, 1.0), E.ravel(), "LSODA", times, rtol=1e-11, atol=1e-13).y.T.reshape(-1, 2, 2)
        lost += [(k + c, w / 2 * P @ information @ P) for c, w, P in zip(times, weights, passed[:-1], strict=False)]
        E = passed[-1]
        if k + 1 < TIME:  # a reading at the end comes too late for the feedback
            gained = E @ M.T @ M @ E / (E[0, 0] + variance)
            lost.append((k + 1.0, gained))
            E = E - gained

    def cost(end: np.ndarray) -> float:
        total = 6.0 / TIME**3 + 0.5 * end @ (np.diagonal(E) - np.array(limits))
        for time, gained in lost:
            h = TIME - time
            moved, gramian = np.array([[1.0, h], [0.0, 1.0]]), np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
            S = moved.T @ np.linalg.solve(np.diag(1 / end) + gramian, moved)
            total += 0.5 * np.trace(S @ gained)
        return float(total)

    return -float(minimize(lambda w: -cost(np.exp(w)), np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-6}).fun)


def covariances_with_gains(
    solution: co.Solution,
    start: np.ndarray,
    noise: np.ndarray,
    variance: float,
    learnt: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """E and Xhat of the double integrator at all nodes by scipy, with Kalman updates, for the gains of a solution.

    Args:
        solution: whose gains are flown, the same in any unit of the states and the control.
        start: E at time zero, (2, 2).
        noise: density of the process noise, (2, 2).
        variance: of what is read of the position, where a node stands twice.
        learnt: E -> what is learnt all the time, (2, 2); None: nothing.
    """
    t, E, Xhat = solution.t, start.copy(), np.zeros((2, 2))
    found, gains = [(E, Xhat)], solution.loop.gain
    for k, (begin, end) in enumerate(pairwise(t)):
        if begin == end:
            lost = E[:, :1] @ E[:1] / (E[0, 0] + variance)
            E, Xhat = E - lost, Xhat + lost
        else:

            def rate(time: float, y: np.ndarray, k: int = k, begin: float = begin, end: float = end) -> np.ndarray:
                share = (time - begin) / (end - begin)
                closed = F - G @ ((1 - share) * gains[k] + share * gains[k + 1])
                E, Xhat = y.reshape(2, 2, 2)
                gained = np.zeros((2, 2)) if learnt is None else learnt(E)
                return np.ravel([F @ E + E @ F.T + noise - gained, closed @ Xhat + Xhat @ closed.T + gained])

            y = solve_ivp(rate, (begin, end), np.ravel([E, Xhat]), "LSODA", rtol=1e-10, atol=1e-14).y[:, -1]
            E, Xhat = y.reshape(2, 2, 2)
        found.append((E, Xhat))
    both = np.array(found)
    return both[:, 0], both[:, 1]
