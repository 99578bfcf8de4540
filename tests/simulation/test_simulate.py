"""Simulations against closed forms, linear theory where it is exact, and section 9 of the specification (6.12)."""

from dataclasses import replace

import numpy as np
import pytest
from loops import GRADED, linear_quadratic, open_loop, setting_of, steered
from scipy import special, stats

import covocp as co
from covocp.base.errors import CovocpWarning, ProblemError
from covocp.simulation.prediction import predict
from covocp.simulation.runs import simulate
from covocp.simulation.sampling import THREE_SIGMA
from covocp.simulation.schedule import base_grid
from covocp.simulation.step_choice import MOST_STEPS, PATIENT, _pair, choose_step

OPTIONS = {"progress": False}


def words(sample):
    """The report on one line."""
    return " ".join(str(sample).split())


def square_error(values):
    """Standard error of the mean square."""
    return float(np.std(values**2, ddof=1) / np.sqrt(values.size))


@pytest.fixture(scope="module")
def lag():
    return steered(0.1)


@pytest.fixture(scope="module")
def oscillator():
    return co.solve(linear_quadratic(), intervals=40, progress=False)


@pytest.fixture(scope="module")
def oscillations(oscillator):
    return simulate(oscillator, 4000, 1, **OPTIONS)


# --- closed forms ---------------------------------------------------------------------------------------------------


def test_ornstein_uhlenbeck_process_has_its_moments():
    a, q, v, x0 = 0.7, 0.2, 0.5, 1.0
    solution = co.solve(open_loop(noise=q, variance=v, measured=False), intervals=20, progress=False)
    sample = simulate(solution, 4000, 3, step=0.05, **OPTIONS)
    t = sample.t
    exact = v * np.exp(-2 * a * t) + q / (2 * a) * (1 - np.exp(-2 * a * t))
    np.testing.assert_allclose(sample.predicted_deviation("x") ** 2, exact, rtol=1e-6)
    # At every time: a chi-square law with as many degrees of freedom as runs (3 sigma, all times together).
    level = 1 - 0.0027 / t.size
    low, high = (stats.chi2.ppf(p, 4000) / 4000 for p in ((1 - level) / 2, (1 + level) / 2))
    ratio = sample.deviation("x") ** 2 / exact
    assert (low < ratio).all()
    assert (ratio < high).all()
    np.testing.assert_allclose(sample.mean("x"), x0 * np.exp(-a * t), atol=4 * np.sqrt(v / 4000))


def test_noise_that_depends_on_the_state_is_that_of_ito():
    # dx = -a x dt + s x dw: <x^2> = x0^2 exp((s^2 - 2a) t); in the sense of Stratonovich it would be 2 s^2.
    a, s = 0.3, 0.5
    problem = open_loop(lambda x, u: -a * x, noise=lambda x: s**2 * x**2, variance=None, measured=False, duration=1.0)
    sample = simulate(co.solve(problem, intervals=10, progress=False), 20000, 2, step=0.02, **OPTIONS)
    square = (1.0 * np.exp(-a) + sample.terminal("x")) ** 2
    error = square.std() / np.sqrt(square.size)
    assert abs(square.mean() - np.exp(s**2 - 2 * a)) < 3 * error
    assert abs(square.mean() - np.exp(2 * s**2 - 2 * a)) > 5 * error


def test_linear_theory_is_exact_for_a_linear_system(oscillations, oscillator):
    sample = oscillations
    for covariance, values in (
        (oscillator.loop.X[-1], sample.deviations),
        (oscillator["E"][-1], sample.estimates - sample.deviations),
        (oscillator.loop.Xhat[-1], sample.estimates),
    ):
        # Mahalanobis distances add up to a chi-square law; so do the squares of each component.
        distance = float(np.sum(values @ np.linalg.inv(covariance) * values))
        assert abs(special.ndtri(stats.chi2.cdf(distance, values.size))) < 3
        for i in range(2):
            whole = float(np.sum(values[:, i] ** 2) / covariance[i, i])
            assert abs(special.ndtri(stats.chi2.cdf(whole, len(values)))) < 3
    assert sample.verdict.holds
    assert sample.verdict.reasons == ()
    assert abs(sample.cost - oscillator.cost) < 3 * sample.cost_error
    assert sample.predicted_cost == oscillator.cost
    assert sample.step.settled


def test_the_estimate_is_orthogonal_to_its_error(oscillations):
    error, estimate = oscillations.estimates - oscillations.deviations, oscillations.estimates
    for i in range(2):
        for j in range(2):
            product = error[:, i] * estimate[:, j]
            assert abs(product.mean()) < 3 * product.std() / np.sqrt(product.size)


def test_both_filters_are_one_for_a_linear_system(oscillator):
    one, two = (simulate(oscillator, 64, 1, step=0.02, filter=kind, **OPTIONS) for kind in ("perturbation", "extended"))
    np.testing.assert_allclose(one.estimates, two.estimates, atol=2e-3 * one.estimates.std())


def test_prediction_is_that_of_the_solution(lag, oscillations, oscillator):
    sample = simulate(lag, 64, 1, step=0.1, **OPTIONS)
    np.testing.assert_allclose(sample.predicted[-1], lag.loop.X[-1], rtol=1e-5)
    np.testing.assert_allclose(sample.predicted_error[-1], lag["E"][-1], rtol=1e-5)
    # On 40 intervals, E and S between the nodes by cubic polynomials.
    np.testing.assert_allclose(oscillations.predicted[-1], oscillator.loop.X[-1], rtol=1e-4)
    assert (sample.predicted == sample.design).all()


# --- 6.12, section 9.3 of the specification: 20,000 runs of another program -----------------------------------------


@pytest.mark.parametrize(
    ("variance", "kind", "predicted", "expected", "error"),
    [
        (0.1, "perturbation", 0.477, 0.577, 0.019),
        (0.1, "extended", 0.477, 0.548, 0.019),
        (0.01, "perturbation", 0.459, 0.465, 0.005),
    ],
)
def test_spread_of_the_lag(variance, kind, predicted, expected, error):
    sample = simulate(steered(variance), 8000, 11, filter=kind, **OPTIONS)
    assert sample.predicted[-1, 0, 0] == pytest.approx(predicted, abs=6e-4)
    square = sample.deviations[:, 0]
    assert abs(np.mean(square**2) - expected) < 3 * np.hypot(error, square_error(square))
    assert sample.left_share == 0.0
    assert sample.share_beyond("x", 10.0) < 1e-3
    assert sample.verdict.holds == (variance == 0.01)
    assert sample.verdict.reasons == (() if variance == 0.01 else ("nonlinear",))


@pytest.mark.parametrize(("variance", "predicted", "beyond"), [(1.0, 0.604, 0.11), (5.0, 0.719, 0.29)])
def test_linear_gains_do_not_hold_unstable_plants(variance, predicted, beyond):
    runs = 4000
    sample = simulate(steered(variance), runs, 5, **OPTIONS)
    assert sample.predicted[-1, 0, 0] == pytest.approx(predicted, abs=6e-4)
    # The share is given to two digits, of 20,000 runs.
    error = np.sqrt(beyond * (1 - beyond) * (1 / runs + 1 / 20000))
    assert abs(sample.share_beyond("x", 10.0) - beyond) < 3 * error + 0.005
    assert sample.left_share > 0.02
    assert not sample.verdict.holds
    assert sample.verdict.reasons == ("unstable",)
    assert sample.verdict.unstable == pytest.approx(beyond, abs=3 * error + 0.02)
    assert "unstable" in str(sample)
    # They are counted, not averaged: every moment is finite, and the median does not see them.
    for values in (sample.deviation("x"), sample.mean("x"), sample.moments.fourth, sample.deviations):
        assert np.isfinite(values).all()
    assert sample.robust_deviation("x") < 2 * sample.predicted_deviation("x")[-1] < sample.deviation("x")[-1]
    assert (np.diff(sample.moments.count) <= 0).all()
    assert sample.moments.count[-1] == np.count_nonzero(sample.stayed)
    assert np.isnan(sample.costs[~sample.stayed]).all()
    assert np.isfinite(sample.cost)


def test_nothing_is_said_where_every_run_leaves(lag, monkeypatch):
    monkeypatch.setattr("covocp.simulation.stretch.LEFT", 1e-6)
    sample = simulate(lag, 64, 1, step=0.5, store=5, **OPTIONS)
    assert sample.left_share == 1.0
    assert sample.share_beyond("x", 1e9) == 1.0
    assert np.isnan(sample.cost)
    assert not sample.verdict.holds
    assert "100 % left the domain" in words(sample)
    assert np.isfinite(sample.deviations).all()


def test_incorrect_statistics():
    # Section 9.2: designed with Q = 1, U = 1, truth Q = 2, U = 0.5.
    from covocp.models import unknown_lag

    design = steered(5.0)
    truth = unknown_lag.steering(process_noise=2.0, measurement_noise=0.5)
    sample = simulate(design, 64, 1, truth=truth, step=0.1, **OPTIONS)
    assert sample.predicted[-1, 0, 0] == pytest.approx(1.17660, abs=2e-5)
    assert sample.predicted_error[-1, 0, 0] == pytest.approx(0.94895, abs=2e-5)
    assert sample.predicted_cost == pytest.approx(2.47971, abs=2e-5)
    assert sample.design[-1, 0, 0] == pytest.approx(0.719375, abs=2e-5)
    assert sample.design_cost == pytest.approx(2.027146, abs=1e-5)
    # At a variance for which the linear equations hold, so does the sample.
    truth = unknown_lag.steering(process_noise=2.0, measurement_noise=0.5, parameter_variance=0.01)
    sample = simulate(steered(0.01), 4000, 1, truth=truth, **OPTIONS)
    assert sample.verdict.holds
    assert abs(sample.cost - sample.predicted_cost) < 3 * sample.cost_error
    assert sample.verdict.deviations[0].low > np.sqrt(sample.design[-1, 0, 0])
    assert "The design expects another spread: x 0.6776" in words(sample)


# --- without a feedback ---------------------------------------------------------------------------------------------


def test_without_feedback_the_covariance_of_the_estimate_is_validated():
    sample = simulate(co.solve(open_loop(), intervals=20, progress=False), 4000, 1, **OPTIONS)
    assert not sample.fed_back
    assert sample.verdict.holds
    assert [entry.name for entry in sample.verdict.decisive] == ["x"]
    assert np.isnan(sample.cost)
    assert "no feedback" in str(sample)
    assert "errors of the filter holds" in str(sample)
    np.testing.assert_allclose(sample.error_covariance("x")[-1, 0, 0], sample.predicted_error[-1, 0, 0], rtol=0.07)


# --- the step -------------------------------------------------------------------------------------------------------


def test_a_coarse_start_is_refined_and_says_so(lag, oscillations):
    assert oscillations.step.change <= 0.2
    assert "sampling error" in oscillations.step.reason
    # More runs have a smaller sampling error, and need a smaller step.
    setting, base = setting_of(lag), base_grid(lag, 2)
    rates = predict(lag, setting.design, setting.design, base).step_rates
    few, many = (choose_step(setting, base, rates, runs=runs, seed=1, stop=lambda: False) for runs in (100, 100_000))
    assert few.settled
    assert many.settled
    assert many.longest < few.longest


@pytest.mark.parametrize("falls", [1.0, 0.5])
def test_the_search_of_a_step_has_an_end(lag, monkeypatch, falls):
    """Runs that part however short the steps are, or that come together slowly: pairs would be divided without end."""
    setting, base, tried = setting_of(lag), base_grid(lag, 2), []

    def change(coarse, fine, runs):
        return 900.0 * falls ** len(tried)

    def pair(setting, coarse, fine, *given):
        tried.append(coarse.steps)
        return flown

    flown = _pair(setting, base, base.divided(2), 2, 1, lambda: False, None)
    monkeypatch.setattr("covocp.simulation.step_choice._pair", pair)
    monkeypatch.setattr("covocp.simulation.step_choice._largest_change", change)
    rates = predict(lag, setting.design, setting.design, base).step_rates
    choice = choose_step(setting, base, rates, runs=100, seed=1, stop=lambda: False)
    assert not choice.settled
    assert choice.grid.steps == tried[-1]  # what is said of the step was found there
    assert choice.change == 900.0 * falls ** len(tried)
    assert 2 * tried[-2] < (PATIENT if falls == 1.0 else MOST_STEPS)
    assert tried[-1] <= MOST_STEPS
    assert choice.stalled == (falls == 1.0)
    assert choice.stalled == ("steps are shorter" in choice.reason)


def test_a_given_step_is_the_longest(lag, oscillator):
    given = simulate(oscillator, 64, 1, step=0.05, **OPTIONS)
    assert given.step.given
    assert [given.step.shortest, given.step.longest] == pytest.approx([0.05, 0.05])
    assert given.step.reason == "as given"
    assert simulate(lag, 64, 1, step=0.25, **OPTIONS).step.longest == pytest.approx(0.25, rel=0.05)


def test_a_step_that_does_not_settle_is_a_warning(lag, monkeypatch):
    monkeypatch.setattr("covocp.simulation.step_choice.SHARE", 1e-9)
    monkeypatch.setattr("covocp.simulation.step_choice.PAIRS", 1)
    with pytest.warns(CovocpWarning, match="did not settle"):
        sample = simulate(lag, 64, 1, **OPTIONS)
    assert not sample.step.settled
    assert "NOT SETTLED" in str(sample)


# --- what the actual control can do ---------------------------------------------------------------------------------


def test_limits_of_the_actual_control(oscillator):
    free = simulate(oscillator, 1000, 1, step=0.02, **OPTIONS)
    tight = simulate(oscillator, 1000, 1, step=0.02, limits={"u": (-0.5, [0.5, 3.0])}, **OPTIONS)
    assert free.asked_share == 0.0
    assert not free.limited
    assert tight.limited
    assert tight.asked_share > 0.5
    assert 0 < tight.asking.max() <= tight.asked_share
    applied = tight.nominal_control[None] + tight.paths[:, :, 4:]
    assert applied.min() >= -0.5 - 1e-12
    assert applied[..., 0].max() <= 0.5 + 1e-12
    assert tight.verdict.reasons == ("saturated",)
    assert "more control than there is" in str(tight.verdict)
    # The filter knows the control that was applied: its errors stay what they are.
    assert all(entry.inside for entry in tight.verdict.errors)


def test_bounds_of_the_problem_as_limits_and_as_a_measure():
    problem = linear_quadratic()
    limited = replace(problem.declarations.controls[0], lower=np.full(2, -0.8), upper=np.full(2, 0.8))
    problem = co.Problem.of(replace(problem.declarations, controls=(limited,)))
    solution = co.solve(problem, intervals=40, progress=False)
    free = simulate(solution, 500, 1, step=0.02, **OPTIONS)
    bound = simulate(solution, 500, 1, step=0.02, limits="bounds", **OPTIONS)
    assert free.asked_share > 0.3
    assert free.outside_share["u[0]"] > 0.1
    assert bound.outside_share["u[0]"] == 0.0
    assert bound.asked_share > 0.3
    assert "they were given it" in words(free)
    assert "it was limited to that" in words(bound)


def test_states_that_leave_their_bounds_are_counted():
    problem = linear_quadratic()
    own = problem.declarations
    bounded = replace(own.states[0], lower=np.array([-0.5, -np.inf]), upper=np.array([1.5, np.inf]))
    problem = co.Problem.of(replace(own, states=(bounded, *own.states[1:])))
    sample = simulate(co.solve(problem, intervals=40, progress=False), 1000, 1, step=0.02, **OPTIONS)
    assert 0.1 < sample.outside_share["r[0]"] < 1.0
    assert "r[0]" in str(sample)


# --- another truth --------------------------------------------------------------------------------------------------


def test_a_truth_of_other_dynamics(oscillator):
    stiff = linear_quadratic(frequency=1.6)
    one = simulate(oscillator, 2000, 1, step=0.02, truth=stiff, **OPTIONS)
    two = simulate(oscillator, 2000, 1, step=0.02, truth={"w": 1.6}, **OPTIONS)
    assert (one.deviations == two.deviations).all()
    assert one.truth == "oscillator"
    assert two.truth == "w = 1.6"
    # The truth is linear: theory with its dynamics is exact for the mean square about the nominal.
    assert one.verdict.holds
    assert abs(one.bias("r")[-1, 0] - one.predicted_mean[-1, 0]) < 4 * one.deviation("r")[-1, 0] / np.sqrt(2000)
    assert abs(one.predicted_mean[-1, 0]) > 0.01
    assert (np.abs(one.predicted[-1] / one.design[-1] - 1) > 0.01).any()


def test_an_unknown_that_is_known_in_truth(lag):
    b = lag.symbols["b"]
    sample = simulate(lag, 200, 1, step=0.1, truth={b: 0.8}, **OPTIONS)
    np.testing.assert_allclose(sample.terminal("b"), -0.2, atol=1e-14)
    np.testing.assert_allclose(sample.mean(b), 0.8)
    assert np.isnan(sample.predicted_cost)  # the linear equations of the cost know one system only


def test_a_truth_with_tables_goes_another_way(oscillator):
    import casadi as ca

    knots = np.linspace(-60.0, 60.0, 121)
    table = ca.interpolant("table", "bspline", [knots], knots)
    one = simulate(oscillator, 70, 1, step=0.1, truth=linear_quadratic(restoring=table), **OPTIONS)
    two = simulate(oscillator, 70, 1, step=0.1, **OPTIONS)
    np.testing.assert_allclose(one.deviations, two.deviations, atol=1e-9)


# --- the result -----------------------------------------------------------------------------------------------------


def test_moments_are_those_of_the_runs(oscillations):
    sample, values = oscillations, oscillations.deviations
    np.testing.assert_allclose(sample.moments.mean[-1, :2], values.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(sample.covariance("r")[-1], values.T @ values / 4000, rtol=1e-9)
    np.testing.assert_allclose(sample.covariance("r", about="mean")[-1], np.cov(values.T, bias=True), rtol=1e-9)
    np.testing.assert_allclose(sample.moments.fourth[-1, :2], (values**4).mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(sample.moments.cube[-1, :2], (values**3).mean(axis=0), atol=1e-12)
    error = sample.estimates - values
    np.testing.assert_allclose(sample.error_covariance("r")[-1], error.T @ error / 4000, rtol=1e-9)
    assert (sample.moments.count == 4000).all()


def test_bands_hold_what_they_promise(oscillations):
    sample = oscillations
    for key in ("r", "u"):
        (low, high), middle = sample.deviation_band(key), sample.deviation(key)
        assert ((low <= middle) & (middle <= high)).all()
        (low, high), middle = sample.mean_band(key), sample.mean(key)
        assert ((low <= middle) & (middle <= high)).all()
    for key in ("r", "u"):
        (low, high), predicted = sample.deviation_band(key), sample.predicted_deviation(key)
        moving = predicted > 0  # nothing is fed back at the start
        assert ((low < predicted) & (predicted < high))[moving].mean() > 0.97
    assert sample.level == THREE_SIGMA == pytest.approx(0.9973, abs=1e-4)
    # Normal runs: the band is that of a chi-square law with 4000 degrees of freedom.
    entry = sample.verdict.deviations[0]
    freedom = stats.chi2.ppf([(1 - THREE_SIGMA) / 2, (1 + THREE_SIGMA) / 2], 4000)
    assert entry.low == pytest.approx(entry.sample * np.sqrt(4000 / freedom[1]), rel=0.01)
    assert entry.high == pytest.approx(entry.sample * np.sqrt(4000 / freedom[0]), rel=0.01)


def test_symbols_and_names_index_alike(lag):
    sample = simulate(lag, 128, 1, step=0.1, store=11, paths=3, **OPTIONS)
    x, u = lag.symbols["x"], lag.symbols["u"]
    count = sample.t.size
    assert (sample.mean(x) == sample.mean("x")).all()
    assert sample.mean(x).shape == sample.deviation(u).shape == (count,)
    assert sample.covariance("x", "b").shape == (count, 1, 1)
    assert sample.terminal("b").shape == (128,)
    assert sample.paths.shape == (3, count, 5)
    assert sample.t[0] == 0.0
    assert sample.t[-1] == 10.0
    np.testing.assert_allclose(sample.mean("x") - sample.bias("x"), lag.at(sample.t)["x"], atol=1e-12)
    assert sample.share_beyond("b", 0.0) == 1.0
    with pytest.raises(ProblemError, match="'y' is not"):
        sample.mean("y")
    with pytest.raises(ProblemError, match="largest deviation"):
        sample.share_beyond("x", -1.0)
    with pytest.raises(ProblemError, match="about"):
        sample.covariance("x", about="zero")
    plain = sample.to_dict()
    assert plain["seed"] == 1
    assert plain["moments.count"].shape == (count,)
    assert all(not hasattr(value, "__dict__") or isinstance(value, np.ndarray) for value in plain.values())


def test_the_start_is_drawn_from_the_initial_covariance(oscillations):
    start = oscillations.covariance("r")[0]
    for i, variance in enumerate((0.1, 0.2)):
        assert abs(start[i, i] / variance - 1) < 3 * np.sqrt(2 / 4000)
    assert oscillations.moments.mean[0, 2:4].tolist() == [0.0, 0.0]  # the estimate starts at the nominal


def test_gains_that_were_optimised_and_controls_that_jump():
    from covocp.problem.declarations import Gain

    for gain in (Gain(constant=True), Gain()):
        problem = co.Problem(duration=10.0, name="lag")
        x = problem.state("x", initial=0.0, final=1.0, variance=1.0)
        b = problem.unknown("b", mean=1.0, variance=0.02)
        u = problem.control("u")
        problem.dynamics(x, -b * x + u, noise=1.0)
        problem.measurement("position", x, noise=1.0)
        problem.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0}, gain=gain)
        solution = co.solve(problem, grid=GRADED, progress=False)
        sample = simulate(solution, 2000, 1, **OPTIONS)
        np.testing.assert_allclose(sample.predicted[-1], solution.loop.X[-1], rtol=1e-4)
        assert sample.verdict.holds
        assert sample.deviations.shape == (2000, 2)
    jumping = steered(0.02, control="constant")
    sample = simulate(jumping, 2000, 1, **OPTIONS)
    np.testing.assert_allclose(sample.predicted[-1, 0, 0], jumping.loop.X[-1, 0, 0], rtol=1e-4)
    assert sample.verdict.holds


def test_the_report_is_readable(oscillations):
    text = str(oscillations)
    assert "4000 runs of the actual system, seed 1" in text
    assert "The linear prediction of the spread holds" in text
    assert "standard error" in text
    assert max(map(len, text.splitlines())) <= 100
