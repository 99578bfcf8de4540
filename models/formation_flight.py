"""Formation flight: an aircraft behind another one finds, by peak seeking, where its induced drag is least.

J. J. Ryan, J. L. Speyer, "Peak-Seeking Control Using Gradient and Hessian Estimates", ACC 2010. The follower, a Boeing
747-100, knows neither the wake of its leader nor where to fly: it measures its coefficient of induced drag, with a
standard deviation of 10 counts ten times a second (1 count = 1e-4; it has 198 alone and 81 at the best place), and its
position to 12 mm. Means over 10 s go to the filter of gradient and Hessian, whose steps a tracker follows. The paper
gives neither aircraft nor map nor noises of the filter: `formation.aircraft` and `formation.drag_map` are their place.

`simulate()` flies it many times. `problem()` is the optimal control problem of the excitation before it, in two inputs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.arguments import a, checked, is_number, one_of, optional, positive, whole
from covocp.blocks import peak_seeking
from covocp.models import designed_excitation
from covocp.models.excitation.paths import Path
from covocp.models.formation import aircraft
from covocp.models.formation.drag_map import DragMap, drag_map
from covocp.models.formation.flight_runs import FlightRuns

Array = npt.NDArray[np.float64]

START = (-6.0, 5.0)  # to the right of the best position and above it [m]
PERIOD = 10.0  # of the seeker [s]
DRAG_DEVIATION = 10.0  # of one measurement, ten a second [counts]
POSITION_DEVIATION = 0.012  # [m]
RADIUS, TURN = 0.7, 120.0  # of the circle of excitation [m], and its period [s]: 3 deg/s
SEEKING = 120.0  # from when on steps are taken: one circle [s]
STORED = 5  # steps between two times of the histories
READINGS = round(PERIOD / aircraft.STEP)
RECOMMENDED: dict[str, Any] = {
    "window": 15,
    "noise": DRAG_DEVIATION**2 / READINGS,
    "drift": (0.02, 0.02, 0.02, 0.5, 0.5),
    "prior_covariance": (25.0, 25.0, 25.0, 900.0, 900.0),
    "reuse": False,
    "newton": "modified",
    "smallest_curvature": 0.8,
    "largest_step": 1.5,
    "descent_gain": 0.05,  # of other steps, where one is chosen
}
PRINTED: dict[str, Any] = {
    "window": 15,
    "noise": DRAG_DEVIATION**2 / READINGS,
    "drift": (0.02, 0.02, 0.02, 0.5, 0.5),
    "prior_covariance": (25.0, 25.0, 25.0, 900.0, 900.0),
    "transport": False,
    "reuse": False,
    "newton": "plain",
    "switch": 6.0,
    "descent_gain": 0.05,
    "smallest_curvature": 0.8,  # of the "modified" step, where it is chosen
}
COMMAND_GAIN = {"recommended": 1.0, "printed": 10.0}


def problem(
    radius: float = RADIUS,
    duration: float = SEEKING,
    ends: designed_excitation.Ends = "rest",
    reach: float | None = None,
) -> co.Problem:
    """The excitation that makes gradient and Hessian of the drag best known; `designed_excitation` in two inputs.

    Args:
        radius: of the circle whose length the path has at most [m].
        duration: of the path [s].
        ends: "rest" at the command, or "free".
        reach: largest distance from the command [m]; None: any.

    Returns:
        The problem, with the noise of the drag, the prior of the law and the bandwidth of the tracker.

    Raises:
        ProblemError: an argument does not fit.
    """
    return designed_excitation.problem(
        2,
        radius=radius,
        duration=duration,
        ends=ends,
        reach=reach,
        noise=DRAG_DEVIATION**2 * aircraft.STEP,
        prior=RECOMMENDED["prior_covariance"],
    )


@checked(
    settings=one_of(*COMMAND_GAIN),
    runs=whole(1, 10**5),
    radius=lambda value: "" if is_number(value) and value >= 0 else "a number >= 0",
    turn=positive,
    command_gain=optional(positive),
    drag=optional(a(DragMap)),
    path=optional(a(Path)),
)
def simulate(
    start: npt.ArrayLike = START,
    *,
    runs: int = 40,
    seed: int = 0,
    duration: float = 420.0,
    radius: float = RADIUS,
    turn: float = TURN,
    command_gain: float | None = None,
    drag: DragMap | None = None,
    path: Path | None = None,
    settings: str = "recommended",
    **changes: Any,
) -> FlightRuns:
    """Fly from a position to that of least drag.

    Args:
        start: to the right of the best position and above it, (2,) [m]; in trim there.
        runs: number of noise realisations.
        seed: of the noise; run i is the same whatever the number of runs.
        duration: [s], a multiple of 10.
        radius: of the circle of excitation, 0 for none [m].
        turn: period of the circle [s].
        command_gain: of the filter of commands: 1 moves the command by the increment, 10 is the paper's; None: 1 with
            the recommended settings, 10 with the printed ones.
        drag: the map; None: that of `formation.drag_map`.
        path: excitation that is flown instead of the circle, once, then held; such as `designed_excitation.path`.
        settings: "recommended", or "printed": the law of the paper with corrected signs.
        **changes: arguments of `blocks.peak_seeking.seeker` that differ from these settings.

    Returns:
        Histories of all runs.

    Raises:
        ProblemError: an argument does not fit.
    """
    field = drag_map() if drag is None else drag
    known = {"recommended": RECOMMENDED, "printed": PRINTED}[settings]
    law = peak_seeking.seeker(2, **peak_seeking.with_changes(known, changes))
    gain = COMMAND_GAIN[settings] if command_gain is None else float(command_gain)
    tracker = aircraft.tracker()
    begin = field.best + _pair("start", start)
    if path is not None and path.position.shape[1] != 2:
        raise co.ProblemError(
            "The path of excitation does not fit.",
            expected="positions to the right and above, (K, 2) [m]",
            received=f"shape {path.position.shape}",
            remedy="give a path in two inputs",
        )

    def excited(t: Any) -> Any:
        return peak_seeking.circle(t, radius, turn) if path is None else path.at(t)

    trim = aircraft.trimmed(tracker, field.evaluate(begin)[1], begin)
    found = co.simulate_sampled(
        _follower(tracker, field, gain, excited),
        _sensor(field),
        law.law(SEEKING),
        initial=np.concatenate([trim.state, trim.sums, begin - excited(0.0)]),
        memory=law.initial(),
        step=aircraft.STEP,
        period=PERIOD,
        duration=duration,
        runs=runs,
        seed=seed,
        every=STORED,
    )
    command = found.x[..., 15:] + excited(found.t)
    return FlightRuns.of(found, command, law, tracker, field)


def _pair(name: str, value: npt.ArrayLike) -> Array:
    """Two finite numbers."""
    numbers = np.asarray(value, dtype=float)
    if numbers.shape != (2,) or not np.isfinite(numbers).all():
        raise co.ProblemError(
            f"The argument '{name}' is no position.",
            expected="two finite numbers: to the right of the best position and above it [m]",
            received=f"{value!r}"[:100],
            remedy=f"correct {name}=",
        )
    return numbers


def _follower(tracker: aircraft.Tracker, field: DragMap, gain: float, excitation: Callable[[Any], Any]) -> ca.Function:
    """A step of (state, sums, command): tracker, aircraft in the wake, ramp of the command."""
    x, increment, t, noise = ca.MX.sym("x", 17), ca.MX.sym("increment", 2), ca.MX.sym("t"), ca.MX.sym("noise", 0)
    state, sums, command = x[:11], x[11:15], x[15:]
    error = ca.vertcat(state[:9], state[9:] - command - excitation(t))
    controls = -ca.DM(tracker.gain) @ ca.vertcat(error, sums)
    A, B, vortex = (ca.DM(part) for part in tracker.model)
    tracked = [aircraft.STATES.index(name) for name in aircraft.TRACKED]
    _, moment = field.function(state[9:])
    following = ca.vertcat(
        A @ state + B @ controls + vortex * moment,
        sums + tracker.step * error[tracked],
        peak_seeking.ramp(command, gain * increment, period=PERIOD, step=tracker.step),
    )
    return ca.Function("follower", [x, increment, t, noise], [following])


def _sensor(field: DragMap) -> ca.Function:
    """Position and drag, with their noises."""
    x, t, noise = ca.MX.sym("x", 17), ca.MX.sym("t"), ca.MX.sym("noise", 3)
    drag, _ = field.function(x[9:11])
    deviations = ca.DM([POSITION_DEVIATION, POSITION_DEVIATION, DRAG_DEVIATION])
    return ca.Function("sensor", [x, t, noise], [ca.vertcat(x[9:11], drag) + deviations * noise])
