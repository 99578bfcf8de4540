"""Figures of simulated phases: deviations over the whole time, a line where one phase ends and the next begins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from covocp.base.arguments import checked, optional, text, texts_by_name
from covocp.base.errors import ProblemError
from covocp.base.files import check_target, written_whole
from covocp.plot.figure import HEAD, PANEL, RESOLUTION, STYLE, SUFFIXES, _figure, _grid
from covocp.plot.legends import place_title
from covocp.simulation.clouds import chosen_parts, draw_band, draw_legend, draw_limits, limits_over_time

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from covocp.simulation.monte_carlo import MonteCarlo
    from covocp.simulation.phase_sample import PhasesMonteCarlo

Part = tuple["MonteCarlo", tuple[str, str, int]]


@checked("plot()", units=optional(texts_by_name), title=optional(text))
def plot_phase_runs(
    sample: PhasesMonteCarlo,
    *names: Any,
    units: Mapping[str, str] | None = None,
    title: str | None = None,
    path: str | Path | None = None,
) -> Figure:
    """Draw simulated phases over the whole time, a panel a quantity, each in the phases that have it.

    A panel has what `MonteCarlo.plot` draws of a phase; clouds at the end of a phase are drawn by `sample[name].plot`.

    Args:
        sample: what `simulate` returned for phases.
        names: symbols of any phase, or names; none: every state, control and estimated unknown.
        units: by name, for the axes, where the problems do not say.
        title: of the figure; by default the name of the phases. Where the prediction fails it is said below.
        path: also write the figure there (.png, .pdf or .svg).

    Returns:
        The figure.

    Raises:
        ProblemError: a name is unknown in all phases, or a pair.
        ExportError: the file cannot be written.
    """
    import matplotlib

    if path is not None:
        check_target(path, SUFFIXES)
    panels = _panels(sample, names)
    known = {b.name: b.unit for phase in sample for b in phase.blocks} | dict(units or {})
    rows, columns = _grid(len(panels))
    with matplotlib.rc_context(STYLE):
        figure = _figure((PANEL[0] * columns, PANEL[1] * rows + HEAD))
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        limited = False
        for place, parts in zip(axes, panels, strict=False):
            for phase, component in parts:
                draw_band(place, phase, component, known)
            limits = [entry for phase, component in parts for entry in limits_over_time(phase, component[2])]
            limited = draw_limits(place, limits) or limited
            for start in sample.starts[1:]:
                place.axvline(start, color="black", linewidth=0.6, linestyle=":", zorder=1)
            place.set_xlim(0.0, sample.starts[-1] + sample[-1].t[-1])
        for place in axes[len(panels) :]:
            place.set_visible(False)
        shown = title if title is not None else sample.name
        failing = "" if sample.holds else f"the linear prediction FAILS at the end of {', '.join(sample.failing)}"
        place_title(figure, (shown, failing), warning=not sample.holds)
        errors = any(component[2] < phase.size for parts in panels for phase, component in parts)
        draw_legend(figure, True, False, (), errors=errors, limits=limited)
        if path is not None:
            with written_whole(path, SUFFIXES) as part:
                figure.savefig(part, dpi=RESOLUTION)
    return figure


def _panels(sample: PhasesMonteCarlo, names: tuple[Any, ...]) -> list[list[Part]]:
    """For each quantity the phases that have it, with its row there, their times those of the whole."""
    found: dict[str, list[Part]] = {}
    missing: dict[int, ProblemError] = {}
    for start, phase in zip(sample.starts, sample, strict=True):
        moved = replace(phase, t=phase.t + start)
        for number, name in enumerate(names or (None,)):
            try:
                components, _ = chosen_parts(phase, () if name is None else (_single(name),))
            except ProblemError as error:
                missing.setdefault(number, error)
                continue
            for component in components:
                found.setdefault(f"{number} {component[0]}", []).append((moved, component))
    for number, unknown in missing.items():
        if not any(key.startswith(f"{number} ") for key in found):
            raise unknown
    return list(found.values())


def _single(name: Any) -> Any:
    """A name of a panel over time.

    Raises:
        ProblemError: a pair, whose cloud is that of one phase.
    """
    if isinstance(name, (tuple, list)):
        raise ProblemError(
            "Clouds are drawn of one phase.",
            expected="symbols or names",
            received=repr(name)[:100],
            remedy="sample[name of the phase].plot((a, b))",
        )
    return name
