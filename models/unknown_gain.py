"""Integrator with an unknown gain and no measurement: how far the state is moved says how uncertain it becomes.

G. T. Schmidt, Sc.D. thesis, M.I.T. 1971, section 3.5. The source gives no numbers; the defaults are chosen here. [x]
and [u] are the units of state and control.

    dx/dt = b u + n,   <n n'> = q delta,   x(0) = 0 known exactly,   b unknown
    J = E_xx(T) + int_0^T c u^2/2 dt,      x(T) given

Errata: [3.5-12] lacks P11 q and [3.5-13] lacks 2 P11 E12. [3.5-17] mixes the costate of the matrix (dP12/dt = -u P11)
with that of the half-vector (twice that); with either used throughout, du/dt = 0. So the optimal control is constant,
and neither [3.5-25] nor the u = k x(T) exp(k t) / (b (exp(k T) - 1)), k = 2 sigma_b^2 / c, of the source's correction
sheet is optimal. E_xx(T) is the same for every control that reaches x(T).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Exact:
    """The solution in closed form; histories have the shape of `t`."""

    t: Array
    """[s]"""
    x: Array
    """[x]"""
    u: Array
    """[u]"""
    E_xx: Array
    """[x^2]"""
    E_xb: Array
    E_bb: Array
    p: Array
    """Costate of x, constant."""
    ell: float
    """Multiplier of x(T), equal to p(T)."""
    cost: float

    __repr__ = short_repr


def problem(
    gain: float = 1.0,
    gain_variance: float = 0.5,
    control_weight: float = 1.0,
    noise: float = 0.1,
    final: float = 1.0,
    duration: float = 1.0,
) -> co.Problem:
    """Integrator with unknown gain, without measurement, Schmidt [3.5].

    Args:
        gain: mean of b [x/u/s], not zero.
        gain_variance: variance of b [(x/u/s)^2].
        control_weight: c [x^2/u^2/s] (parameter "control_weight").
        noise: q, power spectral density of the process noise [x^2/s].
        final: x(T) [x].
        duration: T [s].

    Returns:
        The problem, with state "x", unknown "b", control "u" and the covariance "E" of (x, b).

    Raises:
        ProblemError: where a variance or density is negative, or the duration not positive.
    """
    ocp = co.Problem(duration=duration, name="integrator, unknown gain")
    weight = ocp.parameter("control_weight", control_weight)
    x = ocp.state("x", initial=0.0, final=final, variance=0.0)
    b = ocp.unknown("b", mean=gain, variance=gain_variance)
    u = ocp.control("u")
    ocp.dynamics(x, b * u, noise=noise)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * weight * u**2, terminal=E[x, x])
    return ocp


def exact(
    gain: float = 1.0,
    gain_variance: float = 0.5,
    control_weight: float = 1.0,
    noise: float = 0.1,
    final: float = 1.0,
    duration: float = 1.0,
    t: npt.ArrayLike | None = None,
) -> Exact:
    """Closed-form solution, Schmidt [3.5] corrected: u = x(T) / (b T).

    Args:
        gain: mean of b [x/u/s], not zero.
        gain_variance: variance of b [(x/u/s)^2].
        control_weight: c > 0 [x^2/u^2/s].
        noise: q [x^2/s].
        final: x(T) [x].
        duration: T [s].
        t: times in [0, T], any shape; 101 of them by default.

    Returns:
        Histories, multiplier and cost.
    """
    times = np.asarray(np.linspace(0.0, duration, 101) if t is None else t, dtype=float)
    u = final / (gain * duration)
    costate = -control_weight * u / gain - 2 * gain_variance * final / gain**2
    return Exact(
        t=times,
        x=gain * u * times,
        u=np.full(times.shape, u),
        E_xx=noise * times + gain_variance * (u * times) ** 2,
        E_xb=gain_variance * u * times,
        E_bb=np.full(times.shape, float(gain_variance)),
        p=np.full(times.shape, costate),
        ell=costate,
        cost=noise * duration + gain_variance * (final / gain) ** 2 + 0.5 * control_weight * u**2 * duration,
    )
