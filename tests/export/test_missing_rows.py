"""Samples of a fixed period, rows of them missing: the filter of the others, computed by exponentials of matrices."""

from functools import lru_cache
from itertools import product

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, STRICT
from scipy.linalg import block_diag, expm

import covocp as co
from covocp.export import export_c

pytestmark = pytest.mark.needs_cc
PERIOD, STEPS, CONTROL = 0.05, 24, 0.3
F, G = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([0.0, 1.0])
Q, P0 = np.diag([0.0, 0.2]), np.diag([0.3, 0.5])
M, H = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]]), np.array([0.2, 0.0, 0.0])
PAIR, DIFFERENCE = np.array([[0.2, 0.09], [0.09, 0.1]]), 0.4
R = block_diag(PAIR, DIFFERENCE) / PERIOD
PATTERNS = [np.array(p) for p in product((True, False), repeat=3)]


@lru_cache
def made():
    """The controller, compiled."""
    package = export_c(swing(), FOLDER / "swing", period=PERIOD)
    package.build(flags=STRICT)
    return package


@lru_cache
def swing(unit=1.0):
    """A damped swing seen by three rows, two of them correlated, one of which sees the control; unit: of the rows."""
    ocp = co.Problem(duration=2.0, name="swing")
    x = ocp.state("x", 2, initial=np.zeros(2), variance=np.diag(P0))
    u = ocp.control("u")
    ocp.dynamics(x, ca.DM(F) @ x + ca.DM(G) * u, noise=np.diag(Q))
    ocp.measurement("pair", unit * (x + ca.DM(H[:2]) * u), noise=unit**2 * PAIR)
    ocp.measurement("difference", unit * (x[0] - x[1]), noise=unit**2 * DIFFERENCE)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: np.array([2.0, 1.0])})
    return co.evaluate(ocp, nominal={"u": CONTROL})


def flown(controller, unit=1.0, wrong=np.nan):
    """The states of the controller after each step; every pattern of missing rows comes three times."""
    random = np.random.default_rng(5)
    controller.init()
    states = []
    for k in range(STEPS):
        reading = np.where(PATTERNS[k % 8], unit * random.normal(size=3), wrong)
        controller.step(reading, (k + 1) * PERIOD)
        states.append({**controller.state, "status": controller.status})
    return states


def expected():
    """Gain and estimate after each step: exact discrete model, P- of the filter that has all rows."""
    random = np.random.default_rng(5)
    joint = expm(PERIOD * np.block([[F, G[:, None]], [np.zeros((1, 3))]]))
    Phi, Gamma = joint[:2, :2], joint[:2, 2]
    loan = expm(PERIOD * np.block([[-F, Q], [np.zeros((2, 2)), F.T]]))
    noise = Phi @ loan[:2, 2:]
    P, y, nominal, held = P0, np.zeros(2), np.zeros(2), CONTROL
    for k in range(STEPS):
        nominal = Phi @ nominal + Gamma * CONTROL
        P = Phi @ P @ Phi.T + noise
        there = PATTERNS[k % 8]
        m = random.normal(size=3)[there]
        Mp, L = M[there], np.zeros((2, 3))
        L[:, there] = P @ Mp.T @ np.linalg.inv(Mp @ P @ Mp.T + R[np.ix_(there, there)])
        y = Phi @ y + Gamma * (held - CONTROL)
        y = y + L[:, there] @ (m - Mp @ (nominal + y) - H[there] * held)
        full = P @ M.T @ np.linalg.inv(M @ P @ M.T + R)
        P = P - full @ M @ P
        held = yield L, y, there


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e200])
def test_the_gain_is_that_of_the_rows_that_are_there(wrong):
    filtered, held = expected(), None
    for state in flown(made().python().step, wrong=wrong):
        L, y, there = filtered.send(held)
        # the Gauss method of order 4 between the samples
        np.testing.assert_allclose(state["filter_gain"], L, rtol=0, atol=1e-7)
        np.testing.assert_array_equal(state["filter_gain"][:, ~there], 0.0)
        np.testing.assert_allclose(state["estimate"], y, rtol=0, atol=1e-6)
        assert state["status"] == ("OK" if there.all() else "MEASUREMENT_MISSING")
        held = float(state["control"])


def test_c_and_python_agree_with_missing_rows():
    check = made().check()
    assert check.ok, str(check)
    assert check.deviation <= 1e-12
    for one, other in zip(flown(made().python().step), flown(made().reference().step), strict=True):
        np.testing.assert_allclose(one["estimate"], other["estimate"], rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(one["filter_gain"], other["filter_gain"], rtol=1e-12, atol=1e-15)


def test_the_unit_of_the_rows_changes_nothing_in_single_precision():
    """Variances of 1e-44 are no numbers of single precision: the table holds standard deviations."""
    unit = 1e-22
    runs = []
    for size in (1.0, unit):
        single = export_c(swing(size), FOLDER / f"swing_{size:g}", name="swing", period=PERIOD, precision="single")
        single.build(flags=STRICT)
        runs.append(np.array([state["estimate"] for state in flown(single.python().step, size)]))
    np.testing.assert_allclose(runs[0], runs[1], rtol=0, atol=1e-5)
    assert np.abs(runs[0]).max() > 0.1


def test_nothing_is_corrected_at_a_sample_that_is_over_nor_outside_the_time():
    controller = made().reference().step
    flown(controller)
    before = controller.estimate
    for time in (STEPS * PERIOD, 0.0, 3.0, np.nan):
        controller.step([1.0, np.nan, 2.0], time)
        np.testing.assert_array_equal(controller.estimate, before)
        np.testing.assert_array_equal(controller.state["filter_gain"], 0.0)
