"""A plant at a fast rate with a law at a slow one, simulated for many runs at once.

For laws with a memory of their own, such as those of peak seeking: once in a period the law is given the mean of what
was measured in it, and what it answers is held until the next. Every run has its own stream of random numbers, so run i
is the same whatever the number of runs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from covocp.base.arguments import checked, optional, positive, truth, whole
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.short_repr import short_repr
from covocp.base.threads import one_at_a_time
from covocp.blocks import values
from covocp.simulation.divergence import farthest, in_range
from covocp.simulation.vectorised import Columns, padded, vectorise

Array = NDArray[np.float64]
# (memory, measured, t) -> (memory, held): a casadi.Function, or a Python function of arrays.
SampledLaw = Callable[..., Any]

# Periods in a run, and steps in a period, at most.
MOST = 1e7
# Relative deviation of a ratio of times from a whole number that is rounding.
WHOLE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledSimulation:
    """Histories of all runs, of the plant at K times and of the law at L times.

    Attributes:
        t: times of the plant, (K,) [s].
        x: its state, (runs, K, n); NaN after a run has diverged.
        held: what the law held until then, (runs, K, m).
        samples: times at which the law ran, (L,) [s].
        measured: what it was given, (runs, L, p).
        memory: its memory afterwards, (runs, L, size).
        diverged: whether a run left the range of numbers, (runs,): its state grew 1e15 times beyond 1, its start and
            the way that its first step makes of the duration, or is no number any more.
    """

    t: Array
    x: Array
    held: Array
    samples: Array
    measured: Array
    memory: Array
    diverged: NDArray[np.bool_]

    __repr__ = short_repr


def _function_of(count: int, names: str) -> Callable[[Any], str]:
    """A casadi.Function of so many inputs."""

    def kind(value: Given) -> str:
        fits = isinstance(value, ca.Function) and (value.n_in(), value.n_out()) == (count, 1)
        return "" if fits else f"a casadi.Function of ({names}) with one result"

    return kind


@one_at_a_time
@checked(
    plant=_function_of(4, "x, held, t, noise"),
    sensor=_function_of(3, "x, t, noise"),
    law=lambda law: "" if callable(law) else "a casadi.Function or a Python function of (memory, measured, t)",
    step=positive,
    period=positive,
    duration=positive,
    runs=whole(1, 10**6),
    seed=whole(0, None),
    average=truth,
    reading=optional(_function_of(3, "memory, measured, t")),
    every=whole(1),
)
def simulate_sampled(
    plant: ca.Function,
    sensor: ca.Function,
    law: SampledLaw,
    *,
    initial: ArrayLike,
    memory: ArrayLike,
    held: ArrayLike = 0.0,
    step: float,
    period: float,
    duration: float,
    runs: int = 1,
    seed: int = 0,
    average: bool = True,
    reading: ca.Function | None = None,
    every: int = 1,
) -> SampledSimulation:
    """Plant and sensor at a fast rate, a law with a memory at a slow one.

    Args:
        plant: (x, held, t, noise) -> x a step later; the noise is independent normal numbers of variance one, as many
            as the function takes (none: a symbol of size 0).
        sensor: (x, t, noise) -> what is measured, (p,), evaluated at the end of every step.
        law: (memory, measured, t) -> (memory, held), at the end of every period; a casadi.Function, or a Python
            function of flat arrays, called for one run after the other.
        initial: x at the start, (n,) or (runs, n).
        memory: of the law at the start, (size,).
        held: what is held in the first period, (m,) or a number.
        step: of the plant [s].
        period: of the law, a whole number of steps [s].
        duration: a whole number of periods [s].
        runs: number of runs.
        seed: of the noise; run i has the same noise whatever the number of runs.
        average: the law is given the mean of the measurements of a period; False: the last one. A mean of which one
            measurement is NaN is NaN.
        reading: (memory, measured, t) -> memory, of every measurement but the last one of a period, which the law is
            given as it is (whatever `average`); None: the law is given one value a period.
        every: number of steps between two times of the histories of the plant.

    Returns:
        The histories.

    Raises:
        ProblemError: an argument does not fit, times that are no multiples, a law that returns something else.
    """
    fast, slow = _ratio("period", period, "step", step), _ratio("duration", duration, "period", period)
    start = _runs_of("initial", initial, plant.size1_in(0), int(runs))
    own = values.numeric("memory", values.matrix("memory", memory, (None, 1))).ravel()
    first = values.numeric("held", values.matrix("held", held)).ravel()
    first = np.broadcast_to(first, plant.size1_in(1)) if first.size == 1 else first
    _check_sizes(plant, sensor, law, own.size, first.size)
    if reading is not None:
        _check_reading(reading, own.size, sensor.size1_out(0))
    loop = _Loop(plant, sensor, law, int(runs), start, own, first, reading, slow)
    streams = [
        np.random.Generator(np.random.PCG64(np.random.SeedSequence(int(seed), spawn_key=(i,))))
        for i in range(int(runs))
    ]
    for k in range(slow):
        loop.fly(k, fast, float(step), streams, every=int(every))
        loop.decide((k + 1) * fast * float(step), average=bool(average) and reading is None, count=fast)
    return loop.histories()


class _Loop:
    """State, memory and what is held of all runs, a column each, and their histories."""

    def __init__(
        self,
        plant: ca.Function,
        sensor: ca.Function,
        law: SampledLaw,
        runs: int,
        start: Array,
        memory: Array,
        held: Array,
        reading: ca.Function | None,
        periods: int,
    ) -> None:
        self.runs, self.periods = runs, periods
        width = padded(runs)
        self.plant, self.sensor = vectorise(plant, width, (2,)), vectorise(sensor, width, (1,))
        self.law: Columns | SampledLaw = vectorise(law, width, (2,)) if isinstance(law, ca.Function) else law
        self.reading = None if reading is None else vectorise(reading, width, (2,))
        self.state = np.repeat(start[:, :1], width, axis=1)
        self.state[:, :runs] = start
        self.limit: Any = np.inf
        self.held, self.memory = np.repeat(held[:, None], width, axis=1), np.repeat(memory[:, None], width, axis=1)
        self.total, self.last = np.zeros(self.sensor.outputs[0].shape), np.zeros(self.sensor.outputs[0].shape)
        self.times, self.states, self.holds = [0.0], [self._kept(self.state)], [self._kept(self.held)]
        self.samples: list[float] = []
        self.measured: list[Array] = []
        self.memories: list[Array] = []

    def _kept(self, columns: Array) -> Array:
        return np.array(columns[:, : self.runs].T)

    def fly(self, period: int, steps: int, step: float, streams: list[np.random.Generator], *, every: int) -> None:
        """One period of the plant."""
        shocks = [self.plant.inputs[3].shape[0], self.sensor.inputs[2].shape[0]]
        drawn = np.zeros((steps, sum(shocks), self.state.shape[1]))
        for i, stream in enumerate(streams):
            drawn[:, :, i] = stream.standard_normal((steps, sum(shocks)))
        self.total[:] = 0.0
        for j in range(steps):
            number = period * steps + j
            process, noise = drawn[j, : shocks[0]], drawn[j, shocks[0] :]
            before, self.state = self.state, _evaluated(self.plant, self.state, self.held, number * step, process)
            if number == 0:
                with np.errstate(all="ignore"):  # a step to what is no number any more
                    self.limit = farthest(before, self.state - before, steps * self.periods)
            self.state[:, ~in_range(self.state, len(self.state), self.limit)] = np.nan
            self.last = _evaluated(self.sensor, self.state, (number + 1) * step, noise)
            self.total += self.last
            if self.reading is not None and j + 1 < steps:
                self.memory = _evaluated(self.reading, self.memory, self.last, (number + 1) * step)
            if (number + 1) % every == 0:
                self.times.append((number + 1) * step)
                self.states.append(self._kept(self.state))
                self.holds.append(self._kept(self.held))

    def decide(self, time: float, *, average: bool, count: int) -> None:
        """The law at the end of a period."""
        measured = self.total / count if average else self.last
        if isinstance(self.law, Columns):
            self.memory = _evaluated(self.law, self.memory, measured, time)
            self.held = np.array(self.law.outputs[1])
        else:
            for i in range(self.runs):
                self.memory[:, i], self.held[:, i] = _answer(
                    self.law, self.memory[:, i], measured[:, i], time, self.held
                )
        self.samples.append(time)
        self.measured.append(self._kept(measured))
        self.memories.append(self._kept(self.memory))

    def histories(self) -> SampledSimulation:
        """What happened, runs first."""
        x = np.array(self.states).transpose(1, 0, 2)
        return SampledSimulation(
            t=np.array(self.times),
            x=x,
            held=np.array(self.holds).transpose(1, 0, 2),
            samples=np.array(self.samples),
            measured=np.array(self.measured).transpose(1, 0, 2),
            memory=np.array(self.memories).transpose(1, 0, 2),
            diverged=np.asarray(~np.isfinite(x).all(axis=(1, 2))),
        )


def _evaluated(function: Columns, *given: Any) -> Array:
    """The first result of a vectorised function."""
    for place, value in zip(function.inputs, given, strict=True):
        place[...] = value
    with np.errstate(all="ignore"):  # runs that diverge
        function.evaluate()
    return np.array(function.outputs[0])


def _answer(law: SampledLaw, memory: Array, measured: Array, time: float, held: Array) -> tuple[Array, Array]:
    """What a Python function returns for one run.

    Raises:
        ProblemError: no pair of arrays of these sizes.
    """
    try:
        new, answer = law(memory.copy(), measured.copy(), time)
        pair = np.ravel(values.array("memory", new)), np.ravel(values.array("held", answer))
    except Exception as error:  # whatever a function of the user raises
        raise _wrong_law(f"{type(error).__name__}: {error}"[:200], memory.size, held.shape[0]) from error
    if pair[0].size != memory.size or pair[1].size != held.shape[0]:
        raise _wrong_law(f"{pair[0].size} and {pair[1].size} numbers", memory.size, held.shape[0])
    return pair


def _wrong_law(received: str, memory: int, held: int) -> ProblemError:
    return ProblemError(
        "The law does not return what it must.",
        expected=f"(memory, held) of {memory} and {held} numbers for (memory, measured, t)",
        received=received,
        remedy="call it by itself with the memory at the start",
    )


def _ratio(longer: str, long: float, shorter: str, short: float) -> int:
    """How often one time goes into another.

    Raises:
        ProblemError: not a whole number of times.
    """
    ratio = float(long) / float(short)
    if not 0.5 < ratio < MOST or abs(ratio - round(ratio)) > WHOLE * ratio:
        received = f"{longer}={long}, {shorter}={short}: {ratio:.6g} times"
        raise values.wrong_argument(longer, f"a whole number of {shorter}s, less than {MOST:g}", received)
    return round(ratio)


def _runs_of(name: str, given: ArrayLike, size: int, runs: int) -> Array:
    """A column for each run, (size, runs)."""
    numbers = values.array(name, given)
    if numbers.shape in ((size,), ()):
        numbers = np.broadcast_to(numbers.reshape(-1), (runs, size))
    if numbers.shape != (runs, size) or not np.isfinite(numbers).all():
        expected = f"finite numbers of shape ({size},), the state of the plant, or ({runs}, {size})"
        raise values.wrong_argument(name, expected, f"shape {numbers.shape}")
    return numbers.T.copy()


def _check_reading(reading: ca.Function, memory: int, measured: int) -> None:
    """What is done with a measurement inside a period fits to the law.

    Raises:
        ProblemError: it does not.
    """
    found = (reading.size1_in(0), reading.size1_in(1), reading.size1_out(0))
    if found != (memory, measured, memory):
        expected = f"(memory ({memory},), measured ({measured},), t) -> memory ({memory},)"
        raise values.wrong_argument("reading", expected, f"{found}")


def _check_sizes(plant: ca.Function, sensor: ca.Function, law: SampledLaw, memory: int, held: int) -> None:
    """The functions fit together.

    Raises:
        ProblemError: they do not; names the function and the argument.
    """
    wanted = [
        ("plant", "its result x", plant.size1_out(0), plant.size1_in(0)),
        ("held", "what plant takes", held, plant.size1_in(1)),
        ("sensor", "x", sensor.size1_in(0), plant.size1_in(0)),
    ]
    if isinstance(law, ca.Function):
        if (law.n_in(), law.n_out()) != (3, 2):
            raise values.wrong_argument("law", "a function (memory, measured, t) -> (memory, held)", f"{law}"[:100])
        wanted += [
            ("law", "memory", law.size1_in(0), memory),
            ("law", "its result memory", law.size1_out(0), memory),
            ("law", "measured", law.size1_in(1), sensor.size1_out(0)),
            ("law", "its result held", law.size1_out(1), held),
        ]
    for name, what, have, want in wanted:
        if have != want:
            raise values.wrong_argument(name, f"{want} numbers: {what}", f"{have}")
