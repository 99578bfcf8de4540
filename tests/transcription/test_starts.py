"""Where a solver starts: starts that are ranked, waypoints, runs that lose their way, multistart, Ctrl-C."""

from __future__ import annotations

import signal

import casadi as ca
import numpy as np
import pytest
from problems import lag, solve
from vehicles import vehicle

import covocp as co
from covocp.base.progress import Progress
from covocp.transcription import ranked_starts
from covocp.transcription.starts import own_start

# --- a vehicle that turns ---------------------------------------------------------------------------------------------

# Cost of the cheapest of the extremals that scipy's root finder finds from 60 random starts of the costates.
EXTREMALS = [(0.05, -2.0, 0.21719), (0.5, 1.0, 0.105096)]


@pytest.mark.parametrize(("share", "angle", "cost"), EXTREMALS)
def test_vehicle_finds_the_cheapest_extremal_from_the_default_start(share, angle, cost):
    solution = solve(vehicle(share * 180.0, angle, np.inf))
    assert solution.cost == pytest.approx(cost, rel=2e-3)  # of 100 intervals


@pytest.mark.parametrize("bound", [0.05, 0.1, 0.5])
def test_bounds_that_do_not_bind_do_not_matter(bound):
    """The optimum for 100 m ahead never turns faster than 0.06 rad/s; a bound says nothing about the start."""
    free = solve(vehicle(100.0, 0.0, np.inf))
    solution = solve(vehicle(100.0, 0.0, bound))
    assert solution.cost == pytest.approx(free.cost, rel=1e-6) or (bound == 0.05 and solution.cost < 1.01 * free.cost)
    assert solution.stats["iterations"] <= 30


def test_navigation_by_the_range_to_a_beacon():
    """From the default start as cheap as the best of four explicit ones."""
    problem = vehicle(60.0, 1.0, 0.2, beacon=True)
    waves = [lambda s, a=a, k=k: a * np.cos(k * np.pi * s) for a in (0.03, -0.03) for k in (0, 2)]
    others = [solve(problem, guess={"r": wave}, intervals=50, allow_failure=True) for wave in waves]
    cheapest = min(other.cost for other in others if other.converged)
    assert solve(problem, intervals=50).cost <= 1.001 * cheapest


def test_bend_of_the_start_is_measured_by_what_it_does():
    """One unit of the control, 120 rad of heading, would turn the vehicle 19 times."""
    problem = vehicle(100.0, 0.3, np.inf)
    solver = co.Solver(problem)
    start = own_start(problem.statement(), solver._prepared.mesh, np.zeros(0))
    assert not start.plain
    assert 0.05 < np.abs(start.trajectory.x[:, 2]).max() < np.pi


def test_plain_problem_does_not_look_at_other_starts(monkeypatch):
    monkeypatch.setattr(ranked_starts, "_others", lambda *a: pytest.fail("other starts were made"))
    assert solve(lag().problem, intervals=30).converged


def test_waypoints_lead_the_start():
    """The states at the nodes are the path that was given, the heading and the turn rate follow it."""
    problem = vehicle(100.0, 0.0, 0.2)
    way = {"p": [[0, 0], [50, 70], [100, 0]]}
    start = solve(problem, guess=way, max_iterations=0, allow_failure=True)
    inside = slice(1, -1)  # the ends are given
    path = np.stack([np.interp(start.t, [0, 60, 120], [0, 50, 100]), np.interp(start.t, [0, 60, 120], [0, 70, 0])], 1)
    np.testing.assert_allclose(start["p"][inside], path[inside], atol=1e-6)
    flown = np.cumsum(
        np.diff(start.t)[:, None] * 1.5 * np.stack([np.cos(start["psi"]), np.sin(start["psi"])], 1)[1:], 0
    )
    assert np.abs(flown - path[1:]).max() < 15.0
    solution = solve(problem, guess=way)
    assert solution["p"][50, 1] > 0
    mirrored = solve(problem, guess={"p": [[0, 0], [50, -70], [100, 0]]})
    assert mirrored["p"][50, 1] < 0
    assert mirrored.cost == pytest.approx(solution.cost, rel=1e-5)


def test_run_that_loses_its_way_gets_the_next_start():
    """A guess that spins the vehicle 9 times is no reason to fail."""
    problem = vehicle(100.0, 0.5, 0.5)
    solution = solve(problem, guess={"r": lambda s: 0.48 + 0.0 * s})
    assert solution.stats["tried"] >= 2
    assert solution.cost == pytest.approx(solve(problem).cost, rel=1e-6)


def test_contradiction_is_still_reported():
    """Nowhere near the reach of 180 m: every start fails, and the first one is shown."""
    with pytest.raises(co.SolveError) as caught:
        solve(vehicle(250.0, 0.5, 0.5), intervals=30)
    assert "final value of p[0]" in caught.value.violations


# --- costs where they hold --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["ipopt", "gradient"])
def test_terminal_cost_that_is_infinite_at_the_initial_state(method):
    """F' = u^2, J = int u^2 dt + 1/F(T): least a + 1/a = 2 at a = 1."""
    ocp = co.Problem(duration=2.0)
    F, u = ocp.state("F", initial=0.0), ocp.control("u", guess=0.3)
    ocp.dynamics(F, u**2)
    ocp.minimize(running=u**2, terminal=1 / F)
    assert solve(ocp, method=method, intervals=20).cost == pytest.approx(2.0, rel=1e-6)


# --- multistart -------------------------------------------------------------------------------------------------------


def spring():
    """A spring to be chosen; two basins, k = 1.804 (found from the guess) and k = 0.719 with the cost 1.80721."""
    ocp = co.Problem(6.0, "choose the spring")
    x = ocp.state("x", 2, initial=[0, 0], final=[1.0, 0.0], variance=[0.01, 0.01])
    d, u = ocp.unknown("d", mean=0.4, variance=0.04), ocp.control("u")
    k = ocp.state("k", initial=None, lower=0.5, upper=20.0, guess=3.0)
    ocp.dynamics(k, 0)
    ocp.dynamics(x, ca.vertcat(x[1], u - k * x[0] - d * x[1]), noise=[0, 1e-3])
    ocp.measurement("pos", x[0], noise=0.01)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=300 * E[d, d])
    return ocp


def test_multistart_varies_free_initial_values():
    solver = co.Solver(spring(), intervals=30)
    near = solver.solve(guess={"k": 0.8}, progress=False).cost
    own = solver.solve(progress=False).cost
    assert near < 0.99 * own
    for seed in range(2):
        solution = solver.solve(guess="multistart", starts=8, seed=seed, progress=False)
        assert solution.cost == pytest.approx(near, rel=1e-6)
        assert "local optima" in str(solution)


def test_multistart_varies_free_durations():
    """x' = u from 0 to 1, J = int u^2/2 dt + k(T): T near 1 is best, the guess lies in the basin near 4."""
    ocp = co.Problem(co.Free(4.0, 0.5, 8.0))
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    T = ocp.duration
    ocp.minimize(running=0.05 * u**2, terminal=(T - 1) ** 2 * (T - 4) ** 2 + 0.1 * T)
    times = np.linspace(0.5, 8.0, 750_001)
    cost = 0.05 / times + (times - 1) ** 2 * (times - 4) ** 2 + 0.1 * times
    assert solve(ocp, intervals=10).duration == pytest.approx(4.0, abs=0.1)
    best = solve(ocp, intervals=10, guess="multistart", starts=6)
    assert best.duration == pytest.approx(times[np.argmin(cost)], abs=1e-4)
    assert best.cost == pytest.approx(cost.min(), rel=1e-7)


def logarithm():
    """x' = log u is no number for the half of all random controls: J = e at least, u = e."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=1.0, final=2.0), ocp.control("u", guess=2.0)
    ocp.dynamics(x, ca.log(u))
    ocp.minimize(running=u)
    return ocp


def test_start_outside_the_domain_does_not_end_the_others():
    for seed in range(3):
        solution = solve(logarithm(), intervals=10, guess="multistart", starts=5, seed=seed)
        assert solution.cost == pytest.approx(np.e, rel=1e-5)
        assert len(solution.stats["starts"]) == 6


# --- Ctrl-C -----------------------------------------------------------------------------------------------------------


def test_interrupted_multistart_says_so(monkeypatch):
    update, starts = Progress.update, []

    def interrupting(self, iteration, *rest):
        starts.append(iteration) if iteration == 0 else None
        if len(starts) == 3:
            signal.raise_signal(signal.SIGINT)
        update(self, iteration, *rest)

    monkeypatch.setattr(Progress, "update", interrupting)
    with pytest.raises(co.Interrupted, match="the best of 2 of 11 starts") as caught:  # the first of them on two sides
        solve(lag().problem, intervals=20, guess="multistart", starts=10)
    assert caught.value.solution.converged  # one of the two before


@pytest.mark.parametrize("power", [2, 4])
def test_states_that_answer_to_nothing_by_a_power_do_not_make_the_start_vanish(power):
    """v' = u, y' = -v^n from rest: y has no slope by u there, and nothing else gives its size."""
    ocp = co.Problem(3.0)
    v, y = (ocp.state(name, initial=0.0) for name in "vy")
    u = ocp.control("u")
    ocp.dynamics(v, u)
    ocp.dynamics(y, -0.1 * v**power)
    ocp.minimize(running=(u - 1.0) ** 2)
    solution = co.solve(ocp, intervals=12, progress=False)
    assert solution.cost < 1e-20
    assert solution.stats["iterations"] <= 5
    assert solution["y"][-1] == pytest.approx(-0.1 * 3.0 ** (power + 1) / (power + 1), rel=1e-4)


@pytest.mark.parametrize("what", [co.solve, co.Solver])
def test_a_model_that_is_singular_at_its_start_is_refused_by_name(what):
    ocp = co.Problem(1.0, name="arm")
    x, u = ocp.state("x", 2, initial=[0.0, 0.0], final=[1.0, 0.0]), ocp.control("u")
    inertia = ca.vertcat(ca.horzcat(x[0], 0.0), ca.horzcat(0.0, 1.0))
    ocp.dynamics(x, ca.solve(inertia, ca.vertcat(u, x[0]), "qr"))
    ocp.minimize(running=u**2)
    with pytest.raises(co.ProblemError, match=r"(?s)'arm' cannot be evaluated.*\[0. 0.\].*other initial") as error:
        what(ocp)
    assert isinstance(error.value.__cause__, RuntimeError)
