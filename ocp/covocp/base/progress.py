"""Progress of an iteration on a terminal, silence elsewhere, and a Ctrl-C that stops between iterations."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any


class Progress:
    """A status line while a method iterates, and a flag that Ctrl-C sets.

    Used as a context manager around the iterations; `stop` tells the method to end after the present one. The second
    Ctrl-C interrupts at once.

    Args:
        title: what is being solved.
        show: whether to show the line; only ever shown when the standard error is a terminal.
    """

    def __init__(self, title: str, show: bool = True) -> None:
        """Nothing is shown before the context is entered."""
        self.stop = False
        self._title = title
        self._show = show and sys.stderr.isatty()
        self._status: Any = None
        self._previous: Any = None

    def __enter__(self) -> Progress:
        """Show the line and listen to Ctrl-C (in the main thread)."""
        if self._show:
            from rich.console import Console

            self._status = Console(stderr=True).status(self._title)
            self._status.start()
        if threading.current_thread() is threading.main_thread():
            self._previous = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the line and restore the handler of Ctrl-C."""
        if self._status is not None:
            self._status.stop()
            self._status = None
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)
            self._previous = None

    @property
    def shown(self) -> bool:
        """Whether somebody watches."""
        return self._show

    def update(self, iteration: int, cost: float, violation: float) -> None:
        """Report an iteration: its number, its cost, the largest violation of a constraint (scaled)."""
        if self._status is not None:
            self._status.update(f"{self._title}: iteration {iteration}, cost {cost:.8g}, violation {violation:.1e}")

    def say(self, what: str) -> None:
        """Report what is being done where nothing is iterated; a Ctrl-C since the last report interrupts here.

        Raises:
            KeyboardInterrupt: it was pressed.
        """
        if self.stop:
            raise KeyboardInterrupt
        if self._status is not None:
            self._status.update(f"{self._title}: {what}")

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.stop:
            raise KeyboardInterrupt
        self.stop = True
