"""Figures of several phases over the whole time, with a line where one ends and the next begins, and at instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.arguments import checked, optional, positives, text, texts_by_name, truth
from covocp.base.expressions import Given
from covocp.base.files import check_target
from covocp.base.matrices import Array
from covocp.plot.curves import Bound, Curve, Panel, units_in
from covocp.plot.figure import SUFFIXES, drawn_figure
from covocp.plot.panels import abscissa_label, choose_panels
from covocp.solution.instants import instant_times
from covocp.solution.phases import PhasesSolution

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@checked(
    "plot()",
    costates=truth,
    sigmas=positives,
    units=optional(texts_by_name),
    title=optional(text),
)
def plot_phases(
    solution: PhasesSolution,
    *names: Any,
    costates: bool = False,
    over: Given = None,
    sigmas: Sequence[float] = (1.0,),
    units: Mapping[str, str] | None = None,
    title: str | None = None,
    path: str | Path | None = None,
) -> Figure:
    """Draw several phases over the whole time, a panel a quantity; each in the phases that have it.

    Args:
        solution: of the phases.
        names: what to draw, as of one solution: symbols of any phase, or names; None: states, controls and unknowns
            with bands, then covariances.
        costates: whether to draw the costates of the states and matrices drawn.
        over: what is the abscissa: the name of a scalar state or control; None: time, with a line between phases.
        sigmas: widths of the bands in standard deviations.
        units: by name, for the axes.
        title: of the figure; by default the name of the phases.
        path: also write the figure there (.png, .pdf or .svg).

    Returns:
        The figure.

    Raises:
        ProblemError: a name is unknown.
        ExportError: the file cannot be written.
    """
    if path is not None:
        check_target(path, SUFFIXES)
    phases = list(solution.phases)
    words = units_in(phases) | dict(units or {})
    panels = choose_panels(phases, names, costates=costates, over=over, units=words, phases=True)
    shifts = solution.starts if over is None else np.zeros(len(phases))
    return drawn_figure(
        [solution],
        [solution.name],
        [_joined(panel, shifts) for panel in panels],
        abscissa="time [s]" if over is None else abscissa_label(phases, over, words),
        sigmas=tuple(sigmas),
        title=title,
        path=path,
        marks=_marks(solution) if over is None else (),
        span=(0.0, solution.duration) if over is None else None,
    )


def _marks(solution: PhasesSolution) -> tuple[float, ...]:
    """Where phases meet, and the instants of conditions in them [s]."""
    pairs = zip(solution.starts.tolist(), solution.phases, strict=True)
    inside = [start + time for start, phase in pairs for time in instant_times(phase)]
    return (*solution.starts[1:].tolist(), *inside)


def _joined(panel: Panel, shifts: Array) -> Panel:
    """A panel of the phases as one of the whole time, each bound along the phase that has it."""
    moved = [replace(curve, t=curve.t + shifts[curve.order]) for curve in panel.curves]
    return replace(
        panel,
        curves=tuple(replace(curve, order=0) for curve in moved),
        bounds=tuple(_along(bound, moved) for bound in panel.bounds),
        ellipses=tuple(replace(ellipse, order=0) for ellipse in panel.ellipses),
    )


def _along(bound: Bound, curves: list[Curve]) -> Bound:
    """A bound as far as the curves of its phase go."""
    own = np.concatenate([curve.t for curve in curves if curve.order == bound.order])
    return bound._replace(span=(float(np.nanmin(own)), float(np.nanmax(own))))
