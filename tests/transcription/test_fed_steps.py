"""Steps of the covariance of an estimate that learns all the time: order, semidefiniteness, dependence on the gain.

dE/dt = F E + E F' + Q - E W E and dXhat/dt = (F - G C) Xhat + Xhat (F - G C)' + E W E, against scipy.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.base.matrices import pack, unpack
from covocp.transcription.covariance_steps import moving_step

PERIOD = 0.8


def loop(density: float = 0.05) -> co.Problem:
    """A pendulum with an unknown torque; its rate is measured all the time, its angle read now and then."""
    ocp = co.Problem(PERIOD, "pendulum")
    a = ocp.state("a", initial=0.3, variance=0.2)
    w = ocp.state("w", initial=0.1, variance=0.1)
    b = ocp.unknown("b", mean=0.2, variance=0.3)
    u = ocp.control("u")
    ocp.dynamics(a, w)
    ocp.dynamics(w, 2.0 * ca.sin(a) - 0.1 * w + b + (1.0 + 0.2 * ca.cos(a)) * u, noise=0.02)
    ocp.measurement("rate", w + 0.3 * a**2, noise=density)
    ocp.measurement("angle", a, noise=0.01, every=PERIOD)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=u**2, terminal_weight={a: 1.0, w: 1.0})
    ocp.subject_to(X[a, a], upper=1.0, at="final", name="end")
    return ocp


def stepped(statement, e, x, controls, count):
    """Half-vectors after `count` equal steps along a nominal had by scipy, and those of scipy itself."""
    first, last = controls
    p = statement.values

    def rate(t, z):
        u = first + t / PERIOD * (last - first)
        moved, grown, _ = statement.rates(z[: statement.nx], u, z[statement.nx :], t, PERIOD, p)
        return np.concatenate([moved.full().ravel(), grown.full().ravel()])

    times = np.linspace(0.0, PERIOD, count + 1)
    z = solve_ivp(rate, (0.0, PERIOD), np.concatenate([x, e]), "DOP853", times, rtol=1e-11, atol=1e-13).y
    step = moving_step(statement, statement.ahead, "gauss")
    reading = np.zeros(statement.readings)
    for k in range(count):
        ends = [first + c / count * (last - first) for c in (k, k + 1)]
        interval = (*ends, k / count, 1.0 / count, PERIOD, p, reading)
        e = step(e, z[: statement.nx, k], z[: statement.nx, k + 1], *interval).full().ravel()
    return e, z[statement.nx :, -1]


def test_order_four_and_what_scipy_says():
    statement = loop().statement()
    random = np.random.default_rng(3)
    e = np.concatenate([pack(np.diag([0.2, 0.1, 0.3])), pack(np.diag([0.01, 0.02, 0.0]))])
    controls = [random.standard_normal(statement.nu) for _ in range(2)]
    errors = []
    for count in (4, 8, 16):
        found, truth = stepped(statement, e, np.array([0.3, 0.1]), controls, count)
        errors.append(np.abs(found - truth).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders.min() > 3.7
    assert errors[-1] < 1e-5


@pytest.mark.parametrize("density", [1e-8, 1e-3, 1.0])
def test_semidefinite_whatever_the_gain_and_the_step(density):
    """Classical Runge-Kutta makes Xhat indefinite from gains of about 10 on, and it overflows soon after."""
    statement = loop(density).statement()
    random = np.random.default_rng(7)
    step = moving_step(statement, statement.ahead, "gauss").map(200)
    size = 200
    scale = 10.0 ** random.uniform(-1, 4, size)
    u = [random.standard_normal((statement.nu, size)) * scale for _ in range(2)]
    x = random.standard_normal((2 * statement.nx, size))
    roots = random.standard_normal((2, size, 3, 2)) * 10.0 ** random.uniform(-3, 2, (2, size, 1, 1))
    e = np.concatenate([pack(roots[k] @ roots[k].swapaxes(1, 2)).T for k in range(2)])
    h = 10.0 ** random.uniform(-3, 1, size)[None]
    p = np.tile(statement.values[:, None], (1, size))
    after = step(e, x[:2], x[2:], *u, 0 * h, h, 1.0 + 0 * h, p, np.zeros((1, size))).full()
    for half in np.split(after, 2):
        matrices = unpack(half.T, 3)
        assert np.isfinite(matrices).all()
        assert (np.linalg.eigvalsh(matrices)[:, 0] > -1e-12 * np.trace(matrices, axis1=1, axis2=2)).all()
