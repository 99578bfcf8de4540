"""States that are known exactly carry no rows of E: the same covariances, costates, bounds and files as with them."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.statement.exact_rows import carried

WAYS = [("ipopt", {}), ("ipopt", {"covariances": "states"}), ("gradient", {})]


def platform(*, own=None, sampled=False, lag=0.0, noise=None, most=0.12):
    """A sensor that moves; how well it sees depends on where it is."""
    ocp = co.Problem(duration=4.0, name="moving sensor")
    p, w = ocp.state("p", initial=0.5, variance=own), ocp.state("w", initial=0.0)
    x, b = ocp.state("x", initial=1.0, variance=0.5), ocp.unknown("b", mean=0.2, variance=0.3)
    u = ocp.control("u")
    ocp.dynamics(p, w + lag * x)
    ocp.dynamics(w, u, noise=noise)
    ocp.dynamics(x, -0.3 * x + b, noise=0.05)
    ocp.measurement("y", x * p, noise=0.2, **({"every": 0.5} if sampled else {}))
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + 0.1 * p**2, terminal=5 * (E[x, x] + E[b, b]))
    ocp.subject_to(E[x, x] + E[p, p], upper=most, at="final", name="good")
    return ocp


def integrated(solution, lag=0.0, noise=0.0):
    """E at the end by scipy: rows p, w, x, b, along the nominal of the solution."""

    def rate(t, half):
        E, p, x = half.reshape(4, 4), *(float(solution.at(t)[name]) for name in "px")
        F = np.zeros((4, 4))
        F[0, 1], F[0, 2], F[2, 2], F[2, 3] = 1.0, lag, -0.3, 1.0
        M = np.array([x, 0.0, p, 0.0])
        return (F @ E + E @ F.T + np.diag([0.0, noise, 0.05, 0.0]) - np.outer(E @ M, E @ M) / 0.2).ravel()

    E0 = np.diag([0.0, 0.0, 0.5, 0.3])
    return solve_ivp(rate, (0.0, 4.0), E0.ravel(), rtol=1e-9, atol=1e-11).y[:, -1].reshape(4, 4)


@pytest.mark.parametrize(("method", "options"), WAYS)
def test_the_whole_covariance_is_that_of_scipy(method, options):
    solution = co.solve(platform(), method, intervals=40, progress=False, **options)
    assert np.abs(solution["E"][-1] - integrated(solution)).max() <= 2e-7
    assert not solution["E"][:, :2].any()
    assert solution.block("E").labels == ("p", "w", "x", "b")


def test_methods_carry_what_is_uncertain_alone():
    rows = carried(platform().statement())
    assert rows is not None
    assert rows.statement.matrices[0].labels == rows.statement.augmented == ("x", "b")
    assert rows.statement.ne == 3
    assert rows.whole == 10


@pytest.mark.parametrize(("changed", "left_out"), [({"lag": 0.1}, {"w"}), ({"noise": 0.02}, set())])
def test_a_state_that_something_uncertain_moves_keeps_its_rows(changed, left_out):
    ocp = platform(**changed, most=2.0)
    rows = carried(ocp.statement())
    assert {"p", "w", "x", "b"} - set("pwxb" if rows is None else rows.statement.augmented) == left_out
    solution = co.solve(ocp, intervals=40, progress=False)
    true = integrated(solution, changed.get("lag", 0.0), changed.get("noise", 0.0))
    assert true[0, 0] > 1e-3
    assert np.abs(solution["E"][-1] - true).max() <= 2e-6


@pytest.mark.parametrize(("method", "options"), WAYS)
@pytest.mark.parametrize("sampled", [False, True])
def test_costates_of_rows_that_are_zero_are_slopes_of_the_cost_by_their_variances(method, options, sampled):
    solution = co.solve(platform(sampled=sampled), method, intervals=40, progress=False, **options)
    slope, multiplier = solution.costate("E")[0, 0, 0], float(solution.multiplier("good"))
    size = 1e-6
    values = []
    for variance in (None, size):
        given = co.evaluate(platform(own=variance, sampled=sampled), nominal=solution, intervals=40)
        final = given["E"][-1]
        values.append(given.cost + multiplier * (final[2, 2] + final[0, 0]))
    assert slope == pytest.approx((values[1] - values[0]) / size, rel=2e-4)


def test_a_variance_that_is_a_parameter_keeps_its_rows():
    ocp = co.Problem(duration=2.0)
    own = ocp.parameter("own", 0.0)
    p, x = ocp.state("p", initial=0.5, variance=own), ocp.state("x", initial=1.0, variance=0.5)
    u = ocp.control("u")
    ocp.dynamics(p, u)
    ocp.dynamics(x, -x, noise=0.1)
    ocp.measurement("y", x + p, noise=0.2)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2 + (p - 1) ** 2, terminal=E[x, x] + E[p, p])
    assert carried(ocp.statement()) is None
    assert co.solve(ocp, intervals=10, progress=False, parameters={"own": 0.3})["E"][0, 0, 0] == 0.3


def test_vectors_keep_the_components_that_are_uncertain():
    ocp = co.Problem(duration=2.0)
    x = ocp.state("x", 3, initial=[0.5, 1.0, 0.0], variance=[0.0, 0.5, 0.0])
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(u, -x[1], x[1] * x[0]))
    ocp.measurement("y", x[1] * x[0], noise=0.2)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x[1], x[1]])
    ocp.subject_to(E["x[0]", "x[0]"], upper=1.0, name="nothing")
    rows = carried(ocp.statement())
    assert rows is not None
    assert rows.statement.augmented == ("x[1]", "x[2]")
    solution = co.solve(ocp, intervals=20, progress=False)
    assert solution[E["x[0]", "x[0]"]].max() == 0.0
    assert solution[E["x[2]", "x[2]"]][-1] > 1e-3


def test_guesses_files_and_simulations_have_the_whole_covariance(tmp_path):
    ocp = platform()
    cold = co.solve(ocp, intervals=20, progress=False, covariances="states")
    warm = co.solve(ocp, intervals=20, progress=False, covariances="states", guess=cold)
    assert warm.stats["iterations"] < cold.stats["iterations"]
    assert warm.cost == pytest.approx(cold.cost, rel=1e-9)
    loaded = co.load(cold.save(tmp_path / "platform.npz"), problem=ocp)
    assert np.array_equal(loaded["E"], cold["E"])
    runs = co.simulate(cold, runs=100, seed=1, progress=False)
    assert runs.augmented == ("p", "w", "x", "b")
    assert runs.error_covariance("x")[-1, 0, 0] == pytest.approx(cold["E"][-1, 2, 2], rel=0.45)


@pytest.mark.parametrize("method", ["ipopt", "reduced"])
def test_meshes_that_refine_themselves_carry_the_rows_too(method):
    solution = co.solve(platform(), method, refine=1e-6, progress=False)
    assert np.abs(solution["E"][-1] - integrated(solution)).max() <= 1e-6
    assert not solution["E"][:, :2].any()
