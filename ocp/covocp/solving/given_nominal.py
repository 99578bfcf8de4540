"""The control that `evaluate` is given: on which mesh it is what it is, and the run along it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import as_number, column
from covocp.base.errors import ProblemError, no_option, spelling
from covocp.base.expressions import Given
from covocp.base.matrices import Array, distinct, near
from covocp.base.quadrature import interpolated
from covocp.extremal.dense_output import between_nodes
from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.given_controls import (
    DRIFTED,
    drift,
    each_interval,
    evaluate_controls,
    evaluation_mesh,
    with_costates,
)
from covocp.extremal.mesh_error import UNSTABLE
from covocp.solution.solution import Solution
from covocp.solving.gain_start import free_gain_block, gain_entries
from covocp.statement.names import name_of
from covocp.statement.statement import Block, Statement
from covocp.transcription.first_guess import check_model, controls_guess, evaluate_guess, starts
from covocp.transcription.grading import graded
from covocp.transcription.mesh import INTERVALS, Graded, Mesh, Options, control_places
from covocp.transcription.shooting import interval_columns
from covocp.transcription.steps import nominal_interval

# Share of a control by which it may differ before and after a node and not jump.
ROUNDING = 1e-12
# Relative difference of two values of a decision that are one.
SAME_VALUE = 1e-9
# Miss of the states of a solution by its own steps, all together and relative, with which they are those of a system.
SAME_PATH = 1e-5
HELD = (
    "evaluated along a given nominal, held at its nodes: the plant is too unstable for one run along the controls to "
    "stay there"
)
# Arguments of `evaluate` beside the options of the mesh.
ARGUMENTS = ("nominal", "truth", "intervals", "parameters")


def first_options(nominal: Given, intervals: Given, options: dict[str, Any]) -> Options:
    """The mesh that is asked for; of a nominal that is a solution what is not asked for: its nodes, held or linear."""
    known = _known(options)
    if isinstance(nominal, Solution):
        known = {"control": nominal.mesh.control, **known}
        if intervals is None and not _loses(nominal, known["control"]):
            known = {"grid": distinct(nominal.mesh.nodes), **known}
    return Options(intervals=INTERVALS if intervals is None else intervals, **known)


def options_along(statement: Statement, nominal: Given, options: Options, parameters: Array) -> Options:
    """The options with the graded mesh, to which the nodes of a nominal that is a solution are added.

    Its control bends there, and where it jumps there are two: between other nodes it would be another control. Held, a
    linear one is another in any case.

    Args:
        statement: the problem.
        nominal: as `evaluate` takes it.
        options: of the mesh.
        parameters: of the statement.
    """
    given = graded(statement, options, parameters)
    if not isinstance(nominal, Solution):
        return given
    nodes = _with_its_nodes(given.nodes(), nominal, given.control == "linear")
    if nodes.size == given.nodes().size:
        return given
    if isinstance(given.grid, Graded):
        return replace(given, grid=replace(given.grid, nodes=nodes))
    asked = options.intervals if options.grid is None else given.nodes().size - 1
    return replace(given, grid=Graded(nodes=nodes, asked=asked))


def _loses(nominal: Solution, control: str) -> bool:
    """Whether controls of this form cannot be those of a solution: held ones, where these are linear."""
    return control == "constant" and nominal.mesh.control == "linear"


def _with_its_nodes(nodes: Array, nominal: Solution, linear: bool) -> Array:
    """Some nodes and those of a solution, for a linear control twice where it jumps."""
    there = distinct(nominal.mesh.nodes)
    together = np.sort(np.concatenate([nodes, there[~near(there, distinct(nodes))]]))
    if not linear:
        return together
    inside = there[1:-1]
    before, after = (nominal.extremal.controls_at(inside, before=side) for side in (True, False))
    least = ROUNDING * np.abs(nominal.trajectory.u).max(axis=0, initial=0.0)
    jumps = inside[(np.abs(after - before) > least).any(axis=1)]
    places = distinct(together)
    once = [place for place in places[near(places, jumps)] if np.sum(together == place) == 1]
    return np.sort(np.concatenate([together, once]))


def run_along(
    statement: Statement, nominal: Given, options: Options, parameters: Array, linked: Mapping[int, float] | None = None
) -> Outcome:
    """One run along a nominal.

    Args:
        statement: the problem.
        nominal: as `evaluate` takes it.
        options: of the mesh, graded.
        parameters: of the statement.
        linked: entries of the initial state that a phase before gives.
    """
    mesh = evaluation_mesh(statement, options, parameters)
    u, duration = _controls(statement, mesh, nominal, options.grading.get("intervals_asked", 0))
    x0, e0 = starts(statement, mesh, parameters)
    given = _started_like(statement, nominal, x0, parameters, linked or {})
    x0, e0 = statement.started(given, parameters, e0)
    check_model(statement, x0, u[:1].ravel(), e0, duration, parameters)
    run = evaluate_controls(statement, mesh, u, duration, parameters, x0)
    states = _left(statement, nominal, run, parameters) if isinstance(nominal, Solution) else None
    if states is None:
        return run
    held = evaluate_controls(statement, each_interval(mesh), u, duration, parameters, x0, states)
    if not held.converged:
        return run
    costates = interpolated(nominal.costates.state, nominal.mesh.nodes, mesh.nodes)
    return replace(with_costates(held, costates), message=HELD)


def _left(statement: Statement, nominal: Solution, run: Outcome, parameters: Array) -> Array | None:
    """The states of a solution at the nodes of a run along its controls, (N + 1, nx), where that left them.

    None where it stayed, where the plant amplifies nothing (other steps leave it too), and where they are not those of
    this system from there: what is controlled so is another one.
    """
    own, t = nominal.extremal, run.extremal.trajectory
    alike = _plain(nominal.blocks) == _plain(statement.blocks) and own.mesh.readings.shape[0] == statement.readings
    if not alike or statement.coupled or nominal.statement is None or t.duration != own.trajectory.duration:
        return None
    dense = nominal.stored_dense or between_nodes(own)
    states = dense.at(own.mesh.placed(run.extremal.mesh.nodes))[:, : statement.nx]
    moved = drift(states, run.extremal)
    if moved <= DRIFTED:
        return None
    suffered = float(_defects(statement, run.extremal, states, parameters).sum())
    if moved <= UNSTABLE * suffered or not is_path(statement, own, t.x[0], parameters):
        return None
    return states


def _plain(blocks: tuple[Block, ...]) -> list[tuple[str, str, int]]:
    """Kinds, names and sizes of states and controls."""
    return [(b.kind, b.name, b.size) for b in blocks if b.kind in ("state", "control")]


def _defects(statement: Statement, along: Extremal, x: Array, parameters: Array, sizes: Array | None = None) -> Array:
    """By how much each interval of a mesh leaves states at its nodes, in their sizes or magnitudes there, (N,)."""
    mesh, t = along.mesh, along.trajectory
    sizes = np.maximum(np.abs(x).max(axis=0) if sizes is None else sizes, np.finfo(float).tiny)
    advance = nominal_interval(statement, mesh.substeps, mesh.step).map(mesh.intervals)
    intervals = interval_columns(mesh, ca.DM(t.u.T), t.duration, ca.DM(parameters))
    ends = np.asarray(advance(x[:-1].T, *intervals)[0].full()).T
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray((np.abs(ends - x[1:]) / sizes).max(axis=1))


def is_path(statement: Statement, own: Extremal, start: Array, parameters: Array, sizes: Array | None = None) -> bool:
    """Whether a trajectory is by its own steps one of a system from a start, that its intervals do not leave.

    Args:
        statement: the system.
        own: the trajectory.
        start: where it is to begin, (nx,).
        parameters: of the system.
        sizes: of the states, (nx,); None: their magnitudes along the trajectory.
    """
    x = own.trajectory.x
    sizes = np.maximum(np.abs(x).max(axis=0) if sizes is None else sizes, np.finfo(float).tiny)
    apart = (np.abs(start - x[0]) / sizes).max(initial=0.0)
    return bool(apart + _defects(statement, own, x, parameters, sizes).sum() <= SAME_PATH)


def _started_like(
    statement: Statement, nominal: Given, x0: Array, parameters: Array, linked: Mapping[int, float]
) -> Array:
    """The initial state, with the decisions of the nominal and, of a solution, what else is free there.

    Raises:
        ProblemError: the nominal does not give a decision: a guess is no choice; or another one than a phase before.
    """
    result = x0.copy()
    decisions = [block for block in statement.states if block.role == "decision"]
    if isinstance(nominal, Solution):
        _take_free(statement, nominal, result, parameters, linked)
        decisions = [block for block in decisions if block.name in {own.name for own in nominal.blocks}]
    elif nominal is not None:
        given, gain = _by_name(statement, nominal), free_gain_block(statement)
        for block in decisions:
            if block.name in given:
                result[block.span] = column(block.name, "value", given[block.name], block.size)
            elif block != gain and block.span.start not in linked:  # Gain(guess=) says what it is
                raise _not_given("decision", block.name, ", ".join(given) or "nothing")
        decisions = [block for block in decisions if block.name in given]
    for block in decisions if nominal is not None else ():
        _check_goes_on(block.name, result, block.span, linked)
    result[list(linked)] = list(linked.values())
    return result


def _take_free(
    statement: Statement, nominal: Solution, x: Array, parameters: Array, linked: Mapping[int, float]
) -> None:
    """Put what is free in an initial state as a solution has it.

    Raises:
        ProblemError: the solution has no value of a decision.
    """
    known = statement.boundary_values(parameters)[0]
    gain = free_gain_block(statement)
    own = {block.name: block for block in nominal.blocks if block.kind == "state"}
    for block in statement.states:
        if block.name in own and own[block.name].size == block.size:
            first = nominal.trajectory.x[0, own[block.name].span]
            x[block.span] = np.where(np.isnan(known[block.span]), first, x[block.span])
        elif block == gain and nominal.loop is not None:
            x[block.span] = gain_entries(statement, block, nominal, nominal.t / nominal.duration)[0]
        elif block.role == "decision" and block.span.start not in linked:
            raise _not_given("decision", block.name, f"a solution of '{nominal.name}' without it")


def _check_goes_on(name: str, values: Array, span: slice, linked: Mapping[int, float]) -> None:
    """A decision that a phase before has is the same constant.

    Raises:
        ProblemError: the nominal has another value of it.
    """
    for entry in range(span.start, span.stop):
        before = linked.get(entry, values[entry])
        if abs(values[entry] - before) > SAME_VALUE * abs(before):
            raise ProblemError(
                f"The nominal gives the decision '{name}' two values.",
                expected="one value in all phases that have it",
                received=f"{before:g} and {values[entry]:g}",
                remedy=f"give '{name}' in the first phase that has it, and leave it out in the others",
            )


def _by_name(statement: Statement, nominal: Mapping[Any, Any]) -> dict[str, Any]:
    """What a dict gives of controls and decisions, by name.

    Raises:
        ProblemError: the problem has none of that name.
    """
    decisions = tuple(block.name for block in statement.states if block.role == "decision")
    names = (*(block.name for block in statement.controls), *decisions)
    result: dict[str, Any] = {}
    for key, value in nominal.items():
        name = name_of(key, statement.symbols, names, missing_ok=True)
        if not name:
            kinds = "control or decision" if decisions else "control"
            named = f"'{statement.name}'" if statement.name else "the problem"
            raise ProblemError(
                f"The nominal gives '{key}'"[:100] + f", and {named} has no {kinds} of that name.",
                expected=f"a symbol or name of {', '.join(names)}" if names else f"nothing: it has no {kinds}",
                received=repr(key)[:100],
                remedy=spelling(key, names, "correct or remove it"),
            )
        result[name] = value
    return result


def _known(options: dict[str, Any]) -> dict[str, Any]:
    """Options of the mesh; others mean nothing here."""
    known = {field.name for field in fields(Options)} - {
        "intervals",
        "points",
        "refine",
    }  # nothing is imposed or solved here
    for name in options:
        if name not in known:
            raise no_option("evaluate()", name, options[name], {*known, *ARGUMENTS})
    return options


def _controls(statement: Statement, mesh: Mesh, nominal: Given, asked: int) -> tuple[Array, float]:
    """Control values on a mesh, and the terminal time, as given; `asked`: intervals before grading, or 0."""
    nodes, duration = mesh.nodes, statement.duration.guess
    at = control_places(nodes, mesh.control)
    if nominal is None:
        return controls_guess(statement, nodes, mesh.control, sign=0.0), duration
    if isinstance(nominal, Solution):
        duration = nominal.duration if statement.duration.free else duration
        sampled, columns = _sampled(nominal, mesh), []
        for block in statement.controls:
            if block.name not in {b.name for b in nominal.blocks if b.kind == "control"}:
                if block == free_gain_block(statement) and nominal.loop is not None:
                    columns.append(gain_entries(statement, block, nominal, at))
                    continue
                raise _not_given("control", block.name, f"a solution of '{nominal.name}' without it")
            columns.append(sampled[:, nominal.block(block.name).span])
        return np.concatenate([np.zeros((at.size, 0)), *columns], axis=1), duration
    if not isinstance(nominal, Mapping):
        raise ProblemError(
            "The nominal is of an unknown kind.",
            expected="a Solution, or a dict of control to number, array over the nodes or function of s = t/T",
            received=repr(nominal)[:100],
            remedy="correct nominal=",
        )
    given = _by_name(statement, nominal)
    columns = []
    for block in statement.controls:
        if block.name not in given:
            raise _not_given("control", block.name, ", ".join(given) or "nothing")
        value = given[block.name]
        value = value if callable(value) else as_number(block.name, "guess", value)
        if mesh.control == "constant" and np.ndim(value) and np.shape(value) != (block.size,):
            value = _held(value, at, asked)
        columns.append(evaluate_guess(block, value, at))
    return np.concatenate([np.zeros((at.size, 0)), *columns], axis=1), duration


def _held(value: Array, at: Array, asked: int) -> Array:
    """An array with a row for each interval or each node as one for each interval: held from its node to the next.

    Args:
        value: the array; one of another length is returned as it is.
        at: places of the held values, one for each interval of the mesh.
        asked: intervals that the mesh was asked to have, of which rows may be meant too; or 0.
    """
    if value.shape[0] == at.size + 1:
        return value[:-1]
    if asked and value.shape[0] != at.size and value.shape[0] in (asked, asked + 1):
        return np.asarray(value[(at * asked).astype(int)])
    return value


def _sampled(nominal: Solution, mesh: Mesh) -> Array:
    """Controls of a solution at the places of those of a mesh, (nodes, controls of the solution)."""
    if nominal.mesh.control == mesh.control and np.array_equal(nominal.mesh.nodes, mesh.nodes):
        return nominal.trajectory.u
    at = nominal.mesh.placed(control_places(mesh.nodes, mesh.control))
    u = nominal.extremal.controls_at(at)
    if mesh.control == "linear":  # what comes before a jump, and before the end
        ahead = [*mesh.instants, at.size - 1]
        u[ahead] = nominal.extremal.controls_at(at[ahead], before=True)
    return u


def _not_given(kind: str, name: str, received: str) -> ProblemError:
    return ProblemError(
        f"The nominal does not give the {kind} '{name}'.",
        expected="a history of every control" if kind == "control" else "a value of every decision",
        received=received,
        remedy=f"add '{name}' to nominal=" if "solution" not in received else f"give a dict with '{name}' as nominal=",
    )
