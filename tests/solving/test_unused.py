"""What is probably forgotten in a statement is named, and what is plainly meant is not."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co


def run(ocp, **options):
    return co.solve(ocp, progress=False, intervals=20, **options)


def drifting(measure=None, cost="b"):
    """x' = -b x + u with an unknown b; at the end the variance of something counts."""
    ocp = co.Problem(2.0)
    x = ocp.state("x", initial=0.0, final=1.0, variance=0.1)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=0.1)
    if measure is not None:
        ocp.measurement("m", measure(x, b), noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[cost, cost])
    return ocp


def test_nothing_is_learnt_without_a_measurement():
    with pytest.warns(co.CovocpWarning, match="Nothing is learnt about 'b': there is no measurement"):
        solution = run(drifting())
    np.testing.assert_allclose(solution.deviation("b"), np.sqrt(5.0), rtol=1e-12)


def test_nothing_is_learnt_from_what_does_not_depend_on_it():
    ocp = co.Problem(2.0)
    x, z = ocp.state("x", initial=0.0, final=1.0), ocp.state("z", initial=0.0, variance=1.0)
    b, u = ocp.unknown("b", mean=1.0, variance=5.0), ocp.control("u")
    ocp.dynamics(x, -b * x + u)
    ocp.dynamics(z, 0.0)
    ocp.measurement("m", z, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[b, b])
    with pytest.warns(co.CovocpWarning, match="about 'b': no measurement depends on it"):
        run(ocp)


@pytest.mark.parametrize("measure", [lambda x, b: x, lambda x, b: b])
def test_what_is_measured_at_once_or_by_its_effect_is_learnt(measure):
    assert run(drifting(measure)).deviation("b")[-1] < np.sqrt(5.0)


def test_a_spread_that_the_nominal_shapes_needs_no_measurement():
    assert run(drifting(cost="x")).converged


def test_measurements_that_nothing_uses():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("gauge", x, noise=1.0)
    ocp.minimize(running=u**2)
    with pytest.warns(co.CovocpWarning, match="Nothing uses the measurement 'gauge'"):
        run(ocp)
    run(ocp)  # it is said once


def corridor(limit):
    ocp = co.Problem(3.0)
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, u, noise=1.0)
    ocp.measurement("m", x, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.subject_to(limit(x, E[x, x]), upper=3.0, name="corridor")
    ocp.minimize_expected(running=u**2 + (x - 2) ** 2)
    return ocp


def test_the_error_of_the_filter_is_not_the_spread_of_the_loop():
    with pytest.warns(co.CovocpWarning, match=r"'corridor' contains E.*X = E \+ Xhat") as caught:
        solution = run(corridor(lambda x, E: x + 3 * ca.sqrt(E)))
    worst = np.argmax(1 - np.sqrt(solution["E"][:, 0, 0]) / solution.deviation("x"))
    assert f"{solution.deviation('x')[worst]:.4g}" in str(caught[0].message)
    assert run(corridor(lambda x, E: x)).converged


@pytest.mark.parametrize("noise", [[0.0, 1.0], [1.0, 1.0], 0.0])
def test_noise_that_is_given_for_each_row_is_meant(noise):
    assert double_integrator(noise).converged


def double_integrator(noise):
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", 2, initial=0.0, final=[1.0, None], variance=1.0), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u), noise=noise)
    ocp.measurement("m", x[0], noise=1.0)
    ocp.minimize_expected(running=u**2, terminal_weight={x[0]: 1.0})
    return run(ocp)


def test_one_noise_for_position_and_velocity():
    with pytest.warns(co.CovocpWarning, match=r"The noise of 'x' is one number.*x\[0\]"):
        double_integrator(1.0)


def guessed(rows, **options):
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, guess=np.linspace(0, 1, rows)), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    return run(ocp, **options)


def test_a_guess_of_another_length():
    with pytest.warns(co.CovocpWarning, match="guess of 'x' has 18 rows, and 20 intervals have 21 nodes"):
        guessed(18)
    with pytest.warns(co.CovocpWarning, match="guess of 'u' has 40 rows"):
        guessed(21, guess={"u": np.ones(40)})


@pytest.mark.parametrize("rows", [2, 5, 20, 21])
def test_guesses_at_the_nodes_and_waypoints_are_meant(rows):
    assert guessed(rows).converged


@pytest.mark.parametrize("value", [np.nan, [1.0, np.nan], np.array([np.nan, 1.0]), ca.DM([1.0, np.nan]), ca.MX(np.nan)])
@pytest.mark.parametrize("end", ["initial", "final"])
def test_nan_is_no_free_value(end, value):
    with pytest.raises(co.ProblemError, match=f"The {end} value of 'x' contains NaN(?s:.)*None"):
        co.Problem(1.0).state("x", 2, **({"initial": 0.0} | {end: value}))


def test_nan_is_no_free_entry_of_a_matrix():
    with pytest.raises(co.ProblemError, match="initial value of 'S' contains NaN"):
        co.Problem(1.0).symmetric("S", 2, initial=[[1.0, np.nan], [np.nan, 1.0]])


def test_none_in_a_sequence_is_free():
    """x = (t, anything): the second component stays where it costs nothing, at its start."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", 2, initial=[0.0, 3.0], final=[1.0, None]), ocp.control("u", 2)
    ocp.dynamics(x, u)
    ocp.minimize(running=ca.sumsqr(u))
    solution = run(ocp)
    np.testing.assert_allclose(solution["x"], np.column_stack([solution.t, np.full(21, 3.0)]), atol=1e-7)


def test_a_decision_has_a_guess_without_a_time():
    """As many numbers as entries, which are near the number of intervals by chance."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    d = ocp.decision("d", 20, guess=np.ones(20))
    ocp.minimize(running=u**2 + ca.sumsqr(d - 2))
    assert co.solve(ocp, intervals=30, progress=False).cost == pytest.approx(1.0)


def test_one_value_for_each_entry_has_no_time():
    """As many numbers as entries, which are near the number of intervals by chance; rows are what is counted."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", 18, initial=0.0, final=1.0), ocp.control("u", 18, guess=np.ones(18))
    ocp.dynamics(x, u)
    ocp.minimize(running=ca.sumsqr(u))
    assert run(ocp).cost == pytest.approx(18.0)
    assert run(ocp, guess={"u": np.ones((3, 18))}).converged
    with pytest.warns(co.CovocpWarning, match="guess of 'u' has 17 rows"):
        run(ocp, guess={"u": np.ones((17, 18))})


def test_a_gain_that_nobody_guessed_is_not_blamed():
    """A condition on the spread makes the 16 entries of the gain controls, which start somewhere."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", 4, initial=0.0, final=0.3, variance=0.02), ocp.control("u", 4)
    ocp.dynamics(x, u, noise=1e-3)
    ocp.measurement("m", x, noise=1e-2)
    ocp.chance(x[0], upper=0.6, probability=0.9, at="final", name="limit")
    ocp.minimize_expected(running=ca.sumsqr(u), terminal_weight={x: 1.0})
    assert run(ocp).converged


def beside(use):
    """x' = u, and a second control v in what `use` declares, beside the rate and the cost."""
    ocp = co.Problem(1.0)
    x, u, v = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u"), ocp.control("v", guess=0.5)
    ocp.dynamics(x, u, noise=0.1)
    ocp.measurement("m", x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2 + x**2 + E[x, x])
    use(ocp, x, u, v)
    return ocp


def test_a_control_on_which_nothing_depends():
    ocp = beside(lambda ocp, x, u, v: None)
    with pytest.warns(co.CovocpWarning, match="Nothing depends on the control 'v'"):
        run(ocp)
    run(ocp)  # it is said once
    with pytest.warns(co.CovocpWarning, match="Nothing depends on the control 'v'"):
        co.evaluate(beside(lambda ocp, x, u, v: None), nominal={"u": 0.0, "v": 0.0})


@pytest.mark.parametrize(
    "use",
    [
        lambda ocp, x, u, v: ocp.dynamics(ocp.state("y", initial=0.0, final=1.0), v),
        lambda ocp, x, u, v: ocp.dynamics(ocp.state("y", initial=0.0, variance=1.0), 0.0, noise=0.1 + v**2),
        lambda ocp, x, u, v: ocp.measurement("n", x, noise=1.0 + v**2),
        lambda ocp, x, u, v: ocp.measurement("n", x * (1 + 0.1 * v), noise=1.0),
        lambda ocp, x, u, v: ocp.subject_to(u - v, lower=0.0, upper=0.0, name="same"),
    ],
    ids=["rate", "noise of a rate", "noise of a reading", "reading", "condition"],
)
def test_a_control_that_is_used_somewhere_is_meant(use):
    from covocp.solving.unused import mention_forgotten

    mention_forgotten(beside(use))  # warnings are errors


@pytest.mark.parametrize("expected", [False, True])
def test_a_control_of_the_cost_is_used(expected):
    ocp = co.Problem(1.0)
    x, u, v = ocp.state("x", initial=1.0, variance=1.0), ocp.control("u"), ocp.control("v")
    ocp.dynamics(x, u, noise=0.1)
    if expected:
        ocp.measurement("m", x, noise=1.0)
    (ocp.minimize_expected if expected else ocp.minimize)(running=u**2 + v**2 + x**2)
    assert run(ocp).converged


def two_parts(use):
    """x' = u through two phases; a control v in what `use` declares in the second one, beside the rate and the cost."""
    parts = []
    for k, name in enumerate(("climb", "cruise")):
        ocp = co.Problem(1.0, name=name)
        x = ocp.state("x", initial=None if k else 0.0, final=2.0 if k else None, variance=None if k else 1.0)
        u = ocp.control("u")
        ocp.dynamics(x, u, noise=0.1)
        ocp.measurement("m", x, noise=1.0)
        if k:
            use(ocp, x, u, ocp.control("v", guess=0.5))
        ocp.estimation_covariance()
        ocp.minimize(running=u**2)
        parts.append(ocp)
    return co.Phases(parts)


def test_a_control_on_which_nothing_depends_in_its_phase():
    phases = two_parts(lambda ocp, x, u, v: None)
    with pytest.warns(co.CovocpWarning, match="Nothing depends on the control 'v' of the phase 'cruise'") as given:
        solution = run(phases)
    assert len(given) == 1
    assert solution.cost == pytest.approx(2.0)  # u = 1 in both
    run(phases)  # it is said once
    nominal = [{"u": 1.0}, {"u": 1.0, "v": 0.5}]
    with pytest.warns(co.CovocpWarning, match="Nothing depends on the control 'v' of the phase 'cruise'"):
        co.evaluate(two_parts(lambda ocp, x, u, v: None), nominal=nominal, intervals=4)


def test_a_phase_that_has_changed_is_looked_at_again():
    phases = two_parts(lambda ocp, x, u, v: None)
    with pytest.warns(co.CovocpWarning, match="the control 'v' of the phase 'cruise'"):
        run(phases)
    phases.problems[0].control("w")
    with pytest.warns(co.CovocpWarning, match="the control '[vw]' of the phase") as given:
        run(phases)
    assert "the control 'w' of the phase 'climb'" in str(given[0].message)
    assert len(given) == 2


@pytest.mark.parametrize(
    "use",
    [
        lambda ocp, x, u, v: ocp.dynamics(ocp.state("y", initial=0.0, final=1.0), v),
        lambda ocp, x, u, v: ocp.measurement("n", x, noise=1.0 + v**2),
        lambda ocp, x, u, v: ocp.subject_to(u - v, lower=0.0, upper=0.0, name="same"),
        lambda ocp, x, u, v: ocp.chance(x + v, upper=30.0, probability=0.9),
        lambda ocp, x, u, v: ocp.integral(v**2),
    ],
    ids=["rate", "noise of a reading", "condition", "chance", "integral"],
)
def test_a_control_that_is_used_in_its_phase_is_meant(use):
    from covocp.solving.unused import mention_forgotten_in

    mention_forgotten_in(two_parts(use))  # warnings are errors


@pytest.mark.parametrize(
    "measured", [lambda x: ca.MX(3.0), lambda x: 3.0, lambda x: 0 * x], ids=["MX", "number", "0 x"]
)
@pytest.mark.parametrize("feedback", [True, False], ids=["feedback", "filter"])
def test_a_measurement_of_nothing_is_warned_about_once(measured, feedback):
    ocp = co.Problem(3.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=0.04), ocp.control("u")
    ocp.dynamics(x, u, noise=0.05)
    ocp.measurement("blind", measured(x), noise=0.02)
    if feedback:
        ocp.minimize_expected(running=0.1 * u**2, terminal_weight={x: 1.0})
    else:
        ocp.minimize(running=u**2, terminal=ocp.estimation_covariance()[x, x])
    with pytest.warns(UserWarning, match="'blind' depends on no state") as caught:
        co.solve(ocp, intervals=10, progress=False)
    assert sum("'blind' depends on no state" in str(warning.message) for warning in caught) == 1
