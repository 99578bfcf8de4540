"""Legends, titles and labels that stay within a figure: as many columns as fit, and the height that they need."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from covocp.base.pages import WARNING

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend

# Inches of a figure that are kept for title and legend when its size is chosen: one line of each.
LINE = 0.3
LETTERS = 11.5  # of a title, an inch
LEAST_LETTERS = 12
# Letters along the height of a panel, and along its width: of the axis, of entries in one column and in two.
LONGEST_LINE, LONGEST_ABSCISSA, LONGEST_ENTRY, LONGEST_HALF = 26, 44, 36, 18
MOST_LINES = 2  # of a name along the height of a panel
MANY = 4  # entries of a panel from which on two columns explain them
EDGE = 0.97  # share of the width that a legend may take


def place_legend(figure: Figure, handles: list[Any]) -> None:
    """A legend below all panels, in as many columns as fit into the width; long labels are folded.

    Constrained layout takes its height from the panels, so the figure grows by what a line of it does not hold.
    """
    if not handles:
        return
    for columns in range(len(handles), 0, -1):
        legend = figure.legend(handles=handles, loc="outside lower center", ncols=columns)
        if _size(figure, legend)[0] <= EDGE * figure.get_figwidth():
            break
        legend.remove()
    else:
        legend = _folded(figure, handles)
    height = _size(figure, legend)[1]
    if height > LINE:
        figure.set_figheight(figure.get_figheight() + height - LINE)


def _folded(figure: Figure, handles: list[Any]) -> Legend:
    """A legend of one column with its labels on several lines."""
    longest = max(len(str(handle.get_label())) for handle in handles)
    for letters in range(longest, LEAST_LETTERS - 1, -1):
        labels = [textwrap.fill(str(handle.get_label()), letters) for handle in handles]
        legend = figure.legend(handles=handles, labels=labels, loc="outside lower center", ncols=1)
        if _size(figure, legend)[0] <= EDGE * figure.get_figwidth() or letters == LEAST_LETTERS:
            return legend
        legend.remove()
    return figure.legend(handles=handles, loc="outside lower center", ncols=1)


def _size(figure: Figure, legend: Legend) -> tuple[float, float]:
    """Width and height of a legend in inches."""
    canvas: Any = figure.canvas
    renderer = canvas.get_renderer() if hasattr(canvas, "get_renderer") else None
    box = legend.get_window_extent(renderer)
    return box.width / figure.dpi, box.height / figure.dpi


def place_title(figure: Figure, lines: Iterable[str], *, warning: bool) -> None:
    """A title of the lines that are not empty, folded where they are longer than the figure is wide.

    The figure grows by the lines that are added.
    """
    letters = max(LEAST_LETTERS, int(LETTERS * figure.get_figwidth()))
    folded = [textwrap.fill(plain_text(line), letters) for line in lines if line]
    more = sum(text.count("\n") for text in folded)
    figure.set_figheight(figure.get_figheight() + more * LINE / 2)
    if folded:
        figure.suptitle("\n".join(folded), fontsize=10, color=WARNING if warning else "black")


def axis_label(label: str) -> str:
    """A label along the height of a panel: folded, its unit on a line of its own, and cut where that is not enough."""
    if len(label) <= LONGEST_LINE:
        return label
    name, bracket, unit = label.rpartition(" [")
    if not name or not unit.endswith("]"):
        name, bracket, unit = label, "", ""
    lines = textwrap.wrap(name, LONGEST_LINE) or [name]
    if len(lines) > MOST_LINES:
        lines = [*lines[: MOST_LINES - 1], cut(lines[MOST_LINES - 1] + " " + lines[MOST_LINES], LONGEST_LINE)]
    return "\n".join([*lines, *([cut(bracket.strip() + unit, LONGEST_LINE)] if unit else [])])


def entry_labels(entries: list[str]) -> tuple[list[str], int]:
    """Labels of the entries of a panel, cut to its width, and in how many columns they stand."""
    columns = 2 if len(entries) >= MANY and all(len(entry) <= LONGEST_HALF for entry in entries) else 1
    return [cut(entry, LONGEST_ENTRY) for entry in entries], columns


def cut(text: str, longest: int) -> str:
    """A text that ends with an ellipsis where it would be longer than so many letters."""
    return text if len(text) <= longest else text[: longest - 1].rstrip() + "…"


def plain_text(text: str) -> str:
    """Text in which a dollar sign is a dollar sign."""
    return text.replace("$", r"\$")
