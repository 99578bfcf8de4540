"""Runs that violate the constraints of the problem, against loops of Euler and Maruyama that know nothing of covocp."""

import casadi as ca
import numpy as np
import pytest
from scipy import stats

import covocp as co
from covocp.simulation.runs import simulate
from covocp.simulation.sampling import THREE_SIGMA

RUNS = 3000


def corridor():
    """A nonlinear loop with an unknown, bounds, constraints at all places, one that no run changes, an equality."""
    problem = co.Problem(duration=4.0, name="corridor")
    x = problem.state("x", initial=0.0, final=1.0, variance=0.04, upper=1.4)
    v = problem.state("v", initial=0.0, variance=0.01)
    d = problem.unknown("d", mean=0.0, variance=0.01)
    u = problem.control("u", lower=-3.0, upper=3.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u + d - 0.1 * v**2, noise=0.02)
    problem.measurement("m", x, noise=0.01)
    problem.subject_to(x - 0.4 * problem.time, upper=0.25, name="ramp")
    problem.subject_to(ca.vertcat(v, u + d), upper=[0.75, 2.0], name="pair")
    problem.subject_to(v + x, lower=0.7, upper=1.3, at="final", name="gate")
    problem.subject_to(x, lower=-0.3, upper=0.4, at="initial", name="pad")
    problem.subject_to(v, lower=0.2, upper=0.2, at="final", name="speed")
    problem.minimize_expected(running=0.5 * u**2, terminal_weight={x: 4.0, v: 1.0})
    return problem


def estimated():
    """An open loop with an estimation covariance: a constraint with the covariance and one of the covariance alone."""
    problem = co.Problem(duration=2.0, name="relaxation")
    x = problem.state("x", initial=1.0, variance=0.09)
    k = problem.unknown("k", mean=1.0, variance=0.04)
    w = problem.control("w", lower=0.1, upper=1.0)
    problem.dynamics(x, -k * x, noise=0.05)
    problem.measurement("m", x * w, noise=0.02)
    E = problem.estimation_covariance()
    problem.subject_to(x + ca.sqrt(E[x, x]), upper=1.6, name="margin")
    problem.subject_to(E[x, x], upper=1.0, name="known")
    problem.minimize(running=w**2, terminal=E[x, x])
    return problem


def brute_corridor(solution, generator, h):
    """Euler and Maruyama with the design's gains, all runs side by side: shares by constraint, at any time and at T."""
    steps = round(4.0 / h)
    x, v = 0.2 * generator.standard_normal(RUNS), 0.1 * generator.standard_normal(RUNS)
    d, y = 0.1 * generator.standard_normal(RUNS), np.zeros((3, RUNS))
    once = {name: np.zeros(RUNS, dtype=bool) for name in ("x", "ramp", "pair[0]", "pair[1]")}
    once["pad"] = (x < -0.3) | (x > 0.4)
    for k in range(steps + 1):
        t = min(k * h, 4.0)
        at = solution.at(t)
        K, C = (np.array([np.interp(t, solution.t, g) for g in solution.gains[n].reshape(-1, 3).T]) for n in "KC")
        u = at["u"] - C @ y
        for name, beyond in (
            ("x", x > 1.4),
            ("ramp", x - 0.4 * t > 0.25),
            ("pair[0]", v > 0.75),
            ("pair[1]", u + d > 2.0),
        ):
            once[name] |= beyond
        if k == steps:
            break
        dm = (x - at["x"] - y[0]) * h + np.sqrt(0.01 * h) * generator.standard_normal(RUNS)
        moved = np.array([y[1], y[2] - 0.2 * at["v"] * y[1] - C @ y, 0 * y[0]])
        y = y + moved * h + K[:, None] * dm
        x, v = x + v * h, v + (u + d - 0.1 * v**2) * h + np.sqrt(0.02 * h) * generator.standard_normal(RUNS)
    ended = {"x": x > 1.4, "ramp": x - 1.6 > 0.25, "gate": (v + x < 0.7) | (v + x > 1.3)}
    return once | {"gate": ended["gate"]}, ended


def brute_estimated(solution, generator, h):
    """The same of the open loop: only the plant matters."""
    x = 1.0 + 0.3 * generator.standard_normal(RUNS)
    k = 1.0 + 0.2 * generator.standard_normal(RUNS)
    once = np.zeros(RUNS, dtype=bool)
    for i in range(round(2.0 / h) + 1):
        spread = np.sqrt(solution.at(min(i * h, 2.0))["E"][0, 0])
        beyond = x + spread > 1.6
        once |= beyond
        x = x - k * x * h + np.sqrt(0.05 * h) * generator.standard_normal(RUNS)
    return {"margin": once}, {"margin": beyond}


@pytest.mark.parametrize(
    ("build", "brute", "left_out"),
    [
        (corridor, brute_corridor, {"speed": "an equality, which no noisy run meets exactly"}),
        (estimated, brute_estimated, {"known": "the same in all runs"}),
    ],
)
def test_the_runs_that_violate_are_those_of_an_independent_loop(build, brute, left_out):
    solution = co.solve(build(), intervals=40, progress=False)
    sample = simulate(solution, RUNS, 1, step=0.02, progress=False)
    once, ended = brute(solution, np.random.default_rng(7), 0.02)
    for name, flags in once.items():
        counted = sample.violations[name]
        share = (flags.mean() + counted.share) / 2
        error = 4 * np.sqrt(2 * max(share * (1 - share), 1 / RUNS) / RUNS)  # of two samples of as many runs
        assert abs(flags.mean() - counted.share) < error, name
        assert counted.runs == round(counted.share * RUNS)
    for name, flags in ended.items():
        counted = sample.violations[name]
        share = (flags.mean() + counted.end_share) / 2
        error = 4 * np.sqrt(2 * max(share * (1 - share), 1 / RUNS) / RUNS)
        assert abs(flags.mean() - counted.end_share) < error, name
    assert sample.inequalities.left_out == left_out
    assert set(left_out) <= {word.split("(")[0].strip() for word in str(sample).split("Not counted: ")[1].split(", ")}


def test_what_the_covariances_promise_of_a_linear_system_is_what_happens():
    """Linear dynamics and constraints: the promised probability at the end is exact, and inside its band."""
    problem = co.Problem(duration=2.0)
    x = problem.state("x", 2, initial=[0.0, 0.0], final=[1.0, 0.0], variance=[0.02, 0.01])
    u = problem.control("u")
    problem.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, 0.05])
    problem.measurement("m", x[0], noise=0.01)
    problem.subject_to(x[0] + 0.5 * x[1], upper=1.3, lower=0.6, at="final", name="window")
    problem.subject_to(u + x[1], upper=6.0, name="effort")
    problem.minimize_expected(running=0.5 * u**2, terminal_weight={x: [4.0, 1.0]})
    solution = co.solve(problem, intervals=40, progress=False)
    sample = simulate(solution, 4000, 3, step=0.02, progress=False)
    counted, X = sample.violations["window"], solution.loop.X[-1]
    slope = np.array([1.0, 0.5])
    spread = np.sqrt(slope @ X @ slope)
    exact = stats.norm.sf(0.3 / spread) + stats.norm.cdf(-0.4 / spread)
    assert counted.promised_end == pytest.approx(exact, rel=1e-3)
    assert counted.as_promised
    assert counted.low < counted.end_share < counted.high
    band = stats.binomtest(counted.at_end, 4000).proportion_ci(THREE_SIGMA, "exact")
    assert (counted.low, counted.high) == pytest.approx((band.low, band.high), rel=1e-9)
    effort = sample.violations["effort"]
    assert abs(effort.most - effort.promised_most) < 4 * np.sqrt(effort.promised_most / 4000) + 2e-3
    assert effort.most <= effort.share
    assert "window" in str(sample)


def test_a_value_that_is_no_number_violates_and_a_run_that_left_keeps_what_it_did():
    problem = co.Problem(duration=1.0)
    x = problem.state("x", initial=1.0, variance=1.0)
    u = problem.control("u", lower=0.0, upper=1.0)
    problem.dynamics(x, 40.0 * (x - 1.0) ** 2 * x, noise=1e-6)
    problem.estimation_covariance()
    problem.subject_to(ca.sqrt(x), upper=50.0, name="root")
    problem.minimize(running=(u - 0.3) ** 2)
    solution = co.solve(problem, intervals=10, progress=False)
    sample = simulate(solution, 512, 1, step=0.01, progress=False)
    assert 0.1 < sample.left_share < 0.9
    negative = sample.violations["root"]  # the root of what starts below zero is none: a share of Phi(-1)
    assert negative.share >= stats.norm.cdf(-1.0) - 4 * np.sqrt(0.16 / 512)
    assert negative.at_end >= np.count_nonzero(~sample.stayed)
