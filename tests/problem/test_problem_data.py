"""Wrong numbers in a statement: shapes, definiteness, bounds, NaN and inf, durations."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import solve
from refusals import empty, lag, refused, simple, wrong

import covocp as co

# --- shapes -----------------------------------------------------------------------------------------------------------


@wrong("rate of 'y'", "shape (2, 1)", "shape (3, 1)")
def test_shape_of_a_rate():
    ocp = empty()
    ocp.dynamics(ocp.state("y", 2, initial=0.0), ca.vertcat(1, 2, 3))


@wrong("rate of 'S'", "shape (2, 2)", "shape (2, 1)")
def test_shape_of_a_matrix_rate():
    ocp = empty()
    ocp.dynamics(ocp.symmetric("S", 2, initial=np.eye(2)), ca.vertcat(1, 2))


@wrong("initial value of 'y'", "3 numbers", "shape (2,)")
def test_shape_of_an_initial_value():
    empty().state("y", 3, initial=[1, 2])


@wrong("final value of 'y'", "3 numbers", "shape (2,)")
def test_shape_of_a_final_value():
    empty().state("y", 3, initial=0, final=[1, 2])


@wrong("lower bound of 'u'", "2 numbers", "shape (3,)")
def test_shape_of_a_bound():
    empty().control("u", 2, lower=[1, 2, 3])


@wrong("variance of 'y'", "3 x 3 matrix", "shape (2, 2)")
def test_shape_of_a_variance():
    empty().state("y", 3, initial=0, variance=np.eye(2))


@wrong("noise density of 'x'", "a number", "shape (2,)")
def test_shape_of_a_noise_density():
    lag(noise=[1.0, 2.0])


@wrong("initial value of 'E'", "2 x 2", "shape (3, 3)")
def test_shape_of_an_initial_covariance():
    ocp = empty()
    ocp.state("x", initial=0)
    ocp.unknown("b", mean=1, variance=1)
    ocp.estimation_covariance(initial=np.eye(3))


@wrong("shape of 'x'", "positive whole number", "2.5")
def test_shape_that_is_none():
    empty().state("x", 2.5, initial=0)


@wrong("running cost", "shape (1, 1)", "shape (2, 1)")
def test_shape_of_the_cost():
    ocp = empty()
    ocp.minimize(ocp.state("x", 2, initial=0))


@wrong("guess of 'u'", "1 column", "shape (3, 2)")
def test_shape_of_a_guess():
    solve(simple(control={"guess": np.zeros((3, 2))})[0])


@wrong("guess of 'u'", "one value at each s", "shape (3, 2)")
def test_shape_of_a_guessing_function():
    solve(simple(control={"guess": lambda s: np.zeros((3, 2))})[0])


@wrong("guess of 'x'", "shape (2, 3)")
def test_shape_of_a_guess_of_a_state():
    solve(simple(guess=np.ones((2, 3)))[0])


# --- definiteness -----------------------------------------------------------------------------------------------------


@wrong("variance of 'y'", "not positive semidefinite", "smallest eigenvalue -1")
def test_indefinite_variance():
    empty().state("y", 2, initial=0, variance=[[1, 2], [2, 1]])


@wrong("variance of 'y'", "negative", "nonnegative number", "-1")
def test_negative_variance():
    empty().state("y", initial=0, variance=-1)


@wrong("variance of 'b'", "negative", "-5")
def test_negative_variance_of_an_unknown():
    empty().unknown("b", mean=1, variance=-5)


@wrong("variance of 'y'", "not symmetric")
def test_unsymmetric_variance():
    empty().state("y", 2, initial=0, variance=[[1, 0.2], [0.1, 1]])


@wrong("initial value of 'E'", "not positive semidefinite")
def test_indefinite_initial_covariance():
    ocp = empty()
    ocp.state("x", initial=0)
    ocp.unknown("b", mean=1, variance=1)
    ocp.estimation_covariance(initial=[[1, 2], [2, 1]])


@wrong("initial value of 'S'", "not positive semidefinite")
def test_indefinite_initial_matrix():
    empty().symmetric("S", 2, initial=[[1, 2], [2, 1]], lower=0)


@wrong("initial value of 'S'", "not symmetric")
def test_unsymmetric_initial_matrix():
    empty().symmetric("S", 2, initial=[[1, 0.5], [0.2, 1]])


@wrong("noise density of 'x'", "negative")
def test_negative_noise():
    lag(noise=-1.0)


@wrong("noise density of 'x'", "not positive semidefinite")
def test_indefinite_noise():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.dynamics(x, x, noise=[[1, 2], [2, 1]])


@wrong("noise density of 'position'", "zero", "every measurement needs some noise")
def test_measurement_without_noise():
    lag(measurement_noise=0.0)


@wrong("noise density of 'm'", "singular", "every measurement needs some noise")
def test_singular_measurement_noise():
    ocp = empty()
    ocp.measurement("m", ocp.state("x", 2, initial=0), noise=np.ones((2, 2)))


@wrong("noise density of 'm'", "not symmetric", "entries [0, 1] and [1, 0]")
def test_unsymmetric_noise_density():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.measurement("m", x, noise=ca.blockcat([[1, 0.2 * ocp.time], [0, 1]]))


@wrong("rate of 'P'", "not symmetric", "A @ P + P @ A.T")
def test_unsymmetric_rate_of_a_matrix():
    ocp = empty()
    P = ocp.symmetric("P", 2, initial=np.eye(2))
    ocp.dynamics(P, 2 * np.array([[0.0, 1.0], [2.0, 0.0]]) @ P)


@wrong("noise density of 'x'", "negative", "-1")
def test_noise_that_depends_on_the_state():
    ocp = empty()
    x, u = ocp.state("x", initial=-1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u, noise=x)
    ocp.measurement("m", x, noise=1)
    E = ocp.estimation_covariance()
    ocp.minimize(u**2, E[x, x])
    solve(ocp)


@wrong("noise density of 'range'", "negative", "-1")
def test_measurement_noise_that_depends_on_the_state():
    ocp = empty()
    x, u = ocp.state("x", initial=-1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("range", x, noise=x)
    E = ocp.estimation_covariance()
    ocp.minimize(u**2, E[x, x])
    solve(ocp)


# --- bounds and scales ------------------------------------------------------------------------------------------------


@wrong("component 1 of 'y'", "lower = 1, upper = 0")
def test_bounds_crossed():
    empty().state("y", 2, initial=0, lower=[0, 1], upper=[1, 0])


@wrong("bounds of 'u' cross")
def test_control_bounds_crossed():
    empty().control("u", lower=1, upper=0)


@wrong("initial value of 'y'", "outside its bounds", "[-inf, 1]", "2")
def test_initial_value_outside():
    empty().state("y", initial=2, upper=1)


@wrong("final value of component 2 of 'y'", "outside its bounds")
def test_final_value_outside():
    empty().state("y", 3, initial=0, final=[0, 0, -1], lower=0)


@wrong("initial value of 'P'", "[3, inf]")
def test_matrix_below_its_bound():
    empty().symmetric("P", 1, initial=1.0, lower=3.0)


@wrong("bounds of 'limit' cross", "lower = 1, upper = 0")
def test_constraint_bounds_crossed():
    ocp, x, *_ = lag()
    ocp.subject_to(x, lower=1.0, upper=0.0, name="limit")


def test_a_bound_that_is_given_alone_is_the_only_one():
    ocp, x, *_ = lag()
    cases = ((None, None, (-np.inf, 0.0)), (1.0, None, (1.0, np.inf)), (None, 2.0, (-np.inf, 2.0)))
    for lower, upper, expected in cases:
        ocp.subject_to(x, lower=lower, upper=upper)
        limit = ocp.declarations.constraints[-1]
        assert (limit.lower.item(), limit.upper.item()) == expected


@wrong("'limit' has no bound")
def test_constraint_without_bounds():
    ocp, x, *_ = lag()
    ocp.subject_to(x, upper=np.inf, name="limit")


@wrong("scale of 'x'", "positive")
def test_negative_scale():
    empty().state("x", initial=0, scale=-1)


@wrong("bounds of 'u' leave no number", "lower = inf")
def test_lower_bound_of_infinity():
    empty().control("u", lower=np.inf)


@wrong("bounds of component 1 of 'y' leave no number", "upper = -inf")
def test_upper_bound_of_minus_infinity():
    empty().state("y", 2, initial=0, upper=[1, -np.inf])


# --- no numbers -------------------------------------------------------------------------------------------------------


@wrong("value of 'k'", "not a number", "None")
def test_parameter_that_is_missing():
    empty().parameter("k", None)


@wrong("variance of 'y'", "not a number", "True")
def test_truth_for_a_number():
    empty().state("y", 2, initial=0, variance=True)


@wrong("rate of 'x'", "not an expression", "None")
def test_rate_that_is_missing():
    ocp = empty()
    ocp.dynamics(ocp.state("x", initial=0), None)


def test_none_among_final_values_is_free():
    ocp = empty()
    x, u = ocp.state("x", 2, initial=0, final=[None, 1]), ocp.control("u", 2)
    ocp.dynamics(x, u)
    ocp.minimize(ca.sumsqr(u))
    assert np.abs(solve(ocp)["x"][-1] - [0, 1]).max() < 1e-12


# --- NaN and inf ------------------------------------------------------------------------------------------------------


@wrong("initial value of 'y'", "NaN or inf")
def test_infinite_initial_value():
    empty().state("y", initial=np.inf)


@wrong("lower bound of 'y'", "NaN or inf")
def test_bound_that_is_nan():
    empty().state("y", initial=0, lower=np.nan)


@wrong("mean of 'b'", "NaN or inf")
def test_mean_that_is_nan():
    empty().unknown("b", mean=np.nan, variance=1)


@wrong("value of 'k'", "NaN or inf")
def test_parameter_that_is_nan():
    empty().parameter("k", np.nan)


@wrong("variance of 'y'", "NaN or inf")
def test_variance_that_is_nan():
    empty().state("y", initial=0, variance=np.nan)


@wrong("rate of 'x' is NaN or inf")
def test_rate_that_is_nan():
    empty_problem = empty()
    empty_problem.dynamics(empty_problem.state("x", initial=0), np.nan)


@wrong("guess of 'u'", "NaN or inf")
def test_guess_that_is_nan():
    solve(simple(control={"guess": np.nan})[0])


@wrong("rate of 'x'", "nan at the initial guess", "state [-1.]")
def test_model_that_is_nan():
    solve(simple(rate=lambda x, u: ca.sqrt(x) + u, initial=-1.0)[0])


@wrong("rate of 'x'", "inf at the initial guess")
def test_model_that_is_inf():
    solve(simple(rate=lambda x, u: 1 / x + u)[0])


@wrong("rate of 'E[x, x]'", "inf at the initial guess")
def test_covariance_rate_that_is_inf():
    ocp = empty()
    x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u, noise=1 / x)
    E = ocp.estimation_covariance()
    ocp.minimize(u**2, E[x, x])
    solve(ocp)


@pytest.mark.parametrize("method", ["ipopt", "gradient"])
def test_cost_that_is_no_number_at_the_end_of_the_guess(method):
    problem = simple(terminal=lambda x: ca.sqrt(-1 - x**2))[0]
    refused(lambda: solve(problem, method=method), "cost 'terminal'", "nan at the end of the initial guess")
    refused(lambda: co.evaluate(problem, nominal={"u": 1.0}), "cost 'terminal'", "nan at the end")


@wrong("constraint 'above'", "inf at the initial guess")
def test_constraint_that_is_inf():
    ocp, x, _ = simple()
    ocp.subject_to(ca.log(x), name="above")
    solve(ocp)


# --- duration ---------------------------------------------------------------------------------------------------------


@wrong("'duration'", "> 0 s", "Free(guess)")
def test_duration_of_zero():
    co.Problem(0.0)


@wrong("'duration'", "-1")
def test_negative_duration():
    co.Problem(-1)


@wrong("'duration'", "nan")
def test_duration_that_is_nan():
    co.Problem(np.nan)


@wrong("'duration'", "not a number", "'ten'")
def test_duration_in_words():
    co.Problem("ten")


@wrong("'duration'", "not a number", "'10'")
def test_duration_as_text():
    co.Problem("10")


@wrong("'duration'", "> 0 s", "None", "Free(guess)")
def test_duration_that_is_missing():
    co.Problem(None)


@wrong("not ordered", "lower <= guess <= upper", "lower = 2, guess = 1, upper = 3")
def test_free_duration_unordered():
    co.Free(1.0, 2.0, 3.0)


@wrong("not ordered", "lower = 1, guess = 5, upper = 3")
def test_free_duration_above_its_bound():
    co.Free(5.0, 1.0, 3.0)


@wrong("not ordered", "nan")
def test_free_duration_bound_that_is_nan():
    co.Free(5.0, upper=np.nan)


@wrong("'duration'", "-5")
def test_free_duration_negative():
    co.Free(-5.0)
