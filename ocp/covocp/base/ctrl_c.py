"""A Ctrl-C that CasADi swallows: where it calls back into Python a KeyboardInterrupt comes out as a RuntimeError.

Of that error nothing says reliably what it was, and fallbacks for functions that cannot be evaluated take it for one of
theirs. So it is noted where the signal arrives, and raised again at the end of the call that lost it.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

# Without the conversion of their results to enumerations, which takes longer than what they do.
_bare = getattr(signal, "_signal", signal)
_set: Callable[[int, Any], Any] = _bare.signal
_get: Callable[[int], Any] = _bare.getsignal


class Listener:
    """Notes the KeyboardInterrupts that the handler of Ctrl-C raises; that handler, whosesoever it is, stays at work.

    Used as a context manager around calls, within which others may be. The main thread alone hears, and only where the
    handler is a function of Python.
    """

    def __init__(self) -> None:
        """Nothing is heard yet."""
        self._own = self._heard  # one object, which is told from other handlers
        self._previous: Any = signal.default_int_handler
        self._lost = False
        self._calls = threading.local()

    def __enter__(self) -> None:
        """Listen from now on."""
        depth = self._depth
        if depth == 0 and _in_main_thread():
            self._begin()
        self._calls.depth = depth + 1  # last: a signal before it leaves nothing to be undone

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End of a call; of the outermost one: listen no longer.

        Raises:
            KeyboardInterrupt: one was raised within, and something else came out.
        """
        self._calls.depth = depth = self._depth - 1
        if not _in_main_thread():
            return
        if depth == 0 and _get(signal.SIGINT) is self._own:  # else somebody has set another one meanwhile, which stays
            _set(signal.SIGINT, self._previous)
        if self._lost:
            self._lost = False
            if value is None or isinstance(value, Exception):
                raise KeyboardInterrupt from value

    def caught(self) -> None:
        """A KeyboardInterrupt was caught on purpose, by what tells of it: it is not lost."""
        self._lost = False

    @property
    def _depth(self) -> int:
        return int(getattr(self._calls, "depth", 0))

    def _begin(self) -> None:
        self._lost = False
        handler = _get(signal.SIGINT)
        if handler is self._own or not callable(handler):
            return
        before, self._previous = self._previous, handler
        try:
            _set(signal.SIGINT, self._own)
        except ValueError:  # another interpreter within the process
            self._previous = before

    def _heard(self, number: int, frame: FrameType | None) -> None:
        try:
            self._previous(number, frame)
        except KeyboardInterrupt:
            self._lost = True
            raise


def _in_main_thread() -> bool:
    return threading.get_ident() == threading.main_thread().ident


LISTENER = Listener()
