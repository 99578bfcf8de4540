"""Constants that the optimiser chooses: closed forms, agreement of methods and formulations, what is refused."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import solve
from refusals import refused
from scipy.optimize import minimize_scalar

import covocp as co
from covocp.problem import filters

DURATION, DENSITY, PRICE, VARIANCE = 2.0, 0.5, 0.1, 3.0
WAYS = [{"covariances": "eliminated"}, {"covariances": "states"}, {"method": "gradient"}]


@pytest.fixture(params=WAYS, ids=lambda options: next(iter(options.values())))
def way(request):
    """The formulations and methods, by their options."""
    return request.param


def sensor():
    """Something constant is measured with a noise that is bought: the variance at the end is 1/(1/V + T/r)."""
    ocp = co.Problem(DURATION, "sensor")
    r = ocp.decision("r", guess=3.0, lower=1e-3, upper=1e3, unit="m^2 s")
    x, u = ocp.state("x", initial=1.0, variance=VARIANCE), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("m", x, noise=r)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=x**2 + E[x, x] + PRICE / r)
    return ocp


def test_accuracy_of_a_sensor_against_its_price(way):
    """c/r + 1/(1/V + T/r) is least where 1/V + T/r = sqrt(T/c)."""
    solution = solve(sensor(), intervals=60, **way)
    accuracy = (np.sqrt(DURATION / PRICE) - 1.0 / VARIANCE) / DURATION
    assert float(solution["r"]) == pytest.approx(1.0 / accuracy, rel=1e-5)
    least = PRICE * accuracy + np.sqrt(PRICE / DURATION) + 1.0 / (1.0 + DURATION)
    assert solution.cost == pytest.approx(least, rel=1e-8)
    assert solution.optimality.decisions < (1e-5 if "method" in way else 1e-6)
    assert solution.optimality.curvature > 0


def experiment():
    """An experiment whose length is decided, in its own time: d db/ds = 0, measured with density U/d."""
    ocp = co.Problem(1.0, "length of an experiment")
    d = ocp.decision("d", guess=1.0, lower=0.0, upper=50.0, unit="s")
    x = ocp.state("x", initial=0.0, unit="m")
    b = ocp.unknown("b", mean=1.0, variance=VARIANCE)
    ocp.dynamics(x, d)  # what the clock shows
    ocp.measurement("m", b, noise=DENSITY / d)
    E = ocp.estimation_covariance()
    ocp.minimize(terminal=PRICE * x + E[b, b])
    return ocp


def test_length_of_an_experiment(way):
    """c d + 1/(1/V + d/U) is least at d = sqrt(U/c) - U/V."""
    solution = solve(experiment(), intervals=10, **way)
    assert float(solution["d"]) == pytest.approx(np.sqrt(DENSITY / PRICE) - DENSITY / VARIANCE, rel=1e-5)
    assert solution.cost == pytest.approx(2 * np.sqrt(PRICE * DENSITY) - PRICE * DENSITY / VARIANCE, rel=1e-8)


def test_stiffness_of_a_spring(way):
    """X'' = -k x from (1, 0) is at cos(sqrt(k) T) at the end; c k + x(T)^2 is least where scipy finds it."""
    ocp = co.Problem(1.0, "spring")
    k = ocp.decision("k", guess=1.0, lower=0.1, upper=4.0, unit="1/s^2")
    x, v = ocp.state("x", initial=1.0), ocp.state("v", initial=0.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, -k * x)
    ocp.minimize(running=0.2 * k, terminal=x**2)
    solution = solve(ocp, intervals=60, **({} if "covariances" in way else way))
    best = minimize_scalar(
        lambda q: 0.2 * q + np.cos(np.sqrt(q)) ** 2, bounds=(0.1, 4.0), method="bounded", options={"xatol": 1e-10}
    )
    assert float(solution["k"]) == pytest.approx(best.x, rel=1e-5)
    assert solution.cost == pytest.approx(best.fun, rel=1e-7)


def test_initial_value(way):
    """X(0) = d costs (d - 2)^2, x(T) = d exp(-T) costs its square."""
    ocp = co.Problem(DURATION, "start")
    d = ocp.decision("d", guess=0.0, lower=-5.0, upper=5.0)
    x = ocp.state("x", initial=2 * d)
    ocp.dynamics(x, -x)
    ocp.minimize(terminal=(2 * d - 2.0) ** 2 + x**2)
    solution = solve(ocp, intervals=40, **({} if "covariances" in way else way))
    decay = np.exp(-2 * DURATION)
    assert solution["x"][0] == pytest.approx(2.0 / (1.0 + decay), rel=1e-6)
    assert float(solution["d"]) == pytest.approx(1.0 / (1.0 + decay), rel=1e-6)
    assert solution.cost == pytest.approx(4.0 * decay / (1.0 + decay), rel=1e-6)
    assert solution.optimality.decisions < 1e-5


def test_final_value():
    """A final value that is decided: u = d/T costs d^2/T, the miss of 3 its square."""
    ocp = co.Problem(DURATION, "target")
    d = ocp.decision("d", guess=0.5)
    x, u = ocp.state("x", initial=0.0, final=d), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=(d - 3.0) ** 2)
    for method in ("ipopt", "gradient"):
        solution = solve(ocp, intervals=20, method=method)
        assert solution["x"][-1] == pytest.approx(3.0 / (1.0 + 1.0 / DURATION), rel=1e-6)
        assert float(solution["d"]) == pytest.approx(solution["x"][-1], rel=1e-6)


def test_initial_variance(way):
    """P/v + 1/(1/v + T/U) is least where 1/v + T/U = 1/sqrt(p)."""
    ocp = co.Problem(DURATION, "prior")
    v = ocp.decision("v", guess=1.0, lower=1e-2, upper=1e3)
    x = ocp.state("x", initial=0.0, variance=v)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("m", x, noise=4.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=0.5 / v + E[x, x])
    solution = solve(ocp, intervals=20, **way)
    accuracy = 1.0 / np.sqrt(0.5) - DURATION / 4.0
    assert float(solution["v"]) == pytest.approx(1.0 / accuracy, rel=1e-5)
    assert solution["E"][0, 0, 0] == pytest.approx(1.0 / accuracy, rel=1e-5)
    assert solution.cost == pytest.approx(0.5 * accuracy + np.sqrt(0.5), rel=1e-8)


def test_entry_of_an_initial_covariance_at_its_bound(way):
    """What is measured tells of what is not by their correlation c: E_yy(T) = 1 - c^2 T/(T + U), least at a bound."""
    ocp = co.Problem(DURATION, "correlation")
    c = ocp.decision("c", guess=0.3, lower=-0.8, upper=0.9)
    x, y = ocp.state("x", initial=0.0), ocp.state("y", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.dynamics(y, ca.MX(0))
    ocp.measurement("m", x, noise=1.0)
    E = ocp.estimation_covariance(initial=ca.blockcat([[ca.MX(1), c], [c, ca.MX(1)]]))
    ocp.minimize(running=u**2, terminal=E[y, y])
    solution = solve(ocp, intervals=20, **way)
    assert float(solution["c"]) == pytest.approx(0.9, abs=1e-6)
    assert solution.cost == pytest.approx(1.0 - 0.81 * DURATION / (DURATION + 1.0), rel=1e-6)
    assert solution.optimality.decisions < 1e-6
    assert solution.multipliers.states[0, 2] > 0  # the upper bound holds


def loop(r=None):
    """A closed loop whose sensor is bought; a number in its place makes the same problem without a decision."""
    ocp = co.Problem(DURATION, "loop")
    x = ocp.state("x", initial=1.0, final=0.0, variance=0.5)
    u = ocp.control("u")
    chosen = ocp.decision("r", guess=1.0, lower=0.02, upper=50.0) if r is None else ocp.parameter("r", r)
    ocp.dynamics(x, -0.3 * x + u, noise=0.1)
    ocp.measurement("m", x, noise=chosen)
    ocp.minimize_expected(running=0.5 * u**2 + 0.02 / chosen, terminal_weight={x: 4.0})
    return ocp


def lowest(cost, number):
    """How far from a number the cost is least, relative to it: of the parabola through three costs."""
    low, middle, high = (cost(number * (1 + d)) for d in (-0.05, 0.0, 0.05))
    return 0.025 * (low - high) / (low - 2 * middle + high)


def test_closed_loop_is_the_best_of_all_numbers():
    """The expected cost with the decision is the least of those with numbers; both methods find it."""
    costs = []
    for options in ({}, {"covariances": "states", "covariance_step": "gauss"}, {"method": "gradient"}):
        solution = solve(loop(), intervals=40, **options)
        costs.append(solution.cost)
        assert solution.optimality.decisions < 1e-5
    np.testing.assert_allclose(costs, costs[0], rtol=1e-6)
    number = float(solution["r"])
    assert solve(loop(number), intervals=40).cost == pytest.approx(costs[0], rel=1e-7)
    assert abs(lowest(lambda r: solve(loop(r), intervals=40).cost, number)) < 2e-3


def with_prior(v=None):
    """A closed loop whose first estimate is bought; a number in its place makes the same without a decision."""
    ocp = co.Problem(DURATION, "prior of a loop")
    chosen = ocp.decision("v", guess=0.2, lower=0.05, upper=5.0) if v is None else ocp.parameter("v", v)
    x, u = ocp.state("x", initial=chosen, final=0.0, variance=chosen), ocp.control("u")
    ocp.dynamics(x, -0.3 * x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.3)
    ocp.minimize_expected(running=0.5 * u**2, terminal=0.05 / chosen, terminal_weight={x: 4.0})
    return ocp


def test_prior_of_a_closed_loop(way):
    """The covariances start where the decision says, in costs, loops, evaluations and the classical design."""
    solution = solve(with_prior(), intervals=30, **way)
    number = float(solution["v"])
    np.testing.assert_allclose(solution.loop.E[0], [[number]], rtol=1e-9)
    assert solution.optimality.cost_identity < 1e-5
    assert solution.optimality.decisions < 1e-5
    assert solution.cost == pytest.approx(solve(with_prior(number), intervals=30).cost, rel=1e-6)
    if "method" not in way:
        assert abs(lowest(lambda v: solve(with_prior(v), intervals=30).cost, number)) < 2e-3
    classical = co.solve(with_prior(), intervals=30, nominal="deterministic", progress=False)
    again = solve(with_prior(float(classical["v"])), intervals=30)
    assert classical.cost >= again.cost * (1 - 1e-9) >= solution.cost * (1 - 1e-6)
    truth = co.evaluate(solution, truth=with_prior())
    assert truth.cost == pytest.approx(solution.cost, rel=1e-5)


def test_simulation_and_evaluation_use_the_chosen_number(tmp_path):
    """The same runs as those of the problem with the number in its place; files keep it."""
    solution = solve(loop(), intervals=20)
    number = float(solution["r"])
    plain = co.evaluate(loop(number), nominal=solution)
    assert plain.cost == pytest.approx(solution.cost, rel=1e-12)
    again = co.evaluate(loop(), nominal=solution)
    assert float(again["r"]) == number
    assert again.cost == pytest.approx(solution.cost, rel=1e-12)
    runs, same = (co.simulate(s, 20, seed=3, step=0.05, progress=False) for s in (solution, plain))
    np.testing.assert_allclose(runs.cost, same.cost, rtol=1e-12)
    loaded = co.load(solution.save(tmp_path / "loop.npz"), problem=loop())
    assert float(loaded["r"]) == number
    assert "decision" in str(loaded)
    with pytest.raises(co.ProblemError, match="another problem"):
        co.load(tmp_path / "loop.npz", problem=loop(number))


def test_printed_and_drawn():
    """A number with its unit, no panel, no row of a state, no row in E."""
    solution = solve(sensor(), intervals=20)
    lines = str(solution).splitlines()
    row = next(line for line in lines if line.startswith("r "))
    assert row.split()[-3:] == [f"{float(solution['r']):.8g}", "m^2", "s"]
    assert solution["r"].shape == ()
    assert solution.augmented == ("x",)
    labels = [axes.get_ylabel() for axes in solution.plot().axes]
    assert not any(label.startswith("r") for label in labels)
    assert "r         m^2 s  0.001 .. 1000  3" in str(sensor())


def test_components_and_warm_starts():
    """One at its bound, the other free; a solution is a start that needs no more than another."""
    ocp = co.Problem(1.0, "two")
    d = ocp.decision("d", 2, guess=[0.1, 0.5], lower=[-1.0, -np.inf], upper=[0.2, np.inf])
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u + d[0])
    ocp.minimize(running=u**2, terminal=(x - 1.0) ** 2 + (d[1] - 3.0) ** 2)
    solution = solve(ocp, intervals=10)
    np.testing.assert_allclose(solution["d"], [0.2, 3.0], rtol=1e-6)
    assert float(solution["d[1]"]) == pytest.approx(3.0)
    again = co.solve(ocp, intervals=10, guess=solution, progress=False)
    assert again.stats["iterations"] <= solution.stats["iterations"]
    np.testing.assert_allclose(again["d"], [0.2, 3.0], rtol=1e-6)


def test_constraint_of_decisions_alone_is_one_row():
    """It holds once, at the end, wherever it was asked for."""
    ocp = co.Problem(1.0, "budget")
    d = ocp.decision("d", 2, guess=0.5, lower=0.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=(x - 1.0) ** 2 + ca.sumsqr(d - 2.0))
    ocp.subject_to(d[0] + d[1], upper=2.0, name="both")
    solution = solve(ocp, intervals=10)
    np.testing.assert_allclose(solution["d"], [1.0, 1.0], rtol=1e-6)
    assert solution.multiplier("both") == pytest.approx(2.0, rel=1e-6)


def decided(**more):
    """A problem with a decision that something depends on, or not."""
    ocp = co.Problem(1.0, "plain")
    d = ocp.decision("d", **{"guess": 1.0, **more})
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
    return ocp, d, x, u


def test_a_decision_that_nothing_depends_on_is_refused():
    """Also where only a variance that does not count contains it."""
    ocp, d, x, u = decided()
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    assert "Nothing depends on the decision 'd'" in refused(ocp.statement)
    ocp = co.Problem(1.0)
    d = ocp.decision("d", guess=1.0)
    x, u = ocp.state("x", initial=0.0, variance=d), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    assert "a variance counts where" in refused(ocp.statement)


def test_an_entry_that_nothing_depends_on_is_refused_by_its_index():
    """It would end in the middle of its bounds, as if it had been chosen; in phases where no phase uses it."""

    def vector(name="plain", *, used, first=True):
        ocp = co.Problem(1.0, name)
        d = ocp.decision("d", 3, guess=0.3, lower=0.05, upper=1.0)
        x, u = ocp.state("x", initial=0.0 if first else None), ocp.control("u")
        ocp.dynamics(x, u * d[0])
        ocp.minimize(running=u**2 + sum((d[k] - 0.5) ** 2 for k in used), terminal=(x - 1.0) ** 2)
        return ocp

    assert "'d[1]' (declared" in refused(vector(used=(0, 2)).statement, "Nothing depends on the decision")
    refused(vector(used=()).statement, "Nothing depends on the decision 'd[1]' and 'd[2]'")
    np.testing.assert_allclose(solve(vector(used=(1, 2)), intervals=5)["d"][1:], 0.5, rtol=1e-6)
    parts = [vector("A", used=(1,)), vector("B", used=(), first=False)]
    refused(co.Phases(parts).chain, "Nothing depends on the decision 'd[2]'", "some phase")
    parts = [vector("A", used=(1,)), vector("B", used=(2,), first=False)]
    solution = co.solve(co.Phases(parts), intervals=5, progress=False)
    np.testing.assert_allclose(solution["A"]["d"][1:], 0.5, rtol=1e-6)
    assert max(phase.optimality.decisions for phase in solution) < 1e-4


def test_a_cost_that_falls_for_ever_with_one_entry_is_refused():
    """Also where something else depends on another entry."""
    ocp = co.Problem(1.0)
    d = ocp.decision("d", 2, guess=0.5)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u + d[0])
    ocp.minimize(running=u**2 - d[1], terminal=(x - 1.0) ** 2)
    refused(ocp.statement, "unbounded", "'d[1]'")


@pytest.mark.parametrize(("sign", "bound"), [(-1.0, "upper"), (1.0, "lower")])
def test_a_cost_that_falls_for_ever_is_refused(sign, bound):
    """Said before anything is computed; with the bound it is solved."""
    for limits in ({}, {bound: 3.0 if bound == "upper" else -3.0}):
        ocp, d, x, u = decided(**limits)
        ocp.dynamics(x, u)
        ocp.minimize(running=u**2 + sign * d)
        if limits:
            assert solve(ocp, intervals=10).cost == pytest.approx(-3.0, rel=1e-6)
        else:
            assert f"no {bound} bound" in refused(ocp.statement, "unbounded", "'d'")


def test_a_decision_that_went_far_away_is_named():
    """Where only the solver finds that the cost falls without end."""
    ocp, d, x, u = decided(lower=0.0)
    ocp.dynamics(x, u - d)
    ocp.minimize(running=u**2, terminal=x)
    with pytest.raises(co.SolveError, match="decision 'd' went to"):
        co.solve(ocp, intervals=5, progress=False, max_iterations=300)


def test_a_covariance_must_be_one_up_to_the_bounds():
    """The bound at which it is not is named, with the remedy."""
    ocp = co.Problem(1.0)
    d = ocp.decision("d", guess=1.0, lower=-1.0)
    x, u = ocp.state("x", initial=0.0, variance=d), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("m", x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x, x] + d**2)
    refused(lambda: co.solve(ocp, intervals=5, progress=False), "'d'", "no covariance", "lower bound")


def test_a_filter_has_the_numbers_of_decisions():
    """The same as that of the problem with numbers in their place; no guess is taken for one."""

    def observed(number=None):
        ocp = co.Problem(1.0)
        d = (
            ocp.decision("d", 2, guess=[1.0, 2.0], lower=0.1, upper=9.0)
            if number is None
            else ocp.parameter("d", number)
        )
        x, u = ocp.state("x", initial=d[0], variance=d[1]), ocp.control("u")
        ocp.dynamics(x, u - d[0] * x, noise=d[1])
        ocp.measurement("m", x, noise=d[0])
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2, terminal=E[x, x] + ca.sumsqr(d))
        return ocp

    number, point = np.array([0.7, 3.0]), (0.3, 0.9, -0.4, 0.2, 0.5)
    chosen = filters.extended_filter(observed(), decisions={"d": number})
    for one, two in zip(chosen(*point), filters.extended_filter(observed(number))(*point), strict=True):
        assert float(one) == pytest.approx(float(two), rel=1e-14)
    starts = filters.initial_estimate(observed(), decisions={"d": number})
    np.testing.assert_allclose(np.ravel(starts[0]), 0.7)
    np.testing.assert_allclose(starts[1], [[3.0]])
    refused(lambda: filters.extended_filter(sensor()), "'r' is a decision", "solution['r']")
    refused(lambda: filters.extended_filter(sensor(), decisions={"q": 1.0}), "'q'")


def test_worth_holds_the_decisions_of_its_nominal():
    """As of the problem with numbers in their place."""
    nominal = co.solve(loop(0.4), intervals=20, nominal="deterministic", progress=False)
    given = {"u": nominal["u"], "r": 0.4}
    found = co.worth(loop(), nominal=given, intervals=20, grid=nominal.mesh.nodes)
    known = co.worth(loop(0.4), nominal={"u": nominal["u"]}, intervals=20, grid=nominal.mesh.nodes)
    assert found.classical.cost == pytest.approx(known.classical.cost, rel=1e-12)
    assert found.gain == pytest.approx(known.gain, rel=1e-6, abs=1e-12)
    assert "decisions were held" in found.verdict


def test_what_knows_controls_only_says_so():
    """What a combined design gains, and global minima, are not told of problems with decisions."""
    refused(lambda: co.worth(loop()), "'r' is a decision", "nominal='deterministic'")
    ocp = co.Problem(1.0)
    d = ocp.decision("d", guess=1.0, lower=0.1, upper=2.0)
    x, b, u = ocp.state("x", initial=0.0, variance=1.0), ocp.unknown("b", 1.0, 1.0), ocp.control("u")
    ocp.dynamics(x, u - b)
    ocp.measurement("m", x, noise=d)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[b, b] + 0.1 / d)
    verdict = co.certify(solve(ocp, intervals=10), progress=False)
    assert not verdict.certified
    assert "decision d" in verdict.reason


def test_something_must_move():
    """Decisions and integrals alone are no control problem."""
    ocp = co.Problem(1.0)
    d, u = ocp.decision("d", guess=1.0), ocp.control("u")
    ocp.minimize(running=u**2 + d**2, terminal=ocp.integral(u**2))
    refused(ocp.statement, "no state", "d, integral 1")


def test_bad_input():
    """Bounds crossed, guess outside, NaN, name taken: refused where they are given."""
    ocp = co.Problem(1.0)
    refused(lambda: ocp.decision("d", guess=0.0, lower=1.0, upper=-1.0), "bounds of 'd' cross")
    refused(lambda: ocp.decision("d", guess=2.0, lower=0.0, upper=1.0), "guessed value of 'd' lies outside")
    refused(lambda: ocp.decision("d", guess=np.nan), "'d'")
    refused(lambda: ocp.decision("d", guess=None), "'d'")
    ocp.decision("d", guess=1.0)
    refused(lambda: ocp.decision("d", guess=1.0), "used twice")
    assert len(ocp.states) == 1  # nothing was lost or added
