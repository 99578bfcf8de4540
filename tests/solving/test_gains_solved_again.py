"""A solver whose gains are controls solves again for other values, by every method, as one that is made for them."""

from __future__ import annotations

import pytest
from problems import unassessed

import covocp as co


def loop(kind: str, q: float = 0.01, start: float = 0.0) -> co.Problem:
    """A double integrator with a wall, or with a constant gain."""
    ocp = co.Problem(5.0, "loop")
    x = ocp.state("x", initial=start, final=1.0, variance=0.05)
    v = ocp.state("v", initial=0.0, final=0.0, variance=0.02)
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=ocp.parameter("q", q))
    ocp.measurement("m", x, noise=0.02)
    ocp.estimation_covariance()
    gain = {} if kind == "wall" else {"gain": co.Gain(constant=True)}
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal_weight={x: 5.0, v: 5.0}, **gain)
    if kind == "wall":
        ocp.chance(x, upper=1.5, probability=0.95, name="wall")
    return ocp


@pytest.mark.parametrize("kind", ["wall", "constant"])
@pytest.mark.parametrize(
    ("given", "declared"), [({"parameters": {"q": 0.02}}, {"q": 0.02}), ({"initial": {"x": 0.5}}, {"start": 0.5})]
)
def test_gradient_steps_solve_again_what_ipopt_solves(kind, given, declared):
    solver = co.Solver(loop(kind), "gradient", intervals=20)
    before = solver.solve(progress=False, assess=False)
    found = solver.solve(progress=False, **given)
    fresh = unassessed(loop(kind, **declared), "ipopt", intervals=20)
    assert found.cost == pytest.approx(fresh.cost, rel=2e-5)  # the mesh of the former is graded for what was declared
    assert abs(found.cost / before.cost - 1) > 1e-3
    assert solver.solve(progress=False, assess=False).cost == pytest.approx(before.cost, rel=1e-7)
