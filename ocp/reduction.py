"""Identification of constant parameters reduced to their information: Lambda is a quadratic form of the control.

With nominal dynamics affine in state and control, parameter columns F12 and M_b affine in them, and no correlation of
state and parameters at the start (specification, section 5; N = M_x S + M_b generalises it to measured parameters):

    d Ebar/dt = A Ebar + Ebar A' + Q - Ebar M_x' U^-1 M_x Ebar          (parameters known; does not depend on u)
    d S/dt = A S + F12 - Ebar M_x' U^-1 N                               (affine in u)
    Lambda(T) = Lambda_0 + int_0^T N' U^-1 N dt                         (quadratic in u)
    E_bb = Lambda^-1,  E_xb = S Lambda^-1,  E_xx = Ebar + S Lambda^-1 S'

Steps are those of the covariance step gauss, written for the linear system behind the Riccati equation, E = Y X^-1:
one step from (X, Y) = (0, S) with the inputs (M_x' U^-1 M_b, F12) to (X+, Y+) gives S+ = Y+ - Ebar+ X+, and Lambda
grows by S+' X+ + int (M_b' U^-1 (M_x Y + M_b) - F12' X) dt. They stay accurate where M_x' U^-1 M_x is stiff, and what
they make of Lambda is still exactly quadratic in the values of the control.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from covocp.integrators import GAUSS_NODES, hermite
from covocp.matrices import Array, unpack
from covocp.mesh import Mesh
from covocp.statement import Statement

# Coefficients of the two-stage Gauss method; the weights of both stages are 1/2.
GAUSS_MATRIX = ((0.25, 0.25 - np.sqrt(3.0) / 6.0), (0.25 + np.sqrt(3.0) / 6.0, 0.25))
# Times within a step: both ends and the middle (Runge-Kutta of the nominal), then the two Gauss points.
SAMPLES = (0.0, 0.5, 1.0, *GAUSS_NODES)
START, MIDDLE, END, GAUSS = 0, 1, 2, 3
# Weights of the running cost at the stages of classical Runge-Kutta, and the samples where these lie.
STAGES = ((1 / 6, START), (1 / 3, MIDDLE), (1 / 3, MIDDLE), (1 / 6, END))


@dataclass(frozen=True, kw_only=True)
class Parts:
    """What the reduction is made of, as expressions in z = (state, control) and time; b: the unknown parameters.

    rate (nx), drift: d rate/db (nx, nb), noise (nx, nx), measured: M_x and M_b side by side (m, nx + nb), density U
    (m, m), running: its cost.
    """

    z: Any
    time: Any
    rate: Any
    drift: Any
    noise: Any
    measured: Any
    density: Any
    running: Any


def parts(statement: Statement, parameters: Array) -> Parts:
    """The expressions of a statement with a nominal, one estimation covariance and measurements.

    Args:
        statement: the problem.
        parameters: values of known parameters and means of unknowns, shape (np,).
    """
    if statement.nominal is None or statement.measurement is None or statement.riccati[0] is None:
        raise ValueError("the reduction needs a separate nominal, measurements and an estimation covariance")
    symbolic: Any = statement.symbolic
    nx = statement.nx
    z, time = symbolic.sym("z", nx + statement.nu), symbolic.sym("t")
    arguments = [z[:nx], z[nx:], time, symbolic(statement.duration.guess), symbolic(ca.DM(parameters))]
    rate, running = statement.nominal.call(arguments, True, False)
    drift, noise, _ = statement.riccati[0].call(arguments, True, False)
    _, measured, density = statement.measurement.call(arguments, True, False)
    return Parts(
        z=z,
        time=time,
        rate=rate,
        drift=drift[:nx, nx:],
        noise=noise[:nx, :nx],
        measured=measured,
        density=density,
        running=running,
    )


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Coefficients at all steps and samples, leading axes (K, 5); affine functions of z as slope @ z + constant.

    rate (nx, nz) and (nx,); drift (nx, nb, nz) and (nx, nb); bias: M_b, (m, nb, nz) and (m, nb); noise (nx, nx); state:
    M_x, (m, nx); density (m, m); running: Hessian (nz, nz) and gradient at z = 0 (nz,).
    """

    rate: tuple[Array, Array]
    drift: tuple[Array, Array]
    bias: tuple[Array, Array]
    noise: Array
    state: Array
    density: Array
    running: tuple[Array, Array]


def sample(given: Parts, times: Array) -> Samples:
    """Evaluate the coefficients at times of shape (K, 5) [s]."""
    z, nx = given.z, given.rate.shape[0]
    bias = given.measured[:, nx:]
    hessian, gradient = ca.hessian(given.running, z)
    affine = [(v, ca.jacobian(ca.vec(v), z)) for v in (given.rate, given.drift, bias)]
    outputs = [entry for pair in affine for entry in pair]
    outputs += [given.noise, given.measured[:, :nx], given.density, hessian, gradient]
    function = ca.Function("coefficients", [z, given.time], [ca.densify(entry) for entry in outputs])
    count = times.size
    values = function.map(count)(np.zeros((z.shape[0], count)), times.reshape(1, -1))

    def shaped(value: Any, *shape: int) -> Array:
        """CasADi stores columns first: axes are reversed, then put in order behind (K, 5)."""
        numbers = np.asarray(value.full()).T.reshape(*times.shape, *shape[::-1])
        return np.asarray(np.moveaxis(numbers, range(2, numbers.ndim), range(numbers.ndim - 1, 1, -1)))

    nz, nb, m = z.shape[0], given.drift.shape[1], given.density.shape[0]
    f, fz, d, dz, b, bz, noise, state, density, hess, grad = values
    return Samples(
        rate=(shaped(fz, nx, nz), shaped(f, nx)),
        drift=(shaped(dz, nx, nb, nz), shaped(d, nx, nb)),
        bias=(shaped(bz, m, nb, nz), shaped(b, m, nb)),
        noise=shaped(noise, nx, nx),
        state=shaped(state, m, nx),
        density=shaped(density, m, m),
        running=(shaped(hess, nz, nz), shaped(grad, nz)),
    )


@dataclass(frozen=True, kw_only=True)
class Step:
    """One step: everything affine in the control values has a last axis of columns.

    x: state at the start (nx, columns). stages: (weight in the time integral, z, Hessian and gradient of the running
    cost). products: (weight, P, R) whose sum of weight P' R is what Lambda grows by; P and R are (rows, nb, columns).
    interval: number of the control interval, where the step is its first one; else None.
    """

    x: Array
    stages: tuple[tuple[float, Array, Array, Array], ...]
    products: tuple[tuple[float, Array, Array], ...]
    interval: int | None


@dataclass(frozen=True, kw_only=True)
class Last:
    """At the end: x (nx, columns), S (nx, nb, columns), Ebar (nx, nx)."""

    x: Array
    S: Array
    filtered: Array


class Reduction:
    """The reduction of a statement on a mesh.

    Args:
        statement: the problem; the conditions of the theory are not checked here.
        mesh: nodes, control and substeps; steps are gauss steps whatever its own are.
        parameters: values of known parameters and means of unknowns, shape (np,).
    """

    def __init__(self, statement: Statement, mesh: Mesh, parameters: Array) -> None:
        """Evaluate the coefficients along the mesh."""
        self.statement, self.mesh, self.parameters = statement, mesh, parameters
        given = parts(statement, parameters)
        starts = mesh.nodes[:-1, None] + np.diff(mesh.nodes)[:, None] * np.arange(mesh.substeps) / mesh.substeps
        duration = statement.duration.guess
        self.steps = duration * np.repeat(np.diff(mesh.nodes) / mesh.substeps, mesh.substeps)
        self.samples = sample(given, duration * starts.ravel()[:, None] + self.steps[:, None] * np.array(SAMPLES))
        self.start, _, half, _ = statement.boundary_values(parameters)
        size, nx = statement.matrices[0].size, statement.nx
        initial = unpack(half, size)
        self.filtered, self.prior = initial[:nx, :nx], np.linalg.inv(initial[nx:, nx:])

    @property
    def size(self) -> int:
        """Number of control values V."""
        return self.mesh.control_nodes * self.statement.nu

    def values(self, k: int, c: float, u: Array | None) -> Array:
        """The control at the fraction c of interval k: its values (nu, 1), or its map (nu, V + 1) of (u, 1)."""
        nu, linear = self.statement.nu, self.mesh.control == "linear"
        weights = ((k, 1 - c), (k + 1, c)) if linear else ((k, 1.0),)
        if u is not None:
            return np.asarray(sum(weight * u[node] for node, weight in weights))[:, None]
        result = np.zeros((nu, self.size + 1))
        for node, weight in weights:
            result[np.arange(nu), node * nu + np.arange(nu)] = weight
        return result

    def march(self, u: Array | None = None) -> Iterator[Step | Last]:
        """The steps one after the other, then the end.

        Args:
            u: control values, shape (N + 1 or N, nu), for one column with their trajectory; None: V + 1 columns, the
                affine map of (control values, 1).
        """
        columns = 1 if u is not None else self.size + 1
        nx, nb, per = self.statement.nx, self.prior.shape[0], self.mesh.substeps
        one = np.zeros(columns)
        one[-1] = 1.0
        x = self.start[:, None] * one
        S, filtered = np.zeros((nx, nb, columns)), self.filtered
        for i in range(self.steps.size):
            k, j = divmod(i, per)
            controls = [self.values(k, (j + c) / per, u) for c in SAMPLES]
            after, stages, slopes = self._nominal(i, x, controls, one)
            points = [
                np.vstack([hermite(x, after, *slopes, c), controls[GAUSS + g]]) for g, c in enumerate(GAUSS_NODES)
            ]
            S, filtered, products = self._filter(i, S, filtered, points, one)
            yield Step(x=x, stages=stages, products=products, interval=None if j else k)
            x = after
        yield Last(x=x, S=S, filtered=filtered)

    def _nominal(self, i: int, x: Array, controls: list[Array], one: Array) -> tuple[Array, Any, tuple[Array, Array]]:
        """Classical Runge-Kutta step: state at the end, stages of the running cost, h times the slopes at the ends."""
        h, (slope, constant) = self.steps[i], self.samples.rate
        hessian, gradient = self.samples.running

        def rate(z: Array, at: int) -> Array:
            return np.asarray(slope[i, at] @ z + constant[i, at][:, None] * one)

        stages: list[tuple[float, Array, Array, Array]] = []
        rates: list[Array] = []
        for (weight, at), reach in zip(STAGES, (0.0, 0.5, 0.5, 1.0), strict=True):
            z = np.vstack([x + h * reach * rates[-1] if rates else x, controls[at]])
            rates.append(rate(z, at))
            stages.append((h * weight, z, hessian[i, at], gradient[i, at]))
        after = x + h * sum(weight * value for (weight, _), value in zip(STAGES, rates, strict=True))
        return after, tuple(stages), (h * rates[0], h * rate(np.vstack([after, controls[END]]), END))

    def _filter(self, i: int, S: Array, filtered: Array, points: list[Array], one: Array) -> tuple[Array, Array, Any]:
        """Gauss step of Ebar, S and Lambda, with z at the two Gauss points."""
        h, nx, shape = self.steps[i], S.shape[0], (2 * S.shape[0], *S.shape[1:])
        systems, inputs, drifts, biases, weighted, states = [], [], [], [], [], []
        for g, z in enumerate(points, start=GAUSS):
            A, M = self.samples.rate[0][i, g][:, :nx], self.samples.state[i, g]
            F, Mb = (
                slope[i, g] @ z + constant[i, g][:, :, None] * one
                for slope, constant in (self.samples.drift, self.samples.bias)
            )
            information = np.linalg.solve(self.samples.density[i, g], M).T  # M_x' U^-1
            systems.append(np.block([[-A.T, information @ M], [self.samples.noise[i, g], A]]))
            inputs.append(np.concatenate([np.tensordot(information, Mb, 1), F]))
            weighted.append(np.tensordot(np.linalg.inv(self.samples.density[i, g]), Mb, 1))
            drifts.append(F)
            biases.append(Mb)
            states.append(M)
        first, second = systems
        (a11, a12), (a21, a22) = GAUSS_MATRIX
        unit = np.eye(2 * nx)
        left = np.block([[unit - h * a11 * first, -h * a12 * first], [-h * a21 * second, unit - h * a22 * second]])
        start = np.concatenate([np.zeros_like(S), S])
        inverse = np.linalg.inv(left)
        free = inverse @ np.vstack(systems)
        matrix = unit + h / 2 * (free[: 2 * nx] + free[2 * nx :])
        K = (np.tensordot(free, start, 1) + np.tensordot(inverse, np.concatenate(inputs), 1)).reshape(2, *shape)
        end = start + h / 2 * (K[0] + K[1])
        below, above = (matrix[rows, :nx] + matrix[rows, nx:] @ filtered for rows in (slice(nx, None), slice(nx)))
        following = np.linalg.solve(above.T, below.T)
        following = 0.5 * (following + following.T)
        S_after = end[nx:] - np.tensordot(following, end[:nx], 1)
        products = [(1.0, S_after, end[:nx])]
        for g, row in enumerate(GAUSS_MATRIX):
            at = start + h * (row[0] * K[0] + row[1] * K[1])
            products.append((-h / 2, drifts[g], at[:nx]))
            products.append((h / 2, weighted[g], np.tensordot(states[g], at[nx:], 1) + biases[g]))
        return S_after, following, tuple(products)

    def covariance(self, u: Array) -> tuple[Array, Array, Array]:
        """Ebar(T) (nx, nx), S(T) (nx, nb) and Lambda(T) (nb, nb) of control values u, (N + 1 or N, nu)."""
        information = self.prior.copy()
        for step in self.march(u):
            if isinstance(step, Last):
                return step.filtered, step.S[:, :, 0], 0.5 * (information + information.T)
            for weight, P, R in step.products:
                information += weight * P[:, :, 0].T @ R[:, :, 0]
        raise AssertionError("the march ends with the end")

    def forms(self, weight: Array) -> Forms:
        """All quadratic forms of the control values, with tr(weight Lambda(T)) for a symmetric weight (nb, nb)."""
        size = self.size + 1
        information, running, energy = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
        slope = np.zeros(size)
        nodes, nx = [], self.statement.nx
        for step in self.march():
            if isinstance(step, Last):
                break
            pairs = [(w * np.einsum("abi,bc->aci", P, weight), R) for w, P, R in step.products]
            left, right = (np.concatenate([pair[n].reshape(-1, size) for pair in pairs]) for n in (0, 1))
            information += left.T @ right
            for w, z, hessian, gradient in step.stages:
                running += w * z.T @ hessian @ z
                slope += w * gradient @ z
                energy += w * z[nx:].T @ hessian[nx:, nx:] @ z[nx:]
            if step.interval is not None:
                nodes.append(step.x)
        nodes.append(step.x)
        return Forms(
            information=information + information.T, running=running, slope=slope, energy=energy, nodes=np.array(nodes)
        )


@dataclass(frozen=True, kw_only=True)
class Forms:
    """Quadratic forms of w = (control values, 1), V + 1 entries.

    Attributes:
        information: tr(weight (Lambda - Lambda_0)) = w' information w / 2.
        running: integral of the running cost = w' running w / 2 + slope w + constant.
        slope: its linear part.
        energy: int u' L_uu u dt = w' energy w.
        nodes: x at the nodes as maps of w, shape (N + 1, nx, V + 1).
    """

    information: Array
    running: Array
    slope: Array
    energy: Array
    nodes: Array
