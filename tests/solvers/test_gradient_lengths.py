"""The gradient method solved for other values of the parameters: steps that are too long for them are the reason."""

import numpy as np
import pytest
from refusals import refused
from scipy import sparse

import covocp as co
from covocp.solvers.gradient import descent
from covocp.solvers.gradient.memory import learnt

INTERVALS = 20


def decaying(bound=np.inf, final=0.5, name="decay", start=1.0):
    """x' = -a x + u with least energy; a is a parameter, 1 at first."""
    ocp = co.Problem(duration=1.0, name=name)
    a = ocp.parameter("a", 1.0)
    x, u = ocp.state("x", initial=start, final=final), ocp.control("u", lower=-bound, upper=bound)
    ocp.dynamics(x, -a * x + u)
    ocp.minimize(running=u**2)
    return ocp


def energy(a, final=0.5):
    """Least energy from 1 to the final value with piecewise linear controls: d^2 / g' M^-1 g.

    d is what the control has to add at the end, g what each node adds, M the integrals of products of hat functions.
    """
    h = 1.0 / INTERVALS
    rising, falling = (1 - (1 - np.exp(-a * h)) / (a * h)) / a, ((1 - np.exp(-a * h)) / (a * h) - np.exp(-a * h)) / a
    damped = np.exp(-a * h * np.arange(INTERVALS - 1, -1, -1))  # from the end of an interval to T
    g = np.append(falling * damped, 0.0) + np.append(0.0, rising * damped)
    M = (
        h
        / 6.0
        * (np.diag([2.0, *[4.0] * (INTERVALS - 1), 2.0]) + np.eye(INTERVALS + 1, k=1) + np.eye(INTERVALS + 1, k=-1))
    )
    return (final - np.exp(-a)) ** 2 / (g @ np.linalg.solve(M, g))


def solved(ocp, a, substeps=1, intervals=INTERVALS):
    solver = co.Solver(ocp, "gradient", intervals=intervals, substeps=substeps)
    return solver.solve({"a": a}, progress=False)


@pytest.mark.filterwarnings("ignore:The controls change faster")  # it halves within an interval
@pytest.mark.parametrize("a", [40.0, 50.0])
@pytest.mark.filterwarnings("ignore:The mesh is too coarse")
def test_costates_take_the_steps_that_faster_values_need(a):
    """With those of the first values the terminal conditions did not come closer, for no reason that a user finds."""
    solution = solved(decaying(), a)
    assert solution.stats["backward_steps"] >= a / INTERVALS / 0.25
    assert abs(solution.cost - energy(a)) <= 2.5 * solution.optimality.mesh_error * solution.cost


@pytest.mark.filterwarnings("ignore:The controls change faster")  # it halves within an interval
def test_short_steps_reach_the_least_energy():
    solution = solved(decaying(), 40.0, substeps=8)
    assert solution.cost == pytest.approx(energy(40.0), rel=1e-3)
    assert solution.optimality.mesh_error < 1e-3


def test_steps_that_are_too_long_are_the_reason():
    """Exactly 0 is reached at once with |u| <= 5 < 27.5 x, but a step that damps by 0.95 only does not get there."""
    z = -27.5 / 10
    assert 0.9 < 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24 < 1.0
    with pytest.raises(co.SolveError) as caught:
        solved(decaying(bound=5.0, final=0.0), 27.5, intervals=10)
    message = str(caught.value)
    assert "integration steps are too long for these values of the parameters" in message
    assert "2.75" in message
    assert "substeps=3" in message
    assert "bounds" not in message
    assert solved(decaying(bound=5.0, final=0.0), 27.5, substeps=8, intervals=10).converged


def test_a_condition_that_bounds_forbid_keeps_its_reason():
    with pytest.raises(co.SolveError, match="the bounds may forbid them"):
        solved(decaying(bound=0.01), 2.0)


@pytest.mark.filterwarnings("ignore:The controls change faster")  # it halves within an interval
@pytest.mark.parametrize("substeps", ["auto", 1])
def test_costates_that_no_explicit_steps_follow_are_the_reason(substeps):
    with pytest.raises(co.SolveError, match="the costates are too fast") as caught:
        solved(decaying(), 1e5, substeps)
    assert "method='ipopt'" in str(caught.value)
    assert co.solve(decaying(), parameters={"a": 1e5}, intervals=INTERVALS, progress=False).converged


def test_a_covariance_that_given_steps_blow_up():
    """E' = -E^2 / r: explicit steps of E(0) h / r = 50 overflow; by the default step E is exact at any length."""
    ocp = co.Problem(duration=1.0)
    r = ocp.parameter("r", 1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("m", x, noise=r)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x, x])
    options = {"intervals": INTERVALS, "substeps": 1, "covariance_step": "rk4"}
    solver = co.Solver(ocp, "gradient", **options)
    message = refused(lambda: solver.solve({"r": 1e-3}, progress=False), "too long for these values", "substeps=100")
    assert "guess" not in message
    fine = co.Solver(ocp, "gradient", intervals=INTERVALS, substeps=1).solve({"r": 1e-3}, progress=False)
    assert fine.cost == pytest.approx(1.0 + 1.0 / (1.0 + 1e3), rel=1e-6)


def test_active_sets_that_come_in_turn_are_those_of_the_last_pass(monkeypatch):
    """Where conditions contradict bounds they do not settle; what the last pass would end with is known before."""
    random, made = np.random.default_rng(0), []
    tried = descent._equality_step
    monkeypatch.setattr(descent, "_equality_step", lambda *given: made.append(1) or tried(*given))
    for _ in range(40):
        root, slope = random.normal(size=(12, 12)), 3.0 * random.normal(size=12)
        metric = learnt(sparse.csc_array(root @ root.T + 0.05 * np.eye(12)), [])
        rows, target = random.normal(size=(2, 12)), 20.0 * random.normal(size=2)
        lower, upper = -random.uniform(size=12), random.uniform(size=12)
        found = descent.solve_step(metric, slope, rows, target, lower, upper)
        state = np.zeros(12, dtype=int)
        for _ in range(descent.ACTIVE_SET_PASSES):
            change, ell, _ = tried(metric, slope, rows, target, np.where(state < 0, lower, upper), state)
            pressure, before = -(slope + metric @ change + rows.T @ ell), state
            beyond = np.where(change > upper, 1, np.where(change < lower, -1, 0))
            state = np.where(before == 0, beyond, np.where(before * pressure > 0, before, 0))
            if (state == before).all():
                break
        np.testing.assert_array_equal(found.active, state)
        np.testing.assert_allclose(found.change, np.clip(change, lower, upper), atol=1e-9)
    assert len(made) < 40 * descent.ACTIVE_SET_PASSES * 0.8


@pytest.mark.filterwarnings("ignore:The controls change faster")  # it halves within an interval
def test_phases_take_the_steps_of_their_values():
    first, second = decaying(final=None, name="one"), co.Problem(duration=1.0, name="two")
    a = second.parameter("a", 1.0)
    x, u = second.state("x", initial=None, final=0.5), second.control("u")
    second.dynamics(x, -a * x + u)
    second.minimize(running=u**2)
    phases = co.Phases([first, second])
    options = {"method": "gradient", "intervals": INTERVALS, "substeps": 8, "progress": False}
    solution = co.solve(phases, parameters={"a": 40.0}, **options)
    assert min(solution.phases[0].stats["backward_steps"]) >= 8
    assert solution.cost == pytest.approx(energy(40.0), rel=1e-3)  # what the start adds has died out
    with pytest.raises(co.CovocpError, match=r"in 'one' the (integration steps are too long|costates are too fast)"):
        co.solve(phases, parameters={"a": 1e5}, **options)
