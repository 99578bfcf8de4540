"""Measurements at instants: covariances and slopes against scipy, both formulations and methods, limits, files."""

from __future__ import annotations

from functools import cache, partial

import casadi as ca
import numpy as np
import pytest
from problems import unassessed
from sampled import DURATION, random_system
from scipy.integrate import solve_ivp

import covocp as co
from covocp.base.matrices import unpack
from covocp.extremal.costates import discrete_costates
from covocp.extremal.given_controls import evaluate_controls, evaluation_mesh
from covocp.transcription.mesh import Options

NODES = np.linspace(0.0, DURATION, 9)


def along(system, values):
    """The problem of a system along a control that is linear between the nodes, by short steps."""
    statement = system.problem(direct=0.25).statement()
    options = Options(grid=NODES / DURATION, substeps=48)
    mesh = evaluation_mesh(statement, options, statement.values)
    u = np.interp(mesh.nodes * DURATION, NODES, values)[:, None]
    return evaluate_controls(statement, mesh, u, DURATION, statement.values)


@pytest.mark.parametrize("seeds", [range(0, 13), range(25, 38)])
def test_covariances_and_slopes_of_random_systems_are_those_of_scipy(seeds):
    for seed in seeds:
        system, values = random_system(seed), np.random.default_rng(1000 + seed).normal(size=NODES.size) / 2
        outcome = along(system, values)
        extremal = outcome.extremal
        before, after = system.covariances(partial(np.interp, xp=NODES, fp=values), NODES, 0.25)
        size, nodes = system.size, extremal.mesh.nodes * DURATION
        found = unpack(extremal.trajectory.e, size)
        for t in before:
            same = np.flatnonzero(np.abs(nodes - t) < 1e-12)
            for k, true in ((same[0], before[t]), (same[-1], after[t])):
                allowed = 1e-9 * max(np.abs(system.E0).max(), np.abs(true).max())
                assert np.abs(found[k] - true).max() <= allowed, (seed, t)

        def cost(values, ends=None, system=system):
            if ends is None:
                _, ends = system.covariances(partial(np.interp, xp=NODES, fp=values), NODES, 0.25)
            off = values - 1.0
            energy = 0.1 * np.sum(np.diff(NODES) / 3 * (off[1:] ** 2 + off[1:] * off[:-1] + off[:-1] ** 2))
            return energy + np.trace(system.weights @ ends[DURATION])

        assert sum(outcome.cost_terms.values()) == pytest.approx(cost(values, after), rel=1e-9)
        slopes = discrete_costates(extremal)[1].ravel()
        unit = np.eye(NODES.size)[np.random.default_rng(seed).integers(0, NODES.size)]
        own = float(slopes @ np.interp(nodes, NODES, unit))  # of both values where something is read
        true = (cost(values + 1e-4 * unit) - cost(values - 1e-4 * unit)) / 2e-4
        assert own == pytest.approx(true, rel=1e-6, abs=1e-6 * np.abs(slopes).max()), seed


@cache
def solved(seed):
    return co.solve(random_system(seed).problem(), intervals=48, progress=False)


@pytest.mark.parametrize(
    ("options", "difference"),
    [({"covariances": "states"}, 1e-8), ({"covariance_step": "rk4"}, 1e-5), ({"method": "gradient"}, 1e-7)],
)
@pytest.mark.parametrize("seed", [6, 12])
def test_formulations_steps_and_methods_agree(seed, options, difference):
    """Another step has an error of its own; formulation and method have none."""
    plain = solved(seed)
    other = co.solve(random_system(seed).problem(), intervals=48, progress=False, **options)
    assert other.cost == pytest.approx(plain.cost, rel=difference)
    for solution in (plain, other):
        assert solution.optimality.costate_difference < 1e-4
        assert solution.optimality.stationarity < 1e-5
        assert solution.optimality.curvature > 0


def test_frequent_readings_are_a_continuous_measurement():
    """With a period h and R = U/h the covariances tend to those of density U in the order h."""

    def variance(every):
        ocp = co.Problem(2.0)
        x = ocp.state("x", 2, initial=[0, 0], variance=[1.0, 2.0])
        u = ocp.control("u")
        ocp.dynamics(x, ca.vertcat(x[1], u - x[0]), noise=[0.0, 0.1])
        given = {} if every is None else {"every": every}
        ocp.measurement("y", x[0], 0.2 / (every or 1.0), **given)
        E = ocp.estimation_covariance()
        ocp.minimize(u**2, ca.trace(E.matrix))
        return co.evaluate(ocp, nominal={"u": 0.0}, intervals=80).cost

    limit = variance(None)
    errors = [abs(variance(h) - limit) for h in (0.1, 0.05, 0.025)]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.1)
    assert errors[2] < 0.02 * limit


def expected_by_scipy(system, control):
    """Expected cost of a linear system: that of the nominal, and tr S Q + C'BC E of its feedback (E-20)."""
    n, A, B = system.size, np.zeros((system.size, system.size)), 0.4
    A[0, 0] = 2.0

    def backward(t, y):
        S = y.reshape(n, n)
        gain = system.G.T @ S
        return -(system.F.T @ S + S @ system.F + A - gain.T @ gain / B).ravel()

    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12, "dense_output": True}
    S = solve_ivp(backward, (DURATION, 0.0), 2 * np.eye(n).ravel(), **options).sol
    times = np.linspace(0.0, DURATION, 801)
    before, after = system.covariances(lambda t: 0.0, times)
    total = 0.0
    for k in range(0, 800, 2):  # Simpson's rule; instants are at even points
        h = times[k + 2] - times[k]
        for E, t, weight in (
            (after[times[k]], times[k], 1),
            (before[times[k + 1]], times[k + 1], 4),
            (before[times[k + 2]], times[k + 2], 1),
        ):
            own = S(t).reshape(n, n)
            gain = system.G.T @ own / B
            total += h * weight / 6 * (np.trace(own @ system.Q) + np.trace(gain.T @ gain @ E) * B) / 2
    total += np.trace(S(0.0).reshape(n, n) @ system.E0) / 2

    def nominal(t, y):
        u = control(t)
        return np.append(system.F @ y[:-1] + (system.G @ [u]).ravel(), (y[0] - 1) ** 2 + 0.2 * u**2)

    end = solve_ivp(nominal, (0.0, DURATION), np.zeros(n + 1), method="DOP853", rtol=1e-11, atol=1e-12, max_step=0.05)
    x = end.y[:-1, -1]
    return total + end.y[-1, -1] + x @ x


@pytest.mark.parametrize("seed", [1, 6, 12])
def test_expected_cost_is_that_of_scipy(seed):
    """The instants are every sixteenth of the time; what is read there has its slope and variance for u = 0."""
    system = random_system(seed)
    solution = co.evaluate(system.problem(cost="expected"), nominal={"u": 0.0}, intervals=64, substeps=4)
    true = expected_by_scipy(system, lambda t: 0.0)
    assert solution.cost == pytest.approx(true, rel=2e-6)
    assert solution.loop.expected_cost == pytest.approx(true, rel=2e-6)
    assert solution.loop.other_cost == pytest.approx(true, rel=1e-5)
    assert solution.optimality.cross_covariance < 1e-7


def test_estimate_gains_what_the_error_loses():
    solution = co.solve(random_system(6).problem(cost="expected"), intervals=32, progress=False)
    loop = solution.loop
    for k in solution.mesh.instants:
        assert np.allclose(loop.X[k + 1], loop.X[k], rtol=0, atol=1e-9 * np.abs(loop.X).max())
        assert np.trace(loop.E[k + 1]) < np.trace(loop.E[k])


@pytest.mark.parametrize("variance", [1e-30, 1e-12, 1.0, 1e12])
def test_covariances_are_semidefinite_at_any_accuracy(variance):
    ocp = co.Problem(1.0)
    x = ocp.state("x", 2, initial=[0, 0], variance=np.array([[1.0, 0.99], [0.99, 1.0]]))
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, 1e-3])
    ocp.measurement("y", x[0] + 0.3 * x[1], variance, every=0.25)
    E = ocp.estimation_covariance()
    ocp.minimize(u**2, ca.trace(E.matrix))
    statement = ocp.statement()
    for step in ("gauss", "strang", "rk4"):
        mesh = evaluation_mesh(statement, Options(intervals=20, covariance_step=step), statement.values)
        found = evaluate_controls(statement, mesh, np.zeros((mesh.control_nodes, 1)), 1.0, statement.values)
        values = np.linalg.eigvalsh(unpack(found.extremal.trajectory.e, 2))
        assert (values[:, 0] >= -1e-15 * values[:, 1]).all()


def test_free_duration_moves_relative_instants():
    """The slope of the cost by the duration vanishes, by differences too."""

    def problem(duration):
        ocp = co.Problem(duration)
        x = ocp.state("x", 2, initial=[0, 0], final=[1, 0], variance=[0.3, 0.3])
        u = ocp.control("u")
        ocp.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, 0.2])
        ocp.measurement("y", (1 + x[0]) * x[0], 0.05, at=[0.3, 0.8, 1.0], relative=True)
        E = ocp.estimation_covariance()
        ocp.minimize(0.1 * u**2 + 1.0, 3 * ca.trace(E.matrix))
        return ocp

    free = co.solve(problem(co.Free(1.5, lower=0.2, upper=9.0)), intervals=40, progress=False)
    T = free.duration
    assert free.optimality.transversality < 1e-4
    costs = [co.solve(problem(T + d), intervals=40, progress=False).cost for d in (-2e-3, 0.0, 2e-3)]
    assert costs[1] == pytest.approx(free.cost, rel=1e-8)
    assert abs(costs[2] - costs[0]) < 1e-2 * abs(costs[2] - 2 * costs[1] + costs[0]) + 1e-7


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_saved_and_loaded(tmp_path, control):
    problem = random_system(6).problem(cost="expected")
    solution = co.solve(problem, intervals=24, control=control, progress=False)
    solution.save(tmp_path / "s.npz")
    again = co.load(tmp_path / "s.npz", problem=problem)
    for t in (0.0, 0.5, DURATION):
        for side in ("before", "after"):
            assert np.array_equal(again.at(t, side)["E"], solution.at(t, side)["E"])
    assert co.evaluate(problem, nominal=again).cost == pytest.approx(solution.cost, rel=1e-12)


def test_limits_of_a_variance_hold_before_what_is_read():
    ocp = co.Problem(4.0)
    x = ocp.state("x", initial=0.0, variance=0.1)
    speed = ocp.control("speed", lower=0.0, upper=2.0, guess=0.5)
    ocp.dynamics(x, 0 * speed, noise=0.2 * speed)
    ocp.measurement("y", x, 0.1, every=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize((speed - 1.5) ** 2)
    ocp.subject_to(E[x, x], upper=0.25)
    costs = []
    for options in ({}, {"covariances": "states"}, {"method": "gradient"}):
        found = co.solve(ocp, intervals=20, progress=False, **options)
        assert found["E"].max() == pytest.approx(0.25, rel=1e-4)
        assert not found.check_path()
        costs.append(found.cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-7)
    assert costs[2] == pytest.approx(costs[0], rel=1e-5)
    # each period brings the variance from v to the limit: 0.1 / (1 + 0.1 / 0.25) after every reading
    after = 0.25 * 0.1 / 0.35
    means = [(0.25 - start) / 0.2 for start in (0.1, after, after, after)]
    assert costs[0] == pytest.approx(sum((mean - 1.5) ** 2 for mean in means), rel=1e-5)


def test_gradient_solutions_can_be_saved(tmp_path):
    solution = co.solve(random_system(3).problem(), intervals=16, method="gradient", progress=False)
    solution.save(tmp_path / "s.json")
    assert co.load(tmp_path / "s.json").cost == solution.cost


def test_a_run_goes_on_where_differences_of_the_cost_are_small():
    """Ipopt's filter took differences of 1e-10 for nothing: the run ended at a slope of 2e-5 and was no solution."""
    ocp = co.Problem(10.0)
    x = ocp.state("x", 2, initial=np.zeros(2), variance=np.full(2, 0.1))
    v = ocp.state("v", 2, initial=np.zeros(2), variance=np.full(2, 0.1))
    k = ocp.unknown("k", mean=1.0, variance=0.05)
    u = ocp.control("u", guess=0.1)
    ocp.dynamics(x, v)
    springs = ca.DM([[2.0, -1.0], [-1.0, 2.0]])
    ocp.dynamics(v, -k * (springs @ x) - 0.1 * v + ca.DM([1.0, 0.0]) * u, noise=np.full(2, 0.01))
    ocp.measurement("place", x[1], 0.2, every=1.0)
    ocp.minimize_expected((x[1] - 1) ** 2 + 0.1 * u**2, x[1] ** 2)
    by_ipopt, by_itself = (unassessed(ocp, method, intervals=120) for method in ("ipopt", "reduced"))
    assert by_ipopt.cost == pytest.approx(by_itself.cost, rel=1e-8)
