"""θ-D: the series against its definition, the Riccati equation and independent ways to solve it; what it refuses."""

from __future__ import annotations

import ctypes
import math
import subprocess

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov

import covocp as co
from covocp.blocks import sdre, theta_d, theta_d_series
from covocp.models import agile_aircraft, theta_d_benchmarks

RNG = np.random.default_rng(5)
# A system with two functions in A(x), one of them in two entries, three states and two inputs.
X = ca.SX.sym("x", 3)
A0 = np.array([[0.2, 1.0, 0.0], [-0.5, 0.1, 0.4], [0.3, 0.0, -0.6]])
FIRST = np.array([[0.0, 0.3, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.2]])
SECOND = np.array([[0.1, 0.0, 0.0], [0.0, 0.0, -0.3], [0.0, 0.0, 0.0]])
A = ca.sin(X[0]) * ca.DM(FIRST) + X[1] * X[2] * ca.DM(SECOND)
B = np.array([[1.0, 0.0], [0.0, 0.0], [0.2, 1.0]])
Q, R = np.diag([1.0, 2.0, 0.5]), np.array([[1.0, 0.2], [0.2, 0.7]])
H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
W, V = np.diag([0.5, 1.0, 0.3]), np.diag([0.4, 0.2])
STATES = RNG.standard_normal((6, 3))


def value_of_A(state):
    return np.sin(state[0]) * FIRST + state[1] * state[2] * SECOND


def call(function, *arguments):
    """Outputs as arrays."""
    found = function(*arguments)
    return [part.full() for part in found] if isinstance(found, tuple) else found.full()


def recursion(A0, A, B, Q, R, epsilon):
    """Terms by scipy's solver of each Lyapunov equation, written out once more."""
    S = B @ np.linalg.solve(R, B.T)
    terms = [solve_continuous_are(A0, B, Q, R)]
    closed = A0 - S @ terms[0]
    for n, factor in enumerate(epsilon, start=1):
        inner = sum((terms[j] @ S @ terms[n - j] for j in range(1, n)), np.zeros_like(A0))
        right = -factor * (terms[n - 1] @ A + A.T @ terms[n - 1] - inner)
        terms.append(solve_continuous_lyapunov(closed.T, right))
    return terms


def by_eigenvectors(closed, right):
    """T with T A_c + A_c' T = right, by diagonalising A_c."""
    values, M = np.linalg.eig(closed)
    Y = (M.T @ right @ M) / (values[:, None] + values[None, :])
    return np.real(np.linalg.inv(M).T @ Y @ np.linalg.inv(M))


def residual(P, F, B, Q, R):
    return P @ F + F.T @ P - P @ B @ np.linalg.solve(R, B.T) @ P + Q


def slope(sizes, errors):
    return np.polyfit(np.log(sizes), np.log(errors), 1)[0]


# --- the terms --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["polynomial", "operator"])
@pytest.mark.parametrize(
    ("terms", "k", "l"),
    [(1, 0.0, 0.0), (3, 0.0, 0.0), (3, 1.0, 0.01), (4, [0.9, 0.0, 0.4], [0.2, 1.0, 0.0]), (6, 0.5, 0.3)],
)
def test_terms_solve_their_equations(form, terms, k, l):
    built = theta_d.expansion(X, A0, A, B, Q, R, terms=terms, k=k, l=l, form=form)
    assert built.form == form
    count = terms - 1
    for state, t in zip(STATES, [0.0, 0.5, 1.0, 3.0, 10.0, 100.0], strict=True):
        epsilon = 1.0 - np.broadcast_to(k, count) * np.exp(-np.broadcast_to(l, count) * t)
        wanted = recursion(A0, value_of_A(state), B, Q, R, epsilon)
        found = call(built.terms, state, t)
        found = found if terms > 1 else [found]
        for one, two in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, two, rtol=0, atol=1e-12 * max(1.0, np.abs(two).max()))
        scale = max(np.abs(term).max() for term in wanted)
        np.testing.assert_allclose(call(built.sum, state, t), sum(wanted), rtol=0, atol=1e-12 * scale)


def test_three_ways_to_solve_a_correction_agree():
    built = theta_d.expansion(X, A0, A, B, Q, R, terms=2, form="operator")
    for state in STATES:
        T0, T1 = call(built.terms, state, 0.0)
        right = -(T0 @ value_of_A(state) + value_of_A(state).T @ T0)
        np.testing.assert_allclose(T1, by_eigenvectors(built.closed_loop, right), rtol=0, atol=1e-13)
        np.testing.assert_allclose(T1, solve_continuous_lyapunov(built.closed_loop.T, right), rtol=0, atol=1e-13)


def test_the_form_with_fewer_multiplications_is_taken():
    assert theta_d.expansion(X, A0, A, B, Q, R).form == "polynomial"
    full = ca.SX(3, 3)
    for i in range(3):
        for j in range(3):
            full[i, j] = ca.sin((i + 1) * X[j] + i * j)
    assert theta_d.expansion(X, A0, full, B, Q, R, terms=5).form == "operator"


def test_few_terms_of_one_function_cost_little():
    linear, bilinear, column, _ = agile_aircraft.matrices()
    x = ca.SX.sym("x", 5)
    scenario = agile_aircraft.regulation()
    law = theta_d.regulator(x, linear, x[1] * ca.DM(bilinear), column, scenario.Q, scenario.R, k=1.0, l=0.01)
    assert law.n_instructions() < 100


def test_constant_A_that_is_zero_gives_the_linear_regulator():
    law = theta_d.regulator(X, A0, np.zeros((3, 3)), B, Q, R, terms=4)
    gain = np.linalg.solve(R, B.T) @ solve_continuous_are(A0, B, Q, R)
    np.testing.assert_allclose(call(law, STATES[0], 2.0).ravel(), -gain @ STATES[0], rtol=1e-12)


def test_polynomial_form_with_functions_that_are_not_defined_everywhere():
    root = ca.sqrt(X[0]) * ca.DM(FIRST)
    forms = [theta_d.regulator(X, A0, root, B, Q, R, form=form) for form in ("polynomial", "operator")]
    state = [0.3, -0.2, 0.5]
    np.testing.assert_allclose(call(forms[0], state, 0.0), call(forms[1], state, 0.0), rtol=1e-13)


NEARLY = {
    "far away": (X[1], X[1] + ca.fmax(X[0] - 50.0, 0.0), [60.0, 1.0, 0.0]),
    "in a narrow range": (X[1], X[1] + ca.if_else(ca.fabs(X[0] - 0.5) < 1e-6, 1.0, 0.0), [0.5, 1.0, 0.0]),
    "over long distances": ((1.0 + X[0] / 2e7) ** -2, 1.0 - X[0] / 1e7 + 0.0 * X[0], [1e7, 0.0, 0.0]),
    "never seen": (ca.log(X[0] - 1e9), X[1], [2e9, 1.0, 0.0]),
    "zero near the origin": (ca.fmax(X[0] - 1e9, 0.0), X[1], [2e9, 1.0, 0.0]),
}


@pytest.mark.parametrize("case", list(NEARLY))
def test_entries_that_nearly_depend_on_each_other_are_kept_apart(case):
    first, second, state = NEARLY[case]
    rest = first * ca.DM(FIRST) + second * ca.DM(np.fliplr(FIRST) * (FIRST == 0))
    value = ca.Function("A", [X], [rest])(state).full()
    terms = theta_d.expansion(X, A0, rest, B, Q, R, terms=2, form="polynomial").terms(state, 0.0)
    wanted = recursion(A0, value, B, Q, R, [1.0])
    np.testing.assert_allclose(terms[1].full(), wanted[1], rtol=0, atol=1e-10 * np.abs(wanted[1]).max())


def test_coefficients_of_the_scalar_system():
    system = theta_d_benchmarks.system("cubic")
    built = theta_d.expansion(system.x, system.A0, system.A, system.B, system.Q, system.R, terms=4)
    x = 0.7
    a, root = -(x**2), np.sqrt(2.0)
    found = [float(term[0, 0]) for term in call(built.terms, x, 0.0)]
    wanted = [1 + root, (1 + 1 / root) * a, root / 8 * a**2, -root / 16 * a**3]
    np.testing.assert_allclose(found, wanted, rtol=1e-13)


# --- properties of section 2 ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("terms", [1, 2, 3, 4, 5])
def test_sum_is_the_taylor_series_of_the_riccati_solution(terms):
    """Property 1: the error of the N-th partial sum is of order N + 1 in A."""
    built = theta_d.expansion(X, A0, X[0] * ca.DM(FIRST + SECOND), B, Q, R, terms=terms)
    sizes = np.array([0.04, 0.08, 0.16])
    errors = [
        np.abs(
            call(built.sum, [size, 0.0, 0.0], 0.0) - solve_continuous_are(A0 + size * (FIRST + SECOND), B, Q, R)
        ).max()
        for size in sizes
    ]
    assert slope(sizes, errors) == pytest.approx(terms, abs=0.15)


def test_without_corrections_at_the_start_the_law_is_the_linear_one():
    """Property 2: k = 1 starts as LQR, and with l = 0.01 stays within a tenth of the first correction for 10 s."""
    linear = theta_d.regulator(X, A0, A, B, Q, R, terms=1)
    first = theta_d.regulator(X, A0, A, B, Q, R, terms=2)
    slow = theta_d.regulator(X, A0, A, B, Q, R, terms=2, k=1.0, l=0.01)
    for state in STATES:
        np.testing.assert_allclose(call(slow, state, 0.0), call(linear, state, 0.0), rtol=1e-14)
        correction = call(first, state, 0.0) - call(linear, state, 0.0)
        for t in (1.0, 5.0, 10.0):
            moved = call(slow, state, t) - call(linear, state, 0.0)
            np.testing.assert_allclose(moved, -np.expm1(-0.01 * t) * correction, rtol=1e-10, atol=1e-14)
            assert np.all(np.abs(moved) <= 0.1 * np.abs(correction) + 1e-14)


@pytest.mark.parametrize(("terms", "k", "l"), [(2, 0.0, 0.0), (3, 1.0, 0.01), (4, [0.3, 1.0, 0.6], [0.5, 0.0, 2.0])])
def test_residual_identity(terms, k, l):
    """Property 3: the Riccati residual is made of the perturbations D_n and of the terms of order above N."""
    built = theta_d.expansion(X, A0, A, B, Q, R, terms=terms, k=k, l=l)
    S = B @ np.linalg.solve(R, B.T)
    count = terms - 1
    for state, t in zip(STATES, [0.0, 0.2, 1.0, 4.0, 9.0, 30.0], strict=True):
        T, D = call(built.terms, state, t), call(built.perturbations, state, t)
        D = D if count > 1 else [D]
        rest = value_of_A(state)
        pairs = [(i, j) for i in range(1, terms) for j in range(1, terms) if i + j >= terms]
        wanted = T[-1] @ rest + rest.T @ T[-1] - sum(D) - sum(T[i] @ S @ T[j] for i, j in pairs)
        found = residual(call(built.sum, state, t), A0 + rest, B, Q, R)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * max(1.0, np.abs(wanted).max()))


def test_a_residual_of_zero_does_not_make_a_law_optimal():
    """Property 4: for the second split p = P x of the SDRE law is no gradient, for the first it is."""
    asymmetries = {}
    for name in ("rational", "rational_split"):
        system = theta_d_benchmarks.system(name)
        solution = sdre.solution(system.x, system.A0, system.A, system.B, system.Q, system.R)
        factor = ca.Function("F", [system.x], [system.A0 + system.A])
        state, step = np.array([0.8, -0.6]), 1e-5
        F = factor(state).full()
        assert np.abs(residual(solution(state), F, system.B, system.Q, system.R)).max() < 1e-11
        columns = [
            (solution(state + shift) @ (state + shift) - solution(state - shift) @ (state - shift)) / (2 * step)
            for shift in step * np.eye(2)
        ]
        asymmetries[name] = abs(columns[0][1] - columns[1][0])
        control = sdre.regulator(system.x, system.A0, system.A, system.B, system.Q, system.R)(state, 0.0)
        optimal = theta_d_benchmarks.exact(name, state).control[0]
        if name == "rational":
            np.testing.assert_allclose(control, optimal, rtol=1e-10)
        else:
            assert abs(control[0] - optimal[0]) > 1e-2
    assert asymmetries["rational"] < 1e-8
    assert asymmetries["rational_split"] > 1e-2


def test_perturbed_weight_may_be_indefinite():
    """Property 5, scenario 1 at t = 0: the smallest eigenvalue of Q + D_1 + D_2."""
    linear, bilinear, column, _ = agile_aircraft.matrices()
    x = ca.SX.sym("x", 5)
    scenario = agile_aircraft.regulation("rad")
    built = theta_d.expansion(x, linear, x[1] * ca.DM(bilinear), column, scenario.Q, scenario.R, k=1.0, l=0.01)
    perturbed = scenario.Q + sum(call(built.perturbations, scenario.start, 0.0))
    assert np.linalg.eigvalsh(perturbed)[0] == pytest.approx(-2.23e6, abs=0.005e6)


# --- filter -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("terms", [1, 2, 3, 4])
def test_corrected_filter_has_a_residual_of_high_order_and_the_printed_one_of_first(terms):
    direction = FIRST + SECOND
    sizes = np.array([0.02, 0.04, 0.08])
    orders = {}
    for printed in (False, True):
        built = theta_d.filter_expansion(X, A0, X[0] * ca.DM(direction), H, W, V, terms=terms, printed=printed)
        errors = [
            np.abs(residual(call(built.sum, [size, 0.0, 0.0], 0.0), (A0 + size * direction).T, H.T, W, V)).max()
            for size in sizes
        ]
        orders[printed] = slope(sizes, errors)
    assert orders[False] == pytest.approx(terms, abs=0.2)
    assert orders[True] == pytest.approx(1.0, abs=0.2)


def test_filter_is_the_regulator_of_the_dual():
    found = theta_d.filter_gain(X, A0, A, H, W, V, terms=4, k=[0.2, 0.5, 1.0], l=[0.1, 0.0, 2.0])
    dual = theta_d.expansion(X, A0.T, A.T, H.T, W, V, terms=4, k=[0.2, 0.5, 1.0], l=[0.1, 0.0, 2.0])
    for state in STATES:
        np.testing.assert_allclose(call(found, state, 0.7), call(dual.gain, state, 0.7).T, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("units", ["rad", "deg"])
def test_corrected_filter_tends_to_the_riccati_filter_and_the_printed_one_does_not(units):
    """k = 0, 10 deg: within the radius. The printed P is even indefinite there."""
    linear, bilinear, _, measured = agile_aircraft.matrices()
    scenario = agile_aircraft.regulation(units)
    x = ca.SX.sym("x", 5)
    arguments = (x, linear, x[1] * ca.DM(bilinear), measured, scenario.W, scenario.V)
    state = np.array([0.0, np.deg2rad(10.0), 0.0, 0.0, 0.0])
    wanted = sdre.filter_gain(*arguments)(state, 0.0)
    errors = [
        np.abs(call(theta_d.filter_gain(*arguments, terms=terms), state, 0.0) - wanted).max()
        for terms in (1, 4, 8, 16, 32)
    ]
    assert np.all(np.diff(errors) < 0)
    assert errors[-1] < 1e-7 * np.abs(wanted).max()
    printed = [
        np.abs(call(theta_d.filter_gain(*arguments, terms=terms, printed=True), state, 0.0) - wanted).max()
        for terms in (3, 8)
    ]
    assert min(printed) > 0.1 * errors[0]
    sums = [call(theta_d.filter_expansion(*arguments, printed=printed).sum, state, 0.0) for printed in (False, True)]
    assert np.linalg.eigvalsh(sums[0])[0] > 0.0
    assert np.linalg.eigvalsh(sums[1])[0] < -0.1


# --- servo ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("units", "gain"), [("rad", np.sqrt(20.0)), ("deg", np.sqrt(20.0) * 180.0 / np.pi)])
def test_gain_on_the_integral_is_the_same_for_every_angle(units, gain):
    """Section 4: sqrt(q_I/R) for every frozen angle, and no correction contributes."""
    linear, bilinear, column, _ = agile_aircraft.matrices()
    scenario = agile_aircraft.tracking(units)
    x = ca.SX.sym("x", 5)
    output = [0.0, 0.0, 0.0, 1.0, 0.0]
    whole, constant, rest, extended = theta_d.integral_states(x, linear, x[1] * ca.DM(bilinear), column, output)
    built = theta_d.expansion(whole, constant, rest, extended, scenario.Q, scenario.R, terms=4)
    solution = sdre.solution(whole, constant, rest, extended, scenario.Q, scenario.R)
    for angle in (0.2, 0.9, 1.4):  # deg, within the radius of 1.5356 deg
        state = np.array([0.0, np.deg2rad(angle), 0.0, 0.0, 0.0, 0.0])
        assert call(built.gain, state, 0.0)[0, 5] == pytest.approx(gain, rel=1e-9)
        exact = (extended.T @ solution(state) / scenario.R)[0]
        assert exact[5] == pytest.approx(gain, rel=1e-9)
        for term in call(built.terms, state, 0.0)[1:]:
            contribution = (extended.T @ term / scenario.R)[0]
            assert abs(contribution[5]) < 1e-9 * gain
    beyond = np.array([0.0, np.deg2rad(1.6), 0.0, 0.0, 0.0, 0.0])  # near the singularity: digits are lost
    assert (extended.T @ solution(beyond) / scenario.R)[0, 5] == pytest.approx(-gain, rel=1e-6)


def test_servo_is_the_regulator_of_the_error_with_the_gain_at_the_state():
    system = X, A0, A, B, [0.0, 1.0, 0.0]
    weights = np.diag([1.0, 2.0, 0.5, 3.0]), R
    law = theta_d.servo(*system, *weights, terms=3, k=0.3, l=0.1)
    built = theta_d.expansion(*theta_d.integral_states(*system), *weights, terms=3, k=0.3, l=0.1)
    state, reference = np.append(STATES[0], 0.4), np.array([0.0, 1.0, 0.0, 2.0])
    gain = call(built.gain, state, 1.5)
    np.testing.assert_allclose(call(law, state, 1.5, reference).ravel(), -gain @ (state - reference), rtol=1e-13)


def test_integral_states_integrate_the_output():
    whole, constant, rest, column = theta_d.integral_states(X, A0, A, B, H)
    rate = ca.Function("rate", [whole], [(constant + rest) @ whole])(np.append(STATES[1], [3.0, 4.0])).full().ravel()
    np.testing.assert_allclose(rate[:3], (A0 + value_of_A(STATES[1])) @ STATES[1], rtol=1e-14)
    np.testing.assert_allclose(rate[3:], H @ STATES[1], rtol=1e-14)
    np.testing.assert_array_equal(column, np.vstack([B, np.zeros((2, 2))]))


# --- what the law is --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["polynomial", "operator"])
def test_laws_are_scalar_graphs(form):
    laws = [
        theta_d.regulator(X, A0, A, B, Q, R, terms=4, k=0.5, l=0.1, form=form),
        theta_d.filter_gain(X, A0, A, H, W, V, terms=4, k=0.5, l=0.1, form=form),
        theta_d.servo(X, A0, A, B, [1.0, 0.0, 0.0], np.eye(4), R, k=0.5, l=0.1, form=form),
    ]
    for law in laws:
        assert law.is_a("SXFunction")
        expanded = law.expand()
        arguments = [np.resize(STATES[0], law.size1_in(i)) for i in range(law.n_in())]
        np.testing.assert_array_equal(call(law, *arguments), call(expanded, *arguments))
        assert (law.name_in(0), law.name_in(1)) == ("x", "t")


def test_law_of_mx_is_that_of_sx():
    x = ca.MX.sym("x", 3)
    rest = ca.sin(x[0]) * ca.DM(FIRST) + x[1] * x[2] * ca.DM(SECOND)
    found = theta_d.regulator(x, A0, rest, B, Q, R, k=0.5, l=0.1)
    wanted = theta_d.regulator(X, A0, A, B, Q, R, k=0.5, l=0.1)
    for state in STATES:
        np.testing.assert_allclose(call(found, state, 0.3), call(wanted, state, 0.3), rtol=1e-13)


@pytest.mark.needs_cc
@pytest.mark.parametrize("form", ["polynomial", "operator"])
def test_law_in_c(form, tmp_path):
    law = theta_d.regulator(X, A0, A, B, Q, R, terms=4, k=0.5, l=0.1, form=form)
    generator = ca.CodeGenerator("law")
    generator.add(law)
    source = generator.generate(f"{tmp_path}/")
    subprocess.run(["cc", "-O1", "-fPIC", "-shared", source, "-o", f"{tmp_path}/law.so", "-lm"], check=True)
    ctypes.CDLL(f"{tmp_path}/law.so")
    compiled = ca.external(law.name(), f"{tmp_path}/law.so")
    for state in STATES:
        np.testing.assert_allclose(call(compiled, state, 0.3), call(law, state, 0.3), rtol=1e-13)


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": ca.SX.sym("x", 2)}, "'x' is not the state"),
        ({"x": X[0] + X}, "'x' is not the state"),
        ({"x": 1.0}, "'x' is not the state"),
        ({"A0": np.ones((3, 2))}, "'A0'"),
        ({"A0": ca.SX.sym("a", 3, 3)}, "'A0'"),
        ({"A": X}, "'A'"),
        ({"A": ca.SX.sym("p") * ca.DM(FIRST)}, "the symbols p"),
        ({"A": ca.MX.sym("p") * ca.DM(FIRST)}, "of type MX"),
        ({"B": np.ones((2, 1))}, "'B'"),
        ({"B": np.full((3, 1), np.nan)}, "'B'"),
        ({"Q": np.diag([1.0, -1.0, 1.0])}, "'Q'"),
        ({"Q": np.diag([1.0, 1.0, 1.0]) + np.eye(3, k=1)}, "'Q'"),
        ({"R": np.zeros((2, 2))}, "'R'"),
        ({"R": 1.0}, "'R'"),
        ({"terms": 0}, "'terms'"),
        ({"terms": 2.5}, "'terms'"),
        ({"terms": True}, "'terms'"),
        ({"k": [0.0, 0.0, 0.0]}, "'k'"),
        ({"k": np.nan}, "'k'"),
        ({"k": ca.SX.sym("k")}, "'k'"),
        ({"l": -0.1}, "'l'"),
        ({"l": [0.1]}, None),
        ({"form": "matrix"}, "'form'"),
    ],
)
def test_bad_arguments_are_named(change, message):
    arguments = {"x": X, "A0": A0, "A": A, "B": B, "Q": Q, "R": R, **change}
    if message is None:
        theta_d.regulator(**arguments)
        return
    with pytest.raises(co.ProblemError, match=message):
        theta_d.regulator(**arguments)


def test_modes_out_of_reach_are_named():
    a = np.diag([-1.0, 0.5, -2.0])
    with pytest.raises(co.ProblemError, match=r"\(A0, B\) is not stabilisable[^$]*the mode 0\.5"):
        theta_d.regulator(X, a, A, [1.0, 0.0, 1.0], Q, 1.0)
    with pytest.raises(co.ProblemError, match=r"\(A0, Q\^1/2\) is not detectable[^$]*the mode 0\.5"):
        theta_d.regulator(X, a, A, np.ones(3), np.diag([1.0, 0.0, 1.0]), 1.0)
    with pytest.raises(co.ProblemError, match=r"\(A0, H\) is not detectable[^$]*the mode 0\.5"):
        theta_d.filter_gain(X, a, A, [1.0, 0.0, 1.0], W, 1.0)
    with pytest.raises(co.ProblemError, match=r"\(A0, W\^1/2\) is not stabilisable[^$]*the mode 0\.5"):
        theta_d.filter_gain(X, a, A, np.ones(3), np.diag([1.0, 0.0, 1.0]), 1.0)
    with pytest.raises(co.ProblemError, match="no solution at x"):
        sdre.solution(X, a, A, [1.0, 0.0, 1.0], Q, 1.0)(np.zeros(3))


def test_factorisation_is_checked_at_states():
    f = ca.DM(A0) @ X + A @ X
    theta_d.check_factorisation(X, A0, A, f)
    theta_d.check_factorisation(X, A0, A, lambda x: ca.DM(A0) @ x + A @ x)
    with pytest.raises(co.ProblemError, match=r"casadi\.sin and its like in place of math\.sin"):
        theta_d.check_factorisation(X, A0, A, lambda x: ca.vertcat(math.sin(x[0]), x[1], x[2]))
    with pytest.raises(co.ProblemError, match=r"component 1 of f[^$]*at x = \("):
        theta_d.check_factorisation(X, A0, A, f + ca.vertcat(0.0, 1e-6 * X[2] ** 2, 0.0))
    away = ca.vertcat(0.0, ca.fmax(X[0] - 50.0, 0.0), 0.0)
    theta_d.check_factorisation(X, A0, A, f + away)
    with pytest.raises(co.ProblemError, match="component 1"):
        theta_d.check_factorisation(X, A0, A, f + away, states=[[60.0, 0.0, 0.0]])
    with pytest.raises(co.ProblemError, match="finite"):
        theta_d.check_factorisation(X, A0, A, f, states=np.empty((0, 3)))
    with pytest.raises(co.ProblemError, match="'states'"):
        theta_d.check_factorisation(X, A0, A, f, states=np.ones((4, 2)))
    with pytest.raises(co.ProblemError, match="'f'"):
        theta_d.check_factorisation(X, A0, A, X[0])


def test_benchmarks_are_factored_rightly():
    for name in ("cubic", "two_inputs", "rational", "rational_split"):
        system = theta_d_benchmarks.system(name)
        x = system.x
        w = 1.0 + 0.5 * x[0] ** 2
        f = {
            "cubic": lambda x: x - x**3,
            "two_inputs": lambda x: ca.vertcat(x[0] - x[0] ** 3 + x[1], x[0] + x[0] ** 2 * x[1] - x[1]),
            "rational": lambda x: ca.vertcat(
                x[1],
                0.5 * w * x[1] - (0.5 * x[1] + x[0] + 0.5 * x[0] * x[1] ** 2) / w,  # noqa: B023
            ),
        }[name.removesuffix("_split")]
        theta_d.check_factorisation(x, system.A0, system.A, f)


@pytest.mark.parametrize("state", [[0.4], 0.4, [0.4, 0.4, 0.4], np.ones((3, 2)), [np.nan, 1.0]])
def test_state_dependent_laws_check_the_state(state):
    """One number would stand for all the components, and NaN would look like a pair that is not stabilisable."""
    x = ca.SX.sym("x", 2)
    A0, A = np.array([[0.0, 1.0], [-1.0, -0.2]]), ca.blockcat([[0, 0], [ca.sin(x[0]), x[1] ** 2]])
    with pytest.raises(co.ProblemError, match="'state'"):
        sdre.regulator(x, A0, A, [0.0, 1.0], np.eye(2), 1.0)(state, 0.0)
    with pytest.raises(co.ProblemError, match="'state'"):
        sdre.solution(x, A0, A, [0.0, 1.0], np.eye(2), 1.0)(state)
    with pytest.raises(co.ProblemError, match="'estimate'"):
        sdre.filter_gain(x, A0, A, [1.0, 0.0], np.eye(2), 1.0)(state, 0.0)


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-6])
def test_functions_that_differ_in_small_states_are_not_joined(unit):
    """Two saturations of different width: beyond it they are the same number."""
    x = ca.SX.sym("x", 2)
    A0 = np.array([[0.0, 1.0], [-1.0, -0.2]])
    A = ca.blockcat([[0, 0], [ca.tanh(x[0] / unit), ca.tanh(3 * x[0] / unit)]])
    laws = [theta_d.regulator(x, A0, A, [0.0, 1.0], np.eye(2), 1.0, form=f) for f in ("polynomial", "operator")]
    state = np.array([0.3, 0.1]) * unit
    assert float(laws[0](state, 0)) == pytest.approx(float(laws[1](state, 0)), rel=1e-12)


@pytest.mark.parametrize("unit", [1e-19, 1.0, 1e12, 1e19])
def test_forms_agree_in_every_unit_of_the_state(unit):
    """1 / (1 + x / unit) is no constant, whatever it looks like at states of the order of 1."""
    x = ca.SX.sym("x", 2)
    A, state = ca.diag(ca.vertcat(-1 / (1 + x[0] / unit), -1)), [3.0 * unit, unit]
    arguments = x, [[0, 1], [0, 0]], A, np.eye(2), np.eye(2), np.eye(2)
    plain = theta_d.expansion(*arguments, form="operator", terms=3).sum(state, 0.0).full()
    for form in ("auto", "polynomial"):
        found = theta_d.expansion(*arguments, form=form, terms=3).sum(state, 0.0).full()
        np.testing.assert_allclose(found, plain, rtol=1e-12)


def test_dependence_is_still_seen_where_entries_change_fast():
    """sin(2 x) = 2 sin(x) cos(x) at states of any size; the rounding of a large sum makes no difference of it."""
    x = ca.SX.sym("x", 2)
    A = ca.SX(2, 2)
    A[0, 0], A[0, 1], A[1, 0], A[1, 1] = ca.sin(2 * x[0]), ca.sin(x[0]) * ca.cos(x[0]), x[1] / 57.3, x[1]
    functions, _ = theta_d_series.separated(x, A)
    assert len(functions) == 2
