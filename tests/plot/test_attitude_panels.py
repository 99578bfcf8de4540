"""Figures of attitudes: bands of rotation vectors, and what is required at the end."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from attitudes import steered
from figures import edges_of, legend_of, main_lines, panels, values_of

import covocp as co
from covocp.blocks import so3

VARIANCE = 1e-4


@lru_cache
def spun(turns, goal=None):
    """A turn about x by so many whole ones at a constant rate, its error known as well about every axis."""
    ocp = co.Problem(2.0, "spun")
    omega = ocp.control("omega", 3)
    final = None if goal is None else so3.exp(np.array(goal))
    ocp.attitude("C", initial=np.eye(3), final=final, rate=omega, variance=VARIANCE)
    ocp.estimation_covariance()
    ocp.minimize(running=ca.sumsqr(omega))
    rate = np.array([turns * np.pi, 0.0, 0.0])
    return co.evaluate(ocp, nominal={"omega": lambda s: np.tile(rate, (np.size(s), 1))}, intervals=60)


def marks(axes):
    """Ordinates of what is required at the end."""
    return [line.get_ydata()[0] for line in axes.lines if line.get_marker() == "o"]


def test_the_band_of_a_rotation_vector_has_its_closed_form():
    """Of an error e alike about all axes: of the axis of the turn e, of others e (t/2)/sin(t/2) at the angle t."""
    solution = spun(0.8)
    axes = panels(solution.plot("C"))["C [°]"]
    edges = edges_of(axes, solution.t)
    assert len(edges) == 6  # the angle has none
    half = 0.8 * np.pi * solution.t / 2
    across = np.divide(half, np.sin(half), out=np.ones_like(half), where=half > 0)
    for k, factor in enumerate((np.ones_like(half), across, across)):
        low, high = edges[2 * k : 2 * k + 2]
        assert (high - low) / 2 == pytest.approx(np.rad2deg(np.sqrt(VARIANCE)) * factor, rel=1e-5)
    assert legend_of(solution.plot("C")) == ["± 1 standard deviation"]
    assert marks(axes) == []  # the end is free


def test_the_band_is_that_of_the_logarithm_of_turned_attitudes():
    """Under feedback, of a covariance that is no multiple of one: by central differences of so3.log."""
    solution = co.solve(steered()[0], intervals=10, progress=False)
    edges = edges_of(panels(solution.plot("attitude"))["attitude [°]"], solution.t)
    for k in (1, 4, 10):
        C, h = so3.from_quaternion(solution["attitude"][k]), 1e-5
        logs = [[so3.log(so3.exp(sign * h * row) @ C) for row in np.eye(3)] for sign in (1, -1)]
        J = (np.array(logs[0]) - np.array(logs[1])).T / (2 * h)
        expected = np.rad2deg(np.sqrt(np.diag(J @ solution.loop.X[k] @ J.T)))
        found = [(edges[2 * i + 1][k] - edges[2 * i][k]) / 2 for i in range(3)]
        assert found == pytest.approx(expected, rel=1e-6)


def test_no_band_reaches_a_whole_turn():
    """There a rotation vector has no slope: the band ends before it fills the panel."""
    solution = spun(0.999)
    low, high = edges_of(panels(solution.plot("C"))["C [°]"], solution.t)[2:4]
    near = solution.t / 2 * 0.999 > 0.95
    assert near.any()
    assert np.isnan(high[near]).all()
    assert np.isfinite(high[~near]).all()
    assert np.nanmax(high - low) / 2 < 20 * np.rad2deg(np.sqrt(VARIANCE))


@pytest.mark.parametrize("goal", [(0.3, -0.4, 1.2), (1.5 * np.pi, 0.0, 0.0), (0.7 * np.pi, 0.2, 0.0)])
def test_what_is_required_at_the_end_is_marked_where_it_is(goal):
    """A turn that misses it: the mark is the rotation vector of the goal, the one nearer to the end of the curve."""
    figure = spun(0.8, goal).plot("C")
    expected = np.rad2deg([*goal, np.linalg.norm(goal)])
    end = np.array([line.get_ydata()[-1] for line in main_lines(panels(figure)["C [°]"])])
    found = np.array(marks(panels(figure)["C [°]"]))
    assert end[0] == pytest.approx(0.8 * 360)
    if goal[0] < np.pi / 2:  # its quaternion is nearer to the end with the other sign: the longer way round
        expected[:3] *= 1 - 2 * np.pi / np.linalg.norm(goal)
        expected[3] = 360 - expected[3]
    assert found == pytest.approx(expected, abs=1e-6)
    assert "required at the end" in legend_of(figure)


def test_an_entry_of_a_quaternion_has_its_own_band():
    """q = (cos t/2, sin t/2, 0, 0) spreads by half an error, of which q0 has the share sin t/2 and q1 cos t/2."""
    solution = spun(0.8)
    half = 0.8 * np.pi * solution.t / 2
    shares = (np.abs(np.sin(half)), np.abs(np.cos(half)), np.ones_like(half), np.ones_like(half))
    drawn = panels(solution.plot(*(f"C[{k}]" for k in range(4))))
    for k, share in enumerate(shares):
        axes = drawn[f"C q{k}"]
        (curve,) = (line.get_ydata() for line in main_lines(axes))
        assert [curve[0], curve[-1]] == pytest.approx(solution["C"][[0, -1], k], abs=1e-12)
        low, high = edges_of(axes, solution.t)
        assert (high - low) / 2 == pytest.approx(np.sqrt(VARIANCE) / 2 * share, abs=1e-7)


def test_an_entry_of_the_error_has_a_root_mean_square():
    solution = spun(0.8)
    (rms,) = values_of(solution.plot(("rms", "C[1]")), "rms of C[1] [rad]")
    assert rms == pytest.approx(np.full(rms.shape, np.sqrt(VARIANCE)), rel=1e-6)
    with pytest.raises(co.ProblemError, match="no entry 3"):
        solution.plot(("C[3]", "C[3]"))


def test_no_ellipse_of_the_error_stands_about_entries_of_the_quaternion():
    solution = co.evaluate(correlated(), nominal={"u": 1.0}, intervals=8)
    (axes,) = panels(solution.plot("p", over="C[1]")).values()
    assert len(axes.lines) == 4  # the curve, its start, both edges of its band
    assert len(panels(solution.plot("p", over="y"))["p"].lines) > 6


def correlated():
    """An attitude and two positions, all uncertain."""
    ocp = co.Problem(1.0, "correlated")
    p, y, u = ocp.state("p", initial=0.0, variance=0.3), ocp.state("y", initial=0.0, variance=0.2), ocp.control("u", 3)
    ocp.attitude("C", initial=np.eye(3), rate=u, variance=[0.1, 0.2, 0.3])
    ocp.dynamics(p, u[0], noise=0.1)
    ocp.dynamics(y, u[1], noise=0.1)
    ocp.estimation_covariance()
    ocp.minimize(running=ca.sumsqr(u - 1))
    return ocp
