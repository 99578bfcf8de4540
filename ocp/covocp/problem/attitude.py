"""Attitudes: states that are rotations, as the user sees them, and how they are declared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import density_matrix, is_symbolic
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, shown
from covocp.base.expressions import Given
from covocp.base.geometry import Chart
from covocp.base.matrices import Array, real_numbers
from covocp.base.short_repr import short_repr
from covocp.blocks import so3
from covocp.blocks.rotation_chart import AXES, conjugate, rotation, rotation_chart, turning
from covocp.problem.checks import as_expression, check_name
from covocp.problem.declarations import Constraint, Declarations, Dynamics, Guess, State


@dataclass(frozen=True, eq=False)
class Attitude:
    """An attitude of a problem, C = C_ba from inertial axes a to body axes b: r_b = C r_a, dC/dt = -omega^x C.

    Attributes:
        name: of the state.
        quaternion: q = (w, v) with C = (w^2 - v'v) 1 + 2 v v' - 2 w v^x, shape (4, 1), of unit length along every
            trajectory; q and -q are the same attitude.
    """

    name: str
    quaternion: ca.MX

    __repr__ = short_repr
    __array_ufunc__ = None  # an array times an attitude asks the attitude

    @property
    def matrix(self) -> ca.MX:
        """The rotation C, shape (3, 3)."""
        return ca.MX(rotation(self.quaternion))

    @property
    def vector(self) -> ca.MX:
        """The rotation vector phi of C = e^{-phi^x}, |phi| <= pi, shape (3, 1) [rad]; it jumps at half a turn."""
        return ca.MX(so3.log(self.matrix))

    def __matmul__(self, other: Given) -> ca.MX:
        """C times a vector or matrix of three rows, as `attitude.matrix @ other`.

        Raises:
            ProblemError: of another shape.
        """
        return ca.MX(ca.mtimes(self.matrix, self._factor(other, row=False)))

    def __rmatmul__(self, other: Given) -> ca.MX:
        """A row or matrix of three columns times C, as `other @ attitude.matrix`.

        Raises:
            ProblemError: of another shape.
        """
        return ca.MX(ca.mtimes(self._factor(other, row=True), self.matrix))

    def _factor(self, other: Given, *, row: bool) -> ca.MX:
        """What the rotation is multiplied with; what has one axis is a row before it, a column behind it."""
        if isinstance(other, Attitude):
            return other.matrix
        sizes = (*np.shape(other), 1, 1) if not hasattr(other, "shape") else (*other.shape, 1, 1)
        factor = as_expression(self.name, "factor", other, (int(sizes[0]), int(sizes[1])))
        if row and len(sizes) == 3:
            factor = factor.T
        if factor.shape[1 if row else 0] != 3:
            side = "columns" if row else "rows"
            raise ProblemError(
                f"The attitude '{self.name}' is multiplied with something of another shape.",
                expected=f"three {side}",
                received=f"shape {tuple(factor.shape)}",
                remedy="an attitude turns vectors of three entries",
            )
        return factor

    def error(self, reference: Given) -> ca.MX:
        """The rotation vector, in body axes, by which the attitude differs from another one, shape (3, 1) [rad].

        Args:
            reference: rotation (3, 3), quaternion (4,), another `Attitude`, or an expression of one of these shapes.

        Raises:
            ProblemError: no attitude.
        """
        other = reference.quaternion if isinstance(reference, Attitude) else as_quaternion(self.name, reference)
        return rotation_chart().difference(self.quaternion, other)

    def cosine(self, body_axis: Given, direction: Given) -> ca.MX:
        """Cosine of the angle between an axis of the body and a direction in inertial axes, a scalar.

        A pointing zone is a bound on it: `subject_to(attitude.cosine(axis, sun), upper=cos(angle))` keeps the axis out
        of a cone about the sun, `lower=` inside one.

        Args:
            body_axis: x in body axes, shape (3,), of any length.
            direction: y in inertial axes, shape (3,), of any length, numbers or an expression.

        Raises:
            ProblemError: a vector of another shape, of length zero, NaN.
        """
        axis, target = (_unit(self.name, *pair) for pair in (("body axis", body_axis), ("direction", direction)))
        return ca.MX(ca.dot(axis, self.matrix @ target))


def with_attitude(
    own: Declarations,
    name: str,
    *,
    where: str,
    initial: Given,
    final: Given,
    rate: Given,
    guess: Guess,
    variance: Given,
    noise: Given,
) -> tuple[Declarations, Attitude]:
    """The declarations with one more attitude, and what the user sees of it; arguments as of `Problem.attitude`."""
    chart = rotation_chart()
    symbol = ca.MX.sym(name, chart.size)
    free = ca.MX(ca.DM.nan(chart.size, 1))
    first = free if initial is None else as_quaternion(name, initial, "initial attitude")
    known = _numbers(own, first)
    if not first.is_constant() and np.isfinite(known).all():  # of q and -q the one that the guess begins with
        first = ca.if_else(ca.dot(first, known) < 0, -first, first)
    target = None if final is None else as_quaternion(name, final, "final attitude")
    state = State(
        name=name,
        symbol=symbol,
        size=chart.size,
        where=where,
        unit="rad",
        initial=first,
        final=free,
        lower=np.full(chart.size, -np.inf),
        upper=np.full(chart.size, np.inf),
        guess=_guess(own, name, guess, first, target),
        scale=np.ones(chart.size),
        variance=density_matrix(name, "variance", 0.0 if variance is None else variance, AXES),
        chart=chart,
        target=target,
    )
    density = None if noise is None else density_matrix(name, "noise density", noise, AXES)
    omega = as_expression(name, "angular velocity", rate, (AXES, 1))
    moves = Dynamics(rate=turning(symbol, omega), noise=density, where=where, one_density=False)
    declared = own.adding(states=state, rates={name: moves})
    for constraint in _ends(chart, state, initial is None):
        check_name(constraint.name, list(own.named))
        declared = declared.adding(constraints=constraint)
    return declared, Attitude(name, symbol)


def _ends(chart: Chart, state: State, free_start: bool) -> list[Constraint]:
    """A free attitude begins as a unit quaternion; at the end, the vector part of the relative quaternion is zero.

    Its scalar part is then 1 or -1, the same attitude: half a turn away the vector part is not zero but of length 1,
    unlike the antisymmetric part of the relative rotation, which vanishes there.
    """
    limits: list[Constraint] = []
    zeros, q = np.zeros(AXES), state.symbol
    common: dict[str, Any] = {"where": state.where}
    if free_start:
        one = np.ones(1)
        length = ca.sumsqr(q)
        limits.append(
            Constraint(name=f"length of {state.name}", expression=length, lower=one, upper=one, at="initial", **common)
        )
    if state.target is not None:
        relative = so3.quaternion_product(conjugate(state.target), q)[1:] / ca.norm_2(q)
        limits.append(
            Constraint(
                name=f"final {state.name}", expression=2 * relative, lower=zeros, upper=zeros, at="final", **common
            )
        )
    return limits


def as_quaternion(name: str, value: Given, what: str = "attitude") -> ca.MX:
    """An attitude as a column of four, of unit length where it is given as numbers.

    Raises:
        ProblemError: neither a rotation (3, 3) nor a quaternion (4,).
    """
    symbolic = is_symbolic(value)
    try:
        value = value if symbolic else real_numbers(value)
        shape = tuple(value.shape)
        if shape == (3, 3):
            return ca.MX(ca.densify(ca.MX(_column(so3.to_quaternion(value)))))
        if shape in ((4,), (4, 1)):
            if symbolic:
                return ca.MX(value) / ca.norm_2(value)
            numbers = value.ravel()
            so3.from_quaternion(numbers)
            return ca.MX(ca.DM(numbers / np.linalg.norm(numbers)))
        received = f"shape {shape}"
    except (TypeError, ValueError, OverflowError) as error:  # a ProblemError among them
        received = error.received if isinstance(error, ProblemError) else shown(value)
    raise ProblemError(
        f"The {what} of '{name}' is no attitude.",
        expected="a rotation, shape (3, 3), or a unit quaternion (w, v), shape (4,); of an initial or a final attitude "
        "also None: free",
        received=received,
        remedy="make one by so3.exp (of a rotation vector), so3.principal or so3.project",
    )


def _column(value: Given) -> Any:
    return value if is_symbolic(value) else ca.DM(np.asarray(value))


def _unit(name: str, what: str, value: Given) -> Any:
    """A direction as a column of unit length."""
    if is_symbolic(value):
        return as_expression(name, what, value, (3, 1)) / ca.norm_2(value)
    try:
        numbers = real_numbers(value).ravel()
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    length = float(np.linalg.norm(numbers)) if numbers.shape == (3,) else np.nan
    if not np.isfinite(length) or length == 0.0:
        raise ProblemError(
            f"The {what} that '{name}' points with is no direction.",
            expected="three finite numbers that are not all zero",
            received=shown(value),
            remedy=f"correct the {what}",
        )
    return ca.DM(numbers / length)


def _guess(own: Declarations, name: str, guess: Guess, first: ca.MX, target: ca.MX | None) -> Guess:
    """Where a solver starts, as quaternions: what the user gives, else the shortest way between the ends.

    Without a final attitude it is simulated: the attitude turns as the controls make it; where both are free it stands.
    """
    start = _numbers(own, first)
    if guess is None and target is None:
        return np.array([1.0, 0.0, 0.0, 0.0]) if np.isnan(start).any() else None
    if callable(guess):
        return lambda s: _quaternions(name, _evaluated(guess, s), start)
    if guess is not None:
        return _quaternions(name, guess, start)
    assert target is not None
    end = _numbers(own, target)
    if np.isnan(end).any():
        return None if np.isfinite(start).all() else np.array([1.0, 0.0, 0.0, 0.0])
    return geodesic(end if np.isnan(start).any() else start, end)


def _evaluated(guess: Callable[[Any], Any], s: Given) -> Any:
    """Attitudes at some places, by a function of all of them, or of one."""
    places = np.atleast_1d(s)
    try:
        values = real_numbers(guess(places))
        if values.shape[:1] == places.shape and values.ndim > 1:
            return values
    except (TypeError, ValueError, OverflowError):
        pass
    return np.array([real_numbers(guess(float(c))) for c in places])


def _numbers(own: Declarations, value: ca.MX) -> Array:
    """An end with parameters as declared and decisions at their guesses; NaN where it has other symbols."""
    decided = [state for state in own.states if state.role == "decision"]
    symbols = [*(entry.symbol for entry in own.parameters), *(state.symbol for state in decided)]
    if {s.__hash__() for s in ca.symvar(value)} - {s.__hash__() for s in symbols}:
        return np.full(value.shape[0], np.nan)
    guesses: list[Any] = [state.guess for state in decided]
    numbers = [ca.DM(v) for v in (*(entry.value for entry in own.parameters), *guesses)]
    return np.asarray(ca.Function("end", symbols, [value]).call(numbers)[0].full()).ravel()


def geodesic(start: Array, end: Array) -> Callable[[Any], Array]:
    """The shortest way from one quaternion to another as a function of s in [0, 1], at rest at both ends: (K, 4)."""
    turn = so3.log(so3.from_quaternion(end) @ so3.from_quaternion(start).T)

    def path(s: Any) -> Array:
        share = np.clip(np.atleast_1d(s), 0.0, 1.0)
        smooth = share**2 * (3.0 - 2.0 * share)
        return np.asarray(so3.quaternion_step(np.tile(start, (share.size, 1)), smooth[:, None] * turn))

    return path


def _quaternions(name: str, values: Given, start: Array) -> Array:
    """Guessed attitudes, one or several, rotations or quaternions, as quaternions without jumps of sign, (K, 4).

    Raises:
        ProblemError: no attitudes.
    """
    try:
        given = real_numbers(values)
        if given.shape[-2:] == (3, 3):
            given = so3.to_quaternion(given)
        if given.shape[-1:] != (4,) or given.ndim > 2:
            raise ValueError(f"shape {given.shape}")
        so3.from_quaternion(given)
    except (TypeError, ValueError, OverflowError) as error:  # a ProblemError is a ValueError
        raise ProblemError(
            f"The guess of '{name}' is no course of attitudes.",
            expected="attitudes over the nodes: rotations (K, 3, 3), unit quaternions (K, 4), one of them, or a "
            "function of s = t/T in [0, 1] that returns one or as many as s has entries",
            received=error.received if isinstance(error, ProblemError) else str(error),
            remedy=f"correct the guess of '{name}', or leave it out: the shortest way between the ends is taken",
        ) from error
    rows = np.atleast_2d(given) / np.linalg.norm(np.atleast_2d(given), axis=1)[:, None]
    reference = rows[0] if np.isnan(start).any() else start
    signs = np.where(np.concatenate([[rows[0] @ reference], np.sum(rows[1:] * rows[:-1], axis=1)]) < 0, -1.0, 1.0)
    rows = rows * np.cumprod(signs)[:, None]
    return np.asarray(rows[0] if given.ndim == 1 else rows)
