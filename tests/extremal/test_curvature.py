"""The sign of the reduced Hessian against closed forms and an NLP written out: active constraints, unstable plants."""

from __future__ import annotations

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import eigh, null_space

import covocp as co
from covocp.extremal import curvature
from covocp.extremal.curvature import smallest_curvature
from covocp.extremal.metric import mass_matrix
from covocp.transcription.trajectory import Multipliers


def solve(problem, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return co.solve(problem, progress=False, **options)


def at_rest(problem, intervals, **options):
    """Everything zero, without multipliers: stationary for the problems below."""
    solution = co.solve(
        problem, intervals=intervals, max_iterations=0, allow_failure=True, progress=False, **options
    ).extremal
    t = solution.trajectory
    still = replace(t, x=np.zeros_like(t.x), u=np.zeros_like(t.u))
    return replace(solution, trajectory=still, multipliers=Multipliers.zero(solution.statement, solution.mesh))


def quadratic(a, c, duration, *, final=0.0, lower=-np.inf, beside=False):
    """x' = a x + u, J = int (u^2 - c x^2)/2: u = 0 is stationary; beside it a cart that runs into a wall."""
    ocp = co.Problem(duration=duration)
    x, u = ocp.state("x", initial=0.0, final=final), ocp.control("u", lower=lower, guess=lambda s: 0 * s)
    ocp.dynamics(x, a * x + u)
    cost = 0.5 * u**2 - 0.5 * c * x**2
    if beside:
        y = ocp.state("y", initial=0.0, final=0.0, upper=0.1)
        v = ocp.control("v", guess=lambda s: 0 * s)
        ocp.dynamics(y, v)
        cost += 0.5 * (v - 1.0 + 2.0 * ocp.time / duration) ** 2
    ocp.minimize(running=cost)
    return ocp


@pytest.mark.filterwarnings("ignore:This is no minimum")  # a run of no steps at a saddle
@pytest.mark.parametrize("control", ["linear", "constant"])
@pytest.mark.parametrize(("a", "duration"), [(0.0, 2.0), (4.0, 8.0), (-1.0, 5.0)])
def test_conjugate_point_of_a_plant_that_may_be_unstable(a, duration, control):
    """With x = 0 at both ends the second variation is int x'^2 + (a^2 - c) x^2: positive iff c < a^2 + (pi/T)^2."""
    limit = a**2 + (np.pi / duration) ** 2
    verdicts = [
        smallest_curvature(at_rest(quadratic(a, share * limit, duration), 120, control=control)).verdict
        for share in (0.97, 1.03)
    ]
    assert verdicts == ["minimum", "saddle"]


@pytest.mark.parametrize(("a", "duration"), [(2.0, 8.0), (6.0, 8.0)])
def test_a_convex_problem_of_an_unstable_plant_has_a_minimum(a, duration):
    ocp = co.Problem(duration=duration)
    x = ocp.state("x", 2, initial=[1.0, 0.0], final=[0.5, 0.0], guess=0.5)
    u = ocp.control("u", guess=lambda s: 0 * s)
    ocp.dynamics(x, ca.vertcat(x[1], a * a * x[0] + u))
    ocp.minimize(running=0.5 * u**2 + 0.5 * ca.sumsqr(x))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # the mesh is coarse for this plant
        solution = co.solve(ocp, intervals=100, progress=False)
    assert smallest_curvature(solution.extremal).verdict == "minimum"


@pytest.mark.parametrize("points", [1, 2])
@pytest.mark.parametrize(("share", "verdict"), [(0.9, "minimum"), (1.1, "saddle")])
def test_a_saddle_beside_an_active_state_bound_is_told(share, verdict, points):
    """The cart's motion and x = 0 beside it are stationary for every c; a solver would leave a saddle for infinity."""
    convex, problem = (quadratic(0.0, c * np.pi**2, 1.0, beside=True) for c in (0.5, share))
    solution = solve(convex, intervals=40, tolerance=1e-9, points=points)
    assert np.ptp(np.flatnonzero(solution["y"] > 0.0999)) > 3  # it rests at the wall
    x = solution.trajectory.x.copy()
    assert np.abs(x[:, 0]).max() < 1e-6
    x[:, 0] = 0.0
    still = replace(solution.trajectory, x=x)
    extremal = replace(solution.extremal, stated=problem.statement(), trajectory=still)
    assert smallest_curvature(extremal).verdict == verdict


def test_bounds_that_only_just_hold_leave_the_directions_they_allow():
    """u >= 0 at u = 0: with x(T) free one may push, and gains where c > (pi/2T)^2; with x(T) = 0 nothing may move."""
    limit = (np.pi / 2) ** 2
    pushed = [
        smallest_curvature(at_rest(quadratic(0.0, s * limit, 1.0, final=None, lower=0.0), 30)) for s in (0.9, 1.1)
    ]
    assert [found.verdict for found in pushed] == ["minimum", "saddle"]
    assert (pushed[1].direction >= -1e-9).all()
    held = smallest_curvature(at_rest(quadratic(0.0, 40.0, 1.0, lower=0.0), 30))
    assert (held.value, held.verdict) == (np.inf, "minimum")  # no direction is left


@pytest.mark.parametrize(("bound", "points"), [(0.9, 1), (0.5, 1), (0.5, 3)])
def test_information_under_a_state_bound_is_no_false_alarm(bound, points):
    """The last state is at its bound as well, whose multiplier is that of the terminal state."""
    ocp = co.Problem(5.0)
    x = ocp.state("x", initial=0.0, lower=-bound, upper=bound)
    a = ocp.unknown("a", mean=1.0, variance=1.0)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, -a * x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(terminal=E[a, a])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # between the points the lower bound is passed
        solution = co.solve(ocp, intervals=50, points=points, progress=False)
    assert "NOT A MINIMUM" not in str(solution)
    curvature = solution.optimality.curvature  # None at a vertex: limits leave no direction
    assert curvature is None or curvature >= 0.0


def oscillator(running):
    ocp = co.Problem(duration=4.0)
    x, u = ocp.state("x", 2, initial=[0.0, 1.0], final=[None, 0.2]), ocp.control("u", guess=lambda s: 0 * s)
    ocp.dynamics(x, rate(x, u))
    ocp.subject_to(x[0] + 0.1 * x[1] ** 2, upper=0.45, name="wall")
    ocp.minimize(running=running(x, u))
    return ocp


def rate(x, u):
    return ca.vertcat(x[1], (1 - x[0] ** 2) * x[1] - x[0] + u)


def test_curvature_is_that_of_the_exact_hessian_of_an_nlp_written_out():
    """Van der Pol's oscillator along a wall: single shooting, exact Hessian, dense null space of what is active."""
    running = lambda x, u: 0.5 * u**2 + 0.3 * ca.cos(2 * x[0]) + 0.1 * x[1] ** 2  # noqa: E731
    solution = solve(oscillator(running), intervals=20, substeps=4, tolerance=1e-9)
    n, m, h = 20, 4, 4.0 / 20 / 4
    u, state, cost, walls = ca.SX.sym("u", n + 1), ca.SX([0.0, 1.0]), 0, [ca.SX(0.1)]

    def flow(z, w):
        return ca.vertcat(rate(z[:2], w), running(z[:2], w))

    for k in range(n):
        z = ca.vertcat(state, cost)
        for j in range(m):
            ua, um, ub = (u[k] + (j + c) / m * (u[k + 1] - u[k]) for c in (0.0, 0.5, 1.0))
            k1 = flow(z, ua)
            k2 = flow(z + h / 2 * k1, um)
            k3 = flow(z + h / 2 * k2, um)
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + flow(z + h * k3, ub))
        state, cost = z[:2], z[2]
        walls.append(state[0] + 0.1 * state[1] ** 2)
    wall = ca.vertcat(*walls)
    weights = solution.multiplier("wall")
    active = np.flatnonzero(weights > 1e-4 * weights.max()).tolist()
    assert active
    value = cost + solution.multipliers.final[1] * state[1] + ca.dot(ca.DM(weights), wall)
    hessian, slope = ca.hessian(value, u)
    rows = ca.jacobian(ca.vertcat(state[1], wall[active]), u)
    H, g, J = (np.asarray(v.full()) for v in ca.Function("nlp", [u], [hessian, slope, ca.densify(rows)])(solution["u"]))
    assert np.abs(g).max() < 1e-6
    basis = null_space(J)
    M = mass_matrix(solution.mesh, 4.0, 1).full()
    exact = eigh(basis.T @ H @ basis, basis.T @ M @ basis, eigvals_only=True)
    found = smallest_curvature(solution.extremal)
    assert found.value == pytest.approx(exact[0], rel=1e-4)
    assert found.largest == pytest.approx(max(abs(exact)), rel=1e-3)


def test_a_direction_without_curvature_is_called_flat():
    """Two controls that do the same: their difference costs nothing."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u", 2, guess=lambda s: np.zeros((s.size, 2)))
    ocp.dynamics(x, u[0] + u[1])
    ocp.minimize(running=0.5 * (u[0] + u[1]) ** 2)
    solution = solve(ocp, intervals=10)
    assert smallest_curvature(solution.extremal).verdict == "flat"
    assert solution.optimality.curvature == 0.0
    assert "flat" in str(solution)


def test_a_free_initial_state_counts():
    """J = int x^2/2 - x(0)^2/2 with x' = u, u^2/2: x(0) = 0 is a saddle, because a constant x gains for T < 1."""
    verdicts = []
    for duration in (0.5, 2.0):
        ocp = co.Problem(duration=duration)
        x, u = ocp.state("x", initial=None, guess=0.0), ocp.control("u", guess=lambda s: 0 * s)
        y = ocp.state("y", initial=None, guess=0.0)
        ocp.dynamics(x, u)
        ocp.dynamics(y, 0 * u)
        ocp.subject_to(y - x, lower=0.0, upper=0.0, at="initial")
        ocp.minimize(running=0.5 * x**2 + 50.0 * u**2, terminal=-0.5 * y**2)
        verdicts.append(smallest_curvature(at_rest(ocp, 20)).verdict)
    assert verdicts == ["saddle", "minimum"]


def test_a_curvature_that_would_take_too_long_is_not_known(monkeypatch):
    """A product with the Hessian is looked at first: none is waited for where all of them would take too long."""
    extremal = at_rest(quadratic(1.0, 0.9, 1.0), 30)
    products = []
    monkeypatch.setattr(curvature, "_seconds", lambda *_: products.append(1) or 1.0)
    monkeypatch.setattr(curvature, "FEW_NUMBERS", 0)
    assert smallest_curvature(extremal, 5.0).verdict == "unknown"
    known = smallest_curvature(extremal, 1e6)
    assert known.value == smallest_curvature(extremal).value
    few = smallest_curvature(extremal, 10.0)  # ten steps, which do not separate 30 eigenvalues
    assert few.verdict in ("unknown", known.verdict)
    assert len(products) == 4


def test_what_is_not_known_of_a_solution_is_said(monkeypatch):
    monkeypatch.setattr(curvature, "_seconds", lambda *_: 1e9)
    monkeypatch.setattr(curvature, "FEW_NUMBERS", 0)
    solution = solve(quadratic(0.0, 0.5, 1.0), intervals=10)
    assert np.isnan(solution.optimality.curvature)
    assert "NOT KNOWN: it would take longer" in " ".join(str(solution).split())


def beside_a_bound():
    """J = (int u^2 - 2.5 (int u a)^2 - (int u b)^2 + 30 (int u c)^2)/2, u >= 0: at u = 0 no bound has a multiplier."""
    ocp = co.Problem(duration=1.0)
    y, u = ocp.state("y", 3, initial=[0.0, 0.0, 0.0]), ocp.control("u", lower=0.0, guess=lambda s: 0 * s)
    turn = 2 * np.pi * ocp.time
    ocp.dynamics(y, u * ca.vertcat(ca.cos(turn), 1 - 0.6 * ca.cos(2 * turn), ca.cos(3 * turn)))
    ocp.minimize(running=0.5 * u**2, terminal=0.5 * (-2.5 * y[0] ** 2 - y[1] ** 2 + 30 * y[2] ** 2))
    return ocp


def counted_products(monkeypatch):
    """A list that has one more entry with each product of a Hessian and a direction."""
    products, made = [], curvature.product_along

    def counted(*given):
        once, *others = made(*given)
        return lambda direction: products.append(1) or once(direction), *others

    monkeypatch.setattr(curvature, "product_along", counted)
    return products


def test_a_saddle_is_no_minimum_where_few_products_can_be_waited_for(monkeypatch):
    """Of directions that bounds allow the descending one is found after some steps: without them nothing is known."""
    extremal = at_rest(beside_a_bound(), 40)
    found = smallest_curvature(extremal)
    s, u = extremal.mesh.nodes, found.direction.ravel()
    fine = np.linspace(0.0, 1.0, 4001)
    v = np.interp(fine, s, u / np.abs(u).max())
    turn = 2 * np.pi * fine
    a, b, c = (np.trapezoid(v * w, fine) for w in (np.cos(turn), 1 - 0.6 * np.cos(2 * turn), np.cos(3 * turn)))
    assert v.min() >= -1e-9
    assert np.trapezoid(v**2, fine) - 2.5 * a**2 - b**2 + 30 * c**2 < 0  # so it is a saddle
    products = counted_products(monkeypatch)
    monkeypatch.setattr(curvature, "_seconds", lambda *_: 1.0)
    monkeypatch.setattr(curvature, "FEW_NUMBERS", 0)
    for most in (9.01, 10.0, 12.0, 20.0, 40.0, 80.0):
        products.clear()
        assert smallest_curvature(extremal, most).verdict in ("unknown", "saddle")
        assert len(products) <= most


def test_the_look_at_where_a_run_ended_takes_no_longer_than_it_may(monkeypatch):
    """A run that ends where it began is looked at, but not for as long as it takes."""
    products = counted_products(monkeypatch)
    counts = []
    for each, options in ((0.0, {}), (1.1, {}), (1.1, {"time_limit": 5.0}), (1e9, {})):
        monkeypatch.setattr(curvature, "_seconds", lambda *_, each=each: max(each, 1e-9))
        products.clear()
        co.Solver(quadratic(1.0, 0.9, 1.0), intervals=30).solve(progress=False, **options)
        counts.append(len(products))
    assert 0 < counts[1] < counts[0]
    assert 1.1 * counts[1] <= 10.0  # seconds, that a look may take at least
    assert counts[2:] == [0, 0]
