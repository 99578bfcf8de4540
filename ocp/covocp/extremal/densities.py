"""Noise along a trajectory: what depends on state, control or time may leave its domain on the way.

Noise of a process and of a jump between phases must be positive semidefinite, that of measurements positive definite,
at instants as well: their variance is that of a density over an instant, and two exact readings of the same contradict
each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from covocp.base.checks import check_density
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.matrices import Array, stacked, unpack
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
from covocp.statement.statement import Statement

if TYPE_CHECKING:
    from covocp.statement.chain import Link

# Relative size of a negative eigenvalue that counts as roundoff, and of the smallest one of a measurement's noise.
ROUNDOFF = 1e-12
SINGULAR = 1e-14
# Share of what noise is added to that is lost in rounding of both.
ROUNDING = 1e-15

NOT_NEGATIVE = "state noise that is nowhere negative (a square, exp), or keep what it is made of away from there"
ABOVE_ZERO = "every measurement needs some noise: state it so that it stays above zero"
SWITCHED = f"{ABOVE_ZERO}; a sensor that can be switched off is stated by information=, which may be zero"

JumpEnds = tuple[Array, Array, float, Array, Array]


@dataclass(frozen=True, kw_only=True, eq=False)
class Noise:
    """One noise at some points of a trajectory.

    what: in words, with the user's name; rows: names of its rows, which are told too; () where `what` says all.
    matrices: (points, n, n); time: of the points [s].
    beside: of each row what its size is judged by besides its own: what a measurement sees of the uncertainty, which
    variance noise is added to; None: nothing is known.
    definite: whether it must be positive definite. remedy: against it.
    """

    what: str
    matrices: Array
    time: Array
    rows: Sequence[str] = ()
    beside: Array | None = None
    definite: bool = False
    remedy: str = NOT_NEGATIVE

    __repr__ = short_repr


class Truth(NamedTuple):
    """A system that flies along the trajectory of another one, whose states are the first ones, with its parameters."""

    statement: Statement
    parameters: Array

    def columns(self, extremal: Extremal, nodes: Any) -> tuple[Array, ...]:
        """Arguments (state, control, time, duration, parameters) of its functions at some nodes, a column each."""
        x, u, _, *rest, _ = (np.asarray(column)[:, nodes] for column in extremal.columns())
        return x[: self.statement.nx], u[: self.statement.nu], *rest, np.tile(self.parameters[:, None], (1, nodes.size))


@dataclass(frozen=True, kw_only=True)
class Impossible:
    """What no noise can be.

    what: in words; time: when [s]; smallest: its smallest eigenvalue there.
    definite: whether it must be positive definite; rows: how many of it depend on each other; remedy: what to do.
    """

    what: str
    time: float
    smallest: float
    definite: bool
    rows: int
    remedy: str

    @property
    def sentence(self) -> str:
        """What is wrong, where."""
        one = "not positive" if self.definite else "negative"
        several = f"not positive {'definite' if self.definite else 'semidefinite'}"
        return f"the {self.what} is {one if self.rows == 1 else several} at t = {self.time:.6g} s"

    @property
    def received(self) -> str:
        """What it is there."""
        return f"{self.smallest:.3g}" if self.rows == 1 else f"smallest eigenvalue {self.smallest:.3g}"

    @property
    def words(self) -> str:
        """All of it in a clause."""
        return f"{self.sentence} ({self.received}); {self.remedy}"

    def error(self, where: str, kind: type[ProblemError] = ProblemError) -> ProblemError:
        """The same as an error.

        Args:
            where: "along this nominal", say.
            kind: of error.
        """
        one = "a positive number" if self.definite else "a number that is not negative"
        several = f"a positive {'definite' if self.definite else 'semidefinite'} matrix"
        return kind(
            f"{self.sentence[0].upper()}{self.sentence[1:]} {where}.",
            expected=f"{one if self.rows == 1 else several} wherever it acts",
            received=self.received,
            remedy=self.remedy,
        )


def impossible_density(extremal: Extremal) -> str:
    """The first noise along a trajectory that none can be, in words; "" where there is none."""
    found = impossible_noise(extremal)
    return "" if found is None else found.words


def impossible_noise(extremal: Extremal) -> Impossible | None:
    """The first noise of process and measurements that none can be, at a node or where it is read; else None."""
    return first_impossible(noises_along(extremal))


def impossible_jump(link: Link, before: Statement, after: Statement, ends: JumpEnds) -> Impossible | None:
    """What a link adds to the covariance of the error where that is no variance; else None.

    Args:
        link: between both.
        before: the statement that ends there.
        after: the one that begins there.
        ends: what `Link.values` takes.
    """
    if not after.estimated or not link.matrices or not np.isfinite(ends[0]).all():
        return None
    added, passed = link.variances(after, *ends)
    noise = Noise(
        what=f"noise variance of the jump from '{before.name}' to '{after.name}' of",
        matrices=added[None],
        time=np.array([ends[2]]),
        rows=after.augmented,
        beside=np.abs(np.nan_to_num(np.diagonal(passed), posinf=0.0)),
    )
    return first_impossible([noise])


def impossible_in_phases(extremals: Sequence[Extremal], links: Sequence[Link]) -> str:
    """The first noise in phases that none can be, or between them, in words; "" where there is none."""
    for i, extremal in enumerate(extremals):
        found = impossible_noise(extremal)
        if found is None and i < len(links):
            later = extremals[i + 1]
            found = impossible_jump(links[i], extremal.statement, later.statement, _ends(extremal, later.parameters))
        if found is not None:
            return f"in the phase '{extremal.statement.name}' {found.words}"
    return ""


def noises_along(extremal: Extremal, truth: Truth | None = None) -> Iterator[Noise]:
    """All noises along a trajectory, where the nominal has values; constant ones once.

    Args:
        extremal: the trajectory.
        truth: the system whose noises they are, which may be none; None: that of the trajectory.
    """
    own, mesh = truth or Truth(extremal.statement, extremal.parameters), extremal.mesh
    st, definite = own.statement, truth is None
    if not st.matrices and st.information is None and st.measurement is None and st.samples is None:
        return
    known = np.flatnonzero(np.isfinite(extremal.trajectory.x).all(axis=1))
    nodes = known if st.noise_varies else known[:1]
    if not nodes.size:
        return
    at, count, time = own.columns(extremal, nodes), nodes.size, extremal.time[nodes]
    for block, form in zip(st.matrices, st.riccati, strict=True):
        if block.estimation and form is not None:
            noise = stacked(form.map(count)(*at)[1], count)
            yield Noise(
                what="process noise density of",
                matrices=noise,
                time=time,
                rows=st.augmented,
                beside=_grown(extremal, known),
            )
    if st.information is not None:
        stated = stacked(st.information.map(count)(*at), count)
        size, largest = stated.shape[1], np.abs(np.nan_to_num(stated, posinf=0.0)).max(initial=0.0)
        what, beside = "information of a measurement", np.full(size, largest)
        yield Noise(what=what, matrices=stated * np.eye(size), time=time, beside=beside)
    if st.measurement is not None:
        _, slopes, density = (stacked(v, count) for v in st.measurement.map(count)(*at))
        seen = _largest(extremal, slopes, nodes) * extremal.trajectory.duration
        for block in st.measurements:
            yield Noise(
                what=f"measurement noise density of {block.name}",
                matrices=density[:, block.span, block.span],
                time=time,
                definite=definite,
                beside=seen[block.span] if definite else None,
                remedy=SWITCHED if definite else NOT_NEGATIVE,
            )
    taken = [k for k in mesh.instants if mesh.readings[:, k].any() and k in set(known.tolist())]
    if st.samples is not None and taken:
        yield from _read(extremal, own, np.array(taken), definite)


def _read(extremal: Extremal, own: Truth, nodes: Any, definite: bool) -> Iterator[Noise]:
    """The noise of each measurement at instants, where it is read."""
    samples, count = own.statement.samples, nodes.size
    assert samples is not None
    _, slopes, variance = (stacked(v, count) for v in samples.measurement.map(count)(*own.columns(extremal, nodes)))
    seen = _largest(extremal, slopes, nodes)
    for block, taken in zip(samples.blocks, extremal.mesh.readings[:, nodes] > 0, strict=True):
        yield Noise(
            what=f"measurement noise variance of {block.name}",
            matrices=variance[taken][:, block.span, block.span],
            time=extremal.time[nodes][taken],
            definite=definite,
            beside=seen[block.span] if definite else None,
            remedy=ABOVE_ZERO if definite else NOT_NEGATIVE,
        )


def _grown(extremal: Extremal, nodes: Any) -> Array | None:
    """The least variance of each row of the augmented state along the way, over the duration; None without E."""
    if not extremal.statement.estimated:
        return None
    block = extremal.statement.estimation
    variances = np.diagonal(unpack(extremal.trajectory.e[nodes][:, block.span], block.size), axis1=1, axis2=2)
    return np.asarray(np.nan_to_num(variances).min(axis=0).clip(0.0) / extremal.trajectory.duration)


def _largest(extremal: Extremal, slopes: Array, nodes: Any) -> Array:
    """Largest variance of each of some linear functions of the augmented state, (points, rows, n); inf without E."""
    if not extremal.statement.estimated:
        return np.full(slopes.shape[1], np.inf)
    block = extremal.statement.estimation
    E = unpack(extremal.trajectory.e[nodes][:, block.span], block.size)
    variances = np.einsum("kri,kij,krj->kr", slopes, E, slopes)
    return np.asarray(np.nan_to_num(np.abs(variances), posinf=0.0).max(axis=0, initial=0.0))


def first_impossible(noises: Iterator[Noise] | Sequence[Noise]) -> Impossible | None:
    """What is wrong with the first noise that none can be; else None."""
    for noise in noises:
        for rows in _together(noise):
            own = noise.matrices[:, rows][:, :, rows]
            wrong = _first_wrong(own, noise, rows)
            if wrong is None:
                continue
            point, smallest, row = wrong
            return Impossible(
                what=f"{noise.what} {noise.rows[rows[row]]}" if noise.rows else noise.what,
                time=float(noise.time[point]),
                smallest=smallest,
                definite=noise.definite,
                rows=len(rows),
                remedy=noise.remedy,
            )
    return None


def _together(noise: Noise) -> list[list[int]]:
    """Rows that are alone and may be no variance, one by one, then those with entries beside the diagonal."""
    size = noise.matrices.shape[1]
    beside = ((noise.matrices != 0.0) & ~np.eye(size, dtype=bool)).any(axis=(0, 2))
    joined = np.flatnonzero(beside).tolist()
    alone = np.flatnonzero(~beside & ~_plainly(noise)).tolist()
    return [*([i] for i in alone), *([joined] if joined else [])]


def _plainly(noise: Noise) -> NDArray[np.bool_]:
    """Rows whose variances are numbers that are large enough at all points, of which no more has to be asked."""
    variances = np.diagonal(noise.matrices, axis1=1, axis2=2)
    if not noise.definite:
        return np.asarray(((variances >= 0.0) & (variances < np.inf)).all(axis=0))
    largest = np.max(variances, axis=0, initial=0.0)
    least = SINGULAR * (largest if noise.beside is None else np.minimum(largest, noise.beside))
    return np.asarray(((variances >= least) & (variances > 0.0) & (variances < np.inf)).all(axis=0))


def _first_wrong(matrices: Array, noise: Noise, rows: list[int]) -> tuple[int, float, int] | None:
    """The first point at which a noise is none, its smallest eigenvalue there, and the row that this is most of.

    In units in which the largest variance of each row is 1. The smallest eigenvalue that is allowed is relative to the
    largest of any point, or of what it is judged by besides: what is lost in rounding of that is not negative. Of what
    must be positive definite each variance is so to the lesser of both, and correlations are judged point by point: a
    sensor that is nearly switched off at some points is noisy there, not singular elsewhere.
    """
    if not len(matrices):
        return None
    finite = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    numbers = np.where(np.isfinite(matrices), matrices, 0.0)
    variances = np.abs(np.diagonal(numbers, axis1=1, axis2=2)).max(axis=0)
    variances = np.where(variances > 0, variances, np.abs(numbers).max(initial=0.0) or 1.0)
    beside = np.full(len(rows), np.inf) if noise.beside is None else noise.beside[rows]
    own = np.diagonal(numbers, axis1=1, axis2=2)
    units = np.sqrt(np.where(own != 0, np.abs(own), variances) if noise.definite else np.tile(variances, (len(own), 1)))
    scaled = numbers / units[:, :, None] / units[:, None, :]
    eigenvalues = np.linalg.eigvalsh(scaled)
    smallest, sizes = eigenvalues[:, 0], np.abs(eigenvalues).max(axis=1)
    if noise.definite:
        small = (own < SINGULAR * np.minimum(variances, beside)).any(axis=1)
        wrong = np.flatnonzero((smallest < SINGULAR * sizes) | small | ~finite)
    else:
        share = float((beside / variances).max())
        lost = ROUNDING * share if np.isfinite(share) else 0.0
        wrong = np.flatnonzero((smallest < -max(ROUNDOFF * float(sizes.max()), lost)) | ~finite)
    if not wrong.size:
        return None
    k = int(wrong[0])
    if not finite[k]:
        return k, float(np.nan), int(np.argmin(np.isfinite(matrices[k]).all(axis=1)))
    told = float(np.linalg.eigvalsh(numbers[k])[0])
    vector = np.linalg.eigh(scaled[k])[1][:, 0]
    return k, told if len(rows) == 1 or told <= 0 else float(smallest[k]), int(np.argmax(np.abs(vector)))


def check_noise(extremal: Extremal) -> None:
    """Noise along a trajectory that is given must be one.

    Raises:
        ProblemError: names it, and the time.
    """
    found = impossible_noise(extremal)
    if found is not None:
        raise found.error("along this nominal")


def check_truth(extremal: Extremal, truth: Statement, parameters: Array, initial: Array) -> None:
    """What is truly uncertain along a trajectory must be a covariance, a density or a variance; none at all is one too.

    Args:
        extremal: the trajectory.
        truth: the true system.
        parameters: its own.
        initial: covariance of its deviation at the start, (n, n).

    Raises:
        ProblemError: names it, and the time.
    """
    check_density("truth", "initial covariance", initial, definite=False)
    found = first_impossible(noises_along(extremal, Truth(truth, parameters)))
    if found is not None:
        raise found.error("along the nominal, in the truth")


def check_true_jump(link: Link, before: Extremal, truths: tuple[Truth, Truth]) -> None:
    """The noise of a true jump at the end of a trajectory must be one.

    Args:
        link: of the truth.
        before: the trajectory.
        truths: what ends there, and what begins.

    Raises:
        ProblemError: names what jumps.
    """
    one, two = truths
    t, none = before.trajectory, np.zeros(one.statement.ne)
    ends = (t.x[-1, : one.statement.nx], none, t.duration, one.parameters, two.parameters)
    found = impossible_jump(link, one.statement, two.statement, ends)
    if found is not None:
        raise found.error("in the truth")


def check_jump_noise(link: Link, before: Extremal, after: Statement, parameters: Array) -> None:
    """The noise of a jump at the end of a trajectory that is given must be one.

    Args:
        link: between both.
        before: the extremal that ends there.
        after: the statement that begins there.
        parameters: of that.

    Raises:
        ProblemError: names what jumps.
    """
    found = impossible_jump(link, before.statement, after, _ends(before, parameters))
    if found is not None:
        raise found.error("along this nominal")


def _ends(before: Extremal, parameters: Array) -> JumpEnds:
    """What a link takes at the end of an extremal, and the parameters of the later statement."""
    t = before.trajectory
    return t.x[-1], t.e[-1], t.duration, before.parameters, parameters
