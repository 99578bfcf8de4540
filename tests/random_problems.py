"""Random vector-matrix problems: 1 to 4 states, 0 to 2 unknowns, noise that depends on state, control and time.

`draw(seed)` is the same problem twice: as a covocp Problem, and as plain rates with which `true_cost` integrates it
along any controls by scipy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import covocp as co

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class RandomProblem:
    """A problem, and its rates written out: (x, E, u, t, b) -> x', E', L; (x, E) -> terminal cost."""

    problem: co.Problem
    rates: ca.Function
    terminal: ca.Function
    x0: Array
    E0: Array
    mean: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class _Model:
    """The drawn numbers that make rates, noise and measurements."""

    A: Array
    B: Array
    C: Array
    nonlinear: bool
    timed: bool
    effects: tuple[tuple[int, int, Array], ...]
    noise_kind: int
    noise_sizes: Array
    noise_root: Array
    H: Array
    sensor_kind: int
    sensor_sizes: Array
    correlation: float
    direct: bool

    def rate(self, x: Any, u: Any, t: Any, b: Any) -> Any:
        """Rate of the states; b: list of unknowns."""
        nx, nu = self.B.shape
        f = ca.mtimes(ca.DM(self.A), x) + ca.mtimes(ca.DM(self.B), u)
        if self.nonlinear:
            f = f + ca.DM(self.C) * ca.sin(x[0]) * x[nx - 1]
        if self.timed:
            f = f + ca.DM(self.C) * 0.5 * ca.cos(2 * t)
        for value, (kind, j, direction) in zip(b, self.effects, strict=False):
            what = (x[j], u[j % nu], ca.tanh(x[j]), x[j] * 0.5 + 0.3 * u[0])[kind]
            f = f + ca.DM(direction) * value * what
        return f

    def noise(self, x: Any, u: Any, t: Any) -> Any:
        """Density of the process noise; None where there is none."""
        sizes = ca.DM(self.noise_sizes)
        if self.noise_kind == 0:
            return None
        if self.noise_kind == 4:
            return ca.DM(self.noise_root @ self.noise_root.T) * (1 + 0.5 * ca.tanh(x[0]))
        factor = (1.0, 1 + x[0] ** 2, 0.1 + u[0] ** 2 + ca.sin(t) ** 2)[self.noise_kind - 1]
        return ca.diag(sizes * factor)

    def measured(self, x: Any, u: Any, b: Any) -> Any:
        """What is measured."""
        h = ca.mtimes(ca.DM(self.H), x)
        if self.sensor_kind == 1:
            h = h + 0.2 * ca.sin(x[0])
        return h + 0.5 * b[0] * ca.vertcat(*([u[0]] * self.H.shape[0])) if self.direct else h

    def density(self, x: Any, t: Any) -> Any:
        """Density of the measurement noise."""
        if self.sensor_kind == 2:
            return ca.diag(ca.DM(self.sensor_sizes) * (1 + x[0] ** 2))
        if self.sensor_kind == 3 and self.sensor_sizes.size == 2:
            c = self.correlation * np.sqrt(self.sensor_sizes.prod())
            return ca.DM([[self.sensor_sizes[0], c], [c, self.sensor_sizes[1]]]) * (1 + 0.3 * ca.sin(t))
        return ca.diag(ca.DM(self.sensor_sizes))


def _draw_model(r: np.random.Generator, nx: int, nb: int, nu: int, nm: int) -> _Model:
    unstable = r.random() < 0.4
    A = r.normal(size=(nx, nx)) * 0.5 - np.eye(nx) * (0.6 if not unstable else -0.25)
    B, nonlinear, C = r.normal(size=(nx, nu)), r.random() < 0.6, r.normal(size=nx) * 0.3
    count = max(nb, 1)
    kinds, directions = r.integers(0, 4, size=count), r.normal(size=(count, nx))
    entries, timed = r.integers(0, nx, size=count), r.random() < 0.4
    noise_kind, noise_sizes = int(r.integers(0, 5)), r.uniform(0.01, 0.6, nx)
    noise_root, H, sensor_kind = r.normal(size=(nx, nx)) * 0.3, r.normal(size=(nm, nx)), int(r.integers(0, 4))
    sensor_sizes, correlation = 10 ** r.uniform(-3, 0.5, nm), float(r.uniform(-0.7, 0.7))
    return _Model(
        A=A,
        B=B,
        C=C,
        nonlinear=nonlinear,
        timed=timed,
        effects=tuple((int(k), int(j), d) for k, j, d in zip(kinds, entries, directions, strict=True))[:nb],
        noise_kind=noise_kind,
        noise_sizes=noise_sizes,
        noise_root=noise_root,
        H=H,
        sensor_kind=sensor_kind,
        sensor_sizes=sensor_sizes,
        correlation=correlation,
        direct=nb > 0 and r.random() < 0.3,
    )


def draw(seed: int) -> RandomProblem:
    """The problem of a seed."""
    r = np.random.default_rng(seed)
    nx, nb, nu, nm = int(r.integers(1, 5)), int(r.integers(0, 3)), int(r.integers(1, 3)), int(r.integers(1, 3))
    n, duration = nx + nb, float(r.uniform(0.5, 6))
    model = _draw_model(r, nx, nb, nu, nm)
    root = r.normal(size=(n, n)) * 0.4
    E0 = root @ root.T + np.diag(r.uniform(0.05, 1.0, n))
    if nb and r.random() < 0.6:
        E0[:nx, nx:] = E0[nx:, :nx] = 0
    mean, x0 = r.normal(size=nb) * 0.6, r.normal(size=nx) * 0.7
    final = np.full(nx, np.nan)
    if r.random() < 0.6:
        k = int(r.integers(1, min(nx, nu + 1) + 1))
        final[r.choice(nx, k, replace=False)] = r.normal(size=k) * 0.7
    W = r.normal(size=(n, n))
    terminal_weight = ca.DM(W @ W.T * float(10 ** r.uniform(-1, 0.7)))
    W = r.normal(size=(n, n))
    running_weight = ca.DM(W @ W.T * float(r.uniform(0, 0.5))) if r.random() < 0.5 else None
    on_final, on_state = r.random() < 0.5, float(r.uniform(0, 1))
    bounded, limit = r.random() < 0.35, float(r.uniform(1, 4))

    def running(x: Any, u: Any, E: Any) -> Any:
        cost = 0.5 * ca.sumsqr(u) + 0.5 * on_state * ca.sumsqr(x)
        return cost if running_weight is None else cost + ca.trace(ca.mtimes(running_weight, E))

    def terminal(x: Any, E: Any) -> Any:
        return ca.trace(ca.mtimes(terminal_weight, E)) + (ca.sumsqr(x - 0.5) if on_final else 0)

    ocp = co.Problem(duration=duration, name=f"random {seed}")
    x = ocp.state("x", nx, initial=x0, final=None if np.isnan(final).all() else final_values(final))
    b = [ocp.unknown(f"b{i}", mean=float(mean[i]), variance=1.0) for i in range(nb)]
    limits = (-limit, limit) if bounded else (-np.inf, np.inf)
    u = ocp.control("u", nu, lower=limits[0], upper=limits[1])
    ocp.dynamics(x, model.rate(x, u, ocp.time, b), noise=model.noise(x, u, ocp.time))
    ocp.measurement("m", model.measured(x, u, b), noise=model.density(x, ocp.time))
    E = ocp.estimation_covariance(initial=E0)
    ocp.minimize(running=running(x, u, E.matrix), terminal=terminal(x, E.matrix))
    rates, end = _written_out(model, running, terminal, (nx, nb, nu))
    return RandomProblem(problem=ocp, rates=rates, terminal=end, x0=x0, E0=E0, mean=mean)


def final_values(final: Array) -> list[float | None]:
    """Final values as a user gives them: None leaves a component free."""
    return [None if np.isnan(v) else float(v) for v in final]


def _written_out(model: _Model, running: Any, terminal: Any, sizes: tuple[int, ...]) -> tuple[ca.Function, ca.Function]:
    """The Kalman-Bucy equations in full matrices, independent of covocp's half-vectors."""
    nx, nb, nu = sizes
    x, u, t, b = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("t"), ca.SX.sym("b", nb)
    E, unknowns = ca.SX.sym("E", nx + nb, nx + nb), [b[i] for i in range(nb)]
    rate = model.rate(x, u, t, unknowns)
    z = ca.vertcat(x, b)
    F = ca.vertcat(ca.jacobian(rate, z), ca.SX.zeros(nb, nx + nb))
    M = ca.jacobian(model.measured(x, u, unknowns), z)
    Q, noise = ca.SX.zeros(nx + nb, nx + nb), model.noise(x, u, t)
    if noise is not None:
        Q[:nx, :nx] = noise
    K = ca.mtimes([E, M.T, ca.inv(ca.SX(model.density(x, t)))])
    by_t = ca.mtimes(F, E) + ca.mtimes(E, F.T) + Q - ca.mtimes([K, M, E])
    rates = ca.Function("rates", [x, E, u, t, b], [rate, by_t, running(x, u, E)])
    return rates, ca.Function("terminal", [x, E], [terminal(x, E)])


def true_cost(drawn: RandomProblem, solution: co.Solution, rtol: float = 1e-9) -> float:
    """The cost along the solution's controls by scipy's integrator, interval by interval."""
    t, u = solution.t, solution.trajectory.u
    nx, n = drawn.x0.size, drawn.E0.shape[0]
    y = np.concatenate([drawn.x0, drawn.E0.ravel(), [0.0]])
    for i in range(t.size - 1):
        after = u[i + 1] if u.shape[0] == t.size else u[i]

        def rate(time: float, y: Array, i: int = i, after: Array = after) -> Array:
            at = u[i] + (time - t[i]) / (t[i + 1] - t[i]) * (after - u[i])
            values = drawn.rates(y[:nx], y[nx:-1].reshape(n, n), at, time, drawn.mean)
            return np.concatenate([np.asarray(v.full()).ravel() for v in values])

        y = solve_ivp(rate, (t[i], t[i + 1]), y, rtol=rtol, atol=1e-11, method="DOP853").y[:, -1]
    return float(y[-1] + drawn.terminal(y[:nx], y[nx:-1].reshape(n, n)))
