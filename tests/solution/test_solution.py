"""A solution as data: indexing, interpolation, costates, covariances, gains; all read-only."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from certificates import is_symmetric
from problems import lag, simulate, solve
from refusals import refused

import covocp as co


class Data:
    """A problem with vectors, unknowns, a parameter and two measurements, and its solution."""

    def __init__(self, control="linear"):
        self.problem = ocp = co.Problem(duration=2.0, name="vectors")
        self.k = ocp.parameter("k", [0.5, 0.2])
        self.y = ocp.state("y", 2, initial=[1, 0], final=[0, 0], variance=[0.5, 0.2])
        self.z = ocp.state("z", initial=0.0)
        self.b = ocp.unknown("b", mean=[1.0, 0.3], variance=[0.4, 0.1])
        self.u, self.w = ocp.control("u"), ocp.control("w", 2)
        spring = -self.b[0] * self.y[0] - self.b[1] * self.y[1]
        ocp.dynamics(self.y, ca.vertcat(self.y[1], spring + self.u), noise=[0.0, 0.1])
        ocp.dynamics(self.z, self.w[0] + 0.1 * self.w[1], noise=0.05)
        ocp.measurement("position", self.y[0], noise=0.1)
        ocp.measurement("mixed", ca.vertcat(self.z, self.y[1] * self.z), noise=[[0.2, 0.05], [0.05, 0.3]])
        self.E = ocp.estimation_covariance()
        self.S = ocp.symmetric("S", 2, initial=np.eye(2))
        ocp.dynamics(self.S, -2 * self.S)
        running = 0.5 * self.u**2 + 0.5 * ca.sumsqr(self.w)
        ocp.minimize(running, ca.trace(self.E.matrix) + 10 * (self.z - 1) ** 2 + self.k[0] * self.S[0, 0])
        self.solution = solve(ocp, intervals=40, control=control)


@pytest.fixture(scope="module")
def data():
    return Data()


def test_shapes(data):
    s = data.solution
    shapes = {"y": (2,), "z": (), "u": (), "w": (2,), "b": (2,), "k": (2,), "E": (5, 5), "S": (2, 2), "time": ()}
    for name, shape in shapes.items():
        assert s[name].shape == (41, *shape), name
    assert s.t.shape == (41,)
    assert s.duration == 2.0


def test_symbols_and_names_are_the_same(data):
    s = data.solution
    for name in ("y", "z", "u", "w", "b", "k"):
        np.testing.assert_array_equal(s[getattr(data, name)], s[name])
    np.testing.assert_array_equal(s[data.E], s["E"])
    np.testing.assert_array_equal(s[data.E.matrix], s["E"])
    np.testing.assert_array_equal(s[data.S], s["S"])
    np.testing.assert_array_equal(s[data.problem.time], s.t)


def test_constants_are_constant(data):
    np.testing.assert_array_equal(data.solution["b"], np.tile([1.0, 0.3], (41, 1)))
    np.testing.assert_array_equal(data.solution["k"], np.tile([0.5, 0.2], (41, 1)))


def test_boundary_values(data):
    s = data.solution
    np.testing.assert_allclose(s["y"][[0, -1]], [[1, 0], [0, 0]], atol=1e-8)
    np.testing.assert_allclose(s["E"][0], np.diag([0.5, 0.2, 0, 0.4, 0.1]), atol=1e-12)
    np.testing.assert_allclose(s["S"][:, 0, 0], np.exp(-2 * s.t), rtol=1e-6)


def test_expressions(data):
    s = data.solution
    np.testing.assert_allclose(s[data.y[0] * data.u], s["y"][:, 0] * s["u"], rtol=1e-12)
    np.testing.assert_allclose(s[ca.vertcat(data.y, data.z)], np.column_stack([s["y"], s["z"]]), rtol=1e-12)
    np.testing.assert_allclose(s[data.y @ data.w.T], s["y"][:, :, None] * s["w"][:, None, :], rtol=1e-12)
    np.testing.assert_allclose(s[data.E[data.y, data.b]], s["E"][:, 0:2, 3:5], rtol=1e-12)
    np.testing.assert_array_equal(s[ca.MX(0.0)], np.zeros(41))
    np.testing.assert_allclose(s[ca.sqrt(data.E["z", "z"])], np.sqrt(s["E"][:, 2, 2]), rtol=1e-12)
    np.testing.assert_allclose(s[data.k[0] * data.b[1] + data.problem.time], 0.15 + s.t, rtol=1e-12)


def test_unknown_names(data):
    for key in ("q", ca.MX.sym("q"), ca.MX.sym("y", 2) * 2):
        with pytest.raises(co.ProblemError, match="is not in this solution"):
            data.solution[key]
    with pytest.raises(co.ProblemError, match="no costate"):
        data.solution.costate("u")
    with pytest.raises(co.ProblemError, match="not in this solution"):
        data.solution.covariance("u")
    with pytest.raises(co.ProblemError, match="not in this solution"):
        data.solution.at(0.5)["q"]


def test_what_is_in_it(data):
    """`in` had looked for nodes by number."""
    assert "y" in data.solution
    assert "y[1]" in data.solution
    assert data.y[0] + data.b[1] in data.solution
    assert "q" not in data.solution
    assert ca.MX.sym("q") not in data.solution


def test_covariances(data):
    s = data.solution
    E = s["E"]
    assert is_symmetric(E)
    np.testing.assert_array_equal(s.covariance("y"), E[:, :2, :2])
    np.testing.assert_array_equal(s.covariance(data.y, data.b), E[:, :2, 3:])
    np.testing.assert_array_equal(s.covariance("b", "y"), np.swapaxes(s.covariance("y", "b"), 1, 2))
    np.testing.assert_array_equal(s.covariance("z"), E[:, 2:3, 2:3])
    np.testing.assert_allclose(s.deviation("y"), np.sqrt(np.stack([E[:, 0, 0], E[:, 1, 1]], axis=1)))
    np.testing.assert_allclose(s.deviation(data.z), np.sqrt(E[:, 2, 2]))
    assert s.deviation("b").shape == (41, 2)


def test_no_covariance():
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    solution = solve(ocp, intervals=5)
    assert solution.gains == {}
    assert solution.smallest_eigenvalue == np.inf
    with pytest.raises(co.ProblemError, match="no estimation covariance"):
        solution.covariance("x")


def test_gain_of_the_filter(data):
    """K = E M' U^-1 with M = d(measurement)/d(y, z, b) written out."""
    s = data.solution
    U = np.zeros((3, 3))
    U[0, 0], U[1:, 1:] = 0.1, [[0.2, 0.05], [0.05, 0.3]]
    K = s.gains["K"]
    assert K.shape == (41, 5, 3)
    for i in (0, 7, 40):
        (_, y1), z = s["y"][i], s["z"][i]
        M = np.array([[1, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, z, y1, 0, 0]])
        np.testing.assert_allclose(K[i], s["E"][i] @ M.T @ np.linalg.inv(U), rtol=1e-9, atol=1e-12)


def test_solution_obeys_its_equations(data):
    """States and covariance by scipy along the control found."""
    s = data.solution
    U = np.zeros((3, 3))
    U[0, 0], U[1:, 1:] = 0.1, [[0.2, 0.05], [0.05, 0.3]]
    U_inverse, Q = np.linalg.inv(U), np.diag([0, 0.1, 0.05, 0, 0])

    def rate(t, v, c):
        (y0, y1, z), E = v[:3], v[3:].reshape(5, 5)
        F = np.zeros((5, 5))
        F[0, 1] = 1
        F[1] = [-1, -0.3, 0, -y0, -y1]
        M = np.array([[1, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, z, y1, 0, 0]])
        slope = F @ E + E @ F.T + Q - E @ M.T @ U_inverse @ M @ E
        return [y1, -y0 - 0.3 * y1 + c[0], c[1] + 0.1 * c[2], *slope.ravel()]

    start = [1, 0, 0, *np.diag([0.5, 0.2, 0, 0.4, 0.1]).ravel()]
    v = simulate(rate, start, s.t, np.column_stack([s["u"], s["w"]]))
    np.testing.assert_allclose(np.column_stack([s["y"], s["z"]]), v[:, :3], atol=1e-6)
    np.testing.assert_allclose(s["E"].reshape(41, 25), v[:, 3:], atol=1e-6)


def test_costates_have_the_shapes_of_their_states(data):
    s = data.solution
    assert s.costate("y").shape == (41, 2)
    assert s.costate(data.z).shape == (41,)
    assert s.costate("E").shape == (41, 5, 5)
    assert s.costate(data.S).shape == (41, 2, 2)
    assert is_symmetric(s.costate("E"))
    np.testing.assert_allclose(s.costate("E")[-1], np.eye(5), atol=1e-12)
    np.testing.assert_allclose(s.costate("S")[:, 0, 0], 0.5 * np.exp(-2 * (2 - s.t)), rtol=1e-5)
    np.testing.assert_allclose(s.costate("z")[-1], 20 * (s["z"][-1] - 1), rtol=1e-6)


# --- between the nodes ------------------------------------------------------------------------------------------------


def test_nodes_are_met(data):
    s = data.solution
    sample = s.at(s.t)
    for name in ("y", "z", "u", "w", "E", "S", "b"):
        np.testing.assert_allclose(sample[name], s[name], rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(sample[data.y], s["y"], rtol=1e-12, atol=1e-13)


def test_one_time_and_many(data):
    one, many = data.solution.at(0.33), data.solution.at([0.33, 0.34])
    assert one["y"].shape == (2,)
    assert np.shape(one["u"]) == ()
    assert one["E"].shape == (5, 5)
    assert many["E"].shape == (2, 5, 5)
    np.testing.assert_array_equal(many["y"][0], one["y"])


def test_between_the_nodes_of_known_functions():
    """x = 3 t^2 - 2 t^3 and u = 6 - 12 t exactly: the cubic and the linear interpolation are exact."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", 2, initial=0.0, final=[1, 0]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize(running=0.5 * u**2)
    t = np.linspace(0, 1, 37)
    sample = solve(ocp, intervals=4, tolerance=1e-10).at(t)
    np.testing.assert_allclose(sample["x"][:, 0], 3 * t**2 - 2 * t**3, atol=1e-9)
    np.testing.assert_allclose(sample["u"], 6 - 12 * t, atol=1e-7)


def test_constant_controls_are_held():
    s = Data(control="constant").solution
    assert s["u"].shape == (41,)
    assert s["u"][-1] == s["u"][-2]
    assert s.trajectory.u.shape == (40, 3)
    np.testing.assert_array_equal(s.at([0.0, 0.049, 0.051, 2.0])["u"], s["u"][[0, 0, 1, 39]])


def test_covariances_between_the_nodes_are_semidefinite():
    """Also behind a jump that a cubic would overshoot: U = 1e-6 on a coarse mesh."""
    s = solve(lag(noise=1e-6).problem, intervals=30)
    E = s.at(np.linspace(0, 10, 401))["E"]
    assert np.linalg.eigvalsh(E).min() >= -1e-9 * np.abs(E).max()


@pytest.mark.parametrize("t", [-0.1, 2.1, [0.0, 3.0]])
def test_times_outside(data, t):
    with pytest.raises(ValueError, match="no values there"):
        data.solution.at(t)


@pytest.mark.parametrize(("t", "received"), [(400.0, "400.0"), ([0.0, 3.0], "[0.0, 3.0]"), (np.nan, "nan"), ("1", "1")])
def test_controls_at_times(data, t, received):
    """As `at` takes them: a time, a list, an array, none outside; the values are those of `at`."""
    s = data.solution
    times = [0.0, 0.33, 2.0]
    sample = s.at(times)
    both = np.hstack([sample["u"][:, None], sample["w"]])
    np.testing.assert_array_equal(s.controls_at(times), both)
    np.testing.assert_array_equal(s.controls_at(tuple(times)), both)
    np.testing.assert_array_equal(s.controls_at(np.array(times)), both)
    np.testing.assert_array_equal(s.controls_at(0.33), both[1])
    assert s.controls_at(1).shape == (3,)
    refused(lambda: s.controls_at(t), f"received: {received}" if t != "1" else "'controls_at' is not a number")
    refused(lambda: s.controls_at(1.0, before="no"), "True or False")


# --- plain, frozen data -----------------------------------------------------------------------------------------------


def test_read_only(data):
    s = data.solution
    for array in (s.trajectory.x, s.trajectory.u, s.trajectory.e, s.costates.state, s.costates.matrices, s.rates):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(AttributeError):
        s.name = "other"


@pytest.mark.parametrize("name", ["z", "u", "y", "E", "S", "b", "time"])
def test_values_cannot_be_spoiled(data, name):
    """Whether by a refusal or by a copy: writing into what indexing returns does not change the solution."""
    values = data.solution[name]
    before = values.copy()
    try:
        values[...] = 7.0
    except ValueError:
        return
    np.testing.assert_array_equal(data.solution[name], before)


def test_summary(data):
    text = str(data.solution)
    for word in ("vectors", "solved"):
        assert word in text
    assert data.solution.status == "solved"
    assert data.solution.converged
    assert data.solution.method == "ipopt"
    assert data.solution.stats["iterations"] > 0


def test_a_console_shows_one_line():
    """Also of a solution with hundreds of numbers; print shows the page."""
    text = repr(Data().solution)
    assert "vectors" in text
    assert "solved" in text
    assert len(text) < 120
