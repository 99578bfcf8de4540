"""Models that oscillate as often as the steps meet them, or a multiple of it, against closed forms and quadrature."""

from __future__ import annotations

import warnings
from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_bvp, solve_ivp

import covocp as co
from covocp.extremal.mesh_error import node_error
from covocp.extremal.turns import may_turn_often
from covocp.extremal.unseen import FEW, changes_within_steps

DURATION, INTERVALS = 10.0, 50


def shaken(frequency, amplitude=1.0, table=False):
    """A lag that is held near one while it is shaken, at some frequency [Hz]."""
    ocp = co.Problem(DURATION)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    if table:
        knots = np.linspace(0.0, DURATION, round(6 * frequency * DURATION) + 1)
        shake = ocp.data("shake", knots, np.cos(2 * np.pi * frequency * knots), kind="cubic")
    else:
        shake = ca.cos(2 * np.pi * frequency * ocp.time)
    ocp.dynamics(x, u - 0.1 * x + amplitude * shake)
    ocp.minimize(running=u**2 + 0.1 * (x - 1) ** 2)
    return ocp


def flown(solution, frequency, amplitude=1.0):
    """x(T) along the controls of a solution, each linear piece of u - x/10 in closed form, the shaking added to it."""
    t, u, a, w = solution.t, solution["u"], 0.1, 2 * np.pi * frequency
    x = 0.0
    for h, u0, slope in zip(np.diff(t), u[:-1], np.diff(u) / np.diff(t), strict=True):
        fade = np.exp(-a * h)
        x = fade * x + (u0 - slope / a) * (1 - fade) / a + slope * h / a
    T = t[-1]
    return x + amplitude * (a * np.cos(w * T) + w * np.sin(w * T) - a * np.exp(-a * T)) / (a**2 + w**2)


@pytest.mark.parametrize("frequency", [20.0, 40.0])
def test_given_steps_that_meet_one_place_of_a_period_are_told(frequency):
    with pytest.warns(co.CovocpWarning, match=r"changes with the time faster than the integration steps see.*'x'"):
        found = co.solve(shaken(frequency), intervals=INTERVALS, substeps=1, progress=False)
    off = abs(found["x"][-1] - flown(found, frequency)) / np.ptp(found["x"])
    assert off > 1.0  # the steps take the shaking for a constant
    assert 0.5 * off < found.optimality.node_error < 2.0 * off
    assert found.mesh_error > 0.5


def test_a_nominal_along_such_steps_is_told():
    with pytest.warns(co.CovocpWarning, match="faster than the integration steps see"):
        found = co.evaluate(shaken(20.0), nominal={"u": 0.0}, intervals=INTERVALS, substeps=1)
    assert abs(found["x"][-1] - flown(found, 20.0)) > 1.0


@pytest.mark.parametrize(("frequency", "table"), [(20.0, False), (40.0, True), (100.0, False)])
def test_default_steps_see_what_oscillates_at_a_round_frequency(frequency, table):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The mesh is too coarse")
        found = co.solve(shaken(frequency, table=table), intervals=INTERVALS, progress=False)
    still = co.solve(shaken(frequency, amplitude=0.0), intervals=INTERVALS, progress=False)
    assert found.cost == pytest.approx(still.cost, rel=3e-3)  # what is so fast moves x by 1 / (2 pi frequency) or less
    assert abs(found["x"][-1] - flown(found, frequency)) < 1e-3 * np.ptp(found["x"])


def test_default_steps_along_a_nominal_see_it():
    found = co.evaluate(shaken(20.0), nominal={"u": 0.0}, intervals=INTERVALS)
    assert found["x"][-1] == pytest.approx(flown(found, 20.0), abs=1e-4)


def test_a_cost_that_oscillates_alone_is_seen():
    """The mean of a cosine over whole periods is nothing."""
    ocp = co.Problem(DURATION)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=x**2 * (1 + ca.cos(2 * np.pi * 40.0 * ocp.time)))
    found = co.evaluate(ocp, nominal={"u": 0.0}, intervals=INTERVALS)
    assert found.cost == pytest.approx(DURATION, rel=1e-6)


def test_a_density_that_oscillates_counts_with_its_mean():
    """E' = Q - E^2 / U of a Wiener process from zero, in closed form with the mean of Q."""
    ocp = co.Problem(DURATION)
    x, u = ocp.state("x", initial=0.0, variance=0.0), ocp.control("u")
    ocp.dynamics(x, u, noise=0.05 * (1 + ca.cos(2 * np.pi * 40.0 * ocp.time)))
    ocp.measurement("position", x, noise=2.0)
    ocp.minimize_expected(running=u**2 + x**2)
    found = co.evaluate(ocp, nominal={"u": 0.0}, intervals=INTERVALS)
    settled = np.sqrt(0.05 * 2.0)
    E = settled * np.tanh(DURATION * settled / 2.0)
    assert found.trajectory.e[-1, 0] == pytest.approx(E, rel=5e-3)


def test_what_steps_see_is_not_told():
    """Smooth, too small to matter, or met as often as it needs: no warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for frequency, amplitude, substeps in ((0.1, 1.0, 1), (20.0, 1e-5, 1), (5.0, 1.0, 7)):
            problem = shaken(frequency, amplitude)
            found = co.solve(problem, intervals=INTERVALS, substeps=substeps, progress=False)
            off = abs(found["x"][-1] - flown(found, frequency, amplitude))
            assert off < 1e-2 * np.ptp(found["x"])


def lag_with(shake):
    """A lag that is shaken by what a function of the problem gives."""
    ocp = co.Problem(DURATION)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u - 0.1 * x + shake(ocp))
    ocp.minimize(running=u**2 + 0.1 * (x - 1) ** 2)
    return ocp


def by_quadrature(values):
    """x(T) of the lag along a control of 0.1: the integral of exp(-(T - t)/10) times that and the shaking."""
    t = (np.arange(800_000) + 0.5) * (DURATION / 800_000)
    return float(np.mean(np.exp(-0.1 * (DURATION - t)) * (0.1 + values(t))) * DURATION)


def clocked(rate, frequency):
    """The same shaking by a state that moves at some rate, which is one too: a clock, the angle of a rotor."""

    def shake(ocp):
        angle = ocp.state("angle", initial=0.0)
        speed = ocp.state("speed", initial=rate)
        ocp.dynamics(speed, 0.0 * speed)
        ocp.dynamics(angle, speed)
        return ca.cos(2 * np.pi * frequency / rate * angle)

    return lag_with(shake)


@pytest.mark.parametrize("rate", [1.0, 2 * np.pi * 20.0])
def test_a_clock_or_a_rotor_shakes_as_the_time_does(rate):
    problem = clocked(rate, 20.0)
    found = co.evaluate(problem, nominal={"u": 0.0}, intervals=INTERVALS)
    assert found["x"][-1] == pytest.approx(flown(found, 20.0), abs=1e-4)
    with pytest.warns(co.CovocpWarning, match="faster than the integration steps see"):
        given = co.evaluate(problem, nominal={"u": 0.0}, intervals=INTERVALS, substeps=1)
    assert given.mesh_error > 0.5


def test_an_optimum_with_a_clock_is_that_with_the_time():
    found = co.solve(clocked(1.0, 20.0), intervals=INTERVALS, progress=False)
    by_time = co.solve(shaken(20.0), intervals=INTERVALS, progress=False)
    assert found.cost == pytest.approx(by_time.cost, rel=1e-6)
    assert abs(found["x"][-1] - flown(found, 20.0)) < 1e-3 * np.ptp(found["x"])


def folded(x):
    """A triangle wave of 256 straight pieces in [0, 1], by |x| of |x|."""
    for _ in range(8):
        x = 1 - abs(1 - 2 * x)
    return x


def logistic(x):
    """A polynomial of degree 256 that keeps in [0, 1], turning 255 times."""
    for _ in range(8):
        x = 4 * x * (1 - x)
    return x


def chosen(x):
    """Zeros and ones by turns, 200 of them, as CasADi chooses them."""
    s = ca.SX.sym("s")
    values = ca.pw_const(s, ca.DM(np.arange(0.5, 200) / 20), ca.DM(np.arange(201) % 2.0))
    return ca.Function("chosen", [s], [values])(x)


# In symbols and in numbers, over [0, 10], with the number of intervals whose regular places miss them.
PROFILES = {
    "humps": (
        lambda x: sum(ca.exp(-(((x - 0.1 * k - 0.05) / 0.02) ** 2)) for k in range(100)),
        lambda x: sum(np.exp(-(((x - 0.1 * k - 0.05) / 0.02) ** 2)) for k in range(100)),
        25,
    ),
    "triangles": (lambda x: folded(x / 10), lambda x: folded(x / 10), 32),
    "a table of choices": (
        chosen,
        lambda x: np.floor(20 * x + 0.5) % 2.0,
        25,
    ),
    "pulses": (
        lambda x: sum(ca.if_else(ca.fabs(x - 0.2 * k - 0.05) < 0.03, 1, 0) for k in range(50)),
        lambda x: (np.abs(5 * x - np.floor(5 * x) - 0.25) < 0.15) * 1.0,
        25,
    ),
}


def driven(profile):
    """A lag driven over a profile at constant speed, and what it comes to by quadrature, along u(t)."""
    symbols, numbers, intervals = PROFILES[profile]
    ocp = co.Problem(1.0)
    place, w, u = ocp.state("place", initial=0.0), ocp.state("w", initial=0.0), ocp.control("u")
    ocp.dynamics(place, 10.0)
    ocp.dynamics(w, 10 * symbols(place) - w + u)
    ocp.minimize(running=u**2, terminal=(w - 1) ** 2)
    t = (np.arange(100_000) + 0.5) / 100_000

    def truth(solution):
        return float(np.mean(np.exp(-(1 - t)) * (10 * numbers(10 * t) + np.interp(t, solution.t, solution["u"]))))

    return ocp, intervals, truth


@pytest.mark.parametrize("profile", PROFILES)
def test_a_profile_of_many_pieces_along_a_state_is_told(profile):
    """No wave is in these by which they would repeat themselves."""
    problem, intervals, truth = driven(profile)
    with pytest.warns(co.CovocpWarning, match="changes with the time faster than the integration steps see.*'w'"):
        found = co.evaluate(problem, nominal={"u": 0.0}, intervals=intervals, substeps=1)
    off = abs(found["w"][-1] - truth(found)) / max(np.ptp(found["w"]), 1e-3)
    assert off > 0.5  # the steps take the profile for a constant
    assert node_error(found.extremal) > 0.25 * off


def test_default_steps_see_a_profile_of_humps():
    problem, intervals, truth = driven("humps")
    found = co.solve(problem, intervals=intervals, progress=False)
    assert found["w"][-1] == pytest.approx(truth(found), rel=2e-3)


def test_what_turns_a_few_times_is_known_by_its_operations():
    """Polynomials of low degree, gravity, drag in an atmosphere and saturation, no wave and nothing of many pieces."""
    s = ca.SX.sym("s", 3)
    x, v, a = ca.vertsplit(s)
    often = [ca.sin(x), ca.floor(x), logistic(x), *(symbols(x) for symbols, *_ in PROFILES.values())]
    often.append(sum((-1) ** k * ca.tanh(9 * (x - k)) for k in range(20)))
    seldom = [x**3 - v * a, -x / ca.norm_2(s) ** 3, ca.exp(-x) * v**2 * (1 + a**2), ca.fmin(ca.fmax(x, -1), 1)]
    for expressions, expected in ((often, True), (seldom, False)):
        for expression in expressions:
            assert may_turn_often(ca.Function("f", [s], [expression]), FEW) is expected
            assert not may_turn_often(ca.Function("f", [s], [expression]), FEW, constant=(0,))


KNOTS = np.linspace(0.0, DURATION, 801)
SHAPES = {
    "triangle": (
        lambda ocp: ocp.data("d", KNOTS, np.cos(40 * np.pi * KNOTS), kind="linear"),
        lambda t: np.interp(t, KNOTS, np.cos(40 * np.pi * KNOTS)),
    ),
    "rectified": (
        lambda ocp: ca.fabs(ca.cos(20 * np.pi * ocp.time)),
        lambda t: np.abs(np.cos(20 * np.pi * t)),
    ),
    "smooth": (
        lambda ocp: ca.exp(3 * ca.cos(40 * np.pi * ocp.time)) / 5,
        lambda t: np.exp(3 * np.cos(40 * np.pi * t)) / 5,
    ),
    "one pulse a step": (
        lambda ocp: ca.exp(-(((ca.fmod(ocp.time, 0.2) - 0.074) / 0.006) ** 2)),
        lambda t: np.exp(-(((np.mod(t, 0.2) - 0.074) / 0.006) ** 2)),
    ),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_harmonics_and_pulses_are_seen_or_told(shape):
    """Steps that see a period need not see its harmonics: what is told of the end of the run is of their size."""
    symbols, numbers = SHAPES[shape]
    truth = by_quadrature(numbers)
    for substeps in ("auto", 7):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = co.evaluate(lag_with(symbols), nominal={"u": 0.1}, intervals=INTERVALS, substeps=substeps)
        off = abs(found["x"][-1] - truth) / np.ptp(found["x"])
        assert off < 1e-4 or off < 4 * node_error(found.extremal)
        assert off < 1e-2 or told
        assert off < 3e-3 or substeps == 7


def test_many_periods_a_step_are_told():
    """308 periods are whole numbers in quarters, sevenths and elevenths of a step."""
    with pytest.warns(co.CovocpWarning, match="faster than the integration steps see"):
        found = co.evaluate(shaken(1540.0), nominal={"u": 0.0}, intervals=INTERVALS, substeps=1)
    assert abs(found["x"][-1] - flown(found, 1540.0)) > 1.0
    assert found.mesh_error > 0.5


def test_what_moves_smoothly_is_not_looked_at_further():
    """Stiff, unstable, oscillating, jumping at nodes: what halves of the steps see needs no other parts."""
    for poles, speed in ((-50.0, 1.0), (1.0, 1.0), (-0.1, 6.0)):
        ocp = co.Problem(2.0)
        x, y, u = ocp.state("x", initial=1.0), ocp.state("y", initial=0.0), ocp.control("u")
        ocp.dynamics(x, poles * x + ca.sin(x) + u + ca.sign(ca.sin(np.pi * 5.0 * ocp.time)))
        ocp.dynamics(y, speed * x * ca.cos(y))
        ocp.minimize(running=u**2 + x**2)
        found = co.evaluate(ocp, nominal={"u": 0.0}, intervals=100)
        assert not changes_within_steps(found.extremal)


@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
def test_what_first_steps_would_take_for_nothing_is_seen_before_they_run(method):
    """A sine that is zero wherever they meet it: x(T) in closed form, the controls' part by the same lag unshaken."""
    problem = lag_with(lambda ocp: ca.sin(2 * np.pi * 20.0 * ocp.time))
    found = co.solve(problem, method, intervals=INTERVALS, progress=False)
    a, w, T = 0.1, 2 * np.pi * 20.0, DURATION
    shaken_alone = (a * np.sin(w * T) - w * np.cos(w * T) + w * np.exp(-a * T)) / (a**2 + w**2)
    assert found["x"][-1] == pytest.approx(flown(found, 20.0, amplitude=0.0) + shaken_alone, abs=1e-4)


def best_cost(frequency):
    """Of the lag shaken by a sine: its Hamiltonian equations are linear, and two runs of them meet p(T) = 0."""
    steps = {"rtol": 1e-9, "atol": 1e-11, "max_step": 0.1 / frequency}

    def rate(t, z):
        x, p, _ = z
        u = -p / 2
        rest = u - 0.1 * x + np.sin(2 * np.pi * frequency * t)
        return [rest, 0.1 * p - 0.2 * (x - 1), u**2 + 0.1 * (x - 1) ** 2]

    def end(start):
        return solve_ivp(rate, (0, DURATION), [0.0, start, 0.0], **steps).y[:, -1]

    missed = end(0.0)[1]
    return end(-missed / (end(1.0)[1] - missed))[2]


@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
@pytest.mark.parametrize("frequency", [5.0, 10.0])
def test_a_sine_at_whose_zeros_the_steps_meet_it_is_no_magnitude(frequency, method):
    ocp = co.Problem(DURATION)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u - 0.1 * x + ca.sin(2 * np.pi * frequency * ocp.time))
    ocp.minimize(running=u**2 + 0.1 * (x - 1) ** 2)
    found = co.solve(ocp, method=method, intervals=INTERVALS, progress=False)
    assert found.cost == pytest.approx(best_cost(frequency), rel=2e-4)


def lag_of_periods(frequency: float) -> co.Problem:
    """A lag that is kept at rest while it is shaken: steps that meet each period at its zeros find nothing to do."""
    ocp = co.Problem(DURATION)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u - 0.5 * x + ca.sin(2 * np.pi * frequency * ocp.time))
    ocp.minimize(running=0.1 * u**2 + x**2)
    return ocp


@cache
def least_cost(frequency: float) -> float:
    """By the two-point boundary value problem of x, its costate, and the cost."""

    def rates(t, y):
        x, p = y[:2]
        shake = np.sin(2 * np.pi * frequency * t)
        return np.vstack([-0.5 * x - 5.0 * p + shake, 0.5 * p - 2.0 * x, 2.5 * p**2 + x**2])

    def ends(first, last):
        return np.array([first[0], last[1], first[2]])

    t = np.linspace(0.0, DURATION, round(40 * frequency * DURATION) + 1)
    found = solve_bvp(rates, ends, t, np.zeros((3, t.size)), tol=1e-4, max_nodes=t.size)
    assert found.success
    return float(found.y[2, -1])


@pytest.mark.parametrize("options", [{}, {"control": "constant"}, {"method": "gradient"}])
def test_where_the_steps_see_nothing_of_what_costs_they_are_shortened(options):
    """A run on them has no more than roundoff to minimise, and fails of it: 2e-21 is no cost to be had."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the mesh, whose error is told
        solution = co.solve(lag_of_periods(10.0), intervals=20, progress=False, **options)
    error = abs(solution.cost / least_cost(10.0) - 1.0)
    assert error < 0.03
    assert error < 4.0 * (solution.mesh_error + solution.optimality.control_error)


def test_what_the_user_limits_is_not_tried_on_other_steps():
    with pytest.raises(co.SolveError) as failed:
        co.solve(lag_of_periods(10.0), intervals=20, max_iterations=50, progress=False)
    assert failed.value.solution.mesh.substeps == 1


def test_a_state_that_long_steps_move_where_nothing_costs_is_no_error_of_the_cost():
    """A lag that is asked for at a moment alone: it dies out in one long interval, of which halves tell the state."""
    ocp = co.Problem(10.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    weight = ocp.data("weight", np.array([0.0, 4.97, 5.0, 5.03, 10.0]), np.array([0.0, 0.0, 50.0, 0.0, 0.0]))
    ocp.dynamics(x, u - 0.5 * x)
    ocp.minimize(running=0.1 * u**2 + weight * (x - 1) ** 2)
    grid = np.concatenate([np.linspace(0.0, 0.497, 40), np.linspace(0.497, 0.503, 13)[1:], [0.6, 1.0]])
    with pytest.warns(
        co.CovocpWarning, match="changes the cost by .* and moves a state by .* between two nodes"
    ) as told:
        solution = co.solve(ocp, grid=grid, substeps=1, progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        finer = co.solve(ocp, grid=grid, substeps=8, progress=False)
        printed = str(solution)
    assert "substeps" in str(told[0].message)
    assert "refine" not in str(told[0].message)
    assert solution.cost == pytest.approx(finer.cost, rel=2e-4)
    assert solution.mesh_error > 2e-4
    assert "cost, or states between nodes" in printed
