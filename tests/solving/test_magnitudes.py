"""Numbers that cannot be squared are refused by name, before a solver is busy with inf and NaN."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co
from covocp.models import unknown_lag
from covocp.solvers import ipopt
from covocp.statement.magnitudes import check_magnitudes

# The largest number whose square is one is 1.34e154.
LARGE = 1e155


def integrator(duration=1.0, start=0.0, final=1.0, mean=1.0):
    """x' = v, v' = u - b."""
    ocp = co.Problem(duration, name="integrator")
    x, v = ocp.state("x", initial=start, final=final, variance=1.0), ocp.state("v", initial=0.0, variance=0.1)
    u, b = ocp.control("u"), ocp.unknown("b", mean=mean, variance=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - b)
    ocp.measurement("m", x, noise=1.0)
    ocp.estimation_covariance()
    ocp.minimize(running=u**2)
    return ocp


CASES = [
    ({"duration": LARGE}, "duration of 'integrator'"),
    ({"duration": co.Free(1e300)}, "duration of 'integrator'"),
    ({"start": -LARGE}, "initial value of 'x'"),
    ({"final": 1e300}, "final value of 'x'"),
    ({"mean": -1e300}, "mean of 'b'"),
]


@pytest.mark.parametrize(("change", "words"), CASES)
@pytest.mark.parametrize("method", ["ipopt", "gradient", "reduced", "auto"])
def test_too_large_to_be_squared(change, words, method, monkeypatch):
    monkeypatch.setattr(ipopt, "prepare", lambda *a, **k: pytest.fail("a solver was made"))
    with pytest.raises(co.ProblemError, match=f"The {words} is too large: its square is no number"):
        co.solve(integrator(**change), method, progress=False)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"means": {"b": 1e300}}, "mean of 'b'"),
        ({"initial": {"x": -1e300}}, "initial value of 'x'"),
        ({"duration": 1e300}, "duration of 'first-order lag, unknown time constant'"),
    ],
)
def test_too_large_for_one_solve(given, words):
    solver = co.Solver(unknown_lag.problem(), intervals=10)
    with pytest.raises(co.ProblemError, match=words):
        solver.solve(**given, progress=False)


def test_too_large_where_nothing_is_optimised():
    """The evaluation had returned a cost of NaN."""
    with pytest.raises(co.ProblemError, match="duration of 'first-order lag"):
        co.evaluate(unknown_lag.problem(duration=1e300))
    with pytest.raises(co.ProblemError, match="duration of 'experiment'"):
        co.solve(unknown_lag.phases(duration=1e300), progress=False)


@pytest.mark.parametrize("value", [1e150, 1.34e154, 1.35e154, 1e308])
def test_the_limit_is_that_of_the_square(value):
    st = integrator(final=value).statement()
    with np.errstate(over="ignore"):
        fits = np.isfinite(np.float64(value) ** 2)
    if fits:
        check_magnitudes(st, st.values)
        return
    with pytest.raises(co.ProblemError, match="final value of 'x'"):
        check_magnitudes(st, st.values)
