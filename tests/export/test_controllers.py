"""The exported controller: its formulas computed otherwise, the covariances of the design, misuse."""

import itertools

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, lag, mars, package
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import covocp as co
from covocp.export import export_c
from covocp.export.laws.controller import controller_law
from covocp.export.laws.design import design_of
from covocp.export.laws.history import history
from covocp.export.laws.law import STATUSES, span

pytestmark = pytest.mark.needs_cc
B, U, NOISE = 1.0, 1.0, 1.0  # mean of the time constant, densities of measurement and process noise


def slopes(solution, t):
    """F, G of the lag along its nominal."""
    x = float(solution.at(t)["x"])
    return np.array([[-B, -x], [0.0, 0.0]]), np.array([1.0, 0.0])


def predicted(solution, y, held, begin, end):
    """The estimate without measurement, integrated accurately."""

    def rate(t, y):
        F, G = slopes(solution, t)
        return F @ y + G * (held - float(solution.at(t)["u"]))

    return solve_ivp(rate, (begin, end), y, rtol=1e-12, atol=1e-13).y[:, -1]


def expected_mean(solution, y, held, begin, end):
    """The mean of x that is expected between two times, integrated accurately."""

    def rate(t, z):
        F, G = slopes(solution, t)
        return np.append(F @ z[:2] + G * (held - float(solution.at(t)["u"])), float(solution.at(t)["x"]) + z[0])

    return solve_ivp(rate, (begin, end), np.append(y, 0.0), rtol=1e-12, atol=1e-13).y[2, -1] / (end - begin)


def gain(solution, t, h, known):
    """h B A^-1 of x and its integral, from the covariance at t - h, and that after the measurement."""

    def rate(s, P):
        drift, P = np.zeros((3, 3)), P.reshape(3, 3)
        drift[:2, :2], drift[2, 0] = slopes(solution, s)[0], 1.0
        return (drift @ P + P @ drift.T + np.diag([NOISE, 0.0, U])).ravel()

    P = np.zeros((3, 3))
    P[:2, :2] = known
    ends = np.unique([t - h, *(node for node in solution.t if t - h < node < t), t])
    for begin, end in itertools.pairwise(ends):
        P = solve_ivp(rate, (begin, end), P.ravel(), rtol=1e-12, atol=1e-13).y[:, -1].reshape(3, 3)
    return h * P[:2, 2] / P[2, 2], P[:2, :2] - np.outer(P[:2, 2], P[:2, 2]) / P[2, 2]


def coming(solution, begin, end):
    """The mean of the nominal control, linear between the nodes, over a step."""
    ends = np.unique([begin, *(node for node in solution.t if begin < node < end), end])
    return np.trapezoid([float(solution.at(t)["u"]) for t in ends], ends) / (end - begin)


def counts_again(controller):
    """What is known where it is what the design expects, as after many short steps."""
    controller._values[span(controller.law.outputs, "overdue")] = 0.0


def after(controller, steps):
    """Run some (measurement, time) pairs; the state after each."""
    controller.init()
    states = []
    for reading, time in steps:
        controller.step(reading, time)
        states.append({**controller.state, "status": controller.status})
    return states


def test_two_steps_follow_the_formulas():
    solution, controller = lag(), package("lag").python().step
    first, second = after(controller, [(0.7, 0.05), (-0.2, 0.13)])
    y = np.zeros(2)
    held, begin, known = float(solution.at(0.0)["u"]), 0.0, solution.at(0.0)["E"]
    for state, reading, time in ((first, 0.7, 0.05), (second, -0.2, 0.13)):
        before = predicted(solution, y, held, begin, time)
        sample = solution.at(time)
        L, known = gain(solution, time, time - begin, known)
        if np.allclose(np.diag(known), np.diag(sample["E"]), rtol=1e-2, atol=0):
            known = sample["E"]  # it is the design's
        y = before + L * (reading - expected_mean(solution, y, held, begin, time))
        C = sample["S"][0, :]  # B^-1 G' S, B = 1
        held, begin = coming(solution, time, 2 * time - begin) - C @ y, time
        np.testing.assert_allclose(state["filter_gain"], L, rtol=1e-6, atol=1e-12)  # one Gauss step of order 4
        np.testing.assert_allclose(state["feedback_gain"][0], C, rtol=1e-12)
        np.testing.assert_allclose(state["estimate"], y, rtol=0, atol=1e-7)  # one Gauss step of order 4
        assert state["control"] == pytest.approx(held, abs=1e-7)
        assert state["nominal_control"] == pytest.approx(float(sample["u"]), abs=1e-14)
        assert state["nominal_state"] == pytest.approx(float(sample["x"]), abs=1e-14)
        assert (state["status"], state["time"]) == ("OK", time)


def test_prediction_is_of_fourth_order():
    """Without a measurement: error of one step within an interval of the mesh against an accurate integration."""
    from covocp.models import unknown_lag

    problem, nominal = unknown_lag.steering(parameter_variance=0.05), {"u": [0.3, 0.5, 0.1, 0.4]}
    solution = co.evaluate(problem, nominal=nominal, intervals=3, substeps=40)
    controller = export_c(solution, FOLDER / "three", largest_spread=np.inf).reference().step
    errors = []
    steps = (0.8, 0.4, 0.2)
    for h in steps:
        controller.init()
        controller.step(1.0, 4.0)
        held, start = controller.state["control"], controller.state["estimate"]
        controller.step(np.nan, 4.0 + h)
        assert controller.status == "MEASUREMENT_MISSING"
        errors.append(np.abs(controller.state["estimate"] - predicted(solution, start, held, 4.0, 4.0 + h)).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 4.4).all()  # of one step: 5


def test_a_measurement_that_sees_the_control_is_corrected_by_the_one_that_was_held():
    ocp = co.Problem(duration=4.0, name="direct")
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=0.3), ocp.control("u")
    ocp.dynamics(x, -x + u, noise=0.2)
    ocp.measurement("m", x + 0.5 * u, noise=0.1)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0})
    solution = co.evaluate(ocp, nominal={"u": np.linspace(0.2, 0.6, 41)})
    controller = export_c(solution, FOLDER / "direct").reference().step
    first, second = after(controller, [(0.9, 1.0), (0.4, 1.1)])
    held, y = first["control"], first["estimate"]

    def rate(t, z):
        now = solution.at(t)
        moved = held - float(now["u"])
        return np.array([-z[0] + moved, float(now["x"]) + 0.5 * float(now["u"]) + z[0] + 0.5 * moved])

    before, integral = solve_ivp(rate, (1.0, 1.1), [float(y), 0.0], rtol=1e-12, atol=1e-14).y[:, -1]
    F, P = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.diag([0.3, 0.0])
    for h in (1.0, 0.1):
        loan = expm(h * np.block([[-F, np.diag([0.2, 0.1])], [np.zeros((2, 2)), F.T]]))
        P = loan[2:, 2:].T @ P @ loan[2:, 2:] + loan[2:, 2:].T @ loan[:2, 2:]
        known = P[0, 0] - P[0, 1] ** 2 / P[1, 1]  # what one mean over a second tells is less than the design expects
        P = P if h < 1.0 else np.diag([known, 0.0])
    L = 0.1 * P[0, 1] / P[1, 1]
    expected = before + L * (0.4 - integral / 0.1)
    assert second["filter_gain"] == pytest.approx(L, rel=1e-6)  # one Gauss step of order 4
    assert second["estimate"] == pytest.approx(expected, abs=1e-8)


def test_gain_tends_to_the_continuous_one_and_is_stable_for_any_step():
    solution, controller = mars(), package("mars").python().step
    node = 40
    for h, tolerance in ((1e-2, 2e-2), (1e-3, 2e-3)):
        controller.init()
        controller.step([0.0, 0.0], solution.t[node] - h)
        counts_again(controller)
        controller.step([0.0, 0.0], solution.t[node])
        ratio = controller.state["filter_gain"] / h / solution.gains["K"][node]
        np.testing.assert_allclose(ratio, 1.0, rtol=tolerance)
    st, T, p = solution.statement, solution.duration, solution.parameters
    for h in (1.0, 30.0, solution.t[node]):
        controller.init()
        controller.step([0.0, 0.0], solution.t[node] - h)
        controller.step([0.0, 0.0], solution.t[node])
        M = st.measurement(solution.trajectory.x[node], solution.controls[node], solution.t[node], T, p)[1].full()
        values = np.linalg.eigvals(controller.state["filter_gain"] @ M)
        assert np.abs(values.imag).max() < 1e-6
        assert values.real.min() > -1e-6
        assert values.real.max() < 1.0


def spread_before(solution, t, h, row):
    """Covariance of the errors at t of the state and of the integral of a row that is measured, by scipy."""
    st, T, p = solution.statement, solution.duration, solution.parameters

    def expansion(s):
        sample = solution.at(s)
        x = np.array([sample[b.name] for b in st.states])
        return st.loop.expansion(x, float(sample["lift_to_drag"]), s, T, p)

    def rate(s, P):
        local, P = expansion(s), P.reshape(n + 1, n + 1)
        drift, density = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
        drift[:n, :n], drift[n, :n], density[:n, :n] = local[0].full(), row(s), local[5].full()
        return (drift @ P + P @ drift.T + density).ravel()

    E = solution.at(t - h)["E"]
    n = len(E)
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n] = E
    return solve_ivp(rate, (t - h, t), joint.ravel(), rtol=1e-11, atol=1e-14).y[:, -1].reshape(n + 1, n + 1)


def test_rows_that_are_missing_leave_the_filter_of_the_others():
    solution, controller = mars(), package("mars").python().step
    t, h = 600.0, 2.0
    st, T, p = solution.statement, solution.duration, solution.parameters

    def row(s):
        sample = solution.at(s)
        x = np.array([sample[b.name] for b in st.states])
        return st.measurement(x, float(sample["lift_to_drag"]), s, T, p)[1].full()[1]

    joint = spread_before(solution, t, h, row)
    expected = h * joint[:-1, -1:] / (joint[-1, -1] + 0.02 * h)
    controller.init()
    controller.step([np.nan, np.nan], t - h)
    counts_again(controller)
    controller.step([np.nan, 3.0], t)
    assert controller.status == "MEASUREMENT_MISSING"
    found, small = controller.state["filter_gain"][:, 1:], 1e-9 * np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=small)  # one Gauss step of order 4
    np.testing.assert_array_equal(controller.state["filter_gain"][:, 0], 0.0)
    assert np.isfinite(controller.state["estimate"]).all()


def test_terminal_deviations_are_those_of_the_design():
    """400 actual lags at once, unknown constants and all noises: sample against predicted, three sigma and the step."""
    solution = lag()
    law = controller_law(design_of(solution, None), history(solution, "double"), 1e-12)
    runs, steps = 400, 250
    h = solution.duration / steps
    random = np.random.default_rng(11)
    x = random.normal(size=runs)
    b = B + np.sqrt(0.05) * random.normal(size=runs)
    fields, rows = np.tile(law.start, (runs, 1)), np.zeros((runs, sum(port.size for port in law.inputs)))
    for k in range(steps):
        u = fields[:, span(law.outputs, "control")][:, 0]
        decay = np.exp(-b * h)
        x = decay * x + u * (1 - decay) / b + np.sqrt((1 - decay**2) / (2 * b)) * random.normal(size=runs)
        rows[:, span(law.inputs, "measurement")] = (x + np.sqrt(U / h) * random.normal(size=runs))[:, None]
        rows[:, span(law.inputs, "time")] = (k + 1) * h
        for name, kept in law.held.items():
            rows[:, span(law.inputs, name)] = fields[:, span(law.outputs, kept)]
        fields = law.values(rows)
        assert not fields[:, -1].any()
    ratio = np.std(x - solution["x"][-1], ddof=0) / solution.deviation("x")[-1]
    assert ratio == pytest.approx(1.03, abs=3 / np.sqrt(2 * runs))  # 3 % are due to the step: a delay of h


def test_samples_of_a_short_period_are_the_continuous_law():
    """Both controllers on the same readings: the discrete gains differ by the step only."""
    random = np.random.default_rng(4)
    readings = random.normal(size=1000)
    controls = []
    for name in ("lag", "lag_sampled"):
        controller = package(name).python().step
        controller.init()
        controls.append([controller.step(m, (k + 1) * 0.01)[0] for k, m in enumerate(readings)])
    difference = np.abs(np.array(controls[0]) - controls[1]).max()
    assert difference < 0.01 * np.abs(controls[1]).max()


def unscalar():
    """A lag whose rate solves a linear system, which has no form in scalars."""
    ocp = co.Problem(duration=4.0, name="implicit")
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=0.1), ocp.control("u")
    matrix = ca.vertcat(ca.horzcat(2.0 + x**2, 0.1), ca.horzcat(0.1, 1.0))
    ocp.dynamics(x, u - ca.solve(matrix, ca.vertcat(x, 0.1), "qr")[0], noise=0.1)
    ocp.measurement("m", x, noise=0.5)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0})
    return ocp


def many_states(n=5):
    """A chain with 2 n states, two controls, correlated measurements that see the control."""
    ocp = co.Problem(duration=3.0, name="chain")
    y = ocp.state("y", n, initial=np.zeros(n), variance=0.1)
    v = ocp.state("v", n, initial=np.zeros(n), variance=0.1)
    u = ocp.control("u", 2)
    force = [(y[i - 1] if i else 0) - 2 * y[i] + (y[i + 1] if i < n - 1 else 0) - 0.1 * v[i] ** 3 for i in range(n)]
    force[0], force[-1] = force[0] + u[0], force[-1] + u[1]
    ocp.dynamics(y, v)
    ocp.dynamics(v, ca.vertcat(*force), noise=0.1)
    ocp.measurement("ends", ca.vertcat(y[0] + 0.1 * u[0], y[n - 1]), noise=np.array([[0.2, 0.05], [0.05, 0.1]]))
    ocp.measurement("square", v[0] ** 2, noise=0.3)
    ocp.minimize_expected(running=0.5 * ca.sumsqr(u), terminal_weight={y: np.ones(n)})
    return ocp


@pytest.mark.parametrize("period", [None, 0.05])
@pytest.mark.parametrize("make", [unscalar, many_states])
def test_models_without_scalar_form_and_with_many_states(make, period):
    solution = co.evaluate(make(), nominal={"u": np.linspace(0.2, 0.6, 11)} if make is unscalar else {"u": 0.3})
    made = export_c(solution, FOLDER / f"{make.__name__}_{'sampled' if period else 'any'}", period=period)
    made.build(flags=["-Werror", "-O0"])
    check = made.check(samples=300)
    assert check.deviation <= 1e-12
    assert check.ok


# --- misuse -----------------------------------------------------------------------------------------------------------

NAMES = ["lag", "lag_sampled"]


def ready(name):
    """A controller in the middle of its work."""
    controller = package(name).python().step
    after(controller, [(0.4, 1.0), (0.1, 1.5), (0.9, 2.0)])
    return controller


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("reading", [np.nan, np.inf, -np.inf, 1e200])
def test_readings_that_are_not_finite_are_predicted_over(name, reading):
    controller = ready(name)
    start, held = controller.state["estimate"], float(controller.state["control"])
    control = controller.step(reading, 2.01)
    assert controller.status == "MEASUREMENT_MISSING"
    expected = predicted(lag(), start, held, 2.0, 2.01)
    np.testing.assert_allclose(controller.state["estimate"], expected, rtol=0, atol=1e-8)
    assert np.isfinite(control).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("time", "status", "clamped"),
    [
        (np.nan, "TIME_NOT_FINITE", 2.0),
        (np.inf, "TIME_NOT_FINITE", 2.0),
        (-0.5, "TIME_BEFORE", 0.0),
        (11.0, "TIME_AFTER", 10.0),
        (1.0, "TIME_BACKWARDS", 1.0),
    ],
)
def test_times_outside_the_range_give_the_nominal_control_and_keep_the_estimate(name, time, status, clamped):
    controller = ready(name)
    before = controller.state
    control = controller.step(0.3, time)
    assert controller.status == status
    assert control[0] == pytest.approx(float(lag().at(clamped)["u"]), abs=1e-12)
    np.testing.assert_array_equal(controller.state["estimate"], before["estimate"])
    assert controller.state["time"] == before["time"]
    controller.step(0.3, 2.5)
    assert controller.status == ("OK" if name == "lag" else "SAMPLES_SKIPPED")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e308])
def test_an_estimate_that_is_lost_leaves_the_nominal_control(name, bad):
    law = next(law for law in package(name).laws if law.name == "step")
    rows = law.points(np.random.default_rng(0), 60)[40:41]
    rows[:, span(law.inputs, "estimate")] = bad
    rows[:, span(law.inputs, "measurement")] = 0.1
    rows[:, span(law.inputs, "time")] = 5.0
    rows[:, span(law.inputs, "last")] = 4.99 if name == "lag" else 499
    if name == "lag":
        rows[:, span(law.inputs, "elapsed")] = rows[:, span(law.inputs, "overdue")] = 0.0
    backend = package(name)._library().backend(law)
    values, status = backend(rows[0])
    assert status == 6
    control = values[span(law.outputs, "control")]
    assert control[0] == pytest.approx(coming(lag(), 5.0, 5.01), abs=1e-12)


def test_a_step_at_the_same_time_changes_nothing_but_counts_as_ok():
    controller = ready("lag")
    before = controller.state
    control = controller.step(5.0, 2.0)
    assert controller.status == "OK"
    np.testing.assert_allclose(controller.state["estimate"], before["estimate"], rtol=0, atol=1e-14)
    assert control[0] == pytest.approx(before["control"], abs=1e-14)


def test_samples_that_are_left_out_are_predicted_over_one_by_one():
    controller = ready("lag_sampled")
    late = package("lag_sampled").python().step
    after(late, [(0.4, 1.0), (0.1, 1.5), (0.9, 2.0)])
    control = late.step(0.8, 2.25)
    held, start = float(controller.state["control"]), controller.state["estimate"].copy()
    for k in range(201, 225):
        controller.step(np.nan, k * 0.01)
        controller._values[span(controller.law.outputs, "control")] = held  # it was held all the time
    controller.step(np.nan, 2.25)
    assert (controller.status, late.status) == ("MEASUREMENT_MISSING", "SAMPLES_SKIPPED")
    assert STATUSES["SAMPLES_SKIPPED"] in (package("lag_sampled").directory / "README.md").read_text()
    residual = 0.8 - expected_mean(lag(), start, held, 2.0, 2.25)  # the mean of all that time
    expected = controller.state["estimate"] + late.state["filter_gain"] * residual
    np.testing.assert_allclose(late.state["estimate"], expected, rtol=0, atol=1e-9)
    nominal = coming(lag(), 2.25, 2.26)
    assert control[0] == pytest.approx(nominal - late.state["feedback_gain"][0] @ expected, abs=1e-8)
    assert (late.state["index"], late.state["passed"]) == (225, 0)
    assert late.step(7.0, 2.252) == pytest.approx(control, abs=1e-15)
    assert late.status == "READING_IGNORED"


def test_the_nearest_sample_is_taken():
    early, late = ready("lag_sampled"), None
    one = early.step(0.5, 2.0149)
    late = package("lag_sampled").python().step
    after(late, [(0.4, 1.0), (0.1, 1.5), (0.9, 2.0)])
    assert late.step(0.5, 2.0051)[0] == one[0]


@pytest.mark.parametrize("limits", ["bounds", {"lift_to_drag": (0.3, 0.6)}])
def test_limits_hold(limits):
    made = export_c(mars(), FOLDER / f"limited_{len(limits)}_{type(limits).__name__}", limits=limits)
    controller = made.reference().step
    low, high = (0.0, 1.0) if limits == "bounds" else (0.3, 0.6)
    controls = []
    for sign in (1.0, -1.0):
        controller.init()
        controls += [controller.step([sign * 400.0, sign * 400.0], 200.0 + k)[0] for k in range(60)]
    assert min(controls) == low
    assert max(controls) == high


# --- what cannot be a controller --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"period": 0.0}, "not a positive number"),
        ({"period": np.nan}, "not a positive number"),
        ({"period": "fast"}, "not a positive number"),
        ({"period": 11.0}, "does not fit the duration"),
        ({"period": 1e-9}, "does not fit the duration"),
        ({"limits": "hard"}, "unknown kind"),
        ({"limits": {"u": 3.0}}, "no pair"),
        ({"limits": {"u": (1.0, -1.0)}}, "u"),
        ({"limits": {"thrust": (0.0, 1.0)}}, "thrust"),
        ({"feedback": False, "period": 0.1}, "those of a controller"),
        ({"intervals": 10}, "no option 'intervals' for a solution"),
        ({"limit": "bounds"}, r"(?s)no option 'limit' for a solution.*perhaps 'limits' is meant"),
    ],
)
def test_options_that_mean_nothing_are_refused(options, words):
    with pytest.raises(co.CovocpError, match=words):
        export_c(lag(), FOLDER / "refused", **options)
    assert not (FOLDER / "refused").exists()


def test_a_closed_loop_read_from_a_file_needs_its_problem(tmp_path):
    from covocp.models import unknown_lag

    path = lag().save(tmp_path / "lag.npz")
    with pytest.raises(co.ExportError, match=r"load\(path, problem="):
        export_c(co.load(path), FOLDER / "no_problem")
    export_c(co.load(path), FOLDER / "no_feedback", feedback=False)
    problem = unknown_lag.steering(parameter_variance=0.05)
    made = export_c(co.load(path, problem=problem), FOLDER / "with_problem")
    assert [law.name for law in made.laws] == ["sample", "step"]
