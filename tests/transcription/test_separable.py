"""Slopes of first and second order piece by piece, against CasADi's own differentiation of cost and rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from attitudes import tracked
from decided import everywhere
from phased import bounce
from spreads import ellipse

import covocp as co
from covocp.models import bryson_denham, formation_flight, free_time_integrator
from covocp.solving.warm_start import make_guess
from covocp.transcription.mesh import Options
from covocp.transcription.nlp import NLP
from covocp.transcription.program import Program, joined
from covocp.transcription.scales import choose_scales
from covocp.transcription.separable import COST, slopes
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.transcribing import transcribe


def plain() -> co.Problem:
    """Two controls, a free duration, time and duration in the rates, conditions of every kind."""
    ocp = co.Problem(co.Free(guess=2.0, lower=0.5, upper=9.0))
    x, v = ocp.state("x", initial=0.3, lower=-2.0), ocp.state("v", 2, initial=[0.1, None])
    u, w = ocp.control("u", lower=-3.0, upper=3.0, guess=0.4), ocp.control("w", guess=-0.3)
    ocp.dynamics(x, v[0] * ca.cos(x) + 0.1 * w * ocp.time)
    ocp.dynamics(v, ca.vertcat(u * v[1] - ca.sin(x), w - v[1] ** 2 + 0.1 * ocp.duration * x))
    ocp.subject_to(x**2 + 0.1 * u * v[0], upper=4.0, name="along")
    ocp.subject_to(v[1] * v[0] + 0.1 * u**2, lower=-5.0, at="initial", name="first")
    ocp.subject_to(x * v[1], upper=5.0, at="final", name="last")
    ocp.subject_to(x * u, at=0.5, relative=True, side="after", upper=9.0, name="in between")
    ocp.subject_to(v[0] ** 2, at=0.25, relative=True, upper=9.0, name="early")
    ocp.minimize(running=u**2 * (1 + 0.1 * x**2) + w**2 + 0.1 * ocp.time * v[0], terminal=x**2 * ocp.duration)
    return ocp


def estimated(*, sampled: bool = False) -> co.Problem:
    """A lag of unknown constant whose covariance is in costs and conditions, read always or at instants."""
    ocp = co.Problem(4.0)
    x, b = ocp.state("x", initial=0.2, variance=0.5), ocp.unknown("b", mean=1.0, variance=2.0)
    u = ocp.control("u", guess=0.7)
    ocp.dynamics(x, -b * ca.sin(x) + u, noise=0.3)
    ocp.measurement("y", x + 0.1 * x**2, noise=0.2, at=[1.0, 2.0, 4.0] if sampled else None)
    E = ocp.estimation_covariance()
    ocp.subject_to(E[x, x] * (1 + x**2), upper=3.0, name="along")
    ocp.subject_to(E[b, b] + x**2, upper=9.0, at="final", name="last")
    ocp.minimize(running=u**2 + 0.1 * E[x, b] ** 2, terminal=10.0 * E[b, b])
    return ocp


def closed() -> co.Problem:
    """An expected cost of the closed loop: one covariance runs backward."""
    ocp = co.Problem(2.0)
    x, b = ocp.state("x", initial=0.2, variance=0.5), ocp.unknown("b", mean=1.0, variance=0.4)
    u = ocp.control("u", guess=0.7)
    ocp.dynamics(x, -b * ca.sin(x) + u, noise=0.3)
    ocp.measurement("y", x, noise=0.2)
    ocp.minimize_expected(running=u**2 + x**2, terminal=2.0 * x**2 + x**4)
    return ocp


STATES = {"covariances": "states"}
CASES: dict[str, tuple[Callable[[], co.Problem], dict[str, Any]]] = {
    "plain": (plain, {"intervals": 8}),
    "constant controls": (plain, {"intervals": 8, "control": "constant"}),
    "points inside": (plain, {"intervals": 8, "substeps": 4, "points": 2}),
    "linearly implicit": (plain, {"intervals": 8, "step": "rodas"}),
    "estimation": (estimated, STATES | {"intervals": 7, "substeps": 2}),
    "estimation, points inside": (
        estimated,
        STATES | {"intervals": 5, "substeps": 6, "points": 3, "control": "constant"},
    ),
    "estimation by rk4": (estimated, STATES | {"intervals": 7, "covariance_step": "rk4"}),
    "readings": (lambda: estimated(sampled=True), STATES | {"intervals": 8}),
    "closed loop": (closed, STATES | {"intervals": 6}),
    "terminal weights of matrices": (lambda: ellipse((0.3, 0.2)), STATES | {"intervals": 6, "control": "constant"}),
    "attitude": (lambda: tracked()[0], STATES | {"intervals": 4}),
    "free time": (free_time_integrator.problem, {"intervals": 10}),
    "formation": (formation_flight.problem, {"intervals": 5}),
}


def transcribed(problem: co.Problem, options: dict[str, Any]) -> tuple[NLP, np.ndarray, np.ndarray]:
    """The program, and a point of it that solves nothing."""
    statement = problem.statement()
    mesh = resolve_mesh(statement, Options(**options), statement.values)
    guess = make_guess(statement, mesh, statement.values, None).trajectory
    nlp = transcribe(statement, mesh, choose_scales(statement, mesh, guess, statement.values), taken=True)
    w = nlp.pack(guess)
    return nlp, w + 0.02 * np.random.default_rng(0).normal(size=w.size), np.append(statement.values, 1.7)


def check_slopes(nlp: NLP | Program, w: np.ndarray, p: np.ndarray, sizes: list[int] | None = None) -> None:
    """Compare all slopes at a point with CasADi's own."""
    assert nlp.pieces
    found = slopes(nlp.pieces, nlp.w, nlp.p, nlp.g.shape[0], second=True, sizes=sizes)
    of_cost, of_rows = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", nlp.g.shape[0])
    second, _ = ca.hessian(of_cost * nlp.f + ca.dot(of_rows, nlp.g), nlp.w)
    first = [nlp.f, ca.gradient(nlp.f, nlp.w), nlp.g, ca.jacobian(nlp.g, nlp.w)]
    own = ca.Function("own", [nlp.w, nlp.p, of_cost, of_rows], [*first, ca.triu(second)])
    weights = np.random.default_rng(1).normal(size=nlp.g.shape[0])
    expected = own(w, p, 0.6, weights)
    results = [*found["grad_f"](w, p), *found["jac_g"](w, p), found["hess_lag"](w, p, 0.6, weights)]
    for value, known in zip(results, expected, strict=True):
        a, b = np.asarray(value.full()), np.asarray(known.full())
        assert np.isfinite(b).all()
        assert np.abs(a - b).max() <= 1e-11 * max(1.0, np.abs(b).max())
    assert found["hess_lag"].sparsity_out(0).is_triu()


@pytest.mark.parametrize("case", CASES)
def test_all_slopes_are_those_of_casadi(case: str) -> None:
    make, options = CASES[case]
    check_slopes(*transcribed(make(), options))


def thrown() -> co.Phases:
    """A ball that is steered to a wall, bounces off it, and is caught: free durations, a jump, conditions."""
    problems = []
    for k in range(2):
        ocp = co.Problem(co.Free(guess=1.5, lower=0.2, upper=5.0), name=f"part {k}")
        x = ocp.state("x", initial=None if k else 0.0, final=0.3 if k else 1.0)
        v, u = ocp.state("v", initial=None if k else 0.5), ocp.control("u", guess=0.2 + 0.1 * k)
        ocp.dynamics(x, v)
        ocp.dynamics(v, u - 0.1 * v * ca.sqrt(v**2 + 0.01))
        ocp.subject_to(u * v, upper=3.0, name="power")
        ocp.minimize(running=u**2 * (1 + x**2), terminal=(1 + k) * ocp.duration**2)
        problems.append((ocp, v))
    phases = co.Phases([ocp for ocp, _ in problems], name="thrown")
    phases.jump(problems[1][1], -0.7 * problems[0][1] * (1 + 0.1 * problems[0][0].duration))
    return phases


def apart() -> co.Phases:
    """Two parts that have nothing in common: the first gives the second no value."""
    problems = []
    for k in range(2):
        ocp = co.Problem(1.0 + k, name=f"part {k}")
        x, u = ocp.state("xy"[k], initial=1.0), ocp.control("u")
        ocp.dynamics(x, -(x**3) + u)
        ocp.minimize(running=u**2 + x**2)
        problems.append(ocp)
    return co.Phases(problems, name="apart")


@pytest.mark.parametrize(("phases", "form"), [(thrown, "auto"), (bounce, "states"), (apart, "auto")])
def test_all_slopes_of_several_parts_are_those_of_casadi(phases: Callable[[], co.Phases], form: str) -> None:
    chain = phases().chain()
    parts, w = [], []
    for statement in chain.statements:
        mesh = resolve_mesh(statement, Options(intervals=6, covariances=form), statement.values)  # type: ignore[arg-type]
        guess = make_guess(statement, mesh, statement.values, None).trajectory
        scales = choose_scales(statement, mesh, guess, statement.values)
        parts.append(transcribe(statement, mesh, scales, taken=True))
        w.append(parts[-1].pack(guess))
    point = np.concatenate(w)
    point += 0.02 * np.random.default_rng(0).normal(size=point.size)
    p = np.concatenate([*(statement.values for statement in chain.statements), [1.7]])
    sizes = [statement.np for statement in chain.statements]
    check_slopes(joined(chain, tuple(parts)), point, p + 1e-3 * np.arange(p.size), sizes)


def test_rows_and_cost_are_there_once() -> None:
    nlp, *_ = transcribed(plain(), {"intervals": 8})
    rows = np.concatenate([piece.rows.ravel() for piece in nlp.pieces])
    assert np.array_equal(np.sort(rows[rows != COST]), np.arange(nlp.g.shape[0]))
    assert (rows == COST).sum() == nlp.mesh.intervals + 1


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_second_slopes_by_differences(control: str) -> None:
    nlp, w, p = transcribed(plain(), {"intervals": 8, "control": control, "substeps": 2, "points": 2})
    found = slopes(nlp.pieces, nlp.w, nlp.p, nlp.g.shape[0], second=True)
    weights, step = np.random.default_rng(1).normal(size=nlp.g.shape[0]), 1e-6

    def first(at: np.ndarray) -> np.ndarray:
        _, gradient = found["grad_f"](at, p)
        _, jacobian = found["jac_g"](at, p)
        return 0.6 * gradient.full().ravel() + jacobian.full().T @ weights

    direction = np.random.default_rng(2).normal(size=w.size)
    upper = found["hess_lag"](w, p, 0.6, weights).full()
    whole = upper + np.triu(upper, 1).T
    differences = (first(w + step * direction) - first(w - step * direction)) / (2 * step)
    assert np.abs(whole @ direction - differences).max() <= 1e-7 * np.abs(differences).max()


@pytest.mark.parametrize(
    ("problem", "options"),
    [(plain, {"intervals": 8, "segments": 4}), (lambda: everywhere([0.6, 0.7, 0.8]), STATES | {"intervals": 6})],
    ids=["segments of several intervals", "a variance that is decided at the start"],
)
def test_other_programs_have_no_pieces(problem: Callable[[], co.Problem], options: dict[str, Any]) -> None:
    assert transcribed(problem(), options)[0].pieces == ()


@pytest.mark.parametrize("options", [{"plugin": "sqpmethod"}, {"hessian": "limited-memory"}, {"compile": True}])
def test_solutions_do_not_depend_on_who_differentiates(options: dict[str, Any]) -> None:
    known = co.solve(bryson_denham.problem(), intervals=20, progress=False)
    found = co.solve(bryson_denham.problem(), intervals=20, progress=False, **options)
    assert found.cost == pytest.approx(known.cost, rel=1e-6)
    np.testing.assert_allclose(found.trajectory.x, known.trajectory.x, atol=1e-5)


def test_functions_of_the_user_are_taken() -> None:
    """A Hessian given by hand stays what it is: here none at all, as a first-order method."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=x**2 + u**2)
    size = 11 * 2
    w, p, a, b = ca.MX.sym("w", size), ca.MX.sym("p", 1), ca.MX.sym("a"), ca.MX.sym("b", 10)
    unit = ca.Function("unit", [w, p, a, b], [ca.MX(ca.DM.eye(size))], ["x", "p", "lam_f", "lam_g"], ["h"])
    known = co.solve(ocp, intervals=10, progress=False)
    found = co.solve(ocp, intervals=10, progress=False, plugin_options={"hess_lag": unit})
    assert found.stats["iterations"] > known.stats["iterations"]
    assert found.cost == pytest.approx(known.cost, rel=1e-6)


def test_options_for_functions_of_casadi_reach_them() -> None:
    """They are meant for functions that CasADi makes: an option that none of them has is refused, not left out."""
    with pytest.raises(co.ProblemError, match="refuses its settings"):
        co.solve(plain(), intervals=8, progress=False, plugin_options={"specific_options": {"nlp_hess_l": {"no": 1}}})
