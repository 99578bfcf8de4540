"""Guesses for a solver: the problem's own, another solution on this mesh, given values, random starts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, spelling
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.quadrature import interpolated
from covocp.base.short_repr import short_repr
from covocp.extremal.dense_output import between_nodes
from covocp.extremal.extremal import Guess
from covocp.solution.solution import Solution
from covocp.solving.gain_start import free_gain_block, gain_entries
from covocp.statement.names import name_of
from covocp.statement.statement import Block, Statement
from covocp.transcription.first_guess import check_measured, simulate_matrices, starts
from covocp.transcription.mesh import Mesh, control_places
from covocp.transcription.ranked_starts import ranked
from covocp.transcription.starts import own_start
from covocp.transcription.steering import quadrature_weights, resampled
from covocp.transcription.trajectory import Multipliers, Trajectory


@dataclass(frozen=True, kw_only=True)
class Later:
    """A plan of which some time has passed [s]."""

    plan: Solution
    elapsed: float

    __repr__ = short_repr


def make_guess(statement: Statement, mesh: Mesh, parameters: Array, guess: Given, *, linked: bool = False) -> Guess:
    """The first of `make_guesses`."""
    return next(make_guesses(statement, mesh, parameters, guess, linked=linked))


def make_guesses(
    statement: Statement, mesh: Mesh, parameters: Array, guess: Given, *, linked: bool = False
) -> Iterator[Guess]:
    """Guesses on a mesh from what the user gave, the best first; the others are made when they are asked for.

    `linked`: to a phase before, so that costates count where it starts.

    Raises:
        ProblemError: where it is none of None, a solution, a trajectory, a dict of name to guess, or a solution
            without any symbol of this problem.
    """
    if isinstance(guess, Trajectory):
        yield Guess(trajectory=guess)
    elif isinstance(guess, Later):
        yield _from_solution(statement, mesh, parameters, guess.plan, linked, guess.elapsed)
    elif isinstance(guess, Solution):
        yield _from_solution(statement, mesh, parameters, guess, linked)
    elif guess is None or isinstance(guess, Mapping):
        for first in ranked(_with_guesses(statement, guess or {}), mesh, parameters, linked=linked):
            told = {name: getattr(first, name) for name in ("held", "rival", "alike", "about", "sides")}
            yield Guess(trajectory=first.trajectory, **told)
    else:
        raise ProblemError(
            "The guess is of an unknown kind.",
            expected="None, 'multistart', a Solution, or a dict of name to guess",
            received=repr(guess)[:100],
            remedy="correct guess=",
        )


def _with_guesses(statement: Statement, given: Mapping[Any, Any]) -> Statement:
    """The statement with some of its guesses replaced by name.

    Raises:
        ProblemError: a name that cannot be guessed.
    """
    guesses = dict(statement.guesses)
    for key, value in given.items():
        name = name_of(key, statement.symbols, tuple(guesses), missing_ok=True)
        if not name:
            raise ProblemError(
                f"The guess names '{key}', which cannot be guessed.",
                expected="states, controls or matrices: " + ", ".join(guesses),
                received=str(key),
                remedy=spelling(key, guesses, "correct the name"),
            )
        guesses[name] = value
    return replace(statement, guesses=guesses) if given else statement


def _from_solution(
    statement: Statement,
    mesh: Mesh,
    parameters: Array,
    solution: Solution,
    linked: bool,
    elapsed: float | None = None,
) -> Guess:
    """A solution resampled on a mesh, primal and dual where the problems have the same symbols.

    `elapsed`: what is left of it after this time [s], its last values held after its end; None: the whole, stretched
    to this duration.
    """
    _check_common(statement, solution)
    own = solution.mesh
    t, m = solution.trajectory, solution.multipliers
    blocks = (*statement.states, *statement.controls, *statement.matrices)
    others = {(b.name, b.kind, b.size): b for b in solution.blocks}
    there = [others.get((b.name, b.kind, b.size)) for b in blocks]
    matched = (t.x.shape[1], t.u.shape[1], t.e.shape[1]) == (statement.nx, statement.nu, statement.ne)
    matched = matched and all(o is not None and o.offset == b.offset for b, o in zip(blocks, there, strict=True))
    nodes = np.array_equal(own.nodes, mesh.nodes) and np.array_equal(own.instants, mesh.instants)
    duration = _duration(statement, solution, elapsed)
    if elapsed is None and matched and nodes and own.control == mesh.control and t.u.shape[0] == mesh.control_nodes:
        trajectory = Trajectory(x=t.x.copy(), u=t.u.copy(), e=t.e.copy(), duration=duration)
    else:
        trajectory = _resampled(statement, mesh, parameters, solution, matched, elapsed)
    carried = statement.matrices and not (mesh.eliminated or statement.coupled)
    if carried and not np.array_equal(parameters, solution.extremal.parameters):
        # of other values: from large covariances on, the steps may be too long for a better sensor
        e0 = starts(statement, mesh, parameters)[1]
        made = simulate_matrices(statement, mesh, trajectory.x, trajectory.u, e0, duration, parameters)
        trajectory = replace(trajectory, e=made)
    measured = any(v is not None for v in (statement.information, statement.measurement, statement.samples))
    if measured and not statement.noise_varies:  # what parameters say has no better place to go on to
        start = [trajectory.x[0], trajectory.u[0], 0.0, duration, parameters]
        check_measured(statement, [ca.DM(given) for given in start])
    st = statement
    constraints = (st.path.size, st.start.size, st.end.size, st.inside.size)
    own_constraints = (m.path.shape[1], m.start.size, m.end.size, m.instants.size)
    if not matched or not solution.converged or own_constraints != constraints:
        return Guess(trajectory=trajectory, warm=True)
    width = statement.nx + (0 if mesh.eliminated else statement.ne)
    same = elapsed is None and nodes and own.segments == mesh.segments
    if same and m.gaps.shape == (len(mesh.segments), width) and not linked:
        costates = np.zeros((mesh.nodes.size, statement.nx + statement.ne))  # read where segments meet and nowhere else
        costates[list(mesh.starts[1:]), :width] = m.gaps
    else:
        found = np.hstack([solution.costates.state, solution.costates.matrices])
        costates = interpolated(found, own.nodes, _places(mesh.nodes, duration, solution, elapsed))
    return Guess(
        trajectory=trajectory,
        multipliers=_multipliers(m, own, mesh) if elapsed is None else _left(m, mesh, duration, solution, elapsed),
        costates=(costates[:, : statement.nx], costates[:, statement.nx :]),
        warm=True,
    )


def _duration(statement: Statement, solution: Solution, elapsed: float | None) -> float:
    """The duration to start from [s]."""
    if not statement.duration.free:
        return float(statement.duration.guess)
    left = solution.duration - (elapsed or 0.0)
    return float(left if elapsed is None else np.clip(left, statement.duration.lower, statement.duration.upper))


def _places(nodes: Array, duration: float, solution: Solution, elapsed: float | None) -> Array:
    """Where in a solution, as shares of its duration, these shares of a duration are."""
    if elapsed is None:
        return nodes
    return np.asarray(np.minimum((elapsed + nodes * duration) / solution.duration, 1.0))


def _resampled(
    statement: Statement,
    mesh: Mesh,
    parameters: Array,
    solution: Solution,
    matched: bool,
    elapsed: float | None = None,
) -> Trajectory:
    """The trajectory of a solution on another mesh, or of another problem; `matched`: nothing else is needed."""
    duration = _duration(statement, solution, elapsed)
    # matrices that the program does not hold tell their magnitudes and nothing more: they need not be integrated
    dense = solution.stored_dense or (between_nodes(solution.extremal) if mesh.eliminated else solution.dense)
    sizes, t = mesh.nodes.size, solution.trajectory

    def at(nodes: Array, *, before: bool = False) -> dict[str, Array]:
        places = _places(nodes, duration, solution, elapsed)
        z = dense.at(solution.mesh.placed(places), before=before)
        u = solution.extremal.controls_at(solution.mesh.placed(places), before=before)
        return {"state": z[:, : t.x.shape[1]], "control": u, "matrix": z[:, t.x.shape[1] :]}

    sample = at(mesh.nodes)
    ahead = at(mesh.nodes[mesh.instants], before=True) if mesh.instants else sample
    if mesh.control != "linear":
        sample["control"] = at(control_places(mesh.nodes, mesh.control))["control"]
    gain = free_gain_block(statement) if solution.loop is not None else None
    others = {(b.name, b.kind, b.size): b for b in solution.blocks}
    if matched:  # nothing of it stays
        x, u, e = (np.zeros((n, v.shape[1])) for n, v in ((sizes, t.x), (mesh.control_nodes, t.u), (sizes, t.e)))
    else:
        plain = own_start(statement, mesh, parameters).trajectory  # for what the solution does not know
        x, u, e = plain.x.copy(), plain.u.copy(), plain.e.copy()
    for block in (*statement.states, *statement.controls, *statement.matrices):
        own = others.get((block.name, block.kind, block.size))
        wanted = {"state": x, "control": u, "matrix": e}[block.kind]
        if own is None:
            if block == gain:
                nodes = mesh.nodes if gain.kind == "state" else control_places(mesh.nodes, mesh.control)
                places = _places(nodes, duration, solution, elapsed)
                wanted[:, block.span] = gain_entries(statement, gain, solution, places)
            continue
        values = sample[block.kind][:, own.span]
        if block.tangent:  # of unit length, which interpolation keeps up to its error
            values = values / np.linalg.norm(values, axis=1, keepdims=True)
        wanted[:, block.span] = values
        jumps = block.kind == "matrix" or (block.kind == "control" and mesh.control == "linear")
        if jumps and mesh.instants:
            wanted[mesh.instants, block.span] = ahead[block.kind][:, own.span]
    if gain is not None and gain.name not in {b.name for b in solution.blocks}:
        e = simulate_matrices(statement, mesh, x, u, starts(statement, mesh, parameters)[1], duration, parameters)
    return Trajectory(x=x, u=u, e=e, duration=duration)


def _check_common(statement: Statement, solution: Solution) -> None:
    """A solution that says nothing about this problem is a mistake, not a guess.

    Raises:
        ProblemError: no state, control or matrix of the same name and size.
    """

    def of(blocks: tuple[Block, ...]) -> set[tuple[str, str, int]]:
        return {(b.kind, b.name, b.size) for b in blocks if b.kind in ("state", "control", "matrix")}

    own, given = of(statement.blocks), of(solution.blocks)
    if not own & given:
        words = [", ".join(f"{kind} {name} ({size})" for kind, name, size in sorted(side)) for side in (own, given)]
        raise ProblemError(
            f"The solution of '{solution.name}' is no guess: it has nothing in common with this problem.",
            expected=f"some of {words[0]}",
            received=words[1],
            remedy="give a solution of a problem with the same names and sizes, or a dict of name to guess",
        )


def _multipliers(multipliers: Multipliers, old: Mesh, new: Mesh) -> Multipliers:
    """Multipliers on another mesh: those at nodes are densities times the weights of the nodes."""
    if np.array_equal(old.nodes, new.nodes) and (old.control, old.points) == (new.control, new.points):
        return multipliers
    before, after = (quadrature_weights(replace(m, control="linear"))[:, None] for m in (old, new))

    def at_nodes(values: Array) -> Array:
        return interpolated(values / before, old.nodes, new.nodes) * after

    controls = resampled(multipliers.controls / quadrature_weights(old)[:, None], old, new)
    return replace(
        multipliers,
        path=at_nodes(multipliers.path_at_nodes),
        states=at_nodes(multipliers.states_at_nodes),
        inside_path=np.zeros((new.intervals, new.points - 1, multipliers.path.shape[1])),
        inside_states=np.zeros((new.intervals, new.points - 1, multipliers.states.shape[1])),
        matrices=at_nodes(multipliers.matrices),
        controls=controls * quadrature_weights(new)[:, None],
    )


def _left(multipliers: Multipliers, mesh: Mesh, duration: float, solution: Solution, elapsed: float) -> Multipliers:
    """Multipliers of what is left of a solution: those at nodes are densities times the weights of the nodes.

    Densities in time keep their values; nothing binds after its end, and where it was met between its nodes.
    """
    old, kept = solution.mesh, duration / solution.duration
    before, after = (quadrature_weights(replace(m, control="linear"))[:, None] for m in (old, mesh))
    inside = (mesh.intervals, mesh.points - 1)

    def moved(values: Array, places: Array, nodes: Array) -> Array:
        wanted = elapsed + nodes * duration
        found = interpolated(values, places, _places(nodes, duration, solution, elapsed))
        return np.asarray(np.where((wanted <= solution.duration)[:, None], found, 0.0)) * kept

    def at_nodes(values: Array) -> Array:
        return moved(values / before, old.nodes, mesh.nodes) * after

    weights = (quadrature_weights(m)[:, None] for m in (old, mesh))
    own, new = (control_places(m.nodes, m.control) for m in (old, mesh))
    return replace(
        multipliers,
        path=at_nodes(multipliers.path_at_nodes),
        states=at_nodes(multipliers.states_at_nodes),
        inside_path=np.zeros((*inside, multipliers.path.shape[1])),
        inside_states=np.zeros((*inside, multipliers.states.shape[1])),
        matrices=at_nodes(multipliers.matrices),
        controls=moved(multipliers.controls / next(weights), own, new) * next(weights),
    )
