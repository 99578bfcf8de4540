"""Endings of the methods: a run that ends so says what to do."""

import pytest

import covocp as co
from covocp.models import unknown_lag
from covocp.solvers.gradient import statuses as of_gradient
from covocp.solvers.statuses import Status, status_of


def test_every_ending_is_found_by_the_name_that_ipopt_gives():
    assert all(status_of(status.name_of_ipopt) is status for status in Status)
    assert status_of("what another plugin says") is None


def test_too_few_iterations_say_what_to_do():
    with pytest.raises(co.SolveError, match=r"largest number of iterations: start closer, or allow more") as told:
        co.solve(unknown_lag.problem(final=1.0), intervals=20, max_iterations=2, progress=False)
    assert told.value.solution.stats["return_status"] == Status.ITERATIONS.name_of_ipopt


def test_conditions_that_contradict_are_called_so():
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, final=5.0), ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    with pytest.raises(co.SolveError, match="the constraints may contradict"):
        co.solve(ocp, intervals=10, progress=False)


@pytest.mark.parametrize(
    ("ending", "options"),
    [
        (of_gradient.Status.ITERATIONS, {"max_iterations": 2}),
        (of_gradient.Status.DIVERGING, {"weight": 1e-9}),
    ],
)
def test_endings_of_the_gradient_method_say_what_to_do(ending, options):
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u - x**3)
    ocp.minimize(running=x**2 + u**2 + u**4)
    with pytest.raises(co.SolveError, match=f"{ending.words}: {ending.advice}") as told:
        co.solve(ocp, "gradient", intervals=20, progress=False, **options)
    assert told.value.solution.stats["return_status"] == str(ending)
