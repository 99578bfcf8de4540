"""The histories of several phases: a sample of each in its own time, and one of all that finds the phase of a time."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.export.laws.history import History, clock, history, time_status
from covocp.export.laws.law import Law, Port
from covocp.export.laws.trajectory import BEYOND, STATUSES, block_port, named_values, sample_law
from covocp.export.text.names import identifier
from covocp.solution.phases import PhasesSolution
from covocp.statement.statement import Block

ABOUT = (
    "Nominal of all phases at a time since the first one began: the phase that this time is in (where two meet the "
    "later one), the time since it began, and what it has; what only other phases have is NaN. Matrices whose size "
    "differs between phases are left out: the sample of a phase, which takes the time since it began, has them."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Histories:
    """Tables of all phases, their names in C, when they begin [s], and their laws: `sample`, `sample_<phase>`."""

    tables: list[History]
    parts: list[str]
    starts: Array
    laws: tuple[Law, ...]

    __repr__ = short_repr


def histories(solution: PhasesSolution, precision: str, tolerance: float) -> Histories:
    """The tables and laws of all phases.

    Args:
        solution: of the phases.
        precision: "double" or "single".
        tolerance: largest relative deviation.

    Raises:
        ExportError: a value is NaN or infinite.
    """
    tables = [history(phase, precision) for phase in solution]
    taken: set[str] = set()
    parts = [identifier(phase.name, taken, "phase") for phase in solution]
    starts = _starts(solution, precision)
    entries = zip(solution, tables, parts, strict=True)
    each = [sample_law(phase, own, tolerance, part) for phase, own, part in entries]
    whole = _whole(solution, tables, parts, starts, tolerance)
    return Histories(tables=tables, parts=parts, starts=starts, laws=(whole, *each))


def _whole(solution: PhasesSolution, tables: list[History], parts: list[str], starts: Array, tolerance: float) -> Law:
    """The law (time) -> phase, time in it, what it has, status."""
    time, own = ca.MX.sym("time"), ca.MX.sym("own")
    now = clock(time, solution.duration, tables[0].margin)
    number = sum((now.time >= float(start) for start in starts[1:]), ca.MX(0))
    begun = ca.MX(ca.DM(starts))[number]
    shared = _shared(solution)
    functions = []
    for k, (phase, table) in enumerate(zip(solution, tables, strict=True)):
        inside = ca.fmin(ca.fmax(own, 0.0), table.duration)
        values = {block.name: value for block, value in named_values(phase, table.at(inside))}
        rows = [values.get(name, ca.DM(np.full(_rows(block), np.nan))) for name, block in shared.items()]
        functions.append(ca.Function(f"phase_{k}", [own], [inside, *rows]))
    which: Any = ca.Function.conditional("which", functions[:-1], functions[-1])
    inside, *found = which(number, now.time - begun)
    taken = {"time", "phase", "phase_time", "status"}
    listed = ", ".join(f"{k} {phase.name}" for k, phase in enumerate(solution))
    ports = [
        Port(name="time", unit="s", about="of the values: the one asked for, within the range"),
        Port(name="phase", about=f"that this time is in: {listed}", whole=True),
        Port(name="phase_time", unit="s", about="since this phase began"),
        *(block_port(block, taken) for block in shared.values()),
        Port(name="status", about="as returned", whole=True),
    ]
    core = ca.Function("sample", [time], [now.time, number, inside, *found, time_status(now)])
    begins = {f"{part}_START [s]": float(start) for part, start in zip(parts, starts, strict=True)}
    return Law(
        name="sample",
        kind="sample",
        about=(ABOUT,),
        core=core,
        inputs=(Port(name="time", unit="s"),),
        outputs=tuple(ports),
        constants={"DURATION [s]": solution.duration, **begins},
        statuses=STATUSES,
        points=lambda random, count: _times(solution, starts, random, count)[:, None],
        tolerance=tolerance,
    )


def _starts(solution: PhasesSolution, precision: str) -> Array:
    """When the phases begin, rounded as the package has it: both sides of a comparison must choose the same phase."""
    return solution.starts if precision == "double" else solution.starts.astype(np.float32).astype(float)


def _shared(solution: PhasesSolution) -> dict[str, Block]:
    """What changes in some phase, by name, where it has one size in all phases that have it."""
    known: dict[str, list[Block]] = {}
    for phase in solution:
        for block in phase.blocks:
            if block.kind in ("state", "control", "matrix"):
                known.setdefault(block.name, []).append(block)
    return {name: own[0] for name, own in known.items() if len({block.size for block in own}) == 1}


def _rows(block: Block) -> int:
    """Numbers in a flat column."""
    return block.size**2 if block.kind == "matrix" else block.size


def _times(solution: PhasesSolution, starts: Array, random: np.random.Generator, count: int) -> Array:
    """Times for a comparison: both ends, outside, where phases meet and just before, NaN, infinity, random ones."""
    end = solution.duration
    edges = [0.0, end, -0.5 * end, 2.0 * end, np.nan, np.inf, -np.inf, np.nextafter(end, np.inf)]
    edges += [*starts[1:].tolist(), *np.nextafter(starts[1:], 0.0).tolist()]
    rest = random.uniform(-BEYOND * end, (1.0 + BEYOND) * end, max(0, count - len(edges)))
    return np.concatenate([edges, rest])[:count]
