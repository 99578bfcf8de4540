"""Integrals over the whole time in costs and constraints: closed forms, scipy, and what is refused."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import order, solve, unassessed
from refusals import refused
from scipy.integrate import solve_ivp

import covocp as co

WAYS = [{"covariances": "eliminated"}, {"covariances": "states"}, {"method": "gradient"}]
DURATION, DENSITY, NOISE, PRIOR = 3.0, 0.5, 0.2, 4.0


@pytest.fixture(params=WAYS, ids=lambda options: next(iter(options.values())))
def way(request):
    """The formulations and methods, by their options."""
    return request.param


@pytest.mark.parametrize("method", ["ipopt", "gradient"])
def test_energy_budget(method):
    """The furthest way x'' = u with int u^2 <= B: u = c (T - t), c^2 T^3/3 = B, x(T) = c T^3/3, dx/dB = x/(2 B)."""
    ocp = co.Problem(DURATION, "budget")
    x, v, u = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0), ocp.control("u", guess=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(terminal=-x)
    ocp.subject_to(ocp.integral(u**2, name="energy", unit="J"), upper=4.0, name="budget")
    solution = solve(ocp, intervals=30, method=method)
    furthest = np.sqrt(4.0 * DURATION**3 / 3.0)
    assert solution.cost == pytest.approx(-furthest, rel=1e-7)
    assert float(solution["energy"]) == pytest.approx(4.0, rel=1e-6)
    assert solution["energy"].shape == ()
    assert solution.multiplier("budget") == pytest.approx(furthest / 8.0, rel=1e-5)
    assert solution.optimality.costate_difference < 1e-8


def test_isoperimetric_problem():
    """The largest area over [0, 1] under a curve of given length from 0 to 0 is a piece of a circle."""
    ocp = co.Problem(1.0, "area")
    y, slope = (
        ocp.state("y", initial=0.0, final=0.0),
        ocp.control("slope", lower=-3.0, upper=3.0, guess=lambda s: 1.0 - 2.0 * s),
    )
    ocp.dynamics(y, slope)
    radius = 0.7
    half = np.arcsin(0.5 / radius)
    ocp.minimize(running=-y)
    ocp.subject_to(ocp.integral(ca.sqrt(1 + slope**2)), lower=2 * half * radius, upper=2 * half * radius)
    solution = solve(ocp, intervals=60)
    assert solution.cost == pytest.approx(-(radius**2) * (half - np.sin(half) * np.cos(half)), rel=1e-6)


def test_terminal_cost_of_an_integral_is_a_running_cost():
    """The same steps of integration, so the same discretised problem: the cost to roundoff."""
    found = []
    for stated in ("running", "terminal"):
        ocp = co.Problem(1.0, stated)
        x, u = ocp.state("x", initial=1.0), ocp.control("u")
        ocp.dynamics(x, ca.sin(x) + u)
        if stated == "running":
            ocp.minimize(running=x**2 * ca.exp(u) + u**2)
        else:
            ocp.minimize(terminal=ocp.integral(x**2 * ca.exp(u)) + ocp.integral(u**2))
        found.append(solve(ocp, intervals=10))
    assert found[0].cost == pytest.approx(found[1].cost, rel=1e-9)
    np.testing.assert_allclose(found[0]["u"], found[1]["u"], atol=1e-6)
    assert {"integral 1", "integral 2"} <= set(found[1].values)


def test_cost_that_is_not_linear_in_an_integral():
    """(int u^2)^2 + (x(T) - 1)^2: u = c with 4 c^3 + 2 (c - 1) = 0 over one second."""
    ocp = co.Problem(1.0, "square")
    x, u = ocp.state("x", initial=0.0), ocp.control("u", guess=0.5)
    ocp.dynamics(x, u)
    ocp.minimize(terminal=ocp.integral(u**2) ** 2 + (x - 1.0) ** 2)
    c = next(root.real for root in np.roots([4.0, 0.0, 2.0, -2.0]) if abs(root.imag) < 1e-12)
    for method in ("ipopt", "gradient"):
        solution = solve(ocp, intervals=10, method=method)
        assert solution.cost == pytest.approx(c**4 + (c - 1.0) ** 2, rel=1e-8)
        np.testing.assert_allclose(solution["u"], c, rtol=1e-4)


def watched(prior=PRIOR, density=DENSITY, duration=DURATION, budget=None, stated="terminal"):
    """A lag with an unknown rate; the integral of variances is a cost, in two ways, or has a budget."""
    ocp = co.Problem(duration, "watched")
    x = ocp.state("x", initial=1.0, variance=prior)
    b = ocp.unknown("b", mean=1.0, variance=2.0)
    u = ocp.control("u", guess=0.5)
    ocp.dynamics(x, -b * x + u, noise=NOISE)
    ocp.measurement("m", x, noise=density)
    E = ocp.estimation_covariance()
    spread = E[b, b] + 0.1 * x**2 * E[x, x]
    if stated == "running":
        ocp.minimize(running=u**2 + 2 * spread)
        return ocp
    total = ocp.integral(spread, name="spread")
    ocp.minimize(running=u**2, terminal=2 * total if budget is None else 0.0)
    if budget is not None:
        ocp.subject_to(total, upper=budget, name="budget")
    return ocp


def by_scipy(prior, density, duration, controls):
    """The integral of `watched` along u = sin t, and its covariance at the end, by scipy."""

    def rate(t, z):
        x, E = z[0], z[1:5].reshape(2, 2)
        F = np.array([[-1.0, -x], [0.0, 0.0]])
        growth = F @ E + E @ F.T + np.diag([NOISE, 0.0]) - np.outer(E[:, 0], E[0]) / density
        return np.concatenate([[-x + controls(t)], growth.ravel(), [E[1, 1] + 0.1 * x**2 * E[0, 0]]])

    start = np.concatenate([[1.0], np.diag([prior, 2.0]).ravel(), [0.0]])
    end = solve_ivp(rate, (0.0, duration), start, method="LSODA", rtol=1e-11, atol=1e-13).y[:, -1]
    return end[5], end[1:5].reshape(2, 2)


@pytest.mark.parametrize(
    ("options", "expected"),
    [({}, 4.0), ({"covariance_step": "rk4"}, 4.0), ({"covariance_step": "strang"}, 2.0)],
    ids=["gauss", "rk4", "strang"],
)
@pytest.mark.filterwarnings("ignore:The mesh is too coarse")
def test_integral_of_variances_against_scipy(options, expected):
    """Of the order of the steps, with constants like those of the running cost."""
    exact, covariance = by_scipy(PRIOR, DENSITY, DURATION, lambda t: np.interp(t, [0.0, DURATION], [0.5, -0.5]))
    counts, errors = np.array([40, 80, 160]), []
    for n in counts:
        nominal = {"u": np.linspace(0.5, -0.5, n + 1)}
        known = {"grid": np.linspace(0.0, 1.0, n + 1), "substeps": 2, **options}
        solution = co.evaluate(watched(), nominal=nominal, **known)
        errors.append(float(solution["spread"]) - exact)
    assert order(counts, errors) > expected - 0.6
    running = co.evaluate(watched(stated="running"), nominal=nominal, **known)
    plain = co.evaluate(watched(budget=9.0), nominal=nominal, **known).cost
    assert abs(errors[-1]) < 1.5 * abs((running.cost - plain) / 2.0 - exact) + 1e-10
    np.testing.assert_array_equal(solution["E"], running["E"])  # the filter is as it was
    assert solution.augmented == ("x", "b")
    np.testing.assert_allclose(solution["E"][-1], covariance, rtol=1e-6 if expected == 4.0 else 2e-3)


def test_steep_start_is_graded():
    """A prior that the first readings wipe out: the mesh sees the integral as it sees a running cost."""
    exact, _ = by_scipy(1e4, 1e-2, 1.0, lambda t: 0.5)
    solution = co.evaluate(watched(prior=1e4, density=1e-2, duration=1.0), nominal={"u": 0.5}, intervals=60)
    assert float(solution["spread"]) == pytest.approx(exact, rel=2e-3)
    finer = co.evaluate(watched(prior=1e4, density=1e-2, duration=1.0), nominal={"u": 0.5}, intervals=240)
    assert float(finer["spread"]) == pytest.approx(exact, rel=2e-5)


def test_budget_of_variances(way):
    """The budget is met; what it costs is what the multiplier says; both formulations and methods agree."""
    solution = solve(watched(budget=3.5), intervals=40, **way)
    assert float(solution["spread"]) == pytest.approx(3.5, rel=1e-5)
    assert solution.optimality.costate_difference < 1e-3
    if way == WAYS[0]:
        more, less = (unassessed(watched(budget=3.5 + d), intervals=40).cost for d in (1e-3, -1e-3))
        assert solution.multiplier("budget") == pytest.approx((less - more) / 2e-3, rel=2e-4)
    else:
        reference = unassessed(watched(budget=3.5), intervals=40, **WAYS[0])
        assert solution.cost == pytest.approx(reference.cost, rel=5e-6 if way.get("method") else 1e-7)


def test_integral_in_a_closed_loop(way):
    """Beside an expected cost: of E, which runs forward, while S runs backward."""
    ocp = co.Problem(2.0, "loop")
    x, v = ocp.state("x", initial=1.0, final=0.0, variance=0.5), ocp.state("v", initial=0.0, variance=0.1)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=0.1)
    ocp.measurement("m", x, noise=0.05 + 0.2 * x**2)
    E = ocp.estimation_covariance()
    total = ocp.integral(E[x, x], name="total")
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 4.0})
    ocp.subject_to(total, upper=0.41, name="budget")
    solution = solve(ocp, intervals=30, **way)
    assert float(solution["total"]) == pytest.approx(0.41, rel=1e-5)
    if "method" in way:
        assert solution.cost == pytest.approx(unassessed(ocp, intervals=30).cost, rel=5e-6)
    assert solution.optimality.cost_identity < 1e-5
    assert solution.optimality.costate_difference < 2e-3
    weights = np.trapezoid(solution["E"][:, 0, 0], solution.t)
    assert weights == pytest.approx(0.41, rel=5e-3)
    assert "total" not in str(solution).split("closed loop")[1].split("gain")[0]
    runs = co.simulate(solution, 20, seed=1, step=0.05, progress=False)
    assert "budget" in str(runs)


def test_files_and_pictures(tmp_path):
    """Kept in files; no panel of its own; printed with its unit."""
    solution = solve(watched(), intervals=20)
    assert float(co.load(solution.save(tmp_path / "a.npz"))["spread"]) == float(solution["spread"])
    assert float(co.load(solution.save(tmp_path / "b.json"), problem=watched())["spread"]) == float(solution["spread"])
    assert not any("spread" in axes.get_ylabel() for axes in solution.plot().axes)
    assert "integral" in str(solution)
    assert f"{float(solution['spread']):.8g}" in str(solution)
    assert "E[b, b]" in next(line for line in str(watched()).splitlines() if line.startswith("spread"))


def plain():
    """A problem to put something wrong into."""
    ocp = co.Problem(1.0, "plain")
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    return ocp, x, u


def test_nonsense_is_refused_and_nothing_lost():
    """No expression, a vector, nothing that moves, an integral of an integral."""
    ocp, x, u = plain()
    d, p = ocp.decision("d", guess=1.0), ocp.parameter("p", 2.0)
    total = ocp.integral(u**2)
    refused(lambda: ocp.integral("u"), "integrand")
    refused(lambda: ocp.integral([u, x]), "integrand")
    refused(lambda: ocp.integral(ca.vertcat(u, x)), "a scalar")
    refused(lambda: ocp.integral(3.0), "does not change with time")
    refused(lambda: ocp.integral(p * d), "does not change with time")
    refused(lambda: ocp.integral(u * total), "contains the integral 'integral 1'")
    refused(lambda: ocp.integral(u > 1), "comparison")
    refused(lambda: ocp.integral(u, name="x"), "used twice")
    assert len(ocp.states) == 3
    ocp.minimize(running=u**2 + d**2, terminal=total)
    assert ocp.statement().nx == 3


def test_integrals_belong_to_the_end():
    """Not along the path, not in rates, measurements and running costs, not in the expected terminal cost."""
    ocp, x, u = plain()
    total = ocp.integral(u**2)
    for place in ("path", "initial"):
        refused(lambda place=place: ocp.subject_to(total, upper=1.0, at=place), "elsewhere than at the end")
    ocp.minimize(running=total * u)
    refused(ocp.statement, "integral 'integral 1' in the running cost")
    ocp, x, u = plain()
    y = ocp.state("y", initial=0.0)
    ocp.dynamics(y, ocp.integral(u))
    ocp.minimize(running=u**2)
    refused(ocp.statement, "the rate of 'y'")
    ocp, x, u = plain()
    z = ocp.state("z", initial=0.0, variance=1.0)
    ocp.dynamics(z, u)
    ocp.minimize_expected(running=u**2, terminal=ocp.integral(x**2))
    refused(ocp.statement, "expected terminal cost", "running= of minimize_expected()")
    foreign = co.Problem(1.0).state("foreign", initial=0.0)
    ocp, x, u = plain()
    ocp.minimize(terminal=ocp.integral(foreign * u))
    refused(ocp.statement, "unknown symbol 'foreign'")
