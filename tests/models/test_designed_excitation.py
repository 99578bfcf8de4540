"""Designed excitation: what is known along a path against integrals by scipy, and against filters flown along it."""

from __future__ import annotations

import numpy as np
import pytest
from problems import unassessed
from scipy.integrate import quad_vec

import covocp as co
from covocp import ProblemError
from covocp.models import designed_excitation as model
from covocp.models import formation_flight, peak_seeking_line

RUNS = 4000
SMALL = {"intervals": 40, "substeps": 2, "progress": False}


@pytest.fixture(scope="module")
def designed():
    """From rest at the command and back to it, by the defaults."""
    return co.solve(model.problem(), progress=False)


@pytest.fixture(scope="module")
def within():
    """In motion at both ends, as the circle is, and no farther from the command."""
    return co.solve(model.problem(ends="free", reach=0.7), **SMALL)


@pytest.fixture(scope="module")
def paths(designed, within):
    return {"circle": model.classical(), "designed": model.path(designed), "within": model.path(within)}


@pytest.fixture(scope="module")
def flown(paths):
    return {name: model.fly(path, runs=RUNS, seed=1) for name, path in paths.items()}


def by_quadrature(position, duration, variances, noise, radius):
    """Covariance of (M r^2, b r) written out: the information of (c, z), integrated by scipy, inverted."""

    def rate(t):
        y = np.ravel(position(t)) / radius
        pairs = [y[0] * y[1]] if y.size == 2 else []
        g = np.array([1.0, *(0.5 * y**2), *pairs, *y])
        return np.outer(g, g) / noise

    information, _ = quad_vec(rate, 0.0, duration, epsrel=1e-10, limit=10_000)
    known = np.diag(np.append(0.0, 1.0 / variances))
    return np.linalg.inv(information + known)[1:, 1:]


def scaled(inputs, radius):
    """The default variances of (M r^2, b r)."""
    hessians = inputs * (inputs + 1) // 2
    return np.array([25.0 * radius**4] * hessians + [900.0 * radius**2] * inputs)


def test_circle_against_quadrature():
    """The problem's cost along the circle, its covariance in numpy, and scipy."""
    circling = model.circling()
    found = co.evaluate(model.problem(begin=circling["begin"]), nominal=circling["nominal"], intervals=400)

    def position(t):
        return 0.7 * np.array([np.sin(2 * np.pi * t / 120.0), np.cos(2 * np.pi * t / 120.0)])

    exact = by_quadrature(position, 120.0, scaled(2, 0.7), 10.0, 0.7)
    assert found.cost == pytest.approx(np.trace(exact), rel=1e-4)  # accelerations are linear between the nodes
    np.testing.assert_allclose(model.covariance(model.classical(step=0.1))[-1], exact, rtol=1e-4, atol=1e-5)


def test_the_circle_leaves_one_direction_to_the_prior():
    """On a circle |y|^2 is constant: c and M_11 + M_22 cannot be told apart, however long it is flown."""
    P = model.covariance(model.classical(), noise=1e-9)[-1]
    prior = np.diag(scaled(2, 0.7))
    trace = np.array([1.0, 1.0, 0.0, 0.0, 0.0]) / np.sqrt(2.0)
    assert trace @ P @ trace == pytest.approx(trace @ prior @ trace, rel=1e-4)
    across = np.array([1.0, -1.0, 0.0, 0.0, 0.0]) / np.sqrt(2.0)
    assert across @ P @ across < 1e-9


def test_a_fifth_less_than_the_circle(designed):
    """From rest and back, the same length and time: at least 20 % less; limits hold between the nodes too."""
    circling = model.circling()
    circle = co.evaluate(model.problem(begin=circling["begin"]), nominal=circling["nominal"])
    assert designed.cost < 0.80 * circle.cost
    fine = model.path(designed, step=0.05)
    assert fine.length <= 2 * np.pi * 0.7 * (1 + 1e-6)
    assert max(designed.check_path().values(), default=0.0) < 0.01
    np.testing.assert_allclose(fine.position[[0, -1]], 0.0, atol=1e-9)

    def position(t):
        return designed.at(float(np.clip(t, 0.0, 120.0)))["position"]

    exact = by_quadrature(position, 120.0, scaled(2, 0.7), 10.0, 0.7)
    assert designed.cost == pytest.approx(np.trace(exact), rel=2e-4)


def test_paths_that_may_end_anywhere_are_better_still(designed, within):
    anywhere = co.solve(model.problem(ends="free"), guess=within, **SMALL)
    assert np.linalg.norm(model.path(within).position, axis=1).max() < 0.7 * 1.01
    assert within.cost < 0.66 * np.trace(model.covariance(model.classical())[-1])  # that is held against scipy above
    assert anywhere.cost < within.cost < designed.cost


def test_other_starts_find_the_same(designed):
    """Random starts end in the minimum of the default guess."""
    mesh = {"intervals": 40, "substeps": 2}
    costs = [unassessed(model.problem(), guess=model.start(2, seed), **mesh).cost for seed in (5, 12)]
    same = unassessed(model.problem(), **mesh).cost
    np.testing.assert_allclose(costs, same, rtol=1e-4)
    assert same == pytest.approx(designed.cost, rel=1e-2)


@pytest.mark.parametrize("name", ["circle", "designed", "within"])
def test_filters_find_what_is_predicted(flown, name):
    """4000 functions from the prior: measured mean squares against what the filter says, in 4 standard errors."""
    flights = flown[name]
    mean, error = flights.measured("once")
    assert abs(mean - np.trace(flights.once_covariance)) < 4 * error
    normalised = np.einsum("ri,ij,rj->r", flights.once, np.linalg.inv(flights.once_covariance), flights.once)
    assert normalised.mean() == pytest.approx(5.0, abs=4 * np.sqrt(10.0 / RUNS))
    # means of 10 s know less than a continuous measurement
    assert 1.0 < np.trace(flights.once_covariance) / np.trace(flights.continuous) < 1.2
    sought, spread = flights.measured("seeker")
    assert sought > mean - 4 * (error + spread)  # the seeker reuses readings: it cannot know more
    assert f"predicted {np.trace(flights.once_covariance):.3f}" in str(flights)


def test_the_gain_is_there_in_the_filter(flown):
    """Measured errors are a fifth smaller than the circle's, beyond three standard errors of both."""
    circle, _, within = (flights.measured() for flights in flown.values())
    assert within[0] + 3 * within[1] < 0.8 * (circle[0] - 3 * circle[1])


def test_one_input():
    sine = model.classical(1)
    rest = co.solve(model.problem(1), points=2, progress=False)
    free = co.solve(model.problem(1, ends="free", reach=0.7), points=2, progress=False)
    before = np.trace(model.covariance(sine)[-1])
    exact = by_quadrature(lambda t: 0.7 * np.sin(2 * np.pi * t / 120.0) * np.ones(1), 120.0, scaled(1, 0.7), 10.0, 0.7)
    assert before == pytest.approx(np.trace(exact), rel=1e-4)
    assert rest.cost < 0.88 * before
    assert free.cost < 0.80 * before


def test_problems_of_the_models():
    line = co.solve(peak_seeking_line.problem(), points=2, progress=False)
    assert line.converged
    assert formation_flight.problem().statement().ne == 21
    assert formation_flight.problem(radius=1.0, duration=60.0).duration == 60.0


def test_a_path_is_flown_by_the_aircraft(paths):
    """The command follows the path while the seeker waits, and the aircraft the command."""
    path = paths["designed"]
    runs = formation_flight.simulate(runs=8, duration=150.0, path=path)
    offset = runs.command[:, 0] - path.position[0]
    before = runs.t < 120.0
    np.testing.assert_allclose(
        runs.command[:, before] - offset[:, None], path.at(runs.t[before])[None].repeat(8, axis=0), atol=1e-9
    )
    assert np.abs(runs.tracking_error[:, before]).max() < 0.2
    with pytest.raises(ProblemError, match="two inputs"):
        formation_flight.simulate(runs=1, path=model.classical(1))


def test_paths_as_numbers_and_expressions():
    import casadi as ca

    path = model.circle_and_back()
    assert path.length == pytest.approx(2 * (np.pi + 1) * 0.7, rel=1e-3)  # corners cut
    t = ca.MX.sym("t")
    at = ca.Function("at", [t], [path.at(t)])
    for time in (-1.0, 0.0, 33.3, 120.0, 200.0):
        np.testing.assert_allclose(at(time).full().ravel(), path.at(time), atol=1e-12)
    np.testing.assert_allclose(path.position - path.moved([0.1, 0.2]).position, [[0.1, 0.2]] * path.t.size, atol=1e-15)


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: model.problem(3), "'inputs'"),
        (lambda: model.problem(radius=0.0), "'radius'"),
        (lambda: model.problem(noise=-1.0), "'noise'"),
        (lambda: model.problem(ends="somewhere"), "'ends'"),
        (lambda: model.problem(prior=[1.0, 2.0]), "prior"),
        (lambda: model.problem(prior=[1.0, 1.0, 1.0, 1.0, 0.0]), "prior"),
        (lambda: model.problem(begin=[0.0]), "begin"),
        (lambda: model.problem(begin=[0.0, 0.7, 0.03, 0.0], length=3.0), "its own length"),
        (lambda: model.problem(length=10.0, speed=0.01), "speed"),
        (lambda: model.fly(model.classical(), runs=1), "'runs'"),
        (lambda: model.fly(model.classical(duration=15.0)), "too short"),
        (lambda: model.covariance(model.classical(), noise=0.0), "'noise'"),
    ],
)
def test_wrong_arguments_are_named(call, named):
    with pytest.raises(ProblemError, match=named):
        call()
