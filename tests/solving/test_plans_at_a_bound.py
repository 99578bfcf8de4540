"""States of a plan that is at a bound may pass it by what a plan may: they are where another one may start."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co


def held(start: float = 0.0, upper: float = 1.0, size: float = 1.0) -> co.Problem:
    """A double integrator whose speed is limited, in a unit of some size."""
    ocp = co.Problem(4.0, "limited speed")
    x = ocp.state("x", initial=0.0, final=3.0 * size, variance=0.01 * size**2)
    v = ocp.state("v", initial=start * size, final=0.0, upper=upper * size, variance=0.01 * size**2)
    u = ocp.control("u", lower=-2 * size, upper=2 * size)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=0.01 * size**2)
    ocp.measurement("m", x, noise=0.01 * size**2)
    E = ocp.estimation_covariance()
    ocp.minimize(running=(0.5 * u**2 + E[x, x]) / size**2)
    return ocp


@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
@pytest.mark.parametrize("size", [1.0, 1e-4])
def test_a_plan_starts_from_each_of_its_own_states(method, size):
    solver = co.Solver(held(size=size), method, intervals=20)
    plan = solver.solve(progress=False)
    assert not plan.check_path()
    passed = 0
    for t in np.arange(0.0, 4.0, 0.1):
        x, v = (float(plan.at(t)[name].item()) for name in ("x", "v"))
        found = solver.solve(
            initial={"x": x, "v": v}, guess=plan, elapsed=t, iteration_limit=0, progress=False, assess=False
        )
        assert found["v"][0].item() == pytest.approx(min(v, size), rel=1e-14)
        held(v / size, size=size)  # nor is one that is stated anew refused
        passed += v > size
    assert passed >= 2


def test_what_is_really_beyond_is_refused_with_the_digits_that_tell():
    with pytest.raises(co.ProblemError, match=r"\[-inf\] to \[1\] of the state\n  received: \[1.00002\]"):
        co.Solver(held(), intervals=10).solve(initial={"v": 1.00002})
    with pytest.raises(co.ProblemError, match=r"\[0.0001\] of the state\n  received: \[0.000101\]"):
        co.Solver(held(size=1e-4), intervals=10).solve(initial={"v": 1.01e-4})
    with pytest.raises(co.ProblemError, match="lies outside its bounds") as caught:
        held(1.00002)
    assert "1.00002" in str(caught.value)


def test_a_bound_of_zero_is_judged_by_the_size_of_the_state():
    def falling() -> co.Problem:
        ocp = co.Problem(1.0)
        h = ocp.state("h", initial=1e-3, final=5e-4, lower=0.0)
        u = ocp.control("u")
        ocp.dynamics(h, u)
        ocp.minimize(running=u**2)
        return ocp

    solver = co.Solver(falling(), intervals=10)
    found = solver.solve(initial={"h": -1e-9}, progress=False, assess=False)
    assert found["h"][0].item() == 0.0
    with pytest.raises(co.ProblemError, match="-1e-06"):
        solver.solve(initial={"h": -1e-6})
