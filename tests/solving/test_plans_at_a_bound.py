"""States of a plan that is at a bound may pass it by what a plan may: they are where another one may start."""

from __future__ import annotations

from typing import Any

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
        passed += v > size
    assert passed >= 2


def test_what_is_really_beyond_is_refused_with_the_digits_that_tell():
    with pytest.raises(co.ProblemError, match=r"\[-inf\] to \[1\] of the state\n  received: \[1.00002\]"):
        co.Solver(held(), intervals=10).solve(initial={"v": 1.00002})
    with pytest.raises(co.ProblemError, match=r"\[0.0001\] of the state\n  received: \[0.000101\]"):
        co.Solver(held(size=1e-4), intervals=10).solve(initial={"v": 1.01e-4})
    with pytest.raises(co.ProblemError, match="lies outside its bounds") as caught:
        held(1.00000002)
    assert "1.00000002" in str(caught.value)


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


def moving(initial: float, final: float | None = None, **given: float) -> co.Problem:
    """One state, moved at will away from the bound that it has."""
    ocp = co.Problem(10.0)
    r = ocp.state("r", initial=initial, final=final, **given)
    u = ocp.control("u")
    ocp.dynamics(r, u)
    ocp.minimize(running=(u - (1e-3 if "lower" in given else -1e-3)) ** 2)
    return ocp


DECLARED = [(6377950.0, 6378000.0, None), (6377950.0, 6378000.0, 1.0), (2451544.9, 2451545.0, None)]
DECLARED += [(273.148, 273.15, None), (-9.9, 0.0, 1e6), (-1e-6, 0.0, 1e6), (1 - 1e-9, 1.0, None)]


@pytest.mark.parametrize(("value", "bound", "scale"), DECLARED)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_declared_value_beyond_its_bound_is_refused_whatever_the_size_of_the_bound(value, bound, scale, side):
    given = {"lower" if side > 0 else "upper": side * bound} | ({} if scale is None else {"scale": scale})
    with pytest.raises(co.ProblemError, match="The initial value of 'r' lies outside its bounds"):
        moving(side * value, **given)
    with pytest.raises(co.ProblemError, match="The final value of 'r' lies outside its bounds"):
        moving(side * (bound + 1.0), side * value, **given)


def test_a_declared_value_beyond_by_rounding_is_at_its_bound():
    found = co.solve(moving(0.3, 3 * 0.1, upper=0.3), intervals=5, progress=False)
    assert found["r"][0].item() == found["r"][-1].item() == 0.3
    assert co.solve(moving(0.3 - 3 * 0.1, lower=0.0), intervals=5, progress=False)["r"][0].item() == 0.0


RESTARTED = [
    (dict(initial=6778000.0, lower=6378000.0), 4.0),  # metres from the centre: what moves is 400 km
    (dict(initial=2451545.3, lower=2451545.0), 3e-6),  # days
    (dict(initial=2451545.0, final=2451545.3, lower=2451545.0), 3e-6),
    (dict(initial=2451545.0, lower=2451545.0, upper=2451546.0), 1e-5),
    (dict(initial=2451545.0, lower=2451545.0, scale=0.1), 1e-6),
    (dict(initial=6378000.0, lower=6378000.0, scale=1.0), 1e-5),
    (dict(initial=5.0, final=2.0, lower=1.0), 1e-5),
    (dict(initial=5.0, lower=0.0), 5e-5),
    (dict(initial=5.0, lower=0.0, scale=0.01), 1e-7),
    (dict(initial=0.0, lower=0.0), 1e-5),
]


@pytest.mark.parametrize(("given", "margin"), RESTARTED)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_start_may_pass_its_bound_by_a_share_of_what_moves(given, margin, side):
    bound = given["lower"]
    if side < 0:
        pairs = {"lower": "upper", "upper": "lower"}
        given = {pairs.get(k, k): value if k == "scale" else -value for k, value in given.items()}
    solver = co.Solver(moving(**given), intervals=5)
    begun: dict[str, Any] = {"iteration_limit": 0, "progress": False, "assess": False}
    found = solver.solve(initial={"r": side * (bound - 0.9 * margin)}, **begun)
    assert found["r"][0].item() == side * bound
    with pytest.raises(co.ProblemError, match="numbers within the bounds"):
        solver.solve(initial={"r": side * (bound - 1.1 * margin)}, **begun)
