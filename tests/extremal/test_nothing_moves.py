"""States that are zero but for roundoff: what is measured in their range is measured in their deviations."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co


def with_wind(*, varying: bool) -> co.Problem:
    """A cart in wind of mean zero, whose nominal is roundoff, under a force that the time gives."""
    ocp = co.Problem(10.0)
    x, v = ocp.state("x", initial=1.0, variance=0.1), ocp.state("v", initial=0.0, variance=0.1)
    wind, u = ocp.state("wind", initial=0.0, variance=0.5), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.5 * v + wind + (0.3 * ca.sin(ocp.time) if varying else 0.0))
    ocp.dynamics(wind, -0.5 * wind, noise=0.2)
    ocp.measurement("position", x, noise=0.01)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=5 * x**2)
    return ocp


@pytest.mark.parametrize("varying", [True, False])
def test_the_error_of_the_mesh_is_that_of_the_cost(varying: bool) -> None:
    """Against eight times as many intervals; it had been 0.1 to 1 of a wind of 1e-32 m/s^2."""
    solution, exact = (co.solve(with_wind(varying=varying), intervals=n, progress=False) for n in (50, 400))
    assert solution.mesh_error < 1e-5
    assert abs(solution.cost / exact.cost - 1) < 3e-6


def at_rest() -> co.Problem:
    """An integrator of unknown gain that begins and ends at zero: without noise nothing moves."""
    ocp = co.Problem(3.0)
    x, b, u = ocp.state("x", initial=0.0, final=0.0, variance=0.2), ocp.unknown("b", 1.0, 1.0), ocp.control("u")
    ocp.dynamics(x, b * u, noise=0.05)
    ocp.measurement("m", x, noise=0.02)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 20.0})
    return ocp


def test_a_nominal_that_rests_is_solved_between_its_nodes_too() -> None:
    """Steps towards the digits of roundoff had become shorter than the time has digits."""
    solution = co.solve(at_rest(), nominal="deterministic", progress=False)
    sample = solution.at(np.linspace(0.0, 3.0, 301))
    assert np.abs(sample["x"]).max() < 1e-12
    assert np.linalg.eigvalsh(sample["E"]).min() > 0
    assert abs(co.worth(at_rest()).gain) < 1e-4


@pytest.mark.parametrize("at", ["path", "final"])
def test_a_cost_that_vanishes_beside_a_limit_has_no_share_that_is_wrong(at: str) -> None:
    """Multipliers of 1e-20 that are left beside a limit move controls: two thirds of 1e-34 were told as off."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, -x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.5)
    E = ocp.estimation_covariance()
    ocp.subject_to(E[x, x], upper=10.0, at=at)
    ocp.minimize(running=x**2 + u**2)
    solution = co.solve(ocp, intervals=20, progress=False)
    assert solution.optimality.control_error == 0.0
    assert solution.optimality.stationarity == 0.0
    assert "LARGE" not in str(solution)
