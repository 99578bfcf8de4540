"""Settings of the laws of attitude seeking: those that arrive, those that were printed, and what the user changes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from covocp.base.arguments import Kind, check_argument, is_number, optional, positive, truth, whole
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, warn_user
from covocp.base.short_repr import short_repr
from covocp.blocks.attitude_filter import AXES, FilterSettings
from covocp.blocks.values import array, wrong_argument

Array = NDArray[np.float64]


class Options(TypedDict, total=False):
    """What of the settings may be changed; the units are those of a power in W.

    Attributes:
        kappa: step of the guidance per gradient [rad^2/W].
        window: N, number of differences of an update.
        spacing: readings from one of them to the next.
        period: of the guidance [s].
        noise: variance of a power, or of a difference where `correlated` is False [W^2].
        correlated: whether the differences share the noise of the newest power.
        drift: what the variance of the gradient gains in a guidance step [(W/rad)^2].
        motion_drift: and by the square of the rotation in that step [(W/rad^2)^2].
        prior_covariance: of the gradient, a number or (3,) [(W/rad)^2].
        prior: gradient to begin with, (3,) [W/rad].
        smallest_step: least |kappa b|, of `unconstrained` [rad].
        largest_step: greatest |kappa b|, of `unconstrained` (None: any) and `constrained` [rad].
        penalty: s, of a zone that cannot be kept, of `constrained` [1/cosine unit].
        cutoff: of the low-pass of the direction; None: no low-pass [Hz].
        excitation: amplitude of what is added to a step, about each axis, a number or (3,) [rad].
        excitation_period: a number or (3,) [s].
        excitation_phase: a number or (3,) [rad].
        peak_curvature: c of the power at its peak, to check kappa against: kappa c < 1 [W/rad^2].
    """

    kappa: float
    window: int
    spacing: int
    period: float
    noise: float
    correlated: bool
    drift: float
    motion_drift: float
    prior_covariance: ArrayLike
    prior: ArrayLike
    smallest_step: float
    largest_step: float | None
    penalty: float
    cutoff: float | None
    excitation: ArrayLike
    excitation_period: ArrayLike
    excitation_phase: ArrayLike
    peak_curvature: float | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Settings:
    """The options, checked; the meaning of each is that of `Options`."""

    filter: FilterSettings
    kappa: float
    period: float
    prior_covariance: Array
    prior: Array
    smallest_step: float
    largest_step: float | None
    penalty: float
    cutoff: float | None
    excitation: Array
    excitation_period: Array
    excitation_phase: Array

    __repr__ = short_repr


# D1 of section 14: the setting with which all three laws arrive.
RECOMMENDED: dict[str, Any] = {
    "kappa": 0.05,
    "window": 10,
    "spacing": 2,
    "period": 0.5,
    "noise": 0.0025,
    "correlated": True,
    "drift": 0.02,
    "motion_drift": 16.0,
    "prior_covariance": 1.0,
    "prior": (0.0, 0.0, 0.0),
    "smallest_step": 0.0,
    "largest_step": 0.25,
    "penalty": 1e5,
    "cutoff": None,
    "excitation": 0.04,
    "excitation_period": (8.0, 6.0, 5.0),
    "excitation_phase": (0.0, 2.1, 4.2),
    "peak_curvature": None,
}
# Section 10: of the paper; its excitation sin(0.05 pi k) at 2 Hz has a period of 20 s.
PRINTED: dict[str, Any] = RECOMMENDED | {
    "kappa": 0.15,
    "window": 5,
    "noise": 0.001,
    "correlated": False,
    "drift": 0.002,
    "motion_drift": 0.0,
    "cutoff": 0.08,
    "excitation": 0.001,
    "excitation_period": 20.0,
    "excitation_phase": 0.0,
}
NAMED = {"recommended": RECOMMENDED, "printed": PRINTED}
# What a law has no use for.
NOT_OF = {
    "unconstrained": ("penalty",),
    "projected": ("smallest_step", "largest_step", "penalty"),
    "constrained": ("smallest_step",),
}


def _not_negative(value: Any) -> str:
    return "" if is_number(value) and value >= 0 else "a finite number >= 0"


KINDS: dict[str, Kind] = {
    "kappa": positive,
    "window": whole(1, 1000),
    "spacing": whole(1, 1000),
    "period": positive,
    "noise": positive,
    "correlated": truth,
    "drift": _not_negative,
    "motion_drift": _not_negative,
    "smallest_step": _not_negative,
    "largest_step": optional(positive),
    "penalty": positive,
    "cutoff": optional(positive),
    "peak_curvature": optional(positive),
}
# Steps beyond this do not exist [rad].
HALF_TURN = float(np.pi)


def settings_of(law: str, name: str, changes: Mapping[str, Any]) -> Settings:
    """The settings of a law.

    Args:
        law: "unconstrained", "projected" or "constrained".
        name: of what they begin with.
        changes: of the user.

    Raises:
        ProblemError: an option that the law does not have, a value that does not fit, step bounds that are crossed.
    """
    for option in changes:
        if option not in RECOMMENDED or option in NOT_OF[law]:
            raise ProblemError(
                f"{law}() has no option '{option}'.",
                expected=", ".join(known for known in RECOMMENDED if known not in NOT_OF[law]),
                received=f"{option}={changes[option]!r}"[:80],
                remedy=f"leave {option}= out",
            )
    # The paper bounds the steps of the filter with matrix inequalities only.
    start = NAMED[name] | ({"largest_step": None} if law == "unconstrained" and name == "printed" else {})
    options = start | dict(changes)
    for option, kind in KINDS.items():
        check_argument(f"{law}()", option, kind, options[option])
    _check_steps(law, options)
    excitation = {key: _axes(key, options[key]) for key in ("excitation", "excitation_period", "excitation_phase")}
    if not (excitation["excitation_period"] > 0).all():
        raise wrong_argument("excitation_period", "periods > 0", f"{options['excitation_period']!r}"[:60])
    covariance = _axes("prior_covariance", options["prior_covariance"])
    if not (covariance > 0).all():
        raise wrong_argument("prior_covariance", "variances > 0", f"{options['prior_covariance']!r}"[:60])
    largest, cutoff = options["largest_step"], options["cutoff"]
    return Settings(
        filter=FilterSettings(
            window=int(options["window"]),
            spacing=int(options["spacing"]),
            noise=float(options["noise"]),
            correlated=bool(options["correlated"]),
            drift=float(options["drift"]),
            motion_drift=float(options["motion_drift"]),
        ),
        kappa=float(options["kappa"]),
        period=float(options["period"]),
        prior_covariance=covariance,
        prior=_axes("prior", options["prior"]),
        smallest_step=float(options["smallest_step"]),
        largest_step=None if largest is None else float(largest),
        penalty=float(options["penalty"]),
        cutoff=None if cutoff is None else float(cutoff),
        **excitation,
    )


def _check_steps(law: str, options: Mapping[str, Any]) -> None:
    """Step bounds in order, and a step that does not overshoot the peak.

    Raises:
        ProblemError: bounds that are crossed, a bound that is missing or beyond half a turn.
    """
    least, most = options["smallest_step"], options["largest_step"]
    if most is not None and not least <= most:
        expected = "smallest_step <= largest_step"
        raise wrong_argument("smallest_step", expected, f"smallest_step={least:g}, largest_step={most:g}")
    if law == "constrained" and most is None:
        raise wrong_argument("largest_step", "a length, d_max [rad]", "None", "give largest_step=, or use projected()")
    if most is not None and most > HALF_TURN:
        raise wrong_argument("largest_step", "at most pi rad", f"{most:g}")
    curvature = options["peak_curvature"]
    if curvature is not None and options["kappa"] * curvature >= 1:
        warn_user(
            f"kappa * peak_curvature = {options['kappa'] * curvature:.3g}: guidance whose gradient is late overshoots "
            f"the peak and may not settle. Choose kappa below {1 / curvature:.3g} rad^2/W."
        )


def _axes(name: str, value: Any) -> Array:
    """A number for each axis."""
    numbers = array(name, value)
    if numbers.ndim == 0:
        numbers = np.full(AXES, numbers)
    if numbers.shape != (AXES,) or not np.isfinite(numbers).all():
        raise wrong_argument(name, "a finite number, or one for each of the three axes", f"{value!r}"[:60])
    return numbers
