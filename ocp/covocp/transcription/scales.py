"""Magnitudes of states, controls, matrices and time: the units in which a nonlinear program works."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from covocp.base.matrices import Array, half_indices, unpack
from covocp.statement.statement import Block, Statement
from covocp.transcription.before_reading import GAIN
from covocp.transcription.first_guess import evaluate_guess, simulated
from covocp.transcription.mesh import Mesh
from covocp.transcription.nlp import Scales
from covocp.transcription.resolution import estimated_rows, resolutions
from covocp.transcription.steering import quadrature_weights
from covocp.transcription.trajectory import Trajectory

# Statements of which values at the ends and bounds are kept.
KEPT = 16
# Step by which the response to a control is measured: a share of its size, then of what it moves a state by. That says
# how much it moves where it is within these; else it is tried again, up to so many times, each so many times longer or
# shorter at most. So no unit of a control matters, whose size nothing tells.
RESPONSE_STEP = 1e-3
RESPONDS, RESPONSES, FURTHER = (1e-6, 1.0), 4, 1e9
# Shooting states are scaled by more than their magnitude where the Hessian is of limited memory: it then learns the
# curvature along the controls first (chain of 9 masses: 15 iterations instead of 21).
STRETCH = 10.0
# Least magnitude of a state that starts at (or keeps near) nothing, as a share of the range of its bounds or of 1, the
# lesser one: at a start, which may not have moved it yet, and at a point that was reached, where less is roundoff.
AT_START, REACHED = 1e-3, 1e-9
# A standard deviation counts up to so many times the values at the ends (1 where they tell none), at a start and at a
# point that was reached: a large prior says that little is known, not that the nominal goes there. In far too large
# units of state and control a cost has the size of what they change of it, and any point looks converged.
PRIOR_AT_START, PRIOR_REACHED = 1e3, 10.0
# Share of the largest magnitude of the states that one which nothing tells may have in a bend of the controls.
UNTOLD_SHARE = 0.1
# Share of a given scale that a point which was reached is at least judged by: who gave it may be wrong by as much.
GIVEN_SHARE = 1e-6
# Half the range of bounds counts up to so many times what else tells of a state that may have vanished.
WIDE_BOUNDS = 1e3
# What no quantity has in any unit: the rest of a state or control that is zero. It is no magnitude.
NOTHING = 1e-50
# An entry of a gain, of one in its unit, lets the control scatter by so many times what the largest does along a guess.
SCATTER = 1.4
# A variance that starts at zero and stays below this share of the largest one is what steps leave of one that is zero.
ROUNDOFF = 1e-24


def magnitudes(
    statement: Statement,
    guess: Trajectory,
    parameters: Array,
    *,
    reached: bool = False,
    far: float = 1.0,
    untold_far: bool = False,
) -> Scales:
    """Magnitudes from the given scales, boundary values, standard deviations and the trajectory itself.

    The ranges of the bounds are an upper limit: bounds that are far away say nothing of what moves between them.
    A small standard deviation of a state that starts at zero says how well it is known, not where it goes: where a
    start does not move it further, it counts at least as much as the measurements resolve.

    Args:
        statement: the problem.
        guess: the trajectory.
        parameters: of the statement.
        reached: whether a solver found it: then it tells more than scales that were given.
        far: so many times what the measurements resolve.
        untold_far: whether a state of which nothing tells a magnitude has at least a share of the largest; else 1.
    """
    ends, deviations = _prescribed(statement, parameters, PRIOR_REACHED if reached else PRIOR_AT_START)
    moved = np.abs(guess.x).max(axis=0, initial=0.0)
    found = np.max([moved, ends, deviations], axis=0)
    if (untold := (ends <= NOTHING) & (moved <= deviations)).any() and not reached:
        resolved = far * resolutions(statement, guess, parameters)
        # of what nothing tells more than that it is known exactly an accurate sensor tells no more: 1 is left for it
        untold &= np.isfinite(resolved) & ((found > NOTHING) | (resolved > 1.0))
        found = np.where(untold, np.maximum(found, resolved), found)
    least, span, alone = _bounded(statement, reached)
    x = np.where(found > NOTHING, np.clip(found, least, span), alone)
    if untold_far:
        known = UNTOLD_SHARE * max((found[k] for k in statement.moving), default=0.0)
        x = np.where(found > NOTHING, x, np.minimum(np.maximum(x, known), span))
    u = np.ones(statement.nu)
    for block in statement.states:
        x[block.span] = _as_given(statement, block, x[block.span], found[block.span] > NOTHING, reached)
    for block in statement.controls:
        own = np.abs(guess.u[:, block.span]).max(axis=0, initial=0.0)
        size = np.minimum(np.where(own > NOTHING, own, 1.0), _half_range(statement, block))
        u[block.span] = _as_given(statement, block, size, own > NOTHING, reached)
    found_scales = Scales(x=x, u=u, e=_matrix_scales(statement, guess.e), duration=statement.duration.guess)
    return _with_gain(statement, guess, found_scales)


def unvanishing(
    statement: Statement, mesh: Mesh, found: Trajectory, parameters: Array, wide: float = WIDE_BOUNDS
) -> Array:
    """Magnitudes of the states (nx,) along a trajectory that do not vanish with it.

    A state that is best at zero is there up to what the tolerance leaves, which is no magnitude: the scale, the guess
    and the ends that are given of it, its deviation and its bounds are, and 1 where none of them tells any.

    Args:
        statement: the problem.
        mesh: of the trajectory.
        found: the trajectory.
        parameters: of the statement.
        wide: half the range of bounds counts up to so many times what else is given (1 where nothing is).
    """
    told = np.max(_prescribed(statement, parameters, PRIOR_REACHED), axis=0)
    for block in statement.states:
        values = [told[block.span]]
        if block.name in statement.scales and block.role != "decision":  # those have the range of their bounds
            values.append(np.broadcast_to(statement.scales[block.name], block.size))
        if statement.guesses[block.name] is not None:
            values.append(np.abs(evaluate_guess(block, statement.guesses[block.name], mesh.nodes)).max(axis=0))
        told[block.span] = np.max(values, axis=0)
    lower, upper = statement.state_bounds
    half = np.where(np.isfinite(upper - lower), 0.5 * (upper - lower), 0.0)
    told = np.maximum(told, np.minimum(half, wide * np.where(told > NOTHING, told, 1.0)))
    for block in statement.states:
        if block.name == GAIN and GAIN not in statement.scales:
            told[block.span] = magnitudes(statement, found, parameters, reached=True).x[block.span]
    return np.asarray(np.maximum(np.abs(found.x).max(axis=0, initial=0.0), np.where(told > NOTHING, told, 1.0)))


@lru_cache(maxsize=KEPT)
def _bounded(statement: Statement, reached: bool) -> tuple[Array, ...]:
    """Least and largest magnitudes of the states (nx,) by their bounds, and what they have where nothing else tells."""
    lower, upper = statement.state_bounds
    span = np.where(upper > lower, upper - lower, np.inf)
    limits = np.where(np.isfinite([lower, upper]), np.abs([lower, upper]), 0.0).max(axis=0)
    alone = np.where(limits > 0, np.minimum(limits, 1.0), 1.0)
    alone = np.where(np.isfinite(span), np.minimum(span, 1.0), alone)
    least = np.where(np.isfinite(span), (REACHED if reached else AT_START) * np.minimum(span, 1.0), 0.0)
    return _kept(least, span, alone)


def _prescribed(statement: Statement, parameters: Array, most: float) -> tuple[Array, ...]:
    """Magnitudes of the states (nx,) by their values at the ends, and by their deviations: these up to a multiple."""
    return _prescribed_by(statement, np.asarray(parameters, dtype=float).tobytes(), most)


@lru_cache(maxsize=KEPT)
def _prescribed_by(statement: Statement, parameters: bytes, most: float) -> tuple[Array, ...]:
    """The same, read-only: it is asked in every solve, of parameters that stay."""
    x0, xf, e0, _ = statement.boundary_values(np.frombuffer(parameters))
    ends = np.maximum(np.abs(np.nan_to_num(x0)), np.abs(np.nan_to_num(xf)))
    deviations = np.minimum(_deviations(statement, e0), most * np.where(ends > 0, ends, 1.0))
    return _kept(ends, deviations)


def _kept(*values: Array) -> tuple[Array, ...]:
    """Arrays that several ask for."""
    for value in values:
        value.setflags(write=False)
    return values


def _deviations(statement: Statement, e: Array) -> Array:
    """Standard deviations of the states by some half-vectors (ne,), shape (nx,); 0 of those that nothing estimates."""
    deviations = np.zeros(statement.nx)
    for block in statement.matrices:
        if block.estimation:
            variances = np.diagonal(unpack(np.nan_to_num(e[block.span]), block.size))
            for k, row in estimated_rows(statement).items():
                deviations[k] = np.sqrt(max(variances[row], 0.0))
    return deviations


def choose_scales(
    statement: Statement, mesh: Mesh, guess: Trajectory, parameters: Array, *, reached: bool = False
) -> Scales:
    """The magnitudes along a guess, controls by what they move as well; arguments as of `magnitudes`."""
    scales = magnitudes(statement, guess, parameters, reached=reached)
    free = [block for block in statement.controls if reached or block.name not in statement.scales]
    if statement.coupled or not free:
        return scales
    u, response = scales.u.copy(), needed_controls(statement, mesh, guess, scales.x, parameters)
    for block in free:
        magnitude = np.abs(guess.u[:, block.span]).max(axis=0, initial=0.0)
        own = np.maximum(magnitude, np.where(response[block.span] > 0, response[block.span], 1.0))
        half = _half_range(statement, block)
        if not reached:  # a bounded component of a vector that does nothing yet has the size of the others
            least = np.maximum(magnitude.max(initial=0.0), AT_START * np.minimum(half, 1.0))
            own = np.where(np.isfinite(half), np.maximum(own, least), own)
        own = np.minimum(own, half)
        u[block.span] = _as_given(statement, block, own, own > 0, reached)
    return _with_gain(statement, guess, replace(scales, u=u))


def _with_gain(statement: Statement, guess: Trajectory, scales: Scales) -> Scales:
    """The same with a gain that is chosen freely in units of controls and states: it moves nothing of the nominal.

    Each entry by itself lets the control scatter a little more than the largest one does; where all are zero, than the
    nominal control moves.
    """
    blocks = [b for b in (*statement.controls, *statement.states) if b.name == GAIN]
    if statement.loop is None or not blocks or GAIN in statement.scales:
        return scales
    gain, count = blocks[0], statement.loop.gain.size1_out(0)
    constant = gain.kind == "state"
    along, (lower, upper) = (guess.x, statement.state_bounds) if constant else (guess.u, statement.control_bounds)
    entries, places = (np.array(v) for v in statement.loop.gain.jac_sparsity(0, int(not constant)).get_triplet())
    inside = (places >= gain.span.start) & (places < gain.span.stop)
    rows, columns = np.divmod(entries[inside][np.argsort(places[inside])], count)[::-1]
    spread = _spread(statement, guess, scales.x)[columns]
    scatter = np.abs(along[:, gain.span]).max(axis=0, initial=0.0) * spread
    fed = scales.u if constant else np.delete(scales.u, np.arange(gain.span.start, gain.span.stop))
    largest = np.array([scatter[rows == row].max(initial=0.0) for row in range(count)])
    size = SCATTER * np.where(largest > NOTHING, largest, fed)[rows] / spread
    half = 0.5 * (upper - lower)[gain.span]
    size = np.where(np.isfinite(half) & (half > 0.0), np.minimum(size, half), size)
    x, u = scales.x.copy(), scales.u.copy()
    (x if constant else u)[gain.span] = size
    return replace(scales, x=x, u=u)


def _spread(statement: Statement, guess: Trajectory, x: Array) -> Array:
    """Mean deviations of the rows of the augmented state along a guess; magnitudes of what does not deviate."""
    sizes, variances = np.ones(len(statement.augmented)), np.zeros(len(statement.augmented))
    for k, row in estimated_rows(statement).items():
        sizes[row] = x[k]
    for block in statement.matrices:
        if block.size == variances.size:
            rows, columns = half_indices(block.size)
            variances += np.abs(guess.e[:, block.span][:, rows == columns]).mean(axis=0)
    told = np.isfinite(variances) & (variances > NOTHING)
    return np.where(told, np.sqrt(np.where(told, variances, 1.0)), sizes)


def with_given(statement: Statement, scales: Scales) -> Scales:
    """Magnitudes of a point that was reached, in their place the scales that were given."""
    x, u = scales.x.copy(), scales.u.copy()
    for values, blocks in ((x, statement.states), (u, statement.controls)):
        for block in blocks:
            if block.name in statement.scales:
                values[block.span] = statement.scales[block.name]
    return replace(scales, x=x, u=u)


def _as_given(statement: Statement, block: Block, found: Array, known: Array, reached: bool) -> Array:
    """The given scale of a block, or what was found where none is given; both where a solver found it."""
    given = statement.scales.get(block.name)
    if given is None:
        return found
    size = np.broadcast_to(given, found.shape)
    return np.where(known, np.clip(found, GIVEN_SHARE * size, size), size) if reached else size


def _half_range(statement: Statement, block: Block) -> Array:
    """Half the range of the bounds of a control; inf where it has not two of them, or both are one."""
    lower, upper = (bound[block.span] for bound in statement.control_bounds)
    return np.where(upper > lower, 0.5 * (upper - lower), np.inf)


def evened(scales: Scales, mesh: Mesh) -> Scales:
    """For a limited-memory Hessian: equal changes of two control values cost the same, however long the intervals."""
    weights = quadrature_weights(mesh)
    return replace(scales, x=STRETCH * scales.x, u=scales.u * np.sqrt(weights.mean() / weights)[:, None])


def needed_controls(statement: Statement, mesh: Mesh, guess: Trajectory, scale: Array, parameters: Array) -> Array:
    """Constant changes of each control that move some state by its scale, to first order; 0 where none does."""
    needed = np.zeros(statement.nu)
    base = simulated(statement, mesh, guess.x[0], guess.e[0], guess.u, guess.duration, parameters)
    if base is None:
        return needed

    def share(i: int, step: float) -> float:
        """Which part of its scale a step of one control moves some state by, at most; inf where that diverges."""
        changed = guess.u.copy()
        changed[:, i] += step
        moved = simulated(statement, mesh, guess.x[0], guess.e[0], changed, guess.duration, parameters)
        if moved is None:
            return np.inf
        return float((np.abs(moved - base).max(axis=0, initial=0.0) / scale).max(initial=0.0))

    for i, size in enumerate(_known_controls(statement, guess).tolist()):
        step = RESPONSE_STEP * size
        moved = share(i, step)
        for _ in range(RESPONSES):
            if RESPONDS[0] <= moved <= RESPONDS[1]:
                break
            step *= float(np.clip(RESPONSE_STEP / moved if moved > 0 else np.inf, 1.0 / FURTHER, FURTHER))
            moved = share(i, step)
        needed[i] = step / moved if np.isfinite(moved) and moved > 0 else 0.0
    return needed


def _known_controls(statement: Statement, guess: Trajectory) -> Array:
    """What is known of the sizes of the controls, (nu,): along a guess, their scales, half their ranges; else 1."""
    known: Array = np.asarray(np.abs(guess.u).max(axis=0, initial=0.0))
    for block in statement.controls:
        given, half = statement.scales.get(block.name), _half_range(statement, block)
        told = np.where(np.isfinite(half), half, 1.0) if given is None else np.broadcast_to(given, half.shape)
        own = known[block.span]
        known[block.span] = np.where(own > NOTHING, own, np.minimum(told, 1.0 if given is None else told))
    return known


def _matrix_scales(statement: Statement, e: Array) -> Array:
    """sqrt(E_ii E_jj) from the largest variances along the guess; 1 where these are zero or nothing but roundoff."""
    scales = np.ones(statement.ne)
    for block in statement.matrices:
        rows, columns = half_indices(block.size)
        along = np.abs(e[:, block.span][:, rows == columns])
        diagonal = along.max(axis=0, initial=0.0)
        roundoff = np.where(along[:1].any(axis=0), NOTHING, ROUNDOFF * diagonal.max(initial=0.0))
        diagonal = np.where(diagonal > np.maximum(roundoff, NOTHING), diagonal, 1.0)
        scales[block.span] = np.sqrt(diagonal[rows]) * np.sqrt(diagonal[columns])
    return scales
