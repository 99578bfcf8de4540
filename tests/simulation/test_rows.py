"""Values of runs by name: of constants drawn with known means and variances, beside symbols that have no rows."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from figures import panels

import covocp as co
from covocp.blocks import so3

RUNS = 1500
# Nothing is learnt about these and nothing moves them, so the runs have what is drawn: mean and variance.
DRAWN = {"b": (3.0, 0.4), "c": (-1.0, 0.05)}


def moving(name, decided, *, later=False):
    """A Wiener process, its measurement as accurate as is chosen or not, its energy limited or not, two unknowns."""
    ocp = co.Problem(1.0, name)
    noise = ocp.decision("accuracy", guess=0.1, lower=0.02, upper=1.0) if "decision" in decided else 0.1
    x = ocp.state("x", initial=None if later else 0.0, final=1.0, variance=None if later else 0.1)
    u = ocp.control("u")
    b, c = (ocp.unknown(symbol, *values) for symbol, values in DRAWN.items())
    ocp.dynamics(x, u + 0.01 * b + 0.01 * c, noise=0.01)
    ocp.measurement("m", x, noise=noise)
    if "integral" in decided:
        ocp.subject_to(ocp.integral(u**2, name="energy"), upper=8.0)
    chosen = 0.01 / noise if "decision" in decided else 0.0
    ocp.minimize_expected(running=u**2 + chosen, terminal_weight={x: 3.0})
    return ocp


@lru_cache
def runs(*decided):
    solution = co.solve(moving("rows", decided), intervals=12, progress=False)
    return co.simulate(solution, RUNS, 1, step=0.02, store=6, progress=False)


def is_drawn(sample, name, mean, variance):
    """Five standard errors about what is drawn, by every method that takes a name."""
    error = 5 * np.sqrt(variance / RUNS)
    assert sample.mean(name) == pytest.approx(np.full(sample.t.size, mean), abs=error)
    for value in (
        sample.deviation(name)[-1] ** 2,
        sample.predicted_deviation(name)[-1] ** 2,
        sample.covariance(name)[-1, 0, 0],
        sample.terminal(name).var(),
    ):
        assert value == pytest.approx(variance, rel=5 * np.sqrt(2 / RUNS))
    assert sample.error_covariance(name)[-1, 0, 0] == pytest.approx(variance, rel=0.25)
    assert sample.share_beyond(name, np.sqrt(variance)) == pytest.approx(0.317, abs=0.06)
    assert sample.robust_deviation(name) == pytest.approx(np.sqrt(variance), rel=0.15)


@pytest.mark.parametrize("decided", [("decision",), ("integral",), ("decision", "integral")])
@pytest.mark.parametrize("name", DRAWN)
def test_unknowns_have_what_is_drawn_beside_decisions_and_integrals(decided, name):
    is_drawn(runs(*decided), name, *DRAWN[name])


def test_the_figure_has_the_rows_of_what_it_names():
    figure = runs("decision", "integral").plot()
    assert set(panels(figure)) == {
        *("deviation of x", "deviation of u", "deviation of b", "deviation of c"),
        *("deviation of b at T", "deviation of c at T"),
    }
    band = panels(figure)["deviation of c"].lines
    curves = np.array([line.get_ydata() for line in band if line.get_linewidth() == 1.2])
    assert np.abs(curves) == pytest.approx(np.full(curves.shape, np.sqrt(DRAWN["c"][1])), rel=1e-6)


@pytest.mark.parametrize(
    ("name", "why"), [("accuracy", "the same number in all runs"), ("energy", "along the nominal")]
)
def test_what_has_no_rows_is_refused_with_the_reason(name, why):
    sample = runs("decision", "integral")
    for ask in (sample.mean, sample.deviation, sample.error_covariance, sample.terminal, sample.plot):
        with pytest.raises(co.ProblemError, match=f"no deviations of '{name}'(?s:.)*{why}(?s:.)*x, b, c"):
            ask(name)


def test_a_control_has_no_values_at_the_end():
    with pytest.raises(co.ProblemError, match=r"known of states and unknowns(?s:.)*'u', a control"):
        runs().terminal("u")


@pytest.mark.parametrize("name", DRAWN)
def test_phases_have_what_is_drawn_beside_decisions(name):
    first, second = (moving(phase, ("decision",), later=phase == "B") for phase in "AB")
    solution = co.solve(co.Phases([first, second]), intervals=8, progress=False)
    sample = co.simulate(solution, RUNS, 1, step=0.05, store=4, progress=False)
    for phase in sample:
        is_drawn(phase, name, *DRAWN[name])
    assert f"deviation of {name}" in panels(sample.plot())


@lru_cache
def turning(*order):
    """An attitude and a constant state in some order, then two unknowns."""
    ocp = co.Problem(1.0, "turning")
    w = ocp.control("w", 3)

    def attitude():
        goal, spread = so3.exp([0.3, 0.2, 0.1]), np.diag([0.01, 0.02, 0.03])
        return ocp.attitude("att", initial=np.eye(3), final=goal, rate=w, variance=spread, noise=1e-6 * np.eye(3))

    made = {"att": attitude, "y": lambda: ocp.state("y", initial=5.0, variance=0.49)}
    symbols = {name: made[name]() for name in order}
    for symbol, values in DRAWN.items():
        ocp.unknown(symbol, *values)
    ocp.dynamics(symbols["y"], 0.0)
    ocp.measurement("star", symbols["att"].matrix[:, 0], noise=0.05)
    ocp.minimize_expected(running=ca.sumsqr(w), terminal_weight={"att": 1.0})
    solution = co.solve(ocp, intervals=8, progress=False)
    return co.simulate(solution, RUNS, 1, step=0.05, store=4, progress=False), symbols["att"]


@pytest.mark.parametrize("order", [("att", "y"), ("y", "att")])
def test_what_lies_beside_an_attitude_has_what_is_drawn(order):
    sample, attitude = turning(*order)
    for name, (mean, variance) in {**DRAWN, "y": (5.0, 0.49)}.items():
        is_drawn(sample, name, mean, variance)
    first = np.square(sample.deviation(attitude)[0])
    assert first == pytest.approx([0.01, 0.02, 0.03], rel=5 * np.sqrt(2 / RUNS))
    assert sample.deviation("att[2]")[0] ** 2 == pytest.approx(first[2])
    assert {f"deviation of att[{i}] [rad]" for i in range(3)} < set(panels(sample.plot()))


def test_entries_of_a_quaternion_are_no_entries_of_the_error():
    sample, attitude = turning("att", "y")
    with pytest.raises(co.ProblemError, match="quaternion of 'att'"):
        sample.deviation(attitude.quaternion[0])
    with pytest.raises(co.ProblemError, match="no entry 3"):
        sample.deviation("att[3]")
