"""Nominals of every kind evaluated, what they miss, and other statistics than the design's."""

from __future__ import annotations

import warnings
from functools import cache

import casadi as ca
import closed_loops
import numpy as np
import pytest
from problems import graded, lag, solve
from refusals import refused

import covocp as co
from covocp.models import noisy_integrator, unknown_lag

GRADED = graded(160)


@cache
def combined():
    return solve(unknown_lag.steering(), grid=GRADED, tolerance=1e-9)


@cache
def classical():
    return solve(unknown_lag.steering(), grid=GRADED, nominal="deterministic")


# --- values of the specification --------------------------------------------------------------------------------------


def test_classical_design_of_6_12_from_its_control():
    """The row of quadratic synthesis: along its control in closed form, by chords, and solved for."""
    control, grid = closed_loops.least_energy(), graded(640)
    found = co.evaluate(unknown_lag.steering(), nominal={"u": lambda s: control(10 * s)}, grid=grid)
    loop, u = found.loop, found["u"]
    chords = np.sum(np.diff(found.t) * (u[1:] ** 2 + u[1:] * u[:-1] + u[:-1] ** 2)) / 6
    assert loop.cost["running"] == pytest.approx(chords, rel=1e-12)
    assert 1.0 < chords < 1.0 + 1e-5
    values = [loop.cost["deviations on the way"], loop.X[-1, 0, 0], loop.E[-1, 0, 0], loop.E[-1, 1, 1]]
    np.testing.assert_allclose(values, [0.150444, 1.353619, 1.014567, 3.499117], rtol=4e-5)
    exact = classical()  # the same without the chords
    values = [
        exact.cost_terms["running"],
        exact.cost_terms["deviations"],
        exact.cost,
        exact.loop.cost["deviations on the way"],
        *(exact.loop.X[-1, 0, 0], exact.loop.E[-1, 0, 0], exact.loop.E[-1, 1, 1]),
    ]
    expected = [1.0, 1.504062, 2.504062, 0.150444, 1.353619, 1.014567, 3.499117]
    np.testing.assert_allclose(values, expected, atol=6e-7)


@pytest.mark.parametrize(
    ("design", "values"),
    [
        (combined, [2.02715, 2.47971, 1.17660, 0.94895, 0.05554, -0.08606]),
        (classical, [2.50406, 2.85209, 1.71474, 1.06310, 0.30324, -0.17420]),
    ],
)
def test_incorrect_statistics_of_the_specification(design, values):
    """Table 9.2, to half a unit of the last digit: truth Q11 = 2, U = 0.5; E22 + Xhat22 - 2 Z22 is kept."""
    truth = unknown_lag.steering(process_noise=2.0, measurement_noise=0.5)
    found = co.evaluate(design(), truth=truth)
    loop = found.loop
    actual = [design().cost, found.cost, *(m[-1, 0, 0] for m in (loop.X, loop.E, loop.Xhat, loop.Z))]
    np.testing.assert_allclose(actual, values, atol=0.55e-5)
    np.testing.assert_allclose(loop.E[:, 1, 1] + loop.Xhat[:, 1, 1] - 2 * loop.Z[:, 1, 1], 5.0, rtol=1e-11)
    assert sum(loop.cost.values()) == pytest.approx(found.cost, rel=1e-14)
    np.testing.assert_array_equal(found["u"], design()["u"])
    np.testing.assert_array_equal(found.gains["C"], design().gains["C"])
    assert found.optimality.cross_covariance > 0.05


# --- nominals of every kind -------------------------------------------------------------------------------------------


def drifted(size=1, final=None):
    """One control, a number or a vector, and two states."""
    ocp = co.Problem(2.0, name="drifted")
    x = ocp.state("x", 2, initial=[1.0, 0.0], final=final, variance=[0.2, 0.1])
    u = ocp.control("u", size, guess=0.3)
    ocp.dynamics(x, ca.vertcat(x[1], -ca.sin(x[0]) + ca.sum1(u)), noise=[0.0, 0.4])
    ocp.measurement("m", x[0], noise=0.1)
    weights = {} if final is None else {"terminal_weight": {x: 1.0}}
    ocp.minimize_expected(running=0.5 * ca.dot(u, u) + x[0] ** 2, terminal=ca.dot(x, x), **weights)
    return ocp


def test_a_control_that_the_problem_does_not_have_is_named_with_what_it_has():
    """No solution is spoken of, as there is none."""
    ocp = co.Problem(1.0, name="arm")
    x, torque, d = ocp.state("x", initial=0.0), ocp.control("torque"), ocp.decision("d", guess=1.0)
    ocp.dynamics(x, torque + d)
    ocp.minimize(running=torque**2, terminal=(x - 1.0) ** 2 + d**2)
    said = refused(lambda: co.evaluate(ocp, nominal={"torqe": 1.0}), "'torqe'", "'arm'", "perhaps 'torque' is meant")
    assert "solution" not in said
    assert "torque, d" in said
    refused(lambda: co.evaluate(ocp, nominal={co.Problem(1.0).control("torque"): 1.0}), "of another problem")


def test_all_ways_to_give_a_constant():
    """Number, array, function, symbol as key, and the control's own guess."""
    ocp = drifted()
    u = ocp.declarations.controls[0].symbol
    found = [
        co.evaluate(ocp, nominal=nominal, intervals=10)
        for nominal in (
            {"u": 0.3},
            {"u": np.full(11, 0.3)},
            {"u": np.full((11, 1), 0.3)},
            {"u": [0.3] * 5},  # fewer values: linear between them
            {"u": lambda s: np.full_like(s, 0.3)},
            {u: 0.3},
            None,
        )
    ]
    for solution in found:
        assert solution.cost == found[0].cost
        assert (solution["u"] == 0.3).all()
        assert solution.method == "evaluate"
        assert solution.converged
        assert not solution.optimised


def test_functions_and_arrays_of_a_vector():
    """A function of s = t/T gives values at the nodes, or in the middle of intervals with constant controls."""

    def control(s):
        return np.column_stack([np.cos(3 * s), s])

    linear = co.evaluate(drifted(2), nominal={"u": control}, grid=np.linspace(0, 1, 9))
    np.testing.assert_allclose(linear["u"], control(np.linspace(0, 1, 9)))
    constant = co.evaluate(drifted(2), nominal={"u": control}, grid=np.linspace(0, 1, 9), control="constant")
    np.testing.assert_allclose(constant["u"][:-1], control((np.arange(8) + 0.5) / 8))
    array = co.evaluate(drifted(2), nominal={"u": control(np.linspace(0, 1, 9))}, grid=np.linspace(0, 1, 9))
    assert array.cost == linear.cost


def test_states_follow_the_control():
    """Against scipy."""
    from problems import simulate

    found = co.evaluate(drifted(), nominal={"u": lambda s: np.sin(5 * s)}, intervals=20)
    x = simulate(lambda t, x, u: [x[1], -np.sin(x[0]) + u], [1.0, 0.0], found.t, found["u"])
    np.testing.assert_allclose(found["x"], x, atol=1e-6)


def test_along_a_solution_of_the_problem_itself():
    """Its mesh and its control: the same cost, to roundoff."""
    for options in ({}, {"control": "constant"}):
        best = solve(drifted(), intervals=12, **options)
        again = co.evaluate(drifted(), nominal=best)
        assert again.cost == pytest.approx(best.cost, rel=1e-9)
        np.testing.assert_array_equal(again.mesh.nodes, best.mesh.nodes)
        assert again.mesh.control == best.mesh.control


def test_along_a_solution_on_another_mesh():
    """Sampled where the new nodes are; a finer mesh that holds the old nodes has the same control."""
    best = solve(drifted(), intervals=12)
    fine = co.evaluate(drifted(), nominal=best, grid=np.linspace(0, 1, 37))
    np.testing.assert_allclose(fine["u"], np.interp(fine.t, best.t, best["u"]), atol=1e-12)
    assert fine.cost == pytest.approx(best.cost, rel=10 * best.mesh_error)


def test_along_a_solution_on_so_many_intervals():
    """They were ignored without a word; of a solution that is kept as it is they are refused."""
    best = solve(drifted(), intervals=12)
    fine = co.evaluate(drifted(), nominal=best, intervals=36)
    assert fine.mesh.intervals == 36
    assert fine.cost == co.evaluate(drifted(), nominal=best, grid=np.linspace(0, 1, 37)).cost
    refused(lambda: co.evaluate(best, intervals=36), "keeps its nominal, mesh and parameters", "intervals=")


def test_along_a_solution_of_another_problem():
    """The input that identifies best (chapter 5) is no good nominal: dearer than either design."""
    learning = solve(unknown_lag.problem(weight=0.1, final=1.0), intervals=100)
    found = co.evaluate(unknown_lag.steering(), nominal=learning)
    np.testing.assert_array_equal(found["u"], learning["u"])
    assert found["E"][-1, 1, 1] == pytest.approx(learning["E"][-1, 1, 1], rel=1e-6)
    assert found["E"][-1, 1, 1] < classical()["E"][-1, 1, 1] < combined()["E"][-1, 1, 1]
    assert found.cost > classical().cost > combined().cost


def test_a_deterministic_cost_along_a_nominal():
    """evaluate is for every problem: here with a covariance and no feedback."""
    best = solve(lag().problem, intervals=50)
    again = co.evaluate(lag().problem, nominal=best)
    assert again.cost == pytest.approx(best.cost, rel=1e-9)
    np.testing.assert_allclose(again["E"], best["E"], atol=1e-8)
    assert again.loop is None
    worse = co.evaluate(lag().problem, nominal={"u": 0.1}, intervals=50)
    assert worse.cost > best.cost
    assert set(worse.violations) == {"final value of x"}
    plain = co.evaluate(noisy_integrator.problem(), nominal={"u": 0.2}, intervals=5)
    assert plain["u"].tolist() == [0.2] * 6


def test_free_initial_values_are_those_of_the_solution():
    """Also where the solution is of another problem that has the state; the guess where it has not."""
    problems = []
    for initial, guess in ((None, 0.4), (None, None), (0.7, None)):
        ocp = co.Problem(1.0)
        x, u = ocp.state("x", initial=initial, variance=0.5, guess=guess), ocp.control("u")
        ocp.dynamics(x, -x + u, noise=1.0)
        ocp.measurement("m", x, noise=1.0)
        ocp.minimize_expected(running=0.5 * u**2 + (x - 1) ** 2, terminal=x**2)
        problems.append(ocp)
    best = solve(problems[0], intervals=10)
    assert best["x"][0] > 0.6
    assert co.evaluate(problems[1], nominal=best).cost == pytest.approx(best.cost, rel=1e-9)
    assert co.evaluate(problems[2], nominal=best)["x"][0] == 0.7
    assert co.evaluate(problems[0], nominal={"u": 0.0}, intervals=10)["x"][0] == pytest.approx(0.4)


def test_free_duration_is_that_of_the_solution():
    def lasting(duration):
        ocp = co.Problem(duration)
        x, u = ocp.state("x", initial=1.0, variance=0.5), ocp.control("u")
        ocp.dynamics(x, -0.2 * x + u, noise=0.1)
        ocp.measurement("m", x, noise=1.0)
        ocp.minimize_expected(running=0.5 * u**2 + 0.1, terminal=3 * x**2)
        return ocp

    free = lasting(co.Free(1.0, 0.2, 9.0))
    best = solve(free, intervals=20)
    assert abs(best.duration - 1.0) > 0.2
    again = co.evaluate(free, nominal=best)
    assert again.duration == best.duration
    assert again.cost == pytest.approx(best.cost, rel=1e-9)
    assert co.evaluate(free, nominal={"u": 0.0}, intervals=20).duration == 1.0
    # A fixed duration takes the control at the same share of its own time.
    longer = co.evaluate(lasting(3.0), nominal=best, grid=np.linspace(0, 1, 33))
    assert longer.duration == 3.0
    shares = longer.mesh.nodes
    np.testing.assert_allclose(longer["u"], np.interp(shares, best.mesh.nodes, best["u"]), atol=1e-12)


def test_parameters():
    """By name, as in `solve`; those of a solution's problem otherwise."""
    problem = unknown_lag.steering()
    found = co.evaluate(problem, nominal={"u": 0.1}, intervals=40, parameters={"terminal_weight": 7.0, "b": 0.5})
    other = co.evaluate(unknown_lag.steering(terminal_weight=7.0), nominal={"u": 0.1}, intervals=40)
    np.testing.assert_array_equal(found["S"][-1], np.diag([7.0, 0.0]))
    assert (found["b"] == 0.5).all()
    assert found.cost != pytest.approx(other.cost)
    one = co.evaluate(problem, nominal={"u": 0.1}, intervals=40, parameters={"terminal_weight": 7.0})
    assert one.cost == pytest.approx(other.cost, rel=1e-14)


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")  # two intervals, and strang has order 2
@pytest.mark.parametrize("step", ["gauss", "rk4", "strang"])
def test_mesh_options(step):
    found = co.evaluate(unknown_lag.steering(), nominal={"u": 0.1}, grid=[0, 0.2, 1], substeps=64, covariance_step=step)
    assert (found.mesh.step, found.mesh.substeps) == (step, 64)
    assert found.cost == pytest.approx(co.evaluate(unknown_lag.steering(), nominal={"u": 0.1}).cost, rel=5e-3)


# --- what is missed ---------------------------------------------------------------------------------------------------


def test_missed_conditions_are_violations():
    """Final values, bounds of states and controls, inequalities on the way, at the start and at the end, of E too."""
    ocp = co.Problem(1.0)
    x = ocp.state("x", 2, initial=0.0, final=[0.5, None], lower=[-np.inf, -0.1], upper=[0.75, np.inf], variance=1.0)
    u = ocp.control("u", lower=-0.2, upper=0.9)
    E = ocp.estimation_covariance()
    ocp.dynamics(x, ca.vertcat(u, -u))
    ocp.subject_to(x[0] - x[1], upper=1.6, name="distance")
    ocp.subject_to(u, upper=0.4, at="initial", name="gentle start")
    ocp.subject_to(E[x, x][0, 0], upper=0.3, at="final", name="knowledge")
    ocp.subject_to(x[1], lower=-3.0, at="final", name="met")
    ocp.minimize_expected(running=u**2, terminal_weight={x: 1.0})
    found = co.evaluate(ocp, nominal={"u": 1.0}, intervals=10)
    assert found.violations == pytest.approx(
        {
            "final value of x[0]": 0.5,
            "bounds of x[0]": 0.25,
            "bounds of x[1]": 0.9,
            "bounds of u": 0.1,
            "distance": 0.4,
            "gentle start": 0.6,
            "knowledge": 0.7,
        }
    )
    assert found.converged  # it is what was asked for
    assert co.evaluate(ocp, nominal={"u": 0.3}, intervals=10).violations.keys() == {
        "final value of x[0]",
        "bounds of x[1]",
        "knowledge",
    }


def test_nothing_missed():
    """At a bound, and at the final value to a millionth."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, upper=1.0, variance=1.0), ocp.control("u", lower=0.0, upper=1.0)
    ocp.dynamics(x, u)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 1.0})
    assert co.evaluate(ocp, nominal={"u": 1.0}, intervals=7).violations == {}
    assert co.evaluate(ocp, nominal={"u": 1 - 1e-5}, intervals=7).violations == pytest.approx(
        {"final value of x": 1e-5}
    )


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e6])
def test_what_is_missed_does_not_depend_on_the_unit(unit):
    """A bound of 1e-9 and a limit of 1e-7 were passed by a tenth and more without a word."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, upper=0.5 * unit), ocp.control("u", upper=0.9 * unit)
    ocp.dynamics(x, u)
    ocp.subject_to(x, upper=0.7 * unit, name="wall")
    ocp.subject_to(x, at=0.5, upper=0.3 * unit, name="gate")
    ocp.subject_to(x - 0.3 * unit, at=0.5, upper=0.0, name="zero")
    ocp.minimize(running=(u / unit) ** 2, terminal=((x - unit) / unit) ** 2)
    missed = co.evaluate(ocp, nominal={"u": unit}, intervals=4).violations
    expected = {"bounds of x": 0.5, "bounds of u": 0.1, "wall": 0.3, "gate": 0.2, "zero": 0.2}
    assert missed == pytest.approx({name: value * unit for name, value in expected.items()})
    assert co.evaluate(ocp, nominal=co.solve(ocp, intervals=4, progress=False)).violations == {}


@pytest.mark.parametrize("kind", ["row", "bound"])
@pytest.mark.parametrize("method", ["ipopt", "reduced"])
def test_a_limit_of_zero_that_is_met_all_the_way_is_not_passed(kind, method):
    """By 1e-8, or by 1e-39, "100 % of it" had been told: the row is zero everywhere but for rounding."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=0.1), ocp.control("u")
    v = ocp.control("v", lower=0.0) if kind == "bound" else ocp.control("v")
    ocp.dynamics(x, u - x, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    E = ocp.estimation_covariance()
    if kind == "row":
        ocp.subject_to(v, lower=0.0, name="positive")
    ocp.minimize(running=0.5 * u**2 + 0.5 * (v + 1.0) ** 2, terminal=E[x, x])
    found = co.solve(ocp, intervals=20, method=method, progress=False)  # any warning is an error
    assert np.abs(found["v"]).max() < 1e-7
    assert co.evaluate(ocp, nominal=found).violations == {}
    name = "positive" if kind == "row" else "bounds of v"
    with warnings.catch_warnings(action="ignore"):
        missed = co.evaluate(ocp, nominal={"u": 0.5, "v": -0.01}, intervals=5).violations
    assert missed[name] == pytest.approx(0.01)


def test_a_limit_that_is_rounding_is_not_missed_by_rounding():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.subject_to(x, at=0.5, equals=np.sin(np.pi), name="gate")
    ocp.minimize(running=u**2)
    assert co.evaluate(ocp, nominal=co.solve(ocp, intervals=10, progress=False)).violations == {}


def test_a_nominal_that_diverges():
    ocp = co.Problem(5.0)
    x, u = ocp.state("x", initial=1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, x**3 + u, noise=1.0)
    ocp.measurement("m", x, noise=1.0)
    ocp.minimize_expected(running=u**2 + x**2)
    found = co.evaluate(ocp, nominal={"u": 1.0}, intervals=20)
    assert not found.converged
    assert "NaN or inf" in found.status
    assert found.loop is None
    assert found.message in " ".join(str(found).split())


# --- other statistics -------------------------------------------------------------------------------------------------


def parametric(**changed):
    """Everything that may be another one in a truth."""
    given = {"x0": 0.0, "T": 2.0, "slope": 1.0, "gain": 1.0, "drift": 0.0, "q": 0.5, "r": 0.3, "e": 0.4} | changed
    ocp = co.Problem(given["T"], name="design" if not changed else "truth")
    q, r, e = (ocp.parameter(name, given[name]) for name in ("q", "r", "e"))
    slope, gain, drift = (ocp.parameter(name, given[name]) for name in ("slope", "gain", "drift"))
    x, u = ocp.state("x", initial=given["x0"], variance=e), ocp.control("u")
    ocp.dynamics(x, -x + gain * u + drift * ca.sin(x), noise=q)
    ocp.measurement("m", slope * x, noise=r)
    ocp.minimize_expected(running=0.5 * u**2 + (x - 1) ** 2, terminal=x**2)
    return ocp


@cache
def designed():
    return solve(parametric(), intervals=15)


def test_parameters_as_truth():
    """A dict, or a problem built with other numbers: the same."""
    one = co.evaluate(designed(), truth={"q": 1.5, "r": 0.1, "e": 0.9})
    two = co.evaluate(designed(), truth=parametric(q=1.5, r=0.1, e=0.9))
    assert one.cost == two.cost
    assert one.cost > designed().cost + 0.1
    np.testing.assert_array_equal(one.loop.Z, two.loop.Z)
    np.testing.assert_allclose(one.covariance("x")[0], 0.9)
    # each of the three has its effect
    costs = [co.evaluate(designed(), truth=t).cost for t in ({"q": 1.5}, {"r": 0.1}, {"e": 0.9})]
    assert min(abs(c - designed().cost) for c in costs) > 1e-2


def test_truth_along_a_given_nominal():
    """Both at once."""
    one = co.evaluate(parametric(), nominal={"u": 0.5}, intervals=10, truth={"q": 1.5})
    two = co.evaluate(co.evaluate(parametric(), nominal={"u": 0.5}, intervals=10), truth={"q": 1.5})
    assert one.cost == two.cost
    # dE/dt ... : with the gains of the design the cost is linear in the statistics
    three = co.evaluate(two, truth={"q": 2.5})
    base = co.evaluate(two, truth={"q": 0.5})
    assert three.cost - two.cost == pytest.approx(two.cost - base.cost, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"x0": 0.2}, ["starts elsewhere", "'x'"]),
        ({"T": 2.5}, ["takes another time"]),
        ({"gain": 1.1}, ["differently", "'x'"]),
        ({"drift": 0.1}, ["moves differently", "'x'"]),
        ({"slope": 2.0}, ["measured differently", "'m'"]),
    ],
)
def test_truth_with_another_system(change, parts):
    """The linear equations know one system."""
    refused(lambda: co.evaluate(designed(), truth=parametric(**change)), *parts, "simulate")
    if change.keys() <= {"gain", "drift", "slope"}:
        refused(lambda: co.evaluate(designed(), truth=change), *parts)


def test_truth_that_moves_alike_and_reacts_differently():
    """Along u = 0 from rest the rates agree; their slopes do not."""
    still = co.evaluate(parametric(), nominal={"u": 0.0}, intervals=10)
    assert np.abs(still["x"]).max() == 0
    refused(lambda: co.evaluate(still, truth={"gain": 1.1}), "controlled differently")
    refused(lambda: co.evaluate(still, truth={"drift": 0.1}), "moves differently")


def other_symbols(kind):
    ocp = co.Problem(2.0, name=kind)
    x = ocp.state("y" if kind == "state" else "x", 2 if kind == "size" else 1, initial=0.0, variance=1.0)
    if kind == "another":
        ocp.dynamics(ocp.state("z", initial=0.0, variance=1.0), 0)
    if kind == "unknown":
        ocp.unknown("b", mean=1.0, variance=1.0)
    u = ocp.control("w" if kind == "control" else "u")
    ocp.dynamics(x, -x + u, noise=0.5)
    if kind != "blind":
        m = ca.vertcat(x, x) if kind == "measured" else x
        ocp.measurement("n" if kind == "measurement" else "m", m, noise=0.3)
    ocp.minimize_expected(running=0.5 * u**2 + ca.dot(x, x))
    return ocp


@pytest.mark.parametrize("kind", ["state", "size", "another", "unknown", "control", "measurement", "blind", "measured"])
def test_truth_with_other_symbols(kind):
    refused(lambda: co.evaluate(designed(), truth=other_symbols(kind)), "truth")


def test_truth_of_another_kind():
    refused(lambda: co.evaluate(designed(), truth=3.0), "truth", "3.0", "Problem")
    refused(lambda: co.evaluate(designed(), truth=designed()), "truth", "Solution")
    refused(lambda: co.evaluate(designed(), truth={"p": 1.0}), "'p'", "q, r, e")
    refused(lambda: co.evaluate(designed(), truth={"q": [1.0, 2.0]}), "'q'")
    deterministic = co.Problem(2.0)
    x, u = deterministic.state("x", initial=0.0, variance=1.0), deterministic.control("u")
    deterministic.dynamics(x, -x + u, noise=0.5)
    deterministic.measurement("m", x, noise=0.3)
    deterministic.minimize(running=u**2)
    refused(lambda: co.evaluate(designed(), truth=deterministic), "no expected cost")
    with pytest.warns(co.CovocpWarning, match="Nothing uses the measurement 'm'"):
        found = co.evaluate(deterministic, nominal={"u": 0.0}, intervals=5)
    refused(lambda: co.evaluate(found, truth=parametric()), "closed loop", "minimize_expected()")


@pytest.mark.parametrize(
    ("truth", "parts"),
    [
        ({"e": -1.0}, ["initial covariance", "-1"]),
        ({"q": -0.5}, ["process noise density", "-0.5"]),
        ({"r": -0.1}, ["measurement noise density", "-0.1"]),
    ],
)
def test_truth_that_cannot_be(truth, parts):
    refused(lambda: co.evaluate(designed(), truth=truth), "truth", *parts)


def test_truth_that_cannot_be_on_the_way():
    """A density of the state: positive where the nominal starts, and not where it ends."""

    def build(factor):
        ocp = co.Problem(2.0, name="walk")
        k = ocp.parameter("k", factor)
        x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
        ocp.dynamics(x, u, noise=1 - k * x)
        ocp.measurement("m", x, noise=1.0)
        ocp.minimize_expected(running=0.5 * u**2, terminal=x**2)
        return ocp

    found = co.evaluate(build(0.1), nominal={"u": 1.0}, intervals=10)
    assert co.evaluate(found, truth={"k": 0.4}).cost < found.loop.expected_cost
    refused(lambda: co.evaluate(found, truth={"k": 0.6}), "process noise density", "t = 1.8 s", "-0.08")


def test_truth_without_noise_at_all():
    """A density of zero is one: nothing is driven, and the filter still reacts."""
    found = co.evaluate(designed(), truth={"q": 0.0, "r": 0.0, "e": 0.0})
    assert np.abs(found.loop.X).max() == 0
    assert found.cost == pytest.approx(sum(designed().loop.cost[k] for k in ("terminal", "running")), rel=1e-12)


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (lambda p: co.evaluate(p, nominal=0.5), ["nominal", "0.5", "dict"]),
        (lambda p: co.evaluate(p, nominal="deterministic"), ["nominal", "'deterministic'", "Solution"]),
        (lambda p: co.evaluate(p, nominal={}), ["'u'", "nothing"]),
        (lambda p: co.evaluate(p, nominal={"w": 1.0}), ["w", "u"]),
        (lambda p: co.evaluate(p, nominal={"u": 1.0, "x": 1.0}), ["x", "u"]),
        (lambda p: co.evaluate(p, nominal={"u": np.nan}), ["'u'", "NaN"]),
        (lambda p: co.evaluate(p, nominal={"u": np.ones((3, 2))}), ["'u'", "(3, 2)"]),
        (lambda p: co.evaluate(p, nominal={"u": "full"}), ["'u'", "full"]),
        (lambda p: co.evaluate(p, nominal={"u": 0.0}, method="ipopt"), ["'method'", "substeps"]),
        (lambda p: co.evaluate(p, nominal={"u": 0.0}, intervals=0), ["'intervals'", "0"]),
        (lambda p: co.evaluate(p, nominal={"u": 0.0}, parameters={"z": 1.0}), ["'z'"]),
        (lambda p: co.evaluate(p, nominal={"u": 0.0}, parameters=[1.0]), ["parameters", "dict"]),
        (
            lambda p: co.evaluate(p, nominal=co.evaluate(other_symbols("control"), nominal={"w": 0.0})),
            ["'u'", "control"],
        ),
        (lambda p: co.evaluate(3.0), ["3.0"]),
        (lambda p: co.evaluate(designed(), nominal={"u": 0.0}), ["keeps its nominal", "truth"]),
        (lambda p: co.evaluate(designed(), parameters={"q": 1.0}), ["keeps its nominal", "truth"]),
        (lambda p: co.evaluate(designed(), substeps=3), ["keeps its nominal", "truth"]),
    ],
)
def test_bad_input(call, parts):
    refused(lambda: call(parametric()), *parts)


def spread_limited(noise=0.02, measured=0.01):
    """A lag whose spread is limited: along the path, at an instant and at the end; one condition without X."""
    ocp = co.Problem(1.0, name="spread")
    x = ocp.state("x", initial=0.0, variance=0.02)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=noise)
    ocp.measurement("y", x, noise=measured)
    ocp.minimize_expected(running=0.5 * u**2 + 2 * (x - 1) ** 2)
    X = ocp.closed_loop_covariance()
    ocp.subject_to(X[x, x] / 0.0165, upper=1.0, at="final", name="end")
    ocp.subject_to(X[x, x], upper=0.03, name="path")
    ocp.subject_to(X[u, u] - X[x, u], upper=0.06, at=0.5, name="both")
    ocp.subject_to(u, upper=9.0, name="plain")
    return ocp, x, u, X


def test_conditions_on_the_spread_under_a_truth():
    """Violations, check_path and what is subscripted are those of the loop under the truth, not the design's."""
    ocp, x, u, X = spread_limited()
    design = co.solve(ocp, intervals=20, progress=False)
    found = co.evaluate(design, truth=spread_limited(noise=0.08, measured=0.04)[0])
    loop, C = found.loop, found.loop.gain
    np.testing.assert_allclose(found[X[x, x]], loop.X[:, 0, 0], rtol=1e-12)
    np.testing.assert_allclose(found["Xhat"], loop.Xhat, rtol=0)
    np.testing.assert_allclose(found[X.matrix[0, 0] + x], loop.X[:, 0, 0] + found[x], rtol=1e-12)
    np.testing.assert_allclose(found[X[u, u]], (C @ loop.Xhat @ C.transpose(0, 2, 1))[:, 0, 0], atol=1e-15)
    crossed = -((loop.Xhat - loop.Z) @ C.transpose(0, 2, 1))[:, 0, 0]  # <d du>, d = y - e, du = -C y
    np.testing.assert_allclose(found[X[x, u]], crossed, atol=1e-15)
    assert abs(loop.Z).max() > 1e-3  # else E + Xhat would do
    assert found.violations["end"] == pytest.approx(loop.X[-1, 0, 0] / 0.0165 - 1.0, rel=1e-9)
    assert found.violations["path"] == pytest.approx(loop.X[:, 0, 0].max() - 0.03, rel=1e-9)
    half = np.flatnonzero(found.t == 0.5)[-2]  # there, with the control that goes on
    both = (found[X[u, u]] - found[X[x, u]])[half]
    assert found.violations["both"] == pytest.approx(both - 0.06, rel=1e-9)
    assert found.check_path() == pytest.approx({"path": found.violations["path"]})
    assert "Xhat" not in found.at(0.33).values  # known at the nodes only
    assert design["Xhat"][-1] < found["Xhat"][-1]


def test_conditions_on_the_spread_under_the_truth_of_the_design():
    """What the design met it meets under its own statistics: two integrators differ by less than is said."""
    ocp, x, _, X = spread_limited()
    design = co.solve(ocp, intervals=20, progress=False)
    found = co.evaluate(design, truth=ocp)
    assert found.violations == {}
    assert found.check_path() == {}
    np.testing.assert_allclose(found[X[x, x]], design[X[x, x]], rtol=1e-3)


def test_conditions_that_a_better_truth_meets():
    """A violation that a worse truth has is gone under a better one."""
    design = co.solve(spread_limited()[0], intervals=20, progress=False)
    worse = co.evaluate(design, truth=spread_limited(noise=0.08, measured=0.04)[0])
    assert set(worse.violations) == {"end", "path", "both"}
    assert co.evaluate(worse, truth=spread_limited(noise=0.01)[0]).violations == {}


def test_a_truth_for_what_became_nan_says_so():
    """x' = x^2 from 1 has no value at t = 1; the problem has an expected cost all the same."""
    ocp = co.Problem(2.0, name="blow")
    x, u = ocp.state("x", initial=1.0, variance=0.01), ocp.control("u")
    ocp.dynamics(x, x**2 + u, noise=0.01)
    ocp.measurement("m", x, noise=0.01)
    ocp.minimize_expected(running=u**2 + x**2)
    found = co.evaluate(ocp, nominal={"u": 0.0})
    message = refused(lambda: co.evaluate(found, truth=ocp), "closed loop", "'blow'", "NaN or inf", "cost nan")
    assert "deterministic" not in message
