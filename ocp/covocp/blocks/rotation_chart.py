"""The chart of attitudes: unit quaternions, whose tangent is a rotation vector in body axes.

q = (w, v) stands for C(q) as in `blocks.so3`, of any length: q and every multiple of it are the same attitude. A
tangent d moves it to the quaternion of e^{-d^x} C, its rate is that of dC/dt = -omega^x C, and two attitudes that move
alike differ by d with dd/dt = -omega x d + domega (their error in body axes).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.geometry import Chart
from covocp.base.matrices import Array
from covocp.blocks import so3

# Rows of the tangent of an attitude.
AXES = 3
# Squared tangent of half an angle up to which the angle is a series, and the terms that give it to rounding there.
NEAR, TERMS = 0.05, 13


@lru_cache(maxsize=1)
def rotation_chart() -> Chart:
    """The chart of attitudes; one object, so that two problems have the same."""
    z, base, rate = (ca.SX.sym(name, 4) for name in ("z", "base", "rate"))
    d, v = ca.SX.sym("d", AXES), ca.SX.sym("v", AXES)
    moved = so3.quaternion_step(z, d)
    velocity = 2 * so3.quaternion_product(conjugate(z), rate)[1:] / ca.sumsqr(z)
    # with 1/12 for the coefficient of the last term a step errs by O(h^5), as its method [section 2, equation 6]
    course = v + ca.cross(d, v) / 2 + ca.cross(d, ca.cross(d, v)) / 12
    functions = {
        "move": ([z, d], moved),
        "difference": ([z, base], rotation_vector(so3.quaternion_product(conjugate(base), z))),
        "basis": ([z], ca.substitute(ca.jacobian(moved, d), d, ca.DM.zeros(AXES))),
        "velocity": ([z, rate], velocity),
        "course": ([d, v], course),
        "drift": ([v], -so3.cross(v)),
        "like": ([z, base], z * ca.sqrt(ca.sumsqr(base) / ca.sumsqr(z))),
    }
    made = {name: ca.Function(name, inputs, [ca.densify(output)]) for name, (inputs, output) in functions.items()}
    return Chart(kind="attitude", size=4, tangent=AXES, **made)


def rotation_vectors(quaternions: Array) -> Array:
    """Rotation vectors of a course of quaternions without jumps of sign, (K, 4): (K, 3) [rad].

    They run on through half a turn, up to a whole one, unlike those of `so3.log`.
    """
    q = np.atleast_2d(quaternions)
    q = -q if q.shape[0] and q[0, 0] < 0.0 else q
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(sine, q[:, 0])
    return np.asarray(q[:, 1:] * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0)[:, None])


def rotation_vector(quaternion: ca.SX) -> Any:
    """The rotation vector of a quaternion of any length, |phi| <= pi; derivatives are exact at zero.

    phi = 2 atan(t)/t v/w, t = |v|/w, of q or -q, whichever has w >= 0; up to t^2 = NEAR by the series of atan. A tenth
    as many operations as `so3.log` of the rotation, and slopes of slopes in proportion.
    """
    flip = ca.if_else(quaternion[0] < 0, -1, 1)
    w, v = flip * quaternion[0], flip * quaternion[1:]
    square, near = ca.sumsqr(v), ca.sumsqr(v) < NEAR * w**2
    y = ca.if_else(near, square, 0) / ca.if_else(near, w**2, 1)
    series = sum((-y) ** k / (2 * k + 1) for k in range(TERMS)) / ca.if_else(near, w, 1)
    sine = ca.sqrt(ca.if_else(near, 1, square))
    return 2 * ca.if_else(near, series, ca.atan2(sine, w) / sine) * v


def rotation(quaternion: Expr) -> Any:
    """C of a quaternion of any length, (3, 3)."""
    return so3.from_quaternion(quaternion) / ca.sumsqr(quaternion)


def conjugate(quaternion: Expr) -> Any:
    """The quaternion of the attitude turned back."""
    return ca.vertcat(quaternion[0], -quaternion[1:])


def turning(quaternion: Expr, rate: Expr) -> Any:
    """dq/dt = q (x) (0, omega) / 2 of a body with angular velocity omega in body axes."""
    return so3.quaternion_product(quaternion, ca.vertcat(0, rate)) / 2
