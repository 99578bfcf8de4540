"""What the mesh costs: the change of the cost by halving the integration steps."""

from __future__ import annotations

from functools import lru_cache
from math import gcd
from typing import TYPE_CHECKING

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.bends import change_by_bends
from covocp.extremal.costates import discrete_costates
from covocp.extremal.extremal import Extremal
from covocp.extremal.final_deviations import final_deviations
from covocp.extremal.inside import instant_change
from covocp.extremal.open_loop import Departure, departure, matrices_along_controls, nominal_along
from covocp.extremal.unseen import changes_within_steps
from covocp.statement.statement import Statement
from covocp.transcription.halved_steps import Refined, refined_run
from covocp.transcription.mesh import Mesh, Options, step_unit, with_substeps
from covocp.transcription.nlp import Scales
from covocp.transcription.scales import magnitudes
from covocp.transcription.trajectory import Trajectory

if TYPE_CHECKING:
    from covocp.extremal.links import Within

# Relative error of the cost, estimated by halving the steps, above which a mesh counts as too coarse.
COARSE_MESH = 2e-4
# Costs below this count as zero: a tracking cost whose optimum is zero is known to roundoff only, and no share of it.
NO_COST = 1e-12
# Relative change from which on halving the steps does not tell how far they are off: they are divided in more parts.
FAR, MANY_PARTS = 0.05, 16
# Roundoff of a step, relative: an unstable nominal that makes more of it than the change it suffers tells nothing.
STEP_ROUNDOFF = 1e-13
# Change of what is at a node by halving the steps, relative to its range, that is told.
LONG_STEPS = 1e-2
# Such a change of segments by themselves from which on matrices are looked at along one run of the nominal, too.
CLOSELY = 1e-3
# Largest such change that default steps leave along a nominal, and where the nominal is optimised: shorter steps would
# make that two to four times slower (chains of masses), and the cost has fewer digits than the nodes.
ALONG, OPTIMISED = 1e-4, 2e-3
# Order of the steps, by how much they are divided at a time at most, and how many there may be in an interval.
ORDER, MOST_TIMES, MOST_SUBSTEPS = 4, 8, 64
# Steps of an interval that what an unstable plant makes of them may ask for, and the share of what its segments are off
# by halving the steps that is their own: more of it would be left by any steps.
MOST_AGAINST_GROWTH, OWN_SHARE = 8, 0.3
# A plant is called unstable from so many times what the segments by themselves are off, all together, on.
UNSTABLE = 10.0
# By how much the change shall be smaller than allowed: it is an estimate.
MARGIN = 1.5
# Parts of a step, without a common divisor with each other or with halves, that see what halves of it do not (all of
# them are blind to multiples of 4004 periods in a step alone); and how many times more than these they must say: a jump
# of the model within a step is seen by all, up to four times as much.
UNLIKE_HALVES, MORE_THAN_HALVES = (7, 11, 13), 4.0
# So many steps an interval are tried then, in units of what their number is a multiple of: primes, so that no round
# frequency meets all of them at one place of its period.
PRIMES = (7, 13, 31, 61)
# Base in which frequencies, durations and numbers of intervals are round: the number of steps that see little of an
# oscillation shall have no divisor in common with it.
ROUND = 10
# Range of what hardly varies, in its magnitude; magnitude of what is zero but for roundoff, in the largest one.
LEAST_RANGE, ROUNDOFF = 1e-3, 1e-12


def mesh_error(extremal: Extremal, running: float, within: Within | None = None, *, of_states: bool = True) -> float:
    """Relative change of the cost by halving the integration steps, to first order.

    Where rates depend on the time explicitly, they may jump: then that of the states over a segment, where it is more.
    They may also oscillate so that halves meet one place of the period alone: then that by other parts.

    Each shooting segment is run again from its start. The jumps at the ends of the segments count with the multipliers
    of the continuity, which are the costates there: this is the change of the optimal cost. Along the controls
    themselves the terminal conditions are missed too; what this changes of the cost counts where it is more. What an
    unstable plant makes of the jumps along the controls alone is told by `unstable` and `node_error`.

    Args:
        extremal: trajectory and multipliers.
        running: its running cost.
        within: what the rest of a chain says of it: the cost is then that of all, with what its end changes of the
            later ones, at best and along their controls.
        of_states: whether what states move by counts where it may.

    Returns:
        |change| / max(|changed cost|, NO_COST), or the share of the states' ranges; nan where the run is not finite.
    """
    st = extremal.statement
    cost = _cost_of_all(extremal, running, within)
    change, missed, moved = changes_by_parts(extremal, running, 2, within)
    if abs(change) > FAR * abs(cost):
        with np.errstate(over="ignore", invalid="ignore"):
            further = changes_by_parts(extremal, running, MANY_PARTS, within)
        change, missed, moved = further if np.isfinite(further).all() else (change, missed, moved)
    error = _share(change, missed, cost)
    moves = of_states and not st.autonomous
    if moves and not np.isfinite(moved):
        return error
    error, hidden = (max(error, moved) if moves else error), 0.0
    for further in _unlike_halves(extremal, running, within):
        hidden = max(hidden, _share(*further[:2], cost), moves * further[2])
    return hidden if hidden > MORE_THAN_HALVES * error else error


def _cost_of_all(extremal: Extremal, running: float, within: Within | None) -> float:
    """The cost of the whole chain of which an extremal is part, of itself where it is none."""
    t = extremal.trajectory
    cost = running + float(extremal.statement.terminal(t.x[-1], t.e[-1], t.duration, extremal.parameters))
    return cost if within is None else cost + within.others


def _share(change: float, missed: float, cost: float) -> float:
    """A change of the cost, with or without what is missed at the end, in the changed cost."""
    return max(abs(change), abs(change - missed)) / max(abs(cost + change), NO_COST)


def _unlike_halves(
    extremal: Extremal, running: float, within: Within | None, numbers: tuple[int, ...] = UNLIKE_HALVES
) -> list[tuple[float, float, float]]:
    """Changes by parts of a step that see what its halves do not, where there may be such; those that are finite."""
    if not changes_within_steps(extremal):
        return []
    with np.errstate(over="ignore", invalid="ignore"):
        found = [changes_by_parts(extremal, running, parts, within) for parts in numbers]
    return [changes for changes in found if np.isfinite(changes).all()]


@dataclass(frozen=True, kw_only=True)
class Unseen:
    """What halves of the steps do not see of a model that changes with the time, and other parts do.

    Attributes:
        moved: largest change at a node of a state or an entry of a matrix, relative to its range.
        name: of that state, or of the matrix.
        cost: change of the cost, relative.
    """

    moved: float
    name: str
    cost: float

    __repr__ = short_repr


def unseen(
    extremal: Extremal,
    within: Within | None = None,
    numbers: tuple[int, ...] = UNLIKE_HALVES,
    gaps: Array | float = 0.0,
) -> Unseen | None:
    """What halves of the steps do not see of a model that changes with the time; to first order, as `mesh_error`.

    Args:
        extremal: the trajectory.
        within: what the rest of a chain says of it; where it is not known a statement that costs nothing tells no cost.
        numbers: of parts of a step that are asked.
        gaps: as of `node_error`; along a guess nothing is told of the cost.

    Returns:
        None where they see it, or where it makes little of a difference beside what they tell.
    """
    if not changes_within_steps(extremal):
        return None
    st, running = extremal.statement, parted(extremal, 1).running
    cost = _cost_of_all(extremal, running, within)
    with np.errstate(over="ignore", invalid="ignore"):
        told = _share(*changes_by_parts(extremal, running, 2, within)[:2], cost)
        others_say = _unlike_halves(extremal, running, within, numbers)
        paid = max((_share(*changes[:2], cost) for changes in others_say), default=0.0)
        (halves, size), others = by_segments(extremal, gaps), [by_segments(extremal, gaps, n)[0] for n in numbers]
        moved = np.max(others, axis=0) / size
    moved = np.where(np.isfinite(moved) & (moved > MORE_THAN_HALVES * (halves / size).max()), moved, 0.0)
    # what is not seen may be all that costs
    most = max([abs(cost), *(abs(cost + changes[0]) for changes in others_say)])
    paid = paid if paid > MORE_THAN_HALVES * told and most > NO_COST and not np.any(gaps) else 0.0
    worst = int(np.argmax(moved))
    if not moved[worst] and not paid:
        return None
    return Unseen(moved=float(moved[worst]), name=_entry(st, worst), cost=paid)


def _entry(statement: Statement, row: int) -> str:
    """The name of the state, or of the matrix, to which a row of x and e stacked belongs."""
    if row < statement.nx:
        return statement.state_names[row]
    blocks = statement.matrices
    return next((b.name for b in blocks if b.span.start <= row - statement.nx < b.span.stop), "")


def changes_by_parts(
    extremal: Extremal, running: float, parts: int, within: Within | None = None
) -> tuple[float, float, float]:
    """Changes by shorter steps: of the optimal cost, of it without that along the controls, of states."""
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    finer = parted(extremal, parts)
    jumps = finer.jumps
    weights = extremal.multipliers.gaps
    if weights.shape != jumps.shape:  # a method without segments
        costates, _, _ = discrete_costates(extremal)
        weights = np.hstack([costates.state, costates.matrices])[list(mesh.starts[1:]), : jumps.shape[1]]
    change = float(np.sum(weights * jumps)) + finer.running - running
    change += _at_the_end(extremal, finer.matrices[-1]) - _at_the_end(extremal, t.e[-1])
    change += instant_change(extremal, finer.states, finer.matrices)
    if st.behind:  # what the phases before a link cost by what runs backward, at the start
        behind = st.entries(st.behind)
        change += float(extremal.multipliers.matrices[0, behind] @ (finer.matrices[0] - t.e[0])[behind])
    least = LEAST_RANGE * _magnitudes(st, t, tuple(extremal.parameters.tolist())).x
    missed = _missed(extremal, finer, parts, within) - change_by_bends(
        extremal, finer, parts, _cost_of_all(extremal, running, within)
    )
    return change, missed, _moved(jumps[:, : st.nx], t.x, least)


def _halved(extremal: Extremal) -> Refined:
    """The run with steps of half the length."""
    return parted(extremal, 2)


def parted(extremal: Extremal, parts: int) -> Refined:
    """The run with each step in so many parts."""
    given = extremal.statement, extremal.mesh, extremal.trajectory, tuple(extremal.parameters.tolist())
    return _halved_run(*given) if parts == 2 else _parted_run(*given, parts)


@lru_cache(maxsize=2)
def _halved_run(statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: tuple[float, ...]) -> Refined:
    return refined_run(statement, mesh, trajectory, np.array(parameters))


@lru_cache(maxsize=1 + len(UNLIKE_HALVES))
def _parted_run(
    statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: tuple[float, ...], parts: int
) -> Refined:
    return refined_run(statement, mesh, trajectory, np.array(parameters), parts)


def forget_runs() -> None:
    """Forget what is remembered: runs along a guess are asked for no more, and of many states they are large."""
    for remembered in (_halved_run, _parted_run, _magnitudes):
        remembered.cache_clear()


@lru_cache(maxsize=2)
def _magnitudes(statement: Statement, trajectory: Trajectory, parameters: tuple[float, ...]) -> Scales:
    return magnitudes(statement, trajectory, np.array(parameters))


def node_error(extremal: Extremal, gaps: Array | float = 0.0, *, closely: bool = True) -> float:
    """Largest change of a state or of an entry of a matrix at a node by halving the steps, relative to its range.

    At the end of a covariance it is relative to the product of its own deviations, where that is more.

    The states are those of one run along the controls, in which an unstable plant amplifies what each segment is off.
    Where a feedback holds them, and for matrices that are variables, the jumps at the ends of segments are summed up.
    Where the model changes with the time so that halves do not see it, that by other parts of the steps.

    Args:
        extremal: the trajectory.
        gaps: at the ends of the segments with its own steps, (segments, variables there): those of a guess, along which
            nothing is amplified.
        closely: False where it shall be known well from a hundredth on alone: what the nominal's drift makes of the
            matrices, some times as much as what segments by themselves show, is then left out where these show little.

    Returns:
        The largest of them; inf where a run along the controls diverges, nan where the segments do.
    """
    error = _by_halves(extremal, gaps, 0.0 if closely else CLOSELY)
    hidden = None if np.any(gaps) else unseen(extremal)
    return error if hidden is None else float(np.maximum(error, hidden.moved))


def _by_halves(extremal: Extremal, gaps: Array | float, looked: float = np.inf) -> float:
    """`node_error` by halves alone; matrices along one run where segments are off by more than `looked`."""
    moved, size = by_segments(extremal, gaps)
    with np.errstate(over="ignore", invalid="ignore"):
        matrices = float((moved / size).max(initial=0.0)) > looked
        left = None if np.any(gaps) else _departure(extremal, moved, size, matrices=matrices)
        if left is not None:
            nx = left.states.size
            moved[:nx] = left.states
            if left.matrices is not None and left.end is not None:
                least = ROUNDOFF * _magnitudes_of(extremal).max(initial=0.0)
                end = left.end / np.maximum(final_deviations(extremal.statement, extremal.trajectory.e), least)
                moved[nx:] = np.maximum(moved[nx:], np.maximum(left.matrices, end * size[nx:]))
        return float((moved / size).max(initial=0.0))


def by_segments(extremal: Extremal, gaps: Array | float, parts: int = 2) -> tuple[Array, Array]:
    """Largest change of each entry inside the segments, and of all jumps at their ends, summed up; and its range."""
    t, finer = extremal.trajectory, parted(extremal, parts)
    magnitude, values = _magnitudes_of(extremal), np.hstack([t.x, t.e])
    rounded = ROUNDOFF * magnitude.max(initial=0.0)
    size = np.maximum(np.ptp(values, axis=0), np.maximum(LEAST_RANGE * magnitude, rounded))
    with np.errstate(over="ignore", invalid="ignore"):
        moved, inside = np.cumsum(finer.jumps - gaps, axis=0), np.hstack([finer.states, finer.matrices]) - values
        total = np.abs(inside).max(axis=0)
        total[: moved.shape[1]] += np.abs(moved).max(axis=0)
        left = np.abs(inside[-1, t.x.shape[1] :]) / np.maximum(final_deviations(extremal.statement, t.e), rounded)
        total[t.x.shape[1] :] = np.maximum(total[t.x.shape[1] :], left * size[t.x.shape[1] :])
    return total, size


def _magnitudes_of(extremal: Extremal) -> Array:
    """Magnitudes of states and half-vectors, (nx + ne,)."""
    scales = _magnitudes(extremal.statement, extremal.trajectory, tuple(extremal.parameters.tolist()))
    return np.concatenate([scales.x, scales.e])


def _departure(extremal: Extremal, moved: Array, size: Array, *, matrices: bool = False) -> Departure | None:
    nx = extremal.statement.nx
    return departure(extremal, moved[:nx], size[:nx], matrices=matrices)


def is_lost(extremal: Extremal, left: Array) -> bool:
    """Whether the plant is so unstable that roundoff alone would take the states about as far from the nodes, (nx,)."""
    t, jumps = extremal.trajectory, _halved(extremal).jumps[:, : extremal.statement.nx]
    scale = np.abs(t.x).max(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    suffered, amplified = float((np.abs(jumps) / scale).max()), float((left / scale).max())
    return not np.isfinite(amplified) or amplified * STEP_ROUNDOFF > COARSE_MESH * suffered


def unstable(extremal: Extremal) -> tuple[float, float | None] | None:
    """By how much a run along the controls leaves the nodes, of the range of a state, and what it costs.

    Returns:
        None where the plant is not seen to be unstable, the cost None where it is not known.
    """
    moved, size = by_segments(extremal, 0.0)
    left = _departure(extremal, moved, size)
    if left is None or left.cost is None:
        return None
    nx = left.states.size
    suffered = (np.abs(_halved(extremal).jumps[:, :nx]) / size[:nx]).max(axis=1).sum()
    if (left.states / size[:nx]).max() <= UNSTABLE * suffered:  # long steps of an oscillator add up as well
        return None
    known = np.isfinite(left.cost) and not is_lost(extremal, left.states)
    return float((left.states / size[:nx]).max()), left.cost if known else None


def finer_steps(
    extremal: Extremal, options: Options, allowed: float = ALONG, running: float | None = None
) -> Options | None:
    """The options with so many integration steps that halving them moves little at the nodes.

    A gain that is a control, where the estimate learns all the time, may be large for as long as little is estimated.
    Long steps then find a feedback that is none: at the nodes it is hardly seen, in the cost it is.
    Where the model changes with the time within the steps the cost counts too, and other parts of them than halves.

    Args:
        extremal: a solution on the mesh of the options.
        options: those of this mesh.
        allowed: largest change, relative to the range of each entry.
        running: the running cost, where the cost of such a gain counts as well, and that of one run along the controls.

    Returns:
        None where the steps are short enough, or cannot be shorter.
    """
    return unlike(extremal, options, allowed) or divided(extremal, options, allowed, running)


def unlike(extremal: Extremal, options: Options, allowed: float, gaps: Array | float = 0.0) -> Options | None:
    """The options with a number of steps that no round frequency is a multiple of, where these do not see the model."""
    unit = step_unit(extremal.statement, extremal.mesh)
    numbers = [unit * prime for prime in PRIMES if extremal.mesh.substeps < unit * prime <= MOST_SUBSTEPS]
    if not numbers:
        return None
    for parts in UNLIKE_HALVES:
        found = unseen(extremal, numbers=(parts,), gaps=gaps)
        if found is not None and (found.moved > allowed or found.cost > COARSE_MESH):
            return with_substeps(options, extremal.mesh, numbers[0])
    return None


def divided(
    extremal: Extremal,
    options: Options,
    allowed: float,
    running: float | None = None,
    most: float = MOST_TIMES,
    margin: float = MARGIN,
    gaps: Array | float = 0.0,
) -> Options | None:
    """`finer_steps`, of at most so many times as many, for so many times less change."""
    statement, mesh = extremal.statement, extremal.mesh
    order = 2 if mesh.step == "strang" else ORDER
    moved, size = by_segments(extremal, gaps)
    times = (
        max(float((moved / size).max(initial=0.0)), _against_growth(extremal, gaps, allowed, margin, order)) / allowed
    )
    if statement.fed and running is not None:
        times = max(times, mesh_error(extremal, running) / COARSE_MESH)
    if running is not None and not np.any(gaps):  # a square: it falls twice as fast with the steps
        cost = _cost_of_all(extremal, running, None)
        bent = abs(change_by_bends(extremal, _halved(extremal), 2, cost))
        times = max(times, (bent / (COARSE_MESH * max(abs(cost), NO_COST))) ** 0.5)
    fast = changes_within_steps(extremal)
    if fast and not np.any(gaps):
        times = max(times, _error_of_one(extremal) / COARSE_MESH)
    if not 1.0 < times < np.inf:  # where halving them diverges nothing can be said
        return None
    unit = step_unit(statement, mesh)
    wanted = mesh.substeps * min((margin * times) ** (1 / order), most)
    fewest = mesh.substeps // unit + 1
    number = max(int(np.ceil(wanted / unit)), fewest)
    if fast:  # a round number of steps may meet one place of a period
        number += next(more for more in range(ROUND) if gcd(number + more, ROUND) == 1)
    substeps = min(number, MOST_SUBSTEPS // unit) * unit
    if substeps <= mesh.substeps:
        return None
    return with_substeps(options, mesh, substeps)


def _error_of_one(extremal: Extremal) -> float:
    """`mesh_error` of a statement by itself; 0 where it costs nothing by shorter steps too, or that is no number."""
    running = parted(extremal, 1).running
    cost = _cost_of_all(extremal, running, None)
    most = max(abs(cost), abs(cost + changes_by_parts(extremal, running, 2)[0]))
    return float(np.nan_to_num(mesh_error(extremal, running))) if most > NO_COST else 0.0


def _against_growth(extremal: Extremal, gaps: Array | float, allowed: float, margin: float, order: int) -> float:
    """`_by_halves` where a few more steps suffice against what an unstable plant makes of them; else 0.

    Over a long horizon no steps do, and roundoff and what the solver left of the gaps grow as they do. What an
    oscillator adds up is told as it is: against it the segments by themselves are looked at.
    """
    mesh = extremal.mesh
    if np.any(gaps) or len(mesh.segments) == 1:
        return 0.0
    error = _by_halves(extremal, gaps)
    if not error > allowed or not mesh.substeps * (margin * error / allowed) ** (1 / order) <= MOST_AGAINST_GROWTH:
        return 0.0
    if unstable(extremal) is None:
        return 0.0
    own = refined_run(extremal.statement, mesh, extremal.trajectory, extremal.parameters, parts=1).jumps
    halved = _halved(extremal).jumps
    return error if np.abs(own).max() <= OWN_SHARE * np.abs(halved).max() else 0.0


def _moved(jumps: Array, x: Array, least: Array) -> float:
    """Largest change of a state over a segment, relative to its range, which counts as no less than given.

    A rate that jumps inside an interval, which steps cannot see, need not change the cost.
    """
    return float((np.abs(jumps).max(axis=0) / np.maximum(np.ptp(x, axis=0), least)).max(initial=0.0))


def _missed(extremal: Extremal, finer: Refined, parts: int, within: Within | None) -> float:
    """Multipliers of the final values times what one run along the controls misses of them.

    Within a chain those of the later statements too, which begin where this one ends: they are in what these cost by
    its end, less what they cost along their controls. Zero where the nominal is so unstable that roundoff alone would
    miss as much.
    """
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    held, held_matrices = extremal.multipliers.final, np.zeros(st.ne)
    if within is not None:
        flown, flown_matrices = within.along_controls
        held, held_matrices = held - flown, within.end_matrices - flown_matrices
    if st.coupled or not (held.any() or held_matrices.any()):
        return 0.0
    along = finer.matrices[-1] - t.e[-1]
    if len(mesh.segments) == 1:
        along = along if mesh.eliminated else finer.jumps[-1, st.nx :]
        return float(held @ finer.jumps[-1, : st.nx] + held_matrices @ along)
    drift = nominal_along(extremal, parts)[-1] - t.x[-1]
    if is_lost(extremal, np.abs(drift)):
        return 0.0
    if held_matrices.any():
        along = matrices_along_controls(extremal)[-1] - t.e[-1]
    return float(held @ drift + held_matrices @ along)


def _at_the_end(extremal: Extremal, matrices: Array) -> float:
    """Terminal cost and conditions, with their multipliers, for other half-vectors at the end."""
    st, t, multipliers = extremal.statement, extremal.trajectory, extremal.multipliers
    value = float(st.terminal(t.x[-1], matrices, t.duration, extremal.parameters))
    value += float(multipliers.final_matrices @ matrices)
    if st.end.size:
        arguments = (t.x[-1], extremal.controls[-1], matrices, t.duration, t.duration, extremal.parameters)
        value += float(multipliers.end @ np.asarray(st.end.function(*arguments).full()).ravel())
    return value
