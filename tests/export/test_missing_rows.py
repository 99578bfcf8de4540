"""Samples of a fixed period, rows of them missing: the filter of the others, computed by exponentials of matrices."""

from itertools import product

import means
import numpy as np
import pytest
from exports import FOLDER, STRICT, SWING, package, swing

from covocp.export import export_c

pytestmark = pytest.mark.needs_cc
STEPS = 24
F, G, M, H = SWING.F, SWING.G, SWING.M, SWING.H
PERIOD, CONTROL = SWING.period, SWING.control
PATTERNS = [np.array(p) for p in product((True, False), repeat=3)]


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
    """Gain and estimate after each step: exact discrete model of means, P of the filter that has all rows."""
    random = np.random.default_rng(5)
    own = means.told(F, G[:, None], M, H[:, None], SWING.Q, SWING.U, PERIOD)
    Phi, Gamma, seen, held_on = own.state[:2], own.held[:2, 0], own.state[2:], own.held[2:, 0]
    P, y, nominal, held = SWING.P0, np.zeros(2), np.zeros(2), CONTROL
    for k in range(STEPS):
        there = PATTERNS[k % 8]
        m = random.normal(size=3)
        L, _, P = means.filtered(P, own, there)
        y = Phi @ y + Gamma * (held - CONTROL) + L @ (m - seen @ (nominal + y) - held_on * held)
        nominal = Phi @ nominal + Gamma * CONTROL
        held = yield L, y, there


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e200])
def test_the_gain_is_that_of_the_rows_that_are_there(wrong):
    filtered, held = expected(), None
    for state in flown(package("swing").python().step, wrong=wrong):
        L, y, there = filtered.send(held)
        # the Gauss method of order 4 between the samples
        np.testing.assert_allclose(state["filter_gain"], L, rtol=0, atol=1e-7)
        np.testing.assert_array_equal(state["filter_gain"][:, ~there], 0.0)
        np.testing.assert_allclose(state["estimate"], y, rtol=0, atol=1e-6)
        assert state["status"] == ("OK" if there.all() else "MEASUREMENT_MISSING")
        held = float(state["control"])


def test_between_any_times_what_is_known_without_a_row_is_kept() -> None:
    """Steps of a period without one: the gains of the filter that never had the rows, not of the design."""
    controller = export_c(swing(), FOLDER / "swing_any").reference()["step"]
    own = means.told(F, G[:, None], M, H[:, None], SWING.Q, SWING.U, 0.2)
    P = SWING.P0
    for k, rows in enumerate([(), (), (1,), (), (0, 1, 2), (2,)]):
        there = np.isin(np.arange(3), rows)
        controller.step(np.where(there, 0.1, np.nan), 0.2 * (k + 1))
        L = means.filtered(P, own, there)[0]
        joint = own.state @ P @ own.state.T + own.noise
        P = joint[:2, :2] - L @ joint[2:, :2]
        np.testing.assert_allclose(controller.state["filter_gain"], L, rtol=0, atol=2e-5 * max(1.0, np.abs(L).max()))


def test_c_and_python_agree_with_missing_rows():
    check = package("swing").check()
    assert check.ok, str(check)
    assert check.deviation <= 1e-12
    for one, other in zip(flown(package("swing").python().step), flown(package("swing").reference().step), strict=True):
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
    controller = package("swing").reference().step
    flown(controller)
    before = controller.estimate
    for time in (STEPS * PERIOD, 0.0, 3.0, np.nan):
        controller.step([1.0, np.nan, 2.0], time)
        np.testing.assert_array_equal(controller.estimate, before)
        np.testing.assert_array_equal(controller.state["filter_gain"], 0.0)
