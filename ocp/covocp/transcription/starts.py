"""Where a solver starts: a problem's own start, and whether it is plain, so that this one start will do.

A problem is plain where a bend of its controls moves the states in proportion to it, and where a step or two of Gauss
and Newton bring them to their final values. What else there is to start from is in `ranked_starts`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import is_number
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.matrices import Array
from covocp.base.quadrature import interpolated
from covocp.base.short_repr import short_repr
from covocp.statement.statement import Statement
from covocp.transcription.before_reading import GAIN
from covocp.transcription.choosing import IMPLICIT_SUBSTEPS
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.first_guess import (
    check_model,
    control_scale,
    controls_guess,
    evaluate_guess,
    is_plain,
    simulate_matrices,
    simulate_states,
    starts,
)
from covocp.transcription.held import Held, aim, excited, in_moving_units, too_dear
from covocp.transcription.mesh import Mesh, Options, explicit_substeps
from covocp.transcription.noticed import looks_wrong, noticed_units
from covocp.transcription.preferred import wanted_end
from covocp.transcription.scales import choose_scales, magnitudes, needed_controls
from covocp.transcription.steering import FAR_UNIT, Run, resampled, steer, track
from covocp.transcription.stiffness import stiffness
from covocp.transcription.trajectory import Trajectory

# A bend is halved until its second half moves the states as its first half does, up to this share, or until it moves
# none by more than FAINT of its scale.
CURVED = 0.5
FAINT = 0.05
HALVINGS = 30
# Share of the miss that the first step of steering may leave where a problem is plain.
PLAIN_MISS = 0.3
# The range of the bounds of a state counts up to so many times its magnitude (1 where it has none).
WIDE = 1e3
# A bend is at most so many times the change of a control that moves some state by its magnitude.
REACH = 4.0
# A control that steering moved by more than so many bends is not bent.
FAR = 5.0
# States that answer to a control so many times more by the end than by half the time are unstable: six integrators in
# a row give 2^6.
GROWTH = 64.0
# Intervals of the mesh on which starts are compared.
COARSE = 24


@dataclass(frozen=True, kw_only=True)
class First:
    """A start, whether no others are worth looking at, whether a feedback holds it, whether it is one of several ways.

    unbent: the controls of the problem's own start before they were bent, where they were; rival: whether what is found
    from it is to be compared with what is found from the others; alike: whether a rival has the magnitudes of the
    problem's own start; about: what a rival will cost, NaN where nothing tells; sides: the start as it is compared with
    those that are bent to other sides, and these; of those that may learn more.
    """

    trajectory: Trajectory
    plain: bool
    held: bool = False
    unbent: Array | None = None
    rival: bool = False
    alike: bool = False
    about: float = np.nan
    sides: tuple[Trajectory, ...] = ()

    __repr__ = short_repr


# The starts of the solve that is going on.
_KEPT_STARTS: ContextVar[dict[tuple[Statement, Mesh, tuple[float, ...], bool], First] | None] = ContextVar(
    "kept_starts", default=None
)


def own_start(statement: Statement, mesh: Mesh, parameters: Array, *, hold: bool = True) -> First:
    """Controls from their guesses, steered and bent where these are numbers; states from theirs, or simulated.

    Where the nominal is unstable and would stay so a feedback holds it, unless it is asked to be left to itself.
    The last ones are kept: a solver that is asked again for the same parameters starts from the same. Where a guess may
    have changed since (a function, an array that is filled anew) they are within one solve (`starts_kept`).
    """
    key, kept = (statement, mesh, tuple(parameters), hold), _KEPT_STARTS.get()
    if stays(statement):
        return _own_start(*key)
    if kept is None:
        return _own_start.__wrapped__(*key)
    if key not in kept:
        kept[key] = _own_start.__wrapped__(*key)
    return kept[key]


@contextmanager
def starts_kept() -> Iterator[None]:
    """Within it no guess changes: each start is made once."""
    token = _KEPT_STARTS.set({})
    try:
        yield
    finally:
        _KEPT_STARTS.reset(token)


def stays(statement: Statement) -> bool:
    """Whether a start is the same again, as no guess may have changed since."""
    return all(guess is None or is_number(guess) for guess in statement.guesses.values())


@lru_cache(maxsize=2)
def _own_start(statement: Statement, mesh: Mesh, values: tuple[float, ...], hold: bool) -> First:
    parameters = np.array(values)
    duration = statement.duration.guess
    u = controls_guess(statement, mesh.nodes, mesh.control)
    start, e0 = beside_guesses(statement, mesh, parameters)
    check_model(statement, start, u[:1].ravel(), e0, duration, parameters)
    plain, run, unbent = True, None, None
    if statement.nu and not statement.coupled and all(is_plain(statement.guesses[b.name]) for b in statement.controls):
        run = _held(statement, mesh, values) if hold else None
        followed = followed_states(statement)
        if followed:
            u = _tracked(statement, mesh, parameters, followed)
        else:
            flat = controls_guess(statement, mesh.nodes, mesh.control, sign=0.0)
            units = untold_units(statement, mesh, parameters, flat)
            u, unbent, plain = _bent(base_run(statement, mesh, parameters, start, flat), u, flat, units)
    elif statement.nu and statement.coupled:
        u = _within_reach(statement, mesh, parameters, u)
    left = completed(statement, mesh, parameters, u)
    if np.isnan(statement.boundary_values(parameters)[0]).any() and not _ends_well(statement, left, parameters):
        other = completed(statement, mesh, parameters, u, start=starts(statement, mesh, parameters)[0])
        left = other if _ends_well(statement, other, parameters) else left
    if run is None:
        return First(trajectory=left, plain=plain, unbent=unbent)
    kept = completed(statement, mesh, parameters, run.u.copy(), x=run.x.copy())
    if too_dear(told_run(statement, mesh, parameters, start), kept, left):
        return First(trajectory=left, plain=plain, unbent=unbent)
    return First(trajectory=kept, plain=True, held=True)


def beside_guesses(statement: Statement, mesh: Mesh, parameters: Array) -> tuple[Array, Array]:
    """Initial state and matrices, free entries a little beside their guesses, unless the model has no values there."""
    guessed = starts(statement, mesh, parameters)
    if not np.isnan(statement.boundary_values(parameters)[0]).any():
        return guessed
    u = controls_guess(statement, mesh.nodes, mesh.control)[:1].ravel()
    try:
        start, e0 = starts(statement, mesh, parameters, _units_beside(statement, mesh, parameters, guessed))
        check_model(statement, start, u, e0, statement.duration.guess, parameters)
    except ProblemError:
        return guessed
    return start, e0


def _ends_well(statement: Statement, t: Trajectory, parameters: Array) -> bool:
    """Whether the terminal cost and the conditions at the end have values at the end of a trajectory."""
    x, u, e, duration = t.x[-1], t.u[-1], t.e[-1], t.duration
    values = [statement.terminal(x, e, duration, parameters)]
    if statement.end.size:
        values.append(statement.end.function(x, u, e, duration, duration, parameters))
    return all(np.isfinite(np.asarray(ca.DM(value).full())).all() for value in values)


def _units_beside(statement: Statement, mesh: Mesh, parameters: Array, guessed: tuple[Array, Array]) -> Array:
    """Units of the states (nx,): scales that are given, else final values, else what they pass through; else 1."""
    final = np.abs(np.nan_to_num(statement.boundary_values(parameters)[1]))
    flat = controls_guess(statement, mesh.nodes, mesh.control, sign=0.0)
    x = simulate_states(statement, mesh, *guessed, flat, statement.duration.guess, parameters)
    units = np.where(final > 0, final, np.abs(x).max(axis=0))
    for block in statement.states:
        units[block.span] = statement.scales.get(block.name, units[block.span])
        own = units[block.span]
        units[block.span] = np.where(own > 0, own, own.max())
        if block.name == GAIN and block.name not in statement.scales:
            at_first = Trajectory(x=x, u=flat, e=guessed[1][None, :], duration=statement.duration.guess)
            units[block.span] = choose_scales(statement, mesh, at_first, parameters).x[block.span]
    return np.where(units > 0, units, 1.0)


def completed(
    statement: Statement,
    mesh: Mesh,
    parameters: Array,
    u: Array,
    *,
    start: Array | None = None,
    duration: float | None = None,
    x: Array | None = None,
) -> Trajectory:
    """The trajectory of some controls: guessed states as they are guessed, the others simulated, and the matrices.

    Another initial state than the guessed one, or another duration, may be given; or the states, which then count.
    """
    own, e0 = starts(statement, mesh, parameters)
    if start is None:
        start, e0 = beside_guesses(statement, mesh, parameters)
    duration = statement.duration.guess if duration is None else duration
    guessed = [b for b in statement.states if statement.guesses[b.name] is not None]
    if x is not None:
        guessed = []
    elif len(guessed) < len(statement.states):
        x = simulate_states(statement, mesh, start, e0, u, duration, parameters)
    else:
        x = np.zeros((mesh.intervals + 1, statement.nx))
    for block in guessed:
        x[:, block.span] = evaluate_guess(block, statement.guesses[block.name], mesh.nodes)
        x[:, block.span] += (start - own)[block.span]
    return Trajectory(x=x, u=u, e=simulate_matrices(statement, mesh, x, u, e0, duration, parameters), duration=duration)


def base_run(statement: Statement, mesh: Mesh, parameters: Array, start: Array, flat: Array) -> Run:
    """The run of the nominal on a mesh, in the scales that boundary values, bounds and the unbent run give."""
    run = told_run(statement, mesh, parameters, start)
    travelled = np.abs(run.states(flat)).max(axis=0)
    return replace(run, scale=np.where(np.isfinite(travelled), np.maximum(run.scale, travelled), run.scale))


def told_run(statement: Statement, mesh: Mesh, parameters: Array, start: Array) -> Run:
    """The run of the nominal on a mesh, in the scales that boundary values and bounds give.

    Bounds that are far away say little: they count up to so many times what something else tells.
    """
    final = statement.boundary_values(parameters)[1]
    lower, upper = statement.state_bounds
    span = np.where(np.isfinite(upper - lower), 0.5 * (upper - lower), 0.0)
    known = np.maximum(np.abs(start), np.abs(np.nan_to_num(final)))
    scale = np.maximum(known, np.minimum(span, WIDE * np.where(known > 0, known, 1.0)))
    for block in statement.states:
        given = statement.scales.get(block.name)
        if given is not None:
            scale[block.span] = given
        elif block.size > 1:  # components of one vector have one magnitude unless they are told apart
            scale[block.span] = np.where(scale[block.span] > 0, scale[block.span], scale[block.span].max())
    return Run(
        statement=statement,
        mesh=mesh,
        start=start,
        duration=statement.duration.guess,
        parameters=parameters,
        scale=scale,
        units=np.ones(statement.nu),
    )


@lru_cache(maxsize=2)
@np.errstate(over="ignore", invalid="ignore")  # a run that leaves all numbers is none
def _held(statement: Statement, mesh: Mesh, values: tuple[float, ...]) -> Held | None:
    """A run that a feedback holds near what is guessed of the states, or from the start to where ends and cost want it.

    None where the nominal is stable somewhere there, none is found, or the guesses say how the states move.
    """
    guesses = [(b, statement.guesses[b.name]) for b in statement.states if statement.guesses[b.name] is not None]
    if not all(is_plain(guess) or np.shape(guess) == (block.size,) for block, guess in guesses):
        return None
    parameters = np.array(values)
    flat, bent = (controls_guess(statement, mesh.nodes, mesh.control, sign=sign) for sign in (0.0, 1.0))
    start, e0 = beside_guesses(statement, mesh, parameters)
    run, target = told_run(statement, mesh, parameters, start), statement.boundary_values(parameters)[1]
    if aim(run, start[None, :], flat[0], e0, target) is None:
        return None
    end = wanted_end(run, flat[0], e0)
    if not guesses and np.isnan(end[statement.moving or slice(None)]).all():
        return None  # nothing says where it shall be
    line = start + mesh.nodes[:, None] * (np.where(np.isnan(end), start, end) - start)
    for block, guess in guesses:
        line[:, block.span] = evaluate_guess(block, guess, mesh.nodes)
    aimed = aim(run, line, flat[0], e0, target)
    if aimed is None:
        return None
    run = in_moving_units(run, line, flat)
    bend = (bent - flat) * np.where(untold_controls(statement, flat), run.units, 1.0)
    return excited(run, line, aimed, flat, bend)


def followed_states(statement: Statement) -> tuple[int, ...]:
    """States whose guess says how they move: an array or a function."""
    moving = [b for b in statement.states if b.role == "moving" and not is_plain(statement.guesses[b.name])]
    rows = [list(range(b.span.start, b.span.stop)) for b in moving]
    return tuple(k for block in rows for k in block)


def _tracked(statement: Statement, mesh: Mesh, parameters: Array, rows: tuple[int, ...]) -> Array:
    """Controls along which some states follow their guesses, as far as they can."""
    path = np.zeros((mesh.intervals + 1, statement.nx))
    for block in statement.states:
        guess = statement.guesses[block.name]
        if guess is not None:
            path[:, block.span] = evaluate_guess(block, guess, mesh.nodes)
    return controls_along(statement, mesh, parameters, rows, path)


def controls_along(statement: Statement, mesh: Mesh, parameters: Array, rows: tuple[int, ...], path: Array) -> Array:
    """Controls along which some states follow a path (N + 1, nx), as far as they can."""
    coarse = coarse_mesh(statement, mesh, tuple(parameters))
    path = interpolated(path, mesh.nodes, coarse.nodes)
    start = beside_guesses(statement, mesh, parameters)[0]
    flat = controls_guess(statement, coarse.nodes, mesh.control, sign=0.0)
    run = base_run(statement, coarse, parameters, start, flat)
    run = replace(run, scale=np.maximum(run.scale, np.abs(path).max(axis=0)), units=bend_units(run, flat, path))
    return run.clip(resampled(track(run, rows, path[:, list(rows)], flat), coarse, mesh))


def _bent(run: Run, bent: Array, flat: Array, units: Array) -> tuple[Array, Array | None, bool]:
    """Controls steered to the final values and bent, in units that nothing else tells; the same unbent; whether plain.

    The bend 1 - s breaks symmetries; where the terminal conditions prefer a direction, it must not oppose them, and a
    control that they move far has no symmetry left to break.
    """
    if not np.isfinite(run.start).all():
        return bent, None, True
    sizes = np.abs(bent - flat).max(axis=0)
    bend = (bent - flat) * np.maximum(units, 1.0) * reachable(run, flat, sizes)
    size = bend_size(run, flat, bend)
    bend *= np.minimum(units, 1.0) if size >= 1.0 else 1.0  # else the states have said how much is too much
    fixed, target = targets(run)
    steered, left = steer(run, fixed, target, flat) if fixed else (flat, 0.0)
    sign = np.where(np.sum((steered - flat) * bend, axis=0) < 0, -1.0, 1.0)
    far = np.linalg.norm(steered - flat, axis=0) > FAR * size * np.linalg.norm(bend, axis=0)
    u = run.clip(steered + np.where(far, 0.0, sign) * size * bend)
    return u, steered, size >= 1.0 and left <= PLAIN_MISS


def untold_units(statement: Statement, mesh: Mesh, parameters: Array, flat: Array) -> Array:
    """Units of the controls (nu,) of which neither scale, bounds nor guess say any, by what they move; 1 of others."""
    untold = untold_controls(statement, flat)
    start, e0 = starts(statement, mesh, parameters)
    if not untold.any() or statement.coupled or not np.isfinite(start).all():
        return np.ones(statement.nu)
    still = Trajectory(
        x=simulate_states(statement, mesh, start, e0, flat, statement.duration.guess, parameters),
        u=flat,
        e=np.tile(e0, (mesh.intervals + 1, 1)),
        duration=statement.duration.guess,
    )
    units = moving_units(statement, mesh, still, parameters)
    far = (units > FAR_UNIT) | (units < 1.0 / FAR_UNIT)
    units = np.where(untold & far, units, 1.0)
    if looks_wrong(statement, start, e0, flat[0], units[untold], parameters):
        units = noticed_units(base_run(statement, mesh, parameters, start, flat), flat, units, untold)
    return units


def untold_controls(statement: Statement, flat: Array) -> NDArray[np.bool_]:
    """Controls of which neither scale, bounds nor guess say a unit, (nu,)."""
    untold = np.zeros(statement.nu, dtype=bool)
    for block in statement.controls:
        lower, upper = (bound[block.span] for bound in statement.control_bounds)
        silent = ~np.isfinite(upper - lower) & ~flat[:, block.span].any(axis=0)
        untold[block.span] = silent if block.name not in statement.scales else False
    return untold


def moving_units(statement: Statement, mesh: Mesh, along: Trajectory, parameters: Array) -> Array:
    """Units of the controls (nu,) by what they move; 1 where it is little only because the plant amplifies it."""
    units = choose_scales(statement, mesh, along, parameters).u.copy()
    start, e0, duration = along.x[0], along.e[0], along.duration
    small = [] if statement.coupled else np.flatnonzero(units < 1.0 / FAR_UNIT).tolist()
    for i in small:
        runs = [along.u, along.u + units[i] * np.eye(statement.nu)[i]]
        base, moved = (simulate_states(statement, mesh, start, e0, u, duration, parameters) for u in runs)
        change = np.abs(moved - base)
        if (change.max(axis=0) > GROWTH * change[mesh.nodes <= 0.5].max(axis=0)).any():
            units[i] = 1.0
    return units


def reachable(run: Run, flat: Array, sizes: Array, reach: float = REACH, path: Array | None = None) -> Array:
    """Shares of the bends of the controls, of these sizes, that do not move the states far beyond their magnitudes.

    Far is so many times, `reach`; magnitudes are those of the unbent run, and of a path that is given.

    A bend of half the range between bounds that are far away would start, and measure all that follows, far from
    anything that the problem is about.
    """
    x = run.states(flat)
    x = x if np.isfinite(x).all() else run.start[None, :]
    x = x if path is None else np.vstack([x, path])
    t = Trajectory(x=x, u=flat, e=np.zeros((1, run.statement.ne)), duration=run.duration)
    # The scale of the run counts wide bounds as well; what measurements resolve is where excitation begins, not ends. A
    # state that nothing moves yet, such as the way to the side in metres, would allow next to no bend.
    scale = magnitudes(run.statement, t, run.parameters, far=WIDE, untold_far=True).x
    return _shares(run.statement, sizes, needed_controls(run.statement, run.mesh, t, scale, run.parameters), reach)


def _shares(statement: Statement, sizes: Array, needed: Array, reach: float = REACH) -> Array:
    """So many times what is needed over these sizes, at most 1; 1 without two bounds, with a scale, without effect."""
    bounded = np.isfinite(statement.control_bounds).all(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(bounded & (needed > 0) & (sizes > 0), np.minimum(1.0, reach * needed / sizes), 1.0)
    for block in statement.controls:
        if block.name in statement.scales:
            shares[block.span] = 1.0
    return shares


def _within_reach(statement: Statement, mesh: Mesh, parameters: Array, u: Array) -> Array:
    """Bent controls whose bends do not move states far beyond their magnitudes, where covariances drive the states."""
    flat = controls_guess(statement, mesh.nodes, mesh.control, sign=0.0)
    t = completed(statement, mesh, parameters, flat)
    needed = needed_controls(statement, mesh, t, magnitudes(statement, t, parameters).x, parameters)
    return np.asarray(flat + _shares(statement, np.abs(u - flat).max(axis=0), needed) * (u - flat))


def targets(run: Run) -> tuple[tuple[int, ...], Array]:
    """States with final values, and these."""
    final = run.statement.boundary_values(run.parameters)[1]
    fixed = np.flatnonzero(~np.isnan(final))
    return tuple(int(k) for k in fixed), final[fixed]


def bend_size(run: Run, flat: Array, bend: Array) -> float:
    """Share of a bend to which the states answer in proportion, measured by their values at all nodes.

    1 unless the second half of the bend moves them otherwise than the first: then it is halved, until it does not or is
    faint. States that answer to a bend of nothing by its square never do: they are left out then.
    """
    if not bend.any():
        return 1.0
    rows = run.statement.moving or list(range(run.statement.nx))  # integrals bend by themselves
    if not np.isfinite(run.states(flat)[:, rows]).all():
        return 1.0
    size, straight = _halved(run, flat, bend, rows)
    if straight is None or straight == rows:
        return size
    return _halved(run, flat, bend, straight)[0] if straight else 1.0


def _halved(run: Run, flat: Array, bend: Array, rows: list[int]) -> tuple[float, list[int] | None]:
    """The share of a bend by some states; where they never answered in proportion, those that did so in the end."""
    size, base, scales = 1.0, run.states(flat)[:, rows], run.scale[rows]
    full, straight = run.states(run.clip(flat + bend))[:, rows], rows
    for _ in range(HALVINGS):
        half = run.states(run.clip(flat + 0.5 * size * bend))[:, rows]
        if np.isfinite(full).all() and np.isfinite(half).all():
            moved, bow = full - base, full - 2.0 * half + base
            largest = np.abs(moved).max(axis=0)
            scale = np.where(scales > 0, scales, _of_vectors(run.statement, rows, largest))
            if 2.0 * np.linalg.norm(bow / scale) <= CURVED * np.linalg.norm(moved / scale):
                return size, None
            if (largest / scale).max() <= FAINT:
                return size, None
            in_proportion = 2.0 * np.abs(bow).max(axis=0) <= CURVED * largest
            straight = [row for row, own in zip(rows, in_proportion, strict=True) if own]
        size, full = 0.5 * size, half
    return size, straight


def _of_vectors(statement: Statement, rows: list[int], sizes: Array) -> Array:
    """Sizes of some states as one for each vector, 1 where it is zero: what rounding moves is no size of its own."""
    result = np.zeros(statement.nx)
    result[rows] = sizes
    for block in statement.states:
        result[block.span] = result[block.span].max()
    return np.where(result > 0, result, 1.0)[rows]


def bend_units(run: Run, flat: Array, path: Array | None = None) -> Array:
    """Sizes of the bends of each control, from their effect on the states, which may have a path: constant changes."""
    statement, units = run.statement, np.ones(run.statement.nu)
    for block in statement.controls:
        units[block.span] = control_scale(statement, block, flat[:, block.span])
    units *= np.maximum(untold_units(statement, run.mesh, run.parameters, flat), 1.0)
    units *= reachable(run, flat, units, path=path)
    for i in range(statement.nu):
        bend = np.zeros_like(flat)
        bend[:, i] = units[i]
        units[i] *= bend_size(run, flat, bend)
    return units


@lru_cache(maxsize=KEPT)
def coarse_mesh(statement: Statement, mesh: Mesh, parameters: tuple[float, ...], most: int = COARSE) -> Mesh:
    """The mesh on which starts are compared, with as many steps as the rates need."""
    count = min(most, mesh.intervals)
    nodes = np.linspace(0.0, 1.0, count + 1)
    stiff = stiffness(statement, Options(grid=nodes), np.array(parameters))
    steps = IMPLICIT_SUBSTEPS if mesh.step == "rodas" else max(2, explicit_substeps(stiff.nominal))
    none = np.zeros((mesh.readings.shape[0], count))
    steps += steps % 2
    return replace(mesh, nodes=nodes, substeps=steps, segments=(count,), eliminated=True, points=1, readings=none)
