"""What `solve` is given beside the statement: options, grids, guesses and parameters that it refuses."""

from __future__ import annotations

import numpy as np
import phased
import pytest
from problems import solve
from refusals import empty, lag, refused, simple, uncertain, wrong

import covocp as co

# --- options ----------------------------------------------------------------------------------------------------------


@wrong("no option 'interval'", "intervals", "interval=3")
def test_unknown_option():
    solve(lag()[0], interval=3)


@wrong("no such method", "'ipopt'", "'ipop'")
def test_unknown_method():
    solve(lag()[0], method="ipop")


@wrong("'control'", "'linear', 'constant'", "'quadratic'")
def test_unknown_control():
    solve(lag()[0], control="quadratic")


@wrong("'covariances'", "'eliminated'", "'elim'")
def test_unknown_formulation():
    solve(lag()[0], covariances="elim")


@wrong("'covariance_step'", "'gauss'", "'euler'")
def test_unknown_step():
    solve(lag()[0], covariance_step="euler")


@wrong("'hessian'", "'exact'", "'bfgs'")
def test_unknown_hessian():
    solve(lag()[0], hessian="bfgs")


@wrong("plugin", "'ipopt'", "'nosuch'")
def test_unknown_plugin():
    solve(lag()[0], plugin="nosuch")


@wrong("'tolerance'", "-1")
def test_negative_tolerance():
    solve(lag()[0], tolerance=-1)


@wrong("'max_iterations'", "-1")
def test_negative_number_of_iterations():
    solve(lag()[0], max_iterations=-1)


@wrong("'intervals'", "positive whole number", "10.5")
def test_half_an_interval():
    solve(lag()[0], intervals=10.5)


@wrong("'segments'", "positive whole number", "0")
def test_no_segment():
    solve(lag()[0], segments=0)


@pytest.mark.parametrize("option", [{"segments": 3}, {"covariances": "states"}, {"points": 2}])
def test_what_the_gradient_method_does_not_take_is_to_be_left_out(option):
    """No value of it would be right, so none is asked for; it is not offered for a misspelt one either."""
    (name,) = option
    with pytest.raises(co.ProblemError, match=f"takes no '{name}'") as caught:
        co.solve(lag()[0], "gradient", **option)
    assert caught.value.remedy.startswith("leave it out")
    for problem in (lag()[0], phased.bounce()):
        with pytest.raises(co.ProblemError, match="has no option 'foo'") as caught:
            co.solve(problem, "gradient", foo=1)
        assert name not in caught.value.expected.removeprefix("one of ").split(", ")
        with pytest.raises(co.ProblemError, match="has no option 'foo'") as caught:
            co.solve(problem, "ipopt", foo=1)
        assert name in caught.value.expected.removeprefix("one of ").split(", ")


@wrong("'substeps'", "positive whole number", "'fine'")
def test_substeps_in_words():
    solve(lag()[0], substeps="fine")


@wrong("grid", "increasing", "0.4")
def test_grid_that_falls():
    solve(lag()[0], grid=[0, 0.5, 0.4, 1])


@wrong("grid", "divide the times by the duration")
def test_grid_in_seconds():
    solve(lag()[0], grid=[0, 5, 10])


@wrong("grid", "nan")
def test_grid_that_is_nan():
    solve(lag()[0], grid=[0, np.nan, 1])


@wrong("cannot be eliminated", "rate of a state depends on a matrix", "covariances='states'")
def test_coupled_problem_eliminated():
    ocp = empty()
    x, u, S = ocp.state("x", initial=0), ocp.control("u"), ocp.symmetric("S", 1, initial=1.0)
    ocp.dynamics(x, u + S)
    ocp.dynamics(S, -S)
    ocp.minimize(u**2 + x**2)
    solve(ocp, covariances="eliminated")


@wrong("'gauss'", "rate of S", "rk4")
def test_gauss_for_a_rate_that_is_not_riccati():
    ocp = empty()
    x, u, S = ocp.state("x", initial=0), ocp.control("u"), ocp.symmetric("S", 1, initial=1.0)
    ocp.dynamics(x, u)
    ocp.dynamics(S, x - S**3)
    ocp.minimize(u**2, S)
    solve(ocp, covariance_step="gauss")


@wrong("not a problem", "received: int")
def test_a_number_for_a_problem():
    co.solve(3)


# --- guesses ----------------------------------------------------------------------------------------------------------


@wrong("'v'", "cannot be guessed", "x, u, E")
def test_guess_of_an_unknown_name():
    solve(lag()[0], guess={"v": 1.0})


@wrong("'random'", "'multistart'")
def test_guess_in_words():
    solve(lag()[0], guess="random")


@wrong("unknown kind", "3")
def test_guess_of_another_kind():
    solve(lag()[0], guess=3)


def test_guess_that_is_the_solution_of_another_problem():
    other = empty()
    y, v = other.state("y", 2, initial=0, final=1), other.control("v", 2)
    other.dynamics(y, v)
    other.minimize(v.T @ v)
    found = solve(other, intervals=5)
    refused(lambda: solve(lag()[0], guess=found), "nothing in common", "state x (1)", "state y (2)")


@wrong("guess of 'u'", "shape (7, 3)")
def test_shape_of_a_guess_given_to_solve():
    solve(lag()[0], guess={"u": np.zeros((7, 3))})


@wrong("guess of 'E'", "symmetric 2 x 2 matrix", "shape (3, 3)")
def test_shape_of_the_guess_of_a_matrix():
    co.solve(lag()[0], guess={"E": np.eye(3)})


@wrong("The options of multistart", "guess='multistart'", "seed")
def test_seed_without_multistart():
    co.solve(lag()[0], seed=1)


@wrong("'starts' is not a whole number")
def test_starts_below_zero():
    co.solve(lag()[0], guess="multistart", starts=-1)


# --- parameters -------------------------------------------------------------------------------------------------------


@wrong("parameter 'w'", "v, r")
def test_unknown_parameter():
    co.Solver(uncertain(), intervals=10).solve({"w": 1.0}, progress=False)


@wrong("parameters are not given by name")
def test_parameters_in_a_list():
    co.solve(lag()[0], parameters=[1.0])


@wrong("value of 'v'", "a number", "shape (2,)")
def test_shape_of_a_parameter():
    co.Solver(uncertain(), intervals=10).solve({"v": [1.0, 2.0]}, progress=False)


@wrong("value of 'v'", "NaN or inf")
def test_new_parameter_that_is_inf():
    co.Solver(uncertain(), intervals=10).solve({"v": np.inf}, progress=False)


@wrong("noise density of 'range'", "zero")
def test_measurement_noise_by_a_parameter():
    co.Solver(uncertain(), intervals=10).solve({"r": 0.0}, progress=False)


@wrong("initial value of 'E'", "negative", "-1")
def test_variance_by_a_parameter():
    co.Solver(uncertain(), intervals=10).solve({"v": -1.0}, progress=False)


def test_parameters_by_name_and_by_symbol():
    ocp, x, u = simple()
    k = ocp.parameter("k", 1.0)
    ocp.subject_to(x - k, lower=0.0, at="final")
    solver = co.Solver(ocp, intervals=10)
    by_name, by_symbol = (solver.solve({key: 2.0}, progress=False) for key in ("k", k))
    assert by_name.cost == by_symbol.cost == pytest.approx(4.0, rel=1e-6)  # u = k


@wrong("no parameter 'x'", "one of v, r")
def test_a_state_for_a_parameter():
    ocp = uncertain()
    co.Solver(ocp, intervals=10).solve({ocp.declarations.states[0].symbol: 1.0}, progress=False)


def test_what_is_no_parameter_is_called_what_it_is():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    d, spent = ocp.decision("d", guess=1.0), ocp.integral(u**2, name="J")
    ocp.minimize(running=u**2, terminal=(d - 2) ** 2 + spent)
    for name, kind in (("d", "a decision"), ("J", "an integral"), ("x", "a state")):
        with pytest.raises(co.ProblemError, match=f"'{name}' is {kind}, no parameter"):
            co.solve(ocp, parameters={name: 2.0}, progress=False)


def moved() -> co.Problem:
    """An integrator that is moved with least energy."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    return ocp


def test_a_problem_without_unknowns_takes_no_means():
    with pytest.raises(co.ProblemError, match="means= was given something") as caught:
        co.Solver(moved(), intervals=10).solve(means={"b": 1.0})
    assert caught.value.expected == "one of none: the problem has nothing of that kind"


def test_the_least_time_may_be_a_running_cost_of_one():
    def problem(running: float) -> co.Problem:
        ocp = co.Problem(co.Free(3.0, 0.5, 20.0))
        x, u = ocp.state("x", initial=0.0, final=4.0), ocp.control("u", lower=-1, upper=1)
        ocp.dynamics(x, u)
        ocp.minimize(running=running)
        return ocp

    assert co.solve(problem(1.0), progress=False).duration == pytest.approx(4.0)
    with pytest.raises(co.ProblemError, match="depends on nothing that can be chosen"):
        co.solve(problem(0.0), progress=False)


def test_a_control_that_nothing_stops_is_named():
    ocp = co.Problem(10.0)
    v, u = ocp.state("v", initial=0.0), ocp.control("thrust")
    ocp.dynamics(v, u - 0.1 * v)
    ocp.minimize(running=-u)
    with pytest.raises(co.SolveError, match=r"the control 'thrust' went to \S+ and has no upper bound"):
        co.solve(ocp, progress=False)


def test_how_many_intervals_there_may_be_is_told():
    with pytest.raises(co.ProblemError, match="'intervals'") as caught:
        co.solve(moved(), intervals=10**6, progress=False)
    assert caught.value.expected.endswith("at most 1e+05")


@pytest.mark.parametrize(("name", "value"), [("starts", 3), ("seed", 2)])
def test_what_belongs_to_random_starts_is_not_taken_silently(name, value):
    with pytest.raises(co.ProblemError, match=f"The option '{name}' belongs to guess='multistart'"):
        co.Solver(moved(), intervals=10).solve(progress=False, **{name: value})


def test_units_of_nothing_are_refused():
    solution = co.solve(moved(), intervals=10, progress=False)
    with pytest.raises(co.ProblemError, match="units of 'zz'"):
        solution.plot(units={"zz": "m"})


def test_a_structure_says_yes_or_no():
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=1.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, -x + u, noise=0.1)
    ocp.measurement("y", x, noise=0.1)
    ocp.minimize_expected(running=x**2 + u**2, gain=co.Gain(structure=0.5))
    with pytest.raises(co.ProblemError, match="structure of the gain"):
        co.solve(ocp, progress=False)
