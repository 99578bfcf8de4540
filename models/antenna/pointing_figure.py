"""The figure of an antenna pointing: the histories that the paper shows, and the path of the antenna axis."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from covocp.blocks import so3

if TYPE_CHECKING:
    from covocp.models.antenna.pointing_runs import PointingRuns

Array = npt.NDArray[np.float64]


def draw(runs: PointingRuns, run: int) -> Any:
    """Power, gradient errors with bounds, zones, torque, wheels, and paths on the sphere.

    Args:
        runs: what was flown.
        run: which run.

    Returns:
        The matplotlib figure.
    """
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(12, 12), layout="constrained")
    grid = figure.add_gridspec(4, 2)
    panels = [figure.add_subplot(grid[i, j]) for i, j in ((0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (2, 1))]
    power, *histories = panels
    bands = np.percentile(runs.power, [5.0, 95.0], axis=0)
    power.fill_between(runs.t, *bands, alpha=0.25, label=f"90 % of {len(runs.power)} runs")
    power.plot(runs.t, runs.power[run], label="power")
    power.axhline(runs.antenna.peak, color="k", ls=":", lw=0.8, label="greatest")
    power.set(ylabel="J [W]", title=f"{runs.filter}, settings {runs.settings}")
    _draw_zones(histories[0], runs, run)
    _draw_three(histories[1], runs.t, runs.torque[run], "wheel torque [N m]")
    _draw_three(histories[2], runs.t, np.degrees(runs.rate[run]), "angular velocity [deg/s]")
    _draw_three(histories[3], runs.t, runs.wheel_speed[run], "wheel speed [rad/s]")
    _draw_tilt(histories[4], runs, run)
    _draw_sphere(figure.add_subplot(grid[0:2, 1], projection="3d"), runs, run)
    for axes in panels:
        axes.set(xlim=(0.0, runs.t[-1]), xlabel="t [s]")
        axes.legend(fontsize="small", loc="lower right" if axes is power else "upper right")
        axes.grid(alpha=0.3)
    return figure


def draw_gradient(runs: PointingRuns, run: int) -> Any:
    """Errors of the estimated gradient within their bounds, an axis a panel.

    Args:
        runs: what was flown.
        run: which run.

    Returns:
        The matplotlib figure.
    """
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(3, 1, figsize=(9, 8), layout="constrained", sharex=True)
    error = runs.estimate.gradient[run] - runs.gradient[run]
    bound = 3.0 * runs.estimate.deviation[run]
    for axis, axes in enumerate(panels):
        axes.fill_between(runs.samples, -bound[:, axis], bound[:, axis], alpha=0.25, label="3 standard deviations")
        axes.plot(runs.samples, error[:, axis], lw=1.0, label="error")
        axes.set(ylabel=f"gradient about $b^{axis + 1}$ [W/rad]", xlim=(0.0, runs.t[-1]))
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize="small", loc="upper right")
    panels[0].set_title(f"{runs.filter}, settings {runs.settings}")
    panels[-1].set_xlabel("t [s]")
    return figure


def _draw_three(axes: Any, t: Array, values: Array, name: str) -> None:
    for axis in range(3):
        axes.plot(t, values[:, axis], lw=1.0, label=f"$b^{axis + 1}$")
    axes.set_ylabel(name)


def _draw_zones(axes: Any, runs: PointingRuns, run: int) -> None:
    """What must not be negative."""
    for k in range(runs.zone_values.shape[-1]):
        axes.plot(runs.t, runs.zone_values[run, :, k], label=f"zone {k + 1}")
    axes.axhline(0.0, color="k", lw=0.8)
    axes.set_ylabel("zones, kept where ≥ 0")


def _draw_tilt(axes: Any, runs: PointingRuns, run: int) -> None:
    """Angle between the antenna axis and the source, and where the guidance wants it."""
    for name, quaternions, t, source, style in (
        ("attitude", runs.attitude[run], runs.t, runs.source, "-"),
        ("desired", runs.desired[run], runs.samples, runs.source[np.searchsorted(runs.t, runs.samples - 0.05)], "."),
    ):
        along = np.einsum("kj,kj->k", so3.from_quaternion(quaternions)[:, 2], source)
        axes.plot(t, np.degrees(np.arccos(np.clip(along, -1, 1))), style, ms=2, lw=1.0, label=name)
    axes.set_ylabel("antenna axis to source [deg]")


def _draw_sphere(axes: Any, runs: PointingRuns, run: int) -> None:
    """Paths of the body axes in the inertial frame."""
    C = so3.from_quaternion(runs.attitude[run])
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    sphere = np.cos(angle) * np.sin(height), np.sin(angle) * np.sin(height), np.cos(height)
    axes.plot_wireframe(*sphere, color="0.85", lw=0.5)
    for axis, name in enumerate(("$b^1$", "$b^2$", "$b^3$, antenna")):
        (line,) = axes.plot(*C[:, axis].T, lw=1.2, label=name)
        axes.plot(*C[:1, axis].T, "o", color=line.get_color(), ms=4)
    axes.plot(*runs.source.T, "r*", ms=10, label="source")
    axes.set(
        xlabel="$a^1$", ylabel="$a^2$", zlabel="$a^3$", xticks=[], yticks=[], zticks=[], title="paths from the dots on"
    )
    axes.view_init(25, 150)
    axes.legend(fontsize="small", loc="upper left")
