"""Conditions on the spread of the loop where everything is measured at instants, and the gain is a control.

Before the first reading nothing is fed back, and after it the estimate scatters along one direction only.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from problems import solve, unassessed
from scipy.integrate import solve_ivp
from scipy.stats import beta, norm
from spreads import F, G, covariances_with_gains, ellipse_read, ellipse_read_by_duality

import covocp as co
from covocp.solving.coarse_start import coarser
from covocp.transcription.mesh import Options

DURATION, LIMIT, SIGMAS = 6.0, 1.0, 3.0
Q, R, P0 = np.diag([0.0, 0.02]), 4e-4, np.diag([0.01, 0.01])
RUNS = 20_000


@cache
def solved(unit=1.0, method="ipopt", run=unassessed, **options):
    """A double integrator whose place is read each second, pulled towards a wall that it keeps clear of."""
    ocp = co.Problem(DURATION, "wall")
    x = ocp.state("x", initial=0.0, final=0.0, variance=P0[0, 0] * unit**2)
    v = ocp.state("v", initial=0.0, final=0.0, variance=P0[1, 1] * unit**2)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=Q[1, 1] * unit**2)
    ocp.measurement("place", x, R * unit**2, every=1.0)
    X = ocp.closed_loop_covariance()
    ocp.subject_to(x + SIGMAS * X.deviation(x), upper=LIMIT * unit, name="wall")
    weight = [1.0 / unit**2]
    ocp.minimize_expected((0.5 * u**2 + 0.1 * v**2 - unit * x) / unit**2, terminal_weight={x: weight, v: weight})
    return run(ocp, method=method, intervals=24, **options)


@pytest.fixture(scope="module")
def solution():
    return solved(run=solve)


def covariances(solution):
    """E and Xhat at all nodes by scipy for the gains of the solution."""
    return covariances_with_gains(solution, P0, Q, R)


def test_it_is_solved_and_nothing_is_fed_back_before_the_first_reading(solution):
    """Limits Xhat >= 0, which have no inside before the second reading, took it 202 iterations."""
    assert solution.converged
    assert solution.stats["iterations"] < 100
    until = np.count_nonzero(solution.t < 1.0) + 1
    assert not solution["C"][:until].any()
    assert np.abs(solution["Xhat"][:until]).max() < 1e-20
    assert solution["C"][until:].any(axis=1).all()


@pytest.mark.parametrize(("options", "error"), [({}, 1e-4), ({"substeps": 8}, 1e-6)])
def test_covariances_are_those_of_scipy_with_the_gains(options, error):
    """Xhat but for the error of its integration steps: the default ones leave 3.5e-5, twice as many 4e-8."""
    solution = solved(run=unassessed if options else solve, **options)
    E, Xhat = covariances(solution)
    loop = solution.loop
    assert np.abs(loop.E - E).max() < 1e-9
    assert np.abs(loop.Xhat - Xhat).max() < error * np.abs(Xhat).max()
    assert np.linalg.eigvalsh(Xhat).min() > -1e-9


def test_the_wall_is_kept_by_three_deviations_and_reached(solution):
    E, Xhat = covariances(solution)
    x = solution["x"].ravel()
    outermost = x + SIGMAS * np.sqrt(E[:, 0, 0] + Xhat[:, 0, 0])
    assert outermost.max() == pytest.approx(LIMIT, abs=1e-4)
    assert np.count_nonzero(outermost > LIMIT - 1e-4) >= 3


def test_as_many_runs_cross_it_as_the_spread_says(solution):
    """At the node where it is reached most closely; numpy's own runs of plant, filter and feedback."""
    x, v = own_runs(solution)
    E, Xhat = covariances(solution)
    nominal, deviation = solution["x"].ravel(), np.sqrt(E[:, 0, 0] + Xhat[:, 0, 0])
    k = int(np.argmax(nominal + SIGMAS * deviation))
    crossed = int(np.count_nonzero(x[k] > LIMIT))
    low, high = beta.ppf([5e-4, 1 - 5e-4], [crossed, crossed + 1], [RUNS - crossed + 1, RUNS - crossed])
    assert low < norm.sf((LIMIT - nominal[k]) / deviation[k]) < high
    assert low < norm.sf(SIGMAS) < high


def own_runs(solution):
    """Place and speed at all nodes, (nodes, runs)."""
    random, t, gains = np.random.default_rng(5), solution.t, solution.loop.gain
    d, y = np.linalg.cholesky(P0) @ random.standard_normal((2, RUNS)), np.zeros((2, RUNS))
    E, found = P0.copy(), [d]
    for k, (begin, end) in enumerate(pairwise(t)):
        h = end - begin
        if h == 0.0:
            K = E[:, :1] / (E[0, 0] + R)
            reading = d[:1] + np.sqrt(R) * random.standard_normal((1, RUNS))
            y, E = y + K @ (reading - y[:1]), E - K @ E[:1]
        else:

            def rate(time, z, k=k, begin=begin, h=h):
                C = gains[k] + (time - begin) / h * (gains[k + 1] - gains[k])
                plant = np.block([[F, -G @ C], [np.zeros((2, 2)), F - G @ C]])
                return (plant @ z.reshape(4, 4)).ravel()

            move = solve_ivp(rate, (begin, end), np.eye(4).ravel(), method="DOP853", rtol=1e-9, atol=1e-12).y[:, -1]
            ahead = np.array([[1.0, h], [0.0, 1.0]])
            noise = Q[1, 1] * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
            joint = move.reshape(4, 4) @ np.vstack([d, y])
            d, y = joint[:2] + np.linalg.cholesky(noise) @ random.standard_normal((2, RUNS)), joint[2:]
            E = ahead @ E @ ahead.T + noise
        found.append(d)
    x, v = solution["x"].reshape(-1, 1), solution["v"].reshape(-1, 1)
    return np.array([path[0] for path in found]) + x, np.array([path[1] for path in found]) + v


def test_simulated_runs_are_as_predicted(solution):
    sample = co.simulate(solution, 2000, 3, progress=False)
    assert sample.verdict.holds
    spread = np.sqrt(np.diagonal(solution.loop.X[-1]))
    assert np.abs(sample.deviations.std(axis=0) / spread - 1).max() < 4 / np.sqrt(2 * sample.runs)


def test_other_units_change_nothing(solution):
    """A wall 10,000 m away, not scaled by what it is, made residuals of 7,000 and kept Ipopt from any solution."""
    far = solved(1e4)
    assert far.cost == pytest.approx(solution.cost, rel=1e-8)
    np.testing.assert_allclose(far["C"], solution["C"], atol=1e-4 * np.abs(solution["C"]).max())


def test_the_reduced_method_finds_the_same(solution):
    """Its first Hessian is that of the running cost, which is singular across what was read (LinAlgError)."""
    other = solved(method="reduced")
    assert other.method == "reduced"
    assert other.cost == pytest.approx(solution.cost, rel=1e-6)


@pytest.mark.parametrize(("limits", "unit"), [((0.05, 0.05), 1.0), ((0.04, 0.3), 1e3)])
def test_an_ellipse_at_the_end_costs_what_duality_says(limits, unit):
    """What gains between the nodes and the price of those that hardly matter leave: 1.5e-5 and 3e-5."""
    solution = co.solve(ellipse_read(limits, unit=unit), intervals=40, progress=False)
    least = ellipse_read_by_duality(limits)
    assert 0.0 < solution.cost / least - 1.0 < 5e-5
    assert solution.stats["iterations"] < 50
    reached = np.diagonal(solution.loop.X[-1]) / unit**2 / np.array(limits)
    assert reached.max() == pytest.approx(1.0, abs=1e-5)


def test_an_unstable_plant_keeps_clear_of_a_wall():
    """E and Xhat of one state between the readings, where they grow by exp(2 h) and what the gain makes of it."""
    ocp = co.Problem(3.0, "unstable")
    x = ocp.state("x", initial=1.0, final=0.0, variance=0.05)
    u = ocp.control("u")
    ocp.dynamics(x, x + u, noise=0.01)
    ocp.measurement("position", x, noise=0.01, every=0.25)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal_weight={x: 1.0})
    ocp.subject_to(x - 3 * X.deviation(x), lower=-0.35, name="wall")
    solution = co.solve(ocp, intervals=36, progress=False)
    E, Xhat, gains = 0.05, 0.0, solution.loop.gain.ravel()
    for k, h in enumerate(np.diff(solution.t)):
        if h == 0.0:
            lost = E**2 / (E + 0.01)
            E, Xhat = E - lost, Xhat + lost
        else:
            E = np.exp(2 * h) * E + 0.01 * np.expm1(2 * h) / 2
            Xhat *= np.exp(2 * h * (1 - (gains[k] + gains[k + 1]) / 2))
        assert solution.loop.E[k + 1].item() == pytest.approx(E, rel=1e-5)
        assert solution.loop.Xhat[k + 1].item() == pytest.approx(Xhat, rel=1e-4, abs=1e-12)
    outermost = solution["x"].ravel() - 3 * np.sqrt(solution.loop.X.ravel())
    assert outermost.min() == pytest.approx(-0.35, abs=1e-6)


def test_a_fine_mesh_starts_from_a_coarse_one_with_its_instants(solution):
    statement, mesh = solution.statement, solution.mesh
    assert coarser(statement, Options(intervals=24), mesh, statement.values) is None
    fewer = coarser(statement, Options(intervals=96), mesh.divided(4), statement.values)
    assert fewer is not None
    nodes = fewer.nodes()
    assert 18 <= np.unique(nodes).size - 1 <= 36
    for instant in statement.instants:
        assert np.sum(np.abs(nodes - instant) < 1e-12) == 2
    assert np.isin(np.round(np.unique(nodes), 12), np.round(mesh.divided(4).nodes, 12)).all()
