"""The default mesh: graded where covariance or gain are steep, uniform elsewhere; costs and their stated errors."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from problems import unassessed
from scipy.integrate import solve_ivp

import covocp as co
from covocp.models import lqg_double_integrator, mars_entry, unknown_lag
from covocp.transcription.grading import graded
from covocp.transcription.mesh import Options
from covocp.transcription.steps import simpson_interval

PATH = Path(__file__).parents[2] / "benchmarks" / "measurements" / "expected_cost.py"


def benchmark():
    """The random systems and their costs by scipy."""
    spec = importlib.util.spec_from_file_location("defaults_expected_cost", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


SAMPLE = benchmark()


def accurate(duration=40.0, variance=2500.0, weight=0.05):
    """Double integrator with a large prior and a good sensor: t0 = 4e-4 s, and its cost is known (scipy)."""
    ocp = co.Problem(duration)
    x = ocp.state("x", 2, initial=[0, 0], variance=[variance, 4.0])
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u), noise=[0, 1e-2])
    ocp.measurement("m", x[0], noise=1.0)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: [weight, weight]})
    return ocp


ACCURATE = 0.42095025806894015  # scipy, LSODA at 1e-10: both Riccati equations and (E-20)


def at_rest(ocp, **options):
    controls = [b for b in ocp.statement().blocks if b.kind == "control"]
    return co.evaluate(ocp, nominal={b.name: np.zeros((2, b.size)) for b in controls}, **options)


# --- where the mesh is graded -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [unknown_lag.steering, lqg_double_integrator.problem, mars_entry.problem])
def test_mesh_stays_uniform_where_nothing_is_steep(model):
    statement = model().statement()
    options = graded(statement, Options(), statement.values)
    np.testing.assert_allclose(options.nodes(), np.linspace(0, 1, 101), atol=1e-15)
    assert options.grading == {}


def test_steep_start_is_divided_down_to_its_time_scale():
    statement = accurate().statement()
    nodes = graded(statement, Options(), statement.values).nodes()
    steps = 40.0 * np.diff(nodes)
    assert 1e-4 < steps[0] < 4e-4  # t0 = U/E(0) = 4e-4 s
    assert (steps[1:12] / steps[:11] < 2.0).all()
    assert nodes.size - 101 <= 25
    assert np.isin(np.round(np.linspace(0, 1, 101), 12), np.round(nodes, 12)).all()  # the intervals asked for remain
    assert steps[-1] == pytest.approx(0.4)


def test_steep_end_is_divided_down_to_its_time_scale():
    """S(T) on the speed: 1/S_22 = 1e-4 s; on the position only: (3/S_11)^(1/3) = 0.067 s, not zero."""
    for weight, scale in (([1e-3, 1e4], 1e-4), ([1e4, 0.0], 0.067)):
        ocp = co.Problem(40.0)
        x = ocp.state("x", 2, initial=[0, 0], variance=[0.01, 0.01])
        u = ocp.control("u")
        ocp.dynamics(x, ca.vertcat(x[1], u), noise=[0, 1e-2])
        ocp.measurement("m", x[0], noise=1.0)
        ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: weight})
        statement = ocp.statement()
        options = graded(statement, Options(), statement.values)
        steps = 40.0 * np.diff(options.nodes())
        assert options.grading["nodes_added"][0] == 0
        assert 0.2 * scale < steps[-20:].min() < scale


def test_given_grid_is_never_changed():
    grid = np.linspace(0, 1, 41)
    with pytest.warns(co.base.errors.CovocpWarning, match="too coarse"):
        solution = at_rest(accurate(), grid=grid)
    np.testing.assert_array_equal(solution.mesh.nodes, grid)
    assert "nodes_added" not in solution.stats


def test_held_values_belong_to_the_intervals_asked_for():
    values = np.random.default_rng(2).normal(size=100)
    found = co.evaluate(accurate(), nominal={"u": values}, control="constant")
    middles = 0.5 * (found.mesh.nodes[1:] + found.mesh.nodes[:-1])
    np.testing.assert_array_equal(found.trajectory.u[:, 0], values[np.floor(100 * middles).astype(int)])


def test_grading_is_reported():
    solution = at_rest(accurate())
    assert solution.stats["intervals_asked"] == 100
    start, end = solution.stats["nodes_added"]
    assert solution.mesh.intervals == 100 + start + end
    assert f"mesh: 100 intervals, graded to {100 + start} at the start" in str(solution)


def test_running_cost_of_an_estimate_is_graded_at_its_start():
    """int E dt of a scalar without dynamics is U ln(1 + E(0) T/U)."""
    ocp = co.Problem(10.0)
    x, u = ocp.state("x", initial=0.0, variance=1e4), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("m", x, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + E[x, x])
    solution = at_rest(ocp)
    assert solution.cost == pytest.approx(0.1 * np.log(1 + 1e4 * 10.0 / 0.1), rel=1e-3)
    assert solution.stats["nodes_added"][1] == 0


# --- costs and what is said of them -----------------------------------------------------------------------------------


@pytest.mark.parametrize("intervals", [50, 100])
@pytest.mark.parametrize("options", [{}, {"covariances": "states"}, {"covariance_step": "rk4"}])
def test_cost_with_an_accurate_sensor(options, intervals):
    solution = co.solve(accurate(), intervals=intervals, progress=False, **options)
    assert abs(solution.cost / ACCURATE - 1) < min(1e-3, 3 * solution.mesh_error + 1e-6)
    assert solution.loop.expected_cost == pytest.approx(ACCURATE, rel=1e-4)


def test_gradient_method_and_warm_starts_take_the_graded_mesh():
    gradient = co.solve(accurate(), "gradient", progress=False)
    assert gradient.cost == pytest.approx(ACCURATE, rel=1e-4)
    other = co.solve(accurate(), intervals=30, guess=gradient, progress=False)
    assert other.cost == pytest.approx(ACCURATE, rel=1e-3)
    held = co.solve(accurate(), control="constant", guess=other, progress=False)
    assert held.cost == pytest.approx(ACCURATE, rel=1e-4)


@pytest.mark.parametrize("seed", [1, 6, 11, 18])
def test_cost_of_random_systems(seed):
    system = SAMPLE.random_system(seed)
    truth = SAMPLE.exact(system)
    found = at_rest(SAMPLE.problem(system))
    assert found.cost == pytest.approx(truth, rel=1e-4)
    assert found.optimality.cost_identity < 1e-4


@pytest.mark.parametrize("seed", [2, 7, 9, 11])
def test_stated_error_of_a_coarse_grid_is_the_error(seed):
    """By a factor of 3, of the cost along the same nominal."""
    system = SAMPLE.random_system(seed)
    truth = SAMPLE.exact(system)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = at_rest(SAMPLE.problem(system), grid=np.linspace(0, 1, 21))
    error = abs(found.cost / truth - 1)
    assert error > 1e-3
    assert any("too coarse" in str(w.message) for w in caught)
    assert found.mesh_error / 3 < error < 3 * found.mesh_error


def test_both_forms_of_the_running_cost_telescope():
    """Over one interval of a smooth loop they agree to the order of Simpson's rule, and are not the same."""
    solution = at_rest(accurate(variance=0.02), grid=np.linspace(0, 1, 401))
    st, t, k = solution.statement, solution.trajectory, 200
    common = (t.u[k], t.u[k + 1], *(solution.mesh.nodes[k], 1 / 400), t.duration, solution.parameters, [])
    x, e = np.stack([t.x[k], t.x[k]]).T, t.e[[k, k + 1]]
    middle = 0.5 * (e[0] + e[1])  # linear over so short an interval but for h^2
    values = [
        float(simpson_interval(st, 2, by_parts)(t.x[k], e[0], x, np.stack([middle, e[1]]).T, *common))
        for by_parts in (False, True)
    ]
    assert values[0] == pytest.approx(values[1], rel=1e-3)
    assert values[0] != values[1]


def test_identity_compares_the_cost_that_was_optimised():
    """On a mesh that spoils the covariances' own cost the identity says so, in the record and in a warning."""
    system = SAMPLE.random_system(22)
    with pytest.warns(co.base.errors.CovocpWarning, match="does not resolve the gains"):
        found = at_rest(SAMPLE.problem(system), grid=np.linspace(0, 1, 81))
    own = found.loop.expected_cost
    assert found.optimality.cost_identity == pytest.approx(abs(found.cost - own) / own)
    assert found.optimality.cost_identity > 1e-2


def test_mesh_error_counts_what_an_unstable_nominal_misses():
    """The cost of the control that is returned, integrated by scipy, is off by what the mesh error says."""
    ocp = co.Problem(8.0)
    x, u = ocp.state("x", initial=1.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, x + 0.3 * ca.sin(3 * x) + u)
    ocp.minimize(running=0.5 * (u**2 + x**2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = co.solve(ocp, intervals=40, substeps=1, control="constant", progress=False)

    y = np.array([1.0, 0.0])
    for k, (a, b) in enumerate(zip(found.t, found.t[1:], strict=False)):
        v = found.trajectory.u[k, 0]

        def rate(_, z, v=v):
            return [z[0] + 0.3 * np.sin(3 * z[0]) + v, 0.5 * (v**2 + z[0] ** 2)]

        y = solve_ivp(rate, (a, b), y, rtol=1e-11, atol=1e-12).y[:, -1]
    error = abs(y[1] / found.cost - 1)
    assert abs(y[0] - 1) > 1e-3  # it misses
    assert found.mesh_error > error / 3


def test_free_duration_with_a_large_prior():
    """Range-only rendezvous: by 100 intervals the same duration as by a mesh of 150 that is fine at both ends."""
    ocp = co.Problem(co.Free(60.0, 20.0, 200.0))
    r = ocp.state("r", 2, initial=[-300.0, 50.0], final=[0, 0], variance=[900.0, 900.0])
    v = ocp.state("v", 2, initial=[5.0, 0], final=[0, 0], variance=[0.25, 0.25])
    u = ocp.control("u", 2)
    ocp.dynamics(r, v)
    ocp.dynamics(v, u, noise=[1e-3, 1e-3])
    ocp.measurement("range", ca.sqrt(ca.dot(r, r) + 25.0), noise=0.25)
    ocp.minimize_expected(running=20 * ca.dot(u, u) + 0.3, terminal_weight={r: [0.02, 0.02], v: [1.0, 1.0]})
    found = co.solve(ocp, progress=False)
    s = np.linspace(0, 1, 151)
    fine = np.where(s < 0.5, 4 * s**3, 1 - 4 * (1 - s) ** 3)
    reference = unassessed(ocp, grid=fine, guess=found)
    assert found.duration == pytest.approx(reference.duration, rel=1e-3)
    assert found.cost == pytest.approx(reference.loop.expected_cost, rel=1e-4)


# --- semidefinite steps -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1e-3, 1e-6])
def test_strang_stays_semidefinite_with_accurate_measurements(noise):
    generator = np.random.default_rng(4)
    factor = generator.normal(size=(4, 4))
    ocp = co.Problem(1.0)
    x, b = ocp.state("x", 3, initial=np.ones(3)), ocp.unknown("b", 0.5, 1.0)
    u = ocp.control("u")
    F = generator.normal(size=(3, 3)) * 0.5 - np.eye(3)
    ocp.dynamics(x, ca.DM(F) @ x + ca.DM([1, 0.5, -0.3]) * u + ca.DM([0, 0.2, 0.1]) * b * x[0], noise=[0.5, 0.1, 0.01])
    ocp.measurement("m", ca.DM([[1.0, 0.7, -0.4]]) @ x, noise=noise)
    E = ocp.estimation_covariance(initial=factor @ factor.T * 300)
    ocp.minimize(running=0.5 * u**2, terminal=E[b, b])
    for intervals in (3, 10):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The mesh is too coarse")
            found = at_rest(ocp, intervals=intervals, substeps=1, covariance_step="strang")
        assert found.semidefinite
