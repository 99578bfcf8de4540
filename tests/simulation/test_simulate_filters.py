"""The filters of a simulation: against scipy's integration, at steps far too long for their rates, and their bands."""

from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from loops import linear_quadratic, setting_of
from scipy import stats
from scipy.integrate import solve_ivp

import covocp as co
from covocp.base.errors import ProblemError
from covocp.base.matrices import pack, unpack
from covocp.simulation.constraints import counted_rows
from covocp.simulation.filtering import corrected
from covocp.simulation.plan import make_plan
from covocp.simulation.prediction import predict
from covocp.simulation.run_parts import run_symbols
from covocp.simulation.runs import simulate
from covocp.simulation.sampling import THREE_SIGMA, mean_band
from covocp.simulation.schedule import base_grid, coefficients

OPTIONS = {"progress": False}


def beacon(start=(0.0, 0.0), mean=1.0, *, noise=1e-2, variance=(0.04, 0.01), measured=0.01):
    """A body with unknown drag and the distance to a beacon as its measurement: everything is nonlinear."""
    problem = co.Problem(duration=3.0, name="beacon")
    x = problem.state("x", 2, initial=list(start), variance=variance[0])
    k = problem.unknown("k", mean=mean, variance=variance[1])
    u = problem.control("u")
    problem.dynamics(x, ca.vertcat(x[1], u - k * ca.fabs(x[1]) * x[1]), noise=[0.0, noise])
    problem.measurement("distance", ca.sqrt(1.0 + (x[0] - 2.0) ** 2), noise=measured)
    problem.minimize_expected(running=0.5 * u**2 + 0.1 * u * x[0], terminal=(x[0] - 1.0) ** 2, terminal_weight={x: 1.0})
    return problem


def extended_truth(solution, start, mean):
    """x, estimate and E at the end by scipy for a run without noise: extended Kalman-Bucy filter and feedback."""

    def rate(x, k, u):
        return np.array([x[1], u - k * abs(x[1]) * x[1]])

    def joint(t, z):
        x, y, E = z[:2], z[2:5], unpack(z[5:], 3)
        at = solution.at(min(t, 3.0))
        nominal = np.append(at["x"], 1.0)
        # The gain along the nominal, from S as the solution has it between its nodes; B = 1, N = 0.1 of u x.
        C = at["S"][1] + np.array([0.1, 0.0, 0.0])
        u = at["u"] - C @ (y - nominal)
        F = np.array([[0, 1, 0], [0, -2 * y[2] * abs(y[1]), -abs(y[1]) * y[1]], [0, 0, 0]])
        M = np.array([(y[0] - 2) / np.sqrt(1 + (y[0] - 2) ** 2), 0, 0])
        K = E @ M / 0.01
        residual = np.sqrt(1 + (x[0] - 2) ** 2) - np.sqrt(1 + (y[0] - 2) ** 2)
        spread = F @ E + E @ F.T + np.diag([0, 1e-2, 0]) - np.outer(K, K) * 0.01
        return np.concatenate([rate(x, mean, u), np.append(rate(y[:2], y[2], u), 0.0) + K * residual, pack(spread)])

    E = solution["E"][0]
    z = np.concatenate([start, [0.0, 0.0, 1.0], pack(E)])
    for a, b in zip(solution.t[:-1], solution.t[1:], strict=True):
        z = solve_ivp(joint, (a, b), z, rtol=1e-9, atol=1e-11).y[:, -1]
    return z


def test_the_extended_filter_is_that_of_scipy_along_single_runs():
    """Runs without noise from elsewhere, with another drag: plant, estimate and feedback converge to scipy's."""
    solution = co.solve(beacon(), intervals=30, **OPTIONS)
    start, mean = (0.15, -0.1), 1.1
    still = beacon(start, mean, noise=1e-30, variance=(1e-30, 1e-30), measured=1e-30)
    exact = extended_truth(solution, start, mean)
    errors = []
    for step in (0.1, 0.05, 0.025):
        sample = simulate(solution, 2, 1, truth=still, step=step, filter="extended", **OPTIONS)
        nominal = sample.nominal[-1]
        found = np.concatenate([sample.deviations[0, :2] + nominal[:2], sample.estimates[0] + nominal])
        errors.append(np.abs(found - exact[:5]).max())
    assert errors[2] < 2e-3
    assert errors[2] < 0.7 * errors[1] < 0.49 * errors[0]


@pytest.mark.parametrize("kind", ["perturbation", "extended"])
@pytest.mark.parametrize("step", [0.5, 0.05, None])
def test_no_step_makes_a_filter_unstable(kind, step):
    """A sensor a million times as accurate as the start is known: a filter of 10^4 per second, steps of up to 0.5 s."""
    problem = co.Problem(10.0, "accurate sensor")
    x, u = problem.state("x", initial=0.0, variance=100.0), problem.control("u")
    problem.dynamics(x, -0.1 * x + u, noise=0.1)
    problem.measurement("m", x, noise=0.01)
    E = problem.estimation_covariance()
    problem.minimize(running=u**2, terminal=E[x, x])
    solution = co.solve(problem, intervals=50, **OPTIONS)
    sample = simulate(solution, 1000, 1, filter=kind, step=step, **OPTIONS)
    assert sample.left_share == 0.0
    assert sample.verdict.holds
    exact = -0.001 + np.sqrt(0.001**2 + 0.001)  # 0 = -0.2 E + 0.1 - E^2/0.01
    assert solution["E"][-1, 0, 0] == pytest.approx(exact, rel=1e-4)
    errors = (sample.estimates - sample.deviations)[:, 0]
    low, high = stats.chi2.ppf([0.00135, 0.99865], 1000) / 1000
    # A given step of half a second is longer than the filter is fast, and shortened to its time constant.
    assert low < np.mean(errors**2) / exact < high
    assert sample.step.longest <= 0.5


def test_the_covariance_of_the_extended_filter_stays_semidefinite_at_any_step():
    """Readings so accurate and steps so long that the rate of E would leave the semidefinite matrices at once."""
    solution = co.solve(beacon(), intervals=10, **OPTIONS)
    setting = setting_of(solution, "extended")
    chosen = coefficients(setting.design, "extended")
    run = run_symbols(setting, chosen, len(counted_rows(setting.design).at("path")))
    c, w, h = ca.SX.sym("c", chosen.rows), ca.SX.sym("w", 1), ca.SX.sym("h")
    after = corrected(run, run.z, chosen.split(c), w, h, late=False)
    update = ca.Function("update", [run.z, run.own, c, w, h], [after[run.spans["E"]]])
    generator = np.random.default_rng(3)
    for exponent in (-6.0, 0.0, 6.0):
        for length in (1e-3, 1.0, 1e3):
            factor = generator.standard_normal((3, 3)) * 10.0**exponent
            z = generator.standard_normal(run.z.shape[0])
            z[run.spans["E"]] = pack(factor @ factor.T)
            E = unpack(np.asarray(update(z, 1.0, np.zeros(chosen.rows), 0.3, length).full()).ravel(), 3)
            values = np.linalg.eigvalsh(E)
            assert values[0] >= -1e-13 * values[-1]
            assert np.trace(E) <= np.trace(factor @ factor.T) * (1 + 1e-12)


# --- another mean of an unknown -------------------------------------------------------------------------------------


def plant(mean, gain=0.0, bias=False):
    """x' = u + d - gain d x, measured with d where it is a bias; nearly nothing is learnt and fed back."""
    problem = co.Problem(duration=2.0)
    x = problem.state("x", initial=0.0, variance=0.01)
    d = problem.unknown("d", mean=mean, variance=0.01)
    u = problem.control("u")
    problem.dynamics(x, u + (0.0 if bias else 1.0) * d - gain * d * x, noise=0.01)
    problem.measurement("m", x + d if bias else x, noise=1.0 if bias else 1e4)
    problem.minimize_expected(running=0.5 * u**2, terminal_weight={x: 1e-8})
    return problem


@pytest.mark.parametrize("gain", [0.0, 0.5])
@pytest.mark.parametrize("truth", ["problem", "value"])
def test_another_mean_of_an_unknown_counts_once(truth, gain):
    """x' = d - gain d x from 0 with d = 0.5: 1/gain (1 - exp(-gain d T)), 1.0 for no gain, exactly."""
    solution = co.solve(plant(0.0, gain), intervals=20, **OPTIONS)
    sample = simulate(solution, 2000, 1, truth=plant(0.5, gain) if truth == "problem" else {"d": 0.5}, **OPTIONS)
    exact = (1 - np.exp(-gain)) / gain if gain else 1.0
    assert sample.predicted_mean[-1].tolist() == pytest.approx([exact, 0.5], rel=1e-6)
    assert abs(sample.bias("x")[-1] - exact) < 4 * np.std(sample.terminal("x")) / np.sqrt(2000)
    if gain == 0.0:
        assert sample.verdict.holds


def test_a_bias_of_another_mean_is_another_truth():
    """The rates and slopes are the design's; only the measured values tell, and linear theory is exact for them."""
    solution = co.solve(plant(0.0, bias=True), intervals=20, **OPTIONS)
    sample = simulate(solution, 4000, 1, truth=plant(0.5, bias=True), **OPTIONS)
    error = (sample.estimates - sample.deviations).mean(axis=0)
    predicted = np.sqrt(np.diagonal(sample.predicted_error[-1]))
    assert all(entry.inside for entry in sample.verdict.errors)
    assert abs(error[1]) > 0.3
    assert predicted[1] > 0.3
    with pytest.raises(ProblemError, match="the mean of 'd'"):
        co.evaluate(solution, truth=plant(0.5, bias=True))


# --- bands ----------------------------------------------------------------------------------------------------------


def test_the_band_of_a_mean_covers_what_it_promises_with_ten_runs():
    """100,000 samples of ten normal runs: 99.73 % of the bands hold the mean, within the binomial error."""
    values = np.random.default_rng(1971).standard_normal((100_000, 10))
    mean, square = values.mean(axis=1), (values**2).mean(axis=1)
    low, high = mean_band(mean, square - mean**2, 10, THREE_SIGMA)
    covered = np.mean((low <= 0.0) & (high >= 0.0))
    assert abs(covered - THREE_SIGMA) < 3.5 * np.sqrt(THREE_SIGMA * (1 - THREE_SIGMA) / values.shape[0])
    assert np.isinf(mean_band(np.zeros(1), np.zeros(1), np.ones(1), THREE_SIGMA)).all()


def test_the_band_of_a_mean_of_ten_simulated_runs():
    """Ten runs at a time of a scalar system whose mean is known: 99.73 % of the bands hold it."""
    problem = co.Problem(duration=1.0)
    x, u = problem.state("x", initial=1.0, variance=0.5), problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, -0.7 * x, noise=0.2)
    problem.estimation_covariance()
    problem.minimize(running=(u - 0.1) ** 2)
    solution = co.solve(problem, intervals=4, **OPTIONS)
    values = simulate(solution, 40_000, 5, step=0.25, store=2, paths=0, **OPTIONS).terminal("x").reshape(-1, 10)
    mean, square = values.mean(axis=1), (values**2).mean(axis=1)
    low, high = mean_band(mean, square - mean**2, 10, THREE_SIGMA)
    held = int(np.count_nonzero((low <= 0.0) & (high >= 0.0)))
    assert stats.binomtest(held, 4000, THREE_SIGMA).pvalue > 0.0027
    sample = simulate(solution, 10, 5, step=0.25, store=2, paths=0, **OPTIONS)
    own = sample.mean_band("x")
    assert own[1][-1] - own[0][-1] == pytest.approx(high[0] - low[0], rel=1e-9)  # the same ten runs


# --- predictions that mean nothing ----------------------------------------------------------------------------------


def steep(**options):
    """A terminal weight so large that the gain rises within the last interval of a uniform mesh."""
    problem = co.Problem(40.0, "steep terminal weight")
    x = problem.state("x", 2, initial=[100.0, 0.0], final=[0.0, 0.0], variance=[25.0, 0.25])
    u = problem.control("u", lower=-5.0, upper=5.0)
    problem.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, 1e-2])
    problem.measurement("m", x[0], noise=0.1)
    problem.minimize_expected(running=0.5 * u**2, terminal_weight={x: [1e4, 1e4]})
    return co.solve(problem, **OPTIONS, **options)


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")
def test_gains_between_the_nodes_of_a_coarse_mesh_hold_what_is_promised():
    """Uniform nodes, the gain rises within the last interval: what flies there is what the integrator computes."""
    solution = steep(grid=np.linspace(0.0, 1.0, 41))
    setting = setting_of(solution)
    flown = predict(solution, setting.design, setting.design, base_grid(solution, 11)).deviation[-1]
    np.testing.assert_allclose(np.sqrt(np.diagonal(flown)), [0.29164, 0.15861], rtol=0.02)  # of a mesh 10 times as fine


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")
def test_a_prediction_that_is_no_number_is_never_stability(monkeypatch):
    def lost(*arguments):
        found = predict(*arguments)
        return replace(found, covariance=np.full_like(found.covariance, np.nan))

    monkeypatch.setattr("covocp.simulation.runs.predict", lost)
    solution = steep(grid=np.linspace(0.0, 1.0, 41))
    sample = simulate(solution, 64, 1, limits="bounds", step=0.05, store=11, **OPTIONS)
    assert not sample.verdict.holds
    assert "gains" in sample.verdict.reasons
    assert "no run is unstable" not in str(sample.verdict)
    assert "promised" in str(sample.verdict)
    promise = np.sqrt(np.diagonal(solution.loop.X[-1]))
    far = (np.abs(sample.deviations) > 10 * promise).any(axis=1)
    assert sample.verdict.unstable == pytest.approx((far | ~sample.stayed).mean())


def test_the_promise_is_what_flies_on_a_mesh_that_resolves_the_gains():
    sample = simulate(steep(grid=1 - (1 - np.linspace(0, 1, 81)) ** 3), 64, 1, step=0.05, store=11, **OPTIONS)
    assert sample.verdict.broken == ()
    assert "gains" not in sample.verdict.reasons


# --- the step -------------------------------------------------------------------------------------------------------


def test_a_given_step_that_is_to_blame_is_named():
    """A stiff plant, nonlinear away from its nominal: true at a short step, not at the given one, and it says which."""
    problem = co.Problem(duration=4.0)
    x, u = problem.state("x", initial=0.0, variance=1.0), problem.control("u")
    problem.dynamics(x, -x - 4.0 * x**3 + u, noise=0.5)
    problem.measurement("m", x, noise=1.0)
    problem.minimize_expected(running=0.5 * u**2, terminal_weight={x: 1e-3})
    solution = co.solve(problem, intervals=8, **OPTIONS)
    with pytest.warns(co.base.errors.CovocpWarning, match="step of 0.5 s is too long"):
        long = simulate(solution, 2000, 1, step=0.5, **OPTIONS)
    short = simulate(solution, 2000, 1, step=0.01, **OPTIONS)
    assert long.verdict.reasons[0] == "step"
    assert long.step.change > 1.0
    assert "step" not in short.verdict.reasons
    assert not short.verdict.holds
    assert short.step.change < 1.0
    assert "the given step is too long" in str(long.verdict)


def test_discrete_moments_of_the_perturbation_filter_are_of_second_order():
    """A linear step is a matrix: halving it brings its exact moments four times nearer to linear theory."""
    solution = co.solve(linear_quadratic(), intervals=40, **OPTIONS)
    setting, base = setting_of(solution), base_grid(solution, 2)
    exact = predict(solution, setting.design, setting.design, base).covariance[-1]
    errors = [np.abs(_moments(make_plan(setting, base.divided(k), base.t[[0, -1]], seed=1)) - exact) for k in (1, 2, 4)]
    for one, two in pairwise(errors):
        assert 3.5 < np.diagonal(one).max() / np.diagonal(two).max() < 4.5
    assert np.diagonal(errors[2]).max() < 2e-3 * np.diagonal(exact).max()


def _moments(plan):
    """Covariance of deviation and estimate after all steps of a plan."""
    a = [ca.MX.sym(f"a{i}", plan.step.size1_in(i)) for i in range(4)]
    after = plan.step(*a)[0]
    rows = list(range(plan.spans["x"].start, plan.spans["estimate"].stop))
    matrices = ca.Function("J", a, [ca.jacobian(after, a[0])[rows, rows], ca.jacobian(after, a[1])[rows, :]])
    covariance = np.zeros((len(rows), len(rows)))
    covariance[: plan.states, : plan.states] = (plan.spread @ plan.spread.T)[: plan.states, : plan.states]
    for row in plan.steps:
        A, B = (np.asarray(value.full()) for value in matrices(plan.start, 0, 0, row))
        covariance = A @ covariance @ A.T + B @ B.T
    return covariance
