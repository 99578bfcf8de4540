"""Deviations of a solution by symbol: which rows of the augmented state they are."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co


def test_an_entry_of_a_quaternion_has_no_deviation():
    """By name it is an entry of the error: as the expression it had returned the deviation of another number."""
    ocp = co.Problem(1.0, "turning")
    w = ocp.control("w", 3)
    spread = np.diag([0.01, 0.02, 0.03])
    attitude = ocp.attitude("att", initial=np.eye(3), rate=w, variance=spread, noise=1e-6 * np.eye(3))
    b = ocp.unknown("b", 1.0, 0.25)
    ocp.measurement("star", attitude.matrix[:, 0], noise=0.05)
    ocp.estimation_covariance()
    ocp.minimize(running=w.T @ w + b)
    found = co.evaluate(ocp, nominal={"w": np.zeros((9, 3))}, intervals=8)
    with pytest.raises(co.ProblemError, match="quaternion of 'att'"):
        found.deviation(attitude.quaternion[0])
    first = [found.deviation(f"att[{i}]")[0] for i in range(3)]
    assert np.allclose(np.square(first), np.diag(spread))
    assert np.allclose(found.deviation(attitude)[0], first)
    assert found.deviation(b)[0] == pytest.approx(0.5)
