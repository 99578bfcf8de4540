"""What the form of a control costs where limits along the path act, against closed forms and finer meshes."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co
from covocp.extremal import finer_cost, path_limits

# Coarse meshes pass their limits between the nodes, and say so.
pytestmark = pytest.mark.filterwarnings("ignore:Between the points where it is imposed:covocp.CovocpWarning")
# Estimates and true errors differ by at most this factor: halves of an interval leave up to a quarter of the error.
FACTOR = 2.0
ROOF = 1.3


def lander(how: str) -> tuple[co.Problem, float]:
    """Softly down from 10 with the least fuel (Meditch 1964): fall, then brake; limits of the thrust in three forms."""
    ocp = co.Problem(co.Free(4.0))
    h, v = ocp.state("h", initial=10.0, final=0.0), ocp.state("v", initial=-2.0, final=0.0)
    thrust = ocp.control("u", lower=0.0, upper=3.0 if how == "bound" else np.inf)
    if how == "condition":
        ocp.subject_to(thrust, upper=3.0, name="thrust")
    if how == "two engines":
        other = ocp.control("w", lower=0.0)
        ocp.subject_to(thrust + other, upper=3.0, name="tank")
        thrust += other
    ocp.dynamics(h, v)
    ocp.dynamics(v, -1.5 + thrust)
    ocp.minimize(running=thrust)
    return ocp, 2.0 + np.sqrt(39.0)  # 1.5 T + 2, T from both parabolas


def roofed(how: str) -> tuple[co.Problem, float]:
    """A mass over a distance of 1 in 1 s with the least energy below a speed: two parabolas of the speed and a rest."""
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=0.0, final=1.0)
    v = ocp.state("v", initial=0.0, final=0.0, upper=ROOF if how == "bound" else np.inf)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    if how == "condition":
        ocp.subject_to(v, upper=ROOF, name="roof")
    ocp.minimize(running=u**2)
    return ocp, 8.0 / 3.0 * ROOF**2 / (1.5 * (1.0 - 1.0 / ROOF))


def fastest(how: str) -> tuple[co.Problem, float]:
    """Least time over a distance of 1, rest to rest, below a speed."""
    ocp = co.Problem(co.Free(2.0))
    x = ocp.state("x", initial=0.0, final=1.0)
    v = ocp.state("v", initial=0.0, final=0.0, upper=0.6 if how == "bound" else np.inf)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    if how == "condition":
        ocp.subject_to(v, upper=0.6, name="speed")
    ocp.minimize(terminal=ocp.duration)
    return ocp, 1.0 / 0.6 + 0.6


def walled(_: str) -> tuple[co.Problem, float]:
    """Bryson and Denham: least energy below a wall, a limit of the second order; the error has either sign."""
    wall = 1.0 / 9.0
    ocp = co.Problem(1.0)
    x, v = ocp.state("x", initial=0.0, final=0.0), ocp.state("v", initial=1.0, final=-1.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.subject_to(x, upper=wall, name="wall")
    ocp.minimize(running=0.5 * u**2)
    return ocp, 4.0 / (9.0 * wall)


def watched(_: str) -> tuple[co.Problem, float]:
    """The least measuring that keeps a variance below a limit: none until it is reached, then what holds it."""
    decay, power, noise, first, limit = 0.2, 1.0, 0.1, 0.1, 0.5
    ocp = co.Problem(10.0)
    x, w = ocp.state("x", initial=0.0, variance=first), ocp.control("w", lower=0.0, upper=5.0)
    ocp.dynamics(x, -decay * x, noise=power)
    ocp.measurement("m", x, information=w / noise)
    E = ocp.estimation_covariance()
    ocp.subject_to(E[x, x], upper=limit, name="variance")
    ocp.minimize(running=w)
    settled = power / (2.0 * decay)
    reached = np.log((settled - first) / (settled - limit)) / (2.0 * decay)
    return ocp, (10.0 - reached) * noise * (power - 2.0 * decay * limit) / limit**2


@pytest.mark.parametrize(
    ("stated", "how", "intervals", "control"),
    [
        (lander, "bound", 20, "linear"),
        (lander, "condition", 20, "linear"),
        (lander, "condition", 50, "linear"),
        (lander, "condition", 20, "constant"),
        (lander, "two engines", 20, "linear"),
        (roofed, "condition", 6, "linear"),
        (roofed, "condition", 6, "constant"),
        (roofed, "condition", 20, "linear"),
        (roofed, "bound", 20, "linear"),
        (fastest, "condition", 20, "linear"),
        (fastest, "bound", 50, "linear"),
        (walled, "", 20, "linear"),
        (walled, "", 20, "constant"),
        (walled, "", 50, "linear"),
        (watched, "", 20, "linear"),
        (watched, "", 50, "linear"),
    ],
)
def test_the_estimate_is_the_true_error(stated, how, intervals, control):
    """Beside a condition nothing was told; beside the bound of a state twenty times too much."""
    ocp, optimum = stated(how)
    solution = co.solve(ocp, intervals=intervals, control=control, progress=False)
    truth = abs(solution.cost / optimum - 1.0)
    assert truth / FACTOR < solution.optimality.control_error < truth * FACTOR
    assert "estimated effect of the piecewise" in str(solution)


def test_mixed_conditions_and_covariances_that_the_nominal_drives():
    """Against the cost on twenty times the intervals."""

    def solved(intervals: int) -> co.Solution:
        ocp = co.Problem(10.0)
        x = ocp.state("x", initial=0.0, variance=1.0)
        b, u = ocp.unknown("b", mean=1.0, variance=5.0), ocp.control("u")
        ocp.dynamics(x, -b * x + u, noise=1.0)
        ocp.measurement("m", x, noise=1.0)
        E = ocp.estimation_covariance()
        ocp.subject_to(u - x, lower=-0.3, upper=0.3, name="effort")
        ocp.minimize(running=0.5 * u**2, terminal=10.0 * E[b, b])
        return co.solve(ocp, intervals=intervals, substeps=max(1, 80 // intervals), progress=False)

    solution = solved(20)
    truth = abs(solution.cost / solved(400).cost - 1.0)
    assert truth > 1e-6
    assert truth / FACTOR < solution.optimality.control_error < truth * FACTOR


@pytest.mark.parametrize("method", ["gradient", "reduced"])
def test_other_methods_are_told_the_same(method):
    ocp, optimum = roofed("condition")
    solution = co.solve(ocp, method=method, intervals=20, progress=False)
    truth = abs(solution.cost / optimum - 1.0)
    assert truth / FACTOR < solution.optimality.control_error < truth * FACTOR


def test_equations_along_the_path_always_act():
    """Two controls that are the same: five times the error was told, 3 % for constant controls on six intervals."""
    ocp = co.Problem(1.0)
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u, w = ocp.control("u"), ocp.control("w")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u + 2.0 * w)
    ocp.subject_to(w - u, equals=0.0, name="tied")
    ocp.minimize(running=u**2 + w**2)
    solution = co.solve(ocp, intervals=6, control="constant", progress=False)
    assert solution.optimality.control_error == pytest.approx(solution.cost / (8.0 / 3.0) - 1.0, rel=0.3)


def test_what_a_mesh_that_is_not_solved_to_the_end_gains_is_gained_at_least(monkeypatch):
    """Runs that take too long are ended; an error that is large is then not passed over."""
    solution = co.solve(roofed("condition")[0], intervals=6, control="constant", progress=False)
    whole = finer_cost.change_on_finer_mesh(solution.extremal, solution.cost, None)
    monkeypatch.setitem(finer_cost.SETTINGS, "max_iter", 3)
    least = finer_cost.change_on_finer_mesh(solution.extremal, solution.cost, None)
    assert 0.5 * whole < least < whole


@pytest.mark.parametrize("cause", ["too large", "not solved"])
def test_what_is_not_known_is_said(cause, monkeypatch, tmp_path):
    """It was left out without a word."""
    if cause == "too large":
        monkeypatch.setattr(finer_cost, "MOST_ENTRIES", 0)
    else:
        monkeypatch.setitem(finer_cost.SETTINGS, "max_iter", 0)
    ocp, _ = watched("")
    solution = co.solve(ocp, intervals=20, progress=False)
    assert np.isnan(solution.optimality.control_error)
    text = " ".join(str(solution).split())
    assert "NOT KNOWN" in text
    assert "'variance' acts" in text
    solution.save(tmp_path / "watched.npz")
    assert "NOT KNOWN" in str(co.load(tmp_path / "watched.npz"))


@pytest.mark.parametrize("how", ["condition", "bound"])
def test_the_time_in_which_a_limit_acts(how):
    """The speed is at the roof but for 1.5 (1 - 1/roof) at both ends."""
    solution = co.solve(roofed(how)[0], intervals=100, progress=False)
    share = 1.0 - 3.0 * (1.0 - 1.0 / ROOF)
    (name, found), *others = path_limits.acting(solution.extremal).items()
    assert not others
    assert name == ("v" if how == "bound" else "roof")
    assert found == pytest.approx(share, abs=0.04)


def test_limits_that_are_never_reached_do_not_act():
    ocp, _ = roofed("")
    ocp.subject_to(ocp.states[1].symbol, upper=100.0, name="far")
    assert path_limits.acting(co.solve(ocp, intervals=10, progress=False).extremal) == {}


def test_phases_below_a_speed():
    """Each with the states held where they meet; together the error of the least time of `fastest`."""
    halves = []
    for name in ("first", "second"):
        ocp = co.Problem(co.Free(1.0), name=name)
        start = name == "first"
        x = ocp.state("x", initial=0.0 if start else None, final=0.5 if start else 1.0)
        v = ocp.state("v", initial=0.0 if start else None, final=None if start else 0.0)
        u = ocp.control("u", lower=-1.0, upper=1.0)
        ocp.dynamics(x, v)
        ocp.dynamics(v, u)
        ocp.subject_to(v, upper=0.6, name="speed")
        ocp.minimize(terminal=ocp.duration)
        halves.append(ocp)
    solution = co.solve(co.Phases(halves), intervals=10, progress=False)
    truth = abs(solution.cost / (1.0 / 0.6 + 0.6) - 1.0)
    estimated = sum(solution[name].optimality.control_error for name in ("first", "second"))
    assert truth > 1e-4
    assert truth / FACTOR < estimated < truth * FACTOR


def test_phases_with_covariances_that_go_on():
    """What the later phase costs by the covariance counts; against the cost on five times the intervals."""

    def part(name: str, duration: float) -> co.Problem:
        ocp = co.Problem(duration, name=name)
        first = name == "first"
        x = ocp.state("x", initial=0.0 if first else None, variance=1.0 if first else None)
        b, u = ocp.unknown("b", mean=1.0, variance=5.0), ocp.control("u")
        ocp.dynamics(x, -b * x + u, noise=1.0)
        ocp.measurement("m", x, noise=1.0)
        E = ocp.estimation_covariance()
        ocp.subject_to(x, lower=-0.3, upper=0.3, name="room")
        ocp.minimize(running=0.5 * u**2, terminal=0.0 if first else 10.0 * E[b, b])
        return ocp

    def solved(intervals: int) -> co.PhasesSolution:
        return co.solve(co.Phases([part("first", 4.0), part("second", 6.0)]), intervals=intervals, progress=False)

    solution = solved(10)
    truth = abs(solution.cost / solved(50).cost - 1.0)
    estimated = [solution[name].optimality.control_error for name in ("first", "second")]
    assert min(estimated) > 1e-4
    assert truth / FACTOR < sum(estimated) < truth * FACTOR
