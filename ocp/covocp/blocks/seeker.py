"""Peak seeking: a Kalman filter of gradient and Hessian of an unknown function, and the step to its extremum.

J. J. Ryan, J. L. Speyer, "Peak-Seeking Control Using Gradient and Hessian Estimates", ACC 2010, with the corrections of
docs/blocks/peak_seeking.md; the equations are numbered as there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from covocp.base.arguments import checked, is_number, one_of, optional, positive, truth, whole
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.matrices import half_indices, half_length, standard_deviations
from covocp.base.short_repr import short_repr
from covocp.blocks.arithmetic import beside, where
from covocp.blocks.checked_function import CheckedFunction
from covocp.blocks.eigenvalues import is_definite, symmetric_eigen
from covocp.blocks.quadratic import gradient, hessian, parameters, regressor_row, spread, transition
from covocp.blocks.square_root import factor, in_turn, triangular
from covocp.blocks.values import array, numeric, wrong_argument

Array = NDArray[np.float64]
Newton = Literal["modified", "plain", "never"]

# Positions and values beyond this count as missing: their squares would leave the range of numbers.
LARGEST = 1e30


class Memory(NamedTuple):
    """Where things are in the memory of a seeker.

    positions: of the last `window` readings, the newest first, each (n,).
    values: of these readings.
    readings: their number so far, up to one more than the window.
    point: of the expansion, (n,).
    parameters: zeta, (p,).
    factor: lower triangular L with L L' = P, column by column, (p (p + 1) / 2,).
    """

    positions: slice
    values: slice
    readings: slice
    point: slice
    parameters: slice
    factor: slice

    @classmethod
    def of(cls, inputs: int, window: int) -> Memory:
        """The layout for a number of inputs and a window."""
        size = parameters(inputs).size
        ends = np.cumsum([0, window * inputs, window, 1, inputs, size, half_length(size)]).tolist()
        return cls(*(slice(*pair) for pair in pairwise(ends)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """What is known of the function around the last position; of many memories with their axes first.

    Attributes:
        hessian: M, (n, n).
        gradient: b, (n,).
        parameters: zeta, (p,).
        covariance: of its error, (p, p), positive semidefinite.
        known: whether there was an update; before it the rest is the prior.
    """

    hessian: Array
    gradient: Array
    parameters: Array
    covariance: Array
    known: NDArray[np.bool_]

    __repr__ = short_repr

    @property
    def hessian_deviation(self) -> Array:
        """Standard deviation of each entry of the Hessian, (n, n)."""
        return np.asarray(hessian(self._deviations()))

    @property
    def gradient_deviation(self) -> Array:
        """Standard deviation of each entry of the gradient, (n,)."""
        return np.asarray(gradient(self._deviations()))

    def _deviations(self) -> Array:
        return standard_deviations(self.covariance)


@dataclass(frozen=True, kw_only=True, eq=False)
class Seeker:
    """A peak-seeking law, made by `seeker`.

    Attributes:
        inputs: n.
        window: N, number of earlier readings that each new one is compared with.
        update: casadi.Function (memory, position (n,), value) -> memory; a reading with NaN moves the point of
            expansion where the position is known, and is otherwise left out.
        step: casadi.Function (memory) -> increment of the commanded position (n,), zero before the first update.
        layout: where things are in the memory.
        start: number of differences before the first update.
    """

    inputs: int
    window: int
    update: CheckedFunction
    step: CheckedFunction
    layout: Memory
    start: int
    _initial: Array

    __repr__ = short_repr

    def law(self, start: float = 0.0) -> ca.Function:
        """Both functions in one, as `simulate_sampled` takes it.

        Args:
            start: time before which the increment is zero, while readings are taken [s].

        Returns:
            casadi.Function (memory, measured (n + 1,): position and value, t) -> (memory, increment).

        Raises:
            ProblemError: a start that is no number.
        """
        if not is_number(start):
            raise wrong_argument("start", "a time", repr(start))
        memory, t = ca.SX.sym("memory", self._initial.size), ca.SX.sym("t")
        measured = ca.SX.sym("measured", self.inputs + 1)
        new = self.update(memory, measured[: self.inputs], measured[self.inputs])
        increment = where(t >= start, self.step(new))
        names: Any = (["memory", "measured", "t"], ["memory_out", "increment"])
        return ca.Function("peak_seeking", [memory, measured, t], [new, ca.densify(increment)], *names)

    def initial(self) -> Array:
        """The memory before the first reading: prior and covariance, no readings."""
        return self._initial.copy()

    def estimate(self, memory: ArrayLike) -> Estimate:
        """What a memory says of the function.

        Args:
            memory: shape (..., size).

        Returns:
            Hessian, gradient, parameters and covariance, with the leading axes of the memory.

        Raises:
            ProblemError: another size.
        """
        numbers, layout = array("memory", memory), self.layout
        if isinstance(memory, ca.DM):
            numbers = numbers.ravel()
        if numbers.ndim < 1 or numbers.shape[-1] != self._initial.size:
            expected = f"shape (..., {self._initial.size})"
            raise wrong_argument("memory", expected, f"shape {numbers.shape}", "give what update() returned")
        zeta, size = numbers[..., layout.parameters], parameters(self.inputs).size
        rows, columns = half_indices(size)
        lower = np.zeros((*zeta.shape[:-1], size, size))
        lower[..., rows, columns] = numbers[..., layout.factor]
        return Estimate(
            hessian=hessian(zeta),
            gradient=gradient(zeta),
            parameters=zeta.copy(),
            covariance=lower @ np.swapaxes(lower, -1, -2),
            known=np.asarray(numbers[..., layout.readings][..., 0] > self.start),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Settings:
    """The arguments of `seeker`, checked."""

    inputs: int
    window: int
    noise: float
    drift_factor: Array
    start: int
    with_prior: bool
    transport: bool
    reuse: bool
    newton: str
    smallest_curvature: float
    largest_step: float | None
    descent_gain: float
    switch: float | None
    definite: bool
    sign: float
    position_noise: float

    __repr__ = short_repr


@checked(
    n=whole(1, 20),
    window=whole(1, 10**4),
    noise=positive,
    start=optional(whole(1, 10**4)),
    transport=truth,
    reuse=truth,
    newton=one_of("modified", "plain", "never"),
    smallest_curvature=optional(positive),
    largest_step=optional(positive),
    descent_gain=optional(positive),
    switch=optional(positive),
    definite=truth,
    maximum=truth,
    position_noise=lambda value: (
        "" if is_number(value) and 0 <= value <= LARGEST else f"a number from 0 to {LARGEST:g}"
    ),
)
def seeker(
    n: int,
    window: int,
    *,
    noise: float,
    drift: Expr,
    prior_covariance: Expr,
    prior: Expr = None,
    start: int | None = None,
    transport: bool = True,
    reuse: bool = True,
    newton: Newton = "modified",
    smallest_curvature: float | None = None,
    largest_step: float | None = None,
    descent_gain: float | None = None,
    switch: float | None = None,
    definite: bool = True,
    maximum: bool = False,
    position_noise: float = 0.0,
) -> Seeker:
    """Peak-seeking law for an unknown function f of n inputs, of which noisy values are measured.

    Args:
        n: number of inputs.
        window: N, number of earlier readings that each new one is compared with.
        noise: variance of one value of f, in its unit squared.
        drift: W, what the covariance of zeta gains from one reading to the next: a number (times the identity), (p,)
            (its diagonal) or (p, p). With transport it covers what is of third order in f only.
        prior_covariance: of zeta before the first update, in the same forms.
        prior: zeta at the first position, (p,); None: nothing is known, zero, and the prior covariance is the first
            update's, wherever that is.
        start: number of differences before the first update; None: 1 with a prior, p without.
        transport: whether the estimate moves with the point of expansion, (4); False: zeta is a random walk.
        reuse: whether the noise that the rows of an update have in common, and the use of each reading in up to N
            updates, are accounted for, (3); False: independent rows of variance 2 noise, used as if they were new,
            which makes the covariance too small.
        newton: "modified": eigenvalues of M by their size, at least `smallest_curvature`, (6); "plain": -M^-1 b where
            the Hessian is trusted (`switch`, `definite`), otherwise steepest descent, (5); "never": steepest descent.
        smallest_curvature: least size of an eigenvalue of M in a "modified" step, in units of f over position squared.
        largest_step: largest length of an increment, in units of position; None (not for "modified"): any.
        descent_gain: of steepest descent, increment = - gain * b; for "plain" and "never".
        switch: "plain" steps only while the smallest singular value of P is at most this; None: whatever it is.
        definite: "plain" steps only while M is positive definite (for a maximum: negative definite).
        maximum: seek a maximum of f.
        position_noise: standard deviation of each coordinate of a position that is measured, in units of position; it
            acts as noise of f by the estimated gradient.

    Returns:
        The law; its functions are scalar operations only, so they go into problems, simulations and C code.

    Raises:
        ProblemError: an argument that does not fit, a window shorter than the first update needs, `switch` or
            `definite` without newton="plain", a length or gain that the chosen step needs and does not have.
    """
    size = parameters(n).size
    covariance = numeric("prior_covariance", spread("prior_covariance", prior_covariance, size))
    zeta = np.zeros(size) if prior is None else _prior(prior, size)
    first = (size if prior is None else 1) if start is None else int(start)
    if window < first:
        raise wrong_argument(
            "window", f"at least {first}, the number of differences before the first update", f"{window}",
            f"give window={first} or more, or a prior and start=1",
        )  # fmt: skip
    _check_step(newton, smallest_curvature, largest_step, descent_gain, switch, definite)
    settings = _Settings(
        inputs=int(n),
        window=int(window),
        noise=float(noise),
        drift_factor=np.asarray(factor(numeric("drift", spread("drift", drift, size)))),
        start=first,
        with_prior=prior is not None,
        transport=bool(transport),
        reuse=bool(reuse),
        newton=newton,
        smallest_curvature=float(smallest_curvature or 0.0),
        largest_step=None if largest_step is None else float(largest_step),
        descent_gain=float(descent_gain or 0.0),
        switch=None if switch is None else float(switch),
        definite=bool(definite),
        sign=-1.0 if maximum else 1.0,
        position_noise=float(position_noise),
    )
    layout = Memory.of(settings.inputs, settings.window)
    memory = np.zeros(layout.factor.stop)
    memory[layout.parameters] = zeta
    rows, columns = half_indices(size)
    memory[layout.factor] = np.asarray(factor(covariance))[rows, columns]
    return Seeker(
        inputs=settings.inputs,
        window=settings.window,
        update=_update_function(settings, layout),
        step=_step_function(settings, layout),
        layout=layout,
        start=first,
        _initial=memory,
    )


def with_changes(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `seeker` of which some are changed; what only a plain step knows goes with it.

    Args:
        settings: arguments by name.
        changes: those that differ.

    Returns:
        All of them, without `switch` and `definite` of the settings where the step is no plain one any more.
    """
    merged = dict(settings) | dict(changes)
    if merged.get("newton", "modified") != "plain":
        for name in {"switch", "definite"} - set(changes):
            merged.pop(name, None)
    return merged


def _prior(prior: Expr, size: int) -> Array:
    """The parameters to begin with."""
    numbers = array("prior", prior)
    if numbers.size != size or not np.isfinite(numbers).all():
        raise wrong_argument("prior", f"{size} finite numbers: zeta at the first position", f"{numbers.ravel()}"[:80])
    return numbers.ravel()


def _check_step(
    newton: str,
    smallest_curvature: float | None,
    largest_step: float | None,
    descent_gain: float | None,
    switch: float | None,
    definite: bool,
) -> None:
    """What a kind of step needs, and what means nothing to it."""
    needed = {"smallest_curvature": smallest_curvature, "largest_step": largest_step}
    if newton != "modified":
        needed = {"descent_gain": descent_gain}
    for name, value in needed.items():
        if value is None:
            raise ProblemError(
                f"The step newton='{newton}' needs '{name}'.",
                expected="a finite number > 0",
                received="None",
                remedy=f"give {name}=, in the units of your function and positions",
            )
    for name, given in (("switch", switch is not None), ("definite", not definite)):
        if given and newton != "plain":
            raise ProblemError(
                f"The argument '{name}' means nothing to the step newton='{newton}'.",
                expected=f"{name}= with newton='plain' only",
                received=f"{name}={switch if name == 'switch' else definite}",
                remedy=f"leave {name}= out, or choose newton='plain'",
            )


class _Parts(NamedTuple):
    """A memory as matrices."""

    positions: Expr
    values: Expr
    readings: Expr
    point: Expr
    zeta: Expr
    lower: Expr


def _parts(memory: Expr, settings: _Settings, layout: Memory) -> _Parts:
    """A memory taken apart; positions (N, n)."""
    size = parameters(settings.inputs).size
    lower = ca.SX(size, size)
    for k, (i, j) in enumerate(zip(*half_indices(size), strict=True)):
        lower[int(i), int(j)] = memory[layout.factor.start + k]
    positions = ca.reshape(memory[layout.positions], settings.inputs, settings.window).T
    return _Parts(
        positions,
        memory[layout.values],
        memory[layout.readings],
        memory[layout.point],
        memory[layout.parameters],
        lower,
    )


def _joined(parts: _Parts) -> Expr:
    """A memory put together."""
    half = [parts.lower[int(i), int(j)] for i, j in zip(*half_indices(parts.lower.shape[0]), strict=True)]
    return ca.vertcat(ca.vec(parts.positions.T), parts.values, parts.readings, parts.point, parts.zeta, *half)


def _is_usable(reading: Expr) -> Expr:
    """1 where a number is finite and its square a number too."""
    return ca.fabs(reading) <= LARGEST


def _update_function(settings: _Settings, layout: Memory) -> CheckedFunction:
    """(memory, position, value) -> memory."""
    memory = ca.SX.sym("memory", layout.factor.stop)
    position, value = ca.SX.sym("position", settings.inputs), ca.SX.sym("value")
    old = _parts(memory, settings, layout)
    located = ca.SX(1)
    for i in range(settings.inputs):
        located = ca.logic_and(located, _is_usable(position[i]))
    there = ca.logic_and(located, _is_usable(value))
    x, f = ca.if_else(located, position, old.point), where(there, value)
    moved = _moved(old, x, settings)
    new = _updated(moved, x, f, there, settings)
    kept = _Parts(
        positions=ca.if_else(there, ca.vertcat(x.T, old.positions[:-1, :]), old.positions),
        values=ca.if_else(there, ca.vertcat(f, old.values[:-1]), old.values),
        readings=ca.fmin(old.readings + there, settings.window + 1),
        point=x,
        zeta=ca.if_else(there, new.zeta, moved.zeta),
        lower=ca.if_else(there, new.lower, moved.lower),
    )
    names: Any = (["memory", "position", "value"], ["memory_out"])
    function = ca.Function("update", [memory, position, value], [ca.densify(_joined(kept))], *names)
    return CheckedFunction(function, ("position", "value"))


def _in_motion(old: _Parts, settings: _Settings) -> Expr:
    """Whether the estimate is one at the point of the memory: from the first reading with a prior, else the update."""
    return old.readings > (0 if settings.with_prior else settings.start)


def _moved(old: _Parts, x: Expr, settings: _Settings) -> _Parts:
    """The estimate at a new point, (4) without W; F is triangular, so the factor stays so."""
    if not settings.transport:
        return old._replace(point=x)
    F = transition(where(_in_motion(old, settings), x - old.point))
    return old._replace(point=x, zeta=F @ old.zeta, lower=F @ old.lower)


def _updated(old: _Parts, x: Expr, f: Expr, there: Expr, settings: _Settings) -> _Parts:
    """W of (4), then the differences of a new reading to those in the window, one row after the other, (2) and (3)."""
    drift = ca.SX(ca.sparsify(ca.DM(settings.drift_factor))) * _in_motion(old, settings)
    lower = triangular(beside(old.lower, drift)) if drift.nnz() else old.lower
    steps, residuals = old.positions - ca.repmat(x.T, settings.window, 1), old.values - f
    rows = regressor_row(steps)
    gradient_now = gradient(old.zeta)
    noise = settings.noise + settings.position_noise**2 * ca.sumsqr(gradient_now)
    rows, residuals, variances = _independent(rows, residuals, noise, settings)
    enough = ca.logic_and(there, old.readings >= settings.start)
    used = ca.vertcat(*(ca.logic_and(enough, old.readings > j) for j in range(settings.window)))
    rows = where(ca.repmat(used, 1, rows.shape[1]), rows)
    zeta, root = in_turn(old.zeta, lower, where(used, residuals - rows @ old.zeta), rows, variances)
    return old._replace(zeta=zeta, lower=triangular(root))


def _independent(rows: Expr, values: Expr, noise: Expr, settings: _Settings) -> tuple[Expr, Expr, Expr]:
    """Rows with independent noise and their variances, (3).

    With the covariance noise (I + 1 1') the best guess of the noise of row j by those before it is their mean times
    (j - 1) / j, and 1 + 1/j is left. Row j needs the rows before it only, so a window that is not full is none other.
    """
    if not settings.reuse:
        return rows, values, 2 * noise * ca.DM.ones(settings.window)
    row_sum, value_sum = ca.SX(1, rows.shape[1]), ca.SX(1, 1)
    new_rows, new_values = [], []
    for j in range(settings.window):
        new_rows.append(rows[j, :] - row_sum / (j + 1))
        new_values.append(values[j] - value_sum / (j + 1))
        row_sum, value_sum = row_sum + rows[j, :], value_sum + values[j]
    variances = settings.window * noise * (1 + 1 / ca.DM(range(1, settings.window + 1)))
    return ca.vertcat(*new_rows), ca.vertcat(*new_values), variances


def _step_function(settings: _Settings, layout: Memory) -> CheckedFunction:
    """(memory) -> increment."""
    memory = ca.SX.sym("memory", layout.factor.stop)
    parts = _parts(memory, settings, layout)
    M, b = settings.sign * hessian(parts.zeta), settings.sign * gradient(parts.zeta)
    if settings.newton == "modified":
        step = _modified_step(M, b, settings.smallest_curvature)
    else:
        step = -settings.descent_gain * b
        if settings.newton == "plain":
            step = ca.if_else(_is_trusted(M, parts.lower, settings), _plain_step(M, b), step)
    if settings.largest_step is not None:
        length = ca.sqrt(ca.sumsqr(step))
        step = step * ca.if_else(length > settings.largest_step, settings.largest_step / length, 1)
    increment = where(parts.readings > settings.start, step)
    names: Any = (["memory"], ["increment"])
    return CheckedFunction(ca.Function("step", [memory], [ca.densify(increment)], *names))


def _modified_step(M: Expr, b: Expr, smallest: float) -> Expr:
    """(6): - Q diag(1 / max(|lambda|, smallest)) Q'b."""
    eigen = symmetric_eigen(M)
    return -eigen.vectors @ ((eigen.vectors.T @ b) / ca.fmax(ca.fabs(eigen.values), smallest))


def _plain_step(M: Expr, b: Expr) -> Expr:
    """(5): - M^-1 b; where M is singular it has no value, and `_is_trusted` has refused it."""
    eigen = symmetric_eigen(M)
    return -eigen.vectors @ ((eigen.vectors.T @ b) / ca.if_else(eigen.values == 0, 1, eigen.values))


def _is_trusted(M: Expr, lower: Expr, settings: _Settings) -> Expr:
    """Whether a plain Newton step is taken, (5): P has a singular value of at most `switch`, and M is definite."""
    trusted = is_definite(M) if settings.definite else _is_regular(M)
    if settings.switch is not None:
        excess = lower @ lower.T - settings.switch * ca.SX.eye(lower.shape[0])
        trusted = ca.logic_and(trusted, ca.logic_not(is_definite(excess)))
    return trusted


def _is_regular(M: Expr) -> Expr:
    """Whether no eigenvalue is zero."""
    values = symmetric_eigen(M).values
    regular = ca.SX(1)
    for i in range(M.shape[0]):
        regular = ca.logic_and(regular, values[i] != 0)
    return regular
