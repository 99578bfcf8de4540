"""Transcription by multiple shooting: both formulations and all steps lead to the known solutions, at their orders."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import LAG_COSTS, LAG_EIGENVALUE, lag, order, simulate, solve, unassessed
from scipy.integrate import solve_ivp

import covocp as co
from covocp.models import damped_oscillator, mass_chain, noisy_integrator
from covocp.transcription.mesh import Options
from covocp.transcription.nlp import Scales
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.transcribing import transcribe

FORMULATIONS = ("eliminated", "states")


# --- the first-order lag ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("final", "weight"), LAG_COSTS)
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("step", ["gauss", "rk4"])
def test_lag(final, weight, formulation, step):
    solution = unassessed(lag(weight, final).problem, covariances=formulation, covariance_step=step)
    assert solution.mesh.eliminated == (formulation == "eliminated")
    assert solution.mesh.step == step
    assert solution.cost == pytest.approx(LAG_COSTS[final, weight], rel=1e-6)
    assert np.linalg.eigvalsh(solution["E"]).min() > 0.1


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")
@pytest.mark.parametrize("final", [0.0, 1.0])
def test_lag_with_strang(final):
    """Of order 2: extrapolated from two meshes to the cost, both formulations on the coarser one."""
    problem = lag(10.0, final).problem
    coarse, fine = (
        unassessed(problem, covariance_step="strang", intervals=n, substeps=1, segments=10).cost for n in (100, 200)
    )
    exact = LAG_COSTS[final, 10.0]
    assert (fine - exact) / (coarse - exact) == pytest.approx(0.25, abs=0.02)
    assert (4 * fine - coarse) / 3 == pytest.approx(exact, rel=3e-6)
    other = unassessed(problem, covariance_step="strang", intervals=100, substeps=1, covariances="states").cost
    assert other == pytest.approx(coarse, rel=1e-7)


@pytest.mark.parametrize(
    ("noise", "cost", "E22", "E11"), [(1e-3, 4.5802190, 0.2345105, None), (1e-6, 4.5777677, 0.2343819, 9.99e-4)]
)
def test_very_accurate_measurement(noise, cost, E22, E11):
    solution = solve(lag(10.0, 0.0, noise=noise).problem)
    assert solution.cost == pytest.approx(cost, rel=2e-7)
    assert solution["E"][-1, 1, 1] == pytest.approx(E22, rel=2e-6)
    if E11:
        assert solution["E"][-1, 0, 0] == pytest.approx(E11, rel=1e-5)
    assert np.linalg.eigvalsh(solution["E"]).min() > 0


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("final", [1.0, -1.0])
def test_the_better_of_two_minima(formulation, final):
    """Not 7.7120, which begins in the wrong direction."""
    solution = solve(lag(10.0, final).problem, covariances=formulation)
    assert solution.cost == pytest.approx(7.08523968, rel=1e-6)
    assert np.sign(final) * solution["x"][1] > 0


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")
@pytest.mark.parametrize(("control", "expected"), [("linear", 4), ("constant", 2)])
@pytest.mark.parametrize("final", [0.0, 1.0])
def test_order_of_the_cost(control, expected, final):
    """Against the published cost; its nine digits bear the errors of up to 80 intervals."""
    problem, counts = lag(10.0, final).problem, [25, 50, 80]
    costs = [unassessed(problem, intervals=n, substeps=1, control=control, tolerance=1e-9).cost for n in counts]
    assert order(counts, np.array(costs) - LAG_COSTS[final, 10.0]) == pytest.approx(expected, abs=0.35)


@pytest.mark.parametrize(("control", "expected"), [("linear", 4), ("constant", 2)])
def test_order_of_the_cost_of_the_noisy_integrator(control, expected):
    """u = 2/3 + t - t^2/2 exactly, J = 59/90 [3.4 b]."""
    counts = [5, 10, 20]
    problem = noisy_integrator.problem(0.0, 1.0)
    errors = [unassessed(problem, intervals=n, control=control, tolerance=1e-11).cost - 59 / 90 for n in counts]
    assert order(counts, errors) == pytest.approx(expected, abs=0.2)


def test_given_grid():
    nodes = np.linspace(0, 1, 121) ** 1.2
    solution = solve(lag().problem, grid=nodes)
    np.testing.assert_allclose(solution.t, 10 * nodes)
    assert solution.cost == pytest.approx(7.08523968, rel=2e-6)


def test_grid_with_constant_control():
    nodes = np.array([0.0, 0.2, 0.3, 0.7, 1.0])
    solution = solve(noisy_integrator.problem(), grid=nodes, control="constant")
    np.testing.assert_allclose(solution["u"], 1.0, atol=1e-6)  # constant is optimal [3.4 a]
    assert solution.cost == pytest.approx(0.5, rel=1e-9)


@pytest.mark.parametrize("segments", [1, 7, 50])
def test_number_of_segments_does_not_matter(segments):
    """Also where it does not divide the intervals."""
    solution = solve(lag().problem, segments=segments)
    assert len(solution.mesh.segments) == segments
    assert solution.cost == pytest.approx(7.08523968, rel=1e-6)


@pytest.mark.parametrize("substeps", [2, 3])
def test_substeps(substeps):
    coarse = solve(lag().problem, intervals=50, substeps=substeps)
    assert coarse.cost == pytest.approx(7.08523968, rel=2e-6)


# --- the chain of masses ----------------------------------------------------------------------------------------------

CHAIN = {
    1: (1.0196361700, 1.0199952551),
    3: (1.8376564176, 1.8375579980),
    5: (2.2222978530, 2.2234033128),
    9: (3.3181037202, 3.3191543556),
    14: (None, 3.8129993516),
}
slow = pytest.mark.slow


@pytest.mark.filterwarnings("ignore:The mesh is too coarse", "ignore:The integration steps are long")  # as published
@pytest.mark.parametrize(
    ("masses", "options"),
    [
        *((m, {"segments": s}) for m in (1, 3, 5) for s in (1, 10, 50)),
        (1, {"covariances": "states"}),
        pytest.param(3, {"covariances": "states"}, marks=slow),
        *(pytest.param(m, {"segments": s}, marks=slow) for m in (9, 14) for s in (1, 10)),
    ],
)
def test_chain(masses, options):
    """The published discretisation, to 1e-8, in every formulation."""
    problem = mass_chain.problem(masses)
    for step, published in zip(("rk4", "gauss"), CHAIN[masses], strict=True):
        if published is None:
            continue
        mesh = {"intervals": 50, "control": "constant", "substeps": 1, "covariance_step": step}
        solution = unassessed(problem, **{"covariances": "eliminated", "tolerance": 1e-9, **mesh, **options})
        assert solution.cost == pytest.approx(published, rel=1e-8)
        assert np.linalg.eigvalsh(solution["E"]).min() > 0


def test_coarse_mesh_warns():
    with pytest.warns(co.CovocpWarning, match="mesh is too coarse") as caught:
        solution = co.solve(damped_oscillator.problem(), intervals=20, substeps=1, progress=False)
    assert solution.mesh_error > 1e-3
    assert abs(solution.cost / 863.839329 - 1) > 1e-3  # and it is
    assert caught[0].filename == __file__  # the line of the user, not one of the toolbox


# --- constraints ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("bound", [0.5, 0.8])
def test_terminal_inequality_on_a_variance(formulation, bound):
    """1/E_bb = 1/5 + 2 lambda energy: J = bound + (1/bound - 1/5)/(2 lambda), multiplier -dJ/dbound, for weight 1."""
    data = lag(1.0, 0.0)
    data.problem.subject_to(data.E[data.b, data.b], upper=bound, at="final", name="variance of b")
    solution = solve(data.problem, covariances=formulation)
    energy = (1 / bound - 1 / 5) / (2 * LAG_EIGENVALUE)
    assert solution.cost == pytest.approx(bound + energy, rel=1e-6)
    assert solution["E"][-1, 1, 1] == pytest.approx(bound, rel=1e-6)
    assert solution.multipliers.end[0] == pytest.approx(1 / (2 * LAG_EIGENVALUE * bound**2) - 1, rel=1e-5)
    assert solution.costate("E")[-1, 1, 1] == pytest.approx(1 / (2 * LAG_EIGENVALUE * bound**2), rel=1e-5)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_terminal_inequality_that_does_not_bind(formulation):
    data = lag(1.0, 0.0)
    data.problem.subject_to(data.E[data.b, data.b], upper=2.0, at="final", name="variance of b")
    solution = solve(data.problem, covariances=formulation)
    assert solution.cost == pytest.approx(1.91442319, rel=1e-6)
    assert solution.multipliers.end[0] == pytest.approx(0, abs=1e-5)


def test_path_inequality_on_a_variance():
    """Both formulations agree; the constraint binds where it was violated; its multipliers are not negative."""

    def bound(t, exp):
        return 6.5 * exp(-0.17 * t)

    solutions = {}
    for formulation in ("auto", *FORMULATIONS):
        data = lag(1.0, 1.0)
        excess = data.E[data.b, data.b] - bound(data.problem.time, ca.exp)
        data.problem.subject_to(excess, name="learn early")
        solutions[formulation] = unassessed(data.problem, covariances=formulation, intervals=50)
    assert not solutions["auto"].mesh.eliminated
    assert solutions["states"].cost == pytest.approx(solutions["eliminated"].cost, rel=1e-6)
    free, solution = solve(lag(1.0, 1.0).problem), solutions["states"]
    assert (free["E"][:, 1, 1] - bound(free.t, np.exp)).max() > 0.1
    excess = solution["E"][:, 1, 1] - bound(solution.t, np.exp)
    weights = solution.multipliers.path[:, 0]
    assert excess.max() == pytest.approx(0, abs=1e-6)
    assert weights.min() > -1e-7
    assert weights.max() > 1e-3
    assert np.abs(weights * excess).max() < 1e-6
    assert solution.cost > free.cost
    assert solution.optimality.stationarity < 1e-6
    assert solution.optimality.costate_difference < 1e-4


def test_final_value_of_a_matrix():
    """x' = u, E' = x, E(1) = 5/12 demanded: the solution of case c [3.4], whose weight is then the multiplier."""
    for formulation in FORMULATIONS:
        ocp = co.Problem(duration=1.0)
        x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
        ocp.dynamics(x, u)
        E = ocp.symmetric("E", 1, initial=0.0, final=5 / 12)
        ocp.dynamics(E, x)
        ocp.minimize(running=0.5 * u**2)
        solution = solve(ocp, covariances=formulation)
        np.testing.assert_allclose(solution["u"], solution.t + 0.5, atol=1e-5)
        assert solution.cost == pytest.approx(23 / 24 - 5 / 12, rel=1e-6)
        assert solution.multipliers.final_matrices[0] == pytest.approx(1.0, rel=1e-4)
        np.testing.assert_allclose(solution.costate("E").ravel(), 1.0, rtol=1e-4)


def test_path_constraint_between_nodes():
    """check_path finds the largest excess between the nodes, here by the cubic of a linear acceleration."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", 2, initial=[0, 1], final=[0, -1]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize(running=0.5 * u**2)
    ocp.subject_to(x[0], upper=0.1, name="wall")
    solution = solve(ocp, intervals=11)
    h, c = 1 / 11, np.arange(21)[:, None] / 20
    x0, v0, a, b = solution["x"][:-1, 0], solution["x"][:-1, 1], solution["u"][:-1], solution["u"][1:]
    between = x0 + h * c * v0 + h**2 * (a * c**2 / 2 + (b - a) * c**3 / 6)
    expected = between.max() - 0.1
    assert expected > 1e-5
    found = solution.check_path(points=20)
    assert list(found) == ["wall"]
    assert found["wall"] == pytest.approx(expected, rel=1e-6)
    assert solution["x"][:, 0].max() < 0.1 + 1e-7


def test_constraints_that_no_covariance_enters_do_not_evaluate_its_propagation():
    """Their slopes would be as dear as those of the covariances: a motor with a limited current took five times."""

    def called(limited):
        example = lag()
        ocp = example.problem
        ocp.subject_to(example.E[example.b, example.b] if limited == "variance" else example.x**2, upper=6.0)
        st = ocp.statement()
        mesh = resolve_mesh(st, Options(intervals=20, covariances="eliminated", points=2, substeps=2), st.values)
        ones = Scales(x=np.ones(st.nx), u=np.ones(st.nu), e=np.ones(st.ne), duration=1.0)
        nlp = transcribe(st, mesh, ones)
        function = ca.Function("g", [nlp.w, nlp.p], [nlp.g])
        instructions = [function.instruction_MX(k) for k in range(function.n_instructions())]
        return {entry.which_function().name() for entry in instructions if entry.is_call()}

    assert any("propagate" in name for name in called("variance"))
    assert not any("propagate" in name or "step_matrix" in name for name in called("state"))


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_bounded_control(control):
    """min int u^2/2 - 3 x: u = 3 (1 - t), cut off at 2; the multiplier of the bound is 1 - 3 t until t = 1/3."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u", lower=-1.0, upper=2.0)
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * u**2 - 3 * x)
    solution = solve(ocp, intervals=30, control=control, tolerance=1e-10)
    assert solution.cost == pytest.approx(-1 - 4 / 9, rel=1e-6 if control == "linear" else 5e-4)
    if control == "linear":
        np.testing.assert_allclose(solution["u"], np.minimum(2, 3 * (1 - solution.t)), atol=1e-4)
        density = solution.multipliers.controls[1:9, 0] * 30
        np.testing.assert_allclose(density, 1 - 3 * solution.t[1:9], atol=1e-4)
    np.testing.assert_allclose(solution.costate("x"), -3 * (1 - solution.t), atol=1e-6)


def test_minimum_time():
    """Double integrator from 0 to 1, |u| <= 1: T = 2, bang-bang."""
    ocp = co.Problem(duration=co.Free(3.0, 0.5, 10.0))
    x, u = ocp.state("x", 2, initial=0, final=[1, 0]), ocp.control("u", lower=-1, upper=1)
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize(terminal=ocp.duration)
    solution = solve(ocp, intervals=20, control="constant")
    assert solution.duration == pytest.approx(2.0, rel=1e-6)
    np.testing.assert_allclose(solution["u"][:-1], np.repeat([1.0, -1.0], 10), atol=1e-4)


def test_initial_and_final_inequalities():
    """A free start on x1 + x2 = 1, x1 >= 0.8, carried to the origin at least cost: 0.8 and 0.2, J = (0.64 + 0.04)/2."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", 2, initial=None, final=0.0), ocp.control("u", 2)
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * ca.sumsqr(u))
    ocp.subject_to(ca.sum1(x), lower=1.0, upper=1.0, at="initial", name="line")
    ocp.subject_to(x[0], lower=0.8, upper=np.inf, at="initial", name="half plane")
    solution = solve(ocp, intervals=10)
    np.testing.assert_allclose(solution["x"][0], [0.8, 0.2], atol=1e-6)
    assert solution.cost == pytest.approx(0.34, rel=1e-6)


# --- other kinds of problems ------------------------------------------------------------------------------------------


def test_free_initial_state():
    """min int (u^2 + x^2)/2, x' = u, x(1) = 1, x(0) free: x = cosh t / cosh 1, J = tanh(1)/2, p(0) = 0."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=None, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * u**2 + 0.5 * x**2)
    solution = solve(ocp)
    np.testing.assert_allclose(solution["x"], np.cosh(solution.t) / np.cosh(1), atol=1e-7)
    assert solution.cost == pytest.approx(np.tanh(1) / 2, rel=1e-8)
    assert solution.costate("x")[0] == pytest.approx(0, abs=1e-8)


def test_vectors_partly_free():
    """Two independent copies of it, one with its start fixed instead of its end: x = cosh(1 - t)/cosh(1)."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", 2, initial=[None, 1.0], final=[1.0, None]), ocp.control("u", 2)
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * ca.sumsqr(u) + 0.5 * ca.sumsqr(x))
    solution = solve(ocp)
    assert solution["x"].shape == (101, 2)
    t = solution.t
    exact = np.column_stack([np.cosh(t), np.cosh(1 - t)]) / np.cosh(1)
    np.testing.assert_allclose(solution["x"], exact, atol=1e-7)
    np.testing.assert_allclose(solution["u"], np.column_stack([np.sinh(t), -np.sinh(1 - t)]) / np.cosh(1), atol=1e-4)
    assert solution.cost == pytest.approx(np.tanh(1), rel=1e-8)


def coupled():
    """x' = u + S, S' = 1/2, S(0) = 1: the control makes up for what S contributes, u = -1/4."""
    ocp = co.Problem(duration=1.0)
    x, u, S = ocp.state("x", initial=0.0, final=1.0), ocp.control("u"), ocp.symmetric("S", 1, initial=1.0)
    ocp.dynamics(x, u + S)
    ocp.dynamics(S, 0.5)
    ocp.minimize(running=0.5 * u**2)
    return ocp


def test_coupled_problem_is_solved_with_states():
    solution = solve(coupled())
    assert not solution.mesh.eliminated
    assert solution.mesh.step == "rk4"
    np.testing.assert_allclose(solution["u"], -0.25, atol=1e-9)
    assert solution.cost == pytest.approx(1 / 32, rel=1e-9)
    with pytest.raises(co.ProblemError, match="eliminated"):
        solve(coupled(), covariances="eliminated")


def test_coupled_nonlinear_problem_follows_its_equations():
    ocp = co.Problem(duration=2.0)
    x, u, S = ocp.state("x", initial=1.0), ocp.control("u"), ocp.symmetric("S", 1, initial=1.0, lower=0)
    ocp.dynamics(x, -S * x + u)
    ocp.dynamics(S, 1 - S**2 + x * S)
    ocp.minimize(0.5 * u**2 + 0.5 * x**2, S)
    solution = solve(ocp)

    def rate(t, z, u):
        return [-z[1] * z[0] + u, 1 - z[1] ** 2 + z[0] * z[1], 0.5 * u**2 + 0.5 * z[0] ** 2]

    z = simulate(rate, [1.0, 1.0, 0.0], solution.t, solution["u"])
    np.testing.assert_allclose(solution["x"], z[:, 0], atol=1e-7)
    np.testing.assert_allclose(solution["S"].ravel(), z[:, 1], atol=1e-7)
    assert solution.cost == pytest.approx(z[-1, 1] + z[-1, 2], rel=1e-8)


def unstable():
    ocp = co.Problem(duration=10.0)
    start = ocp.parameter("start", 1.0)
    x = ocp.state("x", initial=start, final=0.0, variance=0.1)
    b = ocp.unknown("b", mean=3.0, variance=0.1)
    u = ocp.control("u")
    ocp.dynamics(x, b * x - x**3 + u, noise=0.01)
    ocp.measurement("m", x, noise=0.01)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + x**2, terminal=E[b, b])
    return ocp


@pytest.mark.filterwarnings("ignore:.*along these controls alone")  # along its controls alone
@pytest.mark.parametrize("segments", [10, 50])
def test_unstable_nominal(segments):
    """Errors of the start grow by exp(30) on the way; p(0) = dJ/dx0 must not feel that, whatever the segments."""
    solver = co.Solver(unstable(), segments=segments)
    solution = solver.solve(progress=False)
    above, below = (
        solver.solve({"start": v}, guess=solution, progress=False, assess=False).cost for v in (1.001, 0.999)
    )
    assert solution.costate("x")[0] == pytest.approx((above - below) / 0.002, rel=1e-4)
    assert solution.optimality.stationarity < 1e-5
    assert solution.optimality.hamiltonian_variation < 1e-3


@pytest.mark.filterwarnings("ignore:.*along these controls alone")
def test_unstable_linear_nominal():
    """x' = 3 x + u, J = int (x^2 + u^2)/2: J = y(0)/2, y' = 1 - y^2 + 6 y backward from 0."""
    ocp = co.Problem(duration=10.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, 3 * x + u)
    ocp.minimize(running=0.5 * u**2 + 0.5 * x**2)
    riccati = solve_ivp(lambda t, y: 1 - y**2 + 6 * y, (0, 10), [0.0], rtol=1e-12, atol=1e-12).y[0, -1]
    solution = solve(ocp, intervals=400)
    assert solution.cost == pytest.approx(riccati / 2, rel=1e-5)
    assert solution.costate("x")[0] == pytest.approx(riccati, rel=1e-4)


@pytest.mark.parametrize("given", [True, False])
def test_scales(given):
    """The lag in other units (x in millionths, u in thousands) is the same problem, with and without given scales."""
    ocp = co.Problem(duration=10.0)
    x = ocp.state("x", initial=0.0, final=1e-6, variance=1e-12, scale=1e-6 if given else None)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u", scale=1e3 if given else None, guess=1e3)
    ocp.dynamics(x, -b * x + 1e-9 * u, noise=1e-12)
    ocp.measurement("m", x, noise=1e-12)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5e-6 * u**2, terminal=10 * E[b, b])
    solution = solve(ocp)
    assert solution.cost == pytest.approx(7.08523968, rel=1e-6)
    assert solution["x"][-1] == pytest.approx(1e-6, rel=1e-6)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_correlated_noise_that_depends_on_the_state(formulation):
    """The covariance along the solution is that of scipy, with U written out; perturbed controls cost more."""
    ocp = co.Problem(duration=3.0)
    x, u = ocp.state("x", 2, initial=0.0, final=[1, 0], variance=0.5), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, 0.1])
    ocp.measurement("m", x, noise=ca.blockcat([[1 + x[0] ** 2, 0.3], [0.3, 1 + x[1] ** 2]]))
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=ca.trace(E.matrix))
    solution = solve(ocp, covariances=formulation)
    F, Q = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, 0.1])

    def rate(t, z, u):
        E = z[2:6].reshape(2, 2)
        U = np.array([[1 + z[0] ** 2, 0.3], [0.3, 1 + z[1] ** 2]])
        slope = F @ E + E @ F.T + Q - E @ np.linalg.inv(U) @ E
        return [z[1], u, *slope.ravel(), 0.5 * u**2]

    start = [0, 0, 0.5, 0, 0, 0.5, 0]
    z = simulate(rate, start, solution.t, solution["u"])
    np.testing.assert_allclose(solution["E"].reshape(-1, 4), z[:, 2:6], atol=1e-7)
    cost = z[-1, 2] + z[-1, 5] + z[-1, 6]
    assert solution.cost == pytest.approx(cost, rel=1e-8)
    gain = solution.gains["K"]
    U = np.array([[1 + z[-1, 0] ** 2, 0.3], [0.3, 1 + z[-1, 1] ** 2]])
    np.testing.assert_allclose(gain[-1], solution["E"][-1] @ np.linalg.inv(U), rtol=1e-6)
    bump = np.cos(2 * np.pi * solution.t / 3) + 0.4 * np.sin(6 * np.pi * solution.t / 3)
    bump -= bump.mean()
    for size in (0.3, -0.3):
        moved = simulate(rate, start, solution.t, solution["u"] + size * bump)
        miss = moved[-1, :2] - [1, 0]
        change = moved[-1, 2] + moved[-1, 5] + moved[-1, 6] - cost
        # the Lagrangian, with the multipliers of the terminal conditions, has its minimum at the solution
        assert change + solution.multipliers.final @ miss > 0


def test_model_that_cannot_be_expanded():
    """A spline has no SX form: the statement falls back to MX. x' = -x + u to x = 1 costs 1/(1 - exp(-2))."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=1.0), ocp.control("u")
    ends = np.repeat([-3.0, 3.0], 4)
    line = ca.bspline(x, ca.DM([3.0, 1.0, -1.0, -3.0]), [ends.tolist()], [3], 1)  # -x, by its Greville abscissae
    ocp.dynamics(x, line + u, noise=0.1)
    ocp.measurement("m", x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=E[x, x])
    steady = np.sqrt(1.1) - 1  # y' = -2 y + 0.1 - y^2, in closed form by its two roots
    other = -np.sqrt(1.1) - 1
    ratio = (1 - steady) / (1 - other) * np.exp(-2 * np.sqrt(1.1))
    variance = (steady - other * ratio) / (1 - ratio)
    solution = solve(ocp, intervals=20)
    assert solution.statement.symbolic is ca.MX
    assert solution["E"][-1].item() == pytest.approx(variance, rel=1e-6)
    assert solution.cost == pytest.approx(1 / (1 - np.exp(-2)) + variance, rel=1e-5)


def test_problem_without_control():
    """Only the start is free: min (x(0) - 1)^2 + x(1)^2 under x' = -x."""
    ocp = co.Problem(duration=1.0)
    x, start = ocp.state("x", initial=None), ocp.state("start", initial=None)
    ocp.dynamics(x, -x)
    ocp.dynamics(start, 0)
    ocp.subject_to(x - start, lower=0.0, upper=0.0, at="initial", name="equal")
    ocp.minimize(terminal=(start - 1) ** 2 + x**2)
    solution = solve(ocp)
    assert solution["x"][0] == pytest.approx(1 / (1 + np.exp(-2)), rel=1e-7)


def test_path_inequality_on_a_large_covariance():
    """36 entries: eliminated, and the same minimum as with the entries as variables; the constraint binds."""
    free = solve(mass_chain.problem(masses=3), intervals=50)
    bound = ca.interpolant("bound", "linear", [free.t], 0.85 * free["E"][:, 6, 6])
    solutions = {}
    for formulation in ("auto", "states"):
        problem = mass_chain.problem(masses=3)
        (covariance,) = problem.declarations.matrices
        stiffness = covariance.matrix[6, 6]
        problem.subject_to(stiffness - bound(problem.time) - 0.25 * ca.exp(-0.4 * problem.time), name="stiffness")
        solutions[formulation] = solve(problem, covariances=formulation, intervals=50)
    auto = solutions["auto"]
    assert auto.mesh.eliminated
    assert auto.cost == pytest.approx(solutions["states"].cost, rel=1e-7)
    assert auto.cost > free.cost * (1 + 1e-5)
    assert auto.multipliers.path.max() > 1e-3
