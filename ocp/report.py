"""What print(solution) shows."""

from __future__ import annotations

import io
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.errors import CovocpError
from covocp.matrices import half_indices
from covocp.statement import Block, entry_names

if TYPE_CHECKING:
    from collections.abc import Mapping

    from covocp.solution import Solution

WIDTH = 100
# Matrices up to this size are shown whole, larger ones by their diagonal.
LARGEST_MATRIX = 6
# Multipliers below this share of the cost are not shown.
NEGLIGIBLE = 1e-9
# Relative difference of costs below which two starts count as having found the same optimum.
SAME_OPTIMUM = 1e-5

RESIDUALS = {
    "stationarity": "largest slope of the Lagrangian by a control (relative)",
    "control_slope": "H_u at the nodes, root mean square (relative)",
    "costate_difference": "costates: multipliers against backward integration (relative)",
    "hamiltonian_variation": "variation of the Hamiltonian along the path (relative)",
    "transversality": "condition of the free duration, k_T + H(T) (relative)",
    "mesh_error": "cost: change by halving the integration steps (relative)",
    "control_error": "cost: estimated effect of the piecewise form of the controls (relative)",
    "smallest_eigenvalue": "smallest eigenvalue of the covariances at all nodes",
    "cost_identity": "expected cost: from the covariances against from S(0) (relative)",
    "cross_covariance": "correlation of the estimate and its error, zero in theory",
    "conservation": "variances E + Xhat that no control changes: error (relative)",
    "curvature": "smallest curvature of the reduced Hessian (relative to its largest)",
}


def summary(solution: Solution) -> str:
    """A solution in words and tables of plain text, at most 100 columns wide.

    Args:
        solution: converged or not; the first line says which.

    Returns:
        The text: status, violations, cost by term, values at the end, residuals of optimality, mesh and effort.
    """
    parts = [
        _head(solution),
        _violations(solution.violations),
        _costs(solution),
        _states(solution),
        _unknowns(solution),
        *(_matrix(solution, block) for block in solution.blocks if block.kind == "matrix"),
        _optimality(solution),
        _effort(solution),
    ]
    return "\n\n".join(part for part in parts if part)


def render_table(columns: list[str], rows: list[list[str]], *, words: tuple[int, ...] = (0,)) -> str:
    """A table as plain text.

    Args:
        columns: headings.
        rows: entries, one list a row.
        words: columns that are set left; the others hold numbers and are set right.

    Returns:
        Lines without trailing blanks, at most 100 columns wide; long words are folded.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for i, column in enumerate(columns):
        table.add_column(
            Text(column), justify="left" if i in words else "right", overflow="fold", no_wrap=i not in words
        )
    for row in rows:
        table.add_row(*(Text(entry) for entry in row))
    stream = io.StringIO()
    Console(file=stream, width=WIDTH, color_system=None, force_terminal=False, force_jupyter=False).print(table)
    return "\n".join(line.rstrip() for line in stream.getvalue().rstrip("\n").splitlines())


def number(value: float | None, digits: int = 8) -> str:
    """A number for a table; "-" where there is none."""
    return "-" if value is None or np.isnan(value) else f"{value:.{digits}g}"


def wrapped(text: str, indent: str = "  ") -> str:
    """A paragraph of at most 100 columns, later lines indented."""
    return textwrap.fill(text, WIDTH, subsequent_indent=indent, break_long_words=True)


def _head(solution: Solution) -> str:
    name = solution.name or "problem without a name"
    if solution.converged:
        return wrapped(f"{name}: {solution.message} ({solution.method})")
    return wrapped(f"NOT CONVERGED: {name}: {solution.message} ({solution.method})")


def _violations(violations: Mapping[str, float]) -> str:
    if not violations:
        return ""
    ordered = sorted(violations.items(), key=lambda item: -item[1])
    return render_table(["violated constraint", "by"], [[name, number(value, 4)] for name, value in ordered])


def _costs(solution: Solution) -> str:
    terms = [[name, number(value)] for name, value in solution.cost_terms.items()]
    return render_table(["cost", ""], [*terms, ["total", number(solution.cost)]])


def _states(solution: Solution) -> str:
    """Terminal values with targets, multipliers and standard deviations."""
    blocks = tuple(b for b in solution.blocks if b.kind == "state")
    if not blocks:
        return ""
    target = solution.targets
    bound = ~np.isnan(target)
    columns = [f"state at T = {solution.duration:.8g} s", "value", "target", "multiplier"]
    rows = [
        [name, number(x), number(goal), number(multiplier if fixed else None)]
        for name, x, goal, multiplier, fixed in zip(
            entry_names(blocks), solution.trajectory.x[-1], target, solution.multipliers.final, bound, strict=True
        )
    ]
    if _estimated(solution):
        columns.append("standard deviation")
        deviations = np.concatenate([np.atleast_1d(solution.deviation(b.name)[-1]) for b in blocks])
        rows = [[*row, number(value)] for row, value in zip(rows, deviations, strict=True)]
    return render_table(columns, rows)


def _unknowns(solution: Solution) -> str:
    """Unknown constants: mean, standard deviation at the start and at the end."""
    rows = []
    for b in solution.blocks:
        if b.kind != "unknown":
            continue
        means = np.atleast_1d(solution.values[b.name][0])
        deviations = (
            solution.deviation(b.name).reshape(-1, b.size) if _estimated(solution) else np.full((2, b.size), np.nan)
        )
        entries = zip(entry_names((b,)), means, deviations[0], deviations[-1], strict=True)
        rows += [[name, number(mean), number(first), number(last)] for name, mean, first, last in entries]
    return render_table(["unknown", "mean", "deviation at 0", "deviation at T"], rows) if rows else ""


def _estimated(solution: Solution) -> bool:
    """Whether there is an estimation covariance."""
    return any(b.estimation for b in solution.blocks)


def _matrix(solution: Solution, block: Block) -> str:
    """A matrix at the end: its lower triangle, or its diagonal where it is large; multipliers of fixed entries."""
    final, labels = solution.values[block.name][-1], block.labels
    kind = "covariance" if block.covariance else "matrix"
    if block.size > LARGEST_MATRIX:
        rows = [[label, number(final[i, i])] for i, label in enumerate(labels)]
        text = render_table([f"{kind} {block.name} at T, diagonal", ""], rows)
    elif block.size == 1:
        text = render_table([f"{kind} {block.name} at T", number(final[0, 0])], [])
    else:
        rows = [[label, *(number(v, 6) for v in final[i, : i + 1])] for i, label in enumerate(labels)]
        rows = [row + [""] * (block.size + 1 - len(row)) for row in rows]
        text = render_table([f"{kind} {block.name} at T", *labels], rows)
    multipliers = solution.multipliers.final_matrices[block.span]
    pairs = zip(*half_indices(block.size), multipliers, strict=True)
    fixed = [
        [f"{block.name}[{labels[min(i, j)]}, {labels[max(i, j)]}]", number(value)]
        for i, j, value in pairs
        if abs(value) > NEGLIGIBLE * abs(solution.cost) and not block.backward  # bounds at the end leave tiny ones
    ]
    return text + ("\n" + render_table(["fixed at T", "multiplier"], fixed) if fixed else "")


def _optimality(solution: Solution) -> str:
    """The residuals of the necessary conditions in words."""
    try:
        values = solution.optimality.as_dict()
    except (CovocpError, RuntimeError, ArithmeticError, ValueError) as error:
        return wrapped(f"necessary conditions: not evaluated ({str(error).splitlines()[0][:100]})")
    rows = []
    for name, value in values.items():
        if value is None or (name == "smallest_eigenvalue" and np.isinf(value)):
            continue
        rows.append(
            [
                RESIDUALS.get(name, name.replace("_", " ")),
                "-" if np.isnan(value) else f"{value:.2e}",
                _verdict(solution, name, value),
            ]
        )
    return render_table(["necessary conditions", "", ""], rows, words=(0, 2))


def _verdict(solution: Solution, name: str, value: float) -> str:
    """What a sign means; residuals speak for themselves."""
    if name == "smallest_eigenvalue":
        return "semidefinite" if solution.semidefinite else "INDEFINITE"
    if name == "curvature" and solution.converged:
        return "minimum" if value > 0 else "NOT A MINIMUM"
    return ""


def _effort(solution: Solution) -> str:
    """Mesh, iterations and time, a sentence."""
    mesh, stats = solution.mesh, solution.stats
    words = [
        f"{mesh.intervals} intervals",
        f"controls piecewise {mesh.control}",
        f"{mesh.substeps} integration step{'s' if mesh.substeps > 1 else ''} an interval",
        f"{len(mesh.segments)} shooting segment{'s' if len(mesh.segments) > 1 else ''}",
    ]
    if any(b.kind == "matrix" for b in solution.blocks):
        words.append(f"matrices {'eliminated' if mesh.eliminated else 'as states'}, step '{mesh.step}'")
    effort = [f"{stats['iterations']} iterations"] if stats.get("iterations", -1) >= 0 else []
    if (seconds := solution_seconds(stats)) is not None:
        effort.append(f"{seconds:.3g} s")
    if stats.get("left_saddle"):
        effort.append("started again from a saddle")
    if "starts" in stats:
        effort.append(_starts(np.asarray(stats["starts"], dtype=float)))
    if stats.get("classical_cost"):
        gain = 1.0 - solution.cost / stats["classical_cost"]
        effort.append(f"the classical design costs {stats['classical_cost']:.8g}: {100 * gain:.3g} % are gained")
    lines = [wrapped("mesh: " + ", ".join(words))]
    return "\n".join(lines + ([wrapped("effort: " + ", ".join(effort))] if effort else []))


def _starts(costs: Any) -> str:
    """What the starts of a multistart found."""
    found = np.sort(costs[np.isfinite(costs)])
    text = f"best of {costs.size} starts"
    if found.size > 1:
        gaps = np.diff(found) > SAME_OPTIMUM * np.maximum(np.abs(found[1:]), np.abs(found[:-1]))
        optima = 1 + int(gaps.sum())
        if optima > 1:
            text += f", which found {optima} local optima with costs from {found[0]:.6g} to {found[-1]:.6g}"
    if found.size < costs.size:
        text += f"; {costs.size - found.size} did not converge"
    return text


def solution_seconds(stats: Mapping[str, Any]) -> float | None:
    """Time that a method reports, all its parts together; None where it reports none."""
    parts = [float(value) for name, value in stats.items() if name.endswith("seconds")]
    return sum(parts) if parts else None
