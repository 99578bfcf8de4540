"""A measurement is the mean since the last step: the exported laws expect that mean, not what is there at its end."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import means
import numpy as np
import pytest
from exports import FOLDER

import covocp as co
from covocp.export import export_c

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


@pytest.mark.parametrize("period", [None, 0.1])
def test_a_flown_law_has_no_bias(period: float | None) -> None:
    """A mass that must go from 0 to 4: at the end it was half a step of its way, eight standard deviations, too far."""
    ocp = co.Problem(4.0, name="mass")
    x = ocp.state("x", initial=0.0, final=4.0, variance=1e-4)
    v = ocp.state("v", initial=1.0, variance=1e-4)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=1e-5)
    ocp.measurement("m", x, noise=1e-5)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 10.0})
    solution = co.solve(ocp, progress=False)
    law = export_c(solution, FOLDER / f"mass_{period}", period=period, largest_spread=np.inf).python()
    sample = co.simulate(solution, 200, seed=1, law=law, period=0.1, progress=False)
    assert abs(sample.deviations[:, 0].mean()) < 4 * sample.deviations[:, 0].std() / np.sqrt(200)
