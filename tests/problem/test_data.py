"""Data over time against numpy, scipy and closed forms; coverage and wrong data."""

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from refusals import empty, refused
from scipy.integrate import quad, solve_bvp
from scipy.interpolate import CubicSpline

import covocp as co
from covocp.models import damped_oscillator

KNOTS = {"few": 23, "many": 301}


def knots(count, last=10.0):
    """Uneven times from 0 to the last."""
    inside = np.sort(np.random.default_rng(count).uniform(0.0, last, count - 2))
    return np.concatenate([[0.0], inside, [last]])


def drifting(times, values, kind="linear", duration=10.0, cubed=False):
    """dx/dt = u + the data (or their cube), and the data."""
    ocp = co.Problem(duration=duration)
    wind = ocp.data("wind", times, values, kind=kind, unit="m/s")
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u + (wind**3 if cubed else wind))
    ocp.minimize(running=u**2, terminal=x**2)
    return ocp, wind, x


def drift(ocp, x, **options):
    """What the data alone make of the state."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        return co.evaluate(ocp, nominal={"u": 0.0}, **options)[x][-1]


@pytest.mark.parametrize("size", KNOTS)
@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_the_values_are_those_of_numpy_and_scipy_and_keep_scalars(size, kind):
    times = knots(KNOTS[size])
    values = np.stack([np.sin(times), times**2], axis=1)
    ocp = co.Problem(duration=10.0)
    both = ocp.data("both", times, values, kind=kind)
    x = ocp.state("x", initial=0.0)
    ocp.dynamics(x, both[0] * ocp.control("u") + ca.sum1(both))
    ocp.minimize(running=x**2)
    assert ocp.statement().symbolic is ca.SX
    at = np.linspace(0.0, 10.0, 1001)
    found = np.array([ocp.declarations.data[0].function(t).full().ravel() for t in at])
    line = np.stack([np.interp(at, times, column) for column in values.T], axis=1)
    exact = line if kind == "linear" else CubicSpline(times, values)(at)
    np.testing.assert_allclose(found, exact, rtol=1e-12, atol=1e-12)
    rate = ocp.statement().rates(0.0, 2.0, [], at[333], 10.0, [])[0]
    assert float(rate) == pytest.approx(3.0 * exact[333, 0] + exact[333, 1], rel=1e-12)


@pytest.mark.parametrize("intervals", [30, 40])
def test_kinks_are_nodes_so_that_integration_keeps_its_order(intervals):
    """Cubes of straight lines are integrated without error by steps of fourth order from kink to kink."""
    times = knots(23)
    values = np.sin(times)
    ocp, _, x = drifting(times, values, cubed=True)
    exact = quad(lambda t: np.interp(t, times, values) ** 3, 0.0, 10.0, points=times, limit=200)[0]
    assert drift(ocp, x, intervals=intervals) == pytest.approx(exact, rel=1e-11)


def test_straight_pieces_have_no_kinks_and_those_of_other_data_count():
    ocp = co.Problem(duration=10.0)
    straight = ocp.data("ramp", np.linspace(0, 10, 201), np.linspace(0, 1, 201))
    rough = ocp.data("rough", knots(301), np.sin(knots(301)))
    bent = ocp.data("bent", [-1.0, 3.3, 7.7, 12.0], [0.0, 1.0, -1.0, 0.0])
    ocp.data("nowhere", [0.0, 1.1, 10.0], [0.0, 1.0, 0.0])
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u + straight + rough + bent)
    ocp.minimize(running=u**2 + x**2)
    for options, expected in (({"intervals": 10}, 9), ({"grid": [0.0, 0.33, 0.5, 1.0]}, 4)):
        nodes = co.evaluate(ocp, nominal={"u": 0.0}, **options).mesh.nodes
        assert nodes.size == expected + 1
        assert {0.33, 0.77} <= {round(float(s), 12) for s in nodes}
    coarse, fine = (co.evaluate(ocp, nominal={"u": 0.0}, intervals=n) for n in (10, 400))
    assert fine.optimality.mesh_error < 1e-7  # the kinks of all are nodes; of a coarse mesh its error is told
    assert 0.5 < coarse.optimality.mesh_error / abs(coarse.cost / fine.cost - 1) < 3


def test_knots_of_a_spline_leave_the_order_of_the_steps():
    times = knots(23)
    spline = CubicSpline(times, np.sin(3 * times))
    ocp, _, x = drifting(times, np.sin(3 * times), kind="cubic")
    exact = spline.integrate(0.0, 10.0)
    counts = (40, 80, 160, 320)
    errors = [abs(drift(ocp, x, intervals=n, substeps=1) - exact) for n in counts]
    assert co.evaluate(ocp, nominal={"u": 0.0}, intervals=40).mesh.intervals == 40
    assert np.polyfit(np.log(counts), np.log(errors), 1)[0] < -3.5


@pytest.mark.parametrize("method", ["ipopt", "gradient"])
def test_a_kinked_reference_is_tracked_as_the_boundary_value_problem_says(method):
    """x' = u, cost u^2 + (x - r)^2: x'' = x - r, x'(T) = 0; between the kinks smooth."""
    times, values = np.array([0.0, 1.7, 2.1, 4.0]), np.array([0.0, 1.0, -0.5, -0.5])
    ocp = co.Problem(duration=4.0)
    r = ocp.data("reference", times, values)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2 + (x - r) ** 2)
    exact = solve_bvp(
        lambda t, y: [y[1], y[0] - np.interp(t, times, values), y[1] ** 2 + (y[0] - np.interp(t, times, values)) ** 2],
        lambda a, b: [a[0], b[1], a[2]],
        np.union1d(np.linspace(0, 4, 401), times),
        np.zeros((3, np.union1d(np.linspace(0, 4, 401), times).size)),
        tol=1e-9,
    )
    solution = co.solve(ocp, method, intervals=100, progress=False)
    assert solution.cost == pytest.approx(exact.y[2, -1], rel=2e-5)
    np.testing.assert_allclose(solution[x], exact.sol(solution.t)[0], atol=2e-4)
    np.testing.assert_allclose(solution[r], np.interp(solution.t, times, values), atol=1e-12)
    assert solution.optimality.mesh_error < 1e-6


def test_a_free_duration_is_covered_up_to_its_bound():
    times = np.linspace(0.0, 6.0, 7)
    ocp, _, x = drifting(times, np.ones(7) + times, duration=co.Free(2.0, 0.5, 6.0))
    assert ocp.statement().kinks(ocp.statement().values) == ()
    assert drift(ocp, x, intervals=10) == pytest.approx(4.0, rel=1e-12)  # the integral of 1 + t up to 2
    for upper, words in ((6.1, "6.1 s, the upper bound"), (np.inf, "upper=6")):
        refused(lambda upper=upper: drifting(times, times, duration=co.Free(2.0, 0.5, upper)), "'wind'", words)


@pytest.mark.parametrize(
    ("times", "values", "kind", "words"),
    [
        ([0.0, 5.0], [1.0, 2.0], "linear", ["do not cover", "0 to 10 s", "0 to 5 s"]),
        ([0.1, 10.0], [1.0, 2.0], "linear", ["do not cover", "0.1 to 10 s"]),
        ([0.0, 6.0, 6.0, 10.0], [1.0, 2.0, 3.0, 4.0], "linear", ["do not rise", "6, then 6"]),
        ([0.0, np.nan, 10.0], [1.0, 2.0, 3.0], "linear", ["not finite"]),
        ([0.0, 10.0], [1.0, np.nan], "linear", ["not finite"]),
        ([0.0, 10.0], [1.0, 2.0, 3.0], "linear", ["(2,)", "(3,)"]),
        ([0.0, 10.0], [[1.0, 2.0]], "linear", ["(1, 2)"]),
        ([[0.0, 10.0]], [1.0, 2.0], "linear", ["(1, 2)"]),
        ([], [], "linear", ["(0,)"]),
        (10.0, 1.0, "linear", ["()"]),
        ([0.0, 10.0], [1.0, 2.0], "cubic", ["too few", "at least 4"]),
        ([0.0, 10.0], [1.0, 2.0], "spline", ["unknown kind"]),
    ],
)
def test_wrong_data_are_refused_by_name(times, values, kind, words):
    ocp = co.Problem(duration=10.0)
    refused(lambda: ocp.data("wind", times, values, kind=kind), "wind", *words)
    ocp.data("wind", [0.0, 10.0], [1.0, 2.0])


def test_names_are_used_once_and_data_do_not_move():
    ocp = empty()
    wind = ocp.data("wind", [0.0, 1.0], [1.0, 2.0])
    refused(lambda: ocp.state("wind", initial=0.0), "used twice")
    refused(lambda: ocp.data("wind", [0.0, 1.0], [1.0, 2.0]), "used twice")
    refused(lambda: ocp.subject_to(wind, upper=1.0), "contains no variable")
    refused(lambda: ocp.dynamics(wind, 0.0), "not a symbol")


def test_the_printout_names_the_data_in_the_equations():
    ocp = co.Problem(duration=2.0)
    wind = ocp.data("side wind", np.linspace(0, 2, 301), np.stack([np.arange(301.0), np.ones(301)], 1), unit="m/s")
    x = ocp.state("x", initial=0.0)
    ocp.dynamics(x, wind[1] - x * wind[0])
    ocp.minimize(running=ocp.control("u") ** 2 + x**2)
    text = str(ocp)
    assert "side wind[1] - x*side wind[0]" in text
    rows = [line.split() for line in text.splitlines() if "301 values" in line]
    assert rows[0][:2] == ["side", "wind[0]"]
    assert " ".join(rows[0][2:]) == "m/s linear, 301 values from 0 to 2 s 0 .. 300"
    assert rows[1][-3:] == ["1", "..", "1"]


def test_a_table_is_at_the_top_and_takes_what_moves():
    lift = co.table("lift", ([0.0, 1.0], [0.0, 2.0]), [[0.0, 2.0], [1.0, 3.0]])
    assert isinstance(lift, co.Table)
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.5), ocp.control("u")
    ocp.dynamics(x, lift(x, u))
    ocp.minimize(running=u**2)
    assert float(ocp.statement().rates(0.5, 1.0, [], 0.0, 1.0, [])[0]) == pytest.approx(1.5)


def test_data_in_a_model_of_the_literature_change_nothing_where_they_are_constant():
    """A running cost times one, over time."""
    plain = damped_oscillator.problem()
    duration = float(plain.duration)
    cost = co.solve(plain, intervals=30, progress=False).cost
    model = damped_oscillator.problem()
    one = model.data("one", np.linspace(0.0, duration, 101), np.ones(101))
    running, terminal = model.declarations.cost
    changed = co.Problem.of(replace(model.declarations, cost=(running * one, terminal)))
    assert co.solve(changed, intervals=30, progress=False).cost == pytest.approx(cost, rel=1e-8)


@pytest.mark.parametrize("count", [4, 101])
def test_data_at_the_end_are_those_of_the_duration(count):
    """min u^2 T + (x - r(T))^2 with x(T) = u T: x(T) = r T / (1 + T)."""
    times = np.linspace(0.0, 3.0, count)
    ocp = co.Problem(duration=2.5)
    r = ocp.data("r", times, times**2)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    wrong = co.Problem.of(ocp.declarations)
    wrong.minimize(running=u**2, terminal=(x - r) ** 2)
    refused(wrong.statement, "'time'", "casadi.substitute(data, problem.time")
    last = ca.substitute(r, ocp.time, ca.MX(ocp.duration))
    ocp.minimize(running=u**2, terminal=(x - last) ** 2)
    exact = np.interp(2.5, times, times**2) * 2.5 / 3.5
    assert co.solve(ocp, intervals=20, progress=False)[x][-1] == pytest.approx(exact, rel=1e-7)


def test_data_that_end_a_little_early_are_told_by_how_much():
    ocp = co.Problem(10.0)
    with pytest.raises(co.ProblemError) as caught:
        ocp.data("w", [0.0, 10.0 - 1e-9], [0.0, 1.0])
    assert caught.value.expected == "times from 0 to 10 s"
    assert caught.value.received == "times from 0 to 9.999999999 s"
