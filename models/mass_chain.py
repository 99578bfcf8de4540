"""Chain of masses with unknown stiffness and damping: a system whose covariance grows as large as one likes.

Not in the literature; made to show how the effort grows with the size of the covariance (n = 2 masses + 2). Unit masses
in a row, the first tied to the wall; y and v are positions and velocities, the force u acts on mass 1:

    f_i = k D_i + D_i^3/2 + d dD_i/dt,   D_i = y_i - y_(i-1),  y_0 = 0   (element i, between masses i-1 and i)
    dv_i/dt = -f_i + f_(i+1) + n_i (+ u for i = 1),  f_(m+1) = 0;   measured: y_m
    means: k = 2 N/m, d = 0.3 N s/m;   densities: 0.002 (m/s^2)^2 s of every n_i, 0.01 m^2 s of the measurement
    variances at the start: 0.05 of every y_i [m^2] and v_i [(m/s)^2], 0.2 of k [(N/m)^2] and d [(N s/m)^2]
    from rest to y_m(T) = 1 m, v_m(T) = 0, the others free;   T = 10 s + (m - 1)/2 s
    J = weight (E_kk(T) + E_dd(T)) + int_0^T u^2/2 dt

Converged J for 50 intervals of constant control and one step of nominal (classical Runge-Kutta) and covariance each:

| n  | covariance step "rk4" | "gauss"      |
|----|-----------------------|--------------|
| 4  | 1.0196361700          | 1.0199952551 |
| 8  | 1.8376564176          | 1.8375579980 |
| 12 | 2.2222978530          | 2.2234033128 |
| 20 | 3.3181037202          | 3.3191543556 |
| 30 |                       | 3.8129993516 |
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co

Array = npt.NDArray[np.float64]

STIFFNESS = 2.0  # mean of k, N/m
DAMPING = 0.3  # mean of d, N s/m
CUBIC = 0.5  # N/m^3
PARAMETER_VARIANCE = 0.2  # (N/m)^2 and (N s/m)^2
INITIAL_VARIANCE = 0.05  # m^2 and (m/s)^2
PROCESS_NOISE = 0.002  # (m/s^2)^2 s
MEASUREMENT_NOISE = 0.01  # m^2 s
TARGET = 1.0  # m, of the last mass


def problem(masses: int = 1, weight: float = 20.0) -> co.Problem:
    """Chain of masses with unknown stiffness and damping, moved from rest to rest of its last mass.

    Args:
        masses: m, number of masses; the covariance has 2 m + 2 rows.
        weight: of the terminal variances of k and d [cost/(N/m)^2, cost/(N s/m)^2] (parameter "weight").

    Returns:
        The problem, with states "y" [m] and "v" [m/s], shape (m,), unknowns "k" and "d", control "u" [N], measurement
        "position" and covariance "E" of (y, v, k, d). The guess of the control is the one of least energy for the chain
        without the cubic force.

    Raises:
        ProblemError: where masses is not a positive whole number.
    """
    if isinstance(masses, bool) or not isinstance(masses, (int, np.integer)) or masses < 1:
        raise co.ProblemError(
            "The chain needs a number of masses.\n"
            "  expected: a positive whole number\n"
            f"  received: masses = {masses!r}\n"
            "  remedy:   give 1 or more"
        )
    m = int(masses)
    duration = 10.0 + 0.5 * (m - 1)  # s
    ocp = co.Problem(duration=duration, name=f"chain of {m} mass" + ("es" if m > 1 else ""))
    terminal_weight = ocp.parameter("weight", weight)
    free = [None] * (m - 1)
    y = ocp.state("y", m, initial=0.0, final=[*free, TARGET], variance=INITIAL_VARIANCE)
    v = ocp.state("v", m, initial=0.0, final=[*free, 0.0], variance=INITIAL_VARIANCE)
    k = ocp.unknown("k", mean=STIFFNESS, variance=PARAMETER_VARIANCE)
    d = ocp.unknown("d", mean=DAMPING, variance=PARAMETER_VARIANCE)
    u = ocp.control("u", guess=least_energy_control(m, duration))
    differences = ca.DM(_differences(m))
    stretch = differences @ y
    force = k * stretch + CUBIC * stretch**3 + d * (differences @ v)
    first = ca.DM(np.eye(m)[:, :1])
    ocp.dynamics(y, v)
    ocp.dynamics(v, first @ u - differences.T @ force, noise=PROCESS_NOISE)
    ocp.measurement("position", y[m - 1], noise=MEASUREMENT_NOISE, unit="m")
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=terminal_weight * (E[k, k] + E[d, d]))
    return ocp


def least_energy_control(masses: int, duration: float) -> Callable[[Array], Array]:
    """Control that moves the last mass of the chain without cubic forces from rest to its target with least energy.

    u(t) = B' exp(A' (T - t)) c, with c such that the last mass arrives, from the controllability Gramian; in the modes
    of A, which are all damped oscillations and distinct.

    Args:
        masses: m.
        duration: T [s].

    Returns:
        The control [N] as a function of s = t/T, of the shape of s.
    """
    m = masses
    D = _differences(m)
    A = np.block([[np.zeros((m, m)), np.eye(m)], [-STIFFNESS * D.T @ D, -DAMPING * D.T @ D]])
    B = np.eye(2 * m)[:, m : m + 1]
    arrival = np.eye(2 * m)[[m - 1, 2 * m - 1]]  # rows of y_m and v_m
    poles, modes = np.linalg.eig(A)
    driven = np.linalg.solve(modes, B).ravel()
    sums = poles[:, None] + poles.conj()
    gramian = np.outer(driven, driven.conj()) * np.expm1(sums * duration) / sums
    response = arrival @ modes  # of the last mass to each mode
    multiplier = np.linalg.solve((response @ gramian @ response.conj().T).real, np.array([TARGET, 0.0]))

    def control(s: Array) -> Array:
        """At the fractions s of the duration."""
        remaining = duration * (1 - np.asarray(s, dtype=float))
        return np.asarray((np.exp(remaining[..., None] * poles) * driven @ (multiplier @ response)).real)

    return control


def _differences(masses: int) -> Array:
    """Matrix of y_i - y_(i-1), y_0 = 0, shape (m, m)."""
    return np.asarray(np.eye(masses) - np.eye(masses, k=-1))
