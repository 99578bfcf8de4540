"""What `simulate` refuses, and how it says so."""

import numpy as np
import pytest
from loops import linear_quadratic, open_loop, steered

import covocp as co
from covocp.base.errors import CovocpWarning, ProblemError
from covocp.models import free_time_integrator, unknown_lag
from covocp.simulation.runs import simulate

OPTIONS = {"progress": False}


@pytest.fixture(scope="module")
def lag():
    return steered(0.1)


@pytest.fixture(scope="module")
def oscillator():
    return co.solve(linear_quadratic(), intervals=40, progress=False)


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        (linear_quadratic(size=3), "other states"),
        (open_loop(), "other measurements"),
        ({"nothing": 1.0}, "no parameter 'nothing'"),
        ({"w": [1.0, 2.0]}, "wrong size"),
        (3.0, "unknown kind"),
    ],
)
def test_a_truth_that_does_not_fit(oscillator, truth, words):
    with pytest.raises(ProblemError, match=words) as caught:
        simulate(oscillator, 64, 1, truth=truth, **OPTIONS)
    for part in ("expected:", "received:", "remedy:"):
        assert part in str(caught.value)


def test_a_truth_with_other_names(lag):
    problem = co.Problem(duration=10.0)
    x = problem.state("x", initial=0.0, variance=1.0)
    u = problem.control("u")
    problem.dynamics(x, -x + u, noise=1.0)
    problem.measurement("position", x, noise=1.0)
    with pytest.raises(ProblemError, match="other unknowns"):
        simulate(lag, 64, 1, truth=problem, **OPTIONS)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"runs": 0}, "runs"),
        ({"runs": 1}, "runs"),
        ({"runs": 10.0}, "runs"),
        ({"runs": True}, "runs"),
        ({"seed": -1}, "seed"),
        ({"seed": None}, "seed"),
        ({"step": 0.0}, "step"),
        ({"step": -1.0}, "step"),
        ({"step": "small"}, "step"),
        ({"step": np.nan}, "step"),
        ({"store": 1}, "store"),
        ({"paths": -1}, "paths"),
        ({"batch": 0}, "batch"),
        ({"level": 1.0}, "level"),
        ({"filter": "kalman"}, "filter"),
        ({"limits": 3.0}, "limits"),
        ({"limits": {"u": 1.0}}, "limits"),
        ({"limits": {"v": (0.0, 1.0)}}, "'v'"),
        ({"limits": {"u": (1.0, 0.0)}}, "cross"),
    ],
)
def test_bad_arguments_are_named(oscillator, arguments, word):
    given = {"runs": 64, "seed": 1, **OPTIONS, **arguments}
    with pytest.raises(ProblemError, match=word) as caught:
        simulate(oscillator, given.pop("runs"), given.pop("seed"), **given)
    assert "expected:" in str(caught.value)


def test_what_cannot_be_simulated(lag, tmp_path):
    with pytest.raises(ProblemError, match="a Solution"):
        simulate(unknown_lag.steering(), 64, 1, **OPTIONS)
    with pytest.raises(ProblemError, match="knows no problem"):
        simulate(co.load(lag.save(tmp_path / "lag.npz")), 64, 1, **OPTIONS)
    with pytest.raises(ProblemError, match="no part of this problem"):
        simulate(co.solve(free_time_integrator.problem(), intervals=20, progress=False), 64, 1, **OPTIONS)
    under = co.evaluate(lag, truth=unknown_lag.steering(process_noise=2.0, parameter_variance=0.1))
    with pytest.raises(ProblemError, match="truth="):
        simulate(under, 64, 1, **OPTIONS)


def test_dynamics_with_a_matrix_are_not_those_of_an_actual_system():
    problem = co.Problem(duration=1.0)
    x = problem.state("x", initial=0.0, variance=1.0)
    u = problem.control("u")
    P = problem.symmetric("P", 1, initial=1.0)
    problem.dynamics(x, -x + u * P, noise=1.0)
    problem.dynamics(P, -P)
    problem.measurement("m", x, noise=1.0)
    problem.estimation_covariance()
    problem.minimize(running=u**2, terminal=P)
    solution = co.solve(problem, intervals=10, progress=False)
    with pytest.raises(ProblemError, match="depend on a matrix"):
        simulate(solution, 64, 1, **OPTIONS)


def test_a_solution_that_did_not_converge_is_a_warning():
    solution = steered(0.1, max_iterations=1, allow_failure=True)
    assert not solution.converged
    with pytest.warns(CovocpWarning, match="did not converge"):
        simulate(solution, 64, 1, step=0.1, **OPTIONS)
