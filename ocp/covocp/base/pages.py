"""What is shown of an object: sections of sentences and tables, as plain text and as HTML with the same words."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from covocp.base.dataclass import dataclass

# Columns of plain text.
WIDTH = 100
# Colour of a sentence that warns, that of warnings in figures too.
WARNING = "#A8002D"
# Styles of Jupyter and of others set all cells right and stretch tables: what is told here wins.
LEFT, RIGHT = (f"text-align:{side};vertical-align:top;padding:0.1em 0.6em" for side in ("left", "right"))
TABLE = "border-collapse:collapse;width:auto;margin:0.6em 0"


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of words and numbers.

    Attributes:
        columns: headings; all empty: none is shown.
        rows: entries, one list a row.
        words: columns that are set left; the others hold numbers and are set right.
        code: columns of expressions, which HTML sets in the type of code.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: tuple[int, ...] = (0,)
    code: tuple[int, ...] = ()

    def text(self) -> str:
        """Lines without trailing blanks, at most 100 columns wide; long words are folded."""
        from rich.console import Console
        from rich.table import Table as Rich
        from rich.text import Text

        table = Rich(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=any(self.columns))
        for i, column in enumerate(self.columns):
            left = i in self.words
            table.add_column(Text(column), justify="left" if left else "right", overflow="fold", no_wrap=not left)
        for row in self.rows:
            table.add_row(*(Text(entry) for entry in row))
        stream = io.StringIO()
        Console(file=stream, width=WIDTH, color_system=None, force_terminal=False, force_jupyter=False).print(table)
        return "\n".join(line.rstrip() for line in stream.getvalue().rstrip("\n").splitlines())

    def html(self) -> str:
        """The element `table`."""
        head = f"<thead>{self._row(self.columns, 'th')}</thead>" if any(self.columns) else ""
        body = "".join(self._row(row, "td") for row in self.rows)
        return f'<table style="{TABLE}">{head}<tbody>{body}</tbody></table>'

    def _row(self, entries: Sequence[str], cell: str) -> str:
        """A row of cells of one kind."""
        cells = []
        for i, entry in enumerate(entries):
            shown = escape(entry)
            if i in self.code and entry and cell == "td":
                shown = f"<code>{shown}</code>"
            cells.append(f'<{cell} style="{LEFT if i in self.words else RIGHT}">{shown}</{cell}>')
        return f"<tr>{''.join(cells)}</tr>"


@dataclass(frozen=True)
class Sentence:
    """A paragraph.

    Attributes:
        words: what it says.
        indent: of its second and later lines in plain text.
        warning: whether it says that something went wrong, which HTML shows in colour.
    """

    words: str
    indent: str = "  "
    warning: bool = False

    def text(self) -> str:
        """Lines of at most 100 columns."""
        return textwrap.fill(self.words, WIDTH, subsequent_indent=self.indent, break_long_words=True)

    def html(self) -> str:
        """The element `p`."""
        style = f"margin:0.3em 0;color:{WARNING};font-weight:bold" if self.warning else "margin:0.3em 0"
        return f'<p style="{style}">{escape(self.words)}</p>'


Part = Table | Sentence
Section = Sequence[Part]


def as_text(sections: Iterable[Section]) -> str:
    """Sections as plain text: a blank line between them; those that are empty are left out."""
    return "\n\n".join("\n".join(part.text() for part in section) for section in sections if section)


def as_html(sections: Iterable[Section], figure: str = "") -> str:
    """Sections as HTML, the words those of the plain text; a figure, an element of HTML, below them."""
    parts = "".join(part.html() for section in sections for part in section)
    return f'<div class="covocp">{parts}{figure}</div>'


def lines_as_html(text: str) -> str:
    """Plain text without tables as HTML, a paragraph a line."""
    return as_html([[Sentence(line) for line in text.splitlines()]])


def number(value: float | None, digits: int = 8) -> str:
    """A number for a table; "-" where there is none."""
    return "-" if value is None or np.isnan(value) else f"{value:.{digits}g}"
