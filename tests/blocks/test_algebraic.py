"""Riccati equations at the end of what numbers can solve: large modes, modes that are hardly reached."""

from __future__ import annotations

import numpy as np
import pytest
from linear_systems import by_doubling

from covocp import ProblemError
from covocp.blocks import riccati


def assert_solved(A, B, Q, R):
    """Gain and cost of the truth, each entry to a share of what its row and column are."""
    regulator = riccati.lqr(A, B, Q, R, discrete=True)
    truth = by_doubling(A, B, Q, np.array([[R]]))
    units = np.sqrt(np.diag(truth))
    np.testing.assert_allclose(regulator.cost / units / units[:, None], truth / units / units[:, None], atol=1e-5)
    assert np.abs(regulator.eigenvalues).max() < 1.0
    expected = np.linalg.solve(R + B.T @ truth @ B, B.T @ truth @ A) / units
    np.testing.assert_allclose(regulator.gain / units, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("R", [1.0, 1e4, 1e5, 1e8])
def test_an_unstable_mode_of_ten_million(R):
    """Any S, and none, leaves a residual that is rounding of A'S A."""
    A = np.array([[1e7, 0.0, -2.5e5], [0.0, 0.93, 100.0], [0.0, 0.0, 1.00001]])
    assert_solved(A, np.array([[1e4], [-60.0], [-1.2]]), np.diag([7e4, 4e2, 9e2]), R)


@pytest.mark.parametrize("seed", range(12))
def test_unstable_modes_far_apart(seed):
    generator = np.random.default_rng(seed)
    fast = 10.0 ** generator.uniform(2, 7)
    A = np.triu(generator.standard_normal((3, 3))) * np.array([[1.0, fast, fast], [1.0, 1.0, 100.0], [1.0, 1.0, 1.0]])
    np.fill_diagonal(A, [fast, 0.9, 1.0001])
    B = generator.standard_normal((3, 1)) * np.array([[fast], [10.0], [1.0]])
    assert_solved(A, B, np.diag(10.0 ** generator.uniform(-2, 4, 3)), 10.0 ** generator.uniform(0, 8))


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("reach", [1e-9, 1e-10])
def test_a_mode_that_is_hardly_reached_is_the_one_that_is_named(discrete, reach):
    """Of two unstable ones, and by how little: the pair is stabilisable, with a gain beyond what can be solved for."""
    turn = np.linalg.qr(np.array([[1.0, 2.0, 0.3], [-0.4, 1.0, 0.5], [0.7, -0.2, 1.0]]))[0]
    A, B = turn @ np.diag([2.5, 1.7, 0.5]) @ turn.T, turn @ np.array([[1.0], [reach], [1.0]])
    assert riccati.unstabilisable(A, B, discrete=discrete).size == 0
    with pytest.raises(ProblemError, match=r"the mode 1\.7, which B does not reach but for a share of \d") as caught:
        riccati.lqr(A, B, np.eye(3), 1.0, discrete=discrete)
    share = float(str(caught.value).split("a share of ")[1].split()[0])
    assert 1e-2 * reach < share < reach
