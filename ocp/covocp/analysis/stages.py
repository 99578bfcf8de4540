"""The reduction interval by interval: what identifies parameters as a linear-quadratic problem of small stages.

Between the ends of a control interval everything is affine in zeta = (x, S, control at the start, at the end, 1), and
the costs are quadratic in it. Operators on whole control histories march through the stages, so that their time grows
with the number of intervals. The two ends of an interval are two values of their own: such controls contain the
piecewise linear and the piecewise constant ones, and come close to any control of finite energy as the mesh is refined.
"""

from __future__ import annotations

import numpy as np

from covocp.analysis.reduction import Reduction
from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr


@dataclass(frozen=True, kw_only=True)
class Stages:
    """n stages with xi = (x, S) of s entries and w = both ends of the control, 2 nu entries.

    Attributes:
        reduction: what they are of.
        ends: xi after a stage by zeta, (n, s, s + 2 nu + 1).
        left, right: Lambda grows by the sum over rows of (left zeta)' (right zeta), (n, rows, nb, s + 2 nu + 1).
        running: integral of the running cost = zeta' running zeta / 2, (n, s + 2 nu + 1, s + 2 nu + 1).
        energy: int u' L_uu u dt = w' energy w, (n, 2 nu, 2 nu).
        roots: their lower Cholesky factors.
    """

    reduction: Reduction
    ends: Array
    left: Array
    right: Array
    running: Array
    energy: Array
    roots: Array

    __repr__ = short_repr

    @staticmethod
    def of(reduction: Reduction) -> Stages:
        """The stages of a reduction, one for each control interval.

        Raises:
            numpy.linalg.LinAlgError: where the running cost is not strictly convex in the control.
        """
        nx, nb, nu = reduction.start.size, reduction.prior.shape[0], reduction.statement.nu
        size = nx * (1 + nb)
        columns = size + 2 * nu + 1
        unit = np.eye(columns)
        controls = (unit[size : size + nu], unit[size + nu : -1])
        filtered, collected = reduction.filtered, []
        for k in range(reduction.mesh.intervals):
            running, energy = np.zeros((columns, columns)), np.zeros((2 * nu, 2 * nu))
            left, right = [], []
            start = (unit[:nx], unit[nx:size].reshape(nx, nb, columns))
            for step in reduction.advance(k, *start, filtered, controls):
                filtered = step.filtered
                left += [weight * P for weight, P, _ in step.products]
                right += [R for _, _, R in step.products]
                for weight, z, hessian, gradient, still in step.stages:
                    running += weight * z.T @ hessian @ z
                    slope = weight * gradient @ z
                    running[-1] += slope
                    running[:, -1] += slope
                    running[-1, -1] += 2 * weight * still
                    u = z[nx:, size:-1]
                    energy += weight * u.T @ hessian[nx:, nx:] @ u
            end = np.vstack([step.x, step.S.reshape(size - nx, columns)])
            collected.append((end, np.concatenate(left), np.concatenate(right), running, energy))
        ends, lefts, rights, runs, energies = (np.array(values) for values in zip(*collected, strict=True))
        return Stages(
            reduction=reduction,
            ends=ends,
            left=lefts,
            right=rights,
            running=runs,
            energy=energies,
            roots=np.linalg.cholesky(energies),
        )

    @property
    def size(self) -> int:
        """Entries s of xi."""
        return int(self.ends.shape[1])

    def trajectory(self, w: Array) -> Array:
        """zeta at the starts of the stages, and at the end with controls of zero, (n + 1, s + 2 nu + 1)."""
        s, count = self.size, self.ends.shape[0]
        zeta = np.zeros((count + 1, self.ends.shape[2]))
        zeta[:, -1] = 1.0
        zeta[:-1, s:-1] = w
        zeta[0, : self.reduction.start.size] = self.reduction.start
        for k in range(count):
            zeta[k + 1, :s] = self.ends[k] @ zeta[k]
        return zeta

    def information(self, zeta: Array) -> Array:
        """Lambda along a trajectory, (nb, nb)."""
        left, right = (np.einsum("krbi,ki->krb", side, zeta[:-1]) for side in (self.left, self.right))
        grown = np.einsum("krb,krc->bc", left, right)
        return np.asarray(self.reduction.prior + 0.5 * (grown + grown.T))

    def weighted(self, weight: Array) -> Array:
        """tr(weight Lambda) grows by zeta' result zeta / 2 in each stage, for a symmetric weight."""
        half = np.einsum("krbi,bc,krcj->kij", self.left, weight, self.right, optimize=True)
        return np.asarray(half + half.transpose(0, 2, 1))

    def changes(self, w: Array) -> Array:
        """Changes of xi at all nodes (n + 1, s) by changes of the controls (n, 2 nu)."""
        s = self.size
        driven = np.einsum("kij,kj->ki", self.ends[:, :, s:-1], w)
        xi = np.zeros((w.shape[0] + 1, s))
        maps = self.ends[:, :, :s]
        for k in range(w.shape[0]):
            xi[k + 1] = maps[k] @ xi[k] + driven[k]
        return xi

    def slopes(self, by_xi: Array, by_w: Array) -> Array:
        """Slopes by the controls (n, 2 nu) of what has these by all nodes (n + 1, s) and directly by the controls."""
        s, count = self.size, by_w.shape[0]
        maps = self.ends[:, :, :s].transpose(0, 2, 1)
        costates = np.zeros((count, s))
        costate = by_xi[count]
        for k in range(count - 1, -1, -1):
            costates[k] = costate
            costate = by_xi[k] + maps[k] @ costate
        return np.asarray(by_w + np.einsum("kji,kj->ki", self.ends[:, :, s:-1], costates))

    def in_roots(self, slopes: Array) -> Array:
        """Slopes by the controls (n, 2 nu) as a vector in which the energy metric is that of the unit matrix."""
        return np.asarray(np.linalg.solve(self.roots, slopes[..., None])[..., 0].ravel())

    def controls(self, v: Array) -> Array:
        """Changes of the controls (n, 2 nu) of those in units of the roots."""
        return np.asarray(np.linalg.solve(self.roots.transpose(0, 2, 1), v[..., None])[..., 0])
