"""What a notebook shows, read as a browser would."""

from __future__ import annotations

import base64
from html.parser import HTMLParser
from typing import Any

VOID = ("img", "br")


class Page(HTMLParser):
    """The words, tables and pictures of a piece of HTML; every element must be closed."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.words: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.tags: list[str] = []
        self.images: list[bytes] = []
        self.warnings: list[str] = []
        self._open: list[tuple[str, str]] = []
        self.feed(html)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, Any]]) -> None:
        self.tags.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        elif tag == "img":
            kind, _, data = dict(attrs)["src"].partition(";base64,")
            assert kind == "data:image/png"
            self.images.append(base64.b64decode(data, validate=True))
        if tag not in VOID:
            self._open.append((tag, dict(attrs).get("style") or ""))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop()[0] == tag

    def handle_data(self, data: str) -> None:
        self.words += data.split()
        tags = [tag for tag, _ in self._open]
        if "td" in tags or "th" in tags:
            self.tables[-1][-1][-1] += data
        if self._open and "bold" in self._open[-1][1]:
            self.warnings.append(data)


def letters(text: str) -> list[str]:
    """The characters of a text without blanks, sorted: folded columns of a printed table are read in another order."""
    return sorted("".join(text.split()))
