"""A solution that was read from a file, and the problem that it is said to be of."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import casadi as ca
import numpy as np

from covocp.base.errors import ProblemError, warn_user
from covocp.extremal.extremal import Extremal
from covocp.extremal.given_controls import missed
from covocp.extremal.nodes import rates_along
from covocp.solution.fingerprint import Difference, differences, not_compared, only_switches, unlike_text
from covocp.solution.meaning import SAMPLED
from covocp.solution.origin import Origin
from covocp.solution.solution import Solution
from covocp.statement.statement import Block, Statement

# Relative difference of the stored rates to those of a problem above which it is another problem; well above what
# another version or compiler changes, well below what another number in the dynamics does.
SAME_RATES = 1e-6
# The same of what is read at an instant; well above what a solver leaves of the equations of a program.
SAME_READING = 1e-4
MOVABLE = "initial_"  # what the names of parameters begin with that are initial values
LISTED = 4  # differences that an error lists
PLURAL = tuple(
    f"the {what}"
    for what in ("symbols", "places", "limits", "bounds", "values", "weights", "constraints", "rows", "instants")
)
# Violation relative to the size of an inequality that a solver's own scales may leave in what it calls solved.
ROUGHLY = 1e-5
MOVED = 1e-6  # relative, for that size


def attached(solution: Solution, statement: Statement) -> Solution:
    """The solution with its statement, and what it violates of it.

    Raises:
        ProblemError: it is the solution of another problem (says what differs).
    """
    found, kept = _differences(solution, statement), solution.stored_problem
    written_elsewhere = kept is not None and kept.casadi != ca.CasadiMeta.version()
    if found and not (written_elsewhere and only_switches(found)):
        raise _of_another(solution, statement, found)
    if found or (kept is not None and unlike_text(kept, statement)):
        warn_user(
            f"Whether '{statement.name}' is the problem of the stored solution is known at the points kept in the file "
            "only: there all equations agree, but pieces or tables in them are written otherwise."
        )
    if kept is not None and (unknown := not_compared(kept, statement)):
        warn_user(
            f"Whether '{statement.name}' is the problem of the stored solution is not known as a whole: the file says "
            f"nothing of {', '.join(unknown)}, which were not compared. Save the solution again where they are right."
        )
    return _with_violations(replace(solution, extremal=replace(solution.extremal, stated=statement)))


def _of_another(solution: Solution, statement: Statement, found: list[Difference]) -> ProblemError:
    """The error that names what differs."""
    shown = found[:LISTED]
    more = f" and {len(found) - LISTED} more" if len(found) > LISTED else ""
    names = ", ".join(entry.what for entry in shown)
    plural = len(found) > 1 or names.startswith(PLURAL)
    elsewhere = any(b.kind == "parameter" and b.name.startswith(MOVABLE) for b in solution.blocks)
    own = "what Solver.solve() found from elsewhere is loaded with movable(problem)"
    own += (
        f", of the problem stated with a duration of {solution.duration:.12g} s; " if "the duration" in names else "; "
    )
    own = own if elsewhere and any(entry.what in ("the duration", "the symbols") for entry in found) else ""
    called = f" (stored: '{solution.name}', given: '{statement.name}')" if solution.name != statement.name else ""
    return ProblemError(
        f"The stored solution is of another problem: {names}{more} {'differ' if plural else 'differs'}{called}.",
        expected="as stored: " + "; ".join(f"{entry.what} {entry.stored}" for entry in shown),
        received="as given: " + "; ".join(f"{entry.what} {entry.given}" for entry in shown),
        remedy=f"give the problem that was solved, or load without one; {own}evaluate(problem, nominal=load(path)) "
        "tells what the stored nominal means for another problem",
    )


def _differences(solution: Solution, statement: Statement) -> list[Difference]:
    """What differs; values of functions at the points of the fingerprint."""
    if (solution.blocks, solution.augmented) != (statement.blocks, statement.augmented):
        stored, given = solution.blocks, statement.blocks
        short = [", ".join(f"{b.kind} {b.name} ({b.size})" for b in blocks) for blocks in (stored, given)]
        if short[0] == short[1]:  # then it is what else is known of them, such as the unit
            pairs = [pair for pair in zip(stored, given, strict=True) if pair[0] != pair[1]]
            short = [", ".join(map(_in_full, own)) for own in zip(*pairs, strict=True)] or short
        return [Difference(what="the symbols", stored=short[0], given=short[1])]
    if solution.stored_problem is not None:
        found = differences(solution.stored_problem, statement, solution.parameters)
        if found:
            return found
    return _contradictions(solution, statement)


def _in_full(block: Block) -> str:
    """All that is known of a symbol."""
    marks = ("covariance", "estimation", "backward", "tangent")
    kinds = [block.role, *(mark for mark in marks if getattr(block, mark))]
    return (
        f"{block.kind} {block.name} ({block.size}) in {block.unit or 'no unit'}: {', '.join((*kinds, *block.labels))}"
    )


def _contradictions(solution: Solution, statement: Statement) -> list[Difference]:
    """What the solution itself says otherwise than the problem; all that there is where no fingerprint was kept."""
    names = {"path": statement.path.names, "start": statement.start.names, "end": statement.end.names}
    names["instants"] = statement.inside.names
    for place, kept in {"instants": (), **solution.constraints}.items():
        if kept != names[place]:
            what = f"the constraints ({place})"
            return [Difference(what=what, stored=", ".join(kept) or "none", given=", ".join(names[place]) or "none")]
    for name, stored, given in _instants(solution, statement):
        if stored != given:
            return [Difference(what=f"the instants of '{name}'", stored=_listed(stored), given=_listed(given))]
    if found := _read_otherwise(solution, statement):
        return [found]
    duration = statement.duration
    if not duration.free and not math.isclose(duration.guess, solution.duration) and math.isfinite(solution.duration):
        return [Difference(what="the duration", stored=f"{solution.duration:g} s", given=f"{duration.guess:g} s")]
    targets = statement.boundary_values(solution.parameters)[1]
    for name, old, new in zip(statement.state_names, solution.targets, targets, strict=True):
        if not np.isclose(old, new, rtol=SAME_RATES, atol=0.0, equal_nan=True):
            return [Difference(what=f"the final value of '{name}'", stored=f"{old:g}", given=f"{new:g}")]
    rates, _ = rates_along(replace(solution.extremal, stated=statement))
    scale = np.abs(solution.rates).max(axis=0, initial=0.0)
    error = np.abs(rates - solution.rates) > SAME_RATES * np.maximum(scale, np.finfo(float).tiny)
    if error.any():
        node, entry = np.argwhere(error)[0]
        name = (*statement.state_names, *statement.matrix_names)[entry]
        what = f"the rate of '{name}' at t = {solution.t[node]:g} s"
        return [Difference(what=what, stored=f"{solution.rates[node, entry]:g}", given=f"{rates[node, entry]:g}")]
    return []


def _instants(solution: Solution, statement: Statement) -> Iterator[tuple[str, list[float], list[float]]]:
    """Name of each measurement at instants, and its shares of the duration by the mesh of the file and by a problem."""
    mesh, samples = solution.mesh, statement.samples
    if mesh.readings.shape[-1] != mesh.intervals:
        return  # a file that does not know them
    taken = [sorted({float(s) for s in mesh.nodes[:-1][row > 0]}) for row in mesh.readings]
    names = [] if samples is None else [block.name for block in samples.blocks]
    places = [] if samples is None else [list(own) for own in samples.places]
    for k in range(max(len(taken), len(places))):
        name = names[k] if k < len(names) else f"measurement {k + 1} at instants"
        yield name, taken[k] if k < len(taken) else [], places[k] if k < len(places) else []


def _read_otherwise(solution: Solution, statement: Statement) -> Difference | None:
    """What a measurement at an instant does to the matrices of a file that does not tell it, where a problem differs.

    Of solutions only: the steps of what did not converge need not meet, and other statistics than the design's have
    another update.
    """
    samples, mesh, e, kept = statement.samples, solution.mesh, solution.trajectory.e, solution.stored_problem
    if kept is not None and SAMPLED in kept.aspects:
        return None
    other = solution.origin is Origin.OTHER_TRUTH or not solution.converged or not np.isfinite(e).all()
    if samples is None or not statement.ne or other or mesh.readings.shape[-1] != mesh.intervals:
        return None
    taken = np.flatnonzero(mesh.readings.any(axis=0))
    columns = [np.asarray(c, dtype=float)[:, taken] for c in replace(solution.extremal, stated=statement).columns()]
    after = np.asarray(samples.update.map(taken.size)(*columns, mesh.readings[:, taken])[0].full()).T
    ahead = statement.entries((*statement.ahead, *statement.summed))
    wrong = np.abs(after - e[taken + 1])[:, ahead] > SAME_READING * np.abs(e).max(axis=0)[ahead]
    if not wrong.any():
        return None
    row, entry = np.argwhere(wrong)[0]
    place, entry = int(taken[row]), ahead[entry]
    names = [block.name for block, part in zip(samples.blocks, mesh.readings[:, place], strict=True) if part > 0]
    return Difference(
        what=f"what {', '.join(map(repr, names))} tells at t = {solution.t[place]:g} s",
        stored=f"{statement.matrix_names[entry]} = {e[place + 1, entry]:g} after it",
        given=f"{after[row, entry]:g}",
    )


def _listed(instants: list[float]) -> str:
    more = ", ..." if len(instants) > LISTED else ""
    return f"{len(instants)}: {', '.join(f'{s:.9g}' for s in instants[:LISTED])}{more}" if instants else "none"


def _with_violations(solution: Solution) -> Solution:
    """The solution with the bounds, targets and inequalities among its violations that its own values do not meet."""
    t = solution.trajectory
    if not solution.converged or not all(np.isfinite(part).all() for part in (t.x, t.u, t.e)):
        return solution  # the last iterate of a failed run says so itself
    found = {name: value for name, value in missed(solution.extremal).items() if name not in solution.violations}
    sizes = _sizes(solution.extremal) if found else {}
    fresh = {name: value for name, value in found.items() if value > ROUGHLY * sizes.get(name, 0.0)}
    if not fresh:
        return solution
    listed = ", ".join(f"{name} by {value:.3g}" for name, value in list(fresh.items())[:LISTED])
    warn_user(f"The stored solution of '{solution.name}' violates {listed}, of which the file says nothing.")
    return replace(solution, violations={**solution.violations, **fresh})


def _sizes(extremal: Extremal) -> dict[str, float]:
    """Size of each inequality along a trajectory: what a state or control of its own size makes of it, by name."""
    st = extremal.statement
    columns = [np.asarray(c, dtype=float) for c in extremal.columns()]
    sizes: dict[str, float] = {}
    for place in st.conditions:
        if not place.size:
            continue
        function = place.function.map(columns[0].shape[1])
        total = np.zeros(place.size)
        before = np.asarray(function(*columns).full())
        for argument, row in ((a, r) for a in range(3) for r in range(columns[a].shape[0])):
            moved = [c.copy() if i == argument else c for i, c in enumerate(columns)]
            moved[argument][row] *= 1 + MOVED
            total += np.abs(np.asarray(function(*moved).full()) - before).max(axis=1) / MOVED
        sizes |= dict(zip(place.names, np.nan_to_num(total).tolist(), strict=True))
    return sizes
