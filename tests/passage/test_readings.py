"""Readings inside the compiled passage: against plain Kalman updates by CasADi, their derivatives, exact limits."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from derivatives import tangents_of
from sampled import random_system

import covocp as co
from covocp.base.linear_solve import LINEAR_SOLVER, linear_solve
from covocp.base.matrices import half_length, pack, pack_symbolic, unpack, unpack_symbolic
from covocp.base.quadrature import gauss_matrix, riccati_step
from covocp.passage import library
from covocp.passage.sweep import Told, depends, entries_of, passed_by
from covocp.transcription import shooting

pytestmark = pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))

STEPS = 7
# Places of the readings: at the start, two at one instant, at the end; and of the Gauss steps between them.
READS = (0, 3, 4, 6)
MOVES = tuple(k for k in range(STEPS) if k not in READS)


def numbers(n: int, rows: int, seed: int) -> list[np.ndarray]:
    """Half-vector at the start, h H at both points, what is read: columns of M by rows and half-vector of R."""
    rng = np.random.default_rng(seed)

    def step() -> np.ndarray:
        F, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, 2)), rng.normal(size=(2, n))
        return 0.05 * np.block([[-F.T, C.T @ C], [B @ B.T, F]])

    A, told = rng.normal(size=(n, n)), []
    for _ in READS:
        M, root = rng.normal(size=(rows, n)), rng.normal(size=(rows, rows))
        told.append(np.append(M.ravel(), pack(root @ root.T + 0.1 * np.eye(rows))))
    points = [np.hstack([step() for _ in MOVES]) for _ in range(2)]
    return [pack(A @ A.T + np.eye(n)), *points, np.array(told).T]


def node(n: int, rows: int, passing=passed_by) -> tuple[list[ca.MX], ca.MX]:
    """Arguments and result of the compiled passage, kicks among them."""
    shapes = [(half_length(n), 1), *[(2 * n, 2 * n * len(MOVES))] * 2, (rows * n + half_length(rows), len(READS))]
    arguments = [ca.MX.sym(f"a{i}", *shape) for i, shape in enumerate([*shapes, (half_length(n), STEPS)])]
    told = Told(steps=READS, rows=rows, columns=arguments[3])
    return arguments, passing(arguments[0], entries_of(arguments[1:3], n), arguments[4], told)


def by_casadi(n: int, rows: int, arguments: list[ca.MX]) -> ca.MX:
    """The same by CasADi's operations: E+ = E - E M' (M E M' + R)^-1 M E, not in Joseph's form."""
    first, h1, h2, told, kicks = arguments
    e, values = first, []
    for k in range(STEPS):
        E = unpack_symbolic(e, n)
        if k in READS:
            own = told[:, READS.index(k)]
            M, R = ca.reshape(own[: rows * n], n, rows).T, unpack_symbolic(own[rows * n :], rows)
            after = E - E @ M.T @ ca.inv(M @ E @ M.T + R) @ M @ E
        else:
            span = slice(2 * n * MOVES.index(k), 2 * n * (MOVES.index(k) + 1))
            D = gauss_matrix((h1[:, span], h2[:, span]), n, LINEAR_SOLVER)
            after = unpack_symbolic(
                pack_symbolic(riccati_step(D, E, lambda a, b: linear_solve(a, b, LINEAR_SOLVER))), n
            )
        e = pack_symbolic(after) + kicks[:, k]
        values.append(e)
    return ca.horzcat(*values)


@pytest.mark.parametrize("asked", ["last entry", "all"])
@pytest.mark.parametrize(("n", "rows"), [(1, 1), (3, 1), (3, 2), (2, 3), (8, 1), (12, 2)])
def test_values_and_slopes_are_those_of_plain_updates(n, rows, asked):
    """One entry at the end has slopes of low rank; with kicks and seeds everywhere they are full."""
    rng = np.random.default_rng(n)
    weights = np.zeros((half_length(n), STEPS))
    weights[-1, -1] = 1.0
    if asked == "all":
        weights = rng.normal(size=weights.shape)
    given = [*numbers(n, rows, n), 1e-3 * rng.normal(size=weights.shape)]
    arguments, passed = node(n, rows)
    found, known = (
        ca.Function("f", arguments, [result, *(ca.gradient(ca.dot(weights, result), v) for v in arguments)])(*given)
        for result in (passed, by_casadi(n, rows, arguments))
    )
    for own, other in zip(found, known, strict=True):
        assert np.abs(np.asarray(own - other)).max() <= 1e-10 * np.abs(np.asarray(other)).max()


@pytest.mark.parametrize(("n", "rows"), [(1, 1), (3, 2), (2, 3), (6, 1)])
def test_tangents_of_values_and_slopes_are_those_of_plain_updates(n, rows):
    """Along directions of the form of H, Q and W symmetric."""
    rng = np.random.default_rng(n)
    shape = (half_length(n), STEPS)
    weights = rng.normal(size=shape)
    given = [*numbers(n, rows, n), 1e-3 * rng.normal(size=shape)]
    moved = numbers(n, rows, n + 100)
    directions = [rng.normal(size=shape[0]), *moved[1:3], rng.normal(size=moved[3].shape), rng.normal(size=shape)]
    arguments, passed = node(n, rows)
    found = []
    for result in (passed, by_casadi(n, rows, arguments)):
        value = ca.dot(weights, result) + ca.sumsqr(result) / 2
        values = [value, *(ca.gradient(value, v) for v in arguments)]
        found.append(tangents_of(values, arguments, directions, given))
    for own, other in zip(*found, strict=True):
        assert np.abs(own - other).max() <= 1e-10 * np.abs(other).max()


@pytest.mark.parametrize("variance", [1e-30, 1e-12, 1.0, 1e12])
def test_any_accuracy_in_exact_arithmetic(variance):
    """Correlated errors, a reading of the sum: by fractions; what is left stays semidefinite, and keeps its digits."""
    E, M = [[Fraction(4), Fraction(1)], [Fraction(1), Fraction(3)]], [Fraction(1), Fraction(1)]
    seen = [sum(E[i][j] * M[j] for j in range(2)) for i in range(2)]
    spread = sum(m * s for m, s in zip(M, seen, strict=True)) + Fraction(variance)
    exact = np.array([[float(E[i][j] - seen[i] * seen[j] / spread) for j in range(2)] for i in range(2)])
    told = Told(steps=(0,), rows=1, columns=ca.DM([1.0, 1.0, variance]))
    found = unpack(
        np.asarray(passed_by(ca.DM([4.0, 1.0, 3.0]), entries_of([ca.DM(4, 0)] * 2, 2), None, told).full()).T, 2
    )[0]
    np.testing.assert_allclose(found, exact, rtol=1e-14)
    assert np.linalg.eigvalsh(found).min() >= -1e-15


def test_slopes_by_an_accurate_reading_keep_their_digits():
    """E+ = E R / (E + R) of one state: slopes R^2/(E + R)^2, E^2/(E + R)^2 and -2 E^2 R M/(M^2 E + R)^2."""
    e, told = ca.MX.sym("e"), ca.MX.sym("told", 2)
    passed = passed_by(e, entries_of([ca.DM(2, 0)] * 2, 1), None, Told(steps=(0,), rows=1, columns=told))
    slopes = ca.Function("f", [e, told], [ca.gradient(passed, e), ca.gradient(passed, told)])
    E, R = 3.0, 1e-12
    by_e, by_told = (np.asarray(v.full()).ravel() for v in slopes(E, [1.0, R]))
    assert by_e[0] == pytest.approx((R / (E + R)) ** 2, rel=1e-3)  # of 1 - K, which has lost twelve digits
    np.testing.assert_allclose(by_told, [-2 * E**2 * R / (E + R) ** 2, (E / (E + R)) ** 2], rtol=1e-12)


def test_rows_of_zeros_read_nothing():
    """A single row among groups of two: the same as by itself, slopes too."""
    n = 3
    first, h1, h2, told = numbers(n, 1, 5)
    wide = np.vstack(
        [told[:n], np.zeros((n, len(READS))), told[n:], np.zeros((1, len(READS))), np.ones((1, len(READS)))]
    )
    results = []
    for rows, own in ((1, told), (2, wide)):
        arguments, passed = node(n, rows)
        value = ca.sumsqr(passed)
        f = ca.Function("f", arguments, [value, ca.gradient(value, arguments[0]), ca.gradient(value, arguments[3])])
        results.append([np.asarray(v.full()) for v in f(first, h1, h2, own, np.zeros((half_length(n), STEPS)))])
    np.testing.assert_allclose(results[1][0], results[0][0], rtol=1e-14)
    np.testing.assert_allclose(results[1][1], results[0][1], rtol=1e-12)
    np.testing.assert_allclose(results[1][2][[0, 1, 2, 6]], results[0][2], rtol=1e-11, atol=1e-13)


def test_a_step_depends_on_what_was_read_before_it():
    """The pattern that CasADi is given: columns by the readings, none by later ones."""
    n, rows = 2, 1
    arguments, dependence = node(n, rows, depends)
    columns = rows * n + half_length(rows)
    pattern = np.asarray(ca.DM(ca.jacobian_sparsity(dependence, arguments[3]), 1).full()) != 0
    for k in range(STEPS):
        block = pattern[k * half_length(n) : (k + 1) * half_length(n)]
        seen = [block[:, j * columns : (j + 1) * columns].all() for j in range(len(READS))]
        assert seen == [place <= k for place in READS]
        assert not block[:, sum(seen) * columns :].any()


def test_an_instant_at_which_nothing_is_read_changes_nothing(monkeypatch):
    """Conditions have instants too; what is read elsewhere is not read there, with the library and without it."""

    def problem(pinned: bool) -> co.Problem:
        ocp = co.Problem(2.0)
        x = ocp.state("x", initial=0.0, variance=1.0)
        u = ocp.control("u", guess=0.3)
        ocp.dynamics(x, -x + u, noise=0.1 * (1 + u**2))
        ocp.measurement("fix", x * (1 + x), 0.1, at=[0.5, 1.5])
        if pinned:
            ocp.subject_to(x, upper=5.0, at=1.0)  # never active
        ocp.minimize(0.1 * (u - 1) ** 2, ocp.estimation_covariance()[x, x])
        return ocp

    options = {"intervals": 20, "progress": False}
    costs = [co.solve(problem(pinned), **options).cost for pinned in (True, False)]
    monkeypatch.setattr(shooting, "functions", lambda: None)
    costs.append(co.solve(problem(True), **options).cost)
    assert costs[0] == pytest.approx(costs[2], rel=1e-9)
    assert costs[0] == pytest.approx(costs[1], rel=1e-5)  # controls may jump at one more place


@pytest.mark.parametrize("options", [{}, {"control": "constant", "substeps": 2}])
@pytest.mark.parametrize("seed", [3, 8])
def test_a_problem_without_the_library_has_the_same_solution(monkeypatch, seed, options):
    problem = random_system(seed).problem
    fast = co.solve(problem(), intervals=20, progress=False, **options)
    monkeypatch.setattr(shooting, "functions", lambda: None)
    plain = co.solve(problem(), intervals=20, progress=False, **options)
    assert fast.cost == pytest.approx(plain.cost, rel=1e-9)
    for name in ("state", "matrices"):
        own, other = (getattr(solution.costates, name) for solution in (fast, plain))
        # where they are zero but for the tolerance of the run, 1e-7, they agree in nothing
        assert np.abs(own - other).max() <= max(1e-5 * np.abs(other).max(), 1e-8 * abs(plain.cost))


def plain_dynamics(limit: str) -> co.Problem:
    """x' = u without drift or noise, b x read once: E_bb = 1/(1 + x(1.5)^2/0.1) must fall to 0.05."""
    ocp = co.Problem(2.0)
    x = ocp.state("x", initial=0.0)
    b = ocp.unknown("b", mean=1.0, variance=1.0)
    u = ocp.control("u", guess=0.5)
    ocp.dynamics(x, u)
    ocp.measurement("m", b * x, noise=0.1, at=[1.5])
    E = ocp.estimation_covariance()[b, b]
    limits = {"variance": (E, 0.05), "logarithm": (ca.log(E), np.log(0.05)), "inverse": (-1 / E, -20.0)}
    ocp.subject_to(limits[limit][0], at="final", upper=limits[limit][1])
    ocp.minimize(running=u**2)
    return ocp


@pytest.mark.parametrize("method", ["ipopt", "reduced"])
@pytest.mark.parametrize("limit", ["variance", "logarithm", "inverse"])
def test_a_limit_on_what_only_readings_change_is_met(limit, method):
    """Where readings alone move a covariance the entries of h H are structurally zero: slopes were lost there."""
    solution = co.solve(plain_dynamics(limit), method, intervals=40, progress=False)
    assert solution.cost == pytest.approx(1.9 / 1.5, rel=1e-6)  # x(1.5)^2 = 1.9 by a constant u, nothing after it


def test_what_only_readings_change_depends_on_them():
    """The first steps move nothing: their entries are structurally zero, those after the first reading are not."""
    n, rows = 2, 1
    first, told = ca.MX(half_length(n), 1), ca.MX.sym("told", rows * n + half_length(rows))
    still = ca.MX(2 * n, 2 * n * 2)
    dependence = depends(first, entries_of((still, still), n), told=Told(steps=(1,), rows=rows, columns=told))
    pattern = np.asarray(ca.DM(ca.jacobian_sparsity(dependence, told), 1).full()) != 0
    assert not pattern[: half_length(n)].any()
    assert pattern[half_length(n) :].all()
