"""Solutions of phases in files: those of each phase, and what is said of all together."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from covocp.base.archive import DamagedFileError
from covocp.base.files import check_target
from covocp.base.threads import one_at_a_time
from covocp.solution.known_links import KnownLink, known_link
from covocp.solution.phases import PhasesSolution
from covocp.solution.storage import SUFFIXES, checked_tree, from_tree, plain, record, write

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
    own |= {"phases": tuple(checked_tree(phase) for phase in solution.phases), "links": plain(_known(solution))}
    return write({"format": FORMAT, "version": VERSION, **own}, path)


def _known(solution: PhasesSolution) -> tuple[KnownLink, ...]:
    """What is known of the links: of those that are there, else what the file said that they were read from."""
    if not solution.links:
        return solution.known_links
    pairs = pairwise(solution.phases)
    return tuple(known_link(link, *pair) for link, pair in zip(solution.links, pairs, strict=True))


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
    links = record(tuple[KnownLink, ...], tree.get("links", ()), "links")  # files that were written before have none
    if len(links) not in (0, len(phases) - 1) or not all(_fits(link) for link in links):
        raise DamagedFileError("what passes between its phases contradicts itself")
    return PhasesSolution(
        **{name: tree[name] for name in (*TEXTS, "converged", "link_residuals", "violations", "stats")},
        phases=tuple(from_tree(phase) for phase in phases),
        known_links=links,
    )


def _fits(link: KnownLink) -> bool:
    """Whether there are rows for all points, and columns for all names."""
    arrays = (link.points, link.values, link.operands)
    rows = all(array.ndim == 2 and array.shape[0] == link.points.shape[0] for array in arrays)
    return rows and link.values.shape[1] == len(link.names)
