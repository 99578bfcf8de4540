"""A measurement is the mean since the last step: the exported laws expect that mean, not what is there at its end."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import means
import numpy as np
import pytest
from exports import FOLDER, quick

import covocp as co
from covocp.export import export_c
from covocp.export.laws.design import design_of
from covocp.export.laws.history import history
from covocp.export.laws.law import span
from covocp.export.laws.sampled import discretised

DURATION, PERIOD = 2.0, 0.1


@cache
def linear(seed: int) -> tuple[Any, co.Solution]:
    """F, G, M, H, start of a random linear system, stable or not, in units of its own; the nominal moves quickly."""
    random = np.random.default_rng(seed)
    n, r = int(random.integers(1, 4)), int(random.integers(1, 3))
    unit, seen = 10.0 ** random.uniform(-4, 4, n), 10.0 ** random.uniform(-4, 4, r)
    F = unit[:, None] * (random.normal(size=(n, n)) * 10.0 ** random.uniform(-1, 0)) / unit
    G, H = unit[:, None] * random.normal(size=(n, 1)), seen[:, None] * random.normal(size=(r, 1))
    M, start = seen[:, None] * random.normal(size=(r, n)) / unit, unit * random.normal(size=n)
    ocp = co.Problem(DURATION, name="linear")
    x, u = ocp.state("x", n, initial=start, variance=0.1 * unit**2), ocp.control("u")
    ocp.dynamics(x, ca.DM(F) @ x + ca.DM(G) @ u, noise=0.05 * unit**2)
    ocp.measurement("m", ca.DM(M) @ x + ca.DM(H) @ u, noise=1e-2 * seen**2)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 1.0 / unit**2})
    solution = co.evaluate(ocp, nominal={"u": lambda s: np.sin(4.0 * s)}, intervals=40, substeps=4)
    return (F, G, M, H, start, unit), solution


def lost(law: Any, system: Any, lengths: list[float], missing: tuple[int, ...] = ()) -> float:
    """Largest difference of estimate and true deviation, in sizes, of a plant without noise that is told its means."""
    F, G, M, H, x, unit = system
    r, now, worst, size = len(M), 0.0, 0.0, unit.copy()
    law.init()
    u = np.ravel(law.step(np.full(r, np.nan), 0.0))
    for k, h in enumerate(lengths):
        own = means.told(F, G, M, H, np.eye(len(F)), np.eye(r), h)
        after = own.state @ x + own.held @ u
        x, now = after[: len(F)], now + h
        told = np.where(k in missing, np.nan, after[len(F) :])
        u = np.ravel(law.step(told, min(now, DURATION)))
        size = np.maximum(size, np.abs(law.state["nominal_state"]))
        worst = max(worst, float(np.abs((law.estimate - (x - law.state["nominal_state"])) / size).max()))
    return worst


@pytest.mark.parametrize("seed", range(4))
def test_what_the_nominal_moves_in_a_step_is_no_deviation(seed: int) -> None:
    """The control that is held makes deviations, which are known; so nothing of what is measured is new."""
    system, solution = linear(seed)
    law = export_c(solution, FOLDER / f"means_{seed}", largest_spread=np.inf).reference()["step"]
    for lengths in ([0.05] * 40, [0.03, 0.31, 0.16, 0.9, 0.05, 0.55]):
        assert lost(law, system, lengths, missing=(2,)) < 1e-5
    law = export_c(solution, FOLDER / f"sampled_means_{seed}", period=PERIOD, largest_spread=np.inf).reference()["step"]
    for lengths in ([PERIOD] * 20, [0.1, 0.3, 0.1, 0.7, 0.2, 0.6]):
        assert lost(law, system, lengths, missing=(2,)) < 1e-5


@cache
def mass() -> co.Solution:
    """Goes from 0 to 4 in a wind that is known."""
    ocp = co.Problem(4.0, name="mass")
    x = ocp.state("x", initial=0.0, final=4.0, variance=1e-4)
    v = ocp.state("v", initial=1.0, variance=1e-4)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u + ca.cos(3.0 * ocp.time), noise=1e-5)
    ocp.measurement("m", x, noise=1e-5)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 10.0})
    return co.solve(ocp, progress=False)


def on_its_way(law: Any, times: np.ndarray) -> np.ndarray:
    """Deviation from the nominal, in predicted standard deviations, of the mass without noise, by exact integrals."""
    solution, z, now, found = mass(), np.array([0.0, 1.0]), 0.0, []
    sin, cos = (lambda t, f=f: f(3.0 * t) for f in (np.sin, np.cos))
    held = float(law.step(np.nan, 0.0)[0])
    for time in times:
        h, (x, v) = time - now, z
        push = v - sin(now) / 3.0
        mean = x + push * h / 2 + held * h**2 / 6 + (cos(now) - (sin(time) - sin(now)) / (3.0 * h)) / 9.0
        x += push * h + held * h**2 / 2 + (cos(now) - cos(time)) / 9.0
        z, now = np.array([x, v + held * h + (sin(time) - sin(now)) / 3.0]), time
        held = float(law.step(mean, time)[0])
        deviation, X = z - law.state["nominal_state"], np.diagonal(solution.loop.X, axis1=1, axis2=2)
        np.testing.assert_allclose(law.estimate, deviation, rtol=0, atol=2e-6)
        found.append(deviation / [np.sqrt(np.interp(time, solution.t, X[:, k])) for k in range(2)])
    return np.array(found)


@pytest.mark.parametrize("irregular", [False, True])
def test_the_control_that_is_held_does_not_lag_on_the_way(irregular: bool) -> None:
    """Held at its value at the time of the call it was half a step behind: three predicted deviations."""
    times = np.linspace(0.1, 4.0, 40)
    if irregular:
        times[:-1] += np.random.default_rng(1).uniform(-0.02, 0.02, 39)
    law = export_c(mass(), FOLDER / f"mass_any_{irregular}", largest_spread=np.inf).reference()["step"]
    law.init()
    law._values[span(law.law.outputs, "length")] = times[0]
    assert np.abs(on_its_way(law, times)).max() < (0.8 if irregular else 0.2)
    law.init()  # unknown length of the first step: the lag of that one alone
    assert np.abs(on_its_way(law, times)[20:]).max() < 0.8


def test_with_a_period_the_mean_of_the_loop_is_what_is_said_of_it() -> None:
    samples = discretised(design_of(mass(), None), history(mass(), "double"), 0.15)  # 0.1 s are left at the end
    law = export_c(mass(), FOLDER / "mass_period", period=0.15, largest_spread=np.inf).reference()["step"]
    law.init()
    shares = on_its_way(law, 0.15 * np.arange(1, 27))
    X = np.diagonal(mass().loop.X, axis1=1, axis2=2)
    sizes = np.array([np.sqrt(np.interp(samples.times[1:], mass().t, X[:, k])) for k in range(2)]).T
    np.testing.assert_allclose(samples.lag[1:], shares * sizes, rtol=0, atol=2e-5)
    t = np.unique([3.9, 4.0, *mass().t[mass().t > 3.9]])
    left = np.trapezoid([float(mass().at(s)["u"]) for s in t], t) / 0.1
    assert float(law.state["control"]) == pytest.approx(
        left - float(np.ravel(law.state["feedback_gain"]) @ law.estimate)
    )


@pytest.mark.parametrize("period", [None, 0.1])
def test_a_flown_law_has_no_bias(period: float | None) -> None:
    """At the end it was half a step of its way, eight standard deviations, too far."""
    solution = mass()
    law = quick(export_c(solution, FOLDER / f"mass_{period}", period=period, largest_spread=np.inf)).python()
    sample = co.simulate(solution, 200, seed=1, law=law, period=0.1, progress=False)
    assert abs(sample.deviations[:, 0].mean()) < 4 * sample.deviations[:, 0].std() / np.sqrt(200)
