"""Solutions of phases in files: those of each phase, and what is said of all together."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from covocp.base.archive import DamagedFileError
from covocp.base.files import check_target
from covocp.base.threads import one_at_a_time
from covocp.solution.phases import PhasesSolution
from covocp.solution.storage import SUFFIXES, checked_tree, from_tree, write

FORMAT = "covocp phases"
VERSION = 1
TEXTS = ("name", "method", "message")


@one_at_a_time
def save(solution: PhasesSolution, path: str | Path) -> Path:
    """Write the solution of phases, converged or not, to a file that is complete or not there.

    Args:
        solution: what to keep.
        path: the file; .npz (compact) or .json (text).

    Returns:
        The path.

    Raises:
        ExportError: unknown suffix, or the file cannot be written.
    """
    check_target(path, SUFFIXES)
    own = {name: getattr(solution, name) for name in (*TEXTS, "converged", "link_residuals")}
    own |= {"violations": dict(solution.violations), "stats": dict(solution.stats)}
    phases = tuple(checked_tree(phase) for phase in solution.phases)
    return write({"format": FORMAT, "version": VERSION, **own, "phases": phases}, path)


def phases_from_tree(tree: Mapping[str, Any]) -> PhasesSolution:
    """The solution that `save` wrote.

    Raises:
        DamagedFileError: an entry is missing or of another type.
    """
    phases, residuals = tree["phases"], tree["link_residuals"]
    fits = isinstance(phases, tuple) and isinstance(residuals, tuple) and len(residuals) == len(phases) - 1
    fits = fits and all(isinstance(value, float) for value in residuals)
    fits = fits and all(isinstance(tree[name], str) for name in TEXTS) and isinstance(tree["converged"], bool)
    violations = tree["violations"]
    fits = fits and isinstance(violations, dict) and all(isinstance(value, float) for value in violations.values())
    if not fits or not isinstance(tree["stats"], dict):
        raise DamagedFileError("its entries are not those of phases")
    return PhasesSolution(
        **{name: tree[name] for name in (*TEXTS, "converged", "link_residuals", "violations", "stats")},
        phases=tuple(from_tree(phase) for phase in phases),
    )
