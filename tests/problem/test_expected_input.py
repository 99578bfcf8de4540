"""What minimize_expected refuses, and with which words: what is wrong, expected, received, remedy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import covocp as co


class Declared:
    """A lag with its symbols; `expect` states the cost and builds."""

    def __init__(self, *, noise=1.0, variance=1.0, parameter_variance=0.5, final=1.0, name="x"):
        self.ocp = co.Problem(duration=3.0, name="lag")
        self.x = self.ocp.state(name, initial=0.0, final=final, variance=variance)
        self.b = self.ocp.unknown("b", mean=1.0, variance=parameter_variance)
        self.u = self.ocp.control("u")
        self.ocp.dynamics(self.x, -self.b * self.x + self.u, noise=noise)
        self.ocp.measurement("m", self.x, noise=1.0)

    def expect(self, running=None, terminal=0.0, **options):
        options = {"terminal_weight": {self.x: 2.0}} | options
        running = 0.5 * self.u**2 if running is None else running
        self.ocp.minimize_expected(running=running, terminal=terminal, **options)
        return self.ocp.statement()


FOREIGN = co.Problem(duration=1.0).parameter("foreign", 1.0)


def no_control():
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=None, variance=1.0)
    ocp.dynamics(x, -x, noise=1.0)
    ocp.minimize_expected(running=x**2)
    return ocp.statement()


def test_nothing_uncertain():
    d = Declared(noise=0.0, variance=0.0, parameter_variance=0.0)
    refused(d.expect, "deterministic", "variance=", "noise=", "minimize()")


@pytest.mark.parametrize(
    "uncertain", [{"noise": 1.0}, {"variance": 1.0}, {"parameter_variance": 0.1}], ids=lambda given: next(iter(given))
)
def test_one_uncertainty_is_enough(uncertain):
    assert Declared(**({"noise": None, "variance": 0.0, "parameter_variance": 0.0} | uncertain)).expect() is not None


def test_given_initial_covariance_counts_as_uncertain_and_as_certain():
    d = Declared(noise=None, variance=0.0, parameter_variance=0.0)
    d.ocp.estimation_covariance(initial=np.diag([0.0, 0.3]))
    assert d.expect() is not None
    d = Declared(noise=None)  # variances are replaced by a covariance of zero
    d.ocp.estimation_covariance(initial=np.zeros((2, 2)))
    refused(d.expect, "deterministic")


@pytest.mark.parametrize(
    "running",
    [
        lambda d: d.x**2,
        lambda d: d.u * d.x + d.x**2,
        lambda d: ca.fabs(d.u),
        lambda d: 0.5 * ca.mtimes([d.u.T, ca.DM([[0.0]]), d.u]) + d.x**2,
    ],
    ids=["absent", "bilinear", "absolute value", "weight zero"],
)
def test_control_without_weight(running):
    d = Declared()
    refused(lambda: d.expect(running(d)), "'u' has no weight", "control_weight={u: ...}")


def test_one_of_two_controls_without_weight():
    d = Declared()
    w = d.ocp.control("w", 2)
    refused(lambda: d.expect(d.u**2 + w[0] ** 2), "'w[1]'", "control_weight={w: ...}")


def test_running_cost_with_a_maximum_by_the_control():
    d = Declared()
    message = refused(lambda: d.expect(-(d.u**2)), "not positive definite", "control_weight={...}")
    assert "measurement" not in message
    d = Declared()
    w = d.ocp.control("w")
    refused(lambda: d.expect(d.u**2 + w**2 + 3 * d.u * w), "u, w", "not positive definite")


def test_terminal_condition_without_weight():
    """Case 2: only the nominal meets it."""
    d = Declared()
    refused(lambda: d.expect(terminal_weight=None), "'x'", "only the nominal meets", "terminal_weight={x: ...}", "0 if")
    # of the unknown, not of x; and of one component of a vector
    d = Declared()
    refused(lambda: d.expect(terminal_weight={d.b: 1.0}), "'x'", "terminal_weight")
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", 2, initial=0.0, final=[None, 1.0], variance=1.0), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize_expected(running=u**2, terminal=x[0] ** 2)
    refused(ocp.statement, "'x'", "terminal_weight")


@pytest.mark.parametrize(
    "given",
    [
        {"terminal_weight": {"x": 0.0}},
        {"terminal_weight": {"x": 1.0}},
        {"terminal_weight": 1.0},
        {"terminal_weight": None, "terminal": lambda d: ca.cosh(d.x)},
    ],
    ids=["zero", "by name", "number", "terminal cost"],
)
def test_terminal_condition_with_weight(given):
    d = Declared()
    terminal = given.get("terminal", lambda d: 0.0)(d)
    assert d.expect(**(given | {"terminal": terminal})).matrix_end is not None


def test_free_end_needs_no_weight():
    assert Declared(final=None).expect(terminal_weight=None) is not None


@pytest.mark.parametrize(
    ("given", "parts"),
    [
        ({"terminal_weight": {"x": -1.0}}, ["terminal weight", "'x'", "-1"]),
        ({"terminal_weight": {"x": [1.0, 2.0]}}, ["terminal weight", "'x'", "(2,)"]),
        ({"terminal_weight": {"x": np.nan}}, ["terminal weight", "'x'", "NaN"]),
        ({"terminal_weight": {"y": 1.0}}, ["terminal_weight()", "y", "x, b"]),
        ({"terminal_weight": {"u": 1.0}}, ["terminal_weight()", "u", "x, b"]),
        ({"terminal_weight": {FOREIGN: 1.0}}, ["terminal_weight()", "foreign", "x, b"]),
        ({"terminal_weight": {"x": FOREIGN}}, ["terminal weight", "'foreign'"]),
        ({"terminal_weight": -2.0}, ["terminal weight", "-2"]),
        ({"terminal_weight": np.eye(3)}, ["terminal weight", "(3, 3)", "2 x 2"]),
        ({"terminal_weight": np.array([[1.0, 0.5], [0.0, 1.0]])}, ["terminal weight", "not symmetric"]),
        ({"terminal_weight": "heavy"}, ["terminal weight", "heavy"]),
        ({"control_weight": {"u": -1.0}}, ["control weight", "'u'", "-1"]),
        ({"control_weight": {"u": 0.0}}, ["'u' has no weight"]),
        ({"control_weight": {"u": np.eye(2)}}, ["control weight", "'u'", "(2, 2)"]),
        ({"control_weight": {"x": 1.0}}, ["control_weight()", "x", "one of u"]),
        ({"control_weight": {"u": FOREIGN}}, ["control weight", "'foreign'"]),
        ({"control_weight": -3.0}, ["control weight", "-3"]),
        ({"control_weight": np.eye(2)}, ["control weight", "(2, 2)"]),
        ({"gain": 1.0}, ["gain", "Gain(", "1.0"]),
        ({"gain": {"constant": True}}, ["gain", "Gain(", "constant"]),
        ({"gain": co.Gain}, ["gain", "Gain("]),
        ({"gain": co.Gain(structure=[[1, 0, 0]])}, ["structure", "(1, 2)", "(1, 3)"]),
        ({"gain": co.Gain(structure=[[0, 0]])}, ["nothing to choose"]),
        ({"gain": co.Gain(lower=1.0, upper=0.0)}, ["nothing to choose", "lower"]),
        ({"gain": co.Gain(lower=np.nan)}, ["lower", "NaN"]),
        ({"gain": co.Gain(guess=[1.0, 2.0, 3.0])}, ["guess", "(1, 2)", "(3,)"]),
        ({"gain": co.Gain(upper="high")}, ["upper", "high"]),
    ],
)
def test_weights_and_gains_that_do_not_fit(given, parts):
    refused(lambda: Declared().expect(**given), *parts)


@pytest.mark.parametrize("value", [-1.0, 0.0])
def test_control_weight_from_a_parameter(value):
    d = Declared()
    d.expect(control_weight={d.u: d.ocp.parameter("r", value)})
    refused(lambda: co.solve(d.ocp, intervals=5, progress=False), "weight", "'u'")


@pytest.mark.parametrize("name", ["S", "Xhat", "C"])
def test_names_of_the_feedback_are_taken(name):
    refused(
        lambda: Declared(name=name).expect(terminal_weight={name: 1.0}), f"'{name}'", "taken", "test_expected_input"
    )


def test_the_name_of_the_covariance_is_taken():
    refused(lambda: Declared(name="E").expect(terminal_weight={"E": 1.0}), "'E'")


@pytest.mark.parametrize("order", [(0, 1), (1, 0), (0, 0), (1, 1)])
def test_one_cost_only(order):
    d = Declared()
    calls = (lambda: d.ocp.minimize(running=d.u**2), lambda: d.ocp.minimize_expected(running=d.u**2))
    calls[order[0]]()
    remedy = "add the terms up" if order[0] == order[1] else "use one of the two"
    refused(calls[order[1]], "cost is given twice", "minimize_expected()", remedy)


def test_the_actual_system_has_no_covariance():
    """Costs, rates, noises, measurements and weights of the actual system contain no matrices."""

    def expect(**options):
        d = Declared()
        E = d.ocp.estimation_covariance()
        return d.expect(**{name: value(d, E[d.b, d.b]) for name, value in options.items()})

    refused(lambda: expect(running=lambda d, v: d.u**2 + v), "running cost", "matrix 'E'", "minimize()")
    refused(lambda: expect(terminal=lambda d, v: v), "terminal cost", "matrix 'E'", "minimize()")
    refused(lambda: expect(terminal_weight=lambda d, v: {d.x: 1 + v}), "terminal weight", "matrix 'E'")
    refused(lambda: expect(control_weight=lambda d, v: {d.u: 1 + v}), "control weight", "matrix 'E'")
    for what in ("rate", "noise", "measurement"):
        ocp = co.Problem(duration=1.0)
        x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
        P = ocp.symmetric("P", 1, initial=1.0)
        ocp.dynamics(P, -P)
        ocp.dynamics(x, u * (P if what == "rate" else 1), noise=P if what == "noise" else 1.0)
        ocp.measurement("m", x * (P if what == "measurement" else 1), noise=1.0)
        ocp.minimize_expected(running=u**2 + x**2)
        refused(ocp.statement, what, "matrix 'P'")


def test_no_control():
    refused(no_control, "needs a control", "minimize()")


def test_symbols_of_another_problem():
    d = Declared()
    refused(lambda: d.expect(d.u**2 + FOREIGN), "'foreign'", "the cost")
    d = Declared()
    refused(lambda: d.expect(terminal=FOREIGN * d.x), "'foreign'")


def test_controls_and_time_are_no_terminal_cost():
    d = Declared()
    refused(lambda: d.expect(terminal=d.u**2), "terminal cost contains 'u'")
    d = Declared()
    refused(lambda: d.expect(terminal_weight={d.x: d.ocp.time}), "terminal cost contains 'time'")


def test_costs_must_be_scalar():
    d = Declared()
    refused(lambda: d.expect(running=ca.vertcat(d.u, d.x)), "running cost", "(2, 1)")
    d = Declared()
    refused(lambda: d.expect(terminal=[1.0, 2.0]), "terminal cost")


def test_state_without_dynamics():
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
    ocp.minimize_expected(running=u**2 + x**2)
    refused(ocp.statement, "'x' has no dynamics")


# --- quadratic synthesis ----------------------------------------------------------------------------------------------


def test_deterministic_nominal_needs_an_expected_cost():
    d = Declared()
    d.ocp.minimize(running=d.u**2)
    refused(lambda: co.solve(d.ocp, nominal="deterministic"), "expected cost", "minimize_expected()", "nominal=")


@pytest.mark.parametrize("constant", [True, False])
def test_deterministic_nominal_needs_the_best_gain(constant):
    d = Declared()
    d.expect(gain=co.Gain(constant=constant, structure=[[1, 0]]))
    refused(lambda: co.solve(d.ocp, nominal="deterministic"), "best gain", "structure=[[1, 0]]", "combined")


def test_deterministic_nominal_needs_a_deterministic_cost():
    """Mars without regularization: only covariances cost."""
    d = Declared()
    d.expect(running=0.0, control_weight={d.u: 1.0})
    refused(lambda: co.solve(d.ocp, nominal="deterministic"), "depends on nothing", "evaluate(problem, nominal=...)")


def test_unknown_kind_of_nominal():
    d = Declared()
    d.expect()
    refused(lambda: co.solve(d.ocp, nominal="classical"), "'nominal'", "'combined' or 'deterministic'", "'classical'")


def test_a_prescribed_end_needs_a_weight_also_where_there_is_one_state_alone() -> None:
    ocp = co.Problem(1.0, name="one")
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, u, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=u**2)
    with pytest.raises(co.ProblemError, match="The final value of 'x' is prescribed, but nothing says"):
        co.solve(ocp, progress=False)
