"""How a run ends: a kind, said in words, with what to do then."""

from __future__ import annotations

from enum import Enum


class Ending(Enum):
    """The endings of a method are an enum of this kind."""

    words: str
    advice: str

    def __str__(self) -> str:
        """In words, with what to do."""
        return f"{self.words}: {self.advice}" if self.advice else self.words
