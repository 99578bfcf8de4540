"""Figures of simulations: deviations over time against the predicted bands, terminal clouds over the ellipses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.arguments import checked, optional, positives, text, texts_by_name
from covocp.base.checks import as_number
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.files import check_target, written_whole
from covocp.base.matrices import Array
from covocp.base.pages import WARNING
from covocp.plot.figure import (
    BAND,
    BOUND,
    COLOURS,
    HEAD,
    PANEL,
    RESOLUTION,
    STYLE,
    SUFFIXES,
    _figure,
    _folded,
    _grid,
)
from covocp.plot.legends import place_legend, place_title, plain_text
from covocp.plot.paths import outline
from covocp.simulation.rows import places
from covocp.statement.entries import error_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from covocp.simulation.monte_carlo import MonteCarlo

PREDICTED, SAMPLE, ERROR = COLOURS[0], COLOURS[1], COLOURS[2]
DASHED: Any = (0, (5, 1.6))
DOTTED: Any = (0, (1.2, 1.4))
GREY = "#777777"
# Half the width of a cloud's axes, in the larger of the predicted and the robust deviation.
VIEW = 4.5
# Runs drawn in a cloud, at most.
DOTS = 5000
SQUARE = 2.9  # inches, of a cloud


@checked("plot()", sigmas=positives, units=optional(texts_by_name), title=optional(text))
def plot_monte_carlo(
    sample: MonteCarlo,
    *names: Any,
    sigmas: Sequence[float] = (1.0, 2.0, 3.0),
    units: Mapping[str, str] | None = None,
    title: str | None = None,
    path: str | Path | None = None,
) -> Figure:
    """Draw a simulation: deviations from the nominal over time, and clouds at the end.

    A panel of deviations has the predicted standard deviation as a band, mean and standard deviation of the sample as
    dashed lines, and some runs; of states and unknowns also the errors of the filter, predicted and in the runs; of
    states and controls their limits. A cloud has the runs at the end, the predicted ellipses about the nominal and,
    dashed, those of the sample about its mean.

    Args:
        sample: what `simulate` returned.
        names: symbols or names, or entries of them ("p[0]"), for panels of deviations, pairs of them for clouds; none:
            a panel for every state, control and estimated unknown, a cloud for every two successive states or unknowns.
        sigmas: sizes of the ellipses in standard deviations.
        units: by name, for the axes, where the problem does not say.
        title: of the figure; by default the name of the problem. Where the prediction fails the verdict stands below.
        path: also write the figure there (.png, .pdf or .svg).

    Returns:
        The figure.

    Raises:
        ProblemError: a name is unknown, a pair is not of scalars, or a size is not positive.
        ExportError: the file cannot be written.
    """
    import matplotlib

    sizes = as_number("plot_monte_carlo", "sizes of the ellipses", list(sigmas)).ravel()
    if not (sizes > 0).all():
        raise _wrong("sigmas", "positive numbers of standard deviations", sigmas)
    if path is not None:
        check_target(path, SUFFIXES)
    known = {b.name: b.unit for b in sample.blocks} | dict(units or {})
    components, clouds = chosen_parts(sample, names)
    count = len(components) + len(clouds)
    rows, columns = _grid(count)
    height = PANEL[1] if not clouds else SQUARE
    with matplotlib.rc_context(STYLE):
        figure = _figure((PANEL[0] * columns, height * rows + HEAD))
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        limits = []
        for place, component in zip(axes, components, strict=False):
            draw_band(place, sample, component, known)
            limits.append(draw_limits(place, limits_over_time(sample, component[2])))
        for place, pair in zip(axes[len(components) :], clouds, strict=False):
            draw_cloud(place, sample, pair, known, tuple(sizes.tolist()))
        for place in axes[count:]:
            place.set_visible(False)
        _title(figure, sample, title)
        rows_shown = [row for _, _, row in components]
        errors = sample.estimated and any(row < sample.size for row in rows_shown)
        draw_legend(figure, bool(components), bool(clouds), tuple(sizes.tolist()), errors=errors, limits=any(limits))
        if path is not None:
            with written_whole(path, SUFFIXES) as part:
                figure.savefig(part, dpi=RESOLUTION)
    return figure


def chosen_parts(
    sample: MonteCarlo, names: tuple[Any, ...]
) -> tuple[list[tuple[str, str, int]], list[tuple[int, int]]]:
    """Components as (label, name of the symbol, row of y) and pairs of rows at the end."""
    n = sample.size
    found = places(sample)
    every = {}
    for rows, block in (found[b.name] for b in sample.blocks if b.name in found):
        entries = error_names((block,))
        every[block.name] = [(label, block.name, rows.start + i) for i, label in enumerate(entries)]
    if not names:
        moving = {b.name for b in sample.blocks if b.kind != "unknown" or sample.estimated}
        components = [entry for name, entries in every.items() for entry in entries if name in moving]
        return components, [(i, i + 1) for i in range(0, n - 1, 2)] + ([(n - 2, n - 1)] if n % 2 and n > 2 else [])
    components = []
    clouds = []
    for name in names:
        if not isinstance(name, (tuple, list)):
            block = sample.rows(name)[1]
            owner = block.name if block.name in every else block.name.split("[")[0]
            components += [entry for entry in every[owner] if block.name in (owner, entry[0])]
            continue
        if len(name) != 2:
            raise _wrong("names", "symbols, or pairs of them", name)
        pair = [sample.rows(key) for key in name]
        if any(block.size != 1 or block.kind == "control" for _, block in pair):
            raise _wrong("names", "pairs of scalar states or unknowns", name)
        clouds.append((pair[0][0].start, pair[1][0].start))
    return components, clouds


def _wrong(name: str, expected: str, received: Given) -> ProblemError:
    return ProblemError(
        f"The argument '{name}' of plot_monte_carlo() is wrong.",
        expected=expected,
        received=repr(received)[:100],
        remedy=f"correct {name}",
    )


def draw_band(axes: Axes, sample: MonteCarlo, component: tuple[str, str, int], units: Mapping[str, str]) -> None:
    """Deviations of one component over time."""
    label, name, row = component
    t, n = sample.t, sample.size
    for run in sample.paths[:, :, row]:
        axes.plot(t, run, color=GREY, linewidth=0.5, alpha=0.5)
    squares = sample.predicted[:, row, row] if row < n else sample.predicted_control[:, row - 2 * n, row - 2 * n]
    predicted = np.sqrt(squares.clip(0.0))
    axes.fill_between(t, -predicted, predicted, color=PREDICTED, alpha=BAND, linewidth=0)
    for edge in (-predicted, predicted):
        axes.plot(t, edge, color=PREDICTED, linewidth=1.2)
    mean = sample.moments.mean[:, row]
    spread = np.sqrt(np.maximum(sample.moments.product[:, row, row] - mean**2, 0.0))
    for curve, width in ((mean, 1.4), (mean - spread, 1.0), (mean + spread, 1.0)):
        axes.plot(t, curve, color=SAMPLE, linestyle=DASHED, linewidth=width)
    if sample.estimated and row < n:
        _draw_error(axes, sample, row)
    axes.axhline(0.0, color="black", linewidth=0.6, zorder=1)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(_folded(_label(label, units.get(name, ""))))
    axes.margins(x=0)


def draw_limits(axes: Axes, limits: list[tuple[Array, Array]]) -> bool:
    """Limits over time that come near what is drawn, if any; the view grows by no more than itself to show them."""
    low, high = axes.get_ylim()
    room = (low - (high - low), high + (high - low))
    near = [(t, limit) for t, limit in limits if limit.min() <= room[1] and limit.max() >= room[0]]
    for t, limit in near:
        axes.plot(t, limit, zorder=1, **BOUND)
    least, most = low, high
    if near:
        values = np.concatenate([limit for _, limit in near])
        least, most = float(values.min()), float(values.max())
    margin = 0.05 * (high - low)
    axes.set_ylim(min(low, max(least - margin, room[0])), max(high, min(most + margin, room[1])))
    return bool(near)


def _draw_error(axes: Axes, sample: MonteCarlo, row: int) -> None:
    """Standard deviation of the error of the estimate: as predicted, and of the runs."""
    predicted = np.sqrt(sample.predicted_error[:, row, row].clip(0.0))
    own = np.sqrt(np.maximum(sample.error_covariance(sample.augmented[row])[:, 0, 0], 0.0))
    for sign in (-1.0, 1.0):
        axes.plot(sample.t, sign * predicted, color=ERROR, linewidth=1.0)
        axes.plot(sample.t, sign * own, color=ERROR, linewidth=1.4, linestyle=DOTTED)


def limits_over_time(sample: MonteCarlo, row: int) -> list[tuple[Array, Array]]:
    """How far a control may deviate from its nominal, where there are limits; a state, to its bounds; over time."""
    n = sample.size
    if row >= 2 * n:
        column = row - 2 * n
        nominal, limits = sample.nominal_control[:, column], [float(limit[column]) for limit in sample.limits]
    else:
        bounds = [entry for entry in sample.inequalities.rows if entry.bound and entry.name == sample.augmented[row]]
        nominal, limits = sample.nominal[:, row], [v for entry in bounds for v in (entry.lower, entry.upper)]
    return [(sample.t, limit - nominal) for limit in limits if np.isfinite(limit)]


def _label(name: str, unit: str) -> str:
    return plain_text(f"deviation of {name}" + (f" [{unit}]" if unit else ""))


def draw_cloud(
    axes: Axes, sample: MonteCarlo, pair: tuple[int, int], units: Mapping[str, str], sigmas: tuple[float, ...]
) -> None:
    """Terminal scatter of two components, with the ellipses of the prediction and, about its mean, of the sample."""
    rows = list(pair)
    values = sample.deviations[sample.stayed][:, rows]
    predicted = sample.predicted[-1][np.ix_(rows, rows)]
    size = np.maximum(np.sqrt(np.diag(predicted)), np.median(np.abs(sample.deviations[:, rows]), axis=0) / 0.6745)
    view = VIEW * np.where(size > 0, size, 1.0)
    shown = values[:DOTS]
    axes.plot(shown[:, 0], shown[:, 1], linestyle="none", marker=".", markersize=1.8, color=GREY, alpha=0.5, zorder=1)
    mean = values.sum(axis=0) / max(1, len(values))
    own = (values - mean).T @ (values - mean) / max(1, len(values))
    for k in sigmas:
        axes.plot(*outline(predicted, k), color=PREDICTED, linewidth=1.4, zorder=3)
        axes.plot(*(mean[:, None] + outline(own, k)), color=SAMPLE, linewidth=1.2, linestyle=DASHED, zorder=3)
    axes.set_xlim(-view[0], view[0])
    axes.set_ylim(-view[1], view[1])
    beyond = int(np.count_nonzero((np.abs(values) > view).any(axis=1))) + int(np.count_nonzero(~sample.stayed))
    if beyond:
        text = f"{beyond} of {sample.runs} runs are outside"
        axes.text(0.02, 0.98, text, transform=axes.transAxes, va="top", fontsize=7, color=WARNING)
    labels = [sample.augmented[row] for row in rows]
    texts = [_label(f"{label} at T", units.get(label.split("[")[0], "")) for label in labels]
    axes.set_xlabel(texts[0])
    axes.set_ylabel(_folded(texts[1]))
    axes.locator_params(nbins=5)


def _title(figure: Figure, sample: MonteCarlo, title: str | None) -> None:
    """Name of the problem, and below it the verdict where the prediction fails."""
    flown = f", a law every {sample.period:.6g} s" if sample.filter == "law" else ""
    text = title if title is not None else sample.name + flown
    verdict = sample.verdict
    place_title(figure, (text, "" if verdict.holds else verdict.headline), warning=not verdict.holds)


def draw_legend(
    figure: Figure, bands: bool, clouds: bool, sigmas: tuple[float, ...], *, errors: bool, limits: bool
) -> None:
    """The legend of what is drawn."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = []
    if bands:
        handles.append(Patch(color=PREDICTED, alpha=2 * BAND, linewidth=0, label="predicted standard deviation"))
        handles.append(Line2D([], [], color=SAMPLE, linestyle=DASHED, label="mean and standard deviation of the runs"))
    if errors:
        handles.append(Line2D([], [], color=ERROR, linewidth=1.0, label="predicted error of the estimate"))
        handles.append(Line2D([], [], color=ERROR, linestyle=DOTTED, label="error of the estimate in the runs"))
    if limits:
        handles.append(Line2D([], [], label="limit", **BOUND))
    if clouds:
        widths = ", ".join(f"{k:g}" for k in sigmas)
        handles.append(Line2D([], [], color=PREDICTED, label=f"predicted ellipses ({widths} deviations)"))
        handles.append(Line2D([], [], color=SAMPLE, linestyle=DASHED, label="ellipses of the runs about their mean"))
    place_legend(figure, handles)
