"""The closed loops of several phases, one after the other: what each begins with is what the one before ends with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, unpack
from covocp.base.short_repr import short_repr
from covocp.extremal.closed_loop import ClosedLoop, close_loop, design_statistics
from covocp.extremal.extremal import Extremal
from covocp.extremal.grown_noise import Grown, grown_noise
from covocp.extremal.joint import Statistics
from covocp.extremal.mean_effect import MeanEffect, mean_effect
from covocp.statement.chain import Link


@dataclass(frozen=True, kw_only=True, eq=False)
class PhaseLoop:
    """The closed loop of a phase.

    loop: None where it leaves the range of numbers, or one before it does.
    start: covariance [E Z; Z' Xhat] that it begins with, (2n, 2n).
    handed: 1/2 tr S Xhat where it begins, less that where the next one begins. The form of the cost that is optimised
        has it in the phase where the deviations arise, the expected cost in the one where they are paid for.
    mean: what curved rates, measurements and jumps do to its mean, with what came before; None where unknown.
    grown: what noise that varies adds, with what came before; None without a loop.
    """

    loop: ClosedLoop | None
    start: Array
    handed: float
    mean: MeanEffect | None
    grown: Grown | None

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class ChainStatistics:
    """What is truly uncertain in all phases.

    phases: the statistics of each, of which the first initial covariance counts. links: what passes between them.
    """

    phases: tuple[Statistics, ...]
    links: tuple[Link, ...]

    __repr__ = short_repr


def phase_loops(
    extremals: Sequence[Extremal], links: Sequence[Link], truth: ChainStatistics | None = None
) -> tuple[PhaseLoop, ...]:
    """The loops of all phases along their extremals.

    Args:
        extremals: of the phases.
        links: of the chain.
        truth: the true statistics; None: the design's.
    """
    first = (design_statistics(extremals[0]) if truth is None else truth.phases[0]).initial
    start: Array = np.asarray(np.kron(np.diag([1.0, 0.0]), first), dtype=float)
    means: tuple[Array, Array] | None = (np.zeros(first.shape[0]), np.zeros(first.shape[0]))
    more: Array = np.zeros_like(start)
    result: list[PhaseLoop] = []
    for k, extremal in enumerate(extremals):
        own = None if truth is None else truth.phases[k]
        loop = close_loop(extremal, own, start) if not k or result[-1].loop is not None else None
        grown = None if loop is None else grown_noise(extremal, loop, more)
        mean = mean_effect(extremal, loop, means, grown) if loop is not None and means is not None else None
        result.append(PhaseLoop(loop=loop, start=start, handed=0.0, mean=mean, grown=grown))
        if k < len(links):
            behind = extremals[k + 1]
            added = _added(links[k], extremal, extremal.parameters, behind.parameters)
            if truth is not None:
                added = _added(truth.links[k], extremal, *(own.parameters for own in truth.phases[k : k + 2]))
            start, means, more = _passed(links[k], extremal, behind, result[-1], added)
    fed = [_fed(extremal, entry.start) for extremal, entry in zip(extremals, result, strict=True)]
    after = [*fed[1:], 0.0]
    return tuple(replace(entry, handed=own - later) for entry, own, later in zip(result, fed, after, strict=True))


def _passed(
    link: Link, before: Extremal, after: Extremal, ended: PhaseLoop, added: Array
) -> tuple[Array, tuple[Array, Array] | None, Array]:
    """[E Z; Z' Xhat] behind a link that adds variances, the means of (d, y), and what noise added to their spread."""
    size, t = len(after.statement.augmented), before.trajectory
    if ended.loop is None or ended.grown is None or link.deviations is None:
        return np.full((2 * size, 2 * size), np.nan), None, np.zeros((2 * size, 2 * size))
    X = ended.loop.X[-1]
    given = link.deviations(t.x[-1], t.e[-1], t.duration, before.parameters, after.parameters, X)
    J, _, bent = (np.asarray(value.full()) for value in given)
    E, Z, Xhat = ended.loop.E[-1], ended.loop.Z[-1], ended.loop.Xhat[-1]
    crossed = J @ Z @ J.T
    start = np.block([[J @ E @ J.T + added, crossed], [crossed.T, J @ Xhat @ J.T]])
    both = np.kron(np.eye(2), J)
    more = both @ ended.grown.end @ both.T
    if ended.mean is None:
        return start, None, more
    return start, (J @ ended.mean.mean[-1] + bent.ravel(), J @ ended.mean.estimate[-1]), more


def _added(link: Link, before: Extremal, parameters: Array, later: Array) -> Array:
    """Variances that a link adds at the end of an extremal, with these parameters of the statements at both sides."""
    assert link.deviations is not None
    size, t = link.deviations.size1_in(5), before.trajectory
    given = link.deviations(t.x[-1], t.e[-1], t.duration, parameters, later, ca.DM.zeros(size, size))
    return np.asarray(given[1].full())


def _fed(extremal: Extremal, start: Array) -> float:
    """1/2 tr S Xhat at the start; zero where the gain is optimised, and the cost is the expected one in each phase."""
    if not extremal.statement.behind:
        return 0.0
    st, size = extremal.statement, start.shape[0] // 2
    S = unpack(extremal.trajectory.e[0, st.matrices[st.behind[0]].span], size)
    return 0.5 * float(np.sum(S * start[size:, size:]))
