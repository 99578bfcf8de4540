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

    @property
    def lost(self) -> bool:
        """Whether another start may lead somewhere."""
        return False

    @property
    def judged(self) -> bool:
        """Whether the point may be stationary, although the run does not say so."""
        return False
