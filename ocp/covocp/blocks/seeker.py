"""Peak seeking: a Kalman filter of gradient and Hessian of an unknown function, and the step to its extremum.

J. J. Ryan, J. L. Speyer, "Peak-Seeking Control Using Gradient and Hessian Estimates", ACC 2010, with the corrections of
docs/blocks/peak_seeking.md; the equations are numbered as there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from covocp.base.arguments import checked, is_number, one_of, optional, positive, truth, whole
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.matrices import half_indices, standard_deviations
from covocp.base.short_repr import short_repr
from covocp.blocks.arithmetic import where
from covocp.blocks.checked_function import CheckedFunction
from covocp.blocks.differences import LARGEST
from covocp.blocks.quadratic import gradient, hessian, parameters, spread
from covocp.blocks.seeker_functions import Memory, Settings, step_function, update_function
from covocp.blocks.square_root import factor
from covocp.blocks.values import array, numeric, wrong_argument

Array = NDArray[np.float64]
Newton = Literal["modified", "plain", "never"]


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
            expansion where the position is known, adds the drift, and is otherwise left out.
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
        drift: W, what the covariance of zeta gains from one reading to the next, missing ones too: a number (times the
            identity), (p,) (its diagonal) or (p, p). With transport it covers what is of third order in f, and changes
            of f with time.
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
            acts as noise of f by the mean square of the gradient at the newest position.

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
    settings = Settings(
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
    return _made(settings, zeta, covariance)


def _made(settings: Settings, zeta: Array, covariance: Array) -> Seeker:
    """The law with its memory at the start: zeta and the factor of its covariance."""
    layout = Memory.of(settings.inputs, settings.window)
    memory = np.zeros(layout.factor.stop)
    memory[layout.parameters] = zeta
    rows, columns = half_indices(zeta.size)
    memory[layout.factor] = np.asarray(factor(covariance))[rows, columns]
    return Seeker(
        inputs=settings.inputs,
        window=settings.window,
        update=update_function(settings, layout),
        step=step_function(settings, layout),
        layout=layout,
        start=settings.start,
        _initial=memory,
    )


def with_changes(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `seeker` of which some are changed; what only a plain step knows goes with it.

    Args:
        settings: arguments by name.
        changes: those that differ.

    Returns:
        All of them, without `switch`, `definite` and `descent_gain` of the settings where the step has no use for them.
    """
    merged = dict(settings) | dict(changes)
    if merged.get("newton", "modified") != "plain":
        for name in {"switch", "definite"} - set(changes):
            merged.pop(name, None)
    if merged.get("newton", "modified") == "modified" and "descent_gain" not in changes:
        merged.pop("descent_gain", None)
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
    if newton == "modified" and descent_gain is not None:
        raise ProblemError(
            "The argument 'descent_gain' means nothing to the step newton='modified'.",
            expected="descent_gain= with newton='plain' or 'never' only",
            received=f"descent_gain={descent_gain}",
            remedy="leave descent_gain= out, or choose newton='plain'",
        )
    for name, given in (("switch", switch is not None), ("definite", not definite)):
        if given and newton != "plain":
            raise ProblemError(
                f"The argument '{name}' means nothing to the step newton='{newton}'.",
                expected=f"{name}= with newton='plain' only",
                received=f"{name}={switch if name == 'switch' else definite}",
                remedy=f"leave {name}= out, or choose newton='plain'",
            )
