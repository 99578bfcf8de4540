"""Runs of the actual system, a batch at a time: random numbers by run, moments by groups of runs.

What a run does depends on its number and the seed only. Sums over runs are kept for groups of `LANES` consecutive runs,
so that they too have the same bits however the runs were divided among batches and workers.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.simulation.flown import own_copy, stepped
from covocp.simulation.plan import Plan
from covocp.simulation.run_parts import UNREAD
from covocp.simulation.vectorised import LANES, padded, vectorise

# Steps whose random numbers are drawn together: they are most of the memory of a batch.
DRAWN = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Where some runs stand where a stretch begins, in place of draws; a column for each run.

    x: actual state, (entries, runs); own: unknowns. estimate: of the deviation, or, of the extended filter, the
    augmented state as it has it; E: its half-vectors. gone: who left the domain before, (runs,). streams: of random
    numbers, one for each run, as far as they were drawn.
    """

    x: Array
    own: Array
    estimate: Array
    E: Array
    gone: Any
    streams: tuple[np.random.Generator, ...]

    __repr__ = short_repr

    def first(self, runs: int) -> Cloud:
        """The first of the runs, with streams of their own: the same start may be simulated twice."""
        columns = {name: getattr(self, name)[:, :runs] for name in ("x", "own", "estimate", "E")}
        return Cloud(**columns, gone=self.gone[:runs], streams=copy.deepcopy(self.streams[:runs]))


class StoppedError(Exception):
    """The simulation was interrupted; nothing of this batch is kept."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Some runs, from number `first`. n: augmented states, m: controls fed back, K: stored times, y = (d, d', du).

    deviation: of the actual system from the nominal at the end, (runs, n); where the run left the domain, just before.
    estimate: the filter's estimate of it, (runs, n).
    cost: (runs,); NaN without an expected cost, and where the run left the domain.
    left: time at which the run left the domain [s], inf where it did not, (runs,).
    unanswered: time at which the law of the run first gave no finite control [s], inf where it always did, (runs,).
    asked: flags by run, (runs, m); violated: those of the inequalities, at some instant of their place, (runs, rows);
        at_end: at the end, those of a run that left the domain set.
    asking: number of runs that ask for more control than there is at a stored time, (K, m); violating: that violate an
        inequality there, (K, rows).
    count, mean, product, cube, fourth: sums over the runs inside the domain, by group: (groups, K), then of y
        (groups, K, 2n + m), of y y' and of the third and fourth powers of y.
    paths: y of the first runs of the simulation, (those in this batch, K, 2n + m), NaN after leaving the domain.
    """

    first: int
    deviation: Array
    estimate: Array
    cost: Array
    left: Array
    unanswered: Array
    asked: Any
    violated: Any
    at_end: Any
    asking: Array
    violating: Array
    count: Array
    mean: Array
    product: Array
    cube: Array
    fourth: Array
    paths: Array

    __repr__ = short_repr

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.cost.size)


def run_batch(
    plan: Plan, first: int, last: int, stop: Callable[[], bool] | None = None, cloud: Cloud | None = None
) -> Batch:
    """Simulate the runs first, ..., last - 1.

    Args:
        plan: what is simulated.
        first: number of the first run, a multiple of `LANES`.
        last: number after the last one.
        stop: asked now and then; true to give up.
        cloud: where they start; None: drawn.

    Returns:
        What is kept of them.

    Raises:
        StoppedError: when `stop` said so.
    """
    return run_stretch(plan, first, last, stop, cloud)[0]


def run_stretch(
    plan: Plan, first: int, last: int, stop: Callable[[], bool] | None = None, cloud: Cloud | None = None
) -> tuple[Batch, Cloud]:
    """The same, and where the runs end; the streams of the cloud are used up."""
    with np.errstate(all="ignore"):  # runs that leave the domain overflow, and are found
        simulation = _Simulation(plan, first, last, cloud)
        return simulation.run(stop or (lambda: False)), simulation.end()


class _Simulation:
    """The buffers of one batch."""

    def __init__(self, plan: Plan, first: int, last: int, cloud: Cloud | None) -> None:
        """Place the runs at their starts: drawn, or as a cloud says."""
        self.plan, self.first, self.runs = plan, first, last - first
        width = self.width = padded(self.runs)
        self.step = vectorise(plan.step, width, (3,))
        self.read = None if plan.read is None else vectorise(plan.read, width, (3,))
        self.observe = vectorise(plan.observe, width, (2,))
        n = plan.size
        self.left, self.unanswered = np.full(width, np.inf), np.full(width, np.inf)
        self.last, self.before = np.zeros((2 * n, width)), np.zeros((2 * n, width))
        self.step.inputs[0][:] = plan.start[:, None]
        if cloud is None:
            self._draw()
        else:
            self._continue(cloud)
        self.step.inputs[2][:] = self.own
        self.observe.inputs[1][:] = self.own
        self.laws = [own_copy(plan.flown.law) for _ in range(self.runs)] if plan.flown else []
        rows, times, groups = 2 * n + plan.fed_back, plan.stored.size, width // LANES
        self.flags = np.zeros((times, plan.fed_back + len(plan.watched)))
        self.kept = np.zeros((self._flagged.stop - self._flagged.start, width), dtype=bool)
        self.seen = np.zeros((2, len(plan.watched), width), dtype=bool)
        self.then = np.zeros((len(plan.watched), width), dtype=bool)
        self.count = np.zeros((groups, times))
        self.sums = [np.zeros((groups, times, rows)) for _ in range(3)]
        self.products = np.zeros((groups, times, rows, rows))
        self.paths = np.full((min(max(plan.paths - first, 0), self.runs), times, rows), np.nan)

    def _draw(self) -> None:
        """Draw the starts of the runs about the mean."""
        plan, kind = self.plan, (1,) if self.plan.pilot else ()
        self.streams = [
            np.random.Generator(np.random.PCG64(np.random.SeedSequence(plan.seed, spawn_key=(i, *kind))))
            for i in range(self.first, self.first + self.runs)
        ]
        n, states, entries = plan.size, plan.states, plan.motion.size
        drawn = np.zeros((n, self.width))
        for i, stream in enumerate(self.streams):
            drawn[:, i] = stream.standard_normal(n)
        start = np.zeros((n, self.width))
        for i in range(n):
            for j in range(i + 1):  # elementwise: a product of matrices may depend on the number of runs
                if plan.spread[i, j] != 0:
                    start[i] += plan.spread[i, j] * drawn[j]
        z = self.step.inputs[0]
        z[:entries] = plan.motion.moved(z[:entries].T, start[:states].T).T
        self.own = plan.unknowns[:, None] + start[states:]

    def _continue(self, cloud: Cloud) -> None:
        """Start where a cloud says; who left the domain before stays out of it, its deviation without limit."""
        plan, z = self.plan, self.step.inputs[0]
        self.streams = list(cloud.streams)
        self.own = np.repeat(plan.unknowns[:, None], self.width, axis=1)
        inside, gone = np.flatnonzero(~cloud.gone), np.flatnonzero(cloud.gone)
        self.own[:, inside] = cloud.own[:, inside]
        for name, values in (("x", cloud.x), ("estimate", cloud.estimate), ("E", cloud.E)):
            z[plan.spans[name], inside] = values[:, inside]
        self.left[gone] = 0.0
        self.last[: plan.size, gone] = np.inf

    def end(self) -> Cloud:
        """Where the runs are after the last step."""
        z, runs = self.step.inputs[0], self.runs
        parts = {name: z[self.plan.spans[name], :runs].copy() for name in ("x", "estimate", "E")}
        gone = np.isfinite(self.left[:runs])
        return Cloud(**parts, own=self.own[:, :runs], gone=gone, streams=tuple(self.streams))

    def run(self, stop: Callable[[], bool]) -> Batch:
        """All steps."""
        plan, step = self.plan, self.step
        z, w, _, coefficients = step.inputs
        after, moved = step.outputs
        size, inside = np.empty_like(moved), np.empty(moved.shape, dtype=bool)
        domain = plan.domain[:, None]
        where = {int(k): i for i, k in enumerate(plan.stored)}
        sampled = {int(k): i for i, k in enumerate(plan.samples)}
        if 0 in sampled:
            self._sample(0)
        self._store(where[0])
        before = self.before
        before[:] = self.observe.outputs[0][: 2 * plan.size]
        last = plan.steps.shape[0]
        for k, noise in self._noises(last, stop):
            if plan.reads[k]:
                moved[:] = before if self.read is None else self._read(noise, k)
            else:
                w[:] = noise
                coefficients[:] = plan.steps[k]
                step.evaluate()
                z[:] = after
            np.less_equal(np.abs(moved, size), domain, inside)  # false for NaN
            if not inside.all():
                self._leave(~inside.all(axis=0), plan.times[k])
                if np.isfinite(self.left[: self.runs]).all():  # no run is followed further
                    for place in (own for at, own in where.items() if at > k):
                        self._store(place)
                    break
            before[:] = moved
            if k + 1 in sampled:
                self._sample(sampled[k + 1])
            if k + 1 in where:
                self._store(where[k + 1])
        return self._batch()

    def _read(self, noise: Array, k: int) -> Array:
        """Let all runs read what is read in a step of no length; their deviations and estimates after it."""
        assert self.read is not None
        z, w, own, coefficients = self.read.inputs
        z[:], w[:], own[:] = self.step.inputs[0], noise, self.own
        coefficients[:] = self.plan.steps[k]
        self.read.evaluate()
        self.step.inputs[0][:] = self.read.outputs[0]
        return self.read.outputs[1]

    def _sample(self, number: int) -> None:
        """Step the laws of the runs that are inside the domain; the mean of what was measured starts anew."""
        flown, spans, z = self.plan.flown, self.plan.spans, self.step.inputs[0]
        assert flown is not None
        measured, controls = z[spans["measured"]], self.plan.fed_back
        mean = measured / flown.period if number else np.full_like(measured, np.nan)
        read = z[spans["read"]]
        mean = np.vstack([mean, np.where(read < UNREAD, read, np.nan)])
        for i in np.flatnonzero(np.isinf(self.left[: self.runs])).tolist():
            time, estimates = float(flown.times[number]), flown.estimates * self.plan.size
            result = stepped(self.laws[i], mean[:, i].copy(), time, controls, estimates, self.first + i)
            if not np.isfinite(result[:controls]).all():
                self.unanswered[i] = min(time, self.unanswered[i])
            z[spans["held"], i] = result[:controls]
            if flown.estimates:
                z[spans["estimate"], i] = result[controls:]
        measured[:], read[:] = 0.0, UNREAD

    def _leave(self, gone: Given, time: float) -> None:
        """Note when runs leave the domain, and where they were before."""
        now = gone & np.isinf(self.left)
        self.left[now], self.last[:, now] = time, self.before[:, now]
        self.kept[:, now] = self.step.inputs[0][self._flagged, now] > 0
        # Anywhere finite: what follows of these runs is not looked at.
        self.step.inputs[0][:, gone] = self.plan.start[:, None]

    def _noises(self, steps: int, stop: Callable[[], bool]) -> Iterator[tuple[int, Array]]:
        """Index and normal numbers (noises, width) of each step, from the stream of each run."""
        rows, pairing = self.plan.noises, self.plan.pairing
        each = 1 if pairing is None else 2
        drawn = np.zeros((self.width, DRAWN * each * rows))
        for begin in range(0, steps, DRAWN):
            if stop():
                raise StoppedError
            length = min(DRAWN, steps - begin)
            for i, stream in enumerate(self.streams):
                drawn[i, : length * each * rows] = stream.standard_normal(length * each * rows)
            noise = np.ascontiguousarray(drawn.T).reshape(DRAWN, each, rows, self.width)
            whole = noise[:, 0]
            if pairing is not None:  # the sum of two has twice the variance
                halves = noise.reshape(DRAWN, each * rows, self.width)
                whole = (halves[:, pairing[:, 0]] + halves[:, pairing[:, 1]]) / np.sqrt(2.0)
            for j in range(length):
                yield begin + j, whole[j]

    def _store(self, place: int) -> None:
        """Add the moments of the runs that are inside."""
        observe = self.observe
        observe.inputs[0][:] = self.step.inputs[0]
        observe.inputs[2][:] = self.plan.stored_coefficients[place]
        observe.evaluate()
        rows = self.products.shape[2]
        y, flags = observe.outputs[0][:rows], observe.outputs[0][rows:]
        counted = np.isinf(self.left)
        counted[self.runs :] = False
        kept = self.paths.shape[0]
        self.paths[:, place] = np.where(counted[:kept], y[:, :kept], np.nan).T
        self.flags[place] = np.count_nonzero(np.where(counted, flags, 0.0), axis=1)
        if place in (0, self.flags.shape[0] - 1):
            self.seen[int(place > 0)] = flags[self.plan.fed_back :] > 0
        for i in np.flatnonzero(self.plan.once == place).tolist():
            self.then[i] = (flags[self.plan.fed_back + i] > 0) | ~counted
        grouped = np.where(counted, y, 0.0).reshape(rows, -1, LANES)
        square = grouped * grouped
        self.count[:, place] = counted.reshape(-1, LANES).sum(axis=1)
        for total, values in zip(self.sums, (grouped, square * grouped, square * square), strict=True):
            total[:, place] = values.sum(axis=2).T
        for i in range(rows):
            for j in range(i + 1):
                self.products[:, place, i, j] = (grouped[i] * grouped[j]).sum(axis=1)
                self.products[:, place, j, i] = self.products[:, place, i, j]

    def _batch(self) -> Batch:
        """What is kept."""
        plan, runs, z = self.plan, self.runs, self.step.inputs[0]
        stayed = np.isinf(self.left[:runs])
        n = plan.size
        y = np.where(stayed, self.observe.outputs[0][: 2 * n, :runs], self.last[:, :runs]).T
        flags = np.where(stayed, z[self._flagged, :runs] > 0, self.kept[:, :runs]).T
        violated, at_end = self._violated(flags[:, plan.fed_back :], stayed)
        return Batch(
            first=self.first,
            deviation=np.ascontiguousarray(y[:, :n]),
            estimate=np.ascontiguousarray(y[:, n:]) if plan.estimates else np.full_like(y[:, n:], np.nan),
            cost=np.where(stayed, self._cost(), np.nan),
            left=self.left[:runs],
            unanswered=self.unanswered[:runs],
            asked=flags[:, : plan.fed_back],
            violated=violated,
            at_end=at_end,
            asking=self.flags[:, : plan.fed_back],
            violating=self.flags[:, plan.fed_back :],
            count=self.count,
            mean=self.sums[0],
            product=self.products,
            cube=self.sums[1],
            fourth=self.sums[2],
            paths=self.paths,
        )

    @property
    def _flagged(self) -> slice:
        """The rows of the state with flags."""
        return slice(self.plan.spans["asked"].start, self.plan.spans["violated"].stop)

    def _violated(self, on_the_way: Given, stayed: Given) -> tuple[Any, Any]:
        """Who violates each inequality at some instant of its place, and at the end, (runs, rows)."""
        first, last = (flags[:, : self.runs].T for flags in self.seen)
        at_end = last | ~stayed[:, None]
        violated = np.zeros_like(at_end)
        places, path = self.plan.watched, iter(range(on_the_way.shape[1]))
        for i, place in enumerate(places):
            if place == "path":
                violated[:, i] = on_the_way[:, next(path)] | (last[:, i] & stayed)
            else:
                once = {"initial": first, "inside": self.then[:, : self.runs].T}.get(place, at_end)
                violated[:, i] = once[:, i]
        return violated, at_end

    def _cost(self) -> Any:
        """Cost of each run."""
        plan = self.plan
        if plan.finish is None:
            return np.full(self.runs, np.nan)
        finish = vectorise(plan.finish, self.width, ())
        finish.inputs[0][:] = self.step.inputs[0]
        finish.inputs[1][:] = self.own
        finish.evaluate()
        return (finish.outputs[0][0] + self.step.inputs[0][plan.spans["cost"]][0])[: self.runs]
