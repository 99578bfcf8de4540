"""The gain of the filter: numbers, stacks of them and expressions agree, and it is the best one."""

import casadi as ca
import numpy as np
import pytest

from covocp.base.gains import innovation_gain, kalman_gain, weighted

GENERATOR = np.random.default_rng(1960)


def definite(size, count=1):
    root = GENERATOR.standard_normal((count, size, size))
    return root @ root.transpose(0, 2, 1) + np.eye(size)


E, M, U = definite(3, 4), GENERATOR.standard_normal((4, 2, 3)), definite(2, 4)


def test_stacks_have_the_gain_of_each():
    gains = kalman_gain(E, M, U)
    for k in range(4):
        np.testing.assert_allclose(gains[k], E[k] @ M[k].T @ np.linalg.inv(U[k]), rtol=1e-12)
        np.testing.assert_allclose(weighted(M[k], U[k]) @ M[k], M[k].T @ np.linalg.inv(U[k]) @ M[k], rtol=1e-12)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("noise", ["matrix", "diagonal", "constant"])
def test_expressions_agree_with_numbers(kind, noise):
    density = U[0] if noise != "diagonal" else np.diag(np.diag(U[0]))
    e, m = kind.sym("E", 3, 3), kind.sym("M", 2, 3)
    u = {"matrix": kind.sym("U", 2, 2), "diagonal": ca.diag(kind.sym("U", 2)), "constant": kind(ca.DM(density))}[noise]
    symbols = [e, m, *ca.symvar(u)] if noise != "matrix" else [e, m, u]
    given = [E[0], M[0]] + ({"matrix": [density], "diagonal": [np.diag(density)], "constant": []}[noise])
    if noise == "diagonal" and kind is ca.SX:
        symbols, given = [e, m, ca.vertcat(*ca.symvar(u))], given
    found = ca.Function("K", symbols, [kalman_gain(e, m, u)])(*given)
    np.testing.assert_allclose(found.full(), kalman_gain(E[0], M[0], density), rtol=1e-12)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_without_measurements_there_are_no_columns(kind):
    assert kalman_gain(kind.sym("E", 3, 3), kind(0, 3), kind(0, 0)).shape == (3, 0)


def test_no_other_gain_of_an_update_leaves_less():
    L, spread = innovation_gain(E[0], M[0], U[0], np.linalg.solve)
    np.testing.assert_allclose(spread, M[0] @ E[0] @ M[0].T + U[0], rtol=1e-12)

    def left(gain):
        rest = np.eye(3) - gain @ M[0]
        return np.trace(rest @ E[0] @ rest.T + gain @ U[0] @ gain.T)

    for _ in range(5):
        assert left(L) < left(L + 1e-3 * GENERATOR.standard_normal(L.shape))
