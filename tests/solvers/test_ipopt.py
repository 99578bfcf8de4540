"""Ipopt and other NLP plugins: saddles, warm starts, re-solving, interrupts, failures."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import warnings

import casadi as ca
import numpy as np
import pytest
from problems import LAG_COSTS, lag, solve

import covocp as co
from covocp.models import free_time_integrator, noisy_integrator

FORMULATIONS = ("eliminated", "states")
OPTIMUM = LAG_COSTS[0.0, 10.0]


# --- the saddle u = 0 of equilibrium identification [specification, 6.4] ----------------------------------------------


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_default_guess_is_not_the_saddle(formulation):
    assert solve(lag(10.0, 0.0).problem, covariances=formulation, intervals=50).cost == pytest.approx(OPTIMUM, rel=3e-6)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    "guess", [np.zeros(51), lambda s: 0 * s, np.zeros((51, 1))], ids=["array", "function", "column"]
)
def test_saddle_is_left(formulation, guess):
    problem = lag(10.0, 0.0, guess=guess).problem
    with pytest.warns(co.CovocpWarning, match="saddle"):
        solution = solve(problem, covariances=formulation, intervals=50)
    assert solution.cost == pytest.approx(OPTIMUM, rel=3e-6)
    assert solution.stats["left_saddle"]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_saddle_is_left_from_a_guess_for_one_solve(formulation):
    with pytest.warns(co.CovocpWarning, match="saddle"):
        solution = solve(lag(10.0, 0.0).problem, covariances=formulation, intervals=50, guess={"u": np.zeros(51)})
    assert solution.cost == pytest.approx(OPTIMUM, rel=3e-6)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("rebuilt", [True, False])
def test_saddle_is_left_on_a_warm_start(formulation, rebuilt):
    """Below the weight 0.0459816 the optimum is u = 0, which is a saddle above it."""
    solver = co.Solver(lag(0.01, 0.0).problem, covariances=formulation, intervals=50)
    rest = solver.solve(progress=False)
    assert rest.cost == pytest.approx(0.05, rel=1e-8)
    np.testing.assert_allclose(rest["u"], 0, atol=1e-4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        if rebuilt:
            solution = solve(lag(10.0, 0.0).problem, covariances=formulation, intervals=50, guess=rest)
        else:
            solution = solver.solve({"weight": 10.0}, guess=rest, progress=False)
    assert solution.cost == pytest.approx(OPTIMUM, rel=3e-6)


def test_no_false_alarm():
    """A linear problem whose guess is its solution ends where it began, silently."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u", guess=np.ones(101))
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * u**2)
    assert solve(ocp).cost == pytest.approx(0.5, rel=1e-9)


def test_multistart_finds_the_better_minimum():
    """The guess of the problem leads to the second minimum, 7.71199239 [6.4]; its random companions do not."""
    problem = lag(10.0, 1.0, guess=lambda s: -2 * np.sin(np.pi * s)).problem
    options = {"guess": "multistart", "starts": 3, "seed": 1, "intervals": 50}
    solution = solve(problem, **options)
    assert solution.cost == pytest.approx(7.08523968, rel=3e-6)
    assert len(solution.stats["starts"]) == 4
    assert solution.stats["starts"][0] == pytest.approx(7.71199239, rel=3e-6)
    again = solve(problem, **options)
    np.testing.assert_array_equal(again["u"], solution["u"])  # seeded


# --- solving again ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_new_parameters_without_rebuilding(formulation):
    """The same as a fresh solve, cold and warm, in any order; and back again."""
    solver = co.Solver(lag(10.0, 1.0).problem, covariances=formulation)
    first = solver.solve(progress=False)
    cold = solver.solve({"weight": 1.0}, progress=False)
    warm = solver.solve({"weight": 1.0}, guess=first, progress=False)
    moved = solver.solve({"weight": 1.0, "final": -1.0}, guess=cold, progress=False)
    back = solver.solve(progress=False)
    for solution in (cold, warm, moved):
        assert solution.cost == pytest.approx(LAG_COSTS[1.0, 1.0], rel=1e-6)
    for solution in (first, back):
        assert solution.cost == pytest.approx(LAG_COSTS[1.0, 10.0], rel=1e-6)
    assert moved["x"][-1] == pytest.approx(-1.0)
    np.testing.assert_allclose(cold["weight"], 1.0)
    np.testing.assert_allclose(warm["E"], cold["E"], atol=1e-4)


def test_new_mean_of_an_unknown():
    """Means are parameters too: x' = b u, J = q + s^2/b^2 + c/(2 b^2) [specification, 6.2]."""
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=0.0, final=1.0, variance=0.0)
    b, u = ocp.unknown("b", mean=1.0, variance=0.5), ocp.control("u")
    ocp.dynamics(x, b * u, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=E[x, x])
    solver = co.Solver(ocp, intervals=20)
    for mean in (1.0, 2.0, -4.0):
        assert solver.solve({"b": mean}, progress=False).cost == pytest.approx(0.1 + 1.0 / mean**2, rel=1e-7)


def test_parameters_of_solve():
    assert solve(lag(10.0, 1.0).problem, parameters={"weight": 1.0}).cost == pytest.approx(2.62300222, rel=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        {"intervals": 60},
        {"control": "constant"},
        {"grid": np.linspace(0, 1, 81) ** 1.2},
        {"covariances": "states"},
        {"segments": 1},
        {"intervals": 40, "control": "constant", "covariances": "states"},
        {"covariance_step": "rk4", "substeps": 2},
    ],
    ids=lambda options: "-".join(options),
)
def test_warm_start_on_another_mesh(options):
    """The same solution as a cold start there, in no more iterations."""
    problem = lag().problem
    cold = solve(problem, **options)
    warm = solve(problem, guess=solve(problem, intervals=50), **options)
    assert warm.cost == pytest.approx(cold.cost, rel=1e-7)
    assert warm.stats["iterations"] <= cold.stats["iterations"]


def test_warm_start_is_short():
    for formulation in FORMULATIONS:
        solver = co.Solver(lag().problem, covariances=formulation, intervals=30)
        first = solver.solve(progress=False)
        assert solver.solve(guess=first, progress=False).stats["iterations"] <= 2


def test_warm_start_of_a_problem_with_other_constraints():
    data = lag()
    free = solve(data.problem)
    data.problem.subject_to(data.E[data.b, data.b], upper=0.2, at="final", name="certainty")
    bound = solve(data.problem, guess=free)
    assert bound["E"][-1, 1, 1] == pytest.approx(0.2, rel=1e-6)
    assert bound.cost == pytest.approx(solve(data.problem).cost, rel=1e-7)
    assert solve(lag().problem, guess=bound).cost == pytest.approx(free.cost, rel=1e-7)


def test_warm_start_of_a_problem_with_states_in_another_order():
    def problem(names):
        ocp = co.Problem(duration=1.0)
        states = {name: ocp.state(name, initial=0.0, final=1.0 if name == "y" else 2.0) for name in names}
        u = ocp.control("u", 2)
        for i, name in enumerate(("y", "z")):
            ocp.dynamics(states[name], u[i])
        ocp.minimize(running=0.5 * u.T @ u + states["y"] ** 2)
        return ocp

    first = solve(problem(("y", "z")), intervals=10)
    second = solve(problem(("z", "y")), intervals=10, guess=first)
    assert second.cost == pytest.approx(first.cost, rel=1e-8)
    np.testing.assert_allclose(second["z"], first["z"], atol=1e-6)


def test_warm_start_with_free_duration():
    first = solve(free_time_integrator.problem(1.0))
    second = solve(free_time_integrator.problem(0.2), guess=first)
    assert second.duration == pytest.approx(0.9167378064, rel=1e-6)


def test_guess_of_states_by_name_and_symbol():
    data = lag()
    for guess in ({"x": lambda s: s, "u": 1.0}, {data.x: np.linspace(0, 1, 101), data.u: lambda s: 1 + 0 * s}):
        assert solve(data.problem, guess=guess).cost == pytest.approx(7.08523968, rel=1e-6)


# --- failures ---------------------------------------------------------------------------------------------------------


def infeasible():
    data = lag(1.0, 0.0)
    data.problem.subject_to(data.E[data.b, data.b], upper=1e-3, at="final", name="certainty")
    data.problem.subject_to(data.u, lower=-1, upper=1, name="force")
    return data.problem


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_infeasible_problem_names_what_is_violated(formulation):
    """Where the half-vectors are variables, it may be their continuity that is given up instead."""
    with pytest.raises(co.SolveError, match=r"certainty|continuity of E") as caught:
        solve(infeasible(), covariances=formulation, intervals=40, max_iterations=300)
    error = caught.value
    assert max(error.violations.values()) > 0.01
    assert formulation == "states" or "certainty" in error.violations
    last = error.solution
    assert not last.converged
    assert last.status.startswith("NOT CONVERGED")
    assert np.isfinite(last["x"]).all()
    again = solve(lag(1.0, 0.0).problem, guess=last, intervals=40)  # the last iterate is a guess
    assert again.cost == pytest.approx(1.91442319, rel=1e-4)


def test_infeasible_end_is_named():
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, final=5.0), ocp.control("u", lower=-1, upper=1)
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    with pytest.raises(co.SolveError, match="final value of x"):
        solve(ocp, intervals=20)


def test_too_few_iterations():
    with pytest.raises(co.SolveError, match="largest number of iterations") as caught:
        solve(lag().problem, max_iterations=2)
    assert caught.value.solution.stats["iterations"] == 2
    solution = solve(lag().problem, max_iterations=2, allow_failure=True)
    assert not solution.converged
    assert "NOT CONVERGED" in str(solution)
    assert solve(lag().problem, guess=solution).cost == pytest.approx(7.08523968, rel=1e-6)


def test_unbounded_problem_fails():
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=-(u**2), terminal=x)
    with pytest.raises(co.SolveError) as caught:
        solve(ocp, intervals=10, max_iterations=100)
    assert caught.value.solution is not None


INTERRUPTED = """
    import os, signal, sys
    import casadi as ca
    import numpy as np
    import covocp as co
    from covocp.base.progress import Progress

    after = int(sys.argv[1])
    update = Progress.update

    def interrupt(self, iteration, cost, violation):
        update(self, iteration, cost, violation)
        if iteration == after:
            os.kill(os.getpid(), signal.SIGINT)

    Progress.update = interrupt
    ocp = co.Problem(duration=10.0)
    x, b, u = ocp.state("x", initial=0.0, final=1.0, variance=1.0), ocp.unknown("b", 1.0, 5.0), ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("m", x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(0.5 * u**2, 10 * E[b, b])
    for attempt in range(3):
        try:
            co.solve(ocp, allow_failure=True)
        except Exception as error:
            print("swallowed", error)
        except co.Interrupted as error:
            solution = error.solution
            break
    print(attempt, solution.converged, solution.status)
    print(solution.stats["iterations"], np.isfinite(solution["E"]).all(), solution.t.size)
"""


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_interrupt_ends_a_loop_of_solves_and_carries_the_last_iterate():
    """No `except Exception` swallows the KeyboardInterrupt, and what it carries does not look like a solution."""
    command = [sys.executable, "-c", textwrap.dedent(INTERRUPTED), "4"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, run.stderr
    first, second = run.stdout.strip().splitlines()
    assert first == "0 False NOT CONVERGED: interrupted by the user"
    iterations, finite, size = second.split()
    assert 4 <= int(iterations) <= 6
    assert (finite, size) == ("True", "101")


def test_handler_of_interrupts_is_restored():
    before = signal.getsignal(signal.SIGINT)
    solve(noisy_integrator.problem(), intervals=10)
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(co.SolveError):
        solve(lag().problem, max_iterations=1)
    assert signal.getsignal(signal.SIGINT) is before


# --- other solvers and options ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("eliminated", [True, False])
def test_another_plugin(eliminated, capfd):
    problem = lag().problem if eliminated else noisy_integrator.problem(1.0, 0.0)
    silent = {"print_iteration": False, "print_header": False, "print_status": False, "qpsol": "qrqp"}
    quiet = {"qpsol_options": {"print_iter": False, "print_header": False}}
    options = {"covariances": "eliminated" if eliminated else "states", "intervals": 20}
    solution = solve(problem, plugin="sqpmethod", plugin_options={**silent, **quiet}, **options)
    assert solution.cost == pytest.approx(solve(problem, **options).cost, rel=1e-6)
    capfd.readouterr()


@pytest.mark.parametrize("plugin", ["sqpmethod", "fatrop"])
def test_another_plugin_is_silent_where_nobody_watches(plugin, capfd):
    found = solve(noisy_integrator.problem(1.0, 0.0), plugin=plugin, intervals=20)
    assert found.cost == pytest.approx(23 / 24, rel=1e-5)
    assert capfd.readouterr() == ("", "")


def test_hessian_can_be_chosen():
    exact = solve(lag().problem, hessian="exact", covariances="eliminated", intervals=20)
    limited = solve(lag().problem, hessian="limited-memory", covariances="states", intervals=20)
    assert exact.stats["hessian"] == "exact"
    assert limited.stats["hessian"] == "limited-memory"
    assert exact.cost == pytest.approx(limited.cost, rel=1e-6)


def test_multipliers_of_parameters_may_be_asked_of_ipopt():
    """Which needs a function that is left out otherwise."""
    cost = solve(lag().problem).cost
    assert solve(lag().problem, plugin_options={"calc_lam_p": True}).cost == pytest.approx(cost, rel=1e-9)


def test_plugin_options_reach_ipopt():
    solution = solve(lag().problem, plugin_options={"ipopt": {"max_iter": 1}}, allow_failure=True)
    assert solution.stats["iterations"] == 1


@pytest.mark.parametrize("options", [{"ipopt": {"nosuch": 1}}, {"nosuch": 1}])
def test_unknown_plugin_option(options):
    with pytest.raises(co.ProblemError, match="refuses its settings"):
        solve(lag().problem, plugin_options=options)


@pytest.mark.needs_cc
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_compiled_functions(formulation, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    problem = lag().problem if formulation == "eliminated" else noisy_integrator.problem(1.0, 0.0)  # less to compile
    options = {"covariances": formulation, "intervals": 10}
    compiled = solve(problem, compile=True, **options)
    assert compiled.cost == pytest.approx(solve(problem, **options).cost, rel=1e-8)


def test_silent_where_nobody_watches(capfd):
    """Nothing on standard output or error without a terminal."""
    co.solve(lag().problem, intervals=20)
    assert capfd.readouterr() == ("", "")


def test_no_default_run_ends_indefinite():
    """All formulations and steps that may be chosen by default, on coarse and fine meshes."""
    for noise in (1.0, 1e-6):
        for intervals in (8, 30):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", co.CovocpWarning)
                solution = solve(lag(10.0, 1.0, noise=noise).problem, intervals=intervals)
            assert np.linalg.eigvalsh(solution["E"]).min() > 0


def test_noise_density_that_follows_the_state():
    """<n n'> = x with x >= 0, as in [3.4], through the covariance of an estimator without measurement."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, lower=0.0, variance=0.0), ocp.control("u")
    ocp.dynamics(x, u, noise=x)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=E[x, x])
    solution = solve(ocp)
    assert solution.cost == pytest.approx(23 / 24, rel=1e-7)
    np.testing.assert_allclose(solution["u"], solution.t + 0.5, atol=1e-4)
    assert ca.DM(solution["E"][-1]).is_dense()
