"""Slopes through the stages of Runge-Kutta steps in compiled code, against CasADi's own differentiation."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.models import mass_chain
from covocp.passage import library
from covocp.passage.sweep import passed_by
from covocp.solving.warm_start import make_guess
from covocp.transcription.mesh import Options
from covocp.transcription.nlp import NLP
from covocp.transcription.scales import choose_scales
from covocp.transcription.shooting import interval_columns
from covocp.transcription.staged import interval_transitions, is_staged
from covocp.transcription.steps import nominal_interval
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.transcribing import transcribe

pytestmark = pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))

SIZE = 8


def two_controls(*, free: bool = False, conditions: bool = False) -> co.Problem:
    """Eight coupled pendulums' worth of nonlinear, time-varying states with two controls and a running cost of all."""
    ocp = co.Problem(co.Free(guess=3.0, lower=1.0, upper=9.0) if free else 3.0)
    x = ocp.state("x", SIZE, initial=0.1 * np.arange(SIZE), variance=0.1)
    u = ocp.control("u", 2, lower=-5.0, upper=5.0, guess=[0.3, -0.2])
    b = ocp.unknown("b", mean=0.7, variance=0.2)
    t, T = ocp.time, ocp.duration
    shifted = ca.vertcat(x[1:], x[0])
    drive = ca.vertcat(*([u[0], 0, u[1], u[0] * u[1]] * 2))
    ocp.dynamics(x, -0.5 * x + ca.sin(shifted) * b + drive + 0.1 * t + 0.05 * T * x**2, noise=0.01)
    ocp.measurement("y", x[:3] + 0.1 * x[3] ** 2, noise=0.1)
    E = ocp.estimation_covariance()
    if conditions:
        ocp.subject_to(x[2] ** 2, upper=25.0, name="path")
        ocp.subject_to(E[b, b], upper=0.15, at="final")
    ocp.minimize(running=ca.sumsqr(u) + 0.1 * ca.sumsqr(x) * (1 + 0.2 * t), terminal=E[b, b] + x[0] ** 2 + 0.1 * T)
    return ocp


CASES: dict[str, tuple[Callable[[], co.Problem], dict[str, object]]] = {
    "chain": (lambda: mass_chain.problem(masses=4), {"intervals": 12}),
    "uneven segments": (lambda: mass_chain.problem(masses=4), {"intervals": 11, "segments": 3, "substeps": 3}),
    "one segment": (lambda: mass_chain.problem(masses=4), {"intervals": 11, "segments": 1, "control": "constant"}),
    "segments of one interval": (two_controls, {"intervals": 6, "segments": 6}),
    "two controls": (two_controls, {"intervals": 13, "segments": 4, "substeps": 2}),
    "free duration": (lambda: two_controls(free=True), {"intervals": 9, "segments": 2, "substeps": 2}),
    "free, constant": (lambda: two_controls(free=True), {"intervals": 9, "segments": 2, "control": "constant"}),
    "conditions": (lambda: two_controls(free=True, conditions=True), {"intervals": 8, "segments": 3}),
}


def transcribed(problem: co.Problem, options: dict[str, object]) -> tuple[NLP, NLP, np.ndarray, np.ndarray]:
    """The NLP with and without compiled code, and a point of it that solves nothing."""
    statement = problem.statement()
    mesh = resolve_mesh(statement, Options(**options), statement.values)  # type: ignore[arg-type]
    guess = make_guess(statement, mesh, statement.values, None).trajectory
    scales = choose_scales(statement, mesh, guess, statement.values)
    compiled, plain = (transcribe(statement, mesh, scales, kind) for kind in (passed_by, None))
    assert is_staged(statement, mesh)
    assert plain.gradient is None
    rng = np.random.default_rng(0)
    w = compiled.pack(guess)
    return compiled, plain, w + 0.1 * rng.normal(size=w.size), np.append(statement.values, 1.7)


@pytest.mark.parametrize("case", CASES)
def test_cost_rows_and_slopes_are_those_of_casadi(case):
    make, options = CASES[case]
    compiled, plain, w, p = transcribed(make(), options)
    assert compiled.gradient is not None
    own = ca.Function("own", [compiled.w, compiled.p], [*compiled.gradient, compiled.g, compiled.jacobian])
    slopes = ca.gradient(plain.f, plain.w), plain.g, ca.jacobian(plain.g, plain.w)
    other = ca.Function("other", [plain.w, plain.p], [plain.f, *slopes])
    for found, expected in zip(own(w, p), other(w, p), strict=True):
        a, b = np.asarray(found.full()), np.asarray(expected.full())
        assert np.abs(a - b).max() <= 1e-11 * np.abs(b).max()


def test_gradient_by_differences():
    compiled, _, w, p = transcribed(two_controls(free=True), CASES["free duration"][1])
    cost, gradient = compiled.gradient or (None, None)
    function = ca.Function("cost", [compiled.w, compiled.p], [cost, gradient])
    slope = np.asarray(function(w, p)[1].full()).ravel()
    direction = np.random.default_rng(1).normal(size=w.size)
    step = 1e-5
    ahead, behind = (float(function(w + sign * step * direction, p)[0]) for sign in (1, -1))
    assert (ahead - behind) / (2 * step) == pytest.approx(slope @ direction, rel=1e-8)


@pytest.mark.parametrize("case", CASES)
def test_transitions_of_single_intervals_are_the_jacobians_of_their_steps(case):
    """At states that are no trajectory, by the state before and the controls at both ends."""
    make, options = CASES[case]
    statement = make().statement()
    mesh = resolve_mesh(statement, Options(**options), statement.values)  # type: ignore[arg-type]
    rng, n = np.random.default_rng(2), mesh.intervals
    x, u = rng.normal(size=(statement.nx, n)), ca.DM(rng.normal(size=(statement.nu, mesh.control_nodes)))
    intervals = interval_columns(mesh, u, ca.DM(1.7), ca.DM(statement.values))
    found = interval_transitions(statement, mesh, x, intervals)
    step = nominal_interval(statement, mesh.substeps, mesh.step)
    symbols = step.mx_in()
    slopes = [ca.densify(ca.jacobian(step(*symbols)[0], symbols[i])) for i in range(3)]
    known = ca.Function("slopes", symbols, slopes).map(n)(x, *intervals)
    for own, other in zip(found, known, strict=True):
        expected = np.asarray(other.full()).reshape(statement.nx, n, -1).transpose(1, 0, 2)
        assert np.abs(own - expected).max() <= 1e-12 * np.abs(expected).max()


def test_stages_of_curved_and_stiff_problems_are_not_taken():
    large = mass_chain.problem(masses=5).statement()
    assert is_staged(large, resolve_mesh(large, Options(intervals=20), large.values))
    assert not is_staged(large, resolve_mesh(large, Options(intervals=20, step="rodas"), large.values))
    ocp = co.Problem(1.0)
    rate = ocp.control("w", 3)
    ocp.attitude("C", initial=np.eye(3), rate=rate)
    ocp.minimize(running=ca.sumsqr(rate))
    curved = ocp.statement()
    assert not is_staged(curved, resolve_mesh(curved, Options(intervals=20), curved.values))


def test_plain_problems_have_the_jacobian_of_casadi():
    """With an exact Hessian, of which the compiled slopes are no part: the quadratic has its closed form."""
    n = 6
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", n, initial=1.0), ocp.control("u", n)
    ocp.dynamics(x, -x + u)
    ocp.minimize(running=0.5 * (ca.sumsqr(x) + ca.sumsqr(u)))
    solution = co.solve(ocp, intervals=200, progress=False)
    # s' = 2 s + s^2 - 1 backward from s = 0
    root = np.sqrt(2.0)
    s = np.sinh(2 * root) / (root * np.cosh(2 * root) + np.sinh(2 * root))
    assert solution.stats["hessian"] == "exact"
    assert solution.cost == pytest.approx(0.5 * n * s, rel=1e-6)
    assert solution.stats["iterations"] <= 2


@pytest.mark.parametrize("method", ["ipopt", "reduced"])
def test_solution_is_that_of_casadis_own_operations(monkeypatch, method):
    fast = co.solve(two_controls(free=True), method, intervals=20, progress=False)
    monkeypatch.setattr("covocp.transcription.shooting.functions", lambda: None)
    plain = co.solve(two_controls(free=True), method, intervals=20, progress=False)
    assert fast.cost == pytest.approx(plain.cost, rel=1e-9)
    assert np.allclose(fast.costates.state, plain.costates.state, rtol=1e-5, atol=1e-6)


def test_a_model_that_fails_at_a_trial_is_stepped_around():
    """sqrt of a negative number at a whole first step: the search takes a shorter one."""
    ocp = co.Problem(2.0)
    x = ocp.state("x", SIZE, initial=0.5, variance=0.1)
    u = ocp.control("u", guess=0.0)
    ocp.dynamics(x, -x + ca.sqrt(x) + u, noise=0.01)
    ocp.measurement("y", x[0], noise=0.01)
    E = ocp.estimation_covariance()
    ocp.minimize(running=(u + 2.0) ** 2 + 1e-3 * u**4, terminal=E[x[0], x[0]] + 30 * (x[0] - 0.2) ** 2)
    solution = co.solve(ocp, intervals=20, progress=False)
    assert solution.converged
    assert solution.optimality.stationarity < 1e-5
