"""A closed loop with every term: two states and an unknown, two controls, written twice, for covocp and for numpy.

L has cross terms of state and control and depends on the unknown, k is not quadratic; the measurement is not linear and
depends on the controls, its two noises are correlated; the process noise depends on state and control. Second
derivatives of the numpy version are complex-step derivatives of gradients that are written by hand.
"""

from __future__ import annotations

import casadi as ca
import closed_loops
import numpy as np

import covocp as co

DURATION = 2.0
START = np.array([0.2, -0.3, 0.8])  # r, mean of c
VARIANCE = np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.15]])
MEASUREMENT_NOISE = np.array([[0.5, 0.2], [0.2, 0.8]])
STEP = 1e-30  # of complex-step derivatives


def problem(*, noise=1.0, variance=VARIANCE, measurement_noise=MEASUREMENT_NOISE, curved=True, gain=None, **weights):
    """Parameter "noise" multiplies the density of the process noise; without `curved` the terminal cost is quadratic.

    Weights go to minimize_expected.
    """
    ocp = co.Problem(duration=DURATION, name="nonlinear loop")
    factor = ocp.parameter("noise", noise)
    r = ocp.state("r", 2, initial=START[:2], variance=variance[:2, :2])
    c = ocp.unknown("c", mean=START[2], variance=variance[2, 2])
    u, w = ocp.control("u"), ocp.control("w")
    density = ca.blockcat([[0.2 + 0.1 * r[0] ** 2, 0.05], [0.05, 0.3 + 0.1 * u**2]])
    rate = ca.vertcat(r[1] + 0.3 * ca.sin(r[0]) + 0.2 * w, -c * r[0] - 0.1 * r[1] ** 3 + u * (1 + 0.2 * r[0]))
    ocp.dynamics(r, rate, noise=factor * density)
    ocp.measurement("m", ca.vertcat(r[0] ** 3 / 3 + r[0] + 0.1 * u**2, c * r[1] + 0.2 * w * r[0]), measurement_noise)
    running = 0.5 * (r[0] - 1) ** 2 + 0.25 * r[1] ** 4 + 0.4 * r[0] * u + 0.1 * c * r[1] * w + 0.6 * u**2
    running += 0.1 * u**2 * r[0] ** 2 + 0.5 * w**2 + 0.2 * c**2 * r[0] + 0.15 * u * w
    terminal = ca.cosh(r[0] - 1) + 0.15 * (1 + r[0] ** 2) * r[1] ** 2 + 0.2 * c * r[1]
    if not curved:
        terminal = ca.dot(r, r)
    ocp.minimize_expected(running=running, terminal=terminal, gain=gain, **weights)
    return ocp


def rate(x, u):
    r0, r1, c = x
    return np.array(
        [r1 + 0.3 * np.sin(r0) + 0.2 * u[1], -c * r0 - 0.1 * r1**3 + u[0] * (1 + 0.2 * r0), 0 * (r0 + u[0])]
    )


def measured(x, u):
    r0, r1, c = x
    return np.array([r0**3 / 3 + r0 + 0.1 * u[0] ** 2, c * r1 + 0.2 * u[1] * r0])


def running(x, u):
    r0, r1, c = x
    value = 0.5 * (r0 - 1) ** 2 + 0.25 * r1**4 + 0.4 * r0 * u[0] + 0.1 * c * r1 * u[1] + 0.6 * u[0] ** 2
    return value + 0.1 * u[0] ** 2 * r0**2 + 0.5 * u[1] ** 2 + 0.2 * c**2 * r0 + 0.15 * u[0] * u[1]


def running_slopes(x, u):
    """L_x and L_u."""
    r0, r1, c = x
    by_x = [
        r0 - 1 + 0.4 * u[0] + 0.2 * u[0] ** 2 * r0 + 0.2 * c**2,
        r1**3 + 0.1 * c * u[1],
        0.1 * r1 * u[1] + 0.4 * c * r0,
    ]
    return np.array(
        [*by_x, 0.4 * r0 + 1.2 * u[0] + 0.2 * u[0] * r0**2 + 0.15 * u[1], 0.1 * c * r1 + u[1] + 0.15 * u[0]]
    )


def terminal(x):
    r0, r1, c = x
    return np.cosh(r0 - 1) + 0.15 * (1 + r0**2) * r1**2 + 0.2 * c * r1


def terminal_slope(x):
    r0, r1, c = x
    return np.array([np.sinh(r0 - 1) + 0.3 * r0 * r1**2, 0.3 * (1 + r0**2) * r1 + 0.2 * c, 0.2 * r1])


def terminal_curvature(x):
    return derivative(terminal_slope, x)


def process_noise(x, u, factor=1.0):
    result = np.zeros((3, 3))
    result[:2, :2] = factor * np.array([[0.2 + 0.1 * x[0] ** 2, 0.05], [0.05, 0.3 + 0.1 * u[0] ** 2]])
    return result


def derivative(function, x):
    """Jacobian by complex steps, exact to roundoff; `function` is given the steps as columns, all at once."""
    x = np.asarray(x, dtype=float)
    return np.asarray(function(x[:, None] + 1j * STEP * np.eye(x.size))).imag / STEP


def weights(x, u):
    """A, B, N."""
    curvature = derivative(lambda z: running_slopes(z[:3], z[3:]), np.concatenate([x, u]))
    return curvature[:3, :3], curvature[3:, 3:], curvature[:3, 3:]


def slopes(x, u):
    """F, G, M and A, B, N."""
    F, G = derivative(lambda z: rate(z, u), x), derivative(lambda v: rate(x, v), u)
    return F, G, derivative(lambda z: measured(z, u), x), *weights(x, u)


def system(end, factor=1.0):
    """For `closed_loops.closed_loop`; `end` is S(T), which depends on the nominal."""
    return closed_loops.System(
        start=START,
        variance=VARIANCE,
        rate=rate,
        F=lambda x, u: derivative(lambda z: rate(z, u), x),
        G=lambda x, u: derivative(lambda v: rate(x, v), u),
        M=lambda x, u: derivative(lambda z: measured(z, u), x),
        Q=lambda x, u: process_noise(x, u, factor),
        U=MEASUREMENT_NOISE,
        weights=weights,
        end=end,
        running=running,
        terminal=terminal,
        scale=np.ones(3),
    )


NODES = np.linspace(0.0, DURATION, 5)
CONTROLS = np.array([[0.5, -0.2], [-0.3, 0.4], [0.8, 0.1], [-0.6, -0.5], [0.2, 0.3]])  # at the nodes, any
NOMINAL = {"u": CONTROLS[:, 0], "w": CONTROLS[:, 1]}


def control(t):
    """CONTROLS, linear between NODES."""
    return np.array([np.interp(t, NODES, column) for column in CONTROLS.T])


def reference(truth=None, feedback=None):
    """The loop along CONTROLS, by scipy."""
    breaks = tuple(NODES[1:-1].tolist())
    last = closed_loops.nominal(system(np.eye(3)), control, DURATION, breaks=breaks)(DURATION)
    design = system(terminal_curvature(last))
    return closed_loops.closed_loop(
        design, control, DURATION, breaks=breaks, times=NODES, truth=truth, feedback=feedback
    )


def random_point(seed):
    """x (with c), u, and positive definite E and S."""
    generator = np.random.default_rng(seed)
    x, u = generator.uniform(-1, 1, 3), generator.uniform(-1, 1, 2)
    roots = generator.standard_normal((2, 3, 3))
    return x, u, *(root @ root.T for root in roots)
