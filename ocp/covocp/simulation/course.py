"""Runs that go through several stretches: each begins where the one before it ended."""

from __future__ import annotations

from collections.abc import Callable

from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.simulation.batches import Batch, Cloud, run_stretch
from covocp.simulation.flown import LawFailedError
from covocp.simulation.junction import Junction
from covocp.simulation.plan import Plan


@dataclass(frozen=True, kw_only=True, eq=False)
class Course:
    """The plan of each stretch, and what carries the runs from one to the next; names of the stretches."""

    plans: tuple[Plan, ...]
    junctions: tuple[Junction, ...]
    names: tuple[str, ...]

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Legs:
    """What is kept of some runs: a batch for each stretch."""

    batches: tuple[Batch, ...]

    __repr__ = short_repr

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.batches[-1].runs


def run_course(course: Course, first: int, last: int, stop: Callable[[], bool] | None = None) -> Legs:
    """Simulate the runs first, ..., last - 1 through all stretches; see `run_batch`.

    Raises:
        LawFailedError: a law raised; in which phase is said.
        StoppedError: when `stop` said so.
    """
    cloud: Cloud | None = None
    found: list[Batch] = []
    for k, plan in enumerate(course.plans):
        try:
            batch, end = run_stretch(plan, first, last, stop, cloud)
        except LawFailedError as error:
            raise LawFailedError(f"in the phase '{course.names[k]}' {error}") from error
        found.append(batch)
        if k < len(course.junctions):
            cloud = course.junctions[k].carried(end)
    return Legs(batches=tuple(found))
