"""Phases whose meshes refine themselves, against closed forms, a quadrature, and problems that are not cut."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from phased import lag, steered
from problems import unassessed
from scipy.integrate import quad, solve_ivp

import covocp as co
from covocp.models import goddard_rocket

QUIET: dict[str, Any] = {"progress": False}


def pieces(durations: list[float], start: float, end: float, width: float, cubic: float = 0.0) -> co.Phases:
    """x' = -c x^3 + u with int (x^2 + width^2 u^2)/2, cut in pieces."""
    problems = []
    for k, duration in enumerate(durations):
        ocp = co.Problem(duration, name=f"piece {k}")
        last = k == len(durations) - 1
        x, u = ocp.state("x", initial=None if k else start, final=end if last else None), ocp.control("u")
        ocp.dynamics(x, -cubic * x**3 + u)
        ocp.minimize(running=0.5 * (x**2 + width**2 * u**2))
        problems.append(ocp)
    return co.Phases(problems, name="pieces")


def layers(width: float) -> float:
    """The cost from 1 to 1 over a second without the cubic term."""
    return float(width * (1 / np.tanh(1 / width) - 1 / np.sinh(1 / width)))


def check(solution: co.PhasesSolution, optimum: float, asked: float) -> None:
    """The true error is below the one that was measured, and that below the one that was asked for."""
    errors, meshes = solution.stats["mesh_errors"], solution.stats["mesh_intervals"]
    assert abs(solution.cost / optimum - 1.0) <= errors[-1] <= asked < min(errors[:-1], default=1.0)
    assert len(errors) == len(meshes)
    assert meshes[-1] == tuple(phase.mesh.intervals for phase in solution)


@pytest.mark.parametrize(("asked", "control"), [(1e-4, "linear"), (1e-6, "linear"), (1e-3, "constant")])
def test_layers_at_the_ends_of_two_pieces(asked: float, control: str) -> None:
    width = 0.05
    solution = co.solve(pieces([0.4, 0.6], 1.0, 1.0, width), refine=asked, control=control, **QUIET)
    check(solution, layers(width), asked)


def test_the_hypersensitive_problem_cut_in_two() -> None:
    """H = 0 over 10 000 time constants: the cost is a quadrature. The second piece is fast at its end alone."""
    optimum = quad(lambda x: -(x**3) + np.sqrt(x**6 + x**2), 0.0, 1.0, epsabs=1e-13)[0]
    optimum += quad(lambda x: x**3 + np.sqrt(x**6 + x**2), 0.0, 1.5, epsabs=1e-13)[0]
    solution = co.solve(pieces([4e3, 6e3], 1.0, 1.5, 1.0, 1.0), refine=1e-4, **QUIET)
    check(solution, optimum, 1e-4)
    assert sum(solution.stats["mesh_intervals"][-1]) < 150


def test_goddards_rocket_whose_durations_are_free() -> None:
    """J of the three arcs one after the other, to ten digits."""
    solution = co.solve(goddard_rocket.phases(), refine=1e-8, **QUIET)
    check(solution, -1.0128369183, 1e-8 + 1e-10)


def test_bryson_denham_in_three_phases() -> None:
    """Least energy below a wall: 4/(9 l), with the wall reached in the phase in the middle."""
    limit, problems = 1 / 9, []
    for name, first, last in (("up", True, False), ("along", False, False), ("down", False, True)):
        ocp = co.Problem(1 / 3, name=name)
        x = ocp.state("x", initial=0.0 if first else None, final=0.0 if last else None, upper=limit)
        v = ocp.state("v", initial=1.0 if first else None, final=-1.0 if last else None)
        u = ocp.control("u")
        ocp.dynamics(x, v)
        ocp.dynamics(v, u)
        ocp.minimize(running=0.5 * u**2)
        problems.append(ocp)
    solution = co.solve(co.Phases(problems), refine=1e-6, **QUIET)
    check(solution, 4 / (9 * limit), 1e-6)


def test_nodes_go_where_the_cost_of_all_is_lost() -> None:
    """A piece that costs next to nothing has few, whatever its own relative error."""
    phases = pieces([0.2, 0.3, 0.5], 1.0, 1e-4, 0.02)
    solution = co.solve(phases, refine=1e-7, **QUIET)
    first, _, last = solution.stats["mesh_intervals"][-1]
    assert first > 3 * last
    w, T = 0.02, 1.0  # x = a e^(-t/w) + b e^(t/w)
    a, b = np.linalg.solve([[1.0, 1.0], [np.exp(-T / w), np.exp(T / w)]], [1.0, 1e-4])
    optimum = 0.5 * w * (a**2 * (1 - np.exp(-2 * T / w)) + b**2 * (np.exp(2 * T / w) - 1))
    check(solution, optimum, 1e-7)


@pytest.fixture(scope="module")
def whole() -> co.Solution:
    return unassessed(lag(10.0, "whole"), intervals=200, tolerance=1e-9)


@pytest.mark.parametrize("form", ["eliminated", "states"])
def test_covariances_cut_in_two_have_the_cost_of_a_fine_mesh(whole: co.Solution, form: str) -> None:
    cut = co.Phases([lag(4.0, "A", last=False), lag(6.0, "B", first=False)])
    solution = co.solve(cut, refine=1e-6, covariances=form, **QUIET)
    check(solution, whole.cost, 1e-6)
    assert sum(solution.stats["mesh_intervals"][-1]) < 100


def test_a_closed_loop_cut_in_two_has_the_cost_of_a_fine_mesh() -> None:
    def part(duration: float, name: str, *, first: bool, last: bool) -> co.Problem:
        ocp = co.Problem(duration, name=name)
        x = ocp.state("x", initial=0.0 if first else None, final=1.0 if last else None, variance=1.0 if first else None)
        b, u = ocp.unknown("b", mean=1.0, variance=0.5), ocp.control("u")
        ocp.dynamics(x, -b * x + u, noise=0.1)
        ocp.measurement("m", x, noise=1.0)
        ocp.minimize_expected(running=0.5 * (x**2 + u**2), terminal=5.0 * (x - 1) ** 2 if last else 0.0)
        return ocp

    whole = unassessed(part(5.0, "whole", first=True, last=True), intervals=100)
    phases = co.Phases([part(2.0, "A", first=True, last=False), part(3.0, "B", first=False, last=True)])
    solution = co.solve(phases, refine=1e-5, **QUIET)
    check(solution, whole.cost, 1e-5)
    assert solution["B"].loop.Xhat[0].any()  # what the feedback before it left


def test_from_a_solution() -> None:
    phases, optimum = pieces([0.5, 0.5], 1.0, 1.0, 0.2), layers(0.2)
    known = co.solve(phases, intervals=[10, 20], **QUIET)
    check(co.solve(phases, refine=1e-5, guess=known, intervals=[8, 12], **QUIET), optimum, 1e-5)


def test_what_cannot_be_reached_is_told_with_what_was_reached(tmp_path: Path) -> None:
    one, two = co.Problem(2.0, name="one"), co.Problem(3.0, name="two")
    steered(one, two)
    with pytest.warns(co.CovocpWarning, match=r"refine=1e-13 was asked.*on 16 \+ 16 intervals is off by about") as told:
        solution = co.solve(co.Phases([one, two]), refine=1e-13, **QUIET)
    best = min(solution.stats["mesh_errors"])
    assert f"{best:.2g}" in str(told[0].message)
    assert abs(solution.cost / (0.5 / 5.0) - 1.0) <= best
    assert "NOT REACHED" in str(solution)
    for suffix in (".npz", ".json"):
        loaded = co.load(solution.save(tmp_path / f"refined{suffix}"))
        assert loaded.stats["mesh_intervals"] == solution.stats["mesh_intervals"] == ((16, 16),)
        assert loaded["two"].stats["mesh_intervals"] == (16,)
        assert "16 + 16" in str(loaded)
        assert "error of the cost of all phases" in str(loaded)


def test_what_is_not_solved_is_not_returned() -> None:
    with pytest.raises(co.SolveError):
        co.solve(pieces([0.5, 0.5], 1.0, 1.0, 1.0, 9.0), refine=1e-4, max_iterations=1, **QUIET)


def roofed(between: Any) -> co.Phases:
    """A mass thrown under a roof that falls, least energy, cut in the middle of its way."""
    problems = []
    for k, name in enumerate(("up", "down")):
        ocp = co.Problem(0.5, name=name)
        x = ocp.state("x", initial=None if k else 0.0, final=0.0 if k else None)
        v = ocp.state("v", initial=None if k else 1.0, final=-1.0 if k else None)
        u = ocp.control("u")
        ocp.dynamics(x, v)
        ocp.dynamics(v, u)
        ocp.minimize(running=0.5 * u**2)
        ocp.subject_to(x + 0.05 * (ocp.time + 0.5 * k), upper=0.12, name="roof", between=between)
        problems.append(ocp)
    return co.Phases(problems)


def highest(solution: co.PhasesSolution) -> float:
    """Largest value of x + 0.05 t along an integration of the controls by scipy."""
    z, found = np.array([0.0, 1.0]), []
    for k, phase in enumerate(solution):

        def rate(t: float, z: Any, phase: Any = phase) -> list[float]:
            return [z[1], float(np.interp(t, phase.t, phase["u"]))]

        t = np.linspace(0.0, 0.5, 501)
        run = solve_ivp(rate, (0.0, 0.5), z, t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.02)
        found.append(float((run.y[0] + 0.05 * (t + 0.5 * k)).max()))
        z = run.y[:, -1]
    return max(found)


def test_limits_of_phases_hold_between_the_nodes() -> None:
    loose, kept = (co.solve(roofed(between), intervals=6, **QUIET) for between in (None, "auto"))
    assert highest(loose) > 0.12 * (1 + 5e-4)
    assert highest(kept) <= 0.12 * (1 + 1.1e-4)
    assert [phase.mesh.intervals for phase in kept] == [6, 6]
    refined = co.solve(roofed("auto"), refine=1e-5, **QUIET)
    assert highest(refined) <= 0.12 * (1 + 2.5e-5)
    assert refined.stats["mesh_errors"][-1] <= 1e-5
    assert refined.cost == pytest.approx(co.solve(roofed("auto"), intervals=30, points=4, **QUIET).cost, rel=1e-5)
    with pytest.raises(co.ProblemError, match="'gradient' cannot keep 'roof' between the nodes"):
        co.solve(roofed("auto"), "gradient", **QUIET)


def test_a_comparison_refines_the_meshes_of_both_methods() -> None:
    comparison = co.compare(pieces([0.5, 0.5], 1.0, 1.0, 0.2), refine=1e-4, progress=False)
    assert comparison.converged
    for solution in comparison.solutions.values():
        check(solution, layers(0.2), 1e-4)
