"""Runs of the antenna pointing: what was flown and estimated, its shares and medians, printout and figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.blocks import attitude_seeking, so3
from covocp.models.antenna.patch import Patch
from covocp.models.antenna.spacecraft import STATES, Spacecraft

if TYPE_CHECKING:
    from covocp.simulation.sampled_loop import SampledSimulation

Array = npt.NDArray[np.float64]

ARRIVED = 0.95  # share of the greatest power that counts as success
LAST = 20.0  # over which the power is averaged for it [s]


@dataclass(frozen=True, kw_only=True, eq=False)
class PointingRuns:
    """Histories of all runs, of the spacecraft at K times and of the guidance at L times; shares are over all runs.

    Attributes:
        filter: that flew.
        settings: of the law.
        t: (K,) [s].
        attitude: unit quaternion, scalar first, (runs, K, 4).
        rate: angular velocity in body axes, (runs, K, 3) [rad/s].
        power: without noise, (runs, K) [W].
        torque: of the wheels on the body in the sample that begins at t, (runs, K, 3) [N m].
        wheel_speed: (runs, K, 3) [rad/s].
        zone_values: x'C y - cos(alpha) of each zone, without margin: not negative where it is kept, (runs, K, m).
        source: direction of the source in the inertial frame, (K, 3).
        samples: times of the guidance, (L,) [s].
        measured: power with noise, (runs, L) [W].
        gradient: true b in body axes, (runs, L, 3) [W/rad].
        estimate: of it, axes (runs, L) first.
        desired: attitude that is held from the sample on, unit quaternion, (runs, L, 4).
        antenna: of the model.
    """

    filter: str
    settings: str
    t: Array
    attitude: Array
    rate: Array
    power: Array
    torque: Array
    wheel_speed: Array
    zone_values: Array
    source: Array
    samples: Array
    measured: Array
    gradient: Array
    estimate: attitude_seeking.GradientEstimate
    desired: Array
    antenna: Patch

    __repr__ = short_repr

    @classmethod
    def of(
        cls,
        found: SampledSimulation,
        law: attitude_seeking.AttitudeSeeker,
        antenna: Patch,
        body: Spacecraft,
        source: Array,
        zones: tuple[attitude_seeking.Zone, ...],
        filter: str,
        settings: str,
    ) -> PointingRuns:
        """What the histories of the loop say.

        Args:
            found: of the loop.
            law: that flew.
            antenna: of the model.
            body: of the model.
            source: its direction at the times of the plant, (K, 3).
            zones: that are watched, without margin.
            filter: name of the law.
            settings: name of its settings.
        """
        attitude = found.x[..., :4]
        power, slope = antenna.evaluate(attitude, source)
        guided = np.rint(found.samples / found.t[1]).astype(int)
        C = so3.from_quaternion(attitude)
        held = np.concatenate([found.held[:, 1:], found.held[:, -1:]], axis=1)
        return cls(
            filter=filter,
            settings=settings,
            t=found.t,
            attitude=attitude,
            rate=found.x[..., 4:7],
            power=power,
            torque=_torques(body, found.x, held),
            wheel_speed=found.x[..., 7:],
            zone_values=np.stack([zone.value(C) for zone in zones], axis=-1) if zones else np.zeros((*power.shape, 0)),
            source=source,
            samples=found.samples,
            measured=found.measured[..., 4],
            gradient=slope[:, guided],
            estimate=law.estimate(found.memory),
            desired=found.held[:, np.minimum(guided + 1, len(found.t) - 1)],
            antenna=antenna,
        )

    @property
    def final_power(self) -> Array:
        """Mean of the last 20 s of each run, (runs,) [W]."""
        return np.asarray(self.power[:, self.t > self.t[-1] - LAST].mean(axis=1))

    @property
    def success(self) -> float:
        """Share of the runs whose mean power of the last 20 s is at least 95 % of the greatest."""
        return float(np.mean(self.final_power >= ARRIVED * self.antenna.peak))

    @property
    def time_to_hold(self) -> float:
        """Median of the time from which on a run keeps 95 % of the greatest power [s]; inf: half never do."""
        return float(np.median(self._since(self.power >= ARRIVED * self.antenna.peak)))

    @property
    def feasible_from(self) -> float:
        """Median of the first time at which all zones are kept [s]; inf: half never get there."""
        return float(np.median(self._first()))

    @property
    def violation(self) -> tuple[float, float]:
        """Median and largest of the largest violation after that time, in cosine units, over the runs that get there.

        NaN where none does: a run that never kept the zones has nothing to violate later.
        """
        first = self._first()
        if not np.isfinite(first).any():
            return np.nan, np.nan
        later = self.t >= first[:, None]
        worst = np.maximum(0.0, -self.zone_values.min(axis=-1, initial=0.0))
        largest = np.where(later, worst, 0.0).max(axis=1)[np.isfinite(first)]
        return float(np.median(largest)), float(largest.max())

    @property
    def coverage(self) -> float:
        """Share of the errors of the gradient, all axes, that are within 3 standard deviations."""
        error = np.abs(self.estimate.gradient - self.gradient)
        return float(np.mean(error <= 3.0 * self.estimate.deviation))

    @property
    def peak_torque(self) -> float:
        """Median over the runs of the largest length of the torque [N m]."""
        return float(np.median(np.linalg.norm(self.torque, axis=-1).max(axis=1)))

    def _first(self) -> Array:
        """First time of each run at which all zones are kept, (runs,) [s]."""
        kept = np.asarray((self.zone_values >= 0).all(axis=-1))
        return np.where(np.any(kept, axis=1), self.t[kept.argmax(axis=1)], np.inf)

    def _since(self, holds: npt.NDArray[np.bool_]) -> Array:
        """Time from which on something holds until the end, (runs,) [s]; inf: it does not at the end."""
        last = holds.shape[1] - 1 - (~holds[:, ::-1]).argmax(axis=1)
        since = np.where(holds.all(axis=1), 0.0, self.t[np.minimum(last + 1, len(self.t) - 1)])
        return np.where(holds[:, -1], since, np.inf)

    def __str__(self) -> str:
        """Shares that arrive, when, and how the zones are kept."""
        since = self.time_to_hold
        share = f"{self.success:.2f} of the runs"
        hold = f"held from {since:.1f} s on" if np.isfinite(since) else "not held by half of them"
        lines = [
            f"Antenna pointing: {len(self.power)} runs of {self.t[-1]:g} s, {self.filter}, settings {self.settings}",
            f"  at least 95 % of {self.antenna.peak:g} W     {share}, {hold}",
            f"  power at the end          median {np.median(self.final_power):.2f} W",
        ]
        if self.zone_values.shape[-1]:
            lines.append(f"  zones                     {self._about_zones()}")
        lines += [
            f"  gradient                  {self.coverage:.3f} within 3 standard deviations",
            f"  largest torque            median {self.peak_torque:.2f} N m",
        ]
        return "\n".join(lines)

    def _about_zones(self) -> str:
        """How many runs get between the zones, when, and by how much they leave them again."""
        reached = int(np.isfinite(self._first()).sum())
        if not reached:
            return "met by none"
        median, largest = self.violation
        when = f" first at {self.feasible_from:.1f} s" if np.isfinite(self.feasible_from) else ""
        later = f"later violation of the cosine: median {median:.3f}, largest {largest:.3f}"
        return f"met by {reached} of {len(self.power)}{when}, {later}"

    def plot(self, path: str | Path | None = None, run: int = 0, *, gradient: bool = False) -> Any:
        """Power, zones, torque, wheels and the paths of the body axes of one run.

        Args:
            path: of the picture; None: not saved.
            run: which run.
            gradient: the errors of the estimated gradient with their bounds instead.

        Returns:
            The matplotlib figure.
        """
        from covocp.models.antenna.pointing_figure import draw, draw_gradient

        figure = (draw_gradient if gradient else draw)(self, run)
        if path is not None:
            figure.savefig(path, dpi=120)
        return figure


def _torques(body: Spacecraft, x: Array, held: Array) -> Array:
    """Of the control, (runs, K, 3) [N m]."""
    state, desired = ca.SX.sym("x", STATES), ca.SX.sym("desired", 4)
    torque = ca.Function("torque", [state, desired], [body.torque(state, desired)]).map(x.shape[0] * x.shape[1])
    found = torque(x.reshape(-1, STATES).T, held.reshape(-1, 4).T)
    return np.asarray(found.full()).T.reshape(*x.shape[:2], 3)
