"""The same from several threads at once."""

from __future__ import annotations

import threading
from collections.abc import Callable


def in_threads(run: Callable[[int], None], count: int = 4) -> None:
    """Call with 0, 1, ... from a thread each, and wait for all."""
    threads = [threading.Thread(target=run, args=(k,)) for k in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
