"""The builder: what must be declared, of which symbols, and what a statement is made of."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import solve
from refusals import empty, lag, refused, simple, wrong

import covocp as co

# --- what is missing, or too much -------------------------------------------------------------------------------------


@wrong("'x' has no dynamics", "test_problem.py:", "dynamics(x, rate)")
def test_missing_dynamics():
    ocp = empty()
    ocp.state("x", initial=0)
    ocp.minimize(running=ocp.control("u") ** 2)
    solve(ocp)


@wrong("'S' has no dynamics", "test_problem.py:")
def test_missing_matrix_dynamics():
    ocp, _, _ = simple()
    ocp.symmetric("S", 2, initial=np.eye(2))
    solve(ocp)


@wrong("no cost", "minimize(")
def test_missing_cost():
    ocp = empty()
    ocp.dynamics(ocp.state("x", initial=0), ocp.control("u"))
    solve(ocp)


@wrong("no state")
def test_missing_state():
    ocp = empty()
    ocp.minimize(running=ocp.control("u") ** 2)
    solve(ocp)


@wrong("nothing to choose", "control")
def test_missing_control():
    ocp = empty()
    x = ocp.state("x", initial=0)
    ocp.dynamics(x, x)
    ocp.minimize(terminal=x)
    solve(ocp)


@wrong("nothing to estimate")
def test_covariance_of_nothing():
    empty().estimation_covariance()


@wrong("after estimation_covariance()", "move the call down")
def test_covariance_declared_too_early():
    ocp = empty()
    x, u = ocp.state("x", initial=0, variance=1.0), ocp.control("u")
    E = ocp.estimation_covariance()
    y = ocp.state("y", initial=0)
    ocp.dynamics(x, u)
    ocp.dynamics(y, u)
    ocp.minimize(u**2, E[x, x])
    solve(ocp)


@wrong("depends on nothing", "running = 0, terminal = 0")
def test_cost_of_nothing():
    solve(simple(running=lambda x, u: 0.0)[0])


@wrong("depends on nothing", "running = k")
def test_cost_of_a_parameter():
    ocp = empty()
    ocp.dynamics(ocp.state("x", initial=0), ocp.control("u"))
    ocp.minimize(ocp.parameter("k", 1.0))
    solve(ocp)


@wrong("'x' is used twice", "test_problem.py:")
def test_name_twice():
    ocp = empty()
    ocp.state("x", initial=0)
    ocp.control("x")


@wrong("'E' is used twice")
def test_covariance_twice():
    lag()[0].estimation_covariance()


@wrong("'position' is used twice")
def test_measurement_twice():
    ocp, x, *_ = lag()
    ocp.measurement("position", x, noise=1.0)


@wrong("rate of 'x' is given twice", "test_problem.py:")
def test_dynamics_twice():
    ocp = empty()
    x = ocp.state("x", initial=0)
    ocp.dynamics(x, 0)
    ocp.dynamics(x, 1)


@wrong("cost is given twice")
def test_minimize_twice():
    ocp, _, u = simple()
    ocp.minimize(u**2)


@wrong("'time' is taken", "Problem.time")
def test_reserved_name():
    empty().state("time", initial=0)


@wrong("needs a name", "3")
def test_name_that_is_no_text():
    empty().state(3, initial=0)


# --- symbols ----------------------------------------------------------------------------------------------------------


@wrong("'c'", "x, b")
def test_unknown_name_in_the_covariance():
    lag()[4]["b", "c"]


@wrong("'u'", "x, b")
def test_control_in_the_covariance():
    _, _, b, u, E = lag()
    E[u, b]


@wrong("two symbols", "E[b]", "E[a, a]")
def test_one_index():
    _, _, b, _, E = lag()
    E[b]


@wrong("'x'", "x, b")
def test_symbol_of_another_problem_in_the_covariance():
    lag()[4][lag()[1], "b"]


@wrong("'u'", "rate of 'x'", "another problem", "declared in this problem")
def test_symbol_of_another_problem_in_a_rate():
    solve(simple(rate=lambda x, u: simple()[2])[0])


@wrong("'q'", "rate of 'x'", "declare 'q'")
def test_unknown_symbol_in_a_rate():
    solve(simple(rate=lambda x, u: u + ca.MX.sym("q"))[0])


@wrong("'u'", "the cost", "another problem")
def test_symbol_of_another_problem_in_the_cost():
    solve(simple(running=lambda x, u: simple()[2] ** 2)[0])


@wrong("'q'", "'limit'")
def test_unknown_symbol_in_a_constraint():
    ocp, x, _ = simple()
    ocp.subject_to(x - ca.MX.sym("q"), name="limit")
    solve(ocp)


@wrong("terminal cost contains 'time'", "Problem.duration")
def test_time_in_the_terminal_cost():
    ocp = co.Problem(co.Free(2.0))
    x = ocp.state("x", initial=0, final=1)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=ocp.time)
    co.solve(ocp)


@wrong("terminal cost contains 'u'")
def test_control_in_the_terminal_cost():
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(terminal=u)
    co.solve(ocp)


@wrong("dynamics()", "one of x")
def test_dynamics_of_another_problem():
    simple()[0].dynamics(simple()[1], 1)


@wrong("dynamics()", "'b'", "constant")
def test_dynamics_of_an_unknown():
    ocp, _, b, _, _ = lag()
    ocp.dynamics(b, 1)


@wrong("dynamics()", "'E'", "has its rate already")
def test_dynamics_of_the_covariance():
    ocp, _, _, _, E = lag()
    ocp.dynamics(E.matrix, E.matrix)


@wrong("initial or final value", "'x'", "at='initial'")
def test_initial_value_by_a_variable():
    ocp, x, u = simple()
    y = ocp.state("y", initial=x)
    ocp.dynamics(y, u)
    solve(ocp)


@wrong("lower bound of 'x'", "k", "subject_to()")
def test_bound_by_a_symbol():
    ocp = empty()
    ocp.state("x", initial=0, lower=ocp.parameter("k", 1.0))


@wrong("rate of 'x'", "not an expression", "casadi.vertcat")
def test_list_as_a_rate():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.dynamics(x, [x[1], x[0]])


@wrong("rate of 'x'", "not an expression", "SX")
def test_symbol_of_another_kind():
    ocp = empty()
    ocp.dynamics(ocp.state("x", initial=0), ca.SX.sym("q"))


@wrong("measurement 'm'", "casadi.vertcat")
def test_measurement_of_a_list():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.measurement("m", [x[0], x[1]], noise=1.0)


@wrong("measurement 'm'", "SX")
def test_measurement_of_a_symbol_of_another_kind():
    empty().measurement("m", ca.SX.sym("q"), noise=1.0)


# --- constraints ------------------------------------------------------------------------------------------------------


@wrong("'three' contains no variable")
def test_constraint_on_a_number():
    lag()[0].subject_to(3.0, name="three")


@wrong("'three' contains no variable")
def test_constraint_on_a_parameter():
    ocp = lag()[0]
    ocp.subject_to(ocp.parameter("k", 1.0) - 2, name="three")


@wrong("'limit' contains no variable")
def test_constraint_on_an_unknown():
    """Unknowns are constant in the nominal: nothing can be chosen here."""
    ocp, _, b, _, _ = lag()
    ocp.subject_to(b - 2, name="limit")


@wrong("constraint 'limit'", "casadi.vertcat")
def test_constraint_on_a_list():
    ocp = empty()
    x = ocp.state("x", 2, initial=0)
    ocp.subject_to([x[0], x[1]], name="limit")


@wrong("'limit' is a comparison", "subject_to(x, upper=1)")
def test_constraint_as_a_comparison():
    """x <= 1 is a truth value: taken as an expression it would demand that x <= 1 is false."""
    ocp, x, _ = simple()
    ocp.subject_to(x <= 1, name="limit")


@wrong("'limit' has an unknown place", "'final'", "'end'")
def test_constraint_at_an_unknown_place():
    ocp, x, *_ = lag()
    ocp.subject_to(x, at="end", name="limit")


@pytest.mark.parametrize("at", [[2.0, 4.0], (2, 4), np.array([2.0, 4.0])])
def test_several_instants_are_several_conditions(at):
    ocp, x, *_ = lag()
    with pytest.raises(co.ProblemError, match=r"'limit' is to hold at an instant(.|\n)*one subject_to for each"):
        ocp.subject_to(x, at=at, name="limit")


@pytest.mark.parametrize("at", [True, [], np.nan, [1.0, None], [1.0, [2.0]], "4.0"])
def test_what_is_no_instant_is_an_unknown_place(at):
    ocp, x, *_ = lag()
    with pytest.raises(co.ProblemError, match="unknown place"):
        ocp.subject_to(x, at=at, name="limit")


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
    entry = ca.Function("f", [x, b, ocp.declarations.matrices[0].symbol], [E[x**2, b], E[x * b, x * b]])
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
    for call in (co.solve, co.compare, co.evaluate, co.worth):
        refused(lambda call=call: call(3), "This is not a problem", "received: int: 3")
    refused(lambda: co.certify(None), "This is not a solution")


def test_a_name_of_an_entry_is_taken() -> None:
    problem = co.Problem(duration=1.0)
    problem.state("x", 2, initial=0.0)
    with pytest.raises(co.ProblemError, match=r"'x\[1\]' is used twice"):
        problem.state("x[1]", initial=0.0)


def test_a_console_shows_what_is_declared():
    problem = co.Problem(duration=1.0, name="cart")
    problem.state("x", initial=0.0, variance=1.0)
    problem.unknown("drag", mean=1.0, variance=0.1)
    problem.control("u")
    assert repr(problem) == "Problem('cart', states x, unknowns drag, controls u)"
    with pytest.raises(co.ProblemError, match="name="):
        co.Problem(duration=1.0, name=3)
