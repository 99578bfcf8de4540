"""The figure of a formation flight: the map with the path, and the histories that the paper shows, in its units."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from covocp.models.formation.flight_runs import FlightRuns

Array = npt.NDArray[np.float64]

# Steps of the second differences that stand for the true Hessian [m]: about the circle of excitation.
DIFFERENCE = 0.7


def draw(runs: FlightRuns, run: int) -> Any:
    """Eight panels of one run, the benefit of all.

    Args:
        runs: what was flown.
        run: which run.

    Returns:
        The matplotlib figure.
    """
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(4, 2, figsize=(12, 14), layout="constrained")
    _draw_map(panels[0, 0], runs, run)
    _draw_benefit(panels[0, 1], runs, run)
    _draw_histories(panels[1:3].ravel(), runs, run)
    _draw_estimates(panels[3], runs, run)
    for axes in panels.ravel()[1:]:
        axes.set(xlim=(0.0, runs.t[-1]), xlabel="t [s]")
        axes.legend(fontsize="small")
        axes.grid(alpha=0.3)
    return figure


def _draw_map(axes: Any, runs: FlightRuns, run: int) -> None:
    """Drag around the best position, and the path."""
    path = runs.position[run]
    low, high = np.nanmin(path, axis=0) - 4.0, np.nanmax(path, axis=0) + 4.0
    y = np.linspace(min(low[0], -4.0), max(high[0], 4.0), 80)
    h = np.linspace(min(low[1], -4.0), max(high[1], 4.0), 80)
    grid = np.stack(np.meshgrid(y, h), axis=-1)
    drag, _ = runs.field.evaluate(grid + runs.field.best)
    lines = axes.contour(y, h, drag, 15, linewidths=0.8, cmap="viridis")
    axes.clabel(lines, fontsize="x-small", fmt="%.0f")
    axes.plot(*path.T, "k", lw=1.0)
    axes.plot(*path[0], "ks", label="start")
    axes.plot(0.0, 0.0, "r*", ms=10, label="least drag")
    axes.set(xlabel="to the right of the best position [m]", ylabel="above it [m]", title="induced drag [counts]")
    axes.legend(fontsize="small")


def _draw_benefit(axes: Any, runs: FlightRuns, run: int) -> None:
    """Drag of the run, what was measured, and the spread of all runs."""
    bands = np.nanpercentile(runs.drag, [5.0, 95.0], axis=0)
    axes.fill_between(runs.t, *bands, alpha=0.25, label=f"90 % of {len(runs.drag)} runs")
    axes.plot(runs.t, runs.drag[run], label="induced drag")
    axes.plot(runs.samples, runs.measured[run, :, 2], ".", label="measured, mean of 10 s")
    axes.axhline(runs.field.isolated, color="k", lw=0.8, ls="--", label="alone")
    axes.axhline(runs.field.at_best.drag, color="k", lw=0.8, ls=":", label="least")
    axes.set(ylabel="$C_{Di}$ [counts]")


def _draw_histories(panels: Any, runs: FlightRuns, run: int) -> None:
    """Distances, tracking errors, surfaces, attitude."""
    distances, errors, surfaces, attitude = panels
    for i, name in enumerate(("lateral", "vertical")):
        color = f"C{i}"
        distances.plot(runs.t, runs.position[run, :, i], color, label=name)
        distances.plot(runs.t, runs.command[run, :, i], color, ls="--", lw=0.8, label=f"{name}, commanded")
        errors.plot(runs.t, runs.tracking_error[run, :, i], color, label=name)
    distances.set(ylabel="distance from the best position [m]")
    errors.set(ylabel="tracking error [m]")
    for i, name in enumerate(("elevator", "aileron and spoilers", "rudder")):
        surfaces.plot(runs.t, np.degrees(runs.controls[run, :, i]), label=name)
    surfaces.set(ylabel="deflection [deg]")
    for i, name in enumerate(("roll", "pitch", "yaw")):
        attitude.plot(runs.t, np.degrees(runs.angles[run, :, i]), label=name)
    attitude.set(ylabel="attitude [deg]")


def _draw_estimates(panels: Any, runs: FlightRuns, run: int) -> None:
    """Gradient and Hessian with three standard deviations, against differences of the map."""
    slopes, curvatures = panels
    estimate, known = runs.estimate, runs.estimate.known[run]
    t = runs.samples[known]
    gradient, hessian = differences(runs, runs.measured[run, known, :2])
    pairs = [("lateral", 0), ("vertical", 1)]
    for name, i in pairs:
        given = (
            (slopes, estimate.gradient[run, known, i], estimate.gradient_deviation[run, known, i], gradient[:, i]),
            (
                curvatures,
                estimate.hessian[run, known, i, i],
                estimate.hessian_deviation[run, known, i, i],
                hessian[:, i],
            ),
        )
        for axes, mean, deviation, true in given:
            axes.fill_between(t, mean - 3 * deviation, mean + 3 * deviation, color=f"C{i}", alpha=0.15)
            axes.plot(t, mean, f"C{i}", label=f"{name}, 3 standard deviations")
            axes.plot(t, true, f"C{i}:", label=f"{name}, differences of the map")
    for axes, unit, truth in ((slopes, "gradient [counts/m]", gradient), (curvatures, "Hessian [counts/m²]", hessian)):
        span = 3.0 * np.abs(truth).max(initial=1.0)
        axes.set(ylabel=unit, ylim=(-span, span))


def differences(runs: FlightRuns, places: Array) -> tuple[Array, Array]:
    """Gradient and diagonal of the Hessian of the map by differences over 0.7 m.

    Inside the core of the vortices the map is far from quadratic: derivatives at a point would say little of what a
    filter sees that looks at the readings around it.

    Args:
        runs: whose map.
        places: (y, h), (L, 2) [m].

    Returns:
        [counts/m] and [counts/m^2], each (L, 2).
    """
    steps = DIFFERENCE * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    drag, _ = runs.field.evaluate(places[:, None] + steps)
    ahead, behind, here = drag[:, [1, 3]], drag[:, [2, 4]], drag[:, :1]
    return (ahead - behind) / (2 * DIFFERENCE), (ahead + behind - 2 * here) / DIFFERENCE**2
