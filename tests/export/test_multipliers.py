"""The status of an exported solver: OK where the conditions of a minimum hold, whatever multipliers it ended with."""

from itertools import product
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, QUICK

import covocp as co
from covocp.export import export_c
from covocp.export.laws.conditions import INFEASIBLE, STATIONARY, residuals

pytestmark = pytest.mark.filterwarnings("ignore::covocp.CovocpWarning")  # the meshes are coarse

INTERVALS, DURATION, WEIGHT = 30, 4.0, 5.0


def swing(bound=np.inf, x0=1.0, v0=0.0):
    """x'' = u - x, at rest at the end; the least of the integral of u^2 + x^2, and of 5 x^2 at the end."""
    ocp = co.Problem(duration=DURATION)
    x, v = ocp.state("x", initial=x0), ocp.state("v", initial=v0, final=0.0)
    u = ocp.control("u", lower=-bound, upper=bound)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - x)
    ocp.minimize(running=u**2 + x**2, terminal=WEIGHT * x**2)
    return ocp


def least_cost(x0, v0):
    """That of the swing without bounds and any control: the linear equations of the maximum principle.

    u = -p_v / 2, p_x' = -2 x + p_v, p_v' = -p_x, p_x(T) = 10 x(T): the unknown p(0) by two runs from zero.
    """
    A = np.array([[0, 1, 0, 0], [-1, 0, 0, -0.5], [-2, 0, 0, 1], [0, 0, -1, 0]], dtype=float)
    steps = 400
    h = DURATION / steps
    step = sum(np.linalg.matrix_power(A * h, k) / float(np.prod(range(1, k + 1))) for k in range(12))
    ends = np.linalg.matrix_power(step, steps)
    rows = np.array([[0.0, 1.0, 0.0, 0.0], [-2 * WEIGHT, 0.0, 1.0, 0.0]]) @ ends
    p0 = np.linalg.solve(rows[:, 2:], -rows[:, :2] @ np.array([x0, v0]))
    # of a homogeneous quadratic optimum half the slope by the start is the cost
    return 0.5 * float(p0 @ np.array([x0, v0]))


@pytest.fixture(scope="module")
def free():
    return export_c(swing(), FOLDER / "swing_free", intervals=INTERVALS)


def starts(count, seed=5):
    random = np.random.default_rng(seed)
    return [(float(random.uniform(-2, 2)), float(random.uniform(-1, 1))) for _ in range(count)]


def test_a_linear_quadratic_optimum_is_called_one_from_every_start(free):
    """Sqpmethod ends there at a step of rounding, of which its line search took a part, also of the multipliers."""
    planner = free.reference()
    for x0, v0 in starts(60):
        plan = planner(initial_x=x0, initial_v=v0)
        assert planner.status == "OK"
        assert plan["stationarity"] < STATIONARY
        assert plan["cost"] == pytest.approx(least_cost(x0, v0), rel=2e-4)
        again = planner(initial_x=x0, initial_v=v0, guess=plan["variables"])
        assert planner.status == "OK"
        assert again["cost"] == pytest.approx(plan["cost"], rel=1e-10)


@pytest.mark.needs_cc
def test_the_c_code_says_the_same(free):
    free.build(flags=QUICK)
    compiled, reference = free.python(), free.reference()
    for x0, v0 in starts(20):
        plan, own = compiled(initial_x=x0, initial_v=v0), reference(initial_x=x0, initial_v=v0)
        assert compiled.status == reference.status == "OK"
        np.testing.assert_allclose(plan["u"], own["u"], atol=1e-9)
    assert free.check().ok


def test_what_is_stopped_early_is_called_solved_only_where_it_is_the_optimum():
    """With controls at their limits, after one iteration, two, three of the solver."""
    whole = export_c(swing(0.6, 1.2), FOLDER / "swing_limited", intervals=INTERVALS).reference()
    known = [(start, whole(initial_x=start[0], initial_v=start[1])) for start in starts(30)]
    known = [(start, best) for start, best in known if best["status"] == "OK"]
    seen, limited = set(), 0
    for most in (1, 2, 3):
        options = {"plugin_options": {"max_iter": most}}
        made = export_c(swing(0.6, 1.2), FOLDER / f"swing_stopped_{most}", intervals=INTERVALS, **options)
        planner = made.reference()
        for (x0, v0), best in known:
            plan = planner(initial_x=x0, initial_v=v0)
            apart = float(np.abs(plan["u"] - best["u"]).max())
            limited += int((np.abs(best["u"]) > 0.6 - 1e-7).any())
            seen.add(planner.status)
            if planner.status == "OK":
                assert apart < 1e-4
            else:
                assert apart > 1e-8 or plan["infeasibility"] > INFEASIBLE
    assert limited > 10
    assert seen == {"OK", "NOT_CONVERGED"}


def test_starts_without_a_plan_are_not_called_solved():
    """So small a control brings nothing to rest from there."""
    planner = export_c(swing(0.6, 1.2), FOLDER / "swing_weak", intervals=INTERVALS).reference()
    planner(initial_x=8.0, initial_v=0.0)
    assert planner.status == "NOT_CONVERGED"


# Residuals of programs whose solutions are known.


def program(H, c, A):
    """min w'Hw/2 + c'w, rows A w."""
    w, p = ca.MX.sym("w", len(c)), ca.MX.sym("p", 1)
    f, g = 0.5 * ca.bilin(ca.DM(H), w, w) + ca.dot(ca.DM(c), w), ca.mtimes(ca.DM(A), w)
    nlp = SimpleNamespace(w=w, p=p, f=f, g=g, gradient=None, jacobian=None)
    slopes = ca.Function("slopes", [w, p], [f, ca.gradient(f, w), g, ca.jacobian(g, w)])
    return nlp, slopes


def told(nlp, slopes, at, bounds, rows, multipliers=None):
    """Violation and slope at a point, with these multipliers (zero: unknown)."""
    g = np.asarray(ca.Function("g", [nlp.w], [nlp.g])(at).full()).ravel()
    lam_x, lam_g = (np.zeros(len(at)), np.zeros(g.size)) if multipliers is None else multipliers
    values = {"x": at, "p": 0.0, "g": g, "lam_x": lam_x, "lam_g": lam_g}
    values |= {"lbx": bounds[0], "ubx": bounds[1], "lbg": rows[0], "ubg": rows[1]}
    symbols = {name: ca.MX.sym(name, np.size(value)) for name, value in values.items()}
    found = ca.Function("found", [*symbols.values()], residuals(nlp, symbols, 1.0, slopes))
    return tuple(float(value) for value in found.call([ca.DM(v) for v in values.values()]))


def solved_by_trying(H, c, A, bounds, rows):
    """The minimum of a strictly convex program: the active set, of all, with the signs of one."""
    n, m = len(c), len(A)
    both, lower, upper = np.vstack([np.eye(n), A]), np.r_[bounds[0], rows[0]], np.r_[bounds[1], rows[1]]
    for sides in product((0, -1, 1), repeat=n + m):
        active = np.flatnonzero(sides)
        values = np.array([lower[i] if sides[i] < 0 else upper[i] for i in active])
        if active.size > n or not np.isfinite(values).all():
            continue
        B = both[active]
        if active.size and np.linalg.matrix_rank(B) < active.size:
            continue
        kkt = np.block([[H, B.T], [B, np.zeros((active.size, active.size))]])
        found = np.linalg.solve(kkt, np.r_[-c, values])
        w, lam = found[:n], found[n:]
        inside = (both @ w >= lower - 1e-9).all() and (both @ w <= upper + 1e-9).all()
        if inside and all(sides[i] * v >= -1e-9 for i, v in zip(active, lam, strict=True)):
            return w
    raise AssertionError("no minimum")


def random_program(random):
    H = (lambda B: B @ B.T + 0.1 * np.eye(3))(random.standard_normal((3, 3)))
    c, A = 2 * random.standard_normal(3), random.standard_normal((2, 3))
    half = random.uniform(0.1, 0.6, 3)
    return H, c, A, (-half, half), (np.array([-0.2, -np.inf]), np.array([0.0, 0.3]))


@pytest.mark.parametrize("seed", range(40))
def test_minima_are_found_stationary_without_multipliers_and_other_points_are_not(seed):
    random = np.random.default_rng(seed)
    H, c, A, bounds, rows = random_program(random)
    nlp, slopes = program(H, c, A)
    best = solved_by_trying(H, c, A, bounds, rows)
    violation, left = told(nlp, slopes, best, bounds, rows)
    assert violation < 1e-9
    assert left < 1e-7
    wrong = random.standard_normal(3), random.standard_normal(2)
    assert told(nlp, slopes, best, bounds, rows, wrong)[1] < 1e-7
    other = solved_by_trying(H, c + random.standard_normal(3), A, bounds, rows)
    if np.abs(other - best).max() > 1e-3:  # feasible, at other limits, but no minimum
        violation, left = told(nlp, slopes, other, bounds, rows)
        assert violation < 1e-9
        assert left > 10 * STATIONARY
    between = 0.5 * (best + other)
    if np.abs(between - best).max() > 1e-3:
        assert told(nlp, slopes, between, bounds, rows)[1] > 10 * STATIONARY


def test_a_limit_that_pushes_the_wrong_way_is_no_minimum():
    """min w^2 / 2 - w on [0, 2]: at 0 and at 2 slopes of one vanish only with a multiplier of the wrong sign."""
    nlp, slopes = program(np.eye(1), np.array([-1.0]), np.zeros((1, 1)))
    rows = np.array([-np.inf]), np.array([np.inf])
    for at, expected in ((0.0, 1.0), (2.0, 1.0), (1.0, 0.0), (0.5, 0.5)):
        left = told(nlp, slopes, [at], ([0.0], [2.0]), rows)[1]
        assert left == pytest.approx(expected, abs=1e-9)


def test_dependent_limits_do_not_make_a_minimum_of_another_point():
    """The same row twice: its multipliers are not unique, their sum is."""
    A = np.array([[1.0, 1.0], [1.0, 1.0]])
    nlp, slopes = program(np.eye(2), np.array([-3.0, -3.0]), A)
    bounds, rows = ([-9.0, -9.0], [9.0, 9.0]), ([-np.inf, -np.inf], [2.0, 2.0])
    assert told(nlp, slopes, [1.0, 1.0], bounds, rows)[1] < 1e-7
    assert told(nlp, slopes, [1.5, 0.5], bounds, rows)[1] > 0.1


def test_an_infeasible_point_is_told_as_one():
    nlp, slopes = program(np.eye(1), np.zeros(1), np.ones((1, 1)))
    violation, _ = told(nlp, slopes, [0.0], ([-1.0], [1.0]), ([2.0], [2.0]))
    assert violation == pytest.approx(2.0)


def test_slopes_without_a_value_are_no_minimum():
    """w ln w at 0, where the bound holds it: its slope is infinite."""
    w, p = ca.MX.sym("w"), ca.MX.sym("p", 1)
    f, g = w * ca.log(w), 0.0 * w
    nlp = SimpleNamespace(w=w, p=p, f=f, g=g, gradient=None, jacobian=None)
    slopes = ca.Function("slopes", [w, p], [f, ca.gradient(f, w), g, ca.jacobian(g, w)])
    rows = np.array([-np.inf]), np.array([np.inf])
    assert not told(nlp, slopes, [0.0], ([0.0], [1.0]), rows)[1] <= STATIONARY
