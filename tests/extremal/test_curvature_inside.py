"""Limits that act inside the intervals, against the NLP as one dense matrix and against problems solved by hand."""

from __future__ import annotations

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import eigh, null_space

import covocp as co
from covocp.extremal.costates import discrete_costates
from covocp.extremal.curvature import held_jacobian, smallest_curvature
from covocp.extremal.metric import mass_matrix
from covocp.extremal.optimality import complementarity
from covocp.transcription.scales import choose_scales
from covocp.transcription.transcribing import transcribe

SMALLEST = 1e-5  # multiplier, in the units of the NLP, from which on a limit is active


def solve(problem, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # between the points the limits are passed a little
        return co.solve(problem, progress=False, **options)


def spectrum(extremal):
    """Eigenvalues of the reduced Hessian of the NLP with all its variables, by a dense null space; directions of
    the controls that it leaves; slopes left over.
    """
    st, mesh, p = extremal.statement, extremal.mesh, np.append(extremal.parameters, 1.0)
    nlp = transcribe(st, mesh, choose_scales(st, mesh, extremal.trajectory, extremal.parameters))
    costates, _, _ = discrete_costates(extremal)
    lam_x, lam_g = nlp.pack_multipliers(extremal.multipliers, (costates.state, costates.matrices))
    value = nlp.f + ca.dot(ca.DM(lam_g), nlp.g)
    hessian, slope = ca.hessian(value, nlp.w)
    outputs = [ca.densify(v) for v in (hessian, slope, ca.jacobian(nlp.g, nlp.w))]
    w, bounds = nlp.pack(extremal.trajectory), nlp.bounds(extremal.parameters)
    H, g, J = (np.asarray(v.full()) for v in ca.Function("dense", [nlp.w, nlp.p], outputs)(w, p))
    fixed = bounds["lbx"] == bounds["ubx"]
    at_bound = fixed | (np.abs(lam_x) > SMALLEST)
    active = (bounds["lbg"] == bounds["ubg"]) | (np.abs(lam_g) > SMALLEST)
    basis = null_space(np.vstack([J[active], np.eye(w.size)[at_bound]]))
    metric = np.zeros((w.size, w.size))
    place = slice(w.size - extremal.trajectory.u.size, w.size)
    scale = np.broadcast_to(nlp.scales.u, extremal.trajectory.u.shape).ravel()
    metric[place, place] = mass_matrix(mesh, extremal.trajectory.duration, st.nu).full() * np.outer(scale, scale)
    values = eigh(basis.T @ H @ basis, basis.T @ metric @ basis, eigvals_only=True)
    return values, basis[place] * scale[:, None], float(np.abs((g.ravel() + lam_x)[~fixed]).max())


def oscillator(limit):
    ocp = co.Problem(duration=4.0)
    x, u = ocp.state("x", 2, initial=[0.0, 1.0], final=[None, 0.2]), ocp.control("u", guess=lambda s: 0 * s)
    ocp.dynamics(x, ca.vertcat(x[1], (1 - x[0] ** 2) * x[1] - x[0] + u))
    limit(ocp, x, u)
    ocp.minimize(running=0.5 * u**2 + 0.3 * ca.cos(2 * x[0]) + 0.1 * x[1] ** 2)
    return ocp


def lag(limit, coupled=0.0):
    ocp = co.Problem(duration=5.0)
    x, u = ocp.state("x", initial=0.0, final=0.3), ocp.control("u", guess=lambda s: np.sin(np.pi * s))
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    E = ocp.estimation_covariance()
    ocp.dynamics(x, -b * x + u + coupled * E[x, x], noise=0.1)
    ocp.measurement("position", x, noise=1.0)
    limit(ocp, x, u, E, b)
    ocp.minimize(running=0.5 * u**2, terminal=10.0 * E[b, b])
    return ocp


CURVED = lambda ocp, x, u: ocp.subject_to(x[0] + 0.1 * x[1] ** 2, upper=0.4)  # noqa: E731
MIXED = lambda ocp, x, u: ocp.subject_to(x[0] + 0.1 * u**2, upper=0.5)  # noqa: E731
KNOWN = lambda ocp, x, u, E, b: ocp.subject_to(E[b, b] + 0.6 * ocp.time, upper=5.3)  # noqa: E731
REACH = lambda ocp, x, u, E, b: ocp.subject_to(x + 0.05 * x**2, upper=0.9)  # noqa: E731


@pytest.mark.parametrize(
    ("problem", "options"),
    [
        (oscillator(CURVED), {"intervals": 8, "points": 4}),
        (oscillator(CURVED), {"intervals": 12, "points": 3, "control": "constant", "substeps": 6}),
        (oscillator(CURVED), {"intervals": 8, "points": 4, "segments": 2, "substeps": 4}),
        (oscillator(MIXED), {"intervals": 8, "points": 4}),
        (lag(REACH), {"intervals": 10, "points": 3}),
        (lag(REACH, coupled=0.5), {"intervals": 8, "points": 3}),
        (lag(KNOWN), {"intervals": 10, "points": 3}),
        (lag(REACH), {"intervals": 10, "points": 3, "covariances": "states"}),
    ],
)
def test_curvature_is_that_of_the_dense_nlp(problem, options):
    solution = solve(problem, tolerance=1e-10, **options)
    assert np.abs(solution.multipliers.inside_path).max() > 1e-3
    exact, basis, slope = spectrum(solution.extremal)
    found = smallest_curvature(solution.extremal)
    assert slope < 1e-8
    rows = held_jacobian(solution.extremal)
    assert np.linalg.matrix_rank(rows, 1e-8) + basis.shape[1] == solution.trajectory.u.size
    np.testing.assert_allclose(rows @ basis, 0.0, atol=1e-9)
    assert found.value == pytest.approx(exact[0], rel=1e-4)
    assert found.largest == pytest.approx(np.abs(exact).max(), rel=1e-3)


def two_carts(growth, gain, duration=1.0):
    """A cart runs into a wall that bends with the state of a second one, for which it is stationary to stay at zero."""
    ocp = co.Problem(duration=duration)
    x, y = ocp.state("x", initial=0.0, final=0.0, guess=0.0), ocp.state("y", initial=0.0, final=0.0)
    u, v = (ocp.control(name, guess=lambda s: 0 * s) for name in "uv")
    ocp.dynamics(x, growth * x + u)
    ocp.dynamics(y, v)
    ocp.subject_to(y + 5.0 * x**2, upper=0.1 * duration)
    running = 0.5 * u**2 - 0.5 * gain * x**2 + 0.5 * (v - 1.0 + 2.0 * ocp.time / duration) ** 2
    ocp.minimize(running=running)
    return ocp


@pytest.mark.parametrize(("growth", "duration", "gains"), [(0.0, 1.0, (19.0, 24.0)), (3.0, 4.0, (11.5, 16.0))])
def test_minimum_and_saddle_at_a_wall_inside_the_intervals(growth, duration, gains):
    """The wall's own curvature, with the multipliers between the nodes, decides which of the two it is."""
    verdicts = []
    for gain in gains:
        solver = co.Solver(two_carts(growth, gain, duration), intervals=14, points=4, tolerance=1e-9)
        solution = solver.solve(assess=False, progress=False)  # a saddle is left where it is looked at
        extremal, m = solution.extremal, solution.multipliers
        t = extremal.trajectory
        still = t.x * [0.0, 1.0], t.u * [0.0, 1.0]
        extremal = replace(extremal, trajectory=replace(t, x=still[0], u=still[1]))
        exact, _, _ = spectrum(extremal)
        found = smallest_curvature(extremal)
        assert np.sign(found.value) == np.sign(exact[0])
        verdicts.append(found.verdict)
        without = replace(extremal, multipliers=replace(m, inside_path=np.zeros_like(m.inside_path)))
        assert spectrum(without)[0][0] < 0  # they are what makes a minimum of the first
    assert verdicts == ["minimum", "saddle"]


def cart(wall):
    """Bryson and Denham: x'' = u from 0 to 0, x <= wall; the least of int u^2 / 2 is 4 / (9 wall)."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", 2, initial=[0.0, 1.0], final=[0.0, -1.0], upper=[wall, np.inf]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize(running=0.5 * u**2)
    return ocp


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_residuals_of_a_solution_whose_limits_act_inside(control):
    solution = solve(cart(1 / 9), intervals=10, points=4, control=control, tolerance=1e-10)
    assert np.abs(solution.multipliers.inside_states).max() > 1e-2
    values = solution.optimality
    assert values.stationarity < 1e-8
    assert values.complementarity < 1e-7  # Ipopt relaxes bounds by 1e-8
    assert values.costate_difference < 1e-8
    assert values.curvature > 0
    assert values.control_error == pytest.approx(solution.cost / 4.0 - 1.0, rel=0.3)


def test_complementarity_counts_the_points_inside():
    """A multiplier of a point between the nodes where the limit is far: the sum of both, by the cost."""
    solution = solve(cart(1 / 9), intervals=10, points=4, tolerance=1e-10)
    extremal, m = solution.extremal, solution.multipliers
    inside = m.inside_states.copy()
    inside[0, 1, 0] += 3.0
    wrong = replace(extremal, multipliers=replace(m, inside_states=inside))
    far = 1 / 9 - solution.at(0.05)["x"][0]
    t = np.linspace(0.0, 1.0, 41)
    size = np.trapezoid(0.5 * np.interp(t, solution.t, solution["u"]) ** 2, t)
    added = complementarity(wrong) - complementarity(extremal)
    assert added == pytest.approx(3.0 * far / size, rel=1e-6)
