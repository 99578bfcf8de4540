"""Small systems in factored form for feedback laws of infinite horizon; three of them with known optimal cost.

dx/dt = (A0 + A(x)) x + B u, J = 1/2 int x'Q x + u'R u dt, R = I. Without units.

cubic: dx/dt = x - x^3 + u, Q = 1, A = -x^2. The state-dependent Riccati law is optimal; with s = 1 - x^2

    u = -x s - x sqrt(s^2 + 1),   V = x^2/2 - x^4/4 - (s sqrt(1 + s^2) + asinh s)/4 + (sqrt(2) + asinh 1)/4

    The θ-D series 1 + sqrt(2), 1 + 1/sqrt(2), sqrt(2)/8, -sqrt(2)/16, ... in a = -x^2 converges for |x| < 2^(1/4).

arctangent: dx1/dt = x2, dx2/dt = -x1 (pi/2 + atan 5 x1) - 5 x1^2/(2 (1 + 25 x1^2)) + 4 x2 + 3 u, Q = diag(0, 1);
    V = (x1^2 (pi/2 + atan 5 x1) + x2^2)/2, u = -3 x2, which every number of terms and all k, l give.

rational: w = 1 + x1^2/2, dx1/dt = x2, dx2/dt = w x2/2 - (x2/2 + x1 + x1 x2^2/2)/w + u, Q = diag(0, 1);
    V = (x1^2 + w x2^2)/2, u = -w x2. With F21 = -(1 + x2^2/2)/w the state-dependent Riccati law is optimal; with
    F21 = -1/w (rational_split) it is not: the laws depend on the factorisation.

van_der_pol: dx1/dt = x2, dx2/dt = -x1 + (1 - x1^2) x2 + u, Q = I.

two_inputs: dx1/dt = x1 - x1^3 + x2 + u1, dx2/dt = x1 + x1^2 x2 - x2 + u2, Q = I. From (2, -2): optimum 1.7790, linear
    regulator 1.9863, state-dependent Riccati law 3.9961.

The arctangent and rational systems are converse problems: f is made for a chosen V.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.blocks import riccati

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class System:
    """A factored system with its weights; n states, m inputs."""

    x: Any
    """SX symbol, (n, 1)."""
    A0: Array
    A: Any
    """SX, (n, n)."""
    B: Array
    Q: Array
    R: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Exact:
    """Optimum at the states that were asked for."""

    cost: Array
    """V, (samples,)."""
    control: Array
    """(samples, m)"""

    __repr__ = short_repr


SYSTEMS = ("cubic", "arctangent", "rational", "rational_split", "van_der_pol", "two_inputs")
# Where `problem` starts.
STARTS = {
    "cubic": (1.0,),
    "arctangent": (1.0, 0.5),
    "rational": (1.0, 0.5),
    "rational_split": (1.0, 0.5),
    "van_der_pol": (1.0, 1.0),
    "two_inputs": (2.0, -2.0),
}


def system(name: str = "cubic") -> System:
    """A system by its name.

    Raises:
        ProblemError: no such system.
    """
    _check(name)
    x = ca.SX.sym("x", len(STARTS[name]))
    F, B, Q = _factored(name, x)
    inputs: Any = ([x], [F])
    A0 = np.asarray(ca.Function("F", *inputs)(0.0).full())
    return System(x=x, A0=A0, A=F - ca.DM(A0), B=B, Q=Q, R=np.eye(B.shape[1]))


def exact(name: str, states: npt.ArrayLike) -> Exact:
    """Optimal cost and control in closed form.

    Args:
        name: "cubic", "arctangent", "rational" or "rational_split".
        states: (samples, n), or one state.

    Raises:
        ProblemError: no such system, or none with a closed form.
    """
    _check(name)
    x = np.asarray(states, dtype=float).reshape(-1, len(STARTS[name]))
    if name == "cubic":
        z = x[:, 0]
        s = 1.0 - z**2
        root = np.sqrt(1.0 + s**2)
        cost = 0.5 * z**2 - 0.25 * z**4 - 0.25 * (s * root + np.arcsinh(s)) + 0.25 * (np.sqrt(2.0) + np.arcsinh(1.0))
        return Exact(cost=cost, control=(-z * (s + root))[:, None])
    if name == "arctangent":
        cost = 0.5 * (x[:, 0] ** 2 * (np.pi / 2 + np.arctan(5 * x[:, 0])) + x[:, 1] ** 2)
        return Exact(cost=cost, control=-3.0 * x[:, 1:])
    if name in ("rational", "rational_split"):
        w = 1.0 + 0.5 * x[:, 0] ** 2
        return Exact(cost=0.5 * (x[:, 0] ** 2 + w * x[:, 1] ** 2), control=-(w * x[:, 1])[:, None])
    raise co.ProblemError(
        f"The optimum of {name!r} has no closed form.\n"
        "  expected: one of cubic, arctangent, rational, rational_split\n"
        f"  received: {name!r}\n"
        "  remedy:   solve problem(name)"
    )


def problem(name: str = "two_inputs", start: npt.ArrayLike | None = None, duration: float = 8.0) -> co.Problem:
    """A system as an optimal control problem with the linear regulator's cost at the end.

    Args:
        name: one of SYSTEMS.
        start: state at the start, (n,); None: STARTS[name].
        duration: long enough for the state to become small [s].

    Returns:
        The problem, with state "x" and control "u".

    Raises:
        ProblemError: no such system, or a start or duration that does not fit.
    """
    given = system(name)
    size = len(given.A0)
    initial = np.asarray(STARTS[name] if start is None else start, dtype=float).ravel()
    final = np.asarray(riccati.continuous(given.A0, given.B, given.Q, given.R))
    ocp = co.Problem(duration=duration, name=f"benchmark {name}")
    x = ocp.state("x", size, initial=initial)
    u = ocp.control("u", given.B.shape[1])
    inputs: Any = ([given.x], [given.A])
    ocp.dynamics(x, (ca.DM(given.A0) + ca.Function("A", *inputs)(x)) @ x + ca.DM(given.B) @ u)
    running = 0.5 * (ca.bilin(ca.DM(given.Q), x, x) + ca.sumsqr(u))
    ocp.minimize(running=running, terminal=0.5 * ca.bilin(ca.DM(final), x, x))
    return ocp


def _factored(name: str, x: Any) -> tuple[Any, Array, Array]:
    """F(x), B and Q."""
    if name == "cubic":
        return 1.0 - x**2, np.eye(1), np.eye(1)
    first, second = x[0], x[1]
    if name == "arctangent":
        spring = np.pi / 2 + ca.atan(5 * first) + 2.5 * first / (1 + 25 * first**2)
        return _companion(-spring, 4.0), np.array([[0.0], [3.0]]), np.diag([0.0, 1.0])
    if name == "van_der_pol":
        return _companion(-1.0, 1.0 - first**2), np.array([[0.0], [1.0]]), np.eye(2)
    if name == "two_inputs":
        return ca.blockcat([[1.0 - first**2, 1.0], [1.0, first**2 - 1.0]]), np.eye(2), np.eye(2)
    w = 1.0 + 0.5 * first**2
    damping = 0.5 * w - 0.5 / w
    if name == "rational":
        rows = _companion(-(1.0 + 0.5 * second**2) / w, damping)
    else:
        rows = _companion(-1.0 / w, damping - 0.5 * first * second / w)
    return rows, np.array([[0.0], [1.0]]), np.diag([0.0, 1.0])


def _companion(spring: Any, damping: Any) -> Any:
    return ca.blockcat([[0.0, 1.0], [spring, damping]])


def _check(name: str) -> None:
    if name not in SYSTEMS:
        raise co.ProblemError(
            "There is no such system.\n"
            f"  expected: one of {', '.join(SYSTEMS)}\n"
            f"  received: {name!r}\n"
            "  remedy:   correct the name"
        )
