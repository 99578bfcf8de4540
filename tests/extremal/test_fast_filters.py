"""Closed loops whose filter is faster at the start than any interval, by orders of magnitude: against scipy."""

from __future__ import annotations

import warnings
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.extremal.closed_loop import close_loop, design_statistics
from covocp.solution import solution as solution_module

DURATION = 10.0
F = np.array([[-1.0, 0.0], [0.0, 0.0]])
G = np.array([[1.0], [0.0]])
M = np.array([[1.0, 0.0], [1.0, 1.0]])
Q = np.diag([1e-2, 0.0])


def offset(prior, density):
    """A lag, one sensor of it, and a very accurate one with an unknown offset."""
    ocp = co.Problem(DURATION, name="offset")
    x, b = ocp.state("x", initial=0.0, final=1.0, variance=1e-2), ocp.unknown("b", mean=0.0, variance=prior)
    u = ocp.control("u")
    ocp.dynamics(x, u - x, noise=1e-2)
    ocp.measurement("m", x, noise=1e-4)
    ocp.measurement("raw", x + b, noise=density)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 5.0})
    return ocp


def feedback(t):
    """C of the linear-quadratic regulator: S' = 2 S + S^2/2 backward from 5, in closed form."""
    decay = np.exp(-2.0 * (DURATION - t))
    S = 5.0 * decay / (1.0 + 1.25 * (1.0 - decay))
    return np.array([[0.5 * S, 0.0]])


def deviations(prior, density, times, share=1.0):
    """Covariance X of the actual loop by scipy; the true initial covariance is `share` times the design's.

    Nothing of this is fast: Y = E^-1, Y' = W - F'Y - Y F - Y Q Y; the true covariance of the error with the gains of
    the design is E + E P D P' E, P' = -(F' + Y Q) P, P(0) = Y(0); that of error and deviation is E R;
    X' = (F - G C) X + X (F - G C)' + Q - G C E R - (G C E R)'.
    """
    W = M.T @ np.diag([1e4, 1.0 / density]) @ M
    start = np.diag([1e-2, prior])
    D = (share - 1.0) * start

    def slope(t, y):
        Y, P, R, X = y.reshape(4, 2, 2)
        E, GC = np.linalg.inv(Y), G @ feedback(t)
        by_R = R @ (F - GC).T - (np.eye(2) + P @ D @ P.T @ E) @ GC.T - Y @ Q - F.T @ R - Y @ Q @ R
        moved = (F - GC) @ X - GC @ E @ R
        return np.array([W - F.T @ Y - Y @ F - Y @ Q @ Y, -(F.T + Y @ Q) @ P, by_R, moved + moved.T + Q]).ravel()

    Y = np.linalg.inv(start)
    y = np.array([Y, Y, -share * np.eye(2), share * start]).ravel()
    found = solve_ivp(slope, (0.0, DURATION), y, "LSODA", times, rtol=1e-10, atol=1e-14)
    return found.y[12:].T.reshape(-1, 2, 2)


@pytest.mark.parametrize(("prior", "density"), [(1e2, 1e-6), (1e6, 1e-8), (1e8, 1e-10)])
def test_deviations_are_those_of_scipy(prior, density):
    with warnings.catch_warnings():  # gains between the nodes as flown, in the last case: another question
        warnings.simplefilter("ignore", co.CovocpWarning)
        solution = co.solve(offset(prior, density), progress=False)
    truth = deviations(prior, density, [1.0, 5.0, 10.0])
    at = np.searchsorted(solution.t, [1.0, 5.0, 10.0])
    found, expected = solution.loop.X[at, 0, 0], truth[:, 0, 0]
    assert np.abs(found / expected - 1).max() <= 1e-5
    assert solution.loop.X[-1, 1, 1] == pytest.approx(prior, rel=1e-9)
    assert solution.cost_identity <= 1e-5


def test_another_true_covariance_than_that_of_the_design():
    solution = co.solve(offset(1e6, 1e-8), progress=False)
    own = design_statistics(solution.extremal)
    loop = close_loop(solution.extremal, replace(own, initial=9.0 * own.initial))
    truth = deviations(1e6, 1e-8, [1.0, 10.0], share=9.0)
    at = np.searchsorted(solution.t, [1.0, 10.0])
    assert np.abs(loop.X[at, 0, 0] / truth[:, 0, 0] - 1).max() <= 1e-5


def test_a_loop_out_of_range_is_told():
    """Deviations that cannot be had are not passed over: those of the error alone look like them."""
    with (
        mock.patch.object(solution_module, "close_loop", return_value=None),
        pytest.warns(co.CovocpWarning, match=r"covariances of the closed loop leave the range of numbers"),
    ):
        co.solve(offset(1.0, 1e-2), progress=False)
