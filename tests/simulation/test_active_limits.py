"""Limits that are active: a solver meets them to 1e-8, and what it was allowed to pass them by no run violates."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co


def burning(rate):
    """Mass burnt by a control that would rather burn more than to 0.9; known exactly."""
    ocp = co.Problem(5.0, name="fuel")
    x, m = ocp.state("x", initial=0.0, variance=0.2), ocp.state("m", initial=1.0, lower=0.5)
    u = ocp.control("u", lower=0, upper=1)
    ocp.dynamics(x, u)
    ocp.dynamics(m, rate(u, m))
    ocp.measurement("position", x, noise=0.05)
    ocp.estimation_covariance()
    ocp.minimize(running=0.1 * u**2, terminal=-x)
    ocp.subject_to(m, lower=0.9, at="final", name="dry")
    ocp.chance(m, lower=0.9, probability=0.99, at="final", name="dry, 99 %")
    ocp.chance(ca.vertcat(m, x), lower=[0.9, -10.0], probability=0.99, joint=True, at="final", name="both")
    return ocp


@pytest.mark.parametrize(
    ("rate", "intervals"), [(lambda u, m: -0.1 * u, 30), (lambda u, m: -0.3 * u**3 * m**3, 5)], ids=["exact", "coarse"]
)
def test_what_is_known_exactly_and_just_allowed_is_violated_by_no_run(rate, intervals):
    """Runs take finer steps than the nominal: on the coarse mesh they end 1e-7 below the limit."""
    solution = co.solve(burning(rate), intervals=intervals, progress=False)
    assert solution["m"][-1] == pytest.approx(0.9, abs=2e-8)
    assert [(entry.reached, entry.met) for entry in solution.chances if entry.name == "dry, 99 %"] == [(1.0, True)]
    assert all(entry.met for entry in solution.chances)
    runs = co.simulate(solution, 200, seed=1, progress=False)
    for name in ("dry", "dry, 99 %", "both"):
        assert (runs.violations[name].runs, runs.violations[name].promised_end) == (0, pytest.approx(0.0, abs=1e-12))
    assert all(entry.met and entry.predicted == pytest.approx(1.0) for entry in runs.chances.values())


def test_what_is_truly_violated_is_counted():
    """u = 1.0002 burns 2e-5 below the limit."""
    evaluated = co.evaluate(burning(lambda u, m: -0.02 * u), nominal={"u": 1.0002})
    assert [entry.reached for entry in evaluated.chances if entry.name == "dry, 99 %"] == [0.0]
    runs = co.simulate(evaluated, 200, seed=1, progress=False)
    for name in ("dry", "dry, 99 %", "both"):
        assert (runs.violations[name].runs, runs.violations[name].promised_end) == (200, 1.0)


def test_a_small_spread_at_a_large_limit_is_counted():
    """A radius of 6.4e6 m with a deviation of 1 m on its limit: half of the runs are below."""
    ocp = co.Problem(5.0, name="orbit")
    r = ocp.state("r", initial=6.4e6 + 50.0, variance=1.0)
    u = ocp.control("u", lower=-20, upper=20)
    ocp.dynamics(r, u)
    ocp.estimation_covariance()
    ocp.minimize(running=1e-3 * u**2, terminal=100 * r)
    ocp.subject_to(r, lower=6.4e6, at="final", name="ground")
    solution = co.solve(ocp, intervals=10, progress=False)
    count = co.simulate(solution, 2000, seed=1, progress=False).violations["ground"]
    passed = 6.4e6 - solution["r"][-1]
    assert abs(passed) < 0.1
    assert count.as_promised
    assert count.promised_end == pytest.approx(0.5, abs=1e-2)


def test_a_saturated_control_asks_for_no_more_before_anything_is_fed_back():
    """The nominal is at its bound, to 1e-8; at time zero nothing is estimated, so every run asks for just that."""
    ocp = co.Problem(4.0, name="saturated")
    x, u = ocp.state("x", initial=0.0, final=3.0, variance=0.1), ocp.control("u", lower=-1, upper=1)
    ocp.dynamics(x, u, noise=0.01)
    ocp.measurement("m", x, noise=0.05)
    ocp.minimize_expected(running=(x - 3) ** 2 + 0.01 * u**2, terminal_weight={x: 3.0})
    # a run of its own, which ends beyond the bound by what Ipopt loosens it
    solution = co.solve(ocp, intervals=20, max_iterations=1000, progress=False)
    assert 1.0 <= solution["u"][0] < 1.0 + 1e-7
    runs = co.simulate(solution, 300, seed=1, progress=False)
    assert runs.asking[0] == 0.0
    assert runs.violating[0].tolist() == runs.promised[0].tolist() == [0.0]
    k = int(np.argmin(np.abs(runs.t - 1.0)))
    assert runs.asking[k] == pytest.approx(0.5, abs=0.1)  # of a normal deviation about the bound
