"""Peak seeking along a line: a noisy function with several minima, and a plant that is slow to follow.

J. J. Ryan, J. L. Speyer, "Peak-Seeking Control Using Gradient and Hessian Estimates", ACC 2010, example in one
dimension:

    f(x) = (cos(x/8.4) + 1.5) (x/6 - 0.4)^2 [1],  x* = 2.4 m,  f(x*) = 0,  f''(x*) = 0.13664 / m^2

is convex for -7.2 m < x < 10.05 m and has another minimum at -23.15 m. Its value is measured every 4 s with a standard
deviation of 0.1, that of f at 1.2 m from the minimum. The plant has poles -1 and -2 +- i [1/s] and a gain of 0.2, so
an increment of the command by the Newton step makes the error smaller by a fifth. The paper gives neither the noises of
its filter nor the first commands; these are chosen here, and the defaults are not the paper's law but the one that
arrives (docs/blocks/peak_seeking.md has both, with their shares).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.arguments import checked, is_number, one_of, positive, whole
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.blocks import kalman, peak_seeking
from covocp.models import designed_excitation

Array = npt.NDArray[np.float64]

MINIMUM = 2.4  # m
CURVATURE = 0.13664  # f'' at the minimum [1/m^2]
STEP, PERIOD = 1.0, 4.0  # of the plant and of the filter [s]
GAIN = 0.2  # of the plant at rest
BANDWIDTH = 1.0  # of the plant: its slowest pole [1/s]
NOISE = 0.01  # variance of one value of f
WINDOW = 10
PLANT = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (-5.0, -9.0, -5.0))
INPUT = (0.0, 0.0, 1.0)
ARRIVED = 1.2  # distance from the minimum at which f equals its noise [m]
RECOMMENDED: dict[str, Any] = {
    "window": WINDOW,
    "noise": NOISE,
    "drift": (1e-5, 1e-4),
    "prior_covariance": (0.1, 1.0),
    "newton": "modified",
    "smallest_curvature": 0.05,
    "largest_step": 5.0,
    "descent_gain": 1.0,  # of other steps, where one is chosen
}
PRINTED: dict[str, Any] = {
    "window": WINDOW,
    "noise": NOISE,
    "drift": (1e-4, 1e-2),
    "prior_covariance": (0.1, 1.0),
    "transport": False,
    "reuse": False,
    "newton": "plain",
    "definite": False,
    "descent_gain": 1.0,
    "switch": 0.005,
    "smallest_curvature": 0.05,  # of the "modified" step, where it is chosen
}


@checked(amplitude=positive, rate=positive, duration=positive)
def problem(amplitude: float = 0.5, rate: float = 0.4, duration: float = 40.0) -> co.Problem:
    """The excitation that makes slope and curvature best known, no longer than a sine; `designed_excitation`.

    Args:
        amplitude: of the sine it is compared with, the unit of positions [m].
        rate: of that sine [rad/s].
        duration: T [s]; 40 s are the ten readings of the window.

    Returns:
        The problem of `designed_excitation` for one input, with the noise of a value every 4 s, the prior of the law,
        and the bandwidth of the plant, 1/s.

    Raises:
        ProblemError: an argument is not positive.
    """
    length = 4.0 * amplitude * rate * duration / (2.0 * np.pi)
    return designed_excitation.problem(
        1,
        radius=amplitude,
        duration=duration,
        length=length,
        noise=NOISE * PERIOD,
        prior=RECOMMENDED["prior_covariance"],
        acceleration=BANDWIDTH * length / duration,
    )


def function(x: Any) -> Any:
    """The performance function; of numbers, arrays or expressions [m]."""
    cosine = ca.cos(x / 8.4) if isinstance(x, (ca.SX, ca.MX)) else np.cos(np.asarray(x) / 8.4)
    return (cosine + 1.5) * (x / 6 - 0.4) ** 2


def derivatives(x: npt.ArrayLike) -> tuple[Array, Array]:
    """Gradient [1/m] and Hessian [1/m^2] of the function at positions [m], in their shape."""
    at, numbers = ca.SX.sym("x"), np.asarray(x, dtype=float)
    curvature, slope = ca.hessian(function(at), at)
    found = ca.Function("derivatives", [at], [slope, curvature]).map(numbers.size)(numbers.reshape(1, -1))
    first, second = (np.asarray(value.full()).reshape(numbers.shape) for value in found)
    return first, second


@dataclass(frozen=True, kw_only=True, eq=False)
class LineRuns:
    """Runs along the line; K times of the plant, L of the filter.

    Attributes:
        t: (K,) [s].
        position: (runs, K) [m].
        value: of the function there, without noise, (runs, K).
        command: (runs, K) [m at the input of the plant].
        samples: times of the filter, (L,) [s].
        measured: noisy values, (runs, L).
        estimate: gradient and Hessian with their covariances, axes (runs, L) first.
        takeover: time from which on the law commands [s]; arrivals count from then on.
    """

    t: Array
    position: Array
    value: Array
    command: Array
    samples: Array
    measured: Array
    estimate: peak_seeking.Estimate
    takeover: float

    __repr__ = short_repr

    def inside(self, time: float, distance: float = ARRIVED) -> float:
        """Share of the runs within a distance of the minimum at a time."""
        return float(np.mean(np.abs(self._at(time) - MINIMUM) < distance))

    def hit(self, time: float, distance: float = 0.25) -> float:
        """Share of the runs that have been within a distance of the minimum, under the law, by a time."""
        return float(np.mean(np.isfinite(self.arrival(distance)) & (self.arrival(distance) <= time)))

    def lost(self, distance: float = 7.5) -> float:
        """Share of the runs farther than a distance from the minimum at the end."""
        return float(np.mean(~(np.abs(self.position[:, -1] - MINIMUM) <= distance)))

    def arrival(self, distance: float = 0.25) -> Array:
        """First time of each run within a distance of the minimum under the law, (runs,) [s]; inf: never."""
        near = (np.abs(self.position - MINIMUM) < distance) & (self.t >= self.takeover)
        return np.where(near.any(axis=1), self.t[near.argmax(axis=1)], np.inf)

    def _at(self, time: float) -> Array:
        return np.asarray(self.position[:, int(np.argmin(np.abs(self.t - time)))])

    def __str__(self) -> str:
        """Shares that arrive, and when."""
        known = self.estimate.known.any(axis=0)
        first = f"{self.samples[known.argmax()]:g} s" if known.any() else "never"
        end, arrival = float(self.t[-1]), np.median(self.arrival())
        when = f"{arrival:.0f} s" if np.isfinite(arrival) else "never"
        return "\n".join(
            [
                f"Peak seeking along a line: {len(self.position)} runs of {end:g} s, first estimate at {first}",
                f"  within {ARRIVED} m of the minimum   {self.inside(min(80.0, end)):.2f} at {min(80.0, end):g} s,"
                f" {self.inside(end):.2f} at the end",
                f"  within 0.25 m by {min(80.0, end):g} s         {self.hit(min(80.0, end)):.2f},"
                f" median of the first time {when}",
                f"  more than 7.5 m away          {self.lost():.2f} at the end",
            ]
        )

    def plot(self, path: str | Path | None = None, run: int = 0) -> Any:
        """Position, value, estimates with 3-sigma bands against the truth of one run, and when all arrive.

        Args:
            path: of the picture; None: not saved.
            run: which run.

        Returns:
            The matplotlib figure.
        """
        import matplotlib.pyplot as plt

        figure, panels = plt.subplots(5, 1, figsize=(8, 11), layout="constrained")
        position, value, slope, curvature, arrivals = panels
        position.plot(self.t, self.position[run], label="position")
        position.plot(self.t, GAIN * self.command[run], "--", lw=1, label="command times gain")
        position.axhline(MINIMUM, color="k", lw=0.8, ls=":", label="minimum")
        position.set_ylabel("position [m]")
        value.plot(self.t, self.value[run], label="f")
        value.plot(self.samples, self.measured[run], ".", label="measured")
        value.set_ylabel("f")
        self._draw_estimates(slope, curvature, run)
        times = self.arrival()
        reached = times[np.isfinite(times)]
        arrivals.hist(reached, bins=np.arange(0.0, self.t[-1] + PERIOD, PERIOD))
        arrivals.set(xlabel="first time within 0.25 m of the minimum [s]", ylabel="runs", xlim=(0.0, self.t[-1]))
        arrivals.set_title(f"{reached.size} of {times.size} runs", fontsize="medium", loc="right")
        for axes in panels[:4]:
            axes.set(xlim=(0.0, self.t[-1]), xlabel="t [s]")
            axes.legend(fontsize="small", loc="upper right")
            axes.grid(alpha=0.3)
        if path is not None:
            figure.savefig(path, dpi=120)
        return figure

    def _draw_estimates(self, slope: Any, curvature: Any, run: int) -> None:
        """Gradient and Hessian of one run."""
        known, estimate = self.estimate.known[run], self.estimate
        at = np.searchsorted(self.t, self.samples - 0.5 * STEP)
        truth = derivatives(self.position[run, at])
        given = (
            (estimate.gradient[..., 0], estimate.gradient_deviation[..., 0]),
            (estimate.hessian[..., 0, 0], estimate.hessian_deviation[..., 0, 0]),
        )
        for axes, name, true, (value, deviation) in zip(
            (slope, curvature), ("gradient [1/m]", "Hessian [1/m²]"), truth, given, strict=True
        ):
            t, mean, band = self.samples[known], value[run, known], 3.0 * deviation[run, known]
            axes.fill_between(t, mean - band, mean + band, alpha=0.2, label="3 standard deviations")
            axes.plot(t, mean, label="estimate")
            axes.plot(self.samples, true, "k:", label="truth")
            axes.set_ylabel(name)
            if mean.size:  # the first bands are far wider than what follows
                span = np.abs(np.concatenate([true, mean])).max()
                axes.set_ylim(-2.0 * span, 2.0 * span)


def _is_row(value: Any) -> str:
    """A number or numbers in a row."""
    try:
        numbers = np.atleast_1d(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        return "finite numbers"
    return "" if numbers.ndim == 1 and np.isfinite(numbers).all() else "finite numbers in a row"


def _number(value: Any) -> str:
    return "" if is_number(value) else "a finite number"


@checked(
    start=_number,
    initial_steps=_is_row,
    runs=whole(1, 10**6),
    excitation=_number,
    rate=positive,
    settings=one_of("recommended", "printed"),
)
def simulate(
    start: float = 0.0,
    initial_steps: npt.ArrayLike = (15.0, 15.0, 15.0),
    *,
    runs: int = 500,
    seed: int = 0,
    duration: float = 200.0,
    excitation: float = 0.0,
    rate: float = 0.4,
    settings: str = "recommended",
    **changes: Any,
) -> LineRuns:
    """Fly the law from a position.

    Args:
        start: position at rest [m].
        initial_steps: of the command at 0, 4, 8, ... s, before the law takes over [m at the input].
        runs: number of noise realisations.
        seed: of the noise; run i is the same whatever the number of runs.
        duration: [s], a multiple of 4.
        excitation: amplitude of a sine added to the position that is commanded [m].
        rate: of the excitation [rad/s].
        settings: "recommended", or "printed": the law of the paper with corrected signs.
        **changes: arguments of `blocks.peak_seeking.seeker` that differ from these settings.

    Returns:
        Histories of all runs.

    Raises:
        ProblemError: an argument does not fit.
    """
    known = {"recommended": RECOMMENDED, "printed": PRINTED}[settings]
    law = peak_seeking.seeker(1, **peak_seeking.with_changes(known, changes))
    steps = np.atleast_1d(np.asarray(initial_steps, dtype=float))
    begin = float(start) / GAIN
    found = co.simulate_sampled(
        _plant(excitation, rate),
        _sensor(),
        _commanded(law, steps),
        initial=[start, 0.0, 0.0],
        memory=np.append(law.initial(), begin + steps[:1].sum()),
        held=begin + steps[:1].sum(),
        step=STEP,
        period=PERIOD,
        duration=duration,
        runs=runs,
        seed=seed,
        average=False,
    )
    return LineRuns(
        t=found.t,
        position=found.x[..., 0],
        value=function(found.x[..., 0]),
        command=found.held[..., 0],
        samples=found.samples,
        measured=found.measured[..., 1],
        estimate=law.estimate(found.memory[..., :-1]),
        takeover=PERIOD * steps.size,
    )


def _plant(excitation: float, rate: float) -> ca.Function:
    """Zero-order hold of the command, which is what the law holds and the excitation."""
    held = np.zeros((4, 4))  # the plant with its input as a state that does not change
    held[:3, :3], held[:3, 3] = PLANT, INPUT
    transition = kalman.discretise(held, np.zeros((4, 4)), STEP)[0][:3]
    x, command, t, noise = ca.SX.sym("x", 3), ca.SX.sym("command"), ca.SX.sym("t"), ca.SX.sym("noise", 0)
    given = command + peak_seeking.sine(t, excitation / GAIN, 2.0 * np.pi / rate)
    return ca.Function("plant", [x, command, t, noise], [ca.DM(transition) @ ca.vertcat(x, given)])


def _sensor() -> ca.Function:
    """Position, without noise, and value."""
    x, t, noise = ca.SX.sym("x", 3), ca.SX.sym("t"), ca.SX.sym("noise")
    return ca.Function("sensor", [x, t, noise], [ca.vertcat(x[0], function(x[0]) + np.sqrt(NOISE) * noise)])


def _commanded(law: peak_seeking.Seeker, steps: Array) -> ca.Function:
    """The law with the command in its memory: the first steps are given, the later ones are the seeker's."""
    memory, measured, t = ca.SX.sym("memory", law.initial().size + 1), ca.SX.sym("measured", 2), ca.SX.sym("t")
    new = law.update(memory[:-1], measured[0], measured[1])
    increment = law.step(new)
    number = t / PERIOD
    for k, step in enumerate(steps[1:].tolist(), start=1):
        increment = ca.if_else(ca.fabs(number - k) < 0.5, step, increment)
    command = memory[-1] + increment
    return ca.Function("commanded", [memory, measured, t], [ca.vertcat(new, command), command])
