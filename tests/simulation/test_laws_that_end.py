"""Runs of a law that end before their time, and laws that oscillate within the steps."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from covocp.simulation.law_steps import seeing_steps
from covocp.simulation.laws import simulate_law

X, U, T = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("t")
INTEGRATOR = ca.Function("plant", [X, U], [U])


def still(rate):
    """A plant whose rate is that, under a law that does nothing."""
    return ca.Function("plant", [X, U], [rate + U]), ca.Function("law", [X, T], [0.0 * X])


@pytest.mark.parametrize("slope", [1.0, 1e-3])
def test_a_law_that_chatters_ends_where_it_begins_to(slope):
    """dx = -sign(x) comes to zero at x(0) / slope; before it the run is kept."""
    law = ca.Function("law", [X, T], [-slope * ca.sign(X)])
    with pytest.warns(UserWarning, match=r"ends at .* chatters, u\[0\] jumps between"):
        run = simulate_law(INTEGRATOR, law, initial=[slope], duration=3e3, samples=6001)
    known = run.t <= 1.0
    np.testing.assert_allclose(run.x[known, 0], slope * (1.0 - run.t[known]), atol=1e-8)
    assert run.diverged
    assert np.isnan(run.x[run.t > 1.1]).all()


def test_a_law_that_switches_now_and_then_does_not_chatter():
    """A relay between two edges, x from -1 to 1 and back in parabolas."""
    y = ca.SX.sym("y", 2)
    plant = ca.Function("plant", [y, U], [ca.vertcat(y[1], U)])
    run = simulate_law(plant, ca.Function("law", [y, T], [-ca.sign(y[0])]), initial=[1.0, 0.0], duration=8.0)
    assert not run.diverged
    switched, quarter = np.modf(run.t / np.sqrt(2.0))  # parabolas of this length, from edge to middle and back
    middle = quarter.astype(int) % 2 == 1
    s = np.sqrt(2.0) * np.where(middle, 1.0 - switched, switched)
    sign = np.where(quarter.astype(int) % 4 < 1, 1.0, np.where(quarter.astype(int) % 4 < 3, -1.0, 1.0))
    np.testing.assert_allclose(run.x[:, 0], sign * (1.0 - s**2 / 2), atol=1e-6)


def test_a_plant_is_followed_to_the_edge_of_its_domain():
    """dx = -sqrt(x) has x = (1 - t/2)^2; LSODA's long trial steps leave the domain at 0.5 s already."""
    with pytest.warns(UserWarning, match=r"ends at 2(\.0000\d*)? s: .*rate of x\[0\] \(plant\) is nan"):
        run = simulate_law(*still(-ca.sqrt(X)), initial=[1.0], duration=5.0, samples=51)
    known = run.t < 2.0
    np.testing.assert_allclose(run.x[known, 0], (1.0 - run.t[known] / 2) ** 2, atol=1e-7)
    assert run.diverged


def test_a_law_without_a_value_is_named():
    law = ca.Function("law", [X, T], [-1.0 - 0.1 * ca.sqrt(X)])
    end = 2.0 * (10.0 - 100.0 * np.log(1.1))  # the integral of 1 / (1 + sqrt(x) / 10)
    with pytest.warns(UserWarning, match=rf"ends at {end:.5f}\d* s: .*u\[0\] \(law\) is nan"):
        simulate_law(INTEGRATOR, law, initial=[1.0], duration=3.0)


def test_runs_with_noise_that_lose_their_value_are_counted():
    with pytest.warns(UserWarning, match=r"4 of 4 runs become NaN .* first at 0\.99\d* s: the rate of x\[0\]"):
        simulate_law(*still(-1 + 1e-3 * ca.log(X)), initial=[1.0], duration=3.0, runs=4)


def test_runs_with_noise_see_a_law_with_whole_periods_in_each_step():
    """u = cos(2 pi 100 t), steps of 0.01 s: x is sin(...) / (2 pi 100), where it was -t/3."""
    law = ca.Function("law", [X, T], [ca.cos(200 * np.pi * T)])
    run = simulate_law(INTEGRATOR, law, initial=[0.0], duration=4.0, samples=401, runs=1)
    assert np.abs(run.x).max() < 1.0 / (200 * np.pi)
    fast = ca.Function("law", [X, T], [ca.cos(2e7 * np.pi * T)])
    with pytest.warns(UserWarning, match="faster than steps"):
        seeing_steps(fast, np.zeros(1), np.linspace(0.0, 4.0, 401), 1)
