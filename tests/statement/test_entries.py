"""An entry of a vector, as a name and as a symbol, is the column of its vector wherever a state may stand."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from figures import panels, values_of
from problems import solve

import covocp as co


@pytest.fixture(scope="module")
def planar():
    """A noisy point in the plane with a drag of four states that nothing measures."""
    ocp = co.Problem(1.0, "planar")
    p = ocp.state("p", 2, initial=0.0, final=[1.0, None], variance=[1.0, 0.5], unit="m")
    v = ocp.state("v", 4, initial=[0.1, 0.2, 0.3, 0.4], variance=[0.1, 0.2, 0.3, 0.4])
    u = ocp.control("u", 2)
    ocp.dynamics(p, u - v[:2], noise=[1.0, 0.3])
    ocp.dynamics(v, -v, noise=0.1)
    ocp.measurement("m", p, noise=[1.0, 2.0])
    ocp.minimize_expected(running=ca.sumsqr(u) + ca.sumsqr(p), terminal_weight={p[0]: 1.0})
    return solve(ocp, intervals=20), {"p": p, "v": v, "u": u}


@pytest.fixture(scope="module")
def runs(planar):
    return co.simulate(planar[0], 64, seed=1, progress=False)


def both(symbols, name, entry):
    return f"{name}[{entry}]", symbols[name][entry]


@pytest.mark.parametrize(("name", "entry"), [("p", 0), ("p", 1), ("v", 3)])
def test_of_a_solution(planar, name, entry):
    solution, symbols = planar
    for key in both(symbols, name, entry):
        np.testing.assert_array_equal(solution[key], solution[name][:, entry])
        np.testing.assert_array_equal(solution.at(0.37)[key], solution.at(0.37)[name][entry])
        np.testing.assert_array_equal(solution.at([0.1, 0.9])[key], solution.at([0.1, 0.9])[name][:, entry])
        np.testing.assert_array_equal(solution.deviation(key), solution.deviation(name)[:, entry])
        np.testing.assert_array_equal(solution.costate(key), solution.costate(name)[:, entry])
        assert solution.multiplier(key) == solution.multiplier(name)[entry]
        np.testing.assert_array_equal(
            solution.covariance(key, "p[1]"), solution.covariance(name, "p")[:, entry : entry + 1, 1:]
        )


def test_of_a_control(planar):
    solution, symbols = planar
    for key in both(symbols, "u", 1):
        np.testing.assert_array_equal(solution[key], solution["u"][:, 1])


@pytest.mark.parametrize("of", ["deviation", "bias", "mean", "predicted_deviation", "terminal", "robust_deviation"])
def test_of_a_simulation(planar, runs, of):
    for key in both(planar[1], "v", 2):
        np.testing.assert_array_equal(getattr(runs, of)(key), getattr(runs, of)("v")[..., 2])


def test_of_pairs_and_controls_of_a_simulation(planar, runs):
    p, u = planar[1]["p"], planar[1]["u"]
    np.testing.assert_array_equal(runs.covariance(p[1], "u[0]"), runs.covariance(p, u)[:, 1:, :1])
    np.testing.assert_array_equal(runs.error_covariance("p[0]", p[1]), runs.error_covariance(p)[:, :1, 1:])
    np.testing.assert_array_equal(runs.predicted_deviation(u[1]), runs.predicted_deviation(u)[:, 1])


@pytest.mark.parametrize("symbolic", [False, True])
def test_in_figures(planar, runs, symbolic):
    solution, symbols = planar
    first, last = (both(symbols, *of)[symbolic] for of in (("p", 0), ("v", 3)))
    figure = solution.plot(first, last, (first, last), ("rms", last), ("C", first), costates=True)
    assert list(panels(figure)) == [
        "p[0] [m]",
        "v[3]",
        "X[p[0], v[3]]",
        "rms of v[3]",
        "C[p[0]]",
        "costate of p[0]",
        "costate of v[3]",
    ]
    (curve,) = values_of(figure, "v[3]")
    assert curve[-1] == pytest.approx(0.4 * np.exp(-1.0), rel=1e-6)
    figure = runs.plot(first, (first, last))
    assert list(panels(figure)) == ["deviation of p[0] [m]", "deviation of v[3] at T"]


def test_limits_and_weights_by_entry(planar):
    solution, symbols = planar
    runs = co.simulate(solution, 64, seed=1, limits={symbols["u"][0]: (-1.0, 1.0)}, progress=False)
    np.testing.assert_array_equal(runs.limits, [[-1.0, -np.inf], [1.0, np.inf]])


def test_terminal_weights_by_entry_are_the_diagonal():
    costs = []
    for weight in ({"x[0]": 3.0, "x[1]": 2.0}, {"x": [3.0, 2.0]}):
        ocp = co.Problem(1.0)
        x, u = ocp.state("x", 2, initial=0.0, final=1.0, variance=1.0), ocp.control("u", 2)
        ocp.dynamics(x, u, noise=1.0)
        ocp.measurement("m", x, noise=1.0)
        ocp.minimize_expected(running=ca.sumsqr(u), terminal_weight=weight)
        costs.append(solve(ocp, intervals=10).cost)
    assert costs[0] == costs[1]


def test_of_a_stored_solution(planar, tmp_path):
    solution, _ = planar
    solution.save(tmp_path / "planar.npz")
    loaded = co.load(tmp_path / "planar.npz")
    np.testing.assert_array_equal(loaded["p[1]"], solution["p"][:, 1])
    np.testing.assert_array_equal(loaded.deviation("v[3]"), solution.deviation("v")[:, 3])


@pytest.mark.parametrize(
    ("key", "words"),
    [("p[2]", "no entry 2"), ("q[0]", "not in this solution"), ("p[-1]", "not in this solution")],
)
def test_what_is_no_entry_is_refused(planar, key, words):
    with pytest.raises(co.ProblemError, match=words):
        planar[0][key]
    with pytest.raises(co.ProblemError, match=words):
        planar[0].deviation(key)


@pytest.mark.parametrize(
    "change", [lambda p: p[0] + 1, lambda p: 2 * p[0], lambda p: p[0] * p[1], lambda p: ca.fmax(*ca.vertsplit(p))]
)
def test_expressions_are_no_entries(planar, change):
    with pytest.raises(co.ProblemError, match="not in this solution"):
        planar[0].deviation(change(planar[1]["p"]))
