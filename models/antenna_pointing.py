"""A spacecraft points its antenna at a source that it does not know, by the power it receives, between two zones.

A. Walsh, J. R. Forbes, S. A. Chee, J. J. Ryan, "Kalman-Filter-Based Unconstrained and Constrained Extremum-Seeking
Guidance on SO(3)", J. Guidance, Control, and Dynamics, 2017, doi 10.2514/1.G002635. The power of a patch antenna, at
most 4.61 W, is measured ten times a second with a standard deviation of 0.05 W. Twice a second the guidance asks for
another attitude, which wheels follow. One body axis is to keep out of a cone of 20 deg, another is to stay in one.

The paper gives neither the dimensions of the patch nor the horizon; its numbers as printed do not arrive
(docs/blocks/attitude_seeking.md says why), so the defaults are other ones.

`simulate()` flies it many times. `problem()` is the slew to the same attitude with everything known, for comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.arguments import a, checked, one_of, optional, whole
from covocp.blocks import attitude_seeking, so3
from covocp.models.antenna.patch import Patch
from covocp.models.antenna.pointing_runs import PointingRuns
from covocp.models.antenna.spacecraft import STATES, Spacecraft

Array = npt.NDArray[np.float64]

STEP, PERIOD = 0.1, 0.5  # of measurement and control, and of the guidance [s]
NOISE = 0.05  # standard deviation of one power [W]
# Body axis, inertial direction, half angle [deg], kind.
ZONES = (((1.0, 0.0, 0.0), (0.3, 1.0, -0.5), 20.0, "exclusion"), ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), 20.0, "inclusion"))
INITIAL_ATTITUDE: Array = np.asarray(so3.principal(2, np.radians(60.0)) @ so3.principal(3, np.radians(20.0)))
BEST_ATTITUDE: Array = np.asarray(so3.principal(3, np.radians(90.0)))  # at the peak, in the middle between the zones
SOURCE = (0.0, 0.0, 1.0)
SETTINGS = ("recommended", "printed", "printed without low-pass")
LARGEST_TORQUE = 0.3  # of problem() [N m]


@checked(
    filter=one_of("unconstrained", "projected", "constrained"),
    settings=one_of(*SETTINGS),
    runs=whole(1, 10**5),
    antenna=optional(a(Patch)),
    spacecraft=optional(a(Spacecraft)),
)
def simulate(
    filter: str = "constrained",
    *,
    runs: int = 128,
    seed: int = 0,
    duration: float = 200.0,
    settings: str = "recommended",
    zones: Sequence[attitude_seeking.ZoneLike] | None = None,
    initial_attitude: npt.ArrayLike | None = None,
    source: npt.ArrayLike | None = None,
    source_rate: npt.ArrayLike | None = None,
    antenna: Patch | None = None,
    spacecraft: Spacecraft | None = None,
    **changes: Any,
) -> PointingRuns:
    """Fly to the attitude of greatest power.

    Args:
        filter: "unconstrained", "projected" or "constrained".
        runs: number of noise realisations.
        seed: of the noise; run i is the same whatever the number of runs.
        duration: [s], a multiple of 0.5.
        settings: "recommended", "printed", or "printed without low-pass".
        zones: each (body axis, inertial direction, half angle [deg], "inclusion" or "exclusion"); None: the paper's.
        initial_attitude: C_ba, a rotation (3, 3), at rest there; None: C_2(60 deg) C_3(20 deg).
        source: direction of the source in the inertial frame, (3,); None: (0, 0, 1).
        source_rate: angular velocity of that direction in the inertial frame, (3,) [rad/s]; None: it is fixed.
        antenna: None: `Patch()`.
        spacecraft: None: `Spacecraft()`.
        **changes: arguments of the law of `blocks.attitude_seeking` that differ from these settings.

    Returns:
        Histories of all runs, with shares and medians.

    Raises:
        ProblemError: an argument does not fit.
    """
    patch, body = antenna or Patch(), spacecraft or Spacecraft()
    given = ZONES if zones is None else zones
    watched = attitude_seeking.zones_of(given)
    law = _law(filter, given, settings, changes)
    start = so3.to_quaternion(INITIAL_ATTITUDE if initial_attitude is None else initial_attitude)
    towards, rate = _vector("source", SOURCE if source is None else source), np.zeros(3)
    if source_rate is not None:
        rate = _vector("source_rate", source_rate, direction=False)
    found = co.simulate_sampled(
        plant(body),
        _sensor(patch, towards, rate),
        law.law(),
        initial=np.concatenate([start, np.zeros(STATES - 4)]),
        memory=law.initial(start),
        held=start,
        step=STEP,
        period=PERIOD,
        duration=duration,
        runs=runs,
        seed=seed,
        average=False,
        reading=law.reading(),
    )
    sources = np.array([so3.exp(-rate * t) @ towards for t in found.t])
    return PointingRuns.of(found, law, patch, body, sources, watched, filter, settings)


def _law(
    filter: str, zones: Sequence[attitude_seeking.ZoneLike], settings: str, changes: dict[str, Any]
) -> attitude_seeking.AttitudeSeeker:
    """The law of a filter."""
    name: Any = "recommended" if settings == "recommended" else "printed"
    given = ({"cutoff": None} if settings == SETTINGS[2] else {}) | {"period": PERIOD} | changes
    if given["period"] != PERIOD:
        raise co.ProblemError(
            "The guidance of the model has a period of its own.",
            expected=f"{PERIOD} s",
            received=f"period={given['period']!r}"[:60],
            remedy="leave period= out",
        )
    if filter == "unconstrained":
        return attitude_seeking.unconstrained(settings=name, **given)
    if filter == "projected":
        return attitude_seeking.projected(zones, settings=name, **given)
    return attitude_seeking.constrained(zones, settings=name, **given)


def _vector(name: str, value: npt.ArrayLike, *, direction: bool = True) -> Array:
    """Three numbers, of a direction with length one."""
    numbers = np.asarray(value, dtype=float)
    if numbers.shape != (3,) or not np.isfinite(numbers).all() or (direction and not numbers.any()):
        raise co.ProblemError(
            f"The argument '{name}' is no vector.",
            expected="three finite numbers" + (" that are not all zero" if direction else ""),
            received=f"{value!r}"[:100],
            remedy=f"correct {name}=",
        )
    return numbers / np.linalg.norm(numbers) if direction else numbers


def plant(body: Spacecraft) -> ca.Function:
    """A sample of the control, 0.1 s, as `simulate_sampled` takes it.

    Args:
        body: the spacecraft.

    Returns:
        casadi.Function (x (10,), desired (4,), t, noise (0,)) -> x: quaternion, angular velocity, wheel speeds.
    """
    x, desired = ca.SX.sym("x", STATES), ca.SX.sym("desired", 4)
    t, noise = ca.SX.sym("t"), ca.SX.sym("noise", 0)
    return ca.Function("spacecraft", [x, desired, t, noise], [body.step(x, desired, STEP)], {"cse": True})


def _sensor(patch: Patch, source: Array, rate: Array) -> ca.Function:
    """Attitude, without noise, and power."""
    x, t, noise = ca.SX.sym("x", STATES), ca.SX.sym("t"), ca.SX.sym("noise")
    direction = so3.exp(-t * ca.SX(ca.DM(rate))) @ ca.DM(source) if rate.any() else ca.SX(ca.DM(source))
    power = patch.power(so3.from_quaternion(x[:4]), direction)
    return ca.Function("sensor", [x, t, noise], [ca.vertcat(x[:4], power + NOISE * noise)])


def problem(*, duration: float = 25.0, torque: float = LARGEST_TORQUE) -> co.Problem:
    """The slew from rest to rest to the best attitude between the zones, with everything known; least torque.

    Args:
        duration: [s].
        torque: largest about each axis [N m].

    Returns:
        The problem, with states "attitude" (unit quaternion), "rate" [rad/s] and "wheels" [rad/s], control "torque"
        [N m]; the exclusion zone is a path constraint, in the inclusion zone the slew ends.
    """
    body, forbidden = Spacecraft(), attitude_seeking.zones_of(ZONES[:1])[0]
    start, end = (np.asarray(so3.to_quaternion(C)) for C in (INITIAL_ATTITUDE, BEST_ATTITUDE))
    end = end if start @ end > 0 else -end
    ocp = co.Problem(duration=duration, name="Slew of the antenna")
    q = ocp.state("attitude", 4, initial=start, final=[None, *end[1:]], guess=lambda s: (1 - s) * start + s * end)
    rate = ocp.state("rate", 3, initial=np.zeros(3), final=np.zeros(3), unit="rad/s")
    wheels = ocp.state("wheels", 3, initial=np.zeros(3), unit="rad/s", scale=10.0)
    tau = ocp.control("torque", 3, lower=-torque, upper=torque, unit="N m")
    half = ca.vertcat(0, rate) / 2
    ocp.dynamics(q, ca.vertcat(-ca.dot(q[1:], half[1:]), q[0] * half[1:] + ca.cross(q[1:], half[1:])))
    ocp.dynamics(rate, body.acceleration(rate, wheels, tau))
    ocp.dynamics(wheels, -tau / body.wheel)
    ocp.subject_to(forbidden.value(so3.from_quaternion(q)), lower=0.0, upper=np.inf, name="exclusion zone")
    ocp.minimize(ca.sumsqr(tau))
    return ocp
