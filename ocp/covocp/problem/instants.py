"""Instants at which something happens: when a measurement is taken, as fractions of the terminal time."""

from __future__ import annotations

from typing import Any

import numpy as np

from covocp.base.checks import as_number, is_scalar, is_symbolic
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.problem.declarations import Declarations

# Share of the terminal time by which an instant may miss one of its ends, or another instant, and be the same.
SAME = 1e-12
# Instants of one measurement that still make a mesh that fits into a memory.
MOST = 10**5


def sampled_at(problem: Declarations, name: str, at: Given, every: Given, relative: bool) -> tuple[float, ...]:
    """When a measurement is taken, as rising fractions of the terminal time; none: always.

    Args:
        problem: of which the duration is read.
        name: of the measurement.
        at: instants [s], or fractions of T; None: as `every` says.
        every: period [s], or its fraction of T; the first instant is a period after the start. None: as `at` says.
        relative: whether they are fractions of T.

    Raises:
        ProblemError: both given, outside [0, T] or twice, a period longer than the duration, seconds where T is free.
    """
    if at is None and every is None:
        if relative:
            raise ProblemError(
                f"relative=True of the measurement '{name}' says nothing.",
                expected="relative=True beside at= or every=, which are fractions of the duration then",
                received="neither",
                remedy="give at= or every=; without them the measurement is continuous",
            )
        return ()
    if at is not None and every is not None:
        raise ProblemError(
            f"The instants of the measurement '{name}' are given twice.",
            expected="at=, the instants, or every=, the period",
            received="both",
            remedy="give one of them",
        )
    if problem.free_duration is not None and not relative:
        raise ProblemError(
            f"The measurement '{name}' is taken at instants in seconds, and the duration is free.",
            expected="fractions of the duration, with relative=True, or a fixed duration",
            received=f"at={at}" if at is not None else f"every={every}",
            remedy="write Problem.measurement(..., at=[0.25, 0.5, 1.0], relative=True)",
        )
    duration = 1.0 if relative else float(problem.duration)
    if every is not None:
        return _periodic(name, every, duration)
    return tuple(_checked(name, at, duration).tolist())


def _periodic(name: str, every: Given, duration: float) -> tuple[float, ...]:
    """The instants of a period."""
    numbers = as_number(name, "period every=", every)
    period = float(numbers.reshape(-1)[0]) if is_scalar(every) and numbers.size == 1 else np.nan
    if not 0 < period <= duration * (1 + SAME):
        raise ProblemError(
            f"The period of the measurement '{name}' does not fit.",
            expected=f"a number in (0, {duration:g}]: within the duration at least one is taken",
            received=f"every={every}",
            remedy="correct every=, or give the instants by at=",
        )
    count = int(np.floor(duration / period * (1 + SAME)))
    _check_count(name, count)
    return tuple(min(k * period / duration, 1.0) for k in range(1, count + 1))


def _checked(name: str, at: Given, duration: float) -> Array:
    """Instants that were given, divided by the duration."""
    if any(is_symbolic(entry) for entry in (at if isinstance(at, (list, tuple)) else [at])):
        raise ProblemError(
            f"The instants at= of the measurement '{name}' contain an expression.",
            expected="numbers: instants are nodes of every mesh, and are not chosen",
            received=f"at={at}"[:200],
            remedy="give numbers; to choose an instant end a phase of Free duration there, and measure at its end",
        )
    times = as_number(name, "instants at=", at).ravel()
    _check_count(name, times.size)
    shares = times / duration
    outside = ~((shares >= -SAME) & (shares <= 1 + SAME))
    if outside.any() or not shares.size:
        raise _refused(name, f"instants in [0, {duration:g}], at least one", times[outside])
    shares = np.clip(shares, 0.0, 1.0)
    for k in np.flatnonzero(np.diff(shares) <= SAME):
        same = abs(shares[k + 1] - shares[k]) <= SAME
        bad = f"{times[k]:g} twice" if same else f"{times[k + 1]:g} after {times[k]:g}"
        raise _refused(name, "instants that rise, each once", bad)
    return np.asarray(shares)


def _check_count(name: str, count: int) -> None:
    if count > MOST:
        raise _refused(name, f"at most {MOST} instants", count)


def _refused(name: str, expected: str, received: Any) -> ProblemError:
    listed = np.array2string(received, threshold=6) if isinstance(received, np.ndarray) else str(received)
    return ProblemError(
        f"The instants of the measurement '{name}' do not fit.",
        expected=expected,
        received=listed if listed != "[]" else "none",
        remedy="correct at= or every=; a measurement that is always there takes neither",
    )
