"""Conditions on probabilities in phases: closed forms through links, both methods, runs, files, what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.stats import norm

import covocp as co

START, NOISE, JUMP = 0.01, 0.02, 0.03
QUANTILE = norm.ppf(0.9)
QUIET: dict[str, Any] = {"progress": False}


def pushed(name: str, *, first: bool, measured: bool, noise: float = NOISE) -> co.Problem:
    """A second in which a push costs, by a control that knows nothing; how far it pays is said at the end of two."""
    ocp = co.Problem(1.0, name)
    x = ocp.state("x", initial=0.0 if first else None, variance=START if first else None)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=noise or None)
    if measured:
        ocp.measurement("m", x, noise=0.01)
    ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=0.0 if first else -x)
    return ocp


def walled(measured: tuple[bool, bool], factor: float = 1.0, **second: Any) -> co.Phases:
    """Both, with a wall at the end; where they meet x is multiplied."""
    parts = [pushed("out", first=True, measured=measured[0])]
    parts += [pushed("on", first=False, measured=measured[1], **second)]
    x, y = (part.states[0].symbol for part in parts)
    parts[1].chance(y, upper=1.0, probability=0.9, at="final", name="wall")
    phases = co.Phases(parts)
    if factor != 1.0:
        phases.jump(y, factor * x, noise=JUMP)
    return phases


@pytest.mark.parametrize(
    ("measured", "factor", "options"),
    [
        ((False, False), 1.0, {}),
        ((False, False), -0.5, {}),
        ((True, True), -0.5, {"covariances": "states"}),
        ((True, True), -0.5, {"covariances": "eliminated"}),
        ((False, True), 1.0, {}),
        ((True, False), -0.5, {"method": "gradient"}),
    ],
)
def test_the_spread_goes_through_the_link_in_closed_form(
    measured: tuple[bool, bool], factor: float, options: dict[str, Any]
) -> None:
    solution = co.solve(walled(measured, factor), intervals=3, **options, **QUIET)
    noise = 0.0 if factor == 1.0 else JUMP
    spread = np.sqrt(factor**2 * (START + NOISE) + noise + NOISE)
    end = 1.0 - QUANTILE * spread
    # x(T) = factor u1 + u2 with least (u1^2 + u2^2)/2: u1 = factor lambda, u2 = lambda.
    cost = end**2 / (2.0 * (1.0 + factor**2)) - end
    assert solution["on"]["x"][-1] == pytest.approx(end, abs=1e-6)
    assert solution.cost == pytest.approx(cost, abs=1e-4 if options.get("method") else 1e-7)
    assert not solution["out"].chances
    (wall,) = solution["on"].chances
    assert wall.deviation == pytest.approx(spread, rel=1e-7)
    assert wall.reached == pytest.approx(0.9, abs=1e-6)
    assert wall.margin == pytest.approx(0.0, abs=1e-6)
    assert wall.met
    assert "wall" in str(solution)


def corridor(duration: float, name: str, *, first: bool = True, last: bool = True) -> co.Problem:
    """A body that is to be fast and to keep off a wall all the way, or a part of it."""
    ocp = co.Problem(duration, name)
    x = ocp.state("x", initial=0.0 if first else None, variance=0.002 if first else None)
    v = ocp.state("v", initial=0.0 if first else None, variance=0.001 if first else None)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.3 * v, noise=0.004)
    ocp.measurement("position", x, noise=0.01)
    ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + (x - 1.0) ** 2)
    ocp.chance(ca.vertcat(x, v), lower=[-1.0, -1.0], upper=[0.7, 0.5], probability=0.9, joint=True, name="walls")
    return ocp


@pytest.fixture(scope="module")
def in_corridors() -> tuple[Any, Any]:
    parts = [corridor(1.0, "first", last=False), corridor(1.0, "second", first=False)]
    whole = co.solve(corridor(2.0, "whole"), intervals=20, tolerance=1e-10, **QUIET)
    return whole, co.solve(co.Phases(parts), intervals=10, tolerance=1e-10, **QUIET)


def test_a_cut_changes_nothing(in_corridors: tuple[Any, Any]) -> None:
    whole, cut = in_corridors
    assert cut.cost == pytest.approx(whole.cost, rel=1e-8)
    np.testing.assert_allclose(cut["second"]["X"], whole["X"][10:], rtol=1e-6, atol=1e-12)
    for k, entry in enumerate(whole.chances):
        tightest = min((phase.chances[k] for phase in cut), key=lambda q: q.reached)
        for name in ("reached", "deviation", "margin"):
            np.testing.assert_allclose(getattr(tightest, name), getattr(entry, name), atol=1e-6)
    assert min(q.reached for q in whole.chances[:2]) == pytest.approx(0.95, abs=1e-5)  # of the risk each takes half


def test_runs_meet_it_and_files_keep_it(in_corridors: tuple[Any, Any], tmp_path: Path) -> None:
    _, cut = in_corridors
    runs = co.simulate(cut, 2000, seed=4, step=0.05, **QUIET)
    for phase, solved in zip(runs, cut, strict=True):
        share = phase.chances["walls"]
        assert share.met
        assert share.predicted == pytest.approx(solved.chances[-1].reached, abs=1e-3)
        assert share.least - 0.02 < share.end
        assert share.end_band[0] <= share.end <= share.end_band[1]
    assert str(runs).count("walls") >= 2
    kept = cut.save(tmp_path / "cut.npz")
    parts = [corridor(1.0, "first", last=False), corridor(1.0, "second", first=False)]
    again = co.load(kept, co.Phases(parts))
    assert [q.reached for phase in again for q in phase.chances] == [q.reached for p in cut for q in p.chances]
    assert "walls" in str(co.load(kept))
    cut.plot("walls", path=tmp_path / "walls.png")
    plt.close("all")


def test_what_appears_scatters_too() -> None:
    first = pushed("first", first=True, measured=True)
    second = co.Problem(1.0, "second")
    x, q = second.state("x", initial=None), second.state("q", initial=0.5, variance=0.04)
    u = second.control("u")
    second.dynamics(x, u, noise=NOISE)
    second.dynamics(q, 0.0 * q)
    second.chance(x + q, upper=1.0, probability=0.9, at="final", name="both")
    second.minimize(running=0.5 * u**2, terminal=-x)
    solution = co.solve(co.Phases([first, second]), intervals=2, **QUIET)
    spread = np.sqrt(START + 2 * NOISE + 0.04)
    assert solution["second"]["x"][-1] == pytest.approx(0.5 - QUANTILE * spread, abs=1e-6)


def test_a_phase_that_only_inherits_what_is_uncertain() -> None:
    solution = co.solve(walled((True, False), noise=0.0), intervals=2, **QUIET)
    assert solution["on"].chances[0].deviation == pytest.approx(np.sqrt(START + NOISE), rel=1e-7)


def test_what_is_refused() -> None:
    def part(name: str, *, first: bool, fed_back: bool = True) -> co.Problem:
        ocp = co.Problem(1.0, name)
        x = ocp.state("x", initial=0.0 if first else None, variance=0.1 if first else None)
        u = ocp.control("u")
        ocp.dynamics(x, u)
        state_cost = ocp.minimize_expected if fed_back else ocp.minimize
        state_cost(running=u**2 + x**2)
        return ocp

    one, two = part("one", first=True), part("two", first=False, fed_back=False)
    plain = list(walled((False, False)).problems)
    with pytest.raises(co.ProblemError, match=r"phase 'on' has the chance condition 'wall'.*of its own"):
        co.solve(co.Phases([plain[0], co.movable(plain[1])]), **QUIET)
    two.chance(two.states[0].symbol, upper=1.0, probability=0.9, name="wall")
    with pytest.raises(co.ProblemError, match="phase 'two' has no expected cost, and others have one"):
        co.solve(co.Phases([one, two]), **QUIET)
    certain = [co.Problem(1.0, name) for name in ("one", "two")]
    for k, ocp in enumerate(certain):
        x, u = ocp.state("x", initial=None if k else 0.0), ocp.control("u")
        ocp.dynamics(x, u)
        ocp.minimize(running=u**2)
    certain[1].chance(certain[1].states[0].symbol, upper=1.0, probability=0.9, name="wall")
    with pytest.raises(co.ProblemError, match="nothing in the system is uncertain"):
        co.solve(co.Phases(certain), **QUIET)
    third = co.Problem(1.0, "third")
    y, X = third.state("x", initial=None), third.symmetric("X", 1, initial=None)
    third.dynamics(y, third.control("u"))
    third.dynamics(X, X)
    third.minimize(terminal=y)
    with pytest.raises(co.ProblemError, match=r"In the phase 'third': .*'X'"):
        co.solve(co.Phases([*walled((True, True)).problems, third]), **QUIET)
