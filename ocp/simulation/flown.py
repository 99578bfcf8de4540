"""A law that flies in place of the design's filter and feedback: stepped once a period, as a computer does it.

At the sample t_k = k period the law is given the mean of the actual measurement over the period before, white noise
included, and answers with the control that is held until the next sample. At time zero nothing has been measured yet:
there the measurement is NaN.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from covocp.matrices import Array
from covocp.simulation.actual import System
from covocp.simulation.request import wrong_argument
from covocp.simulation.schedule import WHOLE, Grid

MOST_SAMPLES = 1_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Flown:
    """A law and when it is stepped.

    law: with `step(measurement, time)`, and `init()` and `estimate` where it has them.
    period: between two steps [s].
    times: of the steps, (K,) [s].
    estimates: whether the law tells its estimate of the deviation from the nominal.
    """

    law: Any
    period: float
    times: Array
    estimates: bool


def flown_law(law: Any, period: Any, design: System, duration: float) -> Flown | None:
    """A law that was checked by a first step.

    Args:
        law: what the user gave; None: there is none.
        period: of its steps [s]; None: its own attribute `period`.
        design: the system that it controls.
        duration: of the simulation [s].

    Raises:
        ProblemError: something else than a law, without a period, for a problem without feedback, or with a control or
            an estimate of another size.
    """
    if law is None:
        if period is not None:
            raise wrong_argument("period", "law= with it: it is the time between two steps of that law", period)
        return None
    if not design.fed_back:
        raise wrong_argument(
            "law", "None: nothing is fed back where the cost is deterministic (simulate_law runs any plant)", law
        )
    if not callable(getattr(law, "step", None)):
        raise wrong_argument(
            "law", "an object with step(measurement, time) -> control, such as a CPackage's python()", law
        )
    chosen: Any = getattr(law, "period", None) if period is None else period
    known = isinstance(chosen, (int, float, np.number)) and not isinstance(chosen, bool)
    if not known or not duration / MOST_SAMPLES <= chosen <= duration:
        expected = f"the time between two steps of the law, above 0 and at most {duration:g} s"
        raise wrong_argument("period", expected, period)
    count = math.floor(duration / chosen + WHOLE)
    times = np.minimum(np.arange(count + 1) * float(chosen), duration)
    first = own_copy(law)
    control = _column(first.step(np.full(design.measured, np.nan), 0.0))
    if control.size != design.fed_back:
        raise wrong_argument("law", f"a control with {design.fed_back} entries from step(measurement, 0.0)", control)
    estimate = _estimate(first)
    if estimate is not None and estimate.size != design.size:
        raise wrong_argument("law", f"an estimate with {design.size} entries, or none", estimate)
    return Flown(law=law, period=float(chosen), times=times, estimates=estimate is not None)


def own_copy(law: Any) -> Any:
    """A law of a run's own, at its start."""
    own = copy.deepcopy(law)
    if callable(getattr(own, "init", None)):
        own.init()
    return own


def stepped(own: Any, measurement: Array, time: float, controls: int, estimates: int) -> Array:
    """Control and estimate of one step, stacked; NaN where the law gives something else than numbers of that size."""
    result = np.full(controls + estimates, np.nan)
    control = _column(own.step(measurement, time))
    if control.size == controls:
        result[:controls] = control
    if estimates:
        estimate = _estimate(own)
        if estimate is not None and estimate.size == estimates:
            result[controls:] = estimate
    return result


def sample_indices(flown: Flown | None, grid: Grid) -> Any:
    """Where the samples lie among the times of a grid."""
    return np.searchsorted(grid.t, flown.times - WHOLE * flown.period) if flown else np.zeros(0, dtype=int)


def _column(value: Any) -> Array:
    return np.asarray(value, dtype=float).ravel()


def _estimate(law: Any) -> Array | None:
    """What a law says of the deviation from the nominal."""
    estimate = getattr(law, "estimate", None)
    return None if estimate is None or callable(estimate) else _column(estimate)
