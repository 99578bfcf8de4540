"""Exported laws where measurements are taken at instants: the filter of the notes, trajectories that jump, refusals."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, quick
from scipy.linalg import expm

import covocp as co
from covocp.base.errors import ExportError
from covocp.export import export_c

pytestmark = pytest.mark.needs_cc
F, G, Q = np.array([[0.0, 1.0], [-0.5, -0.1]]), np.array([[0.0], [1.0]]), np.diag([0.0, 0.1])
P0, R, EVERY, DURATION = np.diag([1.0, 0.3]), 0.05, 0.5, 3.0


def cart(every=EVERY, at=None, continuous=False):
    """A cart whose place is read now and then."""
    ocp = co.Problem(DURATION, "cart")
    x = ocp.state("x", 2, initial=[1, 0], variance=P0)
    u = ocp.control("u")
    ocp.dynamics(x, ca.DM(F) @ x + ca.DM(G) @ u, noise=np.diag(Q))
    if continuous:
        ocp.measurement("speed", x[1], 0.4)
    ocp.measurement("place", x[0], R, **({"every": every} if at is None else {"at": at}))
    ocp.minimize_expected(x[0] ** 2 + 0.1 * u**2, x[0] ** 2)
    return ocp


@pytest.fixture(scope="module")
def solution():
    return co.solve(cart(), intervals=30, progress=False)


@pytest.fixture(scope="module")
def package(solution):
    return quick(export_c(solution, FOLDER / "cart", period=0.1))


def test_estimates_are_those_of_the_discrete_filter(solution, package):
    """Transition and noise by matrix exponentials; between the instants the law is given NaN, and misses nothing."""
    law, period = package.python(), 0.1
    law.init()
    joint = expm(period * np.block([[-F, Q], [np.zeros((2, 2)), F.T]]))
    move = joint[2:, 2:].T
    noise = move @ joint[:2, 2:]
    held = expm(period * np.block([[F, G], [np.zeros((1, 3))]]))[:2, 2:]
    random, P = np.random.default_rng(0), P0.copy()
    known, place = np.array([1.0, 0.0]), 0.0  # estimate of the state itself
    u = law.step(np.full(1, np.nan), 0.0)
    for k in range(1, 31):
        t = k * period
        known, P = move @ known + (held @ u).ravel(), move @ P @ move.T + noise
        measured = np.full(1, np.nan)
        if k % 5 == 0:
            place = known[0] + random.normal()
            measured[0] = place
            gain = P[:, 0] / (P[0, 0] + R)
            known, P = known + gain * (place - known[0]), P - np.outer(gain, P[0])
        u = law.step(measured, t)
        assert law.status == "OK"
        nominal = solution.at(t)["x"]
        assert np.abs(nominal + law.estimate - known).max() < 2e-6 * np.abs(known).max() + 1e-6


def test_a_reading_that_is_due_and_missing_is_told(package):
    law = package.python()
    law.init()
    for k in range(6):
        law.step(np.full(1, np.nan), 0.1 * k)
        assert law.status == ("MEASUREMENT_MISSING" if k == 5 else "OK")


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_sample_is_at_of_the_solution_where_it_jumps(control):
    solution = co.solve(cart(), intervals=12, control=control, progress=False)
    sample = quick(export_c(solution, FOLDER / f"cart_{control}", feedback=False)).python().sample
    times = np.concatenate([np.arange(1, 7) * EVERY, np.random.default_rng(1).uniform(0.0, DURATION, 60)])
    for time in times:
        got, expected = sample(time), solution.at(time)
        for key in ("x", "u", "E", "S"):
            np.testing.assert_allclose(got[key], expected[key], rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("period", [None, 0.05])
def test_flown_laws_hold_what_the_solution_promises(period):
    """Beside a sensor that is always there; 500 runs of the actual system."""
    design = co.solve(cart(at=[0.4, 1.1, 2.0, 3.0], continuous=True), intervals=30, progress=False)
    law = quick(export_c(design, FOLDER / f"flown_{period}", period=period)).python()
    sample = co.simulate(design, 500, 4, law=law, period=0.05, progress=False)
    errors = sample.estimates - sample.deviations
    promised = np.sqrt(np.diagonal(design["E"][-1]))
    assert np.abs(errors.std(axis=0) / promised - 1).max() < 4 / np.sqrt(1000) + 0.01


@pytest.mark.parametrize(
    ("given", "options", "words"),
    [
        ({"at": [0.33]}, {"period": 0.1}, "no samples of the controller"),
        ({}, {"solver": True}, "another plan"),
    ],
)
def test_what_cannot_fly_is_refused(given, options, words, tmp_path):
    problem = cart(**given)
    what = problem if options.pop("solver", False) else co.evaluate(problem, nominal={"u": 0.0}, intervals=20)
    with pytest.raises(ExportError, match=words):
        export_c(what, tmp_path / "cart", **options)
