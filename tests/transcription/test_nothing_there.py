"""Programs of which a part is empty: no parameters, no controls, a control in no rate; closed forms."""

import numpy as np
import pytest

import covocp as co


@pytest.mark.parametrize("options", [{"intervals": 17, "segments": 4}, {"intervals": 8, "points": 3}], ids=str)
@pytest.mark.parametrize("method", ["ipopt", "reduced"])
def test_no_parameters_with_segments_of_unequal_length_and_limits_between_nodes(method, options):
    """From 0 to 1 in one second; the limit of x is never met."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.subject_to(x, upper=2.0)
    ocp.minimize(running=u**2)
    assert co.solve(ocp, method, progress=False, **options).cost == pytest.approx(1.0, rel=1e-9)


def test_a_decision_as_the_initial_value_of_a_scalar_state():
    """d^2 + (1/2 - d)^2 is least at d = 1/4; the variance is 1/(1/V + T/r) at the end."""
    ocp = co.Problem(1.0)
    d = ocp.decision("d", guess=1.0)
    x, u = ocp.state("x", initial=d, final=0.5, variance=0.2), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("y", x, noise=0.25)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=d**2 + E[x, x])
    solution = co.solve(ocp, progress=False)
    assert solution.cost == pytest.approx(0.125 + 1.0 / 9.0, rel=1e-7)
    assert float(solution["d"]) == pytest.approx(0.25, rel=1e-6)


@pytest.mark.parametrize("method", ["ipopt", "reduced", "auto"])
def test_a_free_initial_state_without_controls(method):
    """x = a exp(-t): a^2 ((1 - e^-2)/2 + e^-2) - 0.6 a (1 - e^-1) + 0.09."""
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=None)
    ocp.dynamics(x, -x)
    ocp.minimize(running=(x - 0.3) ** 2, terminal=x**2)
    square, linear = (1.0 - np.exp(-2.0)) / 2.0 + np.exp(-2.0), 0.6 * (1.0 - np.exp(-1.0))
    solution = co.solve(ocp, method, intervals=40, progress=False)
    assert solution.cost == pytest.approx(0.09 - linear**2 / (4.0 * square), rel=1e-6)


def test_the_conditions_of_a_control_that_a_constraint_alone_contains():
    """w follows u, which is 1 all the way."""
    ocp = co.Problem(1.0)
    x, u, w = ocp.state("x", initial=0.0, final=1.0), ocp.control("u"), ocp.control("w", guess=0.3)
    ocp.dynamics(x, u)
    ocp.subject_to(w - u, equals=0.1)
    ocp.minimize(running=u**2)
    solution = co.solve(ocp, intervals=8, progress=False)
    assert solution.cost == pytest.approx(1.0, rel=1e-9)
    assert solution["w"] == pytest.approx(1.1, rel=1e-6)
    assert solution.optimality.stationarity < 1e-8
