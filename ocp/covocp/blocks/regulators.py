"""Linear regulators: from the weights, with a filter, with a reference input or integral states."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import checked, truth
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.short_repr import short_repr
from covocp.blocks import bucy
from covocp.blocks.algebraic import CONTROL, Words, frozen, gain_of, sorted_modes, stabilising, weights
from covocp.blocks.arithmetic import apply, definite_solve, precision, symmetric
from covocp.blocks.duality import Control, dual
from covocp.blocks.scaling import scales
from covocp.blocks.steady import Filter, steady_state
from covocp.blocks.updates import row_matrix
from covocp.blocks.values import is_symbolic, matrix, numeric, restored, square, weight

Array = NDArray[np.float64]
Modes = NDArray[np.complex128]

# Largest relative error of a steady state, passes that scale its equations, and that refine their solution.
STEADY = 1e-9
EQUILIBRATIONS = 30
REFINEMENTS = 4

# What the regulator of `lqg` is called, which has a filter beside it.
GAUSSIAN = Words(
    names=("transition", "B", "state_weight", "control_weight"),
    reach=("(transition, B)", *CONTROL.reach[1:]),
    see=("(transition, state_weight^1/2)", *CONTROL.see[1:3], "state_weight gives no weight"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Regulator:
    """A linear-quadratic regulator u = -gain x; arrays are read-only.

    Args:
        gain: K, shape (m, n).
        cost: S, the Riccati solution: x'S x is the cost from x on, shape (n, n).
        eigenvalues: of A - B K, shape (n,).
    """

    gain: Array
    cost: Array
    eigenvalues: Modes

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianRegulator:
    """Regulator and filter together, u = -K x with the current estimate x; arrays are read-only.

    Args:
        regulator: K, S and the modes of Phi - Gamma K.
        filter: L, M, P and the modes of (I - L H) Phi.
        average_cost: expected x'Q1 x + u'Q2 u of one step in the long run.
        eigenvalues: of the closed loop, those of both, shape (2n,).
    """

    regulator: Regulator
    filter: Filter
    average_cost: float
    eigenvalues: Modes

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceInput:
    """Steady state in which the output is r: x = state r, u = control r.

    Args:
        state: shape (n, p).
        control: shape (m, p).
    """

    state: Array
    control: Array

    __repr__ = short_repr

    def law(self, gain: Expr) -> Array:
        """Feedforward N of u = -gain x + N r, which is u = control r - gain (x - state r), shape (m, p).

        Args:
            gain: K, shape (m, n), or (n,) for one control.

        Raises:
            ProblemError: an expression, another shape.
        """
        rows = matrix("gain", row_matrix("gain", gain, len(self.state)), (len(self.control), len(self.state)))
        return np.asarray(self.control + numeric("gain", rows) @ self.state)


@dataclass(frozen=True, kw_only=True, eq=False)
class Augmented:
    """A model with the integrals (sums) of output - r as last states.

    Args:
        A: shape (n + p, n + p).
        B: shape (n + p, m).
        reference: what r enters by, shape (n + p, p).
    """

    A: Any
    B: Any
    reference: Any

    __repr__ = short_repr


@checked(discrete=truth)
def lqr(A: Expr, B: Expr, Q: Expr, R: Expr, *, cross: Expr = None, discrete: bool = False) -> Regulator:
    """Regulator u = -K x of least cost: the integral (discrete: sum) of x'Q x + 2 x'N u + u'R u.

    Args:
        A: shape (n, n); discrete: the transition matrix.
        B: shape (n, m).
        Q: positive semidefinite, shape (n, n).
        R: positive definite, shape (m, m).
        cross: N, shape (n, m), [Q N; N' R] positive semidefinite; None: zero.
        discrete: x+ = A x + B u instead of dx/dt = A x + B u.

    Returns:
        Gain, Riccati solution and modes of the closed loop.

    Raises:
        ProblemError: expressions, shapes that do not fit, indefinite weights; (A, B) not stabilisable or (A, Q^1/2) not
            detectable: names the mode.
    """
    return _regulator(weights(A, B, Q, R, cross), discrete, CONTROL)


def _regulator(matrices: tuple[Array, ...], discrete: bool, words: Words) -> Regulator:
    """The regulator of checked matrices A, B, Q, R, N, and what the user calls them."""
    a, b, q, r, n = matrices
    cost = stabilising(a, b, q, r, n, discrete=discrete, detectable=True, words=words)
    gain = gain_of(a, b, r, n, cost, discrete=discrete)
    return Regulator(gain=frozen(gain), cost=frozen(cost), eigenvalues=sorted_modes(a - b @ gain))


def lqg(
    transition: Expr, B: Expr, H: Expr, noise: Expr, R: Expr, state_weight: Expr, control_weight: Expr
) -> GaussianRegulator:
    """Discrete regulator and steady-state filter, u_k = -K x_k with the estimate after the measurement y_k (item 6).

    Args:
        transition: Phi, shape (n, n).
        B: Gamma, shape (n, m).
        H: shape (p, n), or (n,) for one measurement.
        noise: Gamma1 R_w Gamma1', positive semidefinite, shape (n, n).
        R: R_v, positive definite, shape (p, p).
        state_weight: Q1, positive semidefinite, shape (n, n).
        control_weight: Q2, positive definite, shape (m, m).

    Returns:
        Regulator, filter, average cost tr(S noise) + tr(P K'(Q2 + Gamma'S Gamma) K), modes of the closed loop.

    Raises:
        ProblemError: as for `lqr` and `kalman.steady_state`.
    """
    matrices = weights(transition, B, state_weight, control_weight, None, GAUSSIAN)
    regulator = _regulator(matrices, True, GAUSSIAN)
    observer = steady_state(transition, H, noise, R)
    q = numeric("noise", matrix("noise", noise))
    steps = matrices[3] + matrices[1].T @ regulator.cost @ matrices[1]
    K = regulator.gain
    return GaussianRegulator(
        regulator=regulator,
        filter=observer,
        average_cost=float(np.trace(regulator.cost @ q) + np.trace(observer.posterior @ K.T @ steps @ K)),
        eigenvalues=frozen(np.sort_complex(np.concatenate([regulator.eigenvalues, observer.eigenvalues]))),
    )


def rate(S: Expr, A: Expr, B: Expr, Q: Expr, R: Expr, *, gain: Expr = None, cross: Expr = None) -> Any:
    """Rate of the cost to go: dS/dt = -(A'S + S A + Q - (S B + N) R^-1 (B'S + N')), the dual of `kalman.rate`.

    With a given gain K it is -((A - B K)'S + S (A - B K) + Q + K'R K - N K - K'N').

    Args:
        S: cost to go x'S x, shape (n, n); known at the end, to be integrated backward.
        A: shape (n, n) [1/s].
        B: shape (n, m).
        Q: positive semidefinite, shape (n, n).
        R: shape (m, m); positive definite where no gain is given.
        gain: K of u = -K x, shape (m, n); None: the best one.
        cross: N, weight of state times control, shape (n, m); None: zero.

    Returns:
        dS/dt, symmetric, shape (n, n) [1/s].

    Raises:
        ProblemError: shapes that do not fit, Q, R or [Q N; N' R] not positive semidefinite, R singular.
    """
    a = square("A", A)
    b = matrix("B", B, (a.shape[0], None))
    q, r = weight("Q", Q, a.shape[0]), weight("R", R, b.shape[1], definite=gain is None)
    end = square("S", S, a.shape[0])
    n = None if cross is None else matrix("cross", cross, b.shape)
    if n is not None and not is_symbolic(q, r, n):
        weight("[Q, cross; cross', R]", ca.blockcat([[q, n], [n.T, r]]))
    filtering = dual(Control(transition=a, input=b, state_weight=Q, control_weight=R, cross=cross))
    backward = None if gain is None else matrix("gain", gain, (b.shape[1], a.shape[0])).T
    slope = bucy.rate(
        end,
        filtering.transition,
        filtering.measurement,
        filtering.noise,
        filtering.measurement_noise,
        gain=backward,
        cross=filtering.cross,
    )
    return restored(-slope if is_symbolic(slope) else -np.atleast_2d(slope), S)


def recursion(S: Expr, A: Expr, B: Expr, Q: Expr, R: Expr) -> tuple[Any, Any]:
    """One step back of item 5: M = S - S B (R + B'S B)^-1 B'S, S_before = A'M A + Q, K = (R + B'S B)^-1 B'S A.

    Args:
        S: cost to go after the step, x'S x, positive semidefinite, shape (n, n).
        A: transition matrix, shape (n, n).
        B: shape (n, m).
        Q: positive semidefinite, shape (n, n).
        R: positive definite, shape (m, m).

    Returns:
        Cost to go before the step, shape (n, n), and the gain K of u = -K x in it, shape (m, n).

    Raises:
        ProblemError: shapes that do not fit, indefinite weights.
    """
    a = square("A", A)
    b = matrix("B", B, (a.shape[0], None))
    after, q = weight("S", S, a.shape[0]), weight("Q", Q, a.shape[0])
    r = weight("R", R, b.shape[1], definite=True)
    before, gain = apply(_step_back, after, a, b, q, r, precision=precision(S, A, B, Q, R))
    return restored(before, S), gain


def _step_back(S: Expr, A: Expr, B: Expr, Q: Expr, R: Expr) -> tuple[Any, Any]:
    """The step back in Joseph form, so that S stays positive semidefinite."""
    K = definite_solve(symmetric(R + B.T @ S @ B), B.T @ S @ A, "weight R + B'S B", "give every control some weight")
    closed = A - B @ K
    return symmetric(closed.T @ S @ closed + K.T @ R @ K + Q), K


@checked(discrete=truth)
def reference_input(A: Expr, B: Expr, output: Expr, *, discrete: bool = False) -> ReferenceInput:
    """State and control of the steady state in which output x is r.

    Args:
        A: shape (n, n).
        B: shape (n, m).
        output: shape (p, n), or (n,) for one output.
        discrete: x+ = A x + B u instead of dx/dt = A x + B u.

    Returns:
        The steady state of each unit reference; of several, the one of least norm.

    Raises:
        ProblemError: expressions, shapes that do not fit, more outputs than controls or a zero at rest: there is no
            such steady state for every r.
    """
    a = numeric("A", square("A", A))
    size = a.shape[0]
    b = numeric("B", matrix("B", B, (size, None)))
    c = numeric("output", row_matrix("output", output, size))
    count, inputs = c.shape[0], b.shape[1]
    system = np.block([[a - np.eye(size) if discrete else a, b], [c, np.zeros((count, inputs))]])
    right = np.vstack([np.zeros((size, count)), np.eye(count)])
    solution, error = _least_norm(system, right)
    if not error <= STEADY:
        raise ProblemError(
            "There is no steady state for every reference.",
            expected="as many controls as outputs, and no zero at rest",
            received=f"{inputs} controls, {count} outputs, a relative error of {error:.2g} in the best steady state",
            remedy="track fewer outputs, or use integral_states",
        )
    return ReferenceInput(state=frozen(solution[:size]), control=frozen(solution[size:]))


def _least_norm(system: Array, right: Array) -> tuple[Array, float]:
    """The solution of least norm, and the largest error of a row relative to its terms.

    Rows and columns are scaled to entries of size 1 first: which rows depend on each other does not follow from units.
    """
    if not system.size:
        return np.zeros((system.shape[1], right.shape[1])), 0.0 if not right.size else np.inf
    known = system != 0.0
    logs = np.log2(np.where(known, np.abs(system), 1.0))
    rows, columns = np.zeros(len(system)), np.zeros(system.shape[1])
    for _ in range(EQUILIBRATIONS):  # so that the mean of the logarithms is zero in each row and column
        rows = _mean(logs - columns, known, 1)
        columns = _mean(logs - rows[:, None], known, 0)
    rows, columns = np.exp2(np.round(rows)), np.exp2(np.round(columns))
    scaled = system / rows[:, None] / columns
    # each reference in a unit of its own as well: its size follows from that of its row
    wanted = right / rows[:, None]
    units = scales(np.abs(wanted).max(axis=0))
    wanted = wanted / units
    left, values, turned = np.linalg.svd(scaled)
    rank = int(np.count_nonzero(values > max(scaled.shape) * np.finfo(float).eps * values[0]))
    found = np.zeros((system.shape[1], right.shape[1]))
    for _ in range(REFINEMENTS):  # small components of a solution are known to rounding of themselves
        found += turned[:rank].T @ ((left[:, :rank].T @ (wanted - scaled @ found)) / values[:rank, None])
    terms = np.abs(scaled).sum(axis=1, keepdims=True) * np.abs(found).max(axis=0) + np.abs(wanted)
    error = np.abs(scaled @ found - wanted) / np.where(terms > 0.0, terms, 1.0)
    solution, free = found * units / columns[:, None], turned[rank:].T / columns[:, None]
    if free.size:
        solution = solution - free @ np.linalg.lstsq(free, solution, rcond=None)[0]
    return solution, float(error.max(initial=0.0))


def _mean(logs: Array, known: NDArray[np.bool_], axis: int) -> Array:
    """Means of the entries that are known, zero where there are none."""
    return np.asarray(np.where(known, logs, 0.0).sum(axis=axis) / np.maximum(known.sum(axis=axis), 1))


def integral_states(A: Expr, B: Expr, output: Expr, *, step: Expr = None) -> Augmented:
    """The model with integral states: dz/dt = output x - r, or z+ = z + step (output x - r).

    Args:
        A: shape (n, n), numbers or an expression.
        B: shape (n, m).
        output: shape (p, n), or (n,) for one output.
        step: sampling time of a discrete model [s]; None: a continuous one.

    Returns:
        The augmented model, to be given to `lqr` with a weight of the integrals.

    Raises:
        ProblemError: shapes that do not fit.
    """
    a = square("A", A)
    size = a.shape[0]
    b, c = matrix("B", B, (size, None)), row_matrix("output", output, size)
    count = c.shape[0]
    if step is not None:
        c = matrix("step", step, (1, 1)) * c
    scale = 1.0 if step is None else matrix("step", step, (1, 1))
    corner = ca.DM(count, count) if step is None else ca.DM.eye(count)
    augmented = Augmented(
        A=ca.densify(ca.blockcat([[a, ca.DM(size, count)], [c, corner]])),
        B=ca.densify(ca.vertcat(b, ca.DM(count, b.shape[1]))),
        reference=ca.densify(ca.vertcat(ca.DM(size, count), -scale * ca.DM.eye(count))),
    )
    if is_symbolic(a, b, c):
        return augmented
    return Augmented(A=augmented.A.full(), B=augmented.B.full(), reference=augmented.reference.full())
