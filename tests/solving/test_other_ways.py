"""A condition that does not act leaves the best gain, also where a run with the first steps does not come to an end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.base.progress import Progress
from covocp.extremal.extremal import Outcome
from covocp.solving import classical_runs, other_ways, solver
from covocp.solving.other_ways import Way, by_other_ways

INTERVALS = {"intervals": 30, "progress": False}
# On long rk4 steps the optimum may be a saddle by 1e-5 of its largest curvature; whether it is seen depends on the time
# that there is for the look.
pytestmark = pytest.mark.filterwarnings("ignore:This is no minimum")


# For each of these rounding decides whether an approximate Hessian leads to the optimum on long rk4 steps.
DURATIONS = (4.0, 3.9, 3.95, 4.05, 4.1, 4.2, 3.8, 4.15, 3.85, 4.25)
RK4 = {"substeps": 1, "covariance_step": "rk4"}


def swung(duration=4.0, *, limited=True):
    """A pendulum from rest to rest, whose variance at the end is a tenth of its limit."""
    ocp = co.Problem(duration, "swung")
    x = ocp.state("x", 2, initial=[0.0, 0.0], final=[1.0, 0.0], variance=[0.05, 0.03])
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u - ca.sin(x[0])), noise=[0.0, 0.02])
    ocp.measurement("m", x[0], noise=0.02)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=u**2, terminal_weight={x: [3.0, 2.0]})
    if limited:
        ocp.subject_to(X[x, x][0, 0], upper=1.0, at="final", name="wide")
    return ocp


@pytest.fixture(scope="module")
def best():
    """Cost of the best gain, from a Riccati equation: what no condition that does not act can change."""
    return co.solve(swung(limited=False), **INTERVALS).cost


@dataclass(frozen=True)
class Creeping:
    """Two solves by one solver whose first run creeps along the gain, and the cost of the best gain."""

    first: co.Solution
    second: co.Solution
    best: float


def solved_twice(duration, method, options, best):
    again = co.Solver(swung(duration), method, intervals=30, **options)
    return Creeping(first=again.solve(progress=False), second=again.solve(progress=False, assess=False), best=best)


@cache
def by_steps(method):
    return solved_twice(4.0, method, {"substeps": 1}, co.solve(swung(limited=False), **INTERVALS).cost)


@cache
def by_hessian(method):
    """For a duration for which the approximate Hessian is another way."""
    if method == "auto":
        found = by_hessian("ipopt")
        return solved_twice(found.first.duration, method, RK4, found.best)
    for duration in DURATIONS:
        try:
            found = solved_twice(duration, method, RK4, 0.0)
        except co.SolveError:
            continue
        if "found by hessian='limited-memory'" in str(found.first):
            return replace(found, best=co.solve(swung(duration, limited=False), **INTERVALS).cost)
    raise AssertionError("the approximate Hessian finds the optimum for none of the durations")


CREEPING = {"steps": by_steps, "hessian": by_hessian}


def test_a_condition_that_does_not_act_leaves_the_best_gain(best):
    found = co.solve(swung(), **INTERVALS)
    assert found.cost == pytest.approx(best, rel=1e-5)
    assert found.stats["iterations"] < 50


@pytest.mark.filterwarnings("ignore:This is no minimum")  # on long steps, as the printout says
@pytest.mark.parametrize(
    ("kind", "step", "by"),
    [("steps", "gauss", "covariance_step='gauss'"), ("hessian", "rk4", "hessian='limited-memory'")],
    ids=["steps", "hessian"],
)
def test_a_run_that_creeps_along_the_gain_goes_another_way(kind, step, by):
    """As by one step an interval, which leaves the gain at the start free."""
    creeping = CREEPING[kind]("ipopt")
    assert creeping.first.cost == pytest.approx(creeping.best, rel=1e-5)
    assert creeping.first.mesh.step == step
    assert f"found by {by}" in str(creeping.first)


def test_where_none_is_tried_they_are_named():
    with pytest.raises(co.SolveError, match="covariance_step='gauss' or hessian='limited-memory' may find a way"):
        co.solve(swung(), max_iterations=60, substeps=1, **INTERVALS)  # as asked: nothing is tried beyond


class Raises:
    """A problem made ready whose run ends as one in which CasADi cannot solve a step."""

    def __init__(self, prepared):
        self.mesh = prepared.mesh

    def solve(self, *_):
        raise RuntimeError("the linear system is singular")


def raising(monkeypatch, where):
    """Let runs raise where options of the mesh and of the method are such."""
    made_ready = solver.made_ready

    def ready(method, statement, options, parameters, **own):
        prepared = made_ready(method, statement, options, parameters, **own)
        return Raises(prepared) if where(options, own) else prepared

    monkeypatch.setattr(solver, "made_ready", ready)


@pytest.mark.filterwarnings("ignore:This is no minimum")  # on long steps, as the printout says
def test_without_the_option_of_the_hessian_ipopt_is_another_way():
    """The method "auto" has none; it lets Ipopt run where a gain is free."""
    auto = by_hessian("auto")
    assert auto.first.cost == pytest.approx(auto.best, rel=1e-5)
    assert "found by method='ipopt' with hessian='limited-memory'" in str(auto.first)
    assert auto.first.method == auto.second.method == "ipopt"
    with pytest.raises(co.SolveError, match="method='ipopt' with hessian='limited-memory' may find a way"):
        co.solve(swung(), method="auto", max_iterations=60, **RK4, **INTERVALS)


@pytest.mark.parametrize("method", ["ipopt", "auto"])
@pytest.mark.parametrize("kind", ["steps", "hessian"])
def test_later_solves_begin_the_way_that_found_a_solution(kind, method):
    creeping = CREEPING[kind](method)
    first, second = creeping.first, creeping.second
    assert first.cost == pytest.approx(creeping.best, rel=1e-5)
    assert second.cost == pytest.approx(creeping.best, rel=1e-5)
    assert second.stats["iterations"] < first.stats["iterations"] - 350  # the first run ended in vain after 400
    assert "other_ways" not in second.stats


@pytest.mark.parametrize("limit", [413, 415])
def test_at_a_limit_the_better_iterate_counts_and_no_way_is_blamed(best, limit):
    """The first run ends after 400 iterations where Xhat is below zero; the limit cuts short what comes after it."""
    found = co.Solver(swung(), intervals=30, substeps=1).solve(iteration_limit=limit, progress=False)
    assert not found.converged
    assert found.cost == pytest.approx(best, rel=1e-3)
    assert "found by" not in str(found)


def test_what_is_told_of_ways_is_what_they_came_to(monkeypatch):
    """Cut short, by a limit or by the user: the outcome that violates less, or is cheaper, and no word on the way."""
    extremal = co.solve(swung(limited=False), **INTERVALS).extremal
    monkeypatch.setattr(other_ways, "make_guess", lambda *_: None)

    def outcome(cost, violation, *, converged=False):
        violations = {"row": violation} if violation else {}
        return Outcome(
            extremal=extremal,
            cost_terms={"running": cost},
            converged=converged,
            message="ended",
            violations=violations,
            stats={"iterations": 10},
        )

    def tried(failed, found, *, stops):
        reporter = Progress("", show=False)

        class Ready:
            mesh = extremal.mesh

            def solve(self, *_):
                reporter.asked = stops
                return found

        ways = [Way("one", None, {}, {}), Way("two", None, {}, {})]
        return by_other_ways(failed, None, ways, lambda way: Ready(), reporter)

    junk, near, cheap, dear = outcome(-900.0, 1e-3), outcome(2.0, 1e-4), outcome(1.0, 0.0), outcome(3.0, 0.0)
    for failed, found, better in ((junk, near, 2.0), (near, junk, 2.0), (dear, cheap, 1.0), (cheap, junk, 1.0)):
        given, kept = tried(failed, found, stops=True)
        assert (given.cost_terms["running"], kept) == (better, None)
        assert given.stats == {"iterations": 20}
    assert tried(near, outcome(np.nan, np.nan), stops=True)[0].cost_terms["running"] == 2.0
    given, kept = tried(junk, near, stops=False)
    assert (given.cost_terms["running"], kept) == (-900.0, None)
    assert given.stats == {"iterations": 30, "other_ways": "one and two"}
    given, kept = tried(junk, outcome(1.0, 0.0, converged=True), stops=False)
    assert given.converged
    assert kept[0].words == given.stats["other_ways"] == "one"


def test_a_way_that_raises_leaves_the_run_that_failed(monkeypatch):
    monkeypatch.setattr(solver, "PATIENCE", 20)
    raising(monkeypatch, lambda options, own: options.covariance_step == "gauss" or "hessian" in own)
    found = co.solve(swung(), substeps=1, allow_failure=True, **INTERVALS)
    assert not found.converged
    assert found.stats["iterations"] == 20
    with pytest.raises(co.SolveError, match="gauss' and hessian='limited-memory' found nothing either"):
        co.solve(swung(), substeps=1, **INTERVALS)


def test_finer_steps_that_raise_leave_the_solution(monkeypatch):
    monkeypatch.setattr(classical_runs, "finer_steps", lambda extremal, options, *_: replace(options, substeps=7))
    raising(monkeypatch, lambda options, own: options.substeps == 7)
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    assert co.solve(ocp, **INTERVALS).cost == pytest.approx(1.0)


def beside_limits(*, at):
    """A position that is not known well enough for its limits, whatever feedback does."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", 2, initial=[0.0, 0.0], variance=[0.2, 0.2]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, 0.5])
    ocp.measurement("m", x[0], noise=0.5)
    ocp.closed_loop_covariance()
    ocp.minimize_expected(running=u**2)
    ocp.chance(x[0], lower=-0.1, upper=0.1, probability=0.95, at=at)
    return ocp


@pytest.mark.parametrize("options", [{}, {"max_iterations": 60}], ids=["tried", "asked"])
def test_where_no_feedback_can_help_no_other_way_is_tried_or_named(options):
    with pytest.raises(co.SolveError, match="no feedback takes X below E") as caught:
        co.solve(beside_limits(at="initial"), intervals=10, progress=False, **options)
    assert "may find a way" not in str(caught.value)
    assert "found nothing either" not in str(caught.value)
    assert "other_ways" not in caught.value.solution.stats


def test_a_gain_of_a_structure_that_fails_by_steps_of_rk4_is_found_by_gauss_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A guess that has a gain replaces the best one. What fails takes hundreds of iterations: here it is cut short."""
    own = solver.from_starts

    def cut(prepared, values, guesses, reporter):
        return own(prepared, values, guesses, Progress("", show=False, iterations=5, within=reporter))

    monkeypatch.setattr(solver, "from_starts", cut)
    ocp = co.Problem(2.0)
    x, b = ocp.state("x", initial=0.2, final=0.2, variance=0.4), ocp.unknown("b", mean=0.9, variance=0.9)
    u = ocp.control("u")
    ocp.dynamics(x, u - b * x, noise=0.02)
    ocp.measurement("m", x, noise=0.05)
    gain = co.Gain(structure=[[1, 0]])
    ocp.minimize_expected(running=0.3 * u**2 + 0.5 * x**2, terminal_weight={x: 1.7}, gain=gain)
    found = co.solve(ocp, intervals=20, guess={"C": 0.0}, progress=False)
    assert "covariance_step='gauss'" in str(found)
    monkeypatch.undo()
    by_gradient = co.solve(ocp, "gradient", intervals=20, progress=False)
    assert found.cost == pytest.approx(by_gradient.cost, rel=1e-4)


def swinging(gain: co.Gain | None) -> co.Problem:
    """A swing whose stiffness is not known."""
    ocp = co.Problem(2.0)
    x, v = ocp.state("x", initial=0.2, final=0.2, variance=0.4), ocp.state("v", initial=-0.25, variance=0.1)
    b, u = ocp.unknown("b", mean=0.9, variance=0.9), ocp.control("u")
    ocp.dynamics(x, v, noise=0.01)
    ocp.dynamics(v, -b * x - 0.3 * v + u, noise=0.02)
    ocp.measurement("m", x, noise=0.05)
    ocp.minimize_expected(running=0.3 * u**2 + 0.5 * x**2, terminal_weight={x: 1.7, v: 1.0}, gain=gain)
    return ocp


def test_a_gain_of_a_structure_begins_at_the_best_gain() -> None:
    """From a gain of zero it took 400 iterations and more, or none was found."""
    structured = swinging(co.Gain(structure=[[1, 1, 0]]))
    found = co.solve(structured, intervals=100, progress=False)
    assert found.stats["iterations"] < 30
    assert not np.any(found.gains["C"][:, :, 2])
    by_gradient = co.solve(structured, "gradient", intervals=25, progress=False)
    best = co.solve(swinging(None), intervals=100, progress=False)
    assert found.cost == pytest.approx(by_gradient.cost, rel=1e-4)
    assert found.cost == pytest.approx(best.cost, rel=1e-3)
