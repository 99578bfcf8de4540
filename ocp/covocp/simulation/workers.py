"""Batches of runs, one after the other or on an executor; what is finished is kept, whatever happens to the rest."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable
from typing import Any, Generic, TypeVar, overload

from covocp.base.ctrl_c import LISTENER
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.short_repr import short_repr
from covocp.base.threads import TURN
from covocp.simulation.batches import Batch, StoppedError, run_batch
from covocp.simulation.course import Course, Legs, run_course
from covocp.simulation.flown import LawFailedError
from covocp.simulation.plan import Plan

# Seconds between two looks at the interrupt while an executor works.
PATIENCE = 0.2


# What is kept of some runs: a batch, or one for each stretch of a course.
Kept = TypeVar("Kept", Batch, Legs)


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Runs that were not simulated: from `first` up to, not including, `last`, and why."""

    first: int
    last: int
    reason: str

    def __str__(self) -> str:
        """The runs and the reason."""
        return f"runs {self.first} to {self.last - 1}: {self.reason}"


@dataclass(frozen=True, kw_only=True)
class Harvest(Generic[Kept]):
    """What came back: the batches by the number of their first run, failures, whether it was interrupted."""

    batches: tuple[Kept, ...]
    failures: tuple[Failure, ...]
    interrupted: bool

    __repr__ = short_repr


@overload
def simulate_batches(
    plan: Plan,
    ranges: list[tuple[int, int]],
    executor: Any,
    stop: Callable[[], bool],
    report: Callable[[Batch], None],
) -> Harvest[Batch]: ...


@overload
def simulate_batches(
    plan: Course,
    ranges: list[tuple[int, int]],
    executor: Any,
    stop: Callable[[], bool],
    report: Callable[[Legs], None],
) -> Harvest[Legs]: ...


def simulate_batches(
    plan: Plan | Course,
    ranges: list[tuple[int, int]],
    executor: Any,
    stop: Callable[[], bool],
    report: Callable[[Any], None],
) -> Harvest[Any]:
    """Simulate some ranges of runs.

    Args:
        plan: what is simulated: one stretch, or several that follow each other.
        ranges: first run of each batch, and the one after its last.
        executor: with the interface of `concurrent.futures`, or None: here, one after the other.
        stop: asked now and then; true to give up.
        report: called with each finished batch.
    """
    if executor is None:
        return _here(plan, ranges, stop, report)
    with TURN.handed_over():  # the executor may work in threads, whose laws may call CasADi
        return _elsewhere(plan, ranges, executor, stop, report)


def _work(plan: Plan | Course) -> Callable[..., Any]:
    """What simulates some runs of it."""
    return run_course if isinstance(plan, Course) else run_batch


def _here(
    plan: Plan | Course, ranges: list[tuple[int, int]], stop: Callable[[], bool], report: Callable[[Any], None]
) -> Harvest[Any]:
    done: list[Any] = []
    failures: list[Failure] = []
    try:
        for first, last in ranges:
            try:
                done.append(_work(plan)(plan, first, last, stop))
            except LawFailedError as error:
                failures.append(Failure(first=first, last=last, reason=_reason(error)))
            else:
                report(done[-1])
    except (StoppedError, KeyboardInterrupt):
        LISTENER.caught()
        return Harvest(batches=tuple(done), failures=(), interrupted=True)
    return Harvest(batches=tuple(done), failures=tuple(failures), interrupted=False)


def _elsewhere(
    plan: Plan | Course,
    ranges: list[tuple[int, int]],
    executor: Any,
    stop: Callable[[], bool],
    report: Callable[[Any], None],
) -> Harvest[Any]:
    """On an executor: a task that fails loses its runs only."""
    done: dict[int, Any] = {}
    failures: list[Failure] = []
    tasks: dict[Any, tuple[int, int]] = {}
    interrupted = False
    try:
        for first, last in ranges:
            try:
                tasks[_submit(executor, plan, first, last)] = (first, last)
            except RuntimeError as error:  # an executor that broke down, or was shut down
                failures.append(Failure(first=first, last=last, reason=_reason(error)))
        pending = set(tasks)
        while pending and not interrupted:
            finished, pending = concurrent.futures.wait(
                pending, timeout=PATIENCE, return_when=concurrent.futures.FIRST_COMPLETED
            )
            for future in finished:
                first, last = tasks[future]
                failure = None if future.cancelled() else future.exception()
                if future.cancelled() or failure is not None:
                    interrupted = interrupted or isinstance(failure, KeyboardInterrupt)
                    failures.append(Failure(first=first, last=last, reason=_reason(failure)))
                    continue
                done[first] = future.result()
                report(done[first])
            interrupted = interrupted or stop()
    except KeyboardInterrupt:
        LISTENER.caught()
        interrupted = True
    if interrupted:
        for future in tasks:
            future.cancel()
    return Harvest(
        batches=tuple(done[first] for first in sorted(done)),
        failures=() if interrupted else tuple(sorted(failures, key=lambda failure: failure.first)),
        interrupted=interrupted,
    )


def _submit(executor: Any, plan: Plan | Course, first: int, last: int) -> Any:
    """A task, as a future of `concurrent.futures`."""
    submit = getattr(executor, "submit", None)
    future = submit(_work(plan), plan, first, last) if callable(submit) else None
    if not isinstance(future, concurrent.futures.Future):
        raise ProblemError(
            "This executor cannot be used.",
            expected="the interface of concurrent.futures: ProcessPoolExecutor, mpi4py.futures.MPIPoolExecutor, or "
            "get_executor() of a Dask client",
            received=repr(executor)[:100],
            remedy="pass such an executor, or None to simulate in this process",
        )
    return future


def _reason(error: BaseException | None) -> str:
    """An error in one line."""
    if error is None:
        return "cancelled"
    lines = [line for line in str(error).splitlines() if line.strip()]
    if isinstance(error, LawFailedError):
        return lines[0].strip()
    return f"{type(error).__name__}: {lines[0].strip()}" if lines else type(error).__name__
