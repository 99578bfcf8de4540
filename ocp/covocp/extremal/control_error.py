"""What the piecewise form of the control costs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from covocp.base.buffered import Matrices
from covocp.base.matrices import Array, stacked
from covocp.extremal.cost_sizes import absolute_cost
from covocp.extremal.costates import discrete_costates
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import halved, refined
from covocp.extremal.hamiltonian import by_controls
from covocp.statement.interval import repeated

# A truth value for each control of each interval.
Mask = NDArray[np.bool_]

# Integrals over [0, 1] of the products of the quadratic polynomials that are 1 at one of 0, 1/2, 1 and 0 at the others.
QUADRATIC_PRODUCTS = np.array([[4.0, 2.0, -1.0], [2.0, 16.0, 2.0], [-1.0, 2.0, 4.0]]) / 30.0
# Weights of the integral over [0, 1] of a value at 0, 1/2 and 1.
SIMPSON = np.array([1.0, 4.0, 1.0]) / 6.0
# One more control value in each interval: integral of the square of what it adds over [0, 1], a hat, or a step by 1/2
# up and down; by how much more the cost falls with the best control, whose difference from the form is taken for
# s^2 - s + 1/6 (linear) or s - 1/2 (constant) in each interval.
HAT, STEP = (1.0 / 3.0, 64.0 / 15.0), (1.0 / 4.0, 4.0 / 3.0)


def estimate_control_error(extremal: Extremal, kinds: tuple[Mask, Mask], others: float) -> float | None:
    """Relative cost of the piecewise form of the control: 1/2 int H_u H_uu^-1 H_u dt.

    H_u is a quadratic polynomial through its values at both ends and in the middle of an interval. Controls at a bound
    somewhere in it count with what the Hamiltonian, quadratic in each of them, can fall between the bounds, by
    Simpson's rule. Intervals in which H_uu is not positive definite count with what the Hamiltonian is above its value
    with the control of one of their ends, by the same rule.

    All costates are those of the discrete steps: fast ones are no polynomial over an interval.

    Args:
        extremal: the solution.
        kinds: of the controls in each interval, (N, nu): free in all of it; at a bound somewhere. Others do not count.
        others: size of the cost of the rest of a chain.

    Returns:
        The share of the cost; None where H is not known pointwise, and needed.
    """
    points = extremal.mesh.points
    if points > 1:  # costates jump inside the intervals
        extremal, kinds = refined(extremal), (np.repeat(kinds[0], points, axis=0), np.repeat(kinds[1], points, axis=0))
    fine = halved(extremal)
    values = _along(extremal, fine)
    total = (_by_middles if extremal.mesh.step == "rodas" else _by_points)(extremal, fine, values, kinds)
    return None if total is None else float(total / max(absolute_cost(extremal) + others, np.finfo(float).tiny))


class _Values(NamedTuple):
    """At start, middle and end of each interval: controls, H_u (3, N, nu), H_uu (3, N, nu, nu), fall of H (3, N).

    definite: intervals in which H_uu is positive definite, (N,).
    above: by how much H is above its value with the control of one of the ends of the interval; zero where H_uu is
        positive definite in all of them.
    """

    u: Array
    slopes: Array
    curvatures: Array
    definite: Mask
    above: Array


def _along(extremal: Extremal, fine: Extremal) -> _Values:
    """The Hamiltonian at both ends and in the middle of each interval; `fine`: with the middles as nodes."""
    st, mesh, n = extremal.statement, extremal.mesh, extremal.mesh.intervals
    costates, t = discrete_costates(fine)[0], fine.trajectory
    u, h = extremal.controls, np.diff(extremal.time)
    ends = u[:-1] if mesh.control == "constant" else u[1:]
    function = Matrices(by_controls(st).map(n))
    controls = [u[:-1] + j / 2 * (ends - u[:-1]) for j in range(3)]

    def there(j: int, control: Array) -> list[Array]:
        at = slice(j, j + 2 * n - 1, 2)  # of the nodes of the halved mesh
        place = (t.e[at].T, (extremal.time[:-1] + j / 2 * h)[None, :])
        known = (*repeated(t.duration, extremal.parameters, n), costates.state[at].T, costates.matrices[at].T)
        return [stacked(v, n) for v in function.evaluated(t.x[at].T, control.T, *place, *known)]

    values, slopes, curvatures = (
        np.array(each) for each in zip(*(there(j, control) for j, control in enumerate(controls)), strict=True)
    )
    definite = np.asarray((np.linalg.eigvalsh(curvatures)[..., 0] > 0).all(axis=0))
    above = np.zeros((3, n))
    if not definite.all():
        held = [np.minimum(*(there(j, w)[0] for w in (u[:-1], ends))) for j in range(3)]
        above = values[..., 0, 0] - np.minimum(np.array(held), values)[..., 0, 0]
    return _Values(np.array(controls), slopes[..., 0], curvatures, definite, above)


def _by_points(extremal: Extremal, fine: Extremal, values: _Values, kinds: tuple[Mask, Mask]) -> float:
    """By the Hamiltonian at the ends and in the middles of the intervals."""
    st, (free, bounded) = extremal.statement, kinds
    falls = [
        np.where(bounded, _fall(*each, *st.control_bounds), 0.0).sum(axis=1)
        for each in zip(values.u, values.slopes, values.curvatures, strict=True)
    ]
    definite, slopes = values.definite, np.where(free, values.slopes, 0.0)
    curvature = np.where(definite[:, None, None], values.curvatures[1], np.eye(st.nu))
    steps = np.linalg.solve(curvature, slopes[..., None])[..., 0]
    gained = 0.5 * np.einsum("jk,jni,kni->n", QUADRATIC_PRODUCTS, slopes, steps)
    shares = np.where(definite, gained + SIMPSON @ np.array(falls), SIMPSON @ values.above)
    return float(np.diff(extremal.time) @ shares)


def _by_middles(extremal: Extremal, fine: Extremal, values: _Values, kinds: tuple[Mask, Mask]) -> float | None:
    """By what another value in the middle of each interval changes the discrete cost.

    Implicit steps that are longer than a fast state lives add up what it does, and so does their adjoint: its costate
    at a node may be off by a third, H_u with it, while slopes by control values are exact. A control that changes
    within a fraction of a step is not seen.
    """
    st, (free, bounded) = extremal.statement, kinds
    kept, definite = free | bounded, values.definite
    if not definite[kept.any(axis=1)].all():
        return None
    square, more = HAT if extremal.mesh.control == "linear" else STEP
    weights = square * np.where((h := np.diff(extremal.time)) > 0, h, 1.0)
    slopes = np.where(h[:, None] > 0, discrete_costates(fine)[1][1::2], 0.0) / weights[:, None]
    curvature = np.where(definite[:, None, None], values.curvatures[1], np.eye(st.nu))
    inside = np.where(free, slopes, 0.0)
    gained = 0.5 * np.sum(inside * np.linalg.solve(curvature, inside[..., None])[..., 0], axis=1)
    gained += np.where(bounded, _fall(values.u[1], slopes, curvature, *st.control_bounds), 0.0).sum(axis=1)
    return float(more * weights @ gained)


def _fall(u: Array, slope: Array, curvature: Array, lower: Array, upper: Array) -> Array:
    """What a function with these slopes and curvatures, (n, nu, nu), falls where entries of u move within bounds."""
    bend = np.diagonal(curvature, axis1=1, axis2=2)
    bend = np.where(bend > 0, bend, 1.0)
    move = np.clip(u - slope / bend, lower, upper) - u
    return np.asarray(np.maximum(-(slope * move + bend / 2 * move**2), 0.0))
