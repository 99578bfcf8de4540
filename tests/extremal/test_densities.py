"""Noise densities and bounds of matrices that are broken on the way are never passed off as solutions."""

import casadi as ca
import numpy as np
import pytest

import covocp as co


def moving(measurement, process=lambda ocp: 0.1):
    ocp = co.Problem(4.0)
    x = ocp.state("x", initial=0, final=1, variance=1)
    b = ocp.unknown("b", 1, 1)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=process(ocp))
    ocp.measurement("m", x, noise=measurement(ocp))
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=5 * E[b, b])
    return ocp


@pytest.mark.parametrize(
    ("measurement", "process", "words"),
    [
        (lambda ocp: 1 - 0.41 * ocp.time, lambda ocp: 0.1, ("measurement noise of m", "t = 2.44 s")),
        (lambda ocp: (ocp.time - 2) ** 2, lambda ocp: 0.1, ("measurement noise of m", "t = 2 s")),
        (lambda ocp: 1.0, lambda ocp: 0.3 - 0.12 * ocp.time, ("process noise of x, b", "t = 2.52 s")),
    ],
)
def test_density_that_no_noise_has_is_no_solution(measurement, process, words):
    """The first node at which a density that falls linearly (or touches zero) is impossible."""
    with pytest.raises(co.SolveError) as caught:
        co.solve(moving(measurement, process), progress=False)
    assert [word for word in words if word not in str(caught.value)] == []
    assert not caught.value.solution.converged


def test_density_that_varies_is_allowed():
    assert co.solve(moving(lambda ocp: 1 + ocp.time), progress=False).converged


@pytest.mark.parametrize("options", [{}, {"covariances": "states"}, {"method": "gradient"}])
def test_lower_bound_of_a_matrix_is_kept(options):
    """Without the bound u = 0 is optimal, and the entry falls to 0.24."""
    ocp = co.Problem(3.0)
    x = ocp.state("x", initial=0, final=0)
    P = ocp.symmetric("P", 1, initial=1.0, lower=0.5)
    u = ocp.control("u", lower=-2, upper=2)
    ocp.dynamics(x, u)
    ocp.dynamics(P, -P + 0.2 * (x + 1) ** 2)
    ocp.minimize(running=u**2)
    solution = co.solve(ocp, intervals=40, progress=False, **options)
    assert solution["P"].min() == pytest.approx(0.5, abs=1e-5)
    assert solution.cost > 1.0


def test_lower_bound_of_a_matrix_cannot_be_eliminated():
    ocp = co.Problem(1.0)
    P = ocp.symmetric("P", 1, initial=1.0, lower=0.5)
    x = ocp.state("x", initial=1)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.dynamics(P, -P)
    ocp.minimize(running=u**2)
    with pytest.raises(co.ProblemError, match="lower bound"):
        co.solve(ocp, covariances="eliminated", progress=False)


def test_mesh_error_of_both_methods_agrees():
    """A coupled problem and a free initial matrix: where the gradient method has no segments of its own."""
    ocp = co.Problem(3.0)
    x = ocp.state("x", 2, initial=[1, 0], final=0.0)
    P = ocp.symmetric("P", 2, initial=np.eye(2))
    u = ocp.control("u", 2)
    ocp.dynamics(x, -P @ x + u)
    ocp.dynamics(P, -P @ P + ca.diag(u * u) * 0.1)
    ocp.minimize(running=ca.dot(u, u) + ca.trace(P))
    errors = [
        co.solve(ocp, method, intervals=40, substeps=1, progress=False).mesh_error for method in ("ipopt", "gradient")
    ]
    assert errors[0] == pytest.approx(errors[1], rel=0.1)
    assert errors[0] < 1e-5


def test_duration_at_its_bound_is_transversal():
    """The integral of u^2 plus T is least at T = 1, outside the bounds: T = 1.5 is optimal."""
    ocp = co.Problem(co.Free(2, 1.5, 5))
    x = ocp.state("x", initial=0, final=1)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=ocp.duration)
    solution = co.solve(ocp, intervals=40, progress=False)
    assert solution.duration == pytest.approx(1.5, abs=1e-6)
    assert solution.optimality.transversality == 0.0


def test_comparison_at_other_parameters():
    ocp = co.Problem(1.0)
    weight = ocp.parameter("weight", 1.0)
    x = ocp.state("x", initial=0, final=1)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=weight * u**2)
    rows = co.compare(ocp, intervals=20, parameters={"weight": 3.0}, progress=False).solutions
    assert [solution.cost for solution in rows.values()] == pytest.approx([3.0, 3.0], rel=1e-6)
