"""Figures inside HTML."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING

from covocp.base.pages import Sentence
from covocp.plot.figure import apart_from_pyplot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Dots an inch: half as many again as a browser's, for fine screens, and no larger a page than it must be.
DOTS, BROWSERS = 144, 96


def embedded(draw: Callable[[], Figure], text: str = "the curves of the tables above") -> str:
    """A figure as an element of HTML that holds its picture (PNG).

    Args:
        draw: makes the figure; pyplot neither knows it nor changes by it.
        text: for those who cannot see it.

    Returns:
        The element `img`; a sentence where the figure cannot be drawn: what stands beside it is shown all the same.
    """
    stream = io.BytesIO()
    try:
        with apart_from_pyplot():
            figure = draw()
            figure.savefig(stream, format="png", dpi=DOTS)
    except Exception as error:  # whatever matplotlib or a fallen-back font raises: the tables are wanted
        reason = " ".join(str(error).split())[:200]
        return Sentence(f"The figure could not be drawn: {reason or type(error).__name__}", warning=True).html()
    width = round(figure.get_figwidth() * BROWSERS)
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return f'<img alt="{escape(text)}" style="width:{width}px;max-width:100%" src="data:image/png;base64,{data}">'
