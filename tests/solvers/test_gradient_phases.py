"""The gradient method on phases against closed forms, the whole problem, and shooting."""

from __future__ import annotations

from typing import Any

import numpy as np
import phased_loops
import pytest
from phased import bounce, lag, steered

import covocp as co

QUIET: dict[str, Any] = {"progress": False}


@pytest.mark.parametrize(("factor", "offset"), [(1.0, 0.0), (-2.0, -0.5)])
def test_a_jump_of_an_integrator_has_the_cost_of_its_closed_form(factor: float, offset: float) -> None:
    one, two = co.Problem(2.0, name="one"), co.Problem(3.0, name="two")
    x, y = steered(one, two)
    phases = co.Phases([one, two])
    phases.jump(y, factor * x + offset)
    solution = co.solve(phases, method="gradient", intervals=5, **QUIET)
    push = (1.0 - offset) / (factor**2 * 2.0 + 3.0)
    assert solution.cost == pytest.approx(0.5 * push**2 * (factor**2 * 2.0 + 3.0), rel=1e-9)
    np.testing.assert_allclose(solution["one"]["u"], factor * push, rtol=1e-6)
    np.testing.assert_allclose(solution["one"].costate("x"), -factor * push, rtol=1e-6)
    assert solution["two"].multiplier("x") == pytest.approx(-push, rel=1e-6)
    assert solution["one"].multiplier("x") == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("kind", ["estimation", "expected"])
def test_a_problem_cut_in_two_costs_what_the_whole_costs(kind: str) -> None:
    part = lag if kind == "estimation" else phased_loops.lag
    whole = co.solve(part(10.0, "whole"), method="gradient", intervals=100, **QUIET)
    pieces = [part(4.0, "A", last=False), part(6.0, "B", first=False)]
    cut = co.solve(co.Phases(pieces), method="gradient", intervals=[40, 60], **QUIET)
    assert cut.cost == pytest.approx(whole.cost, rel=1e-8)
    for phase, node in ((cut["A"], -1), (cut["B"], 0)):
        np.testing.assert_allclose(phase["x"][node], whole.at(4.0)["x"], atol=5e-6)
    np.testing.assert_allclose(cut.at([2.0, 7.0])["E"], whole.at([2.0, 7.0])["E"], atol=1e-5)
    if kind == "expected":
        np.testing.assert_allclose(cut["A"].gains["C"][0], whole.gains["C"][0], rtol=1e-4)
        np.testing.assert_allclose(cut["B"].loop.Xhat[-1], whole.loop.Xhat[-1], rtol=1e-4)


@pytest.mark.parametrize("make", [bounce, phased_loops.bounce])
def test_both_methods_agree_through_a_jump_with_a_free_duration(make: Any) -> None:
    by_gradient = co.solve(make(), method="gradient", intervals=20, **QUIET)
    by_shooting = co.solve(make(), intervals=20, tolerance=1e-9, **QUIET)
    assert by_gradient.cost == pytest.approx(by_shooting.cost, rel=1e-10)
    assert by_gradient.durations == pytest.approx(by_shooting.durations, rel=1e-5)
    assert max(by_gradient.link_residuals) < 1e-5
    for one, other in zip(by_gradient, by_shooting, strict=True):
        np.testing.assert_allclose(one.costates.state, other.costates.state, atol=1e-4)
        np.testing.assert_allclose(one.costates.matrices, other.costates.matrices, atol=1e-3)
        assert one.optimality.stationarity < 1e-4
        assert one.optimality.costate_difference < 1e-4
    assert by_gradient["fall"].optimality.transversality < 1e-4
    assert by_gradient["fall"].multiplier("x") == pytest.approx(by_shooting["fall"].multiplier("x"), rel=1e-3)


def _three(name: str, wanted: float, *, first: bool, last: bool, **bounds: float) -> co.Problem:
    """A part with a decision in its rate and its cost, a free start and a bounded control."""
    ocp = co.Problem(1.0, name=name)
    x = ocp.state("x", initial=None, final=1.0 if last else None)
    d = ocp.decision("d", guess=0.5, **bounds)
    u = ocp.control("u", lower=-0.6, upper=0.6)
    ocp.dynamics(x, u + d - x)
    ocp.minimize(running=u**2 + x**2, terminal=(d - wanted) ** 2 + (x**2 if first else 0.0))
    return ocp


def _parts(**bounds: float) -> co.Phases:
    places = (("a", 1.0, True, False), ("b", 2.0, False, False), ("c", 3.0, False, True))
    return co.Phases([_three(n, w, first=first, last=last, **bounds) for n, w, first, last in places])


@pytest.mark.parametrize("bounds", [{}, {"upper": 1.0}])
def test_three_phases_with_a_decision_and_a_free_start(bounds: dict[str, float]) -> None:
    by_gradient = co.solve(_parts(**bounds), method="gradient", intervals=10, **QUIET)
    by_shooting = co.solve(_parts(**bounds), intervals=10, tolerance=1e-9, **QUIET)
    assert by_gradient.cost == pytest.approx(by_shooting.cost, rel=1e-8)
    assert [float(phase["d"]) for phase in by_gradient] == pytest.approx([float(by_shooting["a"]["d"])] * 3, rel=1e-4)
    assert by_gradient["a"]["x"][0] == pytest.approx(by_shooting["a"]["x"][0], abs=1e-4)
    for phase in by_gradient:
        assert phase.optimality.decisions < 1e-3


def test_what_the_method_does_not_do_for_phases_is_refused() -> None:
    def limited(name: str) -> co.Problem:
        ocp = co.Problem(1.0, name=name)
        x = ocp.state("x", initial=0.0 if name == "one" else None)
        d, u = ocp.decision("d", guess=0.5, lower=0.0, upper=2.0 if name == "one" else 1.0), ocp.control("u")
        ocp.dynamics(x, u + d)
        ocp.minimize(running=u**2 + d**2 + x**2)
        return ocp

    with pytest.raises(co.ProblemError, match="The bounds of the decision 'd' in 'one' and 'two' differ"):
        co.solve(co.Phases([limited("one"), limited("two")]), method="gradient", **QUIET)
    phases = co.Phases([limited("one"), limited("two")])
    with pytest.raises(co.ProblemError, match="not solved that way"):
        co.solve(phases, method="gradient", nominal="deterministic", **QUIET)


def test_a_comparison_of_phases_is_a_table_of_both_methods() -> None:
    table = co.compare(_parts(), intervals=[6, 8, 10], **QUIET)
    assert table.converged
    assert table["gradient"].cost == pytest.approx(table["ipopt"].cost, rel=1e-7)
    assert [phase.mesh.intervals for phase in table["gradient"]] == [6, 8, 10]
    text = str(table)
    assert "gradient" in text
    assert "ipopt" in text
    with pytest.raises(co.ProblemError, match="not drawn in one figure"):
        table.plot()
    assert "<table" in table._repr_html_()
    failed = co.compare(_parts(), methods=["ipopt", ("chord", "gradient", {"variant": "chord"})], intervals=5, **QUIET)
    assert not failed.converged
    assert "does not apply to phases" in str(failed)


def test_a_bound_holds_what_a_jump_gives_and_has_the_multiplier_of_shooting() -> None:
    """y(0) = x(T)/2 <= 0.4 binds at the first node of the later phase alone."""

    def phases() -> co.Phases:
        one, two = co.Problem(1.0, name="one"), co.Problem(1.0, name="two")
        x, u = one.state("x", initial=0.0), one.control("u")
        one.dynamics(x, u)
        one.minimize(running=0.5 * u**2, terminal=(x - 2.0) ** 2)
        y, w = two.state("y", initial=None, upper=0.4), two.control("w", lower=-3.0)
        two.dynamics(y, w)
        two.minimize(running=0.5 * w**2 + y**2)
        result = co.Phases([one, two])
        result.jump(y, 0.5 * x)
        return result

    by_gradient = co.solve(phases(), method="gradient", intervals=8, **QUIET)
    by_shooting = co.solve(phases(), intervals=8, points=1, tolerance=1e-9, **QUIET)
    assert by_gradient["two"]["y"][0] == pytest.approx(0.4, abs=1e-5)
    assert by_gradient.cost == pytest.approx(by_shooting.cost, rel=1e-5)
    for solution in (by_gradient, by_shooting):
        assert solution.link_residuals[0] < 1e-6
        # p(T) of x is minus its control, and 2 (x - 2) + mu/2 + p+/2 of the jump; x is held at 0.8
        assert solution["one"].costate("x")[-1] == pytest.approx(-0.8, rel=1e-3)


def bent_jump() -> co.Phases:
    """The weight S of what deviates before the jump depends on the speed there, by its slope."""
    first = co.Problem(2.0, name="before")
    x, v = first.state("x", initial=0.0, variance=0.2), first.state("v", initial=0.5, variance=0.1)
    drag = first.unknown("drag", mean=0.3, variance=0.02)
    u = first.control("u")
    first.dynamics(x, v)
    first.dynamics(v, -drag * v + u, noise=0.03)
    first.measurement("position", x, noise=0.1)
    first.minimize_expected(running=0.5 * u**2 + 0.4 * (x - first.time) ** 2)
    second = co.Problem(3.0, name="after")
    y, w = second.state("x", initial=None), second.state("v", initial=None)
    drag_after = second.unknown("drag", mean=0.3, variance=0.02)
    push = second.control("u")
    second.dynamics(y, w)
    second.dynamics(w, -drag_after * w + push, noise=0.06)
    second.measurement("position", y, noise=0.2)
    second.minimize_expected(running=0.5 * push**2 + 0.4 * (y - 4) ** 2, terminal=2 * (y - 4) ** 2 + 0.5 * w**2)
    phases = co.Phases([first, second])
    phases.jump(w, v * (1 - 0.3 * drag) - 0.2 * v**2, noise=0.04)
    return phases


def test_costates_where_the_weight_of_a_phase_depends_on_where_it_ends():
    """The slope through S(T) had been taken off multipliers that do not contain it: 2 % of the costate of the speed."""
    shot, found = (co.solve(bent_jump(), method, intervals=20, progress=False) for method in ("ipopt", "gradient"))
    along = co.evaluate(bent_jump(), nominal=shot, intervals=20)
    for name in ("before", "after"):
        assert found[name].optimality.stationarity < 1e-4
        for other, tolerance in ((found, 1e-3), (along, 1e-5)):
            known = shot[name].costates.state
            np.testing.assert_allclose(other[name].costates.state, known, atol=tolerance * np.abs(known).max())
