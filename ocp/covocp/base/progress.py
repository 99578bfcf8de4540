"""Progress of an iteration on a terminal, silence elsewhere, and a Ctrl-C that stops between iterations."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from types import FrameType, TracebackType
from typing import Any

from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

# The largest violation has fallen where it is less than this share of the least one before; what it is at most, in the
# units of the method, counts as none.
FALLEN, MET = 0.9, 1e-6
# So many iterates one after the other below the floor of the cost that violate less than this have lost their way.
LOST, NEAR = 10, 1e-2


@dataclass(kw_only=True)
class Course:
    """How the largest violation went in one run: its last iteration, the least of them, and where it last fell."""

    last: int
    least: float
    fell: int

    def goes_on(self, iteration: int, violation: float) -> None:
        """A further iteration."""
        self.last = iteration
        if violation < FALLEN * self.least:
            self.least, self.fell = violation, iteration

    __repr__ = short_repr


class Progress:
    """A status line while a method iterates, and a flag that Ctrl-C sets.

    Used as a context manager around the iterations; `stop` tells the method to end after the present one, because the
    user asked for it (`asked`) or because a limit is reached (`spent`). The second Ctrl-C interrupts at once.

    Args:
        title: what is being solved.
        show: whether to show the line; only ever shown when the standard error is a terminal.
        seconds: that may pass from entering the context on; None: no limit.
        iterations: that may be reported, beside that of the start; None: no limit.
        within: of what this is a part, with a limit of its own: it is told, and stops both.
        floor: of the cost: iterates below it that violate next to nothing, many of them, have lost their way.
    """

    def __init__(
        self,
        title: str,
        show: bool = True,
        *,
        seconds: float | None = None,
        iterations: int | None = None,
        within: Progress | None = None,
        floor: float = -math.inf,
    ) -> None:
        """Nothing is shown before the context is entered."""
        self._asked = False
        self._within, self._floor, self._below = within, floor, 0
        self._seconds, self._iterations = seconds, iterations
        self._begin, self._seen = time.perf_counter(), 0
        self._title = title
        self._courses: list[Course] = []
        self._show = show and sys.stderr.isatty()
        self._status: Any = None
        self._previous: Any = None

    def __enter__(self) -> Progress:
        """Show the line and listen to Ctrl-C (in the main thread)."""
        self._begin = time.perf_counter()
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
    def asked(self) -> bool:
        """Whether the user asked to stop."""
        return self._asked if self._within is None else self._within.asked

    @asked.setter
    def asked(self, value: bool) -> None:
        if self._within is None:
            self._asked = value
        else:
            self._within.asked = value

    @property
    def spent(self) -> str:
        """The limit that is reached, in words; "" where none is."""
        if self._iterations is not None and self._seen > self._iterations:
            return f"the limit of {self._iterations} iterations"
        if self._seconds is not None and time.perf_counter() - self._begin >= self._seconds:
            return f"the limit of {self._seconds:g} s"
        if self._below >= LOST:
            return f"a cost of {self._floor:.4g}, below which there is no solution"
        return "" if self._within is None else self._within.spent

    def believes(self, cost: float) -> bool:
        """Whether an iterate of this cost may be on the way to a solution."""
        return cost >= self._floor

    @property
    def limited(self) -> bool:
        """Whether a limit may end the iterations."""
        own = self._seconds is not None or self._iterations is not None or self._floor > -math.inf
        return own or (self._within is not None and self._within.limited)

    @property
    def left(self) -> tuple[float | None, int | None]:
        """Seconds, above zero, and iterations that are left to the limits; None: no limit."""
        past = time.perf_counter() - self._begin
        seconds = None if self._seconds is None else max(self._seconds - past, sys.float_info.min)
        return seconds, None if self._iterations is None else max(self._iterations - self._seen, 0)

    def count(self, iterations: int) -> None:
        """Iterations of another run that the limit is meant for too."""
        self._seen += iterations

    @property
    def stop(self) -> bool:
        """Whether the method should end."""
        return self.asked or bool(self.spent) or (self._within is not None and self._within.stop)

    @property
    def shown(self) -> bool:
        """Whether somebody watches."""
        return self._show if self._within is None else self._within.shown

    def update(self, iteration: int, cost: float, violation: float) -> None:
        """Report an iteration: its number, its cost, the largest violation of a constraint (scaled)."""
        self._seen += 1
        self._follow(iteration, violation)
        self._below = self._below + 1 if cost < self._floor and violation < NEAR else 0
        if self._within is not None:
            self._within.update(iteration, cost, violation)
        if self._status is not None:
            self._status.update(f"{self._title}: iteration {iteration}, cost {cost:.8g}, violation {violation:.1e}")

    def _follow(self, iteration: int, violation: float) -> None:
        """Keep how the violation goes; an iteration that is not after the last one begins another run."""
        if not self._courses or iteration <= self._courses[-1].last:
            self._courses.append(Course(last=iteration, least=violation, fell=iteration))
        else:
            self._courses[-1].goes_on(iteration, violation)

    def stalled(self, iterations: int) -> int:
        """For how many iterations the violation had not fallen where the last run of that many iterations ended.

        0 where there was no such run, or where it came to an iterate that violates nothing.
        """
        course = next((c for c in reversed(self._courses) if c.last == iterations), None)
        return 0 if course is None or course.least <= MET else course.last - course.fell

    def say(self, what: str) -> None:
        """Report what is being done where nothing is iterated; a Ctrl-C since the last report interrupts here.

        Raises:
            KeyboardInterrupt: it was pressed.
        """
        if self.asked:
            raise KeyboardInterrupt
        if self._status is not None:
            self._status.update(f"{self._title}: {what}")

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            if callable(self._previous):  # which may note it, where CasADi would lose it
                self._previous(number, frame)
            raise KeyboardInterrupt
        self.asked = True
