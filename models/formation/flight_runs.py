"""Runs of the formation flight: what was flown and estimated, its printout and its figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.blocks import peak_seeking
from covocp.models.formation import aircraft
from covocp.models.formation.drag_map import DragMap

if TYPE_CHECKING:
    from covocp.simulation.sampled_loop import SampledSimulation

Array = npt.NDArray[np.float64]

# A run that misses more than this share of the benefit at the end, or that left the map, is lost.
LOST = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class FlightRuns:
    """Histories of all runs, of the aircraft at K times and of the seeker at L times.

    Attributes:
        t: (K,) [s].
        position: to the right of the best position and above it, (runs, K, 2) [m].
        command: that was commanded, with the excitation, (runs, K, 2) [m].
        tracking_error: position minus command, (runs, K, 2) [m].
        drag: coefficient of induced drag without noise, (runs, K) [counts].
        benefit_gap: share of the benefit that is not had, (f - f_best)/(f_alone - f_best), (runs, K).
        angles: roll, pitch, yaw, (runs, K, 3) [rad].
        controls: elevator, aileron with spoilers, rudder [rad], thrust [0.3 weight], from trim alone, (runs, K, 4).
        samples: times of the seeker, (L,) [s].
        measured: means of what was measured: y, h from the leader [m], drag [counts], (runs, L, 3).
        estimate: gradient [counts/m] and Hessian [counts/m^2] with their covariances, axes (runs, L) first.
        lost: whether a run left the map or ended without half of the benefit, (runs,).
        field: the map of drag.
    """

    t: Array
    position: Array
    command: Array
    tracking_error: Array
    drag: Array
    benefit_gap: Array
    angles: Array
    controls: Array
    samples: Array
    measured: Array
    estimate: peak_seeking.Estimate
    lost: npt.NDArray[np.bool_]
    field: DragMap

    __repr__ = short_repr

    @classmethod
    def of(
        cls,
        found: SampledSimulation,
        command: Array,
        law: peak_seeking.Seeker,
        tracker: aircraft.Tracker,
        field: DragMap,
    ) -> FlightRuns:
        """What the histories of (state, sums, command) say.

        Args:
            found: of the loop.
            command: with the excitation, (runs, K, 2) [m].
            law: the seeker.
            tracker: that followed it.
            field: the map.
        """
        x = found.x
        place = x[..., 9:11]
        flying = np.isfinite(x).all(axis=-1)
        inside = np.zeros(flying.shape, dtype=bool)
        inside[flying] = field.inside(place[flying])
        drag = np.full(flying.shape, np.nan)
        drag[flying] = field.evaluate(place[flying])[0]
        error = np.concatenate([x[..., :9], place - command, x[..., 11:15]], axis=-1)
        gap = field.gap(drag)
        return cls(
            t=found.t,
            position=place - field.best,
            command=command - field.best,
            tracking_error=place - command,
            drag=drag,
            benefit_gap=gap,
            angles=x[..., [aircraft.STATES.index(name) for name in ("phi", "theta", "psi")]],
            controls=-error @ tracker.gain.T,
            samples=found.samples,
            measured=found.measured,
            estimate=law.estimate(found.memory),
            lost=~(inside.all(axis=1) & (gap[:, -1] <= LOST)),
            field=field,
        )

    def gap_at(self, time: float) -> Array:
        """Share of the benefit that each run misses at a time [s], (runs,)."""
        return np.asarray(self.benefit_gap[:, int(np.argmin(np.abs(self.t - time)))])

    def __str__(self) -> str:
        """How much of the benefit is found, and how calmly."""
        end = float(self.t[-1])
        lines = [f"Formation flight: {len(self.lost)} runs of {end:g} s, {int(self.lost.sum())} lost"]
        for time in sorted({min(300.0, end), end}):
            gap = self.gap_at(time)
            lines.append(
                f"  benefit missed at {time:g} s       median {np.nanmedian(gap):.3f}, largest {np.nanmax(gap):.3f}"
            )
        roll, pitch, yaw = np.degrees(np.nanmax(np.abs(self.angles), axis=(0, 1)))
        elevator, aileron, rudder = np.degrees(np.nanmax(np.abs(self.controls[..., :3]), axis=(0, 1)))
        error = np.nanmax(np.abs(self.tracking_error), axis=(0, 1))
        lines += [
            f"  largest tracking error        {error[0]:.2f} m lateral, {error[1]:.2f} m vertical",
            f"  largest angles                roll {roll:.2f}, pitch {pitch:.2f}, yaw {yaw:.2f} deg",
            f"  largest deflections           elevator {elevator:.2f}, aileron {aileron:.1f}, rudder {rudder:.2f} deg",
        ]
        return "\n".join(lines)

    def plot(self, path: str | Path | None = None, run: int = 0) -> Any:
        """The map with the flown path, distances, drag, surfaces, attitude and estimates of one run.

        Args:
            path: of the picture; None: not saved.
            run: which run.

        Returns:
            The matplotlib figure.
        """
        from covocp.models.formation.flight_figure import draw

        figure = draw(self, run)
        if path is not None:
            figure.savefig(path, dpi=120)
        return figure
