"""Phases against closed forms, the whole problem, independent integrations, and differences of solved problems."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from phased import DRAG, RESTITUTION, bounce, lag, steered
from problems import unassessed
from scipy.integrate import solve_ivp

import covocp as co

QUIET: dict[str, Any] = {"progress": False}
FORMS = ("eliminated", "states")


@cache
def bounced_by(form: str) -> co.PhasesSolution:
    return co.solve(bounce(), intervals=20, covariances=form, tolerance=1e-9, **QUIET)


@pytest.fixture(params=FORMS)
def bounced(request: pytest.FixtureRequest) -> co.PhasesSolution:
    return bounced_by(request.param)


@pytest.mark.parametrize("form", FORMS)
def test_a_problem_cut_in_two_costs_what_the_whole_costs(form: str) -> None:
    options = {"covariances": form, "tolerance": 1e-10, **QUIET}
    whole = co.solve(lag(10.0, "whole"), intervals=100, **options)
    parts = co.Phases([lag(4.0, "A", last=False), lag(6.0, "B", first=False)])
    cut = co.solve(parts, intervals=[40, 60], **options)
    # the control may jump at the cut: at the optimum it does not, but for the error of its form
    assert cut.cost == pytest.approx(whole.cost, rel=1e-8)
    at_cut = [whole.costates.state[40], whole.costates.matrices[40]]
    for phase, node in ((cut["A"], -1), (cut["B"], 0)):
        found = [phase.costates.state[node], phase.costates.matrices[node]]
        for own, known in zip(found, at_cut, strict=True):
            np.testing.assert_allclose(own, known, rtol=1e-5)
    np.testing.assert_allclose(cut["A"].values["E"][-1], cut["B"].values["E"][0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(cut.at(np.linspace(0, 10, 41))["x"], whole.at(np.linspace(0, 10, 41))["x"], atol=1e-5)
    assert max(cut.link_residuals) < 1e-6


@pytest.mark.parametrize("form", FORMS)
def test_measurements_at_instants_one_of_them_where_phases_meet(form: str) -> None:
    options = {"covariances": form, "tolerance": 1e-10, **QUIET}
    whole = co.solve(lag(10.0, "whole", at=[2.0, 4.0, 7.0]), intervals=100, **options)
    parts = [lag(4.0, "A", last=False, at=[2.0, 4.0]), lag(6.0, "B", first=False, at=[3.0])]
    cut = co.solve(co.Phases(parts), intervals=[40, 60], **options)
    assert cut.cost == pytest.approx(whole.cost, rel=1e-10)
    np.testing.assert_allclose(cut["B"].values["E"][-1], whole.values["E"][-1], rtol=1e-7)
    for side in ("before", "after"):
        for t in (2.0, 4.0, 7.0):
            known = whole.at(t, side=side)["E"]
            np.testing.assert_allclose(cut.at(t, side=side)["E"], known, rtol=1e-6, err_msg=f"{side} {t}")


def test_a_matrix_of_the_users_goes_on() -> None:
    """P of P' = A P + P A' + Q through both phases, against its integration along the nominal."""
    A, Q, start = np.array([[0.0, 1.0], [-2.0, -0.5]]), 0.1 * np.eye(2), np.diag([1.0, 2.0])
    problems = []
    for name, duration in (("one", 1.0), ("two", 2.0)):
        ocp = co.Problem(duration, name=name)
        x, u = ocp.state("x", initial=None if problems else 1.0), ocp.control("u")
        P = ocp.symmetric("P", 2, initial=None if problems else start)
        ocp.dynamics(x, u)
        F = ca.DM(A) * (1.0 + x)
        ocp.dynamics(P, F @ P + P @ F.T + ca.DM(Q))
        ocp.minimize(running=u**2, terminal=ca.trace(P))
        problems.append(ocp)
    costs = []
    for form in FORMS:
        solution = co.solve(co.Phases(problems), intervals=20, covariances=form, tolerance=1e-9, **QUIET)
        costs.append(solution.cost)

        def rate(t: float, p: np.ndarray, solution=solution) -> np.ndarray:
            P, F = p.reshape(2, 2), A * (1.0 + float(solution.at(min(t, 3.0))["x"]))
            return (F @ P + P @ F.T + Q).ravel()

        found = solve_ivp(rate, (0.0, 3.0), start.ravel(), rtol=1e-9, atol=1e-10, max_step=0.1).y[:, -1].reshape(2, 2)
        np.testing.assert_allclose(solution["two"].values["P"][-1], found, rtol=1e-4)
    assert costs[0] == pytest.approx(costs[1], rel=1e-7)


@pytest.mark.parametrize(("factor", "offset"), [(1.0, 0.0), (0.5, 0.2), (-2.0, -0.5)])
def test_a_jump_of_an_integrator_has_the_cost_of_its_closed_form(factor: float, offset: float) -> None:
    one, two = co.Problem(2.0, name="one"), co.Problem(3.0, name="two")
    x, y = steered(one, two)
    phases = co.Phases([one, two])
    phases.jump(y, factor * x + offset)
    solution = co.solve(phases, intervals=5, tolerance=1e-10, **QUIET)
    push = (1.0 - offset) / (factor**2 * 2.0 + 3.0)  # u = -p, and p before the jump is factor times p after it
    assert solution.cost == pytest.approx(0.5 * push**2 * (factor**2 * 2.0 + 3.0), rel=1e-8)
    np.testing.assert_allclose(solution["one"]["u"], factor * push, rtol=1e-6)
    np.testing.assert_allclose(solution["two"]["u"], push, rtol=1e-6)
    np.testing.assert_allclose(solution["one"].costate("x"), -factor * push, rtol=1e-6)
    assert solution["one"].multiplier("x") == pytest.approx(0.0, abs=1e-6)
    assert solution["two"].multiplier("x") == pytest.approx(-push, rel=1e-6)


def test_a_free_duration_of_a_later_phase() -> None:
    price, factor = 0.02, 2.0
    one, two = co.Problem(1.0, name="one"), co.Problem(co.Free(2.0, 0.1, 50.0), name="two")
    x, y = steered(one, two, price=price)
    phases = co.Phases([one, two])
    phases.jump(y, factor * x)
    solution = co.solve(phases, intervals=10, tolerance=1e-10, **QUIET)
    push = np.sqrt(2.0 * price)
    assert solution.durations[1] == pytest.approx((1.0 - factor**2 * push) / push, rel=1e-6)
    assert solution["two"].optimality.transversality < 1e-6


def test_a_jump_by_the_duration_before_it_counts_in_that_duration() -> None:
    """x+ = x - a T: the later push rises by a for one second more, at its slope p+."""
    a, price = 0.1, 0.05
    one = co.Problem(co.Free(2.0, 0.1, 20.0), name="one")
    x = one.state("x", initial=0.0)
    u = one.control("u")
    one.dynamics(x, u)
    one.minimize(running=0.5 * u**2, terminal=price * one.duration)
    two = co.Problem(1.0, name="two")
    y = two.state("x", initial=None, final=1.0)
    w = two.control("w")
    two.dynamics(y, w)
    two.minimize(running=0.5 * w**2)
    phases = co.Phases([one, two])
    phases.jump(y, x - a * one.duration)
    solution = co.solve(phases, intervals=5, tolerance=1e-10, **QUIET)
    push = a + np.sqrt(a**2 + 2.0 * price)  # u^2/2 = price + a u
    assert solution["one"]["u"][0] == pytest.approx(push, rel=1e-6)
    assert solution.durations[0] == pytest.approx((1.0 - push) / (push - a), rel=1e-6)
    assert solution["one"].optimality.transversality < 1e-6


def test_the_covariance_passes_by_the_tangent_of_the_jump_with_its_noise(bounced: co.PhasesSolution) -> None:
    fall, rise = bounced
    speed = fall["v"][-1]
    # rows x, v, q, r, k after; columns x, v, r, k before
    J = np.zeros((5, 4))
    J[0, 0] = J[3, 2] = J[4, 3] = 1.0
    J[1, 1], J[1, 2] = -RESTITUTION, -speed
    expected = J @ fall.values["E"][-1] @ J.T + np.diag([0.0, 0.01 * speed**2, 0.3, 0.0, 0.0])
    np.testing.assert_allclose(rise.values["E"][0], expected, rtol=0, atol=1e-8)
    assert rise["v"][0] == pytest.approx(-RESTITUTION * speed, rel=1e-8)
    assert abs(expected[3, 1]) > 1e-2  # what the bounce tells of the restitution is not lost


def test_covariances_after_the_jump_are_those_of_an_independent_integration(bounced: co.PhasesSolution) -> None:
    rise = bounced["rise"]

    def rate(t: float, e: np.ndarray) -> np.ndarray:
        E, v = e.reshape(5, 5), float(rise.at(min(t, 1.5))["v"])
        size = np.sqrt(v**2 + 0.01)
        F = np.zeros((5, 5))
        F[0, 1] = F[1, 2] = 1.0
        F[1, 1], F[1, 4], F[2, 2] = -DRAG * (size + v**2 / size), -v * size, -1.0
        information = np.diag([10.0, 5.0, 0.0, 0.0, 0.0])
        noise = np.diag([0.01, 0.02, 0.05, 0.0, 0.0])
        return (F @ E + E @ F.T + noise - E @ information @ E).ravel()

    found = solve_ivp(rate, (0.0, 1.5), rise.values["E"][0].ravel(), rtol=1e-8, atol=1e-10).y[:, -1].reshape(5, 5)
    np.testing.assert_allclose(rise.values["E"][-1], found, rtol=0, atol=2e-6)


def test_the_necessary_conditions_hold_in_each_phase(bounced: co.PhasesSolution) -> None:
    assert max(bounced.link_residuals) < 1e-6
    for phase in bounced:
        residuals = phase.optimality
        assert residuals.stationarity < 1e-5
        assert residuals.costate_difference < 1e-5
        assert residuals.mesh_error < 1e-6
        assert residuals.curvature is None  # one of all phases together
    assert bounced["fall"].optimality.transversality < 1e-5


def test_both_formulations_agree() -> None:
    costs = [bounced_by(form).cost for form in FORMS]
    assert costs[0] == pytest.approx(costs[1], rel=1e-8)


def test_costates_of_the_first_covariance_are_slopes_of_the_cost_of_all_phases() -> None:
    """Through the filter, the jump, and the filter of the next phase: against differences of solved problems."""
    step, options = 1e-3, {"intervals": 20, "tolerance": 1e-10, "covariances": "states", **QUIET}
    costs = [co.solve(bounce(0.5 + side * step), **options).cost for side in (1.0, -1.0)]
    slope = bounced_by("eliminated")["fall"].costate("E")[0][1, 1]
    assert slope == pytest.approx((costs[0] - costs[1]) / (2.0 * step), rel=1e-5)


def test_a_limit_of_a_variance_at_the_end_of_a_later_phase_is_met() -> None:
    free = bounced_by("eliminated")
    limit = float(0.98 * free["rise"].values["E"][-1][1, 1])
    found = [co.solve(bounce(upper=limit), intervals=20, covariances=form, **QUIET) for form in FORMS]
    for solution in found:
        assert solution["rise"].values["E"][-1][1, 1] == pytest.approx(limit, rel=1e-6)
        assert solution.cost > free.cost
        assert max(solution.link_residuals) < 1e-5
    assert found[0].cost == pytest.approx(found[1].cost, rel=1e-6)


def _decided(name: str, wanted: float, *, first: bool) -> co.Problem:
    ocp = co.Problem(1.0, name=name)
    x = ocp.state("x", initial=0.0 if first else None)
    d = ocp.decision("d", guess=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=(d - wanted) ** 2)
    return ocp


def test_a_decision_of_the_same_name_is_one_constant() -> None:
    solution = co.solve(
        co.Phases([_decided("a", 1.0, first=True), _decided("b", 4.0, first=False)]), intervals=4, **QUIET
    )
    assert [float(phase["d"]) for phase in solution] == pytest.approx([2.5, 2.5], rel=1e-7)
    assert solution.cost == pytest.approx(2.0 * 1.5**2, rel=1e-7)
    for phase in solution:
        assert phase.optimality.decisions < 1e-6


def test_parameters_count_in_all_phases_that_have_them() -> None:
    one, two = co.Problem(2.0, name="one"), co.Problem(3.0, name="two")
    x, y = steered(one, two)
    shift = one.parameter("shift", 0.0)
    phases = co.Phases([one, two])
    phases.jump(y, x + shift)
    costs = [co.solve(phases, intervals=4, parameters={"shift": s}, **QUIET).cost for s in (0.0, 0.5)]
    assert costs == pytest.approx([0.5 / 5.0, 0.5 * 0.5**2 / 5.0], rel=1e-7)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_other_units_of_a_state_change_nothing(scale: float) -> None:
    one, two = co.Problem(2.0, name="one"), co.Problem(3.0, name="two")
    for ocp in (one, two):
        x = ocp.state("x", initial=0.0 if ocp is one else None, final=None if ocp is one else scale)
        u = ocp.control("u")
        ocp.dynamics(x, scale * u)
        ocp.minimize(running=0.5 * u**2)
    phases = co.Phases([one, two])
    phases.jump(two.states[0].symbol, 0.5 * one.states[0].symbol)
    assert co.solve(phases, intervals=4, **QUIET).cost == pytest.approx(0.5 / (0.25 * 2.0 + 3.0), rel=1e-6)


def test_an_unstable_plant_in_three_phases_costs_what_it_costs_in_one() -> None:
    def part(name: str, duration: float, *, first: bool, last: bool) -> co.Problem:
        ocp = co.Problem(duration, name=name)
        x = ocp.state("x", initial=1.0 if first else None, final=0.0 if last else None, variance=1.0 if first else None)
        u = ocp.control("u")
        ocp.dynamics(x, 3.0 * x - x**3 + u, noise=0.1)
        ocp.measurement("m", x, noise=0.2)
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2 + x**2 + E[x, x])
        return ocp

    whole = unassessed(part("whole", 3.0, first=True, last=True), grid=np.linspace(0, 1, 61))
    pieces = [part("a", 1.0, first=True, last=False), part("b", 1.0, first=False, last=False)]
    cut = co.solve(co.Phases([*pieces, part("c", 1.0, first=False, last=True)]), grid=np.linspace(0, 1, 21), **QUIET)
    assert cut.cost == pytest.approx(whole.cost, rel=1e-6)


def test_a_warm_start_needs_few_iterations() -> None:
    for form in FORMS:
        cold = bounced_by(form)
        warm = co.solve(bounce(), intervals=20, covariances=form, guess=cold, **QUIET)
        assert warm.cost == pytest.approx(cold.cost, rel=1e-7)
        assert warm.stats["iterations"] <= 2


def test_a_failure_carries_the_last_iterate() -> None:
    one, two = co.Problem(2.0, name="one"), co.Problem(3.0, name="two")
    _, y = steered(one, two)
    two.subject_to(y, upper=-1.0, at="final", name="elsewhere")
    with pytest.raises(co.SolveError, match="were not solved by ipopt") as caught:
        co.solve(co.Phases([one, two], name="both"), intervals=4, **QUIET)
    assert isinstance(caught.value.solution, co.PhasesSolution)
    assert not caught.value.solution.converged
    assert any(name.startswith("two: ") for name in caught.value.violations)


def test_values_of_the_whole_time(bounced: co.PhasesSolution) -> None:
    meeting = bounced.durations[0]
    before, after = (bounced.at(meeting, side=side)["v"] for side in ("before", "after"))
    assert after == pytest.approx(-RESTITUTION * before, rel=1e-6)
    assert np.isnan(bounced.at(0.1)["q"])
    assert bounced.at([meeting + 0.5])["q"] == pytest.approx(bounced["rise"].at([0.5])["q"], rel=1e-9)
    assert bounced.t[-1] == pytest.approx(bounced.duration)
    assert bounced[-1] is bounced["rise"]
    assert len(bounced) == len(list(bounced)) == 2
    assert bounced.cost == pytest.approx(sum(bounced.cost_terms.values()))


def test_the_printout_names_the_phases_and_the_costs(bounced: co.PhasesSolution) -> None:
    text = str(bounced)
    for words in ("fall to rise", "all phases", f"{bounced.cost:.8g}", "fall: solved", "rise: solved"):
        assert words in text
    assert "fixed at T" not in text  # the costates of E at the end of a phase are no multipliers


def test_the_same_body_twice_in_a_chain_of_jumps_by_vectors() -> None:
    """Two components with a jump that mixes them, against the normal equations of the steering."""
    A, b = np.array([[0.5, 1.0], [-1.0, 0.3]]), np.array([0.1, -0.2])
    one, two = co.Problem(1.0, name="one"), co.Problem(2.0, name="two")
    for ocp in (one, two):
        x = ocp.state("x", 2, initial=0.0 if ocp is one else None, final=None if ocp is one else [1.0, 2.0])
        u = ocp.control("u", 2)
        ocp.dynamics(x, u)
        ocp.minimize(running=0.5 * ca.sumsqr(u))
    phases = co.Phases([one, two])
    phases.jump(two.states[0].symbol, ca.DM(A) @ one.states[0].symbol + ca.DM(b))
    solution = co.solve(phases, intervals=4, **QUIET)
    missing = np.array([1.0, 2.0]) - b
    push = np.linalg.solve(A @ A.T * 1.0 + 2.0 * np.eye(2), missing)
    assert solution.cost == pytest.approx(0.5 * missing @ push, rel=1e-7)
    np.testing.assert_allclose(solution["one"]["u"][0], A.T @ push, rtol=1e-6)
