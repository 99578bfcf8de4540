"""Controllers that are given a reading at time zero, against a Kalman filter by matrix exponentials."""

from __future__ import annotations

import casadi as ca
import means
import numpy as np
import pytest
from exports import FOLDER, quick

import covocp as co
from covocp.export import export_c
from covocp.export.laws.design import design_of
from covocp.export.laws.history import history
from covocp.export.laws.sampled import discretised
from covocp.problem.filters import extended_filter

pytestmark = pytest.mark.needs_cc
F, G, Q = np.array([[0.0, 1.0], [-0.5, -0.1]]), np.array([[0.0], [1.0]]), np.diag([0.0, 0.1])
P0 = np.array([[1.0, 0.2], [0.2, 0.3]])
R = np.array([[0.05, 0.02], [0.02, 0.08]])
PLACE, SPEED, PERIOD, STEPS = 0.1, 0.4, 0.1, 15
H = np.array([[1.0, 0.0], [1.0, 0.5]])


def cart(continuous=True, noise=Q):
    """A cart of which three values are read at time zero and later; its speed all the time."""
    ocp = co.Problem(PERIOD * STEPS, "cart")
    x = ocp.state("x", 2, initial=[1, 0], variance=P0)
    u = ocp.control("u")
    ocp.dynamics(x, ca.DM(F) @ x + ca.DM(G) @ u, noise=np.diag(noise))
    if continuous:
        ocp.measurement("speed", x[1], SPEED)
    ocp.measurement("pair", ca.DM(H) @ x, R, at=[0.0, 0.5, 1.2])
    ocp.measurement("place", x[0], PLACE, at=[0.0, 1.0])
    ocp.minimize_expected(x[0] ** 2 + 0.1 * u**2, x[0] ** 2)
    return ocp


@pytest.fixture(scope="module")
def design():
    return co.solve(cart(), intervals=30, progress=False)


@pytest.fixture(scope="module", params=[PERIOD, None])
def package(design, request):
    return quick(export_c(design, FOLDER / f"first_{request.param}", period=request.param))


def flights(law, values, always=True, density=Q, at_end=False):
    """Estimates of the state itself by the law, and by a Kalman filter; the controls are those of the law."""
    solution = values["solution"]
    seen = np.array([[0.0, 1.0]])
    moved = means.told(F, G, seen, np.zeros((1, 1)), density, np.array([[SPEED]]), PERIOD)
    if at_end:  # the extended filter takes what is measured all the time for a reading at the end of a step
        move, noise = moved.state[:2], moved.noise[:2, :2]
        end = np.vstack([np.eye(2), seen])
        moved = means.Told(end @ move, end @ moved.held[:2], end @ noise @ end.T)
        moved.noise[2, 2] += SPEED / PERIOD
    known, P = np.array([1.0, 0.0]), P0.copy()
    found, expected, controls = [], [], []
    for k in range(STEPS + 1):
        ahead, joint = np.append(known, 0.0), np.block([[P, np.zeros((2, 1))], [np.zeros((1, 3))]])
        if k:
            ahead = moved.state @ known + (moved.held @ controls[-1]).ravel()
            joint = moved.state @ P @ moved.state.T + moved.noise
        given = values["given"][k]
        there = np.isfinite(given)
        M = np.hstack([np.vstack([[[0.0, 0.0]], H, [[1.0, 0.0]]]), np.eye(4)[:, :1]])[there]  # of the mean too
        U = np.zeros((4, 4))
        U[1:3, 1:3], U[3, 3] = R, PLACE
        gain = joint[:2] @ M.T @ np.linalg.inv(M @ joint @ M.T + U[np.ix_(there, there)])
        known, P = ahead[:2] + gain @ (given[there] - M @ ahead), joint[:2, :2] - gain @ M @ joint[:, :2]
        controls.append(law.step(given[0 if always else 1 :], k * PERIOD))
        assert law.status in ("OK", "MEASUREMENT_MISSING")
        found.append(solution.at(k * PERIOD)["x"] + law.estimate)
        expected.append(known)
    return np.array(found), np.array(expected)


def readings(missing=None):
    """Readings at all steps, NaN where nothing is read; of the missing row none at time zero."""
    random = np.random.default_rng(3)
    given = np.full((STEPS + 1, 4), np.nan)
    given[1:, 0] = random.normal(size=STEPS)
    for row, at in ((1, (0, 5, 12)), (2, (0, 5, 12)), (3, (0, 10))):
        given[list(at), row] = random.normal(1.0, 1.0, len(at))
    if missing is not None:
        given[0, missing] = np.nan
    return given


def test_estimates_are_those_of_a_kalman_filter(design, package):
    """For any time between two steps U/h and h Q are of first order in h; the first step has none of them."""
    law = package.python()
    found, expected = flights(law, {"solution": design, "given": readings()})
    assert np.abs(found[0] - expected[0]).max() < 1e-12
    assert np.abs(found - expected).max() < (2e-6 if law.period else 2e-2)


def test_any_time_between_two_steps_is_exact_without_noise_in_between():
    """Steps are those of the mesh, so that no kink of the nominal control lies within one."""
    design = co.solve(cart(continuous=False, noise=0 * Q), grid=np.linspace(0, 1, STEPS + 1), progress=False)
    law = export_c(design, FOLDER / "read_only").reference()["step"]
    given = readings()
    given[:, 0] = np.nan
    found, expected = flights(law, {"solution": design, "given": given}, always=False, density=0 * Q)
    assert np.abs(found - expected).max() < 2e-6


@pytest.mark.parametrize("missing", [1, 3])
def test_a_reading_that_is_missing_at_time_zero_is_told_and_left_out(design, package, missing):
    law = package.python()
    law.init()
    given = readings(missing)
    law.step(given[0], 0.0)
    assert law.status == "MEASUREMENT_MISSING"
    there = np.isfinite(given[0])
    M = np.vstack([[[0.0, 1.0]], H, [[1.0, 0.0]]])[there]
    U = np.zeros((4, 4))
    U[1:3, 1:3], U[3, 3] = R, PLACE
    gain = P0 @ M.T @ np.linalg.inv(M @ P0 @ M.T + U[np.ix_(there, there)])
    expected = gain @ (given[0][there] - M @ [1.0, 0.0])
    assert np.abs(law.estimate - expected).max() < 1e-12


def test_c_is_python_also_in_the_first_step(design, package):
    assert package.check().ok
    compiled, reference = package.python()["step"], package.reference()["step"]
    found, expected = (flights(law, {"solution": design, "given": readings()})[0] for law in (compiled, reference))
    assert np.abs(found - expected).max() < 1e-12


def test_a_reading_at_time_zero_counts_once(design, package):
    """A law for samples takes no sample twice; the other one takes what is known after the first reading."""
    law, first = package.python()["step"], readings()[0]
    assert law.state["index" if law.period else "time"] == -1
    law.step(first, 0.0)
    once = law.estimate.copy()
    law.step(np.full(4, np.nan), 0.0)
    assert np.array_equal(law.estimate, once)
    law.step(first, 0.0)
    if law.period:
        assert np.array_equal(law.estimate, once)
        return
    rows, noise = np.vstack([H, [[1.0, 0.0]]]), np.zeros((3, 3))
    noise[:2, :2], noise[2, 2] = R, PLACE
    information = rows.T @ np.linalg.solve(noise, rows)
    twice = np.linalg.solve(
        np.linalg.inv(P0) + 2 * information, 2 * rows.T @ np.linalg.solve(noise, first[1:] - rows[:, 0])
    )
    assert np.abs(law.estimate - twice).max() < 1e-9


def test_a_time_that_is_wrong_leaves_the_first_reading_to_come(package):
    law, first = package.python()["step"], readings()[0]
    law.step(first, np.nan)
    assert law.status == "TIME_NOT_FINITE"
    assert not law.estimate.any()
    law.step(first, 0.0)
    fresh = package.python()["step"]
    fresh.step(first, 0.0)
    assert np.array_equal(law.estimate, fresh.estimate)


def test_the_loop_as_it_flies_is_as_predicted(design, package):
    """2,000 runs of the actual system: errors of the estimate at the end."""
    law = package.python()["step"]
    sample = co.simulate(design, 2000, 4, law=law, period=PERIOD, step=0.05, progress=False)
    errors = (sample.estimates - sample.deviations).std(axis=0)
    assert np.abs(errors / np.sqrt(np.diagonal(design["E"][-1])) - 1).max() < 4 / np.sqrt(4000) + 0.01


def test_spread_as_told_before_the_export_is_that_of_the_runs(design):
    samples = discretised(design_of(design, None), history(design, "double"), PERIOD)
    law = quick(export_c(design, FOLDER / "told", period=PERIOD)).python()["step"]
    sample = co.simulate(design, 3000, 6, law=law, step=0.05, progress=False)
    told = np.sqrt(np.diagonal(samples.flown[-1]))
    assert np.abs(sample.deviations.std(axis=0) / told - 1).max() < 4 / np.sqrt(6000)


def test_extended_filter_takes_it_before_its_first_step():
    """The same readings, the control zero; a mean of what is measured all the time has the noise U/step."""
    predict, update = extended_filter(cart(), step=PERIOD, substeps=8, missing="skip")
    law = _Free(predict, update)
    found, expected = flights(law, {"solution": law, "given": readings()}, at_end=True)
    assert np.abs(found - expected).max() < 1e-6


class _Free:
    """The extended filter in the place of a law whose control is zero and whose nominal is the origin."""

    status = "OK"

    def __init__(self, predict, update):
        self.predict, self.update = predict, update
        self.estimate, self.P = np.array([1.0, 0.0]), P0

    def at(self, time):
        return {"x": np.zeros(2)}

    def step(self, given, time):
        x, P = self.estimate, self.P
        if time > 0.0:
            x, P = self.predict(x, P, 0.0, time - PERIOD)
        x, P = self.update(x, P, given, 0.0, time)
        self.estimate, self.P = np.asarray(x.full()).ravel(), np.asarray(P.full())
        return np.zeros(1)
