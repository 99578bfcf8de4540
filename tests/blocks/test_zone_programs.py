"""The small programs of attitude guidance: against the matrix inequality, other solvers, and optimality conditions."""

from __future__ import annotations

from functools import cache
from itertools import product

import casadi as ca
import numpy as np
import pytest
from attitude_programs import Case, Literal, Reduced, random_case, unit
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, SEEDS
from scipy.optimize import nnls

from covocp.blocks import so3
from covocp.blocks.zone_programs import Rows, box_problem, projection, projection_by_solver, reduced
from covocp.blocks.zones import zone_rows, zones_of

ZONES = [((1, 0, 0), (0.3, 1, -0.5), 20.0, "exclusion"), ((0, 1, 0), (-1, 0, 0), 20.0, "inclusion")]
START = so3.principal(2, np.radians(60.0)) @ so3.principal(3, np.radians(20.0))


@cache
def reduction_function(rows, curvature):
    """The reduction of so many rows as a function of estimate, covariance, A, beta, kappa, penalty and largest step."""
    symbols = ca.SX.sym("b", 3), ca.SX.sym("P", 3, 3), ca.SX.sym("A", rows, 3), ca.SX.sym("beta", rows)
    b, P, A, beta = symbols
    options = {name: ca.SX.sym(name) for name in ("kappa", "penalty", "largest_step")}
    found = reduced(b, P, Rows(A, beta), **options, curvature=curvature)
    return ca.Function("reduction", [*symbols, *options.values()], list(found))


def reduction(case, *, curvature=False):
    """b, lambda, mu, zeta of a case."""
    function = reduction_function(len(case.beta), curvature)
    numbers = (case.estimate, case.covariance, case.A, case.beta, case.kappa, case.penalty, case.largest_step)
    return [np.ravel(part.full()) for part in function.call([ca.DM(v) for v in numbers])]


def cost(case, b, zeta):
    """That of section 7, with the value of the SDP in front."""
    e = b - case.estimate
    return 0.5 * case.surprise + 0.5 * e @ np.linalg.solve(case.covariance, e) + case.penalty * zeta.sum()


def printed_case(attitude, largest_step):
    """Section 13."""
    A, beta = zone_rows(attitude, zones_of(ZONES))
    H = np.array([[0.1, 0, 0], [0, 0.1, 0.05], [0.05, -0.05, 0.1]])
    before = np.array([1.0, -1.0, 0.5])
    residual = np.array([0.2, -0.15, 0.3]) - H @ before
    return Case(H, 0.001 * np.eye(3), np.eye(3), before, residual, A, beta.ravel(), 0.15, 1e5, largest_step)


LATER = so3.exp(np.array([0.1, 0.05, -0.1])) @ so3.principal(3, np.radians(72.0))
PRINTED = [
    (START, 0.25, (-1.4408761589, -0.0040950145, 0.8376376921), 8436.3335, 0.3627511, 36397.6624, 7.4209519),
    (LATER, 0.25, (1.0409652984, -1.0385341007, 0.7846119722), 13.8439136, 0.0, 15.1960809, 1.0355057),
    (LATER, 0.60, (1.9169302220, -1.9413092181, 1.0279591235), 0.0, 0.0, 1.0729014, 0.2541500),
]


@pytest.mark.parametrize(("attitude", "largest_step", "b", "multiplier", "slack", "value", "trace"), PRINTED)
def test_reference_values_of_the_reduction(attitude, largest_step, b, multiplier, slack, value, trace):
    case = printed_case(attitude, largest_step)
    found, bound, _, zeta = reduction(case)
    np.testing.assert_allclose(case.estimate, (1.9437086093, -1.9363502575, 0.9838116262), atol=1e-10)
    assert np.trace(case.covariance) == pytest.approx(0.2528820, abs=1e-7)
    np.testing.assert_allclose(found, b, atol=1e-6)
    assert bound[0] == pytest.approx(multiplier, rel=1e-6, abs=1e-6)
    assert zeta.max() == pytest.approx(slack, abs=1e-6)
    assert cost(case, found, zeta) == pytest.approx(value, rel=1e-6)
    e = found - case.estimate
    assert np.trace(case.covariance + np.outer(e, e) / case.surprise) == pytest.approx(trace, rel=1e-6)


def test_reference_values_of_zones_and_projection():
    A, beta = zone_rows(START, zones_of(ZONES))
    expected = [[0, 0.2508133447, -0.7231326640], [-0.8137976813, 0, 0.4698463104]]
    np.testing.assert_allclose(A, expected, atol=1e-10)
    np.testing.assert_allclose(-beta.ravel(), (0.2961308, -0.5976725), atol=5e-8)
    kappa = 0.15
    step = kappa * np.ravel(ca.evalf(projection(ca.SX.zeros(3, 1), Rows(ca.DM(A), ca.DM(beta)), kappa)).full())
    np.testing.assert_allclose(step, (-0.5508179347, 0, 0.3180148829), atol=1e-10)
    after = so3.exp(step) @ START
    values = [zone.value(after) for zone in zones_of(ZONES)]
    np.testing.assert_allclose(values, (0.1340552401, -0.1063676715), atol=1e-10)


def test_zones_at_the_peak_hold_from_70_to_110_degrees():
    for angle in (69.9, 70.1, 90.0, 109.9, 110.1):
        C = so3.principal(3, np.radians(angle))
        assert all(zone.value(C) >= 0 for zone in zones_of(ZONES)) == (70.0 <= angle <= 110.0)


def test_reduction_solves_the_matrix_inequality():
    """100 random cases by a semidefinite solver at 1e-10: b to 2e-4, the value to 3e-6."""
    for seed in range(100):
        case = random_case(seed)
        K, value, status = Literal(case).solve()
        b, _, _, zeta = reduction(case)
        assert "Solved" in status
        np.testing.assert_allclose(b, case.before + K @ case.residual, atol=2e-4)
        assert cost(case, b, zeta) == pytest.approx(value, rel=3e-6)


def least_gain(case, b):
    """K of theorem 2."""
    weighted = np.linalg.solve(case.innovation, case.residual)
    return case.gain + np.outer(b - case.estimate, weighted) / case.surprise


@pytest.mark.parametrize("seed", range(8))
def test_regularised_gain_is_that_of_theorem_2(seed):
    """Where no zone is missed the regularised inequality has the same b, and one gain only."""
    case = random_case(seed)._replace(beta=np.array([-0.1, -0.2]))
    K, _, _ = Literal(case, regular=case.surprise).solve()
    b = reduction(case)[0]
    np.testing.assert_allclose(K, least_gain(case, b), atol=2e-4)


@FIXED
@given(seed=SEEDS)
def test_gain_of_theorem_2_has_the_least_covariance(seed):
    """Against 25 random gains in each of 40 cases with the same K r; P(K) by Joseph's form."""
    case, generator = random_case(seed), np.random.default_rng(seed)
    b = reduction(case)[0]
    K, e = least_gain(case, b), b - case.estimate
    least = case.covariance + np.outer(e, e) / case.surprise
    np.testing.assert_allclose(K @ case.residual, b - case.before, atol=1e-9)
    np.testing.assert_allclose(case.spread(K), least, atol=1e-9 * np.abs(least).max())
    for _ in range(25):
        other = generator.standard_normal(K.shape)
        other -= np.outer(other @ case.residual, case.residual) / (case.residual @ case.residual)
        assert np.linalg.eigvalsh(case.spread(K + other) - least)[0] >= -1e-9 * np.abs(other).max() ** 2


@FIXED
@given(seed=SEEDS, rows=st.integers(0, 3), penalty=st.sampled_from([1.0, 100.0, 1e5]))
def test_optimality_conditions_of_the_reduction(seed, rows, penalty):
    """Stationarity, signs and complementarity for any number of rows, to the tolerance of the bisection."""
    case = random_case(seed, rows)._replace(penalty=penalty)
    b, multiplier, mu, zeta = reduction(case)
    information, radius = np.linalg.inv(case.covariance), case.largest_step / case.kappa
    pull = case.kappa * case.A.T @ mu if rows else np.zeros(3)
    scale = np.abs(information @ case.estimate).max() + np.abs(pull).max() + multiplier[0] * radius
    residual = information @ (b - case.estimate) + multiplier[0] * b - pull
    assert np.abs(residual).max() <= 1e-7 * scale
    assert np.linalg.norm(b) <= radius * (1 + 1e-12)
    assert multiplier[0] * (radius - np.linalg.norm(b)) <= 1e-7 * scale
    assert (mu >= 0).all()
    assert (mu <= penalty).all()
    left = case.kappa * case.A @ b - case.beta + zeta if rows else np.zeros(0)
    assert (left >= -1e-12).all()
    assert (np.abs(mu * left) <= 1e-6 * scale).all()
    assert (np.abs((penalty - mu) * zeta) <= 1e-6 * max(scale, penalty * 1e-3)).all()


def test_reduction_agrees_with_the_cone_program():
    for seed in range(100, 140):
        case = random_case(seed)
        np.testing.assert_allclose(reduction(case)[0], Reduced(case).solve()[0], atol=2e-5)


@FIXED
@given(seed=SEEDS, count=st.integers(1, 3), bounded=st.booleans())
def test_box_problem_is_the_best_of_a_grid_and_meets_its_conditions(seed, count, bounded):
    generator = np.random.default_rng(seed)
    root = generator.standard_normal((count, count))
    G, g = root @ root.T + 0.01 * np.eye(count), 3.0 * generator.standard_normal(count)
    limits = generator.uniform(0.1, 2.0, count) if bounded else None
    most = None if limits is None else ca.DM(limits)
    mu = np.ravel(ca.evalf(box_problem(ca.SX(ca.DM(G)), ca.SX(ca.DM(g)), most)).full())
    slope = G @ mu - g
    top = np.full(count, np.inf) if limits is None else limits
    for value, rate, most in zip(mu, slope, top, strict=True):
        assert 0 <= value <= most
        assert rate >= -1e-9 or value == most
        assert rate <= 1e-9 or value == 0


def test_rows_that_are_the_same_twice_do_no_harm():
    """Singular G: two identical zones are one."""
    A, beta = zone_rows(START, zones_of(ZONES))
    twice = Rows(ca.DM(np.vstack([A, A[1:]])), ca.DM(np.vstack([beta, beta[1:]])))
    once = Rows(ca.DM(A), ca.DM(beta))
    b = ca.SX(ca.DM([1.0, -2.0, 0.5]))
    first, second = (np.ravel(ca.evalf(projection(b, rows, 0.05)).full()) for rows in (once, twice))
    np.testing.assert_allclose(first, second, atol=1e-9)


@pytest.mark.parametrize("seed", range(30))
def test_enumeration_and_solver_project_alike(seed):
    """Also of the violated rows not all are active in the end: the paper's choice would be wrong (erratum)."""
    generator = np.random.default_rng(seed)
    count = 1 + seed % 3
    A = np.cross(unit(generator.standard_normal((count, 3))), unit(generator.standard_normal((count, 3))))
    beta, b = generator.uniform(-0.2, 0.2, count), 3.0 * generator.standard_normal(3)
    enumerated = ca.evalf(projection(ca.SX(ca.DM(b)), Rows(ca.DM(A), ca.DM(beta)), 0.05)).full()
    x = ca.MX.sym("b", 3)
    solved = ca.Function("solved", [x], [projection_by_solver(x, ca.MX(ca.DM(A)), ca.MX(ca.DM(beta)), 0.05)])(b)
    np.testing.assert_allclose(enumerated, solved.full(), atol=1e-6)


def nearest(A, beta, wanted):
    """The nearest vector with A d >= beta by Lawson and Hanson's least distance programming; None: there is none."""
    rest = beta - A @ wanted
    matrix = np.vstack([A.T, rest / np.abs(rest).max()])
    found = nnls(matrix, np.array([0.0, 0.0, 0.0, 1.0]))[0]
    residual = matrix @ found - np.array([0.0, 0.0, 0.0, 1.0])
    return None if np.linalg.norm(residual) < 1e-7 else wanted - np.abs(rest).max() * residual[:3] / residual[3]


@cache
def solver_of(rows, kappa):
    symbols = ca.MX.sym("b", 3), ca.MX.sym("A", rows, 3), ca.MX.sym("beta", rows)
    return ca.Function("solved", list(symbols), [projection_by_solver(*symbols, kappa)])


@pytest.mark.parametrize("power", [1e-12, 1e-3, 1.0, 1e3, 1e9])
def test_solver_projects_alike_in_every_unit_of_power(power):
    """Of b as given, tolerances decided: in mW the step was of 1e5 rad, in units of 1e9 W none."""
    generator, seen = np.random.default_rng(3), 0
    for trial in range(40):
        count = 2 + trial % 7
        A = np.cross(unit(generator.standard_normal((count, 3))), unit(generator.standard_normal((count, 3))))
        A[1] = A[0] if trial % 3 == 0 else A[1]  # twice the same
        beta = A @ (0.3 * generator.standard_normal(3)) - generator.uniform(0.0, 0.2, count)
        wanted = 0.3 * generator.standard_normal(3)
        expected = nearest(A, beta, wanted)
        found = np.ravel(solver_of(count, 0.05 / power)(wanted * power / 0.05, A, beta).full()) * 0.05 / power
        np.testing.assert_allclose(found, expected, atol=1e-6)
        seen += np.abs(expected - wanted).max() > 1e-3
    assert seen > 20


def test_rows_that_contradict_one_another_move_no_further_than_one_of_them_wants():
    """Four, two against two; and an axis opposite to its cone, whose row is nothing but rounding."""
    against = np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0], [-0.5, 0, 0]])
    found = np.ravel(solver_of(4, 0.05)([0.0, 2.0, 0.0], against, [0.3, 0.2, 0.1, 0.1]).full())
    np.testing.assert_allclose(0.05 * found, [0.3, 0.1, 0.0], atol=1e-9)
    opposite = so3.exp(np.array([0.4, -0.7, 0.2]))
    A, beta = zone_rows(opposite, zones_of([((0, 1, 0), -opposite.T @ [0.0, 1.0, 0.0], 20.0, "inclusion")]))
    A = A + 1e-17
    wanted = np.array([1.0, 2.0, 3.0])
    enumerated = ca.evalf(projection(ca.SX(ca.DM(wanted)), Rows(ca.DM(A), ca.DM(beta)), 0.05)).full()
    np.testing.assert_allclose(np.ravel(enumerated), wanted, rtol=1e-12)
    np.testing.assert_allclose(np.ravel(solver_of(1, 0.05)(wanted, A, beta).full()), wanted, rtol=1e-12)


def test_solver_writes_nothing_to_the_console(capfd):
    for wanted in ([1.0, -2.0, 0.5], [0.0, 0.0, 0.0], [-30.0, 0.0, 0.0]):
        solver_of(4, 0.05)(wanted, np.vstack([np.eye(3), np.ones(3)]), -0.1 * np.ones(4))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["projection", "reduction"])
def test_quadratic_condition_keeps_the_zone_itself(kind):
    """From attitudes within the zones: A d - |d|^2/2 >= beta, and x'Cy >= cos(alpha) after the step."""
    zones = zones_of(ZONES)
    b, C = ca.SX.sym("b", 3), ca.SX.sym("C", 3, 3)
    rows = zone_rows(C, zones)
    if kind == "projection":
        found = projection(b, rows, 0.05, curvature=True)
    else:
        options = {"kappa": 0.05, "penalty": 1e5, "largest_step": 0.25, "curvature": True}
        found = reduced(b, ca.SX.eye(3), rows, **options).gradient
    law = ca.Function("law", [b, C], [found])
    generator = np.random.default_rng(0)
    seen = 0
    while seen < 60:
        attitude = so3.exp(0.3 * generator.standard_normal(3)) @ so3.principal(3, generator.uniform(1.2, 1.95))
        if min(zone.value(attitude) for zone in zones) < 0:
            continue
        seen += 1
        gradient = 4.0 * generator.standard_normal(3)
        step = 0.05 * np.ravel(law(gradient, attitude).full())
        A, beta = zone_rows(attitude, zones)
        assert (A @ step - 0.5 * step @ step - beta.ravel()).min() >= -1e-9
        assert min(zone.value(so3.exp(step) @ attitude) for zone in zones) >= -1e-9
        # no worse than the best of random steps that keep it
        best = np.inf
        for trial in step + 0.02 * generator.standard_normal((200, 3)):
            if kind == "reduction" and trial @ trial > 0.25**2:
                continue
            if (A @ trial - 0.5 * trial @ trial - beta.ravel()).min() >= 0:
                best = min(best, np.sum((trial / 0.05 - gradient) ** 2))
        assert np.sum((step / 0.05 - gradient) ** 2) <= best * (1 + 1e-9)


def test_remainder_of_a_zone_is_at_most_half_the_square_of_the_step():
    generator = np.random.default_rng(1)
    for _ in range(200):
        x, z = unit(generator.standard_normal((2, 3)))
        d = generator.standard_normal(3)
        assert abs(x @ so3.exp(d) @ z - x @ z - np.cross(x, z) @ d) <= 0.5 * d @ d + 1e-15


@pytest.mark.parametrize("curvature", [False, True])
def test_programs_without_rows(curvature):
    case = random_case(0, rows=0)._replace(largest_step=10.0)
    np.testing.assert_allclose(reduction(case, curvature=curvature)[0], case.estimate, rtol=1e-9)


def test_candidates_of_all_active_sets_are_gone_through():
    """Three rows, each of three kinds: the solution of a diagonal problem is known for each."""
    for kinds in product((-1.0, 0.5, 3.0), repeat=3):
        mu = np.ravel(ca.evalf(box_problem(ca.SX.eye(3), ca.SX(ca.DM(kinds)), ca.DM.ones(3, 1))).full())
        np.testing.assert_allclose(mu, np.clip(kinds, 0.0, 1.0))
