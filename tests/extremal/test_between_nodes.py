"""Between the nodes: values against scipy along the same controls, limits on the true path, rates that jump."""

import warnings

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co


def solve(problem, **options):
    return co.solve(problem, progress=False, **options)


def circuit(*, limit=6.0, target=12.0):
    """RL circuit with a time constant of 0.5 ms."""
    ocp = co.Problem(0.02, "circuit")
    i, u = ocp.state("i", initial=0.0, lower=-limit, upper=limit), ocp.control("u", lower=-12.0, upper=12.0)
    ocp.dynamics(i, (u - 1.2 * i) / 0.6e-3)
    ocp.minimize(running=(u - target) ** 2)
    return ocp


def current(solution, t):
    """Its differential equation by scipy, an interval at a time."""
    nodes, u, i = solution.t, solution["u"], np.zeros(1)
    result = np.zeros(t.size)
    for k in range(nodes.size - 1):
        inside = (t >= nodes[k]) & (t <= nodes[k + 1])
        span = nodes[k : k + 2]
        found = solve_ivp(
            lambda s, y, k=k: (np.interp(s, nodes, u) - 1.2 * y) / 0.6e-3, span, i, rtol=1e-10, atol=1e-12,
            dense_output=True,
        )  # fmt: skip
        result[inside], i = found.sol(t[inside])[0], found.y[:, -1]
    return result


# --- values -----------------------------------------------------------------------------------------------------------


def test_a_stiff_state_between_nodes_is_that_of_the_differential_equation():
    solution = co.evaluate(circuit(), nominal={"u": lambda s: 12 * np.sign(np.sin(6 * np.pi * s + 0.1))}, intervals=4)
    t = np.linspace(0.0, 0.02, 2001)
    true = current(solution, t)
    assert np.abs(solution.at(t)["i"] - true).max() <= 1e-4 * np.ptp(true)
    assert solution.dense.knots.size < 40 * solution.mesh.intervals


def lag(noise):
    ocp = co.Problem(10.0)
    x, b = ocp.state("x", initial=0.0, variance=1.0), ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u", guess=lambda s: np.sin(12 * s))
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=noise)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[b, b])
    return ocp


def along_lag(solution, noise, t):
    """x and E as rows at some times, by scipy an interval at a time."""
    nodes, u, z = solution.t, solution["u"], np.array([0.0, 1.0, 0.0, 0.0, 5.0])
    result = np.zeros((t.size, 5))

    def rates(s, z):
        E = z[1:].reshape(2, 2)
        F = np.array([[-1.0, -z[0]], [0.0, 0.0]])
        rate = F @ E + E @ F.T + np.diag([1.0, 0.0]) - np.outer(E[:, 0], E[0]) / noise
        return np.append(-z[0] + np.interp(s, nodes, u), rate)

    for k in range(nodes.size - 1):
        inside = (t >= nodes[k]) & (t <= nodes[k + 1])
        found = solve_ivp(rates, nodes[k : k + 2], z, method="LSODA", rtol=1e-10, atol=1e-13, dense_output=True)
        result[inside], z = found.sol(t[inside]).T, found.y[:, -1]
    return result[:, 0], result[:, 1:].reshape(-1, 2, 2)


@pytest.mark.parametrize("run", [co.evaluate, solve])
def test_default_steps_are_as_short_as_what_is_at_the_nodes_asks_for(run):
    """A covariance that falls within a tenth of the first interval, on the way only: the cost does not show it."""
    with pytest.warns(co.CovocpWarning, match="integration steps are long"):
        coarse = run(lag(1e-4), intervals=60, substeps=1)
    solution = run(lag(1e-4), intervals=60)
    t = np.linspace(0.0, 10.0, 601)
    for got, limits in ((coarse, (1e-3, 1.0)), (solution, (0.0, 1e-4))):
        x, E = along_lag(got, 1e-4, t)
        sample = got.at(t)
        assert np.abs(sample["x"] - x).max() <= 1e-4 * np.ptp(x)
        error = (np.abs(sample["E"] - E).max(axis=0) / np.ptp(E, axis=0)).max()
        assert limits[0] <= error <= limits[1]


def test_a_warm_start_takes_the_shorter_steps_of_its_solution():
    solution = solve(lag(1e-4), intervals=60)
    again = solve(lag(1e-4), intervals=60, guess=solution)
    assert again.mesh.substeps == solution.mesh.substeps > 1
    assert again.stats["iterations"] <= 1
    assert again.cost == pytest.approx(solution.cost, rel=1e-9)


def test_shorter_steps_keep_what_is_told_of_the_starts():
    solution = solve(lag(1e-4), intervals=60, guess="multistart", starts=2)
    assert solution.mesh.substeps > 1
    assert len(solution.stats["starts"]) == solution.stats["asked"] == 3


def test_given_steps_that_are_too_long_for_the_nodes_are_told_with_what_they_lose():
    problem = lag(1e-4)
    with pytest.warns(co.CovocpWarning, match="integration steps are long: halving them moves") as told:
        solution = co.evaluate(problem, intervals=20, substeps=1)
    _, E = along_lag(solution, 1e-4, solution.t)
    error = (np.abs(solution["E"] - E).max(axis=0) / np.ptp(E, axis=0)).max()
    stated = float(str(told[0].message).split("by ")[1].split()[0])
    assert error / 3 <= stated <= 3 * error


def test_a_state_that_is_smooth_needs_no_more_than_its_nodes():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u - x)
    ocp.minimize(running=u**2)
    solution = co.evaluate(ocp, nominal={"u": lambda s: np.cos(s)}, intervals=20)
    np.testing.assert_array_equal(solution.dense.knots, solution.mesh.nodes)


@pytest.mark.parametrize("noise", [1.0, 1e-6])
def test_a_covariance_falls_as_it_does_in_closed_form(noise):
    """x' = 0, measured: E = E0 / (1 + E0 t / U), over at once where U is small, on the coarsest meshes."""
    ocp = co.Problem(10.0)
    x, b, u = ocp.state("x", initial=0.0), ocp.unknown("b", mean=0.0, variance=5.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("reading", b, noise=noise)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2 + x**2, terminal=E[b, b])
    solution = co.evaluate(ocp, nominal={"u": 0.0}, intervals=4)
    t = np.concatenate([[0.0], np.geomspace(1e-9, 10.0, 500)])
    true = 5.0 / (1.0 + 5.0 * t / noise)
    got = solution.at(t)["E"][:, 1, 1]
    np.testing.assert_allclose(got, true, atol=1e-4 * 5.0, rtol=0)
    np.testing.assert_allclose(got, true, rtol=2e-3)


def test_the_matrix_that_runs_backward_rises_as_it_does_in_closed_form():
    """S' = S^2 / b backward from a heavy weight: 1 / S = 1 / S(T) + (T - t) / b, steep in the last interval."""
    ocp = co.Problem(4.0)
    x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("position", x, noise=1.0)
    ocp.estimation_covariance()
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 1e4})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        solution = co.evaluate(ocp, nominal={"u": 0.0}, intervals=10)
    left = np.geomspace(1e-6, 4.0, 300)
    true = 1.0 / (1e-4 + left)
    got = solution.at(4.0 - left)["S"].ravel()
    np.testing.assert_allclose(got, true, atol=1e-4 * 1e4, rtol=0)
    np.testing.assert_allclose(got, true, rtol=5e-3)


def test_a_solution_from_a_file_has_the_same_values_between_nodes(tmp_path):
    solution = co.evaluate(circuit(), nominal={"u": 7.0}, intervals=6)
    t = np.linspace(0.0, 0.02, 333)
    for suffix in (".npz", ".json"):
        loaded = co.load(solution.save(tmp_path / f"circuit{suffix}"))
        np.testing.assert_array_equal(loaded.at(t)["i"], solution.at(t)["i"])


# --- rates that jump --------------------------------------------------------------------------------------------------


def phases(comparison, at=0.9, duration=3.0):
    ocp = co.Problem(duration)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, ca.if_else(comparison(ocp.time, at), 1.0, 0.0) + u)
    ocp.minimize(running=u**2)
    return ocp


@pytest.mark.parametrize("comparison", [lambda t, at: t < at, lambda t, at: t <= at], ids=["<", "<="])
@pytest.mark.parametrize("substeps", [1, 3])
def test_a_rate_that_jumps_at_a_node_is_integrated_from_its_own_side(comparison, substeps):
    solution = solve(phases(comparison), intervals=10, substeps=substeps)
    assert solution["x"][-1] == pytest.approx(0.9, abs=1e-9)
    np.testing.assert_allclose(solution.at([0.6, 0.9, 1.7])["x"], [0.6, 0.9, 0.9], atol=1e-9)
    assert solution.mesh_error < 1e-9


def test_a_jump_inside_an_interval_is_told_by_the_mesh_error():
    """One that nothing can see: a table of CasADi's own with a steep piece."""
    ocp = co.Problem(3.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    rate = ca.interpolant("rate", "linear", [[0.0, 0.9 - 1e-9, 0.9, 3.0]], [1.0, 1.0, 0.0, 0.0])
    ocp.dynamics(x, rate(ocp.time) + u)
    ocp.minimize(running=u**2)
    with pytest.warns(co.CovocpWarning, match="node where a rate jumps"):
        solution = solve(ocp, intervals=8, substeps=1)
    wrong = abs(solution["x"][-1] - 0.9) / 0.9
    assert wrong > 0.01
    assert wrong / 5 < solution.mesh_error < 5 * wrong


# --- limits -----------------------------------------------------------------------------------------------------------


def swing(**options):
    """Bryson and Denham: x'' = u from 0 to 0, x <= 1/9."""
    ocp = co.Problem(1.0, "wall")
    x, u = ocp.state("x", 2, initial=[0.0, 1.0], final=[0.0, -1.0]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize(running=0.5 * u**2)
    ocp.subject_to(x[0], upper=1 / 9, name="wall")
    return solve(ocp, **options)


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_limits_hold_at_as_many_points_as_asked(control):
    passed = {}
    for points in (1, 4):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", co.CovocpWarning)
            solution = swing(intervals=10, points=points, control=control, tolerance=1e-9)
        inside = solution.t[:-1, None] + np.diff(solution.t)[:, None] * np.arange(points) / points
        assert solution.at(inside.ravel())["x"][:, 0].max() <= 1 / 9 + 1e-6
        passed[points] = solution.check_path(50).get("wall", 0.0)
        values = solution.optimality
        assert values.stationarity < 1e-6
        assert values.curvature > 0
        assert solution.multiplier("wall").shape == (11,)
    assert passed[4] < 0.5 * passed[1]


def test_multipliers_between_the_nodes_are_the_slope_of_the_cost():
    """The sum of all multipliers is what the cost falls by for a wall that is farther by one unit."""
    costs = {}
    for wall in (1 / 9 - 1e-4, 1 / 9, 1 / 9 + 1e-4):
        ocp = co.Problem(1.0)
        x, u = ocp.state("x", 2, initial=[0.0, 1.0], final=[0.0, -1.0], upper=[wall, np.inf]), ocp.control("u")
        ocp.dynamics(x, ca.vertcat(x[1], u))
        ocp.minimize(running=0.5 * u**2)
        costs[wall] = solve(ocp, intervals=8, points=3, tolerance=1e-10)
    low, middle, high = costs.values()
    slope = (low.cost - high.cost) / 2e-4
    m = middle.multipliers
    assert m.inside_states.shape == (8, 2, 2)
    assert m.inside_states[..., 0].sum() > 0
    assert m.states_at_nodes[:, 0].sum() == pytest.approx(slope, rel=1e-3)
    assert middle.optimality.stationarity < 1e-8


def test_limits_of_a_stiff_state_hold_on_its_true_path():
    """Points follow the substeps: between them the current passes its limit by less than a per cent."""
    guess = {"u": lambda s: 12 * np.sign(np.sin(6 * np.pi * s + 0.1))}
    solution = solve(circuit(), intervals=10, guess=guess)
    assert solution.mesh.points >= 3
    assert solution.mesh.substeps % solution.mesh.points == 0
    true = current(solution, np.linspace(0.0, 0.02, 4001))
    assert np.abs(true).max() <= 6.0 * 1.01


def test_a_limit_passed_between_the_nodes_is_warned_of_with_its_true_size():
    with pytest.warns(co.CovocpWarning, match="'wall' is passed by") as caught:
        solution = swing(intervals=4)
    t = np.linspace(0.0, 1.0, 40001)
    h, k = 0.25, np.minimum((t / 0.25).astype(int), 3)
    c, u = t / h - k, solution["u"]
    x0, v0 = solution["x"][k, 0], solution["x"][k, 1]
    true = x0 + h * c * v0 + h**2 * (u[k] * c**2 / 2 + (u[k + 1] - u[k]) * c**3 / 6)
    excess = true.max() - 1 / 9
    found = solution.passed_limits(100)[0]
    assert found.by == pytest.approx(excess, rel=1e-3)
    assert found.share == pytest.approx(9 * excess, rel=1e-3)
    assert f"{100 * found.share:.2g} % of it" in str(caught[0].message) or found.share < 0.01
    assert "limits are imposed at the nodes" in str(solution)


def test_a_nominal_that_passes_a_limit_between_the_nodes_only_is_told():
    """x = sin(2 pi t)/4 along four intervals, at whose ends it is below the limit."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, upper=0.2), ocp.control("u")
    ocp.dynamics(x, u * ca.cos(2 * np.pi * ocp.time))
    ocp.minimize(running=u**2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        solution = co.evaluate(ocp, nominal={"u": np.pi / 2}, intervals=2, substeps=20)
    assert np.abs(solution["x"]).max() < 1e-3
    assert solution.violations["bounds of x"] == pytest.approx(0.05, rel=1e-3)
    with pytest.raises(co.ProblemError, match="points"):
        co.evaluate(ocp, nominal={"u": 1.0}, points=3)


def test_problems_without_limits_keep_their_transcription():
    ocp = co.Problem(0.02)
    i, u = ocp.state("i", initial=0.0), ocp.control("u")
    ocp.dynamics(i, (u - 1.2 * i) / 0.6e-3)
    ocp.minimize(running=(u - 1.0) ** 2)
    solution = solve(ocp, intervals=10)
    assert solution.mesh.substeps > 1
    assert solution.mesh.points == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"points": 0}, "points"),
        ({"points": 1.5}, "points"),
        ({"points": "many"}, "points"),
        ({"points": 3, "substeps": 4}, "substeps=3, 6"),
        ({"points": 2, "method": "gradient"}, "points"),
    ],
)
def test_points_that_mean_nothing_are_refused_by_name(options, words):
    with pytest.raises(co.ProblemError, match=words):
        swing(intervals=6, **options)


def test_a_million_points_take_bounded_memory():
    """Nothing grows with the points: three times as many take no more memory."""
    import tracemalloc

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        solution = swing(intervals=2)
    solution.check_path(100)
    peaks = []
    for points in (20_000, 60_000):
        tracemalloc.start()
        solution.check_path(points)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]
