"""Problems with attitudes: against rotation by nine states, integrations of their own, and what they must keep."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from attitudes import INERTIA, slew, tracked
from problems import unassessed
from scipy.integrate import solve_ivp

import covocp as co
from covocp.blocks import so3


def turned_by(solution, goal):
    """Angle between the last attitude and the one to reach."""
    return np.linalg.norm(so3.log(so3.from_quaternion(solution["attitude"][-1]) @ goal.T))


def pairs(count, seed):
    """Random attitudes, of angles up to half a turn."""
    random = np.random.default_rng(seed)
    axes = random.normal(size=(2 * count, 3))
    axes *= random.uniform(0.0, np.pi, 2 * count)[:, None] / np.linalg.norm(axes, axis=1)[:, None]
    return so3.exp(axes).reshape(count, 2, 3, 3)


def by_nine_states(first, last):
    """The same slew with the entries of the rotation as states; at the end C C_f' is symmetric."""
    ocp = co.Problem(10.0, "nine states")
    turn = so3.log(last @ first.T)
    omega = ocp.state("omega", 3, initial=0.0, final=0.0)
    torque = ocp.control("torque", 3)

    def way(s):
        return np.array([(so3.exp((3 * c**2 - 2 * c**3) * turn) @ first).ravel(order="F") for c in np.atleast_1d(s)])

    entries = ocp.state("entries", 9, initial=first.ravel(order="F"), guess=way)
    C = ca.reshape(entries, 3, 3)
    ocp.dynamics(entries, ca.vec(-so3.cross(omega) @ C))
    ocp.dynamics(omega, (torque - ca.cross(omega, INERTIA @ omega)) / np.diag(INERTIA))
    apart = so3.vee(so3.antisymmetric_part(C @ ca.DM(last).T))
    ocp.subject_to(apart, lower=np.zeros(3), upper=np.zeros(3), at="final")
    ocp.minimize(running=ca.sumsqr(torque))
    return ocp


def test_slews_between_random_attitudes_solve_from_the_default_guess():
    for first, last in pairs(25, seed=1):
        ocp, *_ = slew(first, last)
        solution = unassessed(ocp, intervals=20)
        assert solution.converged
        assert turned_by(solution, last) < 1e-7  # not half a turn off, nor anywhere else


@pytest.mark.parametrize("k", range(3))
def test_a_slew_costs_what_it_costs_by_nine_states(k):
    first, last = pairs(3, seed=2)[k]
    ocp, *_ = slew(first, last)
    assert co.solve(ocp).cost == pytest.approx(unassessed(by_nine_states(first, last)).cost, rel=1e-6)


def test_the_quaternion_is_of_unit_length_at_the_nodes_and_between_whatever_the_step():
    ocp, attitude, _ = slew(*pairs(1, seed=3)[0], duration=30.0)
    for options in ({"intervals": 12, "substeps": 1}, {"intervals": 20, "step": "rodas"}):
        solution = co.solve(ocp, **options)
        assert np.linalg.norm(solution.trajectory.x[:, 3:7], axis=1) == pytest.approx(1.0, abs=1e-9)
        assert solution.mesh.nodes.size <= 21
        between = solution.at(np.linspace(0.0, 30.0, 77))[attitude]
        assert np.linalg.norm(between, axis=1) == pytest.approx(1.0, abs=1e-14)


def test_both_methods_agree_on_a_slew():
    ocp, *_ = slew(*pairs(1, seed=4)[0])
    one, other = (co.solve(ocp, method, intervals=40) for method in ("ipopt", "gradient"))
    assert other.cost == pytest.approx(one.cost, rel=1e-6)


def test_a_goal_that_is_given_by_the_other_sign_is_the_same_goal():
    first, last = pairs(1, seed=5)[0]
    costs = [co.solve(slew(first, sign * so3.to_quaternion(last))[0], intervals=20).cost for sign in (1.0, -1.0)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-7)


def test_ends_by_parameters_are_changed_without_building_again():
    ocp = co.Problem(10.0, "ends")
    goal = ocp.parameter("goal", so3.to_quaternion(so3.exp([0.5, 0.0, 0.0])))
    omega = ocp.control("omega", 3)
    ocp.attitude("attitude", initial=np.eye(3), final=goal, rate=omega)
    ocp.minimize(running=ca.sumsqr(omega))
    solver = co.Solver(ocp, intervals=10)
    for vector in ([0.5, 0.0, 0.0], [0.2, -1.0, 2.0], [0.0, 3.0, 0.5]):
        solution = solver.solve({goal: so3.to_quaternion(so3.exp(vector))}, progress=False)
        # the shortest way, at constant speed
        assert solution.cost == pytest.approx(np.sum(np.square(vector)) / 10.0, rel=1e-7)


def test_a_free_start_is_chosen_among_the_attitudes():
    """From any attitude that looks along z to one that is turned by 1 rad: the shortest way is a roll that is saved."""
    ocp = co.Problem(2.0, "free start")
    omega = ocp.control("omega", 3)
    goal = so3.exp([0.0, 0.8, 0.0]) @ so3.exp([0.0, 0.0, 1.1])
    attitude = ocp.attitude("attitude", initial=None, final=goal, rate=omega)
    ocp.subject_to(attitude.matrix[:, 2] - ca.DM([0.0, 0.0, 1.0]), lower=np.zeros(3), upper=np.zeros(3), at="initial")
    ocp.minimize(running=ca.sumsqr(omega))
    solution = co.solve(ocp, intervals=10)
    assert solution.cost == pytest.approx(0.8**2 / 2.0, rel=1e-6)
    assert np.linalg.norm(solution.trajectory.x[:, :4], axis=1) == pytest.approx(1.0, abs=1e-8)


def test_a_cone_is_kept_between_the_nodes_as_check_path_says():
    first, last, sun = np.eye(3), so3.exp([-2.2, 0.3, 0.4]), [0.2, 0.9, 0.4]
    ocp, attitude, torque = slew(first, last, duration=40.0, lower=-2.0, upper=2.0)
    free = co.solve(ocp, intervals=40).cost
    ocp.subject_to(attitude.cosine([0.0, 0.0, 1.0], sun), upper=np.cos(np.deg2rad(40.0)), name="Sun")
    solution = co.solve(ocp, intervals=40, points=2)
    assert solution.cost > free * 1.01
    assert solution.check_path() == {}
    t = np.linspace(0.0, 40.0, 4001)
    seen = so3.from_quaternion(solution.at(t)["attitude"])[:, 2, :] @ np.array(sun) / np.linalg.norm(sun)
    assert np.rad2deg(np.arccos(seen)).min() == pytest.approx(40.0, abs=0.01)


def test_the_covariance_of_a_turning_attitude_against_scipy():
    """Errors in body axes, d' = domega - omega x d; a star z = C s is seen at z + z x d."""
    ocp, attitude = tracked()
    solution = co.solve(ocp, intervals=50)
    J, u, nodes = INERTIA, solution["torque"], solution.t

    def cross(v):
        return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    def rate(t, y):
        w, C, P = y[:3], y[3:12].reshape(3, 3), y[12:].reshape(9, 9)
        control = np.array([np.interp(t, nodes, u[:, i]) for i in range(3)])
        F, M = np.zeros((9, 9)), np.zeros((6, 9))
        F[:3, :3] = np.linalg.solve(J, cross(J @ w) - cross(w) @ J)
        F[3:6, :3], F[3:6, 3:6] = np.eye(3), -cross(w)
        M[:3, :3] = M[:3, 6:] = np.eye(3)
        M[3:, 3:6] = cross(C[:, 0])
        noise = np.diag([1e-4] * 3 + [1e-5] * 3 + [0.0] * 3)
        seen = M.T @ np.diag([1e5] * 3 + [1e4] * 3) @ M
        slopes = (np.linalg.solve(J, control - cross(w) @ J @ w), -cross(w) @ C, F @ P + P @ F.T + noise - P @ seen @ P)
        return np.concatenate([part.ravel() for part in slopes])

    prior = np.diag([0.0] * 3 + [1e-2, 2e-2, 1e-2] + [1e-4] * 3)
    start = np.concatenate([np.zeros(3), np.eye(3).ravel(), prior.ravel()])
    found = solve_ivp(rate, (0.0, 10.0), start, method="LSODA", rtol=1e-9, atol=1e-13, max_step=0.2).y[:, -1]
    true = found[12:].reshape(9, 9)
    assert solution["E"][-1] == pytest.approx(true, abs=1e-7 * np.abs(true).max())
    assert solution.deviation(attitude)[-1] == pytest.approx(np.sqrt(np.diag(true)[3:6]), rel=1e-6)
    assert solution.covariance(attitude, "bias")[-1] == pytest.approx(true[3:6, 6:], abs=1e-7 * np.abs(true).max())
    strang = co.Solver(ocp, intervals=50, covariance_step="strang").solve(assess=False)
    assert strang.cost == pytest.approx(solution.cost, rel=1e-3)


def test_formulations_and_methods_agree_on_the_knowledge_of_an_attitude():
    """Without a body: three errors, six half-vector entries."""
    ocp = co.Problem(2.0, "formulations")
    rate = ocp.control("rate", 3, lower=-1.0, upper=1.0)
    attitude = ocp.attitude("attitude", initial=np.eye(3), rate=rate, variance=[0.1, 0.2, 0.1], noise=1e-2)
    ocp.measurement("boresight", attitude.matrix[0, :].T, 1e-2)
    E = ocp.estimation_covariance()
    ocp.minimize(running=ca.sumsqr(rate), terminal=100.0 * E["attitude[0]", "attitude[0]"])
    costs = [unassessed(ocp, covariances=kind, intervals=10).cost for kind in ("eliminated", "states")]
    costs.append(unassessed(ocp, "gradient", intervals=10).cost)
    assert costs[1:] == pytest.approx(costs[:1] * 2, rel=1e-6)


def test_a_solution_with_an_attitude_is_the_same_from_a_file(tmp_path):
    ocp, attitude, _ = slew(*pairs(1, seed=6)[0])
    solution = co.solve(ocp, intervals=20)
    read = co.load(solution.save(tmp_path / "slew.npz"), problem=ocp)
    assert np.array_equal(read[attitude], solution[attitude])
    assert np.array_equal(read[attitude.vector], solution[attitude.vector])
    dataset = co.load(solution.save(tmp_path / "slew.json")).to_xarray()
    turns = np.unwrap(np.linalg.norm(solution[attitude.vector], axis=1))
    assert dataset["angle_attitude"].values == pytest.approx(turns, abs=1e-7)
    assert np.linalg.norm(dataset["vector_attitude"], axis=1) == pytest.approx(turns, abs=1e-7)


def test_another_attitude_is_another_problem(tmp_path):
    first, last = pairs(1, seed=7)[0]
    path = co.solve(slew(first, last)[0], intervals=20).save(tmp_path / "slew.npz")
    with pytest.raises(co.ProblemError):
        co.load(path, problem=slew(first, last @ so3.exp([0.1, 0.0, 0.0]))[0])


def test_printed_and_drawn_as_rotation_vector_and_angle():
    goal = so3.exp([0.0, 1.0, 0.0])
    solution = co.solve(slew(np.eye(3), goal)[0], intervals=20)
    text = " ".join(str(solution).split())
    assert f"attitude, about y [deg] {np.rad2deg(1.0):.8g}" in text
    assert f"attitude, angle [deg] {np.rad2deg(1.0):.8g}" in text
    panel = next(axes for axes in solution.plot().axes if axes.get_ylabel() == "attitude [°]")
    assert [text.get_text() for text in panel.get_legend().get_texts()] == ["about x", "about y", "about z", "angle"]
    assert panel.get_lines()[3].get_ydata()[-1] == pytest.approx(np.rad2deg(1.0))


def test_an_attitude_with_both_ends_free_points_where_it_is_told():
    """From one direction to another one, the roll free at both ends: the angle between them, at constant speed."""
    ocp = co.Problem(2.0, "pointing")
    omega = ocp.control("omega", 3)
    attitude = ocp.attitude("attitude", initial=None, rate=omega)
    for at, goal in (("initial", [1.0, 0.0, 0.0]), ("final", [0.6, 0.8, 0.0])):
        apart = attitude.matrix @ ca.DM(goal) - ca.DM([1.0, 0.0, 0.0])
        ocp.subject_to(apart[1:], lower=np.zeros(2), upper=np.zeros(2), at=at)
    ocp.minimize(running=ca.sumsqr(omega))
    solution = co.solve(ocp, intervals=10)
    assert solution.cost == pytest.approx(np.arccos(0.6) ** 2 / 2.0, rel=1e-6)
    assert np.linalg.norm(solution.trajectory.x, axis=1) == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_start_by_a_parameter_takes_the_short_way_whatever_its_sign(sign):
    """A start that passes half a turn, where the quaternion of a rotation changes its sign."""
    ocp = co.Problem(10.0, "sign")
    start = ocp.parameter("start", so3.to_quaternion(so3.exp([3.0, 0.0, 0.0])))
    omega = ocp.control("omega", 3)
    ocp.attitude("attitude", initial=start, final=so3.exp([2.5, 0.0, 0.0]), rate=omega)
    ocp.minimize(running=ca.sumsqr(omega))
    solver = co.Solver(ocp, intervals=10)
    solution = solver.solve({start: sign * so3.to_quaternion(so3.exp([3.3, 0.0, 0.0]))}, progress=False)
    assert solution.cost == pytest.approx(0.8**2 / 10.0, rel=1e-6)


def test_a_goal_by_a_decision():
    """How far to turn about one axis, against a price: 2 s / T = 1 with T = 2."""
    ocp = co.Problem(2.0, "decided")
    omega = ocp.control("omega", 3)
    s = ocp.decision("s", guess=0.5, lower=0.0, upper=3.0)
    ocp.attitude("attitude", initial=np.eye(3), final=so3.exp(ca.vertcat(s, 0, 0)), rate=omega)
    ocp.minimize(running=ca.sumsqr(omega), terminal=-s)
    assert co.solve(ocp, intervals=10)["s"] == pytest.approx(1.0, abs=1e-5)


def test_a_slew_whose_gyroscope_is_biased_is_solved_near_its_optimum():
    """An expected cost with limited torques: steps that lessen violations of rounding at any cost left it, for ever."""
    T, goal, inertia = 20.0, so3.exp([-1.2, 0.3, 0.4]), np.array([12.0, 15.0, 9.0])
    ocp = co.Problem(T, "biased gyroscope")
    omega = ocp.state("omega", 3, initial=0.0, variance=1e-4)
    torque = ocp.control("torque", 3, lower=-0.4, upper=0.4)
    known = {"variance": 1e-3 * np.eye(3), "noise": 1e-6 * np.eye(3)}
    attitude = ocp.attitude("attitude", initial=np.eye(3), rate=omega, **known)
    bias = ocp.unknown("bias", mean=0.0, variance=1e-3)
    ocp.dynamics(omega, (torque - ca.cross(omega, inertia * omega)) / inertia, noise=1e-6)
    ocp.measurement("gyroscope", omega[0] + bias, noise=1e-5)
    ocp.measurement("star", attitude.matrix @ ca.DM([0.0, 0.6, 0.8]), noise=1e-3)
    apart = ca.sumsqr(attitude.error(goal)) + ca.sumsqr(omega)
    ocp.minimize_expected(running=0.5 * ca.sumsqr(torque), terminal=50 * apart)
    found, other = (unassessed(ocp, method, intervals=40) for method in ("ipopt", "reduced"))
    assert found.stats["iterations"] < 200
    assert found.cost == pytest.approx(other.cost, rel=1e-8)
