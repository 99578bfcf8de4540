"""What a figure shows: its panels, curves, bands and legends."""

from __future__ import annotations

import numpy as np


def panels(figure):
    """Visible axes by their label."""
    return {axes.get_ylabel(): axes for axes in figure.axes if axes.get_visible()}


def main_lines(axes):
    """The curves: bands have thin edges, bounds two points."""
    return [line for line in axes.lines if line.get_linewidth() > 1.0 and len(line.get_xdata()) > 2]


def title_of(figure):
    return figure.get_suptitle()


def legend_of(figure):
    """Texts of the legends of the whole figure."""
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def values_of(figure, label, at=None):
    """Ordinates of the curves of a panel; `at`: those at some of the times."""
    return [_ordinates(line, at) for line in main_lines(panels(figure)[label])]


def _ordinates(line, at):
    return line.get_ydata() if at is None else line.get_ydata()[np.isin(line.get_xdata(), at)]


def edges_of(axes, at=None):
    """Ordinates of the edges of the bands, which are thin lines; `at`: those at some of the times."""
    return [_ordinates(line, at) for line in axes.lines if line.get_linewidth() < 0.8 and len(line.get_xdata()) > 2]


def entries_of(axes):
    """Texts of the legend of a panel."""
    legend = axes.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]
