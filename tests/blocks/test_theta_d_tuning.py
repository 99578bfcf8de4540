"""How far the θ-D series converges, and k, l by least squares, section 8."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.blocks import sdre, theta_d, theta_d_radius, theta_d_series, theta_d_tuning
from covocp.models import agile_aircraft, theta_d_benchmarks
from covocp.simulation.laws import simulate_law

X = ca.SX.sym("x", 3)
A0 = np.array([[0.2, 1.0, 0.0], [-0.5, 0.1, 0.4], [0.3, 0.0, -0.6]])
FIRST = np.array([[0.0, 0.3, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.2]])
B, Q, R = np.array([[1.0, 0.0], [0.0, 0.0], [0.2, 1.0]]), np.diag([1.0, 2.0, 0.5]), np.array([[1.0, 0.2], [0.2, 0.7]])


def test_radius_of_known_singularities():
    assert theta_d.radius(1.0, -1.0, 1.0, 1.0, 1.0) == pytest.approx(np.sqrt(2.0), rel=1e-3)
    linear, bilinear, column, _ = agile_aircraft.matrices()
    for units in ("rad", "deg"):
        scenario = agile_aircraft.regulation(units)
        found = theta_d.radius(linear, bilinear, column, scenario.Q, scenario.R)
        S = column @ column.T / scenario.R
        constant = np.block([[linear, -S], [-scenario.Q, -linear.T]])
        direction = np.block([[bilinear, np.zeros((5, 5))], [np.zeros((5, 5)), -bilinear.T]])
        # Here the nearest singularity is where two eigenvalues of the Hamiltonian matrix meet in zero.
        inverse_roots = np.linalg.eigvals(np.linalg.solve(constant, -direction))
        assert found == pytest.approx(1.0 / np.abs(inverse_roots).max(), rel=1e-3)


def test_radius_of_an_oscillator_with_two_pairs_of_branch_points_of_nearly_the_same_distance():
    """p_12 = -k + sqrt(k^2 + 1), k = 2 + 2 s; p_22 = -a + sqrt(a^2 + 2 p_12 + 1), a = 0.2 + s."""
    oscillator = np.array([[0.0, 1.0], [-2.0, -0.2]]), np.array([[0.0, 0.0], [-2.0, -1.0]]), [0.0, 1.0], np.eye(2), 1.0

    def inner(s):
        k = 2 + 2 * s
        return (0.2 + s) ** 2 + 2 * (-k + np.sqrt(k**2 + 1)) + 1

    s = -0.08 + 1.11j
    for _ in range(20):
        s -= inner(s) / ((inner(s + 1e-6) - inner(s - 1e-6)) / 2e-6)
    assert abs(inner(s)) < 1e-12
    assert abs(s) < np.sqrt(5.0) / 2  # of k = i
    assert theta_d.radius(*oscillator) == pytest.approx(abs(s), rel=1e-8)
    x = ca.SX.sym("x", 2)
    constant, direction, *rest = oscillator
    found = theta_d.convergence(x, constant, x[0] * direction, *rest, [[1.0, 0.0], [1.3, 0.0], [-1.3, 2.0]], warn=False)
    np.testing.assert_allclose(found.radius, abs(s) / np.array([1.0, 1.3, 1.3]), rtol=1e-8)
    assert not found.converges


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e5, 1e-6)])
def test_radius_of_two_scalar_systems_in_any_units(units):
    """p = a + sqrt(a^2 + 1), a = a_0 + s d: branch points where a = +-i, none where lambda of one meets -lambda of the
    other."""
    U, first, second = np.diag(units), np.array([-0.5, 0.3]), np.array([0.2, -0.4])
    found = theta_d.radius(np.diag(first), np.diag(second), U, np.linalg.inv(U) ** 2, np.eye(2))
    assert found == pytest.approx(np.abs((1j - first) / second).min(), rel=1e-6)


def turned(system, seed):
    """The same system in random coordinates that keep the identity as Q."""
    n = len(system[0])
    O = np.linalg.qr(np.random.default_rng(seed).standard_normal((n, n)))[0]
    return O @ system[0] @ O.T, O @ system[1] @ O.T, O @ system[2], np.eye(n), np.eye(system[2].shape[1])


@pytest.mark.parametrize("copies", [2, 3])
def test_radius_of_equal_axes_is_that_of_one(copies):
    """p = a + sqrt(a^2 + 1) of each axis, and the oscillator of above."""
    one = np.sqrt(1.25) / 0.2
    found = theta_d.radius(*(np.kron(np.eye(copies), v) for v in (-0.5, 0.2, 1.0, 1.0, 1.0)))
    assert found == pytest.approx(one, rel=1e-9)
    oscillator = np.array([[0.0, 1.0], [-2.0, -0.2]]), np.array([[0.0, 0.0], [-2.0, -1.0]]), np.array([[0.0], [1.0]])
    alone = theta_d.radius(*oscillator, np.eye(2), 1.0)
    system = tuple(np.kron(np.eye(copies), v) for v in oscillator)
    assert theta_d.radius(*turned(system, copies)) == pytest.approx(alone, rel=1e-7)
    assert theta_d.radius(*system, np.eye(2 * copies), np.eye(copies)) == pytest.approx(alone, rel=1e-7)


def test_radius_of_opposed_axes_is_that_of_one():
    """D and -D: the eigenvalues of one system meet those of the other where neither has a singularity."""
    generator = np.random.default_rng(87019)
    size = int(generator.integers(1, 6))
    inputs = int(generator.integers(1, min(size, 2) + 1))
    A, D = generator.standard_normal((2, size, size))
    B = generator.standard_normal((size, inputs))
    two = np.kron(np.eye(2), A), np.kron(np.diag([1.0, -1.0]), D), np.kron(np.eye(2), B)
    one = theta_d.radius(A, D, B, np.eye(size), np.eye(inputs))
    assert one == pytest.approx(0.91583, rel=1e-4)  # growth of 1500 terms; a farther branch point is at 0.93516
    assert theta_d.radius(*two, np.eye(2 * size), np.eye(2 * inputs)) == pytest.approx(one, rel=1e-4)
    assert theta_d.radius(*turned(two, 1)) == pytest.approx(one, rel=1e-4)


def test_radius_of_systems_beside_one_another_that_have_no_cost():
    """States that nothing weighs leave T_0 singular: x2 does not act on x1, of which p = a + sqrt(a^2 + 1)."""
    found = theta_d.radius(np.diag([-0.5, -1.0]), np.diag([0.2, 3.0]), np.eye(2), np.diag([1.0, 0.0]), np.eye(2))
    assert found == pytest.approx(np.sqrt(1.25) / 0.2, rel=1e-9)


def test_a_recurrence_tells_the_singularity_of_a_known_series():
    """(1 - s/r)^1/2 and its conjugate, r = 0.9 exp(i)."""
    orders = np.arange(161)
    factors = np.cumprod(np.concatenate([[1.0], (orders[1:] - 1.5) / orders[1:]]))
    terms = (factors * np.cos(orders) / 0.9**orders)[:, None, None]
    found = theta_d_radius.recurrence(terms)
    assert found.order == 2
    assert abs(found.nearest) == pytest.approx(0.9, rel=1e-3)
    assert abs(np.angle(found.nearest)) == pytest.approx(1.0, abs=1e-2)
    assert theta_d_radius.recurrence(np.random.default_rng(0).standard_normal((161, 2, 2))) is None


def test_radius_ends_where_a_mode_cannot_be_reached():
    """x1' = x1 + (1 - s) u: p (1 - s)^2 = 1 + sqrt(1 + (1 - s)^2) has a pole at 1, branch points at 1 +- i."""
    # As the input must not depend on s, it comes through a fast state: x1' = x1 + (1 - s) x2, x2' = -3 x2 + u.
    A, D = np.array([[1.0, 1.0], [0.0, -3.0]]), np.array([[0.0, -1.0], [0.0, 0.0]])
    assert theta_d.radius(A, D, [0.0, 1.0], np.eye(2), 1.0) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_radius_agrees_with_terms_of_high_order(seed):
    """n^3/2 T_n R^n, 500 terms, neither grows nor vanishes."""
    generator = np.random.default_rng(seed)
    size, inputs = 2 + seed % 3, 1 + seed % 2
    A, D = generator.standard_normal((2, size, size))
    B = generator.standard_normal((size, inputs))
    found = theta_d.radius(A, D, B, np.eye(size), np.eye(inputs))
    terms = theta_d_radius.scaled_terms(theta_d_series.start(A, B, np.eye(size), np.eye(inputs)), found * D, 500)
    sizes = np.linalg.norm(terms, axis=(1, 2)) * np.arange(501.0) ** 1.5
    # 250 terms apart, so to 0.8 percent of R; where a mode cannot be reached (seed 2) the pole is a double one.
    assert 0.5 < sizes[380:].max() / sizes[130:250].max() < 7.0


def test_radius_of_a_series_that_ends_is_infinite():
    system = theta_d_benchmarks.system("arctangent")
    found = theta_d.convergence(
        system.x, system.A0, system.A, system.B, system.Q, system.R, [[0.5, 1.0], [-3.0, 0.2], [0.0, 0.0]]
    )
    assert np.all(np.isinf(found.radius))
    assert found.converges


def test_published_radii_of_the_aircraft():
    """Section 7 for filter and servo; what it says of the regulator, 73 and 48 deg, are estimates of low order."""
    linear, bilinear, column, measured = agile_aircraft.matrices()
    for units, regulator, observer in (("rad", 68.7226, 28.71), ("deg", 42.7035, 26.33)):
        first, second = agile_aircraft.regulation(units), agile_aircraft.tracking(units)
        found = theta_d.radius(linear, bilinear, column, first.Q, first.R)
        assert np.rad2deg(found) == pytest.approx(regulator, rel=1e-3)
        found = theta_d.radius(linear.T, bilinear.T, measured.T, first.W, first.V)
        assert np.rad2deg(found) == pytest.approx(observer, rel=2e-3)
        x = ca.SX.sym("x", 5)
        _, constant, rest, extended = theta_d.integral_states(x, linear, ca.DM(bilinear), column, [0, 0, 0, 1.0, 0])
        found = theta_d.radius(constant, ca.DM(rest).full(), extended, second.Q, second.R)
        assert np.rad2deg(found) == pytest.approx(1.5356, rel=1e-3)


def test_inside_the_radius_more_terms_help_and_outside_they_do_not():
    system = theta_d_benchmarks.system("cubic")
    arguments = (system.x, system.A0, system.A, system.B, system.Q, system.R)
    inside, outside = theta_d.convergence(*arguments, [1.0, 1.5], warn=False).radius
    assert inside > 1.0 > outside
    for x, grows in ((1.0, False), (1.5, True)):
        exact = theta_d_benchmarks.exact("cubic", x).control[0, 0]
        errors = [abs(float(theta_d.regulator(*arguments, terms=n)(x, 0.0)) - exact) for n in (10, 20, 40)]
        assert (errors[-1] > errors[0]) == grows


def test_outside_the_radius_a_warning_names_the_state():
    system = theta_d_benchmarks.system("cubic")
    arguments = (system.x, system.A0, system.A, system.B, system.Q, system.R)
    assert theta_d.convergence(*arguments, [0.5, -1.1]).converges
    with pytest.warns(co.CovocpWarning, match=r"1 of 2 states; at x = \(2\)"):
        found = theta_d.convergence(*arguments, [0.5, 2.0])
    assert not found.converges


def test_conditions_of_theorem_3_1():
    """(iv) fails for the aircraft in its own coordinates and holds after a change of them; the bound is a lower one."""
    linear, bilinear, column, measured = agile_aircraft.matrices()
    x = ca.SX.sym("x", 5)
    A = x[1] * ca.DM(bilinear)
    state = [[0.0, np.deg2rad(20.0), 0.0, 0.0, 0.0]]
    printed = {"rad": (2.2e3, 8.4), "deg": (3.0e3, 13.4)}
    for units, (regulator, observer) in printed.items():
        scenario = agile_aircraft.regulation(units)
        both = (
            theta_d.convergence(x, linear, A, column, scenario.Q, scenario.R, state),
            theta_d.convergence(x, linear.T, A.T, measured.T, scenario.W, scenario.V, state),
        )
        assert both[0].largest == pytest.approx(regulator, rel=0.05)
        assert both[1].largest == pytest.approx(observer, rel=0.05)
        for found in both:
            assert found.decay < 0.0
            assert found.largest_transformed < 0.0
            assert np.all(found.guaranteed > 0.0)
            assert np.all(found.guaranteed <= found.radius)


def exact_squares(A):
    """Pi of A' Pi + Pi A = -I for a 3 x 3 matrix of floats, solved in fractions."""
    a = [[Fraction(float(entry)) for entry in row] for row in A]
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    rows = []
    for i, j in pairs:
        row = [Fraction(0)] * 6 + [Fraction(-1 if i == j else 0)]
        for k in range(3):
            row[pairs.index((min(k, j), max(k, j)))] += a[k][i]
            row[pairs.index((min(i, k), max(i, k)))] += a[k][j]
        rows.append(row)
    for c in range(6):
        pivot = next(r for r in range(c, 6) if rows[r][c])
        rows[c], rows[pivot] = rows[pivot], rows[c]
        rows[c] = [v / rows[c][c] for v in rows[c]]
        rows = [r if k == c else [v - r[c] * w for v, w in zip(r, rows[c], strict=True)] for k, r in enumerate(rows)]
    found = np.zeros((3, 3))
    for (i, j), row in zip(pairs, rows, strict=True):
        found[i, j] = found[j, i] = float(row[6])
    return found


@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (1.0, 1e-5, 1e5), (1e5, 1.0, 1e-5)])
@pytest.mark.parametrize("seed", range(4))
def test_coordinates_of_theorem_3_1_in_mixed_units(units, seed):
    """Entries 16 orders apart left the small eigenvalues of Pi no digit, some a minus, and (iv) had seemed to fail."""
    plain = np.random.default_rng(seed).standard_normal((3, 3))
    plain -= (np.linalg.eigvals(plain).real.max() + 1.0) * np.eye(3)
    closed = np.diag(units) @ plain @ np.diag(1.0 / np.array(units))
    squares = exact_squares(closed)
    root, inverse = theta_d_tuning._coordinates(closed)
    sizes = np.sqrt(np.diag(squares))
    np.testing.assert_allclose(root.T @ root / np.outer(sizes, sizes), squares / np.outer(sizes, sizes), atol=1e-6)
    np.testing.assert_allclose(root @ inverse, np.eye(3), atol=1e-12)
    moved = root @ closed @ inverse
    assert np.linalg.eigvalsh(moved + moved.T)[-1] < 1e-12  # exactly -1 / the largest eigenvalue of Pi


def test_guaranteed_radius_bounds_the_terms():
    """Within it the series converges for every choice of epsilon in [0, 1]."""
    found = theta_d.convergence(X, A0, X[0] * ca.DM(FIRST), B, Q, R, [1.0, 0.0, 0.0], warn=False)
    state = [float(found.guaranteed[0]), 0.0, 0.0]
    built = theta_d.expansion(X, A0, X[0] * ca.DM(FIRST), B, Q, R, terms=30, form="operator")
    norms = [np.linalg.norm(term.full()) for term in built.terms(state, 0.0)]
    assert norms[-1] < 1e-3 * norms[1]
    assert found.guaranteed[0] <= found.radius[0]


def sdre_trajectory(system, start, duration, samples):
    u = ca.SX.sym("u", system.B.shape[1])
    rate = (ca.DM(system.A0) + system.A) @ system.x + ca.DM(system.B) @ u
    law = sdre.regulator(system.x, system.A0, system.A, system.B, system.Q, system.R)
    return simulate_law(ca.Function("f", [system.x, u], [rate]), law, initial=start, duration=duration, samples=samples)


@pytest.mark.parametrize("start", [1.5, 3.0])
def test_choice_where_the_series_diverges(start):
    """Section 8: l_1 is the decay rate of A(x(t)), 2 sqrt(2), and the second correction stays away."""
    system = theta_d_benchmarks.system("cubic")
    run = sdre_trajectory(system, [start], 5.0, 51)
    found = theta_d.choose(system.x, system.A0, system.A, system.B, system.Q, system.R, run.x, run.t, starts=4)
    assert found.misfit < 1e-7
    assert found.l[0] == pytest.approx(2 * np.sqrt(2.0), rel=2e-3)
    assert found.k[1] == pytest.approx(1.0, abs=1e-3)
    assert found.l[1] == pytest.approx(0.0, abs=5e-3)


@pytest.mark.parametrize("units", ["rad", "deg"])
def test_choice_where_the_series_converges(units):
    """Section 8: from 30 deg the fit takes the whole series, k = 0."""
    linear, bilinear, column, _ = agile_aircraft.matrices()
    scenario = agile_aircraft.regulation(units)
    x = ca.SX.sym("x", 5)
    system = theta_d_benchmarks.System(
        x=x, A0=linear, A=x[1] * ca.DM(bilinear), B=column, Q=scenario.Q, R=np.array([[scenario.R]])
    )
    run = sdre_trajectory(system, scenario.start, 10.0, 41)
    found = theta_d.choose(x, linear, system.A, column, scenario.Q, scenario.R, run.x, run.t, starts=4)
    np.testing.assert_array_equal(found.k, 0.0)
    np.testing.assert_array_equal(found.l, 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"terms": 1}, "'terms'"),
        ({"starts": 0}, "'starts'"),
        ({"times": [0.0]}, "'times'"),
        ({"states": [[1.0, 2.0]]}, "'states'"),
    ],
)
def test_bad_samples_are_named(change, message):
    system = theta_d_benchmarks.system("cubic")
    arguments = {"states": [[1.0], [0.5]], "times": [0.0, 1.0], **change}
    with pytest.raises(co.ProblemError, match=message):
        theta_d.choose(system.x, system.A0, system.A, system.B, system.Q, system.R, **arguments)
