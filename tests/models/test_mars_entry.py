"""Mars entry, chapter 7: the model against its equations written out with numpy, and both against the specification."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import casadi as ca
import closed_loops
import numpy as np
import pytest
from closed_loops import closed_loop, lower, mars, mars_in_density, piecewise_linear
from refusals import refused
from scipy.integrate import cumulative_simpson, solve_ivp

import covocp as co
from covocp.models import goddard_rocket, mars_entry

RADIUS = 11.0951e6  # ft
DURATION = 915.0  # s
SCALE_HEIGHT = 30000.0  # ft
KINDS = ("high", "mean", "low")


@cache
def reference(make=mars):
    """Constant lift-to-drag ratio, at 2001 times."""
    return closed_loop(make(), lambda t: 0.5, DURATION, times=np.linspace(0.0, DURATION, 2001))


@cache
def optimum():
    """The regularised problem on intervals of 5 s."""
    problem = mars_entry.problem()
    return problem, co.solve(problem, intervals=183, progress=False)


def rms(loop):
    """Range and altitude [ft], velocity [ft/s], path angle [rad]."""
    return [loop.rms(1) * RADIUS, *(loop.rms(i) for i in (0, 2, 3))]


def values(problem, expression, x, u):
    """An expression of the problem's symbols along histories of state and control."""
    symbols = [entry.symbol for entry in problem.declarations.states]
    function = ca.Function("f", [*symbols, problem.declarations.controls[0].symbol], [expression])
    return function(*(ca.DM(row).T for row in x.T), ca.DM(np.ravel(u)).T).full().ravel()


# --- the specification, by the reference integrator -------------------------------------------------------------------


def test_constant_ratio_has_the_specified_deviations():
    loop = reference()
    assert loop.cost == pytest.approx(6.57123e-4, abs=0.5e-9)
    # half a unit of the last digit given
    assert (np.abs(np.subtract(rms(loop), [5952, 16973, 28.76, 0.0077])) <= [0.5, 0.5, 0.005, 0.5e-4]).all()
    h, theta, v, gamma, _ = loop.x[-1]
    np.testing.assert_allclose([h, v], [29620, 1296], atol=0.5)
    assert theta == pytest.approx(0.59831, abs=0.5e-5)
    assert gamma == pytest.approx(-0.360, abs=0.5e-3)
    # rms of the control's deviation from B/2 int du^2 dt
    assert np.sqrt(loop.feedback / (0.05 * DURATION)) == pytest.approx(1.2e-3, abs=0.5e-4)
    assert loop.equivalent == pytest.approx(loop.cost, rel=1e-10)
    assert loop.innovations == pytest.approx(loop.cost, rel=1e-9)
    assert np.abs(loop.Z / np.sqrt(np.einsum("kii,kjj->kij", loop.E, loop.E))).max() < 1e-8


def test_density_and_its_logarithm_are_the_same_to_first_order():
    """E of rho is E of lambda times rho, for each index that is the density's."""
    logarithm, density = reference(), reference(mars_in_density)
    rho = np.exp(logarithm.x[:, 4])
    np.testing.assert_allclose(density.x[:, 4], rho, rtol=1e-9)
    factor = np.ones((rho.size, 5))
    factor[:, 4] = rho
    square = factor[:, :, None] * factor[:, None, :]
    for name in ("E", "X"):
        first, second = getattr(logarithm, name) * square, getattr(density, name)
        size = np.sqrt(np.einsum("kii,kjj->kij", second, second))
        np.testing.assert_allclose(first / size, second / size, atol=1e-7)
    assert density.cost == pytest.approx(logarithm.cost, rel=1e-9)


def test_uncertainty_of_the_atmosphere_grows_with_its_noise_only():
    """lambda + beta h is neither controlled nor moved by the flight: its variance grows by int c/rho dt."""
    loop = reference()
    w = np.array([1 / SCALE_HEIGHT, 0.0, 0.0, 0.0, 1.0])
    noise = cumulative_simpson(4.5e-15 * np.exp(-loop.x[:, 4]), x=loop.t, initial=0.0)
    np.testing.assert_allclose(loop.X @ w @ w, loop.X[0] @ w @ w + noise, rtol=1e-9)


def test_a_decaying_filter_of_the_density_does_not_give_the_published_deviations():
    """The sign conflict of the thesis: row 5 of F as in the shaping filter."""
    system = mars_in_density()

    def F(x, u):
        slopes = system.F(x, u)
        slopes[4] = [0, 0, 0, 0, -abs(x[2] * np.sin(x[3])) / SCALE_HEIGHT]
        return slopes

    loop = closed_loop(replace(system, F=F), lambda t: 0.5, DURATION, times=[0.0, DURATION])
    assert rms(loop)[0] == pytest.approx(14700, abs=50)


# --- the model --------------------------------------------------------------------------------------------------------


def test_statement_has_the_equations_of_the_thesis():
    statement = mars_entry.problem(control_weight=0.2, regularization=3e-5).statement()
    system = mars(control_weight=0.2, regularization=3e-5)
    loop, generator = reference(), np.random.default_rng(7)
    for k in (0, 400, 900, 2000):
        x, u = loop.x[k], np.array([0.3])
        roots = [generator.standard_normal((5, 5)) * system.scale, generator.standard_normal((5, 5)) / system.scale]
        E, S = (root.T @ root for root in roots)
        F, G, M, Q = system.F(x, u), system.G(x, u), system.M(x, u), system.Q(x, u)
        W = M.T @ M / 0.02
        E_rate = F @ E + E @ F.T + Q - E @ W @ E
        S_rate = -F.T @ S - S @ F + S @ G @ G.T @ S / 0.2
        rate, matrices, running = statement.rates(
            x, u, np.concatenate([lower(E), lower(S)]), 0.0, DURATION, statement.values
        )
        np.testing.assert_allclose(rate.full().ravel(), system.rate(x, u), rtol=1e-12)
        square = np.outer(system.scale, system.scale)
        scales = np.concatenate(
            [lower(square) * np.abs(E_rate / square).max(), np.abs(S_rate * square).max() / lower(square)]
        )
        np.testing.assert_allclose(
            matrices.full().ravel() / scales, np.concatenate([lower(E_rate), lower(S_rate)]) / scales, atol=1e-12
        )
        expected = 0.5 * 3e-5 * 0.2**2 + 0.5 * np.trace(S @ E @ W @ E)
        assert float(running) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("data", ["recommended", "printed"])
def test_data_reach_the_statement(data):
    problem = mars_entry.problem(duration=900.0, lower=-0.2, upper=0.7, data=data)
    statement = problem.statement()
    if data == "recommended":
        radius, rho, variance, weights = RADIUS, 4.8e-5 * np.exp(-328 / 30), 8.55e-22, (3.587e-12, 500.0)
    else:
        radius, rho, variance, weights = 10.86e6, 8e-10, 8.55e-12, (2.78e3, 1.39e10)
    x0, xf, e0, _ = statement.boundary_values(statement.values)
    np.testing.assert_allclose(x0, [328000.0, 0.0, 15000.0, -0.19, np.log(rho)])
    np.testing.assert_array_equal(xf, [29600.0, 0.5983, np.nan, np.nan, np.nan])
    variances = [2.56e8, 2.56e8 / (radius + 328000.0) ** 2, 10.0, 4.44e-8, variance / rho**2]
    np.testing.assert_allclose(e0[:15], lower(np.diag(variances)), rtol=1e-12)
    end = statement.matrix_end(xf, 900.0, statement.values).full().ravel()
    np.testing.assert_allclose(end, lower(np.diag([*weights, 0.0, 0.0, 0.0])), rtol=1e-4)
    assert (statement.duration.guess, statement.duration.free) == (900.0, False)
    np.testing.assert_array_equal(np.ravel(statement.control_bounds), [-0.2, 0.7])
    assert [entry.unit for entry in problem.declarations.states] == ["ft", "rad", "ft/s", "rad", "ln(slug/ft^3)"]


def test_without_regularization_only_the_covariances_cost():
    statement = mars_entry.problem(regularization=None).statement()
    x, zero = reference().x[0], np.zeros(30)
    assert float(statement.rates(x, [0.9], zero, 0.0, DURATION, statement.values)[2]) == 0.0
    regularized = mars_entry.problem().statement()
    running = regularized.rates(x, [0.9], zero, 0.0, DURATION, regularized.values)[2]
    assert float(running) == pytest.approx(0.5e-5 * 0.4**2)


def test_duration_may_be_free():
    statement = mars_entry.problem(duration=co.Free(915.0, 850.0, 1000.0)).statement()
    duration = statement.duration
    assert (duration.guess, duration.lower, duration.upper, duration.free) == (915.0, 850.0, 1000.0, True)


def test_loads_of_the_reference():
    problem, loop = mars_entry.problem(), reference()
    assert mars_entry.reference() == {problem.declarations.controls[0].name: 0.5}
    rho, v = np.exp(loop.x[:, 4]), loop.x[:, 2]
    load = values(problem, mars_entry.load_factor(problem), loop.x, loop.u)
    np.testing.assert_allclose(load, 0.5 * 1.023 * rho * v**2 * np.sqrt(1.25) / 32.174, rtol=1e-12)
    assert load.max() == pytest.approx(3.49, abs=0.005)
    heat = values(problem, mars_entry.heat_rate(problem), loop.x, loop.u)
    np.testing.assert_allclose(heat, 1e-8 * np.sqrt(rho) * v**3, rtol=1e-12)
    assert heat.max() == pytest.approx(23.6, abs=0.05)


def test_optimum_has_the_specified_cost():
    problem, solution = optimum()
    assert solution.cost == pytest.approx(5.7667749e-4, rel=1e-5)
    ratio = solution["lift_to_drag"]
    np.testing.assert_allclose([ratio.min(), ratio.max()], [0.303, 0.793], atol=1e-3)
    assert solution["v"][-1] == pytest.approx(1184, abs=0.5)
    # The largest load lies between two nodes.
    assert solution[mars_entry.load_factor(problem)].max() == pytest.approx(3.25, rel=1e-2)
    assert solution[mars_entry.heat_rate(problem)].max() == pytest.approx(23.36, rel=1e-3)


def test_reference_integrator_finds_the_optimum_along_its_control():
    _, solution = optimum()
    control, breaks = piecewise_linear(solution.t, solution["lift_to_drag"])
    loop = closed_loop(mars(regularization=1e-5), control, DURATION, breaks=breaks, times=[0.0, DURATION])
    assert loop.cost == pytest.approx(5.7667749e-4, rel=2e-6)
    assert loop.equivalent == pytest.approx(loop.cost, rel=1e-9)
    assert loop.matrix_terms == pytest.approx(5.424501e-4, rel=1e-5)
    np.testing.assert_allclose(rms(loop), [4213.9, 16358.4, 9.472, 0.00264], rtol=1e-3)
    np.testing.assert_allclose(loop.x[-1, :2], [29600.0, 0.5983], rtol=1e-5)


# --- atmospheres ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_atmosphere_interpolates_its_tables(kind):
    air = mars_entry.atmosphere(kind)
    h = air.altitude[: air.density.size]
    np.testing.assert_allclose(air.density_at(h), air.density, rtol=1e-14)
    middle = (h[1:] + h[:-1]) / 2
    np.testing.assert_allclose(air.density_at(middle), np.sqrt(air.density[1:] * air.density[:-1]), rtol=1e-12)
    assert np.ndim(air.density_at(middle[0])) == 0
    everywhere = np.linspace(-2e4, 6e5, 1001)
    assert (np.diff(air.density_at(everywhere)) < 0).all()
    np.testing.assert_allclose(air.scale_height_at(air.altitude), air.scale_height, rtol=1e-14)
    symbol = ca.MX.sym("h")
    # to scalar operations: an interpolant would not expand
    function = ca.Function("H", [symbol], [air.scale_height_expression(symbol)]).expand()
    np.testing.assert_allclose(
        function(ca.DM(everywhere).T).full().ravel(), air.scale_height_at(everywhere), rtol=1e-12
    )


@pytest.mark.parametrize("kind", KINDS)
def test_tables_of_density_and_scale_height_agree(kind):
    """ln(rho) falls by int dh/H from node to node, up to the digits of the tables; one node of "low" is 8 % off."""
    air = mars_entry.atmosphere(kind)
    falls = [
        (b - a) / (high - low) * np.log(high / low)
        for (a, b), (low, high) in zip(pairwise(air.altitude), pairwise(air.scale_height), strict=True)
    ]
    ratios = -np.diff(np.log(air.density)) / falls[: air.density.size - 1]
    off = np.abs(ratios - 1) > 0.03
    assert off.sum() == (kind == "low")
    if kind == "low":
        assert ratios[off] == pytest.approx(1.08, abs=0.005)
        assert air.altitude[:-2][off] == 32810.0


@pytest.mark.parametrize("kind", KINDS)
def test_truth_flies_through_its_atmosphere(kind):
    """Density along the flight: that of the table at the start, monotone, near the table's on the way down."""
    air = mars_entry.atmosphere(kind)
    statement = mars_entry.truth(kind).statement()
    x0, *_ = statement.boundary_values(statement.values)
    assert x0[4] == pytest.approx(np.log(air.density_at(328000.0)), rel=1e-12)

    def rate(t, x):
        return statement.nominal(x, [0.5], t, DURATION, statement.values)[0].full().ravel()

    def arrived(t, x):
        return x[0] - 40000.0

    arrived.terminal = True
    down = solve_ivp(rate, (0.0, 2 * DURATION), x0, events=arrived, rtol=1e-9, atol=1e-9)
    h, log_density = down.y[0], down.y[4]
    order = np.argsort(h)
    assert (np.diff(log_density[order]) <= 1e-9).all()
    # 3 % of ln(rho(40,000 ft)/rho(328,000 ft)), 6 to 15, by the disagreement of the tables
    np.testing.assert_allclose(log_density, np.log(air.density_at(h)), atol=0.5)
    exact = [log_density[0] + fall(air, height, h[0]) for height in h]
    # The integrator steps over the kinks of H at the nodes of the table.
    np.testing.assert_allclose(log_density, exact, atol=1e-5)


def fall(air, low, high):
    """int dh/H from low to high, H linear between the nodes."""
    inside = air.altitude[(air.altitude > min(low, high)) & (air.altitude < max(low, high))]
    knots = np.sort([low, high, *inside])
    heights = air.scale_height_at(knots)
    total = sum(
        (b - a) * np.log(q / p) / (q - p)
        for (a, b), (p, q) in zip(pairwise(knots), pairwise(heights), strict=True)
        if q != p
    )
    return total if high > low else -total


def test_truth_differs_in_the_atmosphere_only():
    design, truth = mars_entry.problem(), mars_entry.truth("high")
    assert [entry.name for entry in design.states] == [entry.name for entry in truth.states]
    assert [entry.name for entry in design.controls] == [entry.name for entry in truth.controls]
    x, u = reference().x[900], np.array([0.4])
    first, second = (
        problem.statement().nominal(x, u, 0.0, DURATION, problem.statement().values)[0].full().ravel()
        for problem in (design, truth)
    )
    np.testing.assert_array_equal(first[:4], second[:4])
    H = mars_entry.atmosphere("high").scale_height_at(x[0])
    assert second[4] == pytest.approx(first[4] * SCALE_HEIGHT / H, rel=1e-12)
    _, _, e0, _ = design.statement().boundary_values(design.statement().values)
    _, _, e1, _ = truth.statement().boundary_values(truth.statement().values)
    np.testing.assert_array_equal(e0[:15], e1[:15])


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: mars_entry.problem(data="prnted"), "prnted"),
        (lambda: mars_entry.truth("average"), "average"),
        (lambda: mars_entry.truth(data="none"), "none"),
        (lambda: mars_entry.atmosphere("Mean"), "Mean"),
        (lambda: mars_entry.load_factor(goddard_rocket.problem()), "log_density"),
        (lambda: mars_entry.heat_rate(goddard_rocket.problem()), "log_density"),
        (lambda: mars_entry.problem(lower=0.6, upper=0.4), "lift_to_drag"),
        (lambda: mars_entry.problem(control_weight=-1.0), "lift_to_drag"),
    ],
)
def test_bad_input_is_refused(call, named):
    refused(call, named)


def test_a_control_without_weight_is_refused():
    with pytest.raises(co.ProblemError, match="lift_to_drag"):
        mars_entry.problem(control_weight=0.0).statement()


def test_the_reference_integrator_has_the_constants_of_the_model():
    assert mars_entry.DATA["recommended"].radius == closed_loops.RADIUS
