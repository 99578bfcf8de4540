"""Figures of solutions: states with bands, controls, estimates, covariances, costates; several solutions in one."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.arguments import checked, either, optional, positives, sequence, text, texts_by_name, truth
from covocp.base.errors import ProblemError, no_option
from covocp.base.expressions import Given
from covocp.base.files import check_target, written_whole
from covocp.plot.curves import Bound, Panel, units_in
from covocp.plot.legends import (
    LONGEST_ABSCISSA,
    axis_label,
    cut,
    entry_labels,
    place_legend,
    place_title,
    plain_text,
)
from covocp.plot.panels import abscissa_label, choose_panels
from covocp.plot.paths import outline
from covocp.solution.instants import instant_times
from covocp.solution.origin import Origin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from covocp.solution.phases import PhasesSolution
    from covocp.solution.solution import Solution

SUFFIXES = (".png", ".pdf", ".svg")
# Okabe and Ito's palette, distinct for all kinds of colour vision and in grey: blue, vermillion, green, purple, orange,
# sky blue, black.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.6)), (0, (1.2, 1.4)), (0, (6, 1.5, 1.2, 1.5)), (0, (3, 1.2)))
BOUND: dict[str, Any] = {"color": "#666666", "linewidth": 0.8, "linestyle": (0, (4, 3))}
MARK: dict[str, Any] = {"color": "#999999", "linewidth": 0.7, "linestyle": (0, (1, 2))}  # between phases
TARGET: dict[str, Any] = {
    "marker": "o",
    "markersize": 4.5,
    "markerfacecolor": "white",
    "markeredgecolor": "black",
    "markeredgewidth": 0.9,
}
START: dict[str, Any] = {"marker": "s", "markersize": 4.0, "markerfacecolor": "black", "markeredgecolor": "black"}
ELLIPSE_WIDTH = 0.7
PATH_MARGIN = 0.05  # of the range, on both sides
BAND = 0.13  # opacity
HATCH = "////"  # of bands that a probability asks to be inside limits: others show a spread
NEAR = 0.2  # of the range of the curves: bounds farther away are not drawn
# Curves that change by less than this share of their size are drawn as constants: what is left is a solver's tolerance.
CONSTANT = 1e-5
CONSTANT_RANGE = 0.05  # of the value, on both sides
PANEL = (3.3, 2.15)  # width, height in inches
SINGLE = (4.8, 3.2)  # of a panel alone
INSIDE, BESIDE = 4, 12  # entries that a legend within a panel explains, and one beside it, which is as high
HEAD = 0.6  # inches for title and legend
RESOLUTION = 200  # dots an inch
# Backends of matplotlib that show nothing by themselves.
SILENT = ("agg", "cairo", "pdf", "pgf", "ps", "svg", "template")
# Whether figures may become pyplot's, which then has one more open and another that is current.
_FOR_PYPLOT = ContextVar("for_pyplot", default=True)
STYLE: Any = {
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": True,
    "grid.linewidth": 0.4,
    "grid.color": "#DDDDDD",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "legend.handlelength": 2.6,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}


@checked(
    "plot()",
    labels=optional(either(text, sequence)),
    costates=truth,
    gains=truth,
    sigmas=positives,
    units=optional(texts_by_name),
    title=optional(text),
)
def plot_solutions(
    solutions: Sequence[Solution],
    *names: Any,
    labels: Sequence[str] | None = None,
    costates: bool = False,
    gains: bool = False,
    over: Given = None,
    sigmas: Sequence[float] = (1.0,),
    units: Mapping[str, str] | None = None,
    title: str | None = None,
    path: str | Path | None = None,
) -> Figure:
    """Draw solutions over time, a panel a quantity, with a line at the instants of conditions.

    Args:
        solutions: one or more, of the same problem or of problems with the same names.
        names: what to draw: symbols or names of states, controls, unknowns and matrices, or entries of them ("p[0]"),
            pairs of states and unknowns (entries of the covariance of the actual deviations), other expressions of the
            problem's symbols; a list of them shares a panel: plot(["x", "y"]). Besides
            "rms" (root mean squares), "C" and "K" (gains of feedback and filter), "X", "Xhat" and "Z" (covariances of
            the closed loop); ("rms", h), ("C", h), ("K", h) those of one symbol, or of an expression ("rms"). A dict
            gives labels: {"load factor [g]": expression}. None: states, controls and unknowns with bands, then
            covariances and other matrices (of large ones the diagonal), of a closed loop root mean squares instead;
            and what `chance` states along the path, each with a band that must be inside its limits (also by its name).
        labels: of the solutions, for the legend; by default what tells them apart.
        costates: whether to draw the costates of the states and matrices drawn.
        gains: whether to add the gains of feedback and filter.
        over: what is the abscissa: a scalar state, control or expression; None: time. Of one state over another the
            figure is a path, with ellipses of their covariance in place of bands, and axes of the same scale where the
            units agree.
        sigmas: widths of the bands in standard deviations, such as (1, 3); (): none. The bands are those of the actual
            states, of what the feedback adds to the controls, and of the estimates of the unknowns.
        units: by name, for the axes, such as {"y": "m"}, where the problem does not say or says something else.
        title: of the figure; by default the name of the problem. A solution that did not converge is named below it.
        path: also write the figure there (.png, .pdf or .svg).

    Returns:
        The figure. It belongs to pyplot (so that it can be shown) only where an interactive backend is active.

    Raises:
        ProblemError: no solution, a name is unknown, or the labels do not fit.
        ExportError: the file cannot be written.
    """
    if path is not None:
        check_target(path, SUFFIXES)
    given = list(solutions)
    legend = _labels(given, labels)
    known = units_in(given)
    strange = [name for name in units or {} if name not in known]
    if strange:
        raise ProblemError(
            f"The units of '{strange[0]}' are those of nothing in the solution.",
            expected=f"names among {', '.join(sorted(known))}",
            received=f"units={{'{strange[0]}': ...}}",
            remedy="correct the name, or leave it out",
        )
    words = known | dict(units or {})
    panels = choose_panels(given, names, costates=costates, gains=gains, over=over, units=words)
    abscissa = "time [s]" if over is None else abscissa_label(given, over, words)
    marks = {time: None for solution in given for time in instant_times(solution)} if over is None else {}
    drawing: dict[str, Any] = {"sigmas": tuple(sigmas), "title": title, "path": path, "marks": tuple(marks)}
    return drawn_figure(given, legend, panels, abscissa=abscissa, **drawing)


def drawn_figure(
    given: Sequence[Solution | PhasesSolution],
    legend: list[str],
    panels: list[Panel],
    *,
    abscissa: str,
    sigmas: tuple[float, ...],
    title: str | None,
    path: str | Path | None,
    marks: tuple[float, ...] = (),
    span: tuple[float, float] | None = None,
) -> Figure:
    """The figure of some panels.

    Args:
        given: what they are of.
        legend: labels of these.
        panels: their curves.
        abscissa: its label.
        sigmas: widths of the bands.
        title: of the figure; None: the name.
        path: where it is written too, or None.
        marks: places along the abscissa where a line is drawn.
        span: of the abscissa of all panels; None: of their curves.
    """
    import matplotlib

    rows, columns = _grid(len(panels))
    with matplotlib.rc_context(STYLE):
        width, height = SINGLE if len(panels) == 1 else PANEL
        figure = _figure((width * columns, height * rows + HEAD))
        axes = figure.subplots(rows, columns, squeeze=False)
        for place, panel in zip(axes.ravel(), panels, strict=False):
            _draw(place, panel, len(given), sigmas)
            for mark in marks:
                place.axvline(mark, zorder=1, **MARK)
            if span is not None:
                place.set_xlim(*span)
        _arrange(figure, axes, len(panels), abscissa)
        _title(figure, given, legend, title)
        _legend(figure, given, legend, panels, sigmas)
        if path is not None:
            with written_whole(path, SUFFIXES) as part:
                figure.savefig(part, dpi=RESOLUTION)
    return figure


def check_plot_options(given: Mapping[str, Any], function: Callable[..., Any] = plot_solutions) -> None:
    """Options of a figure must be those of the function that draws it.

    Raises:
        ProblemError: one is not.
    """
    parameters = inspect.signature(function).parameters.values()
    known = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    for name, value in given.items():
        if name not in known:
            raise no_option("plot()", name, value, known)


def _arrange(figure: Figure, axes: Any, count: int, abscissa: str) -> None:
    """Hide the places without panels, and label the lowest panel of each column."""
    rows, columns = axes.shape
    for place in axes.ravel()[count:]:
        place.set_visible(False)
    for column in range(columns):
        last = max(row for row in range(rows) if row * columns + column < count)
        axes[last, column].set_xlabel(plain_text(cut(abscissa, LONGEST_ABSCISSA)))
    figure.align_ylabels(list(axes.ravel()[:count]))


def _labels(solutions: list[Solution], labels: Sequence[str] | None) -> list[str]:
    """Labels of the solutions: the given ones, else methods or names where they differ, else numbers."""
    if not solutions:
        raise ProblemError(
            "There is nothing to draw.", expected="at least one solution", received="none", remedy="solve first"
        )
    if labels is not None:
        words = [str(label) for label in labels]
        if isinstance(labels, str) or len(words) != len(solutions):
            raise ProblemError(
                "The labels do not fit the solutions.",
                expected=f"{len(solutions)} labels",
                received=repr(labels),
                remedy="give one label for each solution",
            )
        return words
    for candidates in ([s.method for s in solutions], [s.name for s in solutions], [_kind(s) for s in solutions]):
        if len(set(candidates)) == len(solutions):
            return candidates
    return [f"{i + 1}: {s.method}" for i, s in enumerate(solutions)]


def _kind(solution: Solution) -> str:
    """How the nominal came about."""
    if solution.method == "evaluate":
        return "evaluated"
    return "classical" if solution.origin is Origin.CLASSICAL else "combined"


def _grid(count: int) -> tuple[int, int]:
    """Rows and columns for a number of panels."""
    columns = 1 if count == 1 else 2 if count in (2, 4) else 3
    return -(-count // columns), columns


def _figure(size: tuple[float, float]) -> Figure:
    """An empty figure: pyplot's where it can be shown, else one that no global state knows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    pyplot = sys.modules.get("matplotlib.pyplot")
    if pyplot is None and hasattr(sys, "ps1") and _FOR_PYPLOT.get():
        import matplotlib.pyplot as pyplot
    if pyplot is not None and _FOR_PYPLOT.get():
        backend = pyplot.get_backend().lower()
        if backend not in SILENT and "inline" not in backend:
            shown: Figure = pyplot.figure(figsize=size, layout="constrained")
            return shown
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


@contextmanager
def apart_from_pyplot() -> Iterator[None]:
    """Within this no figure becomes pyplot's, whatever the backend."""
    token = _FOR_PYPLOT.set(False)
    try:
        yield
    finally:
        _FOR_PYPLOT.reset(token)


def _title(
    figure: Figure, solutions: Sequence[Solution | PhasesSolution], labels: list[str], title: str | None
) -> None:
    """Name of the problem, and below it a warning of solutions that did not converge."""
    names = list(dict.fromkeys(s.name for s in solutions if s.name))
    text = title if title is not None else names[0] if len(names) == 1 else ""
    failed = [
        f"{label}: {s.status}" if len(solutions) > 1 else s.status
        for s, label in zip(solutions, labels, strict=True)
        if not s.converged
    ]
    place_title(figure, (text, *failed), warning=bool(failed))


def _legend(
    figure: Figure,
    solutions: Sequence[Solution | PhasesSolution],
    labels: list[str],
    panels: list[Panel],
    sigmas: tuple[float, ...],
) -> None:
    """Which solution is which, and what bands, circles and thin dashes mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = []
    if len(solutions) > 1:
        handles += [
            Line2D([], [], label=plain_text(label if s.converged else f"{label} (not converged)"), **_line(i))
            for i, (s, label) in enumerate(zip(solutions, labels, strict=True))
        ]
    curves = [curve for panel in panels for curve in panel.curves]
    widths = " and ".join(f"{width:g}" for width in sigmas) + " standard deviation"
    widths += "s" if sigmas and sigmas[-1] != 1 else ""
    if sigmas and any(curve.deviation is not None for curve in curves):
        handles.append(Patch(color="#555555", alpha=2 * BAND, linewidth=0, label=f"± {widths}"))
    if any(curve.needed is not None for curve in curves):
        label = "must be inside the limits" if handles else "band: must be inside the limits"
        handles.append(Patch(color="#555555", alpha=2 * BAND, linewidth=0, hatch=HATCH, label=label))
    if sigmas and any(panel.ellipses for panel in panels):
        handles.append(Line2D([], [], color="#555555", linewidth=ELLIPSE_WIDTH, label=f"ellipses of {widths}"))
    if any(panel.path for panel in panels):
        handles.append(Line2D([], [], linestyle="none", label="start", **START))
    if any(curve.target is not None for curve in curves):
        handles.append(Line2D([], [], linestyle="none", label="required at the end", **TARGET))
    if any(_near_bounds(panel) for panel in panels):
        handles.append(Line2D([], [], label="bound", **BOUND))
    place_legend(figure, handles)


def _line(i: int) -> dict[str, Any]:
    """Colour, dashes and width of the i-th line; later ones are thinner, so that equal curves all show."""
    return {
        "color": COLOURS[i % len(COLOURS)],
        "linestyle": DASHES[i % len(DASHES)],
        "linewidth": 2.0 if i == 0 else 1.4,
    }


def _draw(axes: Axes, panel: Panel, count: int, sigmas: tuple[float, ...]) -> None:
    """One panel: bands, lines, targets, bounds, legend of its entries.

    One solution: the entries differ by colour. Several: the solutions differ by colour, the entries by dashes.
    """
    grouped = len(panel.entries) > 1
    for curve in panel.curves:
        line = _line(curve.order if count > 1 else curve.entry)
        style: Any = "steps-post" if curve.steps else "default"
        if count > 1 and grouped:
            line["linestyle"] = DASHES[curve.entry % len(DASHES)]
        for width in sorted(sigmas, reverse=True):
            if curve.deviation is None:
                break
            low, high = curve.y - width * curve.deviation, curve.y + width * curve.deviation
            step: Any = "post" if curve.steps else None
            axes.fill_between(curve.t, low, high, color=line["color"], alpha=BAND, linewidth=0, step=step)
            for edge in (low, high):
                axes.plot(curve.t, edge, color=line["color"], linewidth=0.5, alpha=0.7, drawstyle=style)
        if curve.needed is not None:
            low, high = curve.y - curve.needed[0], curve.y + curve.needed[1]
            axes.fill_between(curve.t, low, high, color=line["color"], alpha=BAND, linewidth=0, hatch=HATCH)
            axes.plot(curve.t, np.column_stack([low, high]), color=line["color"], linewidth=0.5, alpha=0.7)
        axes.plot(curve.t, curve.y, drawstyle=style, **line)
    for ellipse in panel.ellipses:
        for width in sigmas:
            x, y = ellipse.centre[:, None] + outline(ellipse.covariance, width)
            axes.plot(x, y, color=_line(ellipse.order)["color"], linewidth=ELLIPSE_WIDTH, alpha=0.8)
    _targets(axes, panel)
    for bound in _near_bounds(panel):
        if bound.span is None:
            axes.axhline(bound.value, zorder=1, **BOUND)
        else:
            axes.plot(bound.span, (bound.value, bound.value), zorder=1, **BOUND)
    axes.set_ylabel(plain_text(_folded(panel.label)))
    axes.margins(x=PATH_MARGIN if panel.path else 0)
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    low, high = axes.dataLim.intervaly
    size = max(abs(low), abs(high))
    if 0 < high - low < CONSTANT * size:
        axes.set_ylim(low - CONSTANT_RANGE * size, high + CONSTANT_RANGE * size)
    if grouped and panel.legend:
        _entry_legend(axes, panel, count)


def _targets(axes: Axes, panel: Panel) -> None:
    """Circles where states must arrive, and squares where paths start."""
    for curve in panel.curves:
        if panel.path:
            axes.plot(curve.t[:1], curve.y[:1], linestyle="none", zorder=5, **START)
        if curve.target is not None:
            axes.plot([curve.t[-1]], [curve.target], linestyle="none", clip_on=False, zorder=5, **TARGET)


def _near_bounds(panel: Panel) -> list[Bound]:
    """The bounds that the curves come near."""
    reached = [curve.y for curve in panel.curves]
    for curve in panel.curves:
        reached += [] if curve.needed is None else [curve.y - curve.needed[0], curve.y + curve.needed[1]]
    finite = np.concatenate([np.zeros(0), *(values[np.isfinite(values)] for values in reached)])
    if not finite.size:
        return []
    low, high = float(finite.min()), float(finite.max())
    margin = NEAR * (high - low)
    return [bound for bound in panel.bounds if low - margin <= bound.value <= high + margin]


def _entry_legend(axes: Axes, panel: Panel, count: int) -> None:
    """Which entry is which: within the panel, or beside it where so many curves leave no room."""
    from matplotlib.lines import Line2D

    shown = sorted({curve.entry for curve in panel.curves})
    labels, columns = entry_labels([panel.entries[k] for k in shown])
    handles = []
    for k, label in zip(shown, labels, strict=True):
        style = _line(k) if count == 1 else {"color": "#555555", "linestyle": _line(k)["linestyle"]}
        handles.append(Line2D([], [], label=plain_text(label), **style))
    look: dict[str, Any] = {"fontsize": 7, "handlelength": 2.0, "labelspacing": 0.3}
    if columns > 1 and INSIDE < len(handles) <= BESIDE:
        axes.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5), **look)
    else:
        axes.legend(handles=handles, ncols=columns, **look)


def _folded(label: str) -> str:
    """A label along the height of a panel, as it is shown; dollar signs are still those of the name."""
    return axis_label(label)
