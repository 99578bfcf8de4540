"""Measurements stated by their information, which may be zero, and bounds at which a density ends."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import solve
from refusals import refused
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

import covocp as co

DECAY, NOISE, DENSITY, PRICE, DURATION = 0.1, 0.1, 0.1, 0.05, 10.0


def switched(stated="information", guess=0.5):
    """A sensor that costs while it is switched on: information w/U."""
    ocp = co.Problem(DURATION, "switched sensor")
    x, w = ocp.state("x", initial=0.0, variance=1.0), ocp.control("w", lower=0, upper=1, guess=guess)
    ocp.dynamics(x, -DECAY * x, noise=NOISE)
    if stated == "information":
        ocp.measurement("m", x, information=w / DENSITY)
    else:
        ocp.measurement("m", x, noise=DENSITY / w)
    E = ocp.estimation_covariance()
    ocp.minimize(running=PRICE * w, terminal=E[x, x])
    return ocp


def variance(switch):
    """E(T) by scipy, the sensor switched on at a time."""

    def rate(t, E, on):
        return -2 * DECAY * E + NOISE - on * E**2 / DENSITY

    before = solve_ivp(rate, (0, switch), [1.0], args=(0.0,), rtol=1e-10, atol=1e-12).y[0, -1]
    return solve_ivp(rate, (switch, DURATION), [before], args=(1.0,), rtol=1e-10, atol=1e-12).y[0, -1]


def best():
    """Cost of the best time at which to switch on."""
    found = minimize_scalar(lambda s: PRICE * (DURATION - s) + variance(s), bounds=(5.0, 9.9), method="bounded")
    return found.fun


@pytest.mark.parametrize(
    "options",
    [{"covariances": "eliminated"}, {"covariances": "states"}, {"method": "gradient"}],
    ids=lambda options: next(iter(options.values())),
)
def test_switched_sensor(options):
    """As cheap as the best single switch, up to the interval in which it lies."""
    solution = solve(switched(), **options)
    assert solution.cost == pytest.approx(best(), rel=5e-4)
    assert abs(solution["w"][0]) < 1e-6


@pytest.mark.parametrize("formulation", ["eliminated", "states"])
def test_density_that_ends_at_a_bound_is_kept_from_passing_it(formulation):
    """U/w, w >= 0: a bound that is widened, by however little, makes the density negative."""
    solution = solve(switched("noise"), covariances=formulation)
    assert solution["w"].min() >= 0.0
    assert solution.cost == pytest.approx(best(), rel=5e-4)


def test_no_information_measures_nothing():
    """dE/dt = 2 F E + Q."""
    solution = co.evaluate(switched(), nominal={"w": 0.0})
    decay = np.exp(-2 * DECAY * solution.t)
    E = decay + NOISE / (2 * DECAY) * (1 - decay)
    np.testing.assert_allclose(solution.covariance("x").ravel(), E, rtol=1e-8)


def loop(blind, stated):
    """A closed loop with two instruments, the second of which sees nothing at first."""
    ocp = co.Problem(4.0, "half blind")
    x, u = ocp.state("x", 2, initial=[1.0, 0.0], variance=[0.5, 0.1]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], -0.2 * x[1] + u), noise=[0.0, 0.1])
    ocp.measurement("speed", x[1], noise=0.5)
    on = 1 / (1 + ca.exp(-8 * (ocp.time - 2.0))) if blind else ca.MX(1.0)
    if stated == "information":
        ocp.measurement("m", x[0], information=on / 0.05)
    else:
        ocp.measurement("m", x[0], noise=0.05 / on)
    ocp.minimize_expected(running=0.5 * u**2 + 0.5 * x[0] ** 2, terminal_weight={x: 2.0})
    return ocp


@pytest.mark.parametrize("blind", [False, True])
def test_information_is_the_inverse_of_the_density(blind):
    """Wherever both can be written, in every number of a closed loop."""
    one, two = (solve(loop(blind, stated), intervals=30) for stated in ("information", "noise"))
    assert one.cost == pytest.approx(two.cost, rel=1e-9)
    for name in ("K", "C"):
        np.testing.assert_allclose(one.gains[name], two.gains[name], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(one.deviation("x"), two.deviation("x"), rtol=1e-6)


def late():
    """The only instrument sees nothing in the first half."""
    ocp = co.Problem(4.0, "late")
    x, u = ocp.state("x", initial=1.0, variance=0.5), ocp.control("u")
    ocp.dynamics(x, -0.2 * x + u, noise=0.1)
    ocp.measurement("m", x, information=ca.if_else(ocp.time > 2.0, 20.0, 0.0))
    ocp.minimize_expected(running=0.5 * u**2 + 0.5 * x**2, terminal_weight={x: 2.0})
    return ocp


@pytest.mark.parametrize("filter", ["perturbation", "extended"])
def test_simulated_sensor_without_information_measures_nothing(filter):
    """Half way the filter's error has the variance of the system without feedback, by its closed form."""
    solution = solve(late(), intervals=40)
    runs = co.simulate(solution, 400, seed=1, progress=False, filter=filter)
    assert runs.cost == pytest.approx(solution.cost, abs=4 * runs.cost_error)
    middle = solution.covariance("x").ravel()[20]
    decay = np.exp(-0.4 * 2.0)
    assert middle == pytest.approx(0.5 * decay + 0.1 / 0.4 * (1 - decay), rel=1e-6)


@pytest.mark.needs_cc
@pytest.mark.parametrize("period", [None, 0.1])
def test_exported_controller_ignores_what_tells_nothing(tmp_path, period):
    """The readings of the first half do not move the estimate; those of the second half do."""
    solution = solve(late(), intervals=40)
    package = co.export_c(solution, tmp_path / "late", **({} if period is None else {"period": period}))
    package.build()
    assert package.check(samples=100).ok
    controller = package.python()

    def estimates(reading):
        controller.init()
        found = []
        for time in np.arange(1, 30) * 0.1:
            controller.step([reading], time)
            found.append(float(np.asarray(controller.estimate).ravel()[0]))
        return np.array(found)

    apart = np.abs(estimates(5.0) - estimates(-5.0))
    assert apart[:18].max() < 1e-12
    assert apart[-1] > 1.0


def refusal(**given):
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", 2, initial=0.0, variance=1.0)
    return lambda: ocp.measurement("m", x, **given)


def test_wrong_information_is_refused():
    refused(refusal(), "noise of the measurement 'm' is given not at all", "information=")
    refused(refusal(noise=1.0, information=1.0), "given twice")
    refused(refusal(information=-1.0), "information of 'm'", "not positive semidefinite")
    refused(
        refusal(information=np.array([[2.0, 1.0], [1.0, 2.0]])), "information of the measurement 'm'", "not diagonal"
    )
    refused(refusal(information=np.nan), "NaN")


def test_information_that_is_negative_at_the_start_is_refused():
    ocp = co.Problem(duration=1.0)
    x, w = ocp.state("x", initial=0.0, variance=1.0), ocp.control("w", lower=-1, upper=1, guess=[-0.5] * 11)
    ocp.dynamics(x, -x, noise=1.0)
    ocp.measurement("m", x, information=w)
    E = ocp.estimation_covariance()
    ocp.minimize(running=w, terminal=E[x, x])
    refused(lambda: solve(ocp, intervals=10), "information of 'm'")


def two_sensors(**given: object) -> co.Problem:
    """A mass whose place and speed may be measured."""
    ocp = co.Problem(4.0)
    x, v = ocp.state("x", initial=0.0, variance=0.1), ocp.state("v", initial=0.0, final=1.0, variance=0.2)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.1 * v, noise=0.01)
    ocp.measurement("both", ca.vertcat(x, v), **given) if given else ocp.measurement("speed", v, noise=2.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x, x])
    return ocp


@pytest.mark.parametrize("information", [[0.0, 0.5], np.diag([0.0, 0.5]), ca.DM([0.0, 0.5])])
def test_a_sensor_of_no_information_is_one_that_is_not_there(information):
    solution = co.solve(two_sensors(information=information), intervals=20, progress=False)
    alone = co.solve(two_sensors(), intervals=20, progress=False)
    assert solution.cost == pytest.approx(alone.cost, rel=1e-10)


def test_no_information_at_all():
    cost = co.solve(two_sensors(information=0.0), intervals=20, progress=False).cost
    assert cost > co.solve(two_sensors(), intervals=20, progress=False).cost


@pytest.mark.parametrize("refine", [1e-3, 1e-5])
def test_meshes_refine_themselves_beside_a_sensor_that_is_switched(refine):
    """The bound of zero is passed by no share of it: information that is negative means nothing."""
    ocp = co.Problem(4.0)
    x, w = ocp.state("x", initial=0.0, variance=1.0), ocp.control("w", lower=0, upper=1, guess=0.5)
    ocp.dynamics(x, -0.2 * x, noise=0.3)
    ocp.measurement("m", x, information=w / 0.1)
    E = ocp.estimation_covariance()
    ocp.subject_to(ocp.integral(w), upper=1.0)
    ocp.minimize(terminal=E[x, x])
    # the last second: up to 3 s by the linear equation, then by the Riccati equation of one state
    before = np.exp(-0.4 * 3.0) + 0.75 * (1.0 - np.exp(-0.4 * 3.0))
    rate = solve_ivp(lambda _, e: -0.4 * e + 0.3 - e**2 / 0.1, (0.0, 1.0), [before], rtol=1e-11, atol=1e-13)
    solution = co.solve(ocp, refine=refine, progress=False)
    assert solution.cost == pytest.approx(rate.y[0, -1], rel=refine)
