"""Reference script: the actual Mars entry with its filter and feedback, one run after another in a plain numpy loop.

Nominal, gains and slopes are computed beforehand, at every step. A run is a Python loop over the steps with vectors of
five, by the scheme of covocp (Heun's method, the noises held over the step), so that both do the same work:

    dx = f(x, u - C y) dt + n,   dy = ((F - K M) y + (G - K h_u) du + K (m - h)) dt,   du = -C y.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from peers_f3 import propagated, unpack
from peers_loops import (
    ACCELEROMETER_NOISE,
    BALLISTIC,
    CONTROL_WEIGHT,
    DENSITY_NOISE,
    DURATION,
    GRAVITY,
    RADIUS,
    SCALE_HEIGHT,
    UNITS,
    VARIANCES,
    Array,
    mars,
)
from peers_packed import packing


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """What is known at every step before the first run."""

    x: Array  # nominal, (K, 5)
    u: Array  # (K,)
    h: Array  # expected measurement, (K, 2)
    K: Array  # (K, 5, 2)
    C: Array  # (K, 5)
    drift: Array  # F - K M, (K, 5, 5)
    input: Array  # G - K h_u, (K, 5)


def accelerations(x: ca.SX, u: ca.SX) -> ca.SX:
    """What the accelerometers measure, in inertial axes."""
    _, theta, v, gamma, log_density = ca.vertsplit(x)
    drag = 0.5 * BALLISTIC * ca.exp(log_density) * v**2
    along, across, angle = -drag, drag * u, theta - gamma
    sine, cosine = ca.sin(angle), ca.cos(angle)
    return ca.vertcat(cosine * along + sine * across, cosine * across - sine * along)


def schedule(u: Array) -> Schedule:
    """Nominal, gains and slopes along a control, at steps of equal length."""
    loop = mars()
    rows = packing(5)
    E0, end = (loop.E0 / np.outer(loop.d, loop.d))[rows], (loop.end / np.outer(loop.s, loop.s))[rows]
    z = propagated(loop, DURATION / (u.size - 1), u, E0, end)
    x, control = ca.SX.sym("x", 5), ca.SX.sym("u")
    E, S = ca.SX.sym("E", 15), ca.SX.sym("S", 15)
    scaled = ca.Function("slopes", [loop.x, loop.u], [loop.F, loop.G])(x / UNITS, control)
    F, G = ca.diag(UNITS) @ scaled[0] @ ca.diag(1 / UNITS), UNITS * scaled[1]
    covariance = unpack(E, 5) * np.outer(loop.d * UNITS, loop.d * UNITS)
    weight = unpack(S, 5) * np.outer(loop.s / UNITS, loop.s / UNITS) * loop.cost
    expected = accelerations(x, control)
    M, by_control = ca.jacobian(expected, x), ca.jacobian(expected, control)
    K = covariance @ M.T / ACCELEROMETER_NOISE
    outputs = [expected, K, weight @ G / CONTROL_WEIGHT, F - K @ M, G - K @ by_control]
    at = ca.Function("schedule", [x, control, E, S], [ca.densify(value) for value in outputs])
    nodes = z[:5].T * UNITS
    values = [at(xk, uk, zk[5:20], zk[20:]) for xk, uk, zk in zip(nodes, u, z.T, strict=True)]
    h, gain, C, drift, by_input = (np.array([np.asarray(value[i]) for value in values]) for i in range(5))
    return Schedule(x=nodes, u=u, h=h[:, :, 0], K=gain, C=C[:, :, 0], drift=drift, input=by_input[:, :, 0])


def rates(s: Schedule, k: int, x: Array, y: Array) -> tuple[Array, Array]:
    """Rates of the state and of the estimate, without noise, at step k."""
    change = -float(s.C[k] @ y)
    h, theta, v, gamma, log_density = x.tolist()
    u = float(s.u[k]) + change
    sine, cosine, distance = math.sin(gamma), math.cos(gamma), RADIUS + h
    gravity = GRAVITY * (RADIUS / distance) ** 2
    drag = 0.5 * BALLISTIC * math.exp(log_density) * v * v
    rate = np.array(
        [
            v * sine,
            v * cosine / distance,
            -gravity * sine - drag,
            (v / distance - gravity / v) * cosine + drag * u / v,
            -v * sine / SCALE_HEIGHT,
        ]
    )
    a, b = math.sin(theta - gamma), math.cos(theta - gamma)
    measured = np.array([drag * (a * u - b), drag * (b * u + a)])
    return rate, s.drift[k] @ y + s.input[k] * change + s.K[k] @ (measured - s.h[k])


def run(s: Schedule, step: float, random: np.random.Generator) -> Array:
    """Deviation of one run from the nominal at the end."""
    steps = s.u.size - 1
    x = s.x[0] + np.sqrt(VARIANCES) * random.standard_normal(5)
    y = np.zeros(5)
    process = math.sqrt(DENSITY_NOISE * step) * random.standard_normal(steps)
    measurement = math.sqrt(ACCELEROMETER_NOISE * step) * random.standard_normal((steps, 2))
    for k in range(steps):
        x_rate, y_rate = rates(s, k, x, y)
        # the noises at the values that they have half a step on
        x_noise = process[k] * math.exp(-0.5 * (x[4] + step / 2 * x_rate[4]))
        y_noise = (s.K[k] + s.K[k + 1]) @ measurement[k] / 2
        x_next, y_next = x + step * x_rate, y + step * y_rate + y_noise
        x_next[4] += x_noise
        x_later, y_later = rates(s, k + 1, x_next, y_next)
        x = x + step / 2 * (x_rate + x_later)
        x[4] += x_noise
        y = y + step / 2 * (y_rate + y_later) + y_noise
    return x - s.x[-1]


def simulate(runs: int, step: float, u: float, seed: int = 1) -> dict[str, Any]:
    """Simulate along a constant control; rms of the deviations at the end, and seconds without the schedule."""
    s = schedule(np.full(round(DURATION / step) + 1, u))
    start = time.perf_counter()
    children = np.random.SeedSequence(seed).spawn(runs)
    deviations = np.array([run(s, step, np.random.default_rng(child)) for child in children])
    return {
        "rms": np.sqrt(np.mean(deviations**2, axis=0)).tolist(),
        "build": 0.0,
        "solve": time.perf_counter() - start,
    }
