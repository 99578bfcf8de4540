"""What a wrong statement is answered: before any solver starts, by the name of the symbol, with what to do."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co

WRONG = {}


def wrong(*words):
    """Register a wrong statement and the words that its error must contain."""

    def register(function):
        WRONG[function.__name__] = (function, words)
        return function

    return register


def solve(ocp, **options):
    return co.solve(ocp, **{"progress": False, "intervals": 20, **options})


def empty():
    return co.Problem(duration=1.0)


def simple(rate=None, running=None, terminal=0.0, control=None, **state):
    """An integrator x' = u, with one thing replaced."""
    ocp = empty()
    x, u = ocp.state("x", **{"initial": 0.0, **state}), ocp.control("u", **(control or {}))
    ocp.dynamics(x, u if rate is None else rate(x, u))
    ocp.minimize(running=u**2 if running is None else running(x, u), terminal=terminal(x) if terminal else 0.0)
    return ocp, x, u


def lag(noise=1.0, measurement_noise=1.0):
    ocp = co.Problem(duration=10.0)
    x = ocp.state("x", initial=0.0, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=noise)
    ocp.measurement("position", x, noise=measurement_noise)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=E[b, b])
    return ocp, x, b, u, E


def uncertain():
    """An integrator whose initial variance is the parameter v, measurement noise the parameter r."""
    ocp = empty()
    v, r = ocp.parameter("v", 1.0), ocp.parameter("r", 1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=v), ocp.control("u")
    ocp.dynamics(x, u, noise=1.0)
    ocp.measurement("range", x, noise=r)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x, x])
    return ocp


# --- shapes -----------------------------------------------------------------------------------------------------------


@wrong("rate of 'y'", "shape (2, 1)", "shape (3, 1)")
def shape_of_a_rate():
    ocp = empty()
    ocp.dynamics(ocp.state("y", 2, initial=0.0), ca.vertcat(1, 2, 3))


@wrong("rate of 'S'", "shape (2, 2)", "shape (2, 1)")
def shape_of_a_matrix_rate():
    ocp = empty()
    ocp.dynamics(ocp.symmetric("S", 2, initial=np.eye(2)), ca.vertcat(1, 2))


@wrong("initial value of 'y'", "3 numbers", "shape (2,)")
def shape_of_an_initial_value():
    empty().state("y", 3, initial=[1, 2])


@wrong("final value of 'y'", "3 numbers", "shape (2,)")
def shape_of_a_final_value():
    empty().state("y", 3, initial=0, final=[1, 2])


@wrong("lower bound of 'u'", "2 numbers", "shape (3,)")
def shape_of_a_bound():
    empty().control("u", 2, lower=[1, 2, 3])


@wrong("variance of 'y'", "3 x 3 matrix", "shape (2, 2)")
def shape_of_a_variance():
    empty().state("y", 3, initial=0, variance=np.eye(2))


@wrong("noise density of 'x'", "a number", "shape (2,)")
def shape_of_a_noise_density():
    lag(noise=[1.0, 2.0])


@wrong("initial value of 'E'", "2 x 2", "shape (3, 3)")
def shape_of_an_initial_covariance():
    ocp = empty()
    ocp.state("x", initial=0)
    ocp.unknown("b", mean=1, variance=1)
    ocp.estimation_covariance(initial=np.eye(3))


@wrong("shape of 'x'", "positive whole number", "2.5")
def shape_that_is_none():
    empty().state("x", 2.5, initial=0)


@wrong("running cost", "shape (1, 1)", "shape (2, 1)")
def shape_of_the_cost():
    ocp = empty()
    ocp.minimize(ocp.state("x", 2, initial=0))


@wrong("guess of 'u'", "1 column", "shape (3, 2)")
def shape_of_a_guess():
    solve(simple(control={"guess": np.zeros((3, 2))})[0])


@wrong("guess of 'u'", "function of s", "shape (3, 2)")
def shape_of_a_guessing_function():
    solve(simple(control={"guess": lambda s: np.zeros((3, 2))})[0])


@wrong("guess of 'x'", "shape (2, 3)")
def shape_of_a_guess_of_a_state():
    solve(simple(guess=np.ones((2, 3)))[0])


@wrong("guess of 'u'", "shape (7, 3)")
def shape_of_a_guess_given_to_solve():
    solve(lag()[0], guess={"u": np.zeros((7, 3))})


@wrong("value of 'v'", "a number", "shape (2,)")
def shape_of_a_parameter():
    co.Solver(uncertain(), intervals=10).solve({"v": [1.0, 2.0]}, progress=False)


# --- definiteness -----------------------------------------------------------------------------------------------------


@wrong("variance of 'y'", "not positive semidefinite", "smallest eigenvalue -1")
def indefinite_variance():
    empty().state("y", 2, initial=0, variance=[[1, 2], [2, 1]])


@wrong("variance of 'y'", "negative", "nonnegative number", "-1")
def negative_variance():
    empty().state("y", initial=0, variance=-1)


@wrong("variance of 'b'", "negative", "-5")
def negative_variance_of_an_unknown():
    empty().unknown("b", mean=1, variance=-5)


@wrong("variance of 'y'", "not symmetric")
def unsymmetric_variance():
    empty().state("y", 2, initial=0, variance=[[1, 0.2], [0.1, 1]])


@wrong("initial value of 'E'", "not positive semidefinite")
def indefinite_initial_covariance():
    ocp = empty()
    ocp.state("x", initial=0)
    ocp.unknown("b", mean=1, variance=1)
    ocp.estimation_covariance(initial=[[1, 2], [2, 1]])


@wrong("initial value of 'S'", "not positive semidefinite")
def indefinite_initial_matrix():
    empty().symmetric("S", 2, initial=[[1, 2], [2, 1]], lower=0)


@wrong("initial value of 'S'", "not symmetric")
def unsymmetric_initial_matrix():
    empty().symmetric("S", 2, initial=[[1, 0.5], [0.2, 1]])


@wrong("noise density of 'x'", "negative")
def negative_noise():
    lag(noise=-1.0)


@wrong("noise density of 'x'", "not positive semidefinite")
def indefinite_noise():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.dynamics(x, x, noise=[[1, 2], [2, 1]])


@wrong("noise density of 'position'", "zero", "every measurement needs some noise")
def measurement_without_noise():
    lag(measurement_noise=0.0)


@wrong("noise density of 'm'", "singular", "every measurement needs some noise")
def singular_measurement_noise():
    ocp = empty()
    ocp.measurement("m", ocp.state("x", 2, initial=0), noise=np.ones((2, 2)))


@wrong("noise density of 'range'", "zero")
def measurement_noise_by_a_parameter():
    co.Solver(uncertain(), intervals=10).solve({"r": 0.0}, progress=False)


@wrong("initial value of 'E'", "negative", "-1")
def variance_by_a_parameter():
    co.Solver(uncertain(), intervals=10).solve({"v": -1.0}, progress=False)


@wrong("noise density of 'x'", "negative", "-1")
def noise_that_depends_on_the_state():
    ocp = empty()
    x, u = ocp.state("x", initial=-1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u, noise=x)
    ocp.measurement("m", x, noise=1)
    E = ocp.estimation_covariance()
    ocp.minimize(u**2, E[x, x])
    solve(ocp)


@wrong("noise density of 'range'", "negative", "-1")
def measurement_noise_that_depends_on_the_state():
    ocp = empty()
    x, u = ocp.state("x", initial=-1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("range", x, noise=x)
    E = ocp.estimation_covariance()
    ocp.minimize(u**2, E[x, x])
    solve(ocp)


# --- what is missing, or too much -------------------------------------------------------------------------------------


@wrong("'x' has no dynamics", "test_problem.py:", "dynamics(x, rate)")
def missing_dynamics():
    ocp = empty()
    ocp.state("x", initial=0)
    ocp.minimize(running=ocp.control("u") ** 2)
    solve(ocp)


@wrong("'S' has no dynamics", "test_problem.py:")
def missing_matrix_dynamics():
    ocp, _, _ = simple()
    ocp.symmetric("S", 2, initial=np.eye(2))
    solve(ocp)


@wrong("no cost", "minimize(")
def missing_cost():
    ocp = empty()
    ocp.dynamics(ocp.state("x", initial=0), ocp.control("u"))
    solve(ocp)


@wrong("no state")
def missing_state():
    ocp = empty()
    ocp.minimize(running=ocp.control("u") ** 2)
    solve(ocp)


@wrong("nothing to choose", "control")
def missing_control():
    ocp = empty()
    x = ocp.state("x", initial=0)
    ocp.dynamics(x, x)
    ocp.minimize(terminal=x)
    solve(ocp)


@wrong("nothing to estimate")
def covariance_of_nothing():
    empty().estimation_covariance()


@wrong("after estimation_covariance()", "move the call down")
def covariance_declared_too_early():
    ocp = empty()
    x, u = ocp.state("x", initial=0, variance=1.0), ocp.control("u")
    E = ocp.estimation_covariance()
    y = ocp.state("y", initial=0)
    ocp.dynamics(x, u)
    ocp.dynamics(y, u)
    ocp.minimize(u**2, E[x, x])
    solve(ocp)


@wrong("depends on nothing", "running = 0, terminal = 0")
def cost_of_nothing():
    solve(simple(running=lambda x, u: 0.0)[0])


@wrong("depends on nothing", "running = k")
def cost_of_a_parameter():
    ocp = empty()
    ocp.dynamics(ocp.state("x", initial=0), ocp.control("u"))
    ocp.minimize(ocp.parameter("k", 1.0))
    solve(ocp)


@wrong("'x' is used twice", "test_problem.py:")
def name_twice():
    ocp = empty()
    ocp.state("x", initial=0)
    ocp.control("x")


@wrong("'E' is used twice")
def covariance_twice():
    lag()[0].estimation_covariance()


@wrong("'position' is used twice")
def measurement_twice():
    ocp, x, *_ = lag()
    ocp.measurement("position", x, noise=1.0)


@wrong("rate of 'x' is given twice", "test_problem.py:")
def dynamics_twice():
    ocp, x, _ = simple()
    ocp.dynamics(x, 1)


@wrong("cost is given twice")
def minimize_twice():
    ocp, _, u = simple()
    ocp.minimize(u**2)


@wrong("'time' is taken", "Problem.time")
def reserved_name():
    empty().state("time", initial=0)


@wrong("needs a name", "3")
def name_that_is_no_text():
    empty().state(3, initial=0)


# --- symbols ----------------------------------------------------------------------------------------------------------


@wrong("'c'", "x, b")
def unknown_name_in_the_covariance():
    lag()[4]["b", "c"]


@wrong("'u'", "x, b")
def control_in_the_covariance():
    _, _, b, u, E = lag()
    E[u, b]


@wrong("two symbols", "E[b]", "E[a, a]")
def one_index():
    _, _, b, _, E = lag()
    E[b]


@wrong("'x'", "x, b")
def symbol_of_another_problem_in_the_covariance():
    lag()[4][lag()[1], "b"]


@wrong("'u'", "rate of 'x'", "another problem", "declared in this problem")
def symbol_of_another_problem_in_a_rate():
    solve(simple(rate=lambda x, u: simple()[2])[0])


@wrong("'q'", "rate of 'x'", "declare 'q'")
def unknown_symbol_in_a_rate():
    solve(simple(rate=lambda x, u: u + ca.MX.sym("q"))[0])


@wrong("'u'", "the cost", "another problem")
def symbol_of_another_problem_in_the_cost():
    solve(simple(running=lambda x, u: simple()[2] ** 2)[0])


@wrong("'q'", "'limit'")
def unknown_symbol_in_a_constraint():
    ocp, x, _ = simple()
    ocp.subject_to(x - ca.MX.sym("q"), name="limit")
    solve(ocp)


@wrong("dynamics()", "one of x")
def dynamics_of_another_problem():
    simple()[0].dynamics(simple()[1], 1)


@wrong("dynamics()", "'b'", "constant")
def dynamics_of_an_unknown():
    ocp, _, b, _, _ = lag()
    ocp.dynamics(b, 1)


@wrong("dynamics()", "'E'", "has its rate already")
def dynamics_of_the_covariance():
    ocp, _, _, _, E = lag()
    ocp.dynamics(E.matrix, E.matrix)


@wrong("initial or final value", "'x'", "at='initial'")
def initial_value_by_a_variable():
    ocp, x, u = simple()
    y = ocp.state("y", initial=x)
    ocp.dynamics(y, u)
    solve(ocp)


@wrong("lower bound of 'x'", "k", "subject_to()")
def bound_by_a_symbol():
    ocp = empty()
    ocp.state("x", initial=0, lower=ocp.parameter("k", 1.0))


@wrong("rate of 'x'", "not an expression", "casadi.vertcat")
def list_as_a_rate():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.dynamics(x, [x[1], x[0]])


@wrong("rate of 'x'", "not an expression", "SX")
def symbol_of_another_kind():
    ocp = empty()
    ocp.dynamics(ocp.state("x", initial=0), ca.SX.sym("q"))


# --- bounds and constraints -------------------------------------------------------------------------------------------


@wrong("component 1 of 'y'", "lower = 1, upper = 0")
def bounds_crossed():
    empty().state("y", 2, initial=0, lower=[0, 1], upper=[1, 0])


@wrong("bounds of 'u' cross")
def control_bounds_crossed():
    empty().control("u", lower=1, upper=0)


@wrong("initial value of 'y'", "outside its bounds", "[-inf, 1]", "2")
def initial_value_outside():
    empty().state("y", initial=2, upper=1)


@wrong("final value of component 2 of 'y'", "outside its bounds")
def final_value_outside():
    empty().state("y", 3, initial=0, final=[0, 0, -1], lower=0)


@wrong("'three' contains no variable")
def constraint_on_a_number():
    lag()[0].subject_to(3.0, name="three")


@wrong("'three' contains no variable")
def constraint_on_a_parameter():
    ocp = lag()[0]
    ocp.subject_to(ocp.parameter("k", 1.0) - 2, name="three")


@wrong("'limit' has an unknown place", "'final'", "'end'")
def constraint_at_an_unknown_place():
    ocp, x, *_ = lag()
    ocp.subject_to(x, at="end", name="limit")


@wrong("bounds of 'limit' cross", "lower = 1, upper = 0")
def constraint_bounds_crossed():
    ocp, x, *_ = lag()
    ocp.subject_to(x, lower=1.0, name="limit")


# --- NaN and inf ------------------------------------------------------------------------------------------------------


@wrong("initial value of 'y'", "NaN or inf")
def infinite_initial_value():
    empty().state("y", initial=np.inf)


@wrong("lower bound of 'y'", "NaN or inf")
def bound_that_is_nan():
    empty().state("y", initial=0, lower=np.nan)


@wrong("mean of 'b'", "NaN or inf")
def mean_that_is_nan():
    empty().unknown("b", mean=np.nan, variance=1)


@wrong("value of 'k'", "NaN or inf")
def parameter_that_is_nan():
    empty().parameter("k", np.nan)


@wrong("variance of 'y'", "NaN or inf")
def variance_that_is_nan():
    empty().state("y", initial=0, variance=np.nan)


@wrong("rate of 'x' is NaN or inf")
def rate_that_is_nan():
    empty_problem = empty()
    empty_problem.dynamics(empty_problem.state("x", initial=0), np.nan)


@wrong("guess of 'u'", "NaN or inf")
def guess_that_is_nan():
    solve(simple(control={"guess": np.nan})[0])


@wrong("value of 'v'", "NaN or inf")
def new_parameter_that_is_inf():
    co.Solver(uncertain(), intervals=10).solve({"v": np.inf}, progress=False)


@wrong("rate of 'x'", "nan at the initial guess", "state [-1.]")
def model_that_is_nan():
    solve(simple(rate=lambda x, u: ca.sqrt(x) + u, initial=-1.0)[0])


@wrong("rate of 'x'", "inf at the initial guess")
def model_that_is_inf():
    solve(simple(rate=lambda x, u: 1 / x + u)[0])


@wrong("rate of 'E[x, x]'", "inf at the initial guess")
def covariance_rate_that_is_inf():
    ocp = empty()
    x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u, noise=1 / x)
    E = ocp.estimation_covariance()
    ocp.minimize(u**2, E[x, x])
    solve(ocp)


@wrong("cost 'terminal'", "inf at the initial guess")
def cost_that_is_inf():
    solve(simple(terminal=lambda x: 1 / x)[0])


@wrong("constraint 'above'", "inf at the initial guess")
def constraint_that_is_inf():
    ocp, x, _ = simple()
    ocp.subject_to(ca.log(x), name="above")
    solve(ocp)


# --- duration ---------------------------------------------------------------------------------------------------------


@wrong("'duration'", "> 0 s", "Free(guess)")
def duration_of_zero():
    co.Problem(0.0)


@wrong("'duration'", "-1")
def negative_duration():
    co.Problem(-1)


@wrong("'duration'", "nan")
def duration_that_is_nan():
    co.Problem(np.nan)


@wrong("'duration'", "not a number", "'ten'")
def duration_in_words():
    co.Problem("ten")


@wrong("not ordered", "lower <= guess <= upper", "lower = 2, guess = 1, upper = 3")
def free_duration_unordered():
    co.Free(1.0, 2.0, 3.0)


@wrong("not ordered", "lower = 1, guess = 5, upper = 3")
def free_duration_above_its_bound():
    co.Free(5.0, 1.0, 3.0)


@wrong("not ordered", "nan")
def free_duration_bound_that_is_nan():
    co.Free(5.0, upper=np.nan)


@wrong("'duration'", "-5")
def free_duration_negative():
    co.Free(-5.0)


# --- options ----------------------------------------------------------------------------------------------------------


@wrong("no option 'interval'", "intervals", "interval=3")
def unknown_option():
    solve(lag()[0], interval=3)


@wrong("no such method", "'ipopt'", "'ipop'")
def unknown_method():
    solve(lag()[0], method="ipop")


@wrong("'control'", "'linear', 'constant'", "'quadratic'")
def unknown_control():
    solve(lag()[0], control="quadratic")


@wrong("'covariances'", "'eliminated'", "'elim'")
def unknown_formulation():
    solve(lag()[0], covariances="elim")


@wrong("'covariance_step'", "'gauss'", "'euler'")
def unknown_step():
    solve(lag()[0], covariance_step="euler")


@wrong("'hessian'", "'exact'", "'bfgs'")
def unknown_hessian():
    solve(lag()[0], hessian="bfgs")


@wrong("plugin", "'ipopt'", "'nosuch'")
def unknown_plugin():
    solve(lag()[0], plugin="nosuch")


@wrong("'tolerance'", "-1")
def negative_tolerance():
    solve(lag()[0], tolerance=-1)


@wrong("'max_iterations'", "-1")
def negative_number_of_iterations():
    solve(lag()[0], max_iterations=-1)


@wrong("'intervals'", "positive whole number", "10.5")
def half_an_interval():
    solve(lag()[0], intervals=10.5)


@wrong("'segments'", "positive whole number", "0")
def no_segment():
    solve(lag()[0], segments=0)


@wrong("'substeps'", "positive whole number", "'fine'")
def substeps_in_words():
    solve(lag()[0], substeps="fine")


@wrong("grid", "increasing", "0.4")
def grid_that_falls():
    solve(lag()[0], grid=[0, 0.5, 0.4, 1])


@wrong("grid", "divide the times by the duration")
def grid_in_seconds():
    solve(lag()[0], grid=[0, 5, 10])


@wrong("grid", "nan")
def grid_that_is_nan():
    solve(lag()[0], grid=[0, np.nan, 1])


@wrong("'v'", "cannot be guessed", "x, u, E")
def guess_of_an_unknown_name():
    solve(lag()[0], guess={"v": 1.0})


@wrong("'random'", "'multistart'")
def guess_in_words():
    solve(lag()[0], guess="random")


@wrong("unknown kind", "3")
def guess_of_another_kind():
    solve(lag()[0], guess=3)


@wrong("parameter 'w'", "v, r")
def unknown_parameter():
    co.Solver(uncertain(), intervals=10).solve({"w": 1.0}, progress=False)


@wrong("scale of 'x'", "positive")
def negative_scale():
    empty().state("x", initial=0, scale=-1)


@wrong("cannot be eliminated", "rate of a state depends on a matrix", "covariances='states'")
def coupled_problem_eliminated():
    ocp = empty()
    x, u, S = ocp.state("x", initial=0), ocp.control("u"), ocp.symmetric("S", 1, initial=1.0)
    ocp.dynamics(x, u + S)
    ocp.dynamics(S, -S)
    ocp.minimize(u**2 + x**2)
    solve(ocp, covariances="eliminated")


@wrong("'gauss'", "rate of S", "rk4")
def gauss_for_a_rate_that_is_not_riccati():
    ocp = empty()
    x, u, S = ocp.state("x", initial=0), ocp.control("u"), ocp.symmetric("S", 1, initial=1.0)
    ocp.dynamics(x, u)
    ocp.dynamics(S, x - S**3)
    ocp.minimize(u**2, S)
    solve(ocp, covariance_step="gauss")


@wrong("'limit' is a comparison", "subject_to(x, upper=1)")
def constraint_as_a_comparison():
    """x <= 1 is a truth value: taken as an expression it would demand that x <= 1 is false."""
    ocp, x, _ = simple()
    ocp.subject_to(x <= 1, name="limit")


@wrong("'limit' contains no variable")
def constraint_on_an_unknown():
    """Unknowns are constant in the nominal: nothing can be chosen here."""
    ocp, _, b, _, _ = lag()
    ocp.subject_to(b - 2, name="limit")


@wrong("'limit' has no bound")
def constraint_without_bounds():
    ocp, x, *_ = lag()
    ocp.subject_to(x, upper=np.inf, name="limit")


@wrong("constraint 'limit'", "casadi.vertcat")
def constraint_on_a_list():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.subject_to([x[0], x[1]], name="limit")


@wrong("measurement 'm'", "casadi.vertcat")
def measurement_of_a_list():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.measurement("m", [x[0], x[1]], noise=1.0)


@wrong("measurement 'm'", "SX")
def measurement_of_a_symbol_of_another_kind():
    empty().measurement("m", ca.SX.sym("q"), noise=1.0)


@wrong("noise density of 'm'", "not symmetric", "entries [0, 1] and [1, 0]")
def unsymmetric_noise_density():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.measurement("m", x, noise=ca.blockcat([[1, 0.2 * ocp.time], [0, 1]]))


@wrong("rate of 'P'", "not symmetric", "A @ P + P @ A.T")
def unsymmetric_rate_of_a_matrix():
    ocp = empty()
    P = ocp.symmetric("P", 2, initial=np.eye(2))
    ocp.dynamics(P, 2 * np.array([[0.0, 1.0], [2.0, 0.0]]) @ P)


@wrong("terminal cost contains 'time'", "Problem.duration")
def time_in_the_terminal_cost():
    ocp = co.Problem(co.Free(2.0))
    x = ocp.state("x", initial=0, final=1)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=ocp.time)
    co.solve(ocp)


@wrong("terminal cost contains 'u'")
def control_in_the_terminal_cost():
    ocp, _, u = simple()
    ocp.cost = None
    ocp.minimize(terminal=u)
    co.solve(ocp)


@wrong("initial value of 'P'", "[3, inf]")
def matrix_below_its_bound():
    empty().symmetric("P", 1, initial=1.0, lower=3.0)


@wrong("guess of 'E'", "symmetric 2 x 2 matrix", "shape (3, 3)")
def shape_of_the_guess_of_a_matrix():
    co.solve(lag()[0], guess={"E": np.eye(3)})


@wrong("not a problem", "received: int")
def a_number_for_a_problem():
    co.solve(3)


@wrong("parameters are not given by name")
def parameters_in_a_list():
    co.solve(lag()[0], parameters=[1.0])


@wrong("The options of multistart", "guess='multistart'", "seed")
def seed_without_multistart():
    co.solve(lag()[0], seed=1)


@wrong("'starts' is not a whole number")
def starts_below_zero():
    co.solve(lag()[0], guess="multistart", starts=-1)


@wrong("'segments'", "belongs to shooting")
def segments_of_the_gradient_method():
    co.solve(lag()[0], "gradient", segments=3)


@pytest.fixture
def no_solver(monkeypatch):
    """A solver that is called is a failure of the test."""

    def refuse(self, *arguments):
        pytest.fail("a solver was started")

    monkeypatch.setattr("covocp.solvers.ipopt.ShootingSolver.solve", refuse)


@pytest.mark.usefixtures("no_solver")
@pytest.mark.parametrize("case", WRONG)
def test_wrong_statement(case):
    function, words = WRONG[case]
    with pytest.raises(co.ProblemError) as caught:
        function()
    message = str(caught.value)
    assert [part for part in words if part not in message] == [], message
    assert [part for part in ("\n  expected: ", "\n  received: ", "\n  remedy:   ") if part not in message] == []
    assert message[0].isupper() or message.startswith(("'", "dynamics()", "covariance_step="))  # a sentence, or a name


# --- what is allowed --------------------------------------------------------------------------------------------------


def test_zero_variance_and_zero_noise_are_allowed():
    ocp = empty()
    x = ocp.state("x", 2, initial=0, variance=[1.0, 0.0])
    ocp.dynamics(x, x + ocp.control("u"), noise=[0.0, 1.0])
    E = ocp.estimation_covariance()
    ocp.minimize(terminal=ca.trace(E.matrix))
    statement = ocp.statement()
    assert statement.boundary_values(statement.values)[2].tolist() == [1.0, 0.0, 0.0]
    np.testing.assert_array_equal(statement.riccati[0](0, 0, 0, 1, [])[1].full(), np.diag([0.0, 1.0]))


def test_errors_are_value_errors():
    """What catches ValueError catches a wrong statement."""
    assert issubclass(co.ProblemError, ValueError)
    assert issubclass(co.ProblemError, co.CovocpError)
    assert issubclass(co.SolveError, RuntimeError)


def test_symbols_have_their_shapes():
    ocp = empty()
    assert ocp.state("x", initial=0).shape == (1, 1)
    assert ocp.state("y", 3, initial=0).shape == (3, 1)
    assert ocp.unknown("b", mean=[1, 2], variance=1).shape == (2, 1)
    assert ocp.parameter("k", [1, 2, 3]).shape == (3, 1)
    assert ocp.control("u", 2).shape == (2, 1)
    assert ocp.symmetric("S", 3, initial=np.eye(3)).shape == (3, 3)
    E = ocp.estimation_covariance()
    assert E.matrix.shape == (6, 6)
    assert E["y", "b"].shape == (3, 2)
    assert E.labels == ("x", "y[0]", "y[1]", "y[2]", "b[0]", "b[1]")
    assert ocp.duration == 1.0
    assert co.Problem(co.Free(2.0)).duration.shape == (1, 1)


def test_covariance_of_an_expression_is_first_order():
    """E[x^2, b] = 2 x E[x, b]."""
    ocp, x, b, _, E = lag()
    values = {"x": 3.0, "b": 1.0}
    entry = ca.Function("f", [x, b, ocp.matrices[0].symbol], [E[x**2, b], E[x * b, x * b]])
    product, quadratic = entry(values["x"], values["b"], [2.0, 0.5, 4.0])
    assert float(product) == pytest.approx(2 * 3 * 0.5)
    gradient = np.array([1.0, 3.0])
    assert float(quadratic) == pytest.approx(gradient @ np.array([[2.0, 0.5], [0.5, 4.0]]) @ gradient)


def test_statement_is_built_once_until_something_is_added():
    ocp, x, _ = simple()
    first = ocp.statement()
    assert ocp.statement() is first
    ocp.subject_to(x, upper=1.0)
    assert ocp.statement() is not first
    assert first.path.size == 0
    assert ocp.statement().path.size == 1


def test_variances_become_the_initial_covariance():
    ocp = empty()
    k = ocp.parameter("k", 2.0)
    y = ocp.state("y", 2, initial=0, variance=[[1.0, 0.5], [0.5, 1.0]])
    ocp.unknown("b", mean=[1.0, 2.0], variance=k * ca.DM([3.0, 4.0]))
    ocp.dynamics(y, ca.vertcat(ocp.control("u"), 0))
    E = ocp.estimation_covariance()
    ocp.minimize(terminal=E[y, y][0, 0])
    half = ocp.statement().boundary_values(np.array([2.0, 1.0, 2.0]))[2]
    np.testing.assert_allclose(half, [1, 0.5, 0, 0, 1, 0, 0, 6, 0, 8])


def test_what_is_no_problem_or_solution_is_refused_by_name() -> None:
    for wrong in (lambda: co.solve(3), lambda: co.compare(3), lambda: co.evaluate(3), lambda: co.worth(3)):
        with pytest.raises(co.ProblemError, match=r"This is not a problem(.|\n)*received: int: 3"):
            wrong()
    with pytest.raises(co.ProblemError, match="This is not a solution"):
        co.certify(None)


def test_a_name_of_an_entry_is_taken() -> None:
    problem = co.Problem(duration=1.0)
    problem.state("x", 2, initial=0.0)
    with pytest.raises(co.ProblemError, match=r"'x\[1\]' is used twice"):
        problem.state("x[1]", initial=0.0)
