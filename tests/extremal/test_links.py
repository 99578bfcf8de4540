"""Costates where phases meet and a bound holds a state there, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import covocp as co
from covocp.solving import phases_outcome


def _bryson_denham(duration: float, name: str, *, first: bool, limit: float = 1 / 9) -> co.Problem:
    ocp = co.Problem(duration, name=name)
    x = ocp.state("x", initial=0.0 if first else None, final=None if first else 0.0, upper=limit)
    v = ocp.state("v", initial=1.0 if first else None, final=None if first else -1.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=0.5 * u**2)
    return ocp


@pytest.mark.parametrize("cut", [0.2, 1 / 3, 0.4, 0.5])
@pytest.mark.parametrize("intervals", [20, 80])
def test_a_bound_that_is_active_where_phases_meet_has_a_multiplier_there(cut: float, intervals: int) -> None:
    """Bryson-Denham, cut before, at the entry of, and inside the arc at the bound, from 1/3 to 2/3."""
    phases = co.Phases([_bryson_denham(cut, "a", first=True), _bryson_denham(1 - cut, "b", first=False)])
    solution = co.solve(phases, intervals=intervals, progress=False)
    assert solution.cost == pytest.approx(4.0, rel=2e-4)  # 4 / (9 limit)
    assert solution.link_residuals[0] < 1e-9
    a, b = solution
    # p_x is 18 before the arc and -18 after it; what is between depends on the places at which the bound is imposed
    np.testing.assert_allclose(a.costate("x")[0], 18.0, rtol=2e-2)
    np.testing.assert_allclose(b.costate("x")[-1], -18.0, rtol=2e-2)
    held = a.costate("x")[-1] - b.costate("x")[0]
    assert held > -1e-6  # an upper bound pushes one way
    assert a.multiplier("x") == pytest.approx(held, abs=held + 1e-6)  # what of it the earlier phase has


def test_a_decision_at_its_bound_counts_once() -> None:
    def part(name: str, wanted: float, *, first: bool) -> co.Problem:
        ocp = co.Problem(1.0, name=name)
        x = ocp.state("x", initial=0.0 if first else None)
        d = ocp.decision("d", guess=1.0, upper=2.0)
        u = ocp.control("u")
        ocp.dynamics(x, u + d)
        ocp.minimize(running=u**2 + x**2, terminal=(d - wanted) ** 2)
        return ocp

    solution = co.solve(
        co.Phases([part("a", 4.0, first=True), part("b", 9.0, first=False)]), intervals=10, progress=False
    )
    assert [float(phase["d"]) for phase in solution] == pytest.approx([2.0, 2.0], rel=1e-6)
    assert solution.link_residuals[0] < 1e-7
    for phase in solution:
        assert phase.optimality.decisions < 1e-6


def _at_rest(constant: float) -> co.Phases:
    """An integrator that begins and ends at zero: no costates; the variance at the end and a constant are the cost."""
    parts = []
    for name in ("A", "B"):
        first = name == "A"
        ocp = co.Problem(1.0, name=name)
        x = ocp.state(
            "x", initial=0.0 if first else None, final=None if first else 0.0, variance=0.1 if first else None
        )
        u = ocp.control("u")
        ocp.dynamics(x, u, noise=0.01)
        ocp.measurement("m", x, noise=0.1)
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2, terminal=constant if first else E[x, x])
        parts.append(ocp)
    return co.Phases(parts)


@pytest.mark.parametrize("constant", [0.0, 1e3])
def test_costates_that_vanish_meet(monkeypatch: pytest.MonkeyPatch, constant: float) -> None:
    """What roundoff differs by is nothing of the cost, though 1 % of itself; a jump of the costate is told."""
    seen: list[Any] = []
    residual = phases_outcome.link_residual
    monkeypatch.setattr(phases_outcome, "link_residual", lambda *args: seen.append(args) or residual(*args))
    solution = co.solve(_at_rest(constant), intervals=20, progress=False)
    assert solution.link_residuals[0] < 1e-7
    assert "LARGE" not in str(solution)
    before, after, link = seen[0]
    deviation = float(solution["A"]["E"].max()) ** 0.5  # what x has for a magnitude, as it rests
    for jump in (1e-2, 1e-4):
        broken = replace(before, within=replace(before.within, end=before.within.end + jump))
        told = residual(broken, after, link)
        assert told == pytest.approx(min(1.0, jump * deviation / (0.1 * (solution.cost - constant))), rel=1e-2)
        assert told > 1e-4


def test_a_jump_of_costates_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative to the costate, which is 2 u = 1 along the whole: from 0 to 1 in two seconds."""
    seen: list[Any] = []
    residual = phases_outcome.link_residual
    monkeypatch.setattr(phases_outcome, "link_residual", lambda *args: seen.append(args) or residual(*args))
    parts = [co.Problem(1.0, name=name) for name in ("A", "B")]
    for first, ocp in zip((True, False), parts, strict=True):
        x, u = ocp.state("x", initial=0.0 if first else None, final=None if first else 1.0), ocp.control("u")
        ocp.dynamics(x, u)
        ocp.minimize(running=u**2)
    co.solve(co.Phases(parts), intervals=10, progress=False)
    before, after, link = seen[0]
    broken = replace(before, within=replace(before.within, end=before.within.end + 0.01))
    assert residual(broken, after, link) == pytest.approx(0.01, rel=1e-4)


GROWTH = 4.0  # of the first phase, along which 4 intervals of one step are coarse


def later_pays(terminal, *, estimated: bool = False, running=0.0, final: float | None = None) -> co.Phases:
    """x grows by e^4 in the first phase, which costs nothing; in the second one x' = u."""
    first, second = co.Problem(1.0, name="grows"), co.Problem(1.0, name="pays")
    for k, ocp in enumerate((first, second)):
        x, u = ocp.state("x", initial=None if k else 0.1, final=final if k else None), ocp.control("u")
        ocp.dynamics(x, u if k else GROWTH * x)
        E = None
        if estimated:
            b = ocp.unknown("b", mean=1.0, variance=1.0)
            ocp.measurement("product", b * x, noise=2.0)
            E = ocp.estimation_covariance()[b, b]
        costs = {"running": 0.5 * u**2 + running * x, "terminal": terminal(x, E)} if k else {"running": 0.5 * u**2}
        ocp.minimize(**costs)
    return co.Phases([first, second])


@pytest.mark.parametrize(
    ("terminal", "estimated", "exact"),
    [
        (lambda x, _: 3.0 * x, False, 0.3 * np.exp(GROWTH)),
        (
            lambda _, E: E,
            True,
            1.0 / (1.0 + 0.01 * np.expm1(2 * GROWTH) / (2 * GROWTH) / 2.0 + 0.01 * np.exp(2 * GROWTH) / 2.0),
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:The mesh is too coarse", "ignore:The integration steps are long")
def test_mesh_error_of_a_phase_tells_what_its_end_costs_later(terminal, estimated, exact):
    """The phase with the long steps costs nothing itself; along the given controls x and E_bb have a closed form."""
    still = [{"u": np.zeros(5)}, {"u": np.zeros(41)}]
    phases = later_pays(terminal, estimated=estimated)
    found = co.evaluate(phases, nominal=still, intervals=[4, 40], substeps=1)
    true = abs(found.cost / exact - 1.0)
    assert true > 1e-2
    assert found[0].optimality.mesh_error == pytest.approx(true, rel=0.3)


@pytest.mark.filterwarnings("ignore:The mesh is too coarse", "ignore:The integration steps are long")
def test_mesh_error_of_a_phase_counts_what_later_ones_miss_along_their_controls():
    """With u(0) = 0 in the second phase its start costs nothing at best; along the controls x is off as it starts."""
    step = sum((GROWTH / 4) ** k / f for k, f in enumerate((1, 1, 2, 6, 24)))  # of Runge and Kutta, in a quarter
    phases = later_pays(lambda x, _: 0.0, running=2.0, final=0.1 * step**4 + 1.0)
    found = co.solve(phases, intervals=[4, 40], substeps=1, progress=False)
    assert abs(found[1]["u"][0]) < 1e-6  # the costate where the phases meet
    missed = 2.0 * 0.1 * (np.exp(GROWTH) - step**4)  # of int 2 x dt
    assert found[0].optimality.mesh_error == pytest.approx(missed / (found.cost + missed), rel=0.1)
