"""What an attitude must be, and what is said where it is not."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from refusals import refused, wrong

import covocp as co
from covocp.blocks import so3
from covocp.problem.attitude import geodesic


def declared(**given):
    ocp = co.Problem(1.0)
    rate = ocp.control("rate", 3)
    return ocp, ocp.attitude("attitude", **{"initial": np.eye(3), "rate": rate} | given)


@wrong("initial attitude of 'attitude'", "a rotation, shape (3, 3)", "differs from the identity by 0.21")
def test_no_rotation():
    declared(initial=1.1 * np.eye(3))


@wrong("final attitude of 'attitude'", "determinant -1")
def test_a_reflection():
    declared(final=np.diag([1.0, 1.0, -1.0]))


@wrong("initial attitude of 'attitude'", "unit quaternion", "a norm of 2")
def test_a_quaternion_that_is_too_long():
    declared(initial=[2.0, 0.0, 0.0, 0.0])


@wrong("initial attitude of 'attitude'", "shape (3,)")
def test_three_numbers():
    declared(initial=[0.1, 0.2, 0.3])


@wrong("initial attitude of 'attitude'", "NaN")
def test_nan():
    declared(initial=np.full((3, 3), np.nan))


@wrong("angular velocity of 'attitude'", "shape (3, 1)")
def test_a_scalar_rate():
    declared(rate=ca.MX.sym("w"))


@wrong("variance of 'attitude'", "not positive semidefinite")
def test_a_negative_variance():
    declared(variance=-1.0)


@wrong("variance of 'attitude'", "3 x 3 matrix")
def test_a_variance_of_four():
    declared(variance=np.eye(4))


@wrong("name 'rate' is used twice")
def test_a_name_that_is_taken():
    ocp, _ = declared()
    ocp.attitude("rate", initial=None, rate=ca.MX.zeros(3))


@wrong("guess of 'attitude'", "rotations (K, 3, 3)", "shape (5, 3)")
def test_a_guess_of_vectors():
    declared(guess=np.zeros((5, 3)))


@wrong("The rate of 'attitude' is given twice")
def test_a_second_rate():
    ocp, attitude = declared()
    ocp.dynamics(attitude, ca.MX.zeros(4))


@pytest.mark.parametrize("axis", [[0.0, 0.0, 0.0], [1.0, 0.0], [np.nan, 0.0, 1.0], "x"])
def test_an_axis_that_points_nowhere(axis):
    words = ("body axis that 'attitude' points with is no direction", "three finite numbers")
    refused(lambda: declared()[1].cosine(axis, [1.0, 0.0, 0.0]), *words)


def test_a_prescribed_attitude_needs_a_weight_where_it_is_fed_back():
    ocp, _ = declared(final=so3.exp([0.1, 0.0, 0.0]), variance=0.1)
    ocp.minimize_expected(running=ca.sumsqr(ocp.declarations.controls[0].symbol))
    with pytest.raises(co.ProblemError, match=r"terminal_weight=\{attitude: \.\.\.\}"):
        ocp.statement()


def test_a_weight_of_a_prescribed_attitude_is_one_of_its_errors():
    ocp, attitude = declared(final=so3.exp([0.1, 0.0, 0.0]), variance=0.1)
    u = ocp.declarations.controls[0].symbol
    ocp.minimize_expected(running=ca.sumsqr(u), terminal_weight={attitude: [1.0, 2.0, 3.0]})
    loop = ocp.statement().loop
    weights = loop.terminal([1.0, 0.0, 0.0, 0.0], 1.0, [])[1].full()
    assert weights == pytest.approx(np.diag([1.0, 2.0, 3.0]))


def test_second_derivatives_by_attitudes_against_finite_differences():
    """k of a turned attitude, to second order in the rotation vector of the turn."""
    ocp, attitude = declared(variance=0.1)
    s = np.array([0.6, 0.0, 0.8])
    u = ocp.declarations.controls[0].symbol
    ocp.minimize_expected(running=ca.sumsqr(u), terminal=ca.exp((attitude.matrix @ ca.DM(s))[1]))
    S = ocp.statement().loop.terminal
    C = so3.exp([0.4, -0.9, 0.2])

    def k(d):
        return np.exp((so3.exp(d) @ C @ s)[1])

    h, unit = 1e-4, np.eye(3)
    true = [
        [(k(h * (a + b)) - k(h * (a - b)) - k(h * (b - a)) + k(-h * (a + b))) / (4 * h * h) for a in unit] for b in unit
    ]
    found = S(so3.to_quaternion(C), 1.0, [])[1].full()
    assert found == pytest.approx(np.array(true), abs=1e-7)


def test_matrices_quaternions_and_expressions_are_the_same_attitude():
    C = so3.exp([0.4, -0.9, 0.2])
    q = so3.to_quaternion(C)
    ocp = co.Problem(1.0)
    rate, given = ocp.control("rate", 3), ocp.parameter("given", q)
    for k, initial in enumerate((C, ca.DM(C), q, -q, 1.0 * given)):
        ocp.attitude(f"a{k}", initial=initial, rate=rate)
    ocp.minimize(running=ca.sumsqr(rate))
    start = ocp.statement().boundary_values(ocp.statement().values).initial.reshape(-1, 4)
    found = so3.from_quaternion(start)
    assert found == pytest.approx(np.tile(C, (5, 1, 1)), abs=1e-15)


def test_what_an_attitude_tells():
    ocp, attitude = declared(final=None)
    ocp.minimize(running=ca.sumsqr(attitude.vector))
    C, other = so3.exp([0.4, -0.9, 0.2]), so3.exp([-0.1, 0.3, 0.0])
    expression = ca.vertcat(
        ca.vec(attitude.matrix), attitude.vector, attitude.error(other), attitude.cosine([0, 0, 2.0], [3.0, 0, 0])
    )
    value = ca.Function("value", [attitude.quaternion], [expression])
    expected = [C.ravel(order="F"), [0.4, -0.9, 0.2], so3.log(C @ other.T), [C[2, 0]]]
    for factor in (1.0, -2.0):
        found = value(factor * so3.to_quaternion(C)).full().ravel()
        assert found == pytest.approx(np.concatenate(expected), abs=1e-14)


def test_a_geodesic_turns_about_one_axis_between_rests():
    first, last = so3.exp([0.4, -0.9, 0.2]), so3.exp([-1.0, 2.0, 1.5])
    path = so3.from_quaternion(
        geodesic(so3.to_quaternion(first), so3.to_quaternion(last))(np.array([0.0, 0.3, 0.5, 1.0]))
    )
    turn = so3.log(last @ first.T)
    for C, share in zip(path, (0.0, 0.216, 0.5, 1.0), strict=True):
        assert so3.log(C @ first.T) == pytest.approx(share * turn, abs=1e-12)


@pytest.mark.parametrize("kind", ["matrices", "quaternions", "function", "one", "function of one"])
def test_guesses_of_attitudes(kind):
    turn = np.array([0.0, 1.0, 0.0])
    rotations = so3.exp(np.linspace(0.0, 1.0, 11)[:, None] * turn)
    flipped = so3.to_quaternion(rotations) * np.where(np.arange(11) % 2, -1.0, 1.0)[:, None]
    guess = {
        "matrices": rotations,
        "quaternions": flipped,
        "function": lambda s: so3.exp(np.asarray(s)[:, None] * turn),
        "one": rotations[-1],
        "function of one": lambda s: so3.exp(float(s) * turn),
    }[kind]
    ocp, attitude = declared(guess=guess, final=rotations[-1])
    ocp.minimize(running=ca.sumsqr(ocp.declarations.controls[0].symbol))
    assert co.solve(ocp, intervals=10).cost == pytest.approx(1.0, rel=1e-7)


def test_a_direction_by_a_parameter_is_of_any_length():
    ocp = co.Problem(1.0)
    rate, sun = ocp.control("rate", 3), ocp.parameter("sun", [0.0, 3.0, 4.0])
    attitude = ocp.attitude("attitude", initial=np.eye(3), rate=rate)
    value = ca.Function("value", [attitude.quaternion, sun], [attitude.cosine([0, 0, 2.0], sun)])
    assert float(value([1.0, 0.0, 0.0, 0.0], [0.0, 3.0, 4.0])) == pytest.approx(0.8, abs=1e-15)


@wrong("name 'final attitude' is used twice")
def test_a_name_that_the_end_of_an_attitude_needs():
    ocp = co.Problem(1.0)
    rate = ocp.control("rate", 3)
    ocp.subject_to(rate, upper=np.ones(3), name="final attitude")
    ocp.attitude("attitude", initial=np.eye(3), final=so3.exp([0.1, 0.0, 0.0]), rate=rate)


@pytest.mark.parametrize("kind", [np.asarray, ca.DM, lambda value: ca.MX(ca.DM(value))])
def test_an_attitude_times_a_vector_turns_it(kind):
    """A third of a turn about the diagonal: x becomes y or z; C = exp(-phi^x) has r_b = C r_a."""
    _, attitude = declared()
    turned = ca.Function(
        "turned", [attitude.quaternion], [attitude @ kind([1.0, 2.0, 3.0]), kind([[1.0, 2.0, 3.0]]) @ attitude]
    )
    after, before = (value.full().ravel() for value in turned([0.5, 0.5, 0.5, 0.5]))
    assert after == pytest.approx([2.0, 3.0, 1.0])
    assert before == pytest.approx([3.0, 1.0, 2.0])


def test_an_attitude_times_something_else():
    _, attitude = declared()
    row = ca.Function("row", [attitude.quaternion], [np.array([1.0, 2.0, 3.0]) @ attitude])
    assert row([0.5, 0.5, 0.5, 0.5]).full().ravel() == pytest.approx([3.0, 1.0, 2.0])
    for factor in (2.0, [1.0, 2.0], "north"):
        with pytest.raises(co.ProblemError):
            attitude @ factor
