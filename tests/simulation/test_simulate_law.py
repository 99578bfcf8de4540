"""Laws of the user in the actual system: exact sampled statistics, the design's own filter as its limit, C code."""

import concurrent.futures
import multiprocessing
import re
import threading

import casadi as ca
import numpy as np
import pytest
from exports import lag, package, quick
from loops import linear_quadratic, open_loop, steered
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import covocp as co
from covocp.models import lqg_double_integrator
from covocp.simulation.runs import simulate

PERIOD = 0.5
A = np.array([[0.0, 1.0], [0.0, 0.0]])


class Proportional:
    """Pushes against the mean of the measured position."""

    gain = 0.8

    def step(self, measurement, time):
        return -self.gain * np.nan_to_num(measurement)


class Recorder:
    """Gives out a table of controls and keeps what it is told, of all runs in turn."""

    period = PERIOD

    def __init__(self, controls):
        self.controls, self.told = controls, []

    def __deepcopy__(self, memo):
        return self

    def step(self, measurement, time):
        self.told.append((time, float(measurement[0])))
        return [self.controls[round(time / PERIOD)]]


def regulated(**options):
    return co.solve(lqg_double_integrator.problem(duration=3.0, **options), intervals=60, progress=False)


@pytest.fixture(scope="module")
def design():
    return regulated()


def exact_moments(q=0.1, r=0.025, spread=0.1, start=(1.0, 0.0), duration=3.0):
    """Mean and covariance of position and speed at the end under `Proportional`, in closed form.

    The state (position, speed, integral of the measurement) over one period with a constant control, by exponentials.
    """
    drift = np.zeros((3, 3))
    drift[:2, :2], drift[2, 0] = A, 1.0
    control = np.array([[0.0], [1.0], [0.0]])
    density = np.diag([0.0, q, r])
    block = expm(PERIOD * np.block([[drift, control], [np.zeros((1, 4))]]))
    move, push = block[:3, :3], block[:3, 3:]
    noise = expm(PERIOD * np.block([[-drift, density], [np.zeros((3, 3)), drift.T]]))
    added = noise[3:, 3:].T @ noise[:3, 3:]
    feedback = -Proportional.gain / PERIOD * np.array([[0.0, 0.0, 1.0]])
    keep = np.diag([1.0, 1.0, 0.0])  # the integral starts anew
    mean, covariance = np.array([*start, 0.0]), np.diag([spread, spread, 0.0])
    for k in range(round(duration / PERIOD)):
        step = move @ keep + push @ feedback if k else move
        mean, covariance = step @ mean, step @ covariance @ step.T + added
    return mean[:2], covariance[:2, :2]


def test_statistics_of_a_sampled_law_are_exact(design):
    runs = 10_000
    sample = simulate(design, runs, 3, law=Proportional(), period=PERIOD, step=0.01, progress=False)
    mean, covariance = exact_moments()
    found = np.column_stack([sample.nominal[-1] + sample.deviations])[:, :2]
    errors = np.sqrt(np.diagonal(covariance) / runs)
    assert (np.abs(found.mean(axis=0) - mean) < 4 * errors).all()
    # standard error of a normal second moment; 0.01 of a step of 0.5 moves it far less
    spread = np.sqrt((np.outer(np.diagonal(covariance), np.diagonal(covariance)) + covariance**2) / runs)
    assert (np.abs(np.cov(found.T) - covariance) < 4 * spread).all()


def test_the_law_is_told_the_mean_of_the_period_before():
    """Without noise: the measurements and the end are those of an accurate integration; the control is held."""
    solution = regulated(initial_variance=0.0, process_noise=0.0, measurement_noise=1e-18)
    law = Recorder([0.5, -1.0, 0.25, 0.0, 2.0, -0.5, 7.0])
    sample = simulate(solution, 2, 1, law=law, step=0.001, progress=False)
    told = law.told[1::2]  # after the trial step two runs in turn
    assert [time for time, _ in told] == pytest.approx([k * PERIOD for k in range(7)], abs=1e-12)
    state, means = np.array([1.0, 0.0, 0.0]), [np.nan]
    for u in law.controls[:6]:
        state[2] = 0.0
        path = solve_ivp(lambda t, z, u=u: [z[1], u, z[0]], (0.0, PERIOD), state, rtol=1e-12, atol=1e-12)
        state = path.y[:, -1]
        means.append(state[2] / PERIOD)
    np.testing.assert_allclose([value for _, value in told], means, rtol=0, atol=1e-6)  # Heun's method, steps of 0.001
    np.testing.assert_allclose(sample.nominal[-1] + sample.deviations[0], state[:2], rtol=0, atol=1e-6)
    moved = sample.nominal_control[:, 0] + sample.paths[0, :, 4]
    assert sample.t == pytest.approx([k * PERIOD for k in range(7)])  # moments are kept where the law is stepped
    assert moved == pytest.approx(law.controls)


def test_the_exported_controller_tends_to_the_filter_of_the_design():
    """The more often it is stepped, the nearer each run is to that with the continuous filter, to first order.

    The periods divide the mesh, so that the steps and with them the noises of a run are the same.
    """
    options = {"runs": 64, "seed": 5, "step": 1 / 128, "progress": False}
    continuous = simulate(lag(), **options)
    distances = []
    for period in (1 / 8, 1 / 16, 1 / 32):
        sampled = simulate(lag(), law=package("lag").python(), period=period, **options)
        gaps = np.hstack([sampled.deviations - continuous.deviations, sampled.estimates - continuous.estimates])
        distances.append(np.sqrt(np.mean(gaps**2)))
    assert distances[0] < 0.1
    assert distances[1] / distances[0] == pytest.approx(0.5, abs=0.06)
    assert distances[2] / distances[1] == pytest.approx(0.5, abs=0.06)


def chain(masses=5):
    """Masses on springs of an unknown stiffness: more rows than a controller writes out in scalars."""
    problem = co.Problem(duration=4.0, name="chain")
    y = problem.state("y", masses, initial=0.0, variance=0.1)
    v = problem.state("v", masses, initial=0.0, variance=0.1)
    k, u = problem.unknown("k", mean=2.0, variance=0.1), problem.control("u")
    stretch = ca.DM(np.eye(masses) - np.eye(masses, k=-1))
    problem.dynamics(y, v)
    problem.dynamics(v, ca.DM(np.eye(masses)[:, :1]) @ u - k * (stretch.T @ stretch @ y), noise=0.01)
    problem.measurement("all", y, noise=0.1 * np.eye(masses))
    problem.minimize_expected(running=0.5 * u**2, terminal_weight={y: 5.0, v: 5.0})
    return co.solve(problem, intervals=40, progress=False)


def test_a_controller_of_many_rows_tends_to_the_filter_of_the_design(tmp_path):
    solution = chain()
    options = {"runs": 24, "seed": 5, "step": 1 / 80, "store": 2, "progress": False}
    continuous = simulate(solution, **options)
    law = quick(co.export_c(solution, tmp_path / "chain")).python()
    distances = []
    for period in (1 / 10, 1 / 20, 1 / 40):
        sampled = simulate(solution, law=law, period=period, **options)
        distances.append(np.sqrt(np.mean((sampled.deviations - continuous.deviations) ** 2)))
    assert distances[0] < 0.1 * np.sqrt(np.mean(continuous.deviations**2))
    assert distances[1] / distances[0] == pytest.approx(0.5, abs=0.1)
    assert distances[2] / distances[1] == pytest.approx(0.5, abs=0.1)


def test_c_and_python_fly_the_same_runs():
    flown = [
        simulate(lag(), 4, 2, law=law, step=0.01, progress=False)
        for law in (package("lag_sampled").python(), package("lag_sampled").reference())
    ]
    assert flown[0].period == 0.01
    np.testing.assert_allclose(flown[0].deviations, flown[1].deviations, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(flown[0].estimates, flown[1].estimates, rtol=1e-9, atol=1e-9)


def test_other_processes_load_the_compiled_law():
    options = {"runs": 128, "seed": 7, "step": 0.1, "batch": 64, "period": 0.1, "progress": False}
    here = simulate(lag(), law=package("lag").python(), **options)
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(2, mp_context=context) as executor:
        there = simulate(lag(), law=package("lag").python(), executor=executor, **options)
    for name in ("deviations", "estimates", "costs"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name), err_msg=name)


def test_what_is_printed(design):
    told = " ".join(str(simulate(design, 64, 1, law=Proportional(), period=PERIOD, progress=False)).split())
    assert "a law stepped every 0.5 s" in told
    assert "this law is not the filter and feedback of the design" in told
    assert "error of the filter" not in told  # it says nothing of its estimate
    assert "error of the filter" in str(simulate(lag(), 64, 1, law=package("lag_sampled").python(), progress=False))


def test_a_law_without_estimate_has_no_errors(design):
    sample = simulate(design, 64, 1, law=Proportional(), period=PERIOD, progress=False)
    assert np.isnan(sample.estimates).all()
    assert sample.verdict.errors == ()
    with pytest.raises(co.ProblemError, match="no errors of estimates"):
        sample.error_covariance("position")


def test_each_run_has_a_law_of_its_own(design):
    class Counting(Proportional):
        count = None

        def init(self):
            self.count = 0

        def step(self, measurement, time):
            assert time == pytest.approx(self.count * PERIOD)
            self.count += 1
            return super().step(measurement, time)

    law = Counting()
    simulate(design, 3, 1, law=law, period=PERIOD, step=0.1, progress=False)
    assert law.count is None


def test_limits_hold_for_a_law_too(design):
    class Hard(Proportional):
        gain = 50.0

    sample = simulate(design, 64, 1, law=Hard(), period=PERIOD, limits={"u": (-1.0, 1.0)}, step=0.05, progress=False)
    assert sample.asked_share == 1.0
    moved = sample.nominal_control + sample.paths[:, :, 4:]
    assert np.abs(moved).max() <= 1.0 + 1e-12


def test_a_run_whose_law_fails_leaves_the_domain(design):
    class Lost(Proportional):
        def step(self, measurement, time):
            return [np.nan] if time > 1.0 else super().step(measurement, time)

    sample = simulate(design, 64, 1, law=Lost(), period=PERIOD, step=0.05, progress=False)
    assert sample.left_share == 1.0
    assert (sample.left >= 1.0).all()
    assert (sample.unanswered == 1.5).all()  # the first step after 1 s
    assert sample.verdict.reasons == ("unanswered",)
    assert "in 100 % of the runs the law once gave no finite control" in str(sample.verdict)


def test_a_law_that_raises_in_flight_loses_its_batch_only(design):
    class Breaking(Proportional):
        def step(self, measurement, time):
            if measurement[0] > 2.2:
                raise ZeroDivisionError("no inverse")
            return super().step(measurement, time)

    options = {"law": Breaking(), "period": PERIOD, "step": 0.05, "batch": 64, "progress": False}
    with pytest.warns(co.CovocpWarning, match=r"the law failed in run \d+ at [\d.]+ s: ZeroDivisionError: no inverse"):
        sample = simulate(design, 640, 1, **options)
    assert 0 < sample.runs < 640
    assert sum(failure.last - failure.first for failure in sample.failed) == 640 - sample.runs
    Breaking.step = lambda self, measurement, time: 0.0 if time == 0 else 1 / 0
    with pytest.raises(co.SolveError, match="every task failed"):
        simulate(design, 64, 1, **options)


def test_control_that_was_given_is_no_reason():
    design = co.solve(linear_quadratic(), intervals=40, progress=False)  # bounds of 4
    law = Answers(lambda measurement: -6.0 * np.nan_to_num(measurement))
    options = {"law": law, "period": 0.05, "step": 0.05, "progress": False}
    given = simulate(design, 256, 1, **options)
    assert given.asked_share > 0.5
    assert given.verdict.reasons == ("law",)
    assert "asked for more control than the nominal has" in str(given.verdict)
    assert "saturated" in simulate(design, 256, 1, limits="bounds", **options).verdict.reasons


class Wide(Proportional):
    def step(self, measurement, time):
        return [0.0, 0.0]


class Short(Proportional):
    estimate = np.zeros(3)


class Locked(Proportional):
    def __init__(self):
        self.lock = threading.Lock()


class Answers:
    def __init__(self, answer):
        self.answer = answer

    def step(self, measurement, time):
        return self.answer(measurement)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"law": 3, "period": 0.1}, "step(measurement, time)"),
        ({"law": Proportional()}, "the time between two steps"),
        ({"law": Proportional(), "period": -1.0}, "the time between two steps"),
        ({"law": Proportional(), "period": 30.0}, "at most 3 s"),
        ({"law": Recorder([0.0]), "period": 0.1}, "0.5 s, for which this law was made"),
        ({"law": Proportional, "period": 0.1}, "law=Proportional(...)"),
        ({"law": Answers(lambda m: 2.0 * (1.0 - m)), "period": 0.1}, "also where nothing was measured yet"),
        ({"law": Answers(lambda m: None), "period": 0.1}, "1 finite number(s)"),
        ({"law": Answers(lambda m: "a"), "period": 0.1}, "ValueError"),
        ({"law": Answers(lambda m: 1 / 0), "period": 0.1}, "ZeroDivisionError"),
        ({"law": Locked(), "period": 0.1}, "cannot be copied"),
        ({"law": Proportional(), "period": True}, "the time between two steps"),
        ({"law": Wide(), "period": 0.1}, "1 finite number(s)"),
        ({"law": Short(), "period": 0.1}, "2 numbers"),
        ({"law": Proportional(), "period": 0.1, "filter": "extended"}, "the law has its own"),
        ({"period": 0.1}, "law="),
    ],
)
def test_misuse_is_refused_before_anything_runs(design, options, words):
    with pytest.raises(co.ProblemError, match=re.escape(words)):
        simulate(design, 8, 1, progress=False, **options)


def test_nothing_is_fed_back_in_an_open_loop():
    with pytest.raises(co.ProblemError, match="deterministic"):
        simulate(co.solve(open_loop(), progress=False), 8, 1, law=Proportional(), period=0.1, progress=False)


def test_a_trajectory_is_no_law():
    history = package("history").python()
    with pytest.raises(co.ProblemError, match="step"):
        simulate(steered(0.1), 8, 1, law=history, period=0.1, progress=False)
