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
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.gains import weighted
from covocp.base.matrices import Array, unpack
from covocp.base.quadrature import GAUSS_NODES, covariance_after, hermite
from covocp.base.short_repr import short_repr
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh

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

    __repr__ = short_repr


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
    M_x, (m, nx); density (m, m); running: Hessian (nz, nz), gradient at z = 0 (nz,) and value there.
    """

    rate: tuple[Array, Array]
    drift: tuple[Array, Array]
    bias: tuple[Array, Array]
    noise: Array
    state: Array
    density: Array
    running: tuple[Array, Array, Array]

    __repr__ = short_repr


def sample(given: Parts, times: Array) -> Samples:
    """Evaluate the coefficients at times of shape (K, 5) [s]."""
    z, nx = given.z, given.rate.shape[0]
    bias = given.measured[:, nx:]
    hessian, gradient = ca.hessian(given.running, z)
    affine = [(v, ca.jacobian(ca.vec(v), z)) for v in (given.rate, given.drift, bias)]
    outputs = [entry for pair in affine for entry in pair]
    outputs += [given.noise, given.measured[:, :nx], given.density, hessian, gradient]
    outputs.append(ca.substitute(given.running, z, ca.DM.zeros(z.shape[0])))
    function = ca.Function("coefficients", [z, given.time], [ca.densify(entry) for entry in outputs])
    count = times.size
    values = function.map(count)(np.zeros((z.shape[0], count)), times.reshape(1, -1))

    def shaped(value: Given, *shape: int) -> Array:
        """CasADi stores columns first: axes are reversed, then put in order behind (K, 5)."""
        numbers = np.asarray(value.full()).T.reshape(*times.shape, *shape[::-1])
        return np.asarray(np.moveaxis(numbers, range(2, numbers.ndim), range(numbers.ndim - 1, 1, -1)))

    nz, nb, m = z.shape[0], given.drift.shape[1], given.density.shape[0]
    f, fz, d, dz, b, bz, noise, state, density, hess, grad, still = values
    return Samples(
        rate=(shaped(fz, nx, nz), shaped(f, nx)),
        drift=(shaped(dz, nx, nb, nz), shaped(d, nx, nb)),
        bias=(shaped(bz, m, nb, nz), shaped(b, m, nb)),
        noise=shaped(noise, nx, nx),
        state=shaped(state, m, nx),
        density=shaped(density, m, m),
        running=(shaped(hess, nz, nz), shaped(grad, nz), shaped(still)),
    )


def resolved(statement: Statement, mesh: Mesh, parameters: Array) -> Mesh:
    """The mesh with as many substeps as Runge-Kutta steps of the nominal need, whose own may be implicit ones."""
    times = statement.duration.guess * mesh.nodes[:, None]
    slopes = sample(parts(statement, parameters), times).rate[0][:, 0, :, : statement.nx]
    fastest = float(np.abs(np.linalg.eigvals(slopes)).max(initial=0.0))
    needed = int(np.ceil(fastest * statement.duration.guess * float(np.diff(mesh.nodes).max())))
    return replace(mesh, substeps=max(mesh.substeps, needed))


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One step: everything affine in what it starts from has a last axis of columns.

    stages: (weight in the time integral, z, Hessian, gradient and value at z = 0 of the running cost). products:
    (weight, P, R) whose sum of weight P' R is what Lambda grows by; P and R are (rows, nb, columns).
    x: state at the end (nx, columns); S: (nx, nb, columns); filtered: Ebar (nx, nx).
    """

    stages: tuple[tuple[float, Array, Array, Array, float], ...]
    products: tuple[tuple[float, Array, Array], ...]
    x: Array
    S: Array
    filtered: Array

    __repr__ = short_repr


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

    def advance(self, k: int, x: Array, S: Array, filtered: Array, ends: tuple[Array, Array]) -> Iterator[Stage]:
        """The steps of control interval k.

        Args:
            k: its number.
            x: state at its start, (nx, columns), an affine map whose last column is the constant.
            S: (nx, nb, columns).
            filtered: Ebar (nx, nx).
            ends: control at its start and its end, (nu, columns) each.
        """
        per = self.mesh.substeps
        one = np.zeros(x.shape[1])
        one[-1] = 1.0
        for j in range(per):
            i = k * per + j
            controls = [ends[0] + (j + c) / per * (ends[1] - ends[0]) for c in SAMPLES]
            after, stages, slopes = self._nominal(i, x, controls, one)
            points = [
                np.vstack([hermite(x, after, *slopes, c), controls[GAUSS + g]]) for g, c in enumerate(GAUSS_NODES)
            ]
            S, filtered, products = self._filter(i, S, filtered, points, one)
            x = after
            yield Stage(stages=stages, products=products, x=x, S=S, filtered=filtered)

    def _nominal(self, i: int, x: Array, controls: list[Array], one: Array) -> tuple[Array, Any, tuple[Array, Array]]:
        """Classical Runge-Kutta step: state at the end, stages of the running cost, h times the slopes at the ends."""
        h, (slope, constant) = self.steps[i], self.samples.rate
        hessian, gradient, still = self.samples.running

        def rate(z: Array, at: int) -> Array:
            return np.asarray(slope[i, at] @ z + constant[i, at][:, None] * one)

        stages: list[tuple[float, Array, Array, Array, float]] = []
        rates: list[Array] = []
        for (weight, at), reach in zip(STAGES, (0.0, 0.5, 0.5, 1.0), strict=True):
            z = np.vstack([x + h * reach * rates[-1] if rates else x, controls[at]])
            rates.append(rate(z, at))
            stages.append((h * weight, z, hessian[i, at], gradient[i, at], float(still[i, at])))
        after = x + h * sum(weight * value for (weight, _), value in zip(STAGES, rates, strict=True))
        return after, tuple(stages), (h * rates[0], h * rate(np.vstack([after, controls[END]]), END))

    def _filter(self, i: int, S: Array, filtered: Array, points: list[Array], one: Array) -> tuple[Array, Array, Any]:
        """Gauss step of Ebar, S and Lambda, with z at the two Gauss points."""
        h, nx, shape = self.steps[i], S.shape[0], (2 * S.shape[0], *S.shape[1:])
        systems, inputs, drifts, biases, inputs_of_bias, states = [], [], [], [], [], []
        for g, z in enumerate(points, start=GAUSS):
            A, M = self.samples.rate[0][i, g][:, :nx], self.samples.state[i, g]
            F, Mb = (
                slope[i, g] @ z + constant[i, g][:, :, None] * one
                for slope, constant in (self.samples.drift, self.samples.bias)
            )
            information = weighted(M, self.samples.density[i, g])
            systems.append(np.block([[-A.T, information @ M], [self.samples.noise[i, g], A]]))
            inputs.append(np.concatenate([np.tensordot(information, Mb, 1), F]))
            inputs_of_bias.append(np.tensordot(np.linalg.inv(self.samples.density[i, g]), Mb, 1))
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
        following = covariance_after(matrix, filtered)
        S_after = end[nx:] - np.tensordot(following, end[:nx], 1)
        products = [(1.0, S_after, end[:nx])]
        for g, row in enumerate(GAUSS_MATRIX):
            at = start + h * (row[0] * K[0] + row[1] * K[1])
            products.append((-h / 2, drifts[g], at[:nx]))
            products.append((h / 2, inputs_of_bias[g], np.tensordot(states[g], at[nx:], 1) + biases[g]))
        return S_after, following, tuple(products)

    def covariance(self, u: Array) -> tuple[Array, Array, Array]:
        """Ebar(T) (nx, nx), S(T) (nx, nb) and Lambda(T) (nb, nb) of control values u, (N + 1 or N, nu)."""
        information, nb = self.prior.copy(), self.prior.shape[0]
        x, S, filtered = self.start[:, None], np.zeros((self.start.size, nb, 1)), self.filtered
        for k in range(self.mesh.intervals):
            ends = (u[k][:, None], u[k + (self.mesh.control == "linear")][:, None])
            for step in self.advance(k, x, S, filtered, ends):
                x, S, filtered = step.x, step.S, step.filtered
                for weight, P, R in step.products:
                    information += weight * P[:, :, 0].T @ R[:, :, 0]
        return filtered, S[:, :, 0], 0.5 * (information + information.T)
