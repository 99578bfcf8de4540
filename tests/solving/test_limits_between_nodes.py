"""Path constraints that must hold between the nodes: `subject_to(..., between="auto")`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co


def thrown(between: Any, limit: float = 0.12) -> co.Problem:
    """A mass thrown under a roof that falls: least energy."""
    ocp = co.Problem(duration=1.0, name="roof")
    x, v = ocp.state("x", initial=0.0, final=0.0), ocp.state("v", initial=1.0, final=-1.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=0.5 * u**2)
    ocp.subject_to(x + 0.05 * ocp.time, upper=limit, name="roof", between=between)
    return ocp


def highest(solution: co.Solution) -> float:
    """Largest value of x + 0.05 t along an integration of the control by scipy."""

    def rate(t: float, z: Any) -> list[float]:
        return [z[1], float(np.interp(t, solution.t, solution["u"]))]

    t = np.linspace(0.0, 1.0, 4001)
    run = solve_ivp(rate, (0.0, 1.0), [0.0, 1.0], t_eval=t, rtol=1e-10, atol=1e-12, max_step=0.01)
    return float((run.y[0] + 0.05 * t).max())


@pytest.mark.parametrize("intervals", [5, 12, 30])
def test_the_limit_holds_between_the_nodes(intervals):
    with pytest.warns(co.CovocpWarning) if intervals == 5 else _quiet():
        loose = co.solve(thrown(None), intervals=intervals, progress=False)
    kept = co.solve(thrown("auto"), intervals=intervals, progress=False)
    assert highest(kept) <= 0.12 * (1 + 1.1e-4)
    assert highest(kept) <= highest(loose)
    assert np.array_equal(kept.mesh.nodes, loose.mesh.nodes)
    if intervals < 30:
        assert highest(loose) > 0.12 * (1 + 1e-3)
        assert kept.mesh.points > loose.mesh.points


def _quiet() -> Any:
    import contextlib

    return contextlib.nullcontext()


def test_with_a_refined_mesh_both_hold():
    solution = co.solve(thrown("auto"), refine=1e-5, progress=False)
    exact = co.solve(thrown("auto"), intervals=300, points=4, progress=False)
    assert highest(solution) <= 0.12 * (1 + 2.5e-5)
    assert abs(solution.cost / exact.cost - 1.0) <= 1e-5
    assert solution.stats["mesh_errors"][-1] <= 1e-5


def test_a_bound_on_a_covariance():
    ocp = co.Problem(duration=4.0, name="watched")
    x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u", lower=0.0, upper=2.0)
    ocp.dynamics(x, -x + u, noise=0.5)
    ocp.measurement("m", (1 + u) * x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + 0 * x)
    ocp.subject_to(E[x, x] - 1.0 + 0.25 * ocp.time, upper=0.45, name="spread", between="auto")
    solution = co.solve(ocp, intervals=8, progress=False)
    assert solution.check_path(60).get("spread", 0.0) <= 0.45 * 1.1e-4


def test_what_cannot_be_kept_is_said():
    with pytest.raises(co.ProblemError, match="'gradient' cannot keep 'roof' between the nodes"):
        co.Solver(thrown("auto"), "gradient")
    comparison = co.compare(thrown("auto"), intervals=10, progress=False)
    assert "between the nodes" in comparison.rows[1].reason
    assert comparison["ipopt"].converged
    with pytest.warns(co.CovocpWarning) as told:  # one interval cannot turn before the roof
        co.solve(thrown("auto"), intervals=1, progress=False)
    assert any("'roof' does not hold between the nodes as between='auto' asks" in str(entry.message) for entry in told)


@pytest.mark.parametrize("wrong", [True, 1, "always", 1e-3])
def test_wrong_words_are_refused(wrong):
    with pytest.raises(co.ProblemError, match="'roof' has a wrong between="):
        thrown(wrong)


def test_it_is_of_the_path_alone():
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=0.0)
    with pytest.raises(co.ProblemError, match="between="):
        ocp.subject_to(x, upper=1.0, at="final", between="auto")
