"""A law that flies in place of the design's filter and feedback: stepped once a period, as a computer does it.

At the sample t_k = k period the law is given the mean of the actual measurement over the period before, white noise
included, and answers with the control that is held until the next sample. At time zero nothing has been measured yet:
there the measurement is NaN.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
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

    __repr__ = short_repr


def flown_law(law: Given, period: Given, design: System, duration: float) -> Flown | None:
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
            expected = "law= with it: it is the time between two steps of that law"
            raise wrong_argument("period", expected, period, "give law=, or leave period= out")
        return None
    _check_kind(law, design)
    chosen = _period(law, period, duration)
    first = _first_step(law, design)
    count = math.floor(duration / chosen + WHOLE)
    times = np.minimum(np.arange(count + 1) * chosen, duration)
    return Flown(law=law, period=chosen, times=times, estimates=_estimate(first) is not None)


def _check_kind(law: Given, design: System) -> None:
    """Refuse what cannot be a law, and problems without feedback."""
    if not design.fed_back:
        expected = "None: nothing is fed back where the cost is deterministic"
        raise wrong_argument("law", expected, law, "state an expected cost; simulate_law runs any plant with any law")
    if isinstance(law, type):
        expected = "an object, not its class"
        raise wrong_argument("law", expected, law.__name__, f"give law={law.__name__}(...)")
    if not callable(getattr(law, "step", None)):
        expected = "an object with step(measurement, time) -> control, such as a CPackage's python()"
        raise wrong_argument("law", expected, law, "give it a method step")


def _period(law: Given, period: Given, duration: float) -> float:
    """Time between two steps: as given, which must not contradict the law's own."""
    own = getattr(law, "period", None)
    chosen: Any = own if period is None else period
    known = isinstance(chosen, (int, float, np.number)) and not isinstance(chosen, bool)
    if not known or not duration / MOST_SAMPLES <= chosen <= duration:
        expected = f"the time between two steps of the law, above 0 and at most {duration:g} s"
        raise wrong_argument("period", expected, period, "give period= in seconds")
    if isinstance(own, (int, float, np.number)) and abs(chosen - own) > WHOLE * own:
        expected = f"{own:g} s, for which this law was made"
        raise wrong_argument("period", expected, period, "leave period= out, or make the law for another one")
    return float(chosen)


def _first_step(law: Given, design: System) -> Any:
    """A copy of the law that answered at time zero with numbers of the right size."""
    try:
        first = own_copy(law)
    except Exception as error:  # whatever the user's class raises
        remedy = "leave out of it what cannot be copied (locks, files), or give it a method __deepcopy__"
        raise wrong_argument("law", "an object of which each run has a copy", in_words(error), remedy) from error
    expected = f"{design.fed_back} finite number(s) from step(measurement, 0.0), where the measurement is NaN"
    remedy = "let step return the whole control, also where nothing was measured yet"
    try:
        answer = first.step(np.full(design.measured + design.sampled, np.nan), 0.0)
        control = column_of(answer)
        estimate = _estimate(first)
    except Exception as error:
        raise wrong_argument("law", expected, in_words(error), remedy) from error
    if control.size != design.fed_back or not np.isfinite(control).all():
        raise wrong_argument("law", expected, answer, remedy)
    if estimate is not None and estimate.size != design.size:
        expected = f"an attribute estimate with {design.size} numbers, or none"
        raise wrong_argument(
            "law", expected, estimate, "estimate the deviation of states and unknowns from the nominal"
        )
    return first


def own_copy(law: Given) -> Any:
    """A law of a run's own, at its start."""
    own = copy.deepcopy(law)
    if callable(getattr(own, "init", None)):
        own.init()
    return own


class LawFailedError(Exception):
    """A law raised in flight: says in which run, when and what."""


def stepped(own: Given, measurement: Array, time: float, controls: int, estimates: int, run: int) -> Array:
    """Control and estimate of one step, stacked; NaN where the law gives something else than numbers of that size.

    Raises:
        LawFailedError: the law raised.
    """
    result = np.full(controls + estimates, np.nan)
    try:
        control = column_of(own.step(measurement, time))
        estimate = _estimate(own) if estimates else None
    except Exception as error:
        raise LawFailedError(f"the law failed in run {run} at {time:g} s: {in_words(error)}") from error
    if control.size == controls:
        result[:controls] = control
    if estimate is not None and estimate.size == estimates:
        result[controls:] = estimate
    return result


def sample_indices(flown: Flown | None, grid: Grid) -> Any:
    """Where the samples lie among the times of a grid."""
    if flown is None:
        return np.zeros(0, dtype=int)
    return np.searchsorted(grid.t, flown.times + WHOLE * flown.period, side="right") - 1  # after what is read there


def column_of(value: Given) -> Array:
    """Numbers as the user gave them, flat."""
    return np.asarray(value, dtype=float).ravel()


def _estimate(law: Given) -> Array | None:
    """What a law says of the deviation from the nominal."""
    estimate = getattr(law, "estimate", None)
    return None if estimate is None or callable(estimate) else column_of(estimate)


def in_words(error: Exception) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {error}"
