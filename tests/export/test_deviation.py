"""Every exported thing of the toolbox: compiled with every warning an error, equal to Python."""

import numpy as np
import pytest
from exports import FOLDER, filter_functions, lag, mars, package

import covocp as co
from covocp.export import export_c

pytestmark = pytest.mark.needs_cc
DOUBLE = ["lag", "lag_sampled", "mars", "mars_sampled", "swing", "history", "steps", "filters", "theta"]


@pytest.mark.parametrize("name", DOUBLE)
def test_double_precision_agrees_to_rounding(name):
    check = package(name).check()
    assert check.ok, str(check)
    assert check.deviation <= 1e-12
    assert check.self_test
    assert all(law.points == 1000 for law in check.laws.values())


@pytest.mark.parametrize("name", ["lag_single", "mars_single"])
def test_single_precision_reports_its_deviation(name):
    check = package(name).check()
    assert check.ok, str(check)
    assert 1e-9 < check.deviation < 1e-2


def test_another_seed_gives_other_points_and_the_same_answer():
    lag_package = package("lag")
    first, second = lag_package.check(samples=200), lag_package.check(samples=200, seed=7)
    assert first.ok
    assert second.ok
    assert lag_package.ok
    assert lag_package.deviation == second.deviation


def test_points_contain_the_ends_of_the_time_and_what_lies_beyond():
    law = package("history").laws[0]
    times = law.points(np.random.default_rng(0), 200)[:, 0]
    end = package("history").laws[0].constants["DURATION [s]"]
    assert {0.0, end} <= set(times[np.isfinite(times)].tolist())
    assert (times < 0).any()
    assert (times > end).any()
    assert np.isnan(times).any()
    assert np.isinf(times).any()


def test_a_wrong_constant_is_found_by_check_and_by_the_self_test():
    made = export_c(filter_functions()[:1], FOLDER / "tampered")
    path = made.directory / "tampered_casadi.c"
    text = path.read_text(encoding="utf-8")
    assert "1.0000000000000001e-01" in text
    path.write_text(text.replace("1.0000000000000001e-01", "1.0000000000100001e-01"), encoding="utf-8")
    check = made.check(samples=50)
    assert not check.ok
    assert not check.self_test
    assert check.deviation > 1e-12
    assert not made.ok
    assert "FAILED" in str(check)


# --- 1000 steps in the loop -------------------------------------------------------------------------------------------


def fly_lag(controller, missing):
    """The actual lag, its control held between the steps."""
    solution, steps = lag(), 1000
    random = np.random.default_rng(1)
    h = solution.duration / steps
    x, history = random.normal(), []
    controller.init()
    u = float(controller.state["control"])
    for k in range(steps):
        x += h * (-1.1 * x + u) + np.sqrt(h) * random.normal()
        reading = x + random.normal() / np.sqrt(h) if not missing or k % 7 else np.nan
        u = float(controller.step(reading, (k + 1) * h)[0])
        history.append((x, u))
    return np.array(history)


@pytest.mark.parametrize("name", ["lag", "lag_sampled"])
@pytest.mark.parametrize("missing", [False, True])
def test_a_thousand_steps_of_the_lag_agree(name, missing):
    laws = package(name).python(), package(name).reference()
    in_c, in_python = (fly_lag(law.step, missing) for law in laws)
    assert np.isfinite(in_c).all()
    np.testing.assert_allclose(in_c, in_python, rtol=0, atol=1e-9)
    assert np.abs(in_c[:, 1]).max() > 0.5


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("name", ["mars", "mars_sampled"])
def test_a_thousand_steps_of_the_mars_entry_agree(name, missing):
    solution = mars()
    st, T, p = solution.statement, solution.duration, solution.parameters
    steps = 1000
    h = T / steps
    histories = []
    for laws in (package(name).python(), package(name).reference()):
        random = np.random.default_rng(2)
        x = solution.trajectory.x[0] + np.linalg.cholesky(solution["E"][0]) @ random.normal(size=5)
        controller = laws.step
        controller.init()
        u, history = solution.controls[0], []
        for k in range(steps):
            t = k * h
            middle = x + h / 2 * st.nominal(x, u, t, T, p)[0].full().ravel()
            x = x + h * st.nominal(middle, u, t + h / 2, T, p)[0].full().ravel()
            value = st.measurement(x, u, t + h, T, p)[0].full().ravel()
            value += np.sqrt(0.02 / h) * random.normal(size=2)
            if missing and k % 5 == 0:
                value[k % 2] = np.nan
            u = controller.step(value, t + h)
            history.append([*(x / np.abs(solution.trajectory.x).max(axis=0)), *u])
        histories.append(np.array(history))
    np.testing.assert_allclose(histories[0], histories[1], rtol=0, atol=1e-9)
    assert 1e-6 < np.abs(histories[0][:, -1] - 0.5).max() < 1.0


def test_theta_d_law_and_filter_in_the_loop_over_the_whole_of_scenario_two():
    import casadi as ca

    from covocp.models import agile_aircraft
    from covocp.simulation.laws import gain_filter

    A0, bilinear, B, measured = agile_aircraft.matrices()
    x, u = ca.SX.sym("x", 5), ca.SX.sym("u")
    plant = ca.Function("plant", [x, u], [(ca.DM(A0) + x[1] * ca.DM(bilinear)) @ x + ca.DM(B) @ u])
    scenario = agile_aircraft.tracking()
    runs = []
    for laws in (package("theta").python(), package("theta").reference()):

        def command(state, time, laws=laws):
            angle, integral = agile_aircraft.path_command(time)
            return laws.theta_d_servo(state, time, [0, 0, 0, angle, 0, integral])

        observer = gain_filter(
            plant, laws.theta_d_filter_gain, measured, scenario.estimate, integrate=[0.0, 0.0, 0.0, 1.0, 0.0]
        )
        options = {"duration": scenario.duration, "samples": 1001, "breaks": (5.0, 15.0, 20.0)}
        runs.append(co.simulate_law(plant, command, initial=np.zeros(5), observer=observer, **options))
    scale = np.abs(runs[1].x).max(axis=0)
    np.testing.assert_allclose(runs[0].x / scale, runs[1].x / scale, rtol=0, atol=1e-9)
    assert np.degrees(runs[0].x[497, 3]) == pytest.approx(45.0, abs=1.0)


def test_a_kalman_filter_with_missing_readings_agrees_over_a_thousand_cycles():
    from exports import NOISE, TRANSITION, H, R

    from covocp.blocks import kalman

    laws = package("filters").python()
    random = np.random.default_rng(3)
    truth, state, other = np.zeros(2), (np.zeros(2), np.eye(2)), (np.zeros(2), np.eye(2))
    for _ in range(1000):
        truth = TRANSITION @ truth + 0.1 * random.normal(size=2)
        reading = truth + random.normal(size=2)
        reading[random.uniform(size=2) < 0.3] = np.nan
        state = laws.update_joseph(*laws.predict(*state), reading)
        other = kalman.update(*kalman.predict(*other, TRANSITION, NOISE), reading, H, R, missing="skip")
    np.testing.assert_allclose(state[0], other[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(state[1], other[1], rtol=0, atol=1e-9)
