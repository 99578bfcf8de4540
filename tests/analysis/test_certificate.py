"""The certificate of global optimality: the reduction against direct integration, the bound against the cost itself."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from lag_variants import lag, variant
from problems import unassessed
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, eigh, null_space

import covocp as co
from covocp.analysis.conditions import terminal_weight, why_not
from covocp.analysis.lower_bound import Bound
from covocp.analysis.mesh_bound import both_ends, divided, mesh_residual
from covocp.analysis.reduction import Reduction
from covocp.analysis.stages import Stages
from covocp.base.matrices import unpack
from covocp.models import damped_oscillator, unknown_lag
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Multipliers

EIGENVALUE = 0.43495704  # specification, 6.4: of the information operator on controls with x(T) = 0, T = 10


@lru_cache
def oscillator(naming: str, damping_weight: float, stiffness_weight: float) -> co.Solution:
    problem = damped_oscillator.problem(damping_weight, stiffness_weight, naming=naming)
    return co.solve(problem, intervals=80, progress=False)


@lru_cache
def certificate_of(solution: co.Solution) -> co.Certificate:
    return co.certify(solution)


def two_parameters() -> co.Problem:
    """All that the theory allows: time, known inputs, two unknowns that are also measured, correlated noise."""
    ocp = co.Problem(4.0, name="two parameters")
    x = ocp.state("x", 2, initial=[0.3, -0.2], final=[1.0, None], variance=[0.5, 0.2])
    b = ocp.unknown("b", mean=[1.0, 0.4], variance=np.array([[0.5, 0.1], [0.1, 0.3]]))
    u = ocp.control("u", 2, guess=lambda s: np.stack([np.sin(3 * s), np.cos(2 * s)], axis=1))
    table = ca.interpolant("table", "linear", [[0.0, 2.0, 4.0]], [0.1, 0.4, 0.2])(ocp.time)
    ocp.dynamics(x, ca.vertcat(x[1] + b[1] * u[1], -b[0] * x[0] - 0.5 * x[1] + u[0] + table), noise=[0.1, 0.2])
    modes = ca.vertcat(x[0] + 0.2 * b[1] * u[0] * ca.cos(ocp.time), x[1] + b[0] * x[1] + 0.3 * b[0])
    ocp.measurement("modes", modes, noise=np.array([[0.3, 0.1], [0.1, 0.4]]))
    E = ocp.estimation_covariance()
    running = 0.5 * u[0] ** 2 + u[1] ** 2 + 0.2 * u[0] * u[1] + 0.1 * (x[0] - 1) ** 2 + 0.05 * x[0] * u[1]
    ocp.minimize(running=running, terminal=5 * E[b[0], b[0]] + E[b[1], b[1]] + 0.3 * x[1] ** 2)
    return ocp


def mesh(intervals: int, substeps: int = 1, control: str = "linear") -> Mesh:
    return Mesh(
        nodes=np.linspace(0, 1, intervals + 1),
        control=control,
        substeps=substeps,
        segments=(intervals,),
        eliminated=True,
        step="gauss",
    )


def random_control(grid: Mesh, size: int, seed: int) -> np.ndarray:
    """A smooth control, in the transcription of the mesh."""
    nodes = grid.nodes if grid.control == "linear" else 0.5 * (grid.nodes[1:] + grid.nodes[:-1])
    orders = np.arange(5)
    return np.cos(np.pi * np.outer(nodes, orders)) @ np.random.default_rng(seed).standard_normal((5, size))


def kalman_bucy(problem: co.Problem, grid: Mesh, u: np.ndarray) -> np.ndarray:
    """E(T) by integrating nominal and full covariance, an interval at a time."""
    st = problem.statement()
    duration = st.duration.guess
    x0, _, e0, _ = st.boundary_values(st.values)
    z = np.concatenate([x0, e0])
    for k, (a, b) in enumerate(zip(grid.nodes[:-1], grid.nodes[1:], strict=True)):
        after = u[k + 1] if grid.control == "linear" else u[k]

        def rate(t: float, z: np.ndarray, k: int = k, a: float = a, b: float = b, after: Any = after) -> np.ndarray:
            control = u[k] + (t / duration - a) / (b - a) * (after - u[k])
            rates = st.rates(z[: st.nx], control, z[st.nx :], t, duration, st.values)
            return np.concatenate([np.asarray(v.full()).ravel() for v in rates[:2]])

        z = solve_ivp(rate, (duration * a, duration * b), z, rtol=1e-9, atol=1e-11, method="DOP853").y[:, -1]
    return unpack(z[st.nx :], st.matrices[0].size)


@pytest.mark.parametrize(
    ("problem", "substeps", "control"),
    [
        (unknown_lag.problem(), 12, "linear"),
        (damped_oscillator.problem(), 12, "linear"),
        (two_parameters(), 6, "linear"),
        (two_parameters(), 6, "constant"),
    ],
)
def test_the_reduction_is_the_kalman_bucy_covariance(problem: co.Problem, substeps: int, control: str) -> None:
    st = problem.statement()
    errors = []
    for factor in (1, 2):
        grid = mesh(20, factor * substeps, control)
        u = random_control(grid, st.nu, seed=3)
        reduction = Reduction(st, grid, st.values)
        filtered, S, information = reduction.covariance(u)
        covariance = np.linalg.inv(information)
        E = np.block([[filtered + S @ covariance @ S.T, S @ covariance], [covariance @ S.T, covariance]])
        if factor == 1:
            direct = kalman_bucy(problem, grid, u)
        errors.append(np.abs(E - direct).max() / np.abs(direct).max())
    assert errors[1] < 1e-6
    # Order 4: 16 times less, down to the error of the direct integration.
    assert errors[1] < errors[0] / 10 or errors[1] < 1e-8


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_stages_give_information_cost_and_states_of_any_control(control: str) -> None:
    problem = two_parameters()
    st, grid = problem.statement(), mesh(15, 8, control)
    u = random_control(grid, st.nu, seed=4)
    reduction = Reduction(st, grid, st.values)
    stages = Stages.of(reduction)
    ends = np.hstack([u, u]) if control == "constant" else np.hstack([u[:-1], u[1:]])
    zeta = stages.trajectory(ends)
    assert stages.information(zeta) == pytest.approx(reduction.covariance(u)[2], rel=1e-10)
    weight = np.array([[2.0, 0.5], [0.5, 1.0]])
    grown = np.einsum("ki,kij,kj->", zeta[:-1], stages.weighted(weight), zeta[:-1]) / 2
    assert grown == pytest.approx(np.trace(weight @ (stages.information(zeta) - reduction.prior)), rel=1e-10)
    state, cost = np.append(st.boundary_values(st.values)[0], 0.0), 0.0
    for k in range(15):

        def rate(t: float, z: np.ndarray, k: int = k) -> np.ndarray:
            first, last = np.split(ends[k], 2)
            outputs = st.rates(z[:-1], first + (t / 4 * 15 - k) * (last - first), np.zeros(st.ne), t, 4.0, st.values)
            return np.append(np.asarray(outputs[0].full()), float(outputs[2]))

        state = solve_ivp(rate, (4 * k / 15, 4 * (k + 1) / 15), state, rtol=1e-10, atol=1e-12).y[:, -1]
    cost = np.einsum("ki,kij,kj->", zeta[:-1], stages.running, zeta[:-1]) / 2
    assert zeta[-1, :2] == pytest.approx(state[:2], rel=1e-5)
    assert cost == pytest.approx(state[2], rel=1e-5)


def dense(stages: Stages, hessian: np.ndarray) -> np.ndarray:
    """The quadratic form of the control values of all stages, a column at a time."""
    count, s, width = stages.ends.shape[0], stages.size, stages.energy.shape[1]
    columns = []
    for unit in np.eye(count * width):
        w = unit.reshape(count, width)
        xi = stages.changes(w)
        local = np.einsum("kij,kj->ki", hessian[:, :-1, :-1], np.hstack([xi[:-1], w]))
        columns.append(stages.slopes(np.vstack([local[:, :s], np.zeros((1, s))]), local[:, s:]).ravel())
    return np.array(columns)


def information_eigenvalue(intervals: int) -> float:
    """Largest eigenvalue of G on the controls with x(T) = 0, in the metric int u^2."""
    st = unknown_lag.problem().statement()
    stages = Stages.of(Reduction(st, mesh(intervals), st.values))
    last = np.zeros((intervals + 1, stages.size))
    last[-1, 0] = 1.0
    basis = null_space(stages.slopes(last, np.zeros((intervals, 2))).reshape(1, -1))
    forms = (dense(stages, stages.weighted(np.eye(1))) / 2, block_diag(*stages.energy))
    return float(eigh(*(basis.T @ form @ basis for form in forms), eigvals_only=True)[-1])


def test_the_operator_has_the_eigenvalue_of_the_closed_form() -> None:
    exact = unknown_lag.exact().eigenvalue
    assert exact == pytest.approx(EIGENVALUE, abs=5e-9)
    errors = [abs(information_eigenvalue(n) - exact) for n in (25, 50, 100)]
    assert errors[2] < 1e-7
    # Order 4 of the Gauss steps and of the eigenvalues on piecewise linear controls.
    assert 3.5 < np.log2(errors[0] / errors[1]) < 4.5
    assert 3.5 < np.log2(errors[1] / errors[2]) < 4.5


@pytest.mark.parametrize(("weight", "final"), [(10.0, 0.0), (1.0, 1.0)])
def test_costate_of_the_parameters_at_the_start(weight: float, final: float) -> None:
    """Consequence (ii): P_bb(0) = Lambda_0 E_bb(T) C_bb E_bb(T) Lambda_0."""
    solution = lag(weight, final)
    information = Reduction(solution.statement, solution.mesh, solution.parameters).covariance(solution.trajectory.u)[2]
    expected = 0.2**2 * weight / information[0, 0] ** 2
    # The costates are adjoint to the discrete steps, for which the reduction is exact: only roundoff remains.
    assert solution.costate("E")[0, 1, 1] == pytest.approx(expected, rel=1e-9)


def test_costates_of_two_parameters_at_the_start() -> None:
    solution = oscillator("table", 0.0, 1000.0)
    information = Reduction(solution.statement, solution.mesh, solution.parameters).covariance(solution.trajectory.u)[2]
    gain = np.linalg.inv(information) / 0.2
    expected = gain.T @ np.diag([0.0, 1000.0]) @ gain
    assert solution.costate("E")[0, 2:, 2:] == pytest.approx(expected, rel=1e-8)


def test_the_bound_touches_the_cost_and_is_never_above_it() -> None:
    solution = oscillator("equations", 0.0, 1000.0)
    extremal = solution.extremal
    bound = Bound.at(extremal, extremal.mesh, both_ends(extremal))
    st, stages = extremal.statement, bound.stages
    C = terminal_weight(st, solution.parameters)[st.nx :, st.nx :]
    S_c = np.linalg.solve(bound.information, np.linalg.solve(bound.information, C).T)
    base = bound.zeta[:-1, stages.size : -1]

    def parts(change: np.ndarray) -> tuple[float, np.ndarray]:
        zeta = stages.trajectory(base + change)
        return float(np.einsum("ki,kij,kj->", zeta[:-1], stages.running, zeta[:-1]) / 2), stages.information(zeta)

    def cost(change: np.ndarray) -> float:
        energy, information = parts(change)
        return energy + float(np.trace(C @ np.linalg.inv(information)))

    def lower(change: np.ndarray) -> float:
        energy, information = parts(change)
        return energy + bound.uncertain - float(np.trace(S_c @ (information - bound.information)))

    still = np.zeros_like(base)
    assert cost(still) == pytest.approx(solution.cost, rel=1e-7)
    assert bound.cost == pytest.approx(cost(still), rel=1e-12)
    assert lower(still) == pytest.approx(cost(still), rel=1e-12)
    v = np.random.default_rng(5).standard_normal(base.size)
    v -= bound.held @ (bound.held.T @ v)
    direction = stages.controls(v.reshape(base.shape))
    for size in (-3.0, -0.3, -0.01, 0.01, 0.3, 3.0):
        assert lower(size * direction) <= cost(size * direction)
    # Slope and curvature of the bound, in the units of the energy, are those of these costs.
    second = (lower(direction) + lower(-direction) - 2 * lower(still)) / 2
    assert v @ bound.apply(bound.curvature, v) / 2 == pytest.approx(second, rel=1e-8)
    assert bound.slope @ v == pytest.approx((lower(direction) - lower(-direction)) / 2, rel=1e-6)


@pytest.mark.parametrize("weight", [0.1, 1.0, 10.0])
def test_equilibrium_identification_is_certified_with_eigenvalue_zero(weight: float) -> None:
    """5.2: u is the eigenfunction itself, so the second variation vanishes along it."""
    certificate = certificate_of(lag(weight, 0.0))
    assert certificate.certified, str(certificate)
    assert abs(certificate.smallest_eigenvalue) < 1e-4
    assert certificate.gap < 2e-4 * lag(weight, 0.0).cost
    exact = unknown_lag.exact(weight=weight).cost
    assert lag(weight, 0.0).cost - certificate.gap <= exact


@pytest.mark.parametrize("weight", [0.1, 1.0, 10.0])
def test_transient_identification_is_certified(weight: float) -> None:
    certificate = certificate_of(lag(weight, 1.0))
    assert certificate.certified, str(certificate)
    assert certificate.smallest_eigenvalue > 100 * certificate.tolerance
    assert certificate.consistency < 1e-10
    assert certificate.mesh_gap < certificate.gap < 1e-6 * lag(weight, 1.0).cost


def test_the_second_local_minimum_is_not_certified() -> None:
    solution = lag(10.0, 1.0, second=True)
    assert solution.cost == pytest.approx(7.71199239, abs=1e-5)
    certificate = certificate_of(solution)
    assert certificate.verdict == "not certified"
    assert certificate.smallest_eigenvalue < -0.01
    assert "better control may exist" in certificate.reason
    # The true difference to the global minimum shows that the bound must fall at least so far.
    assert certificate.gap > solution.cost - lag(10.0, 1.0).cost


def test_zero_control_is_certified_below_the_threshold_and_a_saddle_above_it() -> None:
    """u = 0 is stationary for every weight; there S^c = 25 C22 and the eigenvalue is 1 - 50 C22 lambda."""
    still = lag(0.04, 0.0)
    assert np.abs(still.trajectory.u).max() < 1e-6
    certificate = co.certify(still)
    assert certificate.certified, str(certificate)
    assert certificate.smallest_eigenvalue == pytest.approx(1 - 50 * 0.04 * EIGENVALUE, abs=1e-5)
    extremal = replace(still.extremal, parameters=np.array([10.0, 1.0]))
    saddle = replace(still, extremal=extremal, cost_terms={"terminal": 50.0, "running": 0.0})
    certificate = co.certify(saddle)
    assert certificate.verdict == "not certified"
    assert certificate.smallest_eigenvalue == pytest.approx(1 - 500 * EIGENVALUE, rel=1e-6)


@pytest.mark.parametrize(
    ("naming", "damping_weight", "stiffness_weight", "certified"),
    [
        ("table", 0.0, 0.0, True),
        ("table", 1000.0, 0.0, True),
        ("table", 0.0, 1000.0, True),
        ("equations", 0.0, 0.0, True),
        # Has a second local minimum only 0.44 above; the bound is too weak to exclude others.
        ("equations", 1000.0, 0.0, False),
        ("equations", 0.0, 1000.0, True),
    ],
)
def test_damped_oscillator(naming: str, damping_weight: float, stiffness_weight: float, certified: bool) -> None:
    solution = oscillator(naming, damping_weight, stiffness_weight)
    certificate = certificate_of(solution)
    assert certificate.certified == certified, str(certificate)
    assert certificate.consistency < 1e-10
    if not damping_weight and not stiffness_weight:
        assert certificate.smallest_eigenvalue == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize("measurement_noise", [1e-3, 1e-6])
def test_accurate_measurement(measurement_noise: float) -> None:
    """Stiff Riccati equations; classical Runge-Kutta steps overflow here."""
    problem = variant(final=0.0, density=lambda x, u: measurement_noise)
    certificate = co.certify(co.solve(problem, intervals=100, progress=False))
    assert certificate.certified, str(certificate)
    assert abs(certificate.smallest_eigenvalue) < 1e-4


def test_interpolation_tables_and_vectors_meet_the_conditions() -> None:
    solution = co.solve(two_parameters(), intervals=40, progress=False)
    assert why_not(solution.statement, solution.parameters) == ""
    certificate = co.certify(solution)
    assert certificate.consistency < 1e-10
    assert certificate.mesh_gap < 1e-6 * solution.cost


@pytest.mark.parametrize(
    "changes",
    [
        {"control": {"lower": -1.2, "upper": 1.2}},
        {"extra": lambda ocp, x, u, E, b: ocp.subject_to(x + 0.5 * u, upper=1.6)},
        {"final": 0.3, "state": {"upper": 0.4}, "terminal": lambda x, E, b: E[b, b]},
        {"extra": lambda ocp, x, u, E, b: ocp.subject_to(x + u, lower=1.5, upper=2.0, at="initial")},
        {"final": None, "extra": lambda ocp, x, u, E, b: ocp.subject_to(x, lower=0.7, upper=1.0, at="final")},
        {"final": None, "state": {"upper": 0.6}, "terminal": lambda x, E, b: E[b, b] - x},
    ],
)
@pytest.mark.parametrize("mesh", [{"intervals": 50}, {"intervals": 17, "points": 3}])
def test_multipliers_of_convex_constraints_make_the_solution_stationary(
    changes: dict[str, Any], mesh: dict[str, Any]
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # the second mesh is coarse
        solution = co.solve(variant(**changes), progress=False, **mesh)
    extremal = solution.extremal
    ends = both_ends(extremal)
    bare = Multipliers.zero(extremal.statement, extremal.mesh)
    without, _ = mesh_residual(replace(extremal, multipliers=bare), ends)
    residual, slack = mesh_residual(extremal, ends)
    assert without > 1e-3 * np.sqrt(2 * solution.cost)  # the constraint acts
    assert residual < 1e-5 * np.sqrt(2 * solution.cost)
    assert abs(slack) < 1e-6 * solution.cost


def test_limits_that_act_inside_the_intervals_are_part_of_the_bound() -> None:
    """Without their multipliers the slope that is left makes room for controls that cost less."""
    changes: dict[str, Any] = {"final": 0.0, "state": {"upper": 0.7}, "terminal": lambda x, E, b: 0.2 * E[b, b]}
    changes["running"] = lambda x, u, E, b: 0.5 * (u - 1.0) ** 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        solution = co.solve(variant(**changes), intervals=20, points=4, progress=False)
        finest = unassessed(variant(**changes), intervals=200)
    assert np.abs(solution.multipliers.inside_states).max() > 1e-3
    certificate = co.certify(solution, progress=False)
    assert certificate.mesh_gap < 1e-5 * solution.cost
    assert solution.cost - finest.cost < certificate.gap < 0.1 * solution.cost


def test_terminal_equalities_restrict_the_directions() -> None:
    def end(ocp: co.Problem, x: Any, u: Any, E: Any, b: Any) -> None:
        ocp.subject_to(2 * x + 0.0 * u, lower=2.0, upper=2.0, at="final")

    certificate = co.certify(co.solve(variant(final=None, extra=end), intervals=100, progress=False))
    fixed = certificate_of(lag(10.0, 1.0))
    assert certificate.certified
    assert certificate.smallest_eigenvalue == pytest.approx(fixed.smallest_eigenvalue, rel=1e-4)


@pytest.mark.parametrize(("intervals", "control"), [(1, "linear"), (4, "constant"), (10, "linear"), (60, "constant")])
def test_no_control_of_a_finer_mesh_costs_less_by_more_than_the_gap(intervals: int, control: str) -> None:
    """Whether certified or not; what the gap leaves is mostly what the finer mesh gains."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # coarse meshes
        solution = co.solve(unknown_lag.problem(final=1.0), intervals=intervals, control=control, progress=False)
    best = 7.0852396843  # of 400 intervals, to 1e-9
    certificate = co.certify(solution)
    assert solution.cost - best <= certificate.gap
    assert certificate.certified == (intervals >= 10)
    if not certificate.certified:
        assert "a freer one may by up to" in certificate.reason
    if intervals >= 4:
        assert certificate.gap < 5 * (solution.cost - best) + 1e-6


def test_the_gap_holds_for_bounded_controls_between_the_nodes() -> None:
    problem = {"control": {"lower": -1.2, "upper": 1.2}}
    best = unassessed(variant(**problem), intervals=200).cost
    for control in ("linear", "constant"):
        solution = co.solve(variant(**problem), intervals=25, control=control, progress=False)
        assert solution.cost - best <= co.certify(solution).gap


def test_a_solution_of_another_discretisation_shows_in_the_consistency() -> None:
    with pytest.warns(co.CovocpWarning, match="too coarse"):
        solution = co.solve(
            unknown_lag.problem(final=0.0), intervals=30, substeps=1, covariance_step="strang", progress=False
        )
    certificate = co.certify(solution)
    assert certificate.verdict == "not certified"
    assert certificate.consistency > 1e-4


def test_what_violates_the_constraints_of_the_problem_is_not_certified() -> None:
    free = lag(10.0, 1.0)
    lid = {"extra": lambda ocp, x, u, E, b: ocp.subject_to(x, upper=0.5, name="lid")}
    for changes, named in (({"final": 2.0}, "x"), (lid, "lid"), ({"control": {"upper": 0.5}}, "u")):
        certificate = co.certify(co.evaluate(variant(**changes), nominal=free, intervals=80))
        assert certificate.verdict == "not certified"
        assert named in certificate.reason
        assert "violates" in certificate.reason


def test_certifying_takes_time_in_proportion_to_the_intervals() -> None:
    """Operations are counted by what is stored: nothing has two axes of control values."""
    st = unknown_lag.problem().statement()
    sizes = []
    for n in (20, 40):
        stages = Stages.of(Reduction(st, mesh(n), st.values))
        sizes.append(sum(getattr(stages, name).size for name in ("ends", "left", "right", "running", "energy")))
    assert sizes[1] == 2 * sizes[0]


def test_a_run_that_did_not_converge_is_not_certified() -> None:
    certificate = co.certify(replace(lag(10.0, 1.0), converged=False, message="stopped"))
    assert certificate.verdict == "not certified"
    assert "did not converge (stopped)" in certificate.reason


def test_dividing_keeps_the_control() -> None:
    grid = mesh(4)
    u = random_control(grid, 2, seed=1)
    finer, values = divided(grid, np.hstack([u[:-1], u[1:]]), 3)
    assert finer.nodes == pytest.approx(np.linspace(0, 1, 13))
    for column in range(2):
        at = np.interp(finer.nodes, grid.nodes, u[:, column])
        assert values[:, column] == pytest.approx(at[:-1])
        assert values[:, 2 + column] == pytest.approx(at[1:])


def test_printout_is_a_sentence() -> None:
    text = str(certificate_of(lag(10.0, 1.0)))
    assert text.startswith("global minimum (certified): no admissible control of finite energy costs less by")
    assert "smallest eigenvalue 0.0542" in text
    assert "\n" not in text
    assert str(certificate_of(lag(10.0, 1.0, second=True))).startswith("not certified: ")
