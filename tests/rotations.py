"""Rotations for tests: angles at which formulas change, and derivatives of the exponential by scipy alone."""

from __future__ import annotations

import casadi as ca
import numpy as np
from hypothesis import strategies as st
from scipy.linalg import expm

KINDS = (ca.SX, ca.MX)
AXIS = np.array([0.6, -0.48, 0.64])
# Around zero, around the ends of the series of exp (1) and log (0.4949), and around its last branch (2.6906).
ANGLES = (0.0, 1e-200, 1e-9, 1e-4, 0.494, 0.496, 0.9, 1 - 1e-12, 1.0, 1 + 1e-12, 1.1, 2.69, 2.691, 3.1)
ROUNDING = {"rtol": 0, "atol": 1e-14}
IDENTITY = {"rtol": 0, "atol": 1e-10}
ANY_ANGLE = st.one_of(st.just(0.0), st.floats(1e-12, 1e-4), st.floats(1e-4, 3.1))


def turn(seed: int, angle: float):
    """A rotation vector of a given length."""
    axis = np.random.default_rng(seed).standard_normal(3)
    return angle * axis / np.linalg.norm(axis)


def hat(v):
    """The cross-product matrix, by numpy alone."""
    return np.cross(np.asarray(v), np.eye(3)).T


def second_derivative(X, U, V):
    """e^X, its derivatives along U, along V, and along both, by the exponential of one block matrix."""
    Z = np.zeros_like(X)
    whole = expm(np.block([[X, U, V, Z], [Z, X, Z, V], [Z, Z, X, U], [Z, Z, Z, X]]))
    return whole[:3, :3], whole[:3, 3:6], whole[:3, 6:9], whole[:3, 9:]
