"""The two benchmark systems in plain CasADi, for the peers: nothing here imports covocp.

Both have the form  dx/dt = f(x, u),  dE/dt = F E + E F' + Q - E W E  with W = M' U^-1 M constant, x(0) = 0, E(0) and
some entries of x(T) given, and minimise  tr[C E(T)] + 1/2 int u^2 dt  with a scalar control.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class System:
    """A system with its covariance; `nx` nominal states, `n` augmented states (nominal, then unknown constants)."""

    x: ca.SX  # (nx,)
    u: ca.SX  # scalar
    rate: ca.SX  # f(x, u), (nx,)
    F: ca.SX  # Jacobian of the augmented system, (n, n)
    W: Array  # M' U^-1 M, (n, n)
    Q: Array  # process noise density, (n, n)
    E0: Array  # initial covariance, (n, n)
    C: Array  # terminal weight of the covariance, (n, n)
    duration: float  # seconds
    final: dict[int, float]  # entries of x(T) that are given

    @property
    def nx(self) -> int:
        """Number of nominal states."""
        return int(self.x.numel())

    @property
    def n(self) -> int:
        """Size of the covariance."""
        return int(self.E0.shape[0])

    def terminal_states(self, x: ca.MX) -> ca.MX:
        """Select the entries of x(T) that are given."""
        return ca.vertcat(*[x[i] for i in self.final])

    def targets(self) -> list[float]:
        """Values of these entries."""
        return list(self.final.values())


def _augmented(rate: ca.SX, x: ca.SX, unknown: ca.SX, means: list[float]) -> tuple[ca.SX, ca.SX]:
    """Rate and augmented Jacobian with the unknown constants at their means."""
    top = ca.horzcat(ca.jacobian(rate, x), ca.jacobian(rate, unknown))
    F = ca.vertcat(top, ca.SX(unknown.numel(), top.shape[1]))
    at_means: list[ca.SX] = ca.substitute([rate, F], [unknown], [ca.SX(ca.DM(means))])
    return at_means[0], at_means[1]


def oscillator(damping_weight: float = 1000.0) -> System:
    """Damped oscillator with unknown damping a and stiffness b (Schmidt, section 5.4; a the damping, as in [5.4-1])."""
    x, u, unknown = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
    a, b = unknown[0], unknown[1]
    rate, F = _augmented(ca.vertcat(x[1], -b * x[0] - a * x[1] + u), x, unknown, [2.51, 3.15])
    return System(
        x=x,
        u=u,
        rate=rate,
        F=F,
        W=np.diag([1 / 0.05, 0.0, 0.0, 0.0]),
        Q=np.diag([0.0, 0.005, 0.0, 0.0]),
        E0=np.diag([0.1, 0.1, 0.2, 0.2]),
        C=np.diag([0.0, 0.0, damping_weight, 0.0]),
        duration=10.0,
        final={0: 10.0, 1: 0.0},
    )


def chain(masses: int) -> System:
    """Chain of masses with unknown stiffness k and damping d; n = 2 masses + 2."""
    m = masses
    x, u, unknown = ca.SX.sym("x", 2 * m), ca.SX.sym("u"), ca.SX.sym("p", 2)
    y, v = ca.vertsplit(x[:m]), ca.vertsplit(x[m:])
    k, d = unknown[0], unknown[1]
    forces = []
    for i in range(m):
        stretch = y[i] - (y[i - 1] if i else 0.0)
        stretch_rate = v[i] - (v[i - 1] if i else 0.0)
        forces.append(k * stretch + 0.5 * stretch**3 + d * stretch_rate)
    accelerations = [(forces[i + 1] if i + 1 < m else 0.0) - forces[i] + (u if i == 0 else 0.0) for i in range(m)]
    rate, F = _augmented(ca.vertcat(*v, *accelerations), x, unknown, [2.0, 0.3])
    n = 2 * m + 2
    measured = np.zeros((1, n))
    measured[0, m - 1] = 1.0
    return System(
        x=x,
        u=u,
        rate=rate,
        F=F,
        W=measured.T @ measured / 0.01,
        Q=np.diag([0.0] * m + [0.002] * m + [0.0, 0.0]),
        E0=np.diag([0.05] * (2 * m) + [0.2, 0.2]),
        C=np.diag([0.0] * (2 * m) + [20.0, 20.0]),
        duration=10.0 + 0.5 * (m - 1),
        final={m - 1: 1.0, 2 * m - 1: 0.0},
    )


def minimum_energy(system: System, intervals: int) -> Array:
    """Control of least energy that meets the terminal conditions of the linear part, one value an interval."""
    jacobians = ca.Function(
        "linear", [system.x, system.u], [ca.jacobian(system.rate, system.x), ca.jacobian(system.rate, system.u)]
    )
    A, B = (np.asarray(matrix) for matrix in jacobians(0, 0))
    h = system.duration / intervals
    identity = np.eye(system.nx)
    integral = h * (identity + h * A / 2 @ (identity + h * A / 3 @ (identity + h * A / 4)))
    A_step, B_step = identity + A @ integral, integral @ B
    effects = np.zeros((len(system.final), intervals))
    rows = identity[list(system.final)]
    for k in reversed(range(intervals)):
        effects[:, k] = (rows @ B_step).ravel()
        rows = rows @ A_step
    control: Array = np.linalg.pinv(effects) @ np.array(system.targets())
    return control


def at_nodes(values: Array) -> Array:
    """Node values of a control given by its mean over each interval."""
    return np.concatenate([values[:1], (values[:-1] + values[1:]) / 2, values[-1:]])
