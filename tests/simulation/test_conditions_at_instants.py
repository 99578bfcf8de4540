"""Conditions at instants in simulated runs: who violates them there, against the runs themselves and the normal law."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

import covocp as co

RUNS = 4000


def steered(*, sampled: bool = False, control: bool = False) -> co.Solution:
    """A linear system with feedback that passes below a limit at half of the time."""
    ocp = co.Problem(2.0, name="steered")
    x, v = ocp.state("x", initial=1.0, variance=0.02), ocp.state("v", initial=0.0, variance=0.01)
    u = ocp.control("u")
    ocp.dynamics(x, v, noise=0.002)
    ocp.dynamics(v, u - 0.1 * v, noise=0.01)
    if sampled:
        ocp.measurement("fix", x, noise=0.02, every=0.25)
    else:
        ocp.measurement("position", x, noise=0.02)
    ocp.subject_to(x, at=1.0, upper=0.4, name="below")
    ocp.subject_to(x + 0.2 * u if control else x, at=1.5, lower=0.0, name="above")
    ocp.subject_to(v, at=1.0, equals=-0.8, name="speed")
    ocp.minimize_expected(running=u**2 + x**2, terminal=5 * x**2 + v**2)
    return co.solve(ocp, intervals=30, progress=False)


@pytest.mark.parametrize("kind", [{}, {"sampled": True}, {"control": True}])
def test_runs_that_violate_a_condition_at_its_instant_are_counted(kind: dict[str, Any]) -> None:
    solution = steered(**kind)
    sample = co.simulate(solution, RUNS, seed=3, paths=RUNS, store=9, progress=False)
    k = np.flatnonzero(np.abs(sample.t - 1.0) < 1e-12)
    assert k.size == 2
    x = sample.nominal[k[-1], 0] + sample.paths[:, k[-1], 0]
    count = sample.violations["below"]
    assert count.runs == np.count_nonzero(x > 0.4)
    assert count.most_time == 1.0
    assert count.promised_end == pytest.approx(0.5, abs=1e-3)  # the limit binds the nominal
    assert count.as_promised
    late = sample.violations["above"]
    k = int(np.flatnonzero(np.abs(sample.t - 1.5) < 1e-12)[-1])
    value = sample.nominal[k, 0] + sample.paths[:, k, 0]
    if kind.get("control"):
        value = value + 0.2 * (sample.nominal_control[k, 0] + sample.paths[:, k, -1])
    assert late.runs == np.count_nonzero(value < 0.0)
    assert late.promised_end == pytest.approx(stats.norm.cdf(-value.mean() / value.std()), abs=0.02)
    assert late.as_promised
    assert "equality" in sample.inequalities.left_out["speed"]
    assert sample.verdict.holds
    assert "instant" in str(sample)


def test_a_run_that_left_the_domain_before_the_instant_violates_it() -> None:
    """With a truth that drives all runs away early every run counts, with one that does so late none does for that."""
    solution = steered()

    def truth(push: float, begin: float) -> co.Problem:
        ocp = co.Problem(2.0, name="pushed")
        x, v = ocp.state("x", initial=1.0, variance=0.02), ocp.state("v", initial=0.0, variance=0.01)
        u = ocp.control("u")
        ocp.dynamics(x, v - push * (ocp.time > begin), noise=0.002)
        ocp.dynamics(v, u - 0.1 * v, noise=0.01)
        ocp.measurement("position", x, noise=0.02)
        ocp.minimize_expected(running=u**2 + x**2, terminal=5 * x**2 + v**2)
        return ocp

    early = co.simulate(solution, 64, seed=1, truth=truth(1e4, 0.2), progress=False)
    assert early.left_share == 1.0
    assert early.violations["below"].runs == 64
    late = co.simulate(solution, 64, seed=1, truth=truth(1e4, 1.2), progress=False)
    plain = co.simulate(solution, 64, seed=1, progress=False)
    assert late.left_share == 1.0
    assert late.violations["below"].runs == plain.violations["below"].runs < 64
    assert late.violations["above"].runs == 64


def test_runs_through_phases_are_counted() -> None:
    phases = []
    for name, first in (("one", True), ("two", False)):
        ocp = co.Problem(1.0, name=name)
        x = ocp.state("x", initial=1.0 if first else None, variance=0.05 if first else None)
        u = ocp.control("u")
        ocp.dynamics(x, u, noise=0.02)
        ocp.measurement("position", x, noise=0.02)
        ocp.subject_to(x, at=0.5, upper=0.8 if first else 0.3, name="below")
        ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=0.0 if first else 2.0 * x**2)
        phases.append(ocp)
    solution = co.solve(co.Phases(phases), intervals=20, progress=False)
    sample = co.simulate(solution, 500, seed=1, paths=500, progress=False)
    for own, limit in zip(sample.phases, (0.8, 0.3), strict=True):
        k = int(np.flatnonzero(np.abs(own.t - 0.5) < 1e-12)[-1])
        assert own.violations["below"].runs == np.count_nonzero(own.nominal[k, 0] + own.paths[:, k, 0] > limit)
