"""What print(solution) shows, and a notebook."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.expressions import Given
from covocp.base.matrices import Array, distinct, half_indices, near, standard_deviations
from covocp.base.pages import Part, Section, Sentence, Table, as_text, number
from covocp.blocks.rotation_chart import rotation_vectors
from covocp.extremal.path_limits import NOTED
from covocp.solution.chances import chance_section
from covocp.solution.instants import instant_section
from covocp.solution.origin import Classical, Origin
from covocp.solution.residual_section import residual_section
from covocp.statement.entries import entry_names, error_names
from covocp.statement.statement import Block, Role, Statement

if TYPE_CHECKING:
    from collections.abc import Mapping

    from covocp.solution.solution import Solution
    from covocp.transcription.mesh import Mesh

# Matrices up to this size are shown whole, larger ones by their diagonal.
LARGEST_MATRIX = 6
# Feedback gains of more entries than this are not shown.
MOST_GAINS = 12
# Share of the largest feedback, or of the largest gain, that counts as none.
NO_FEEDBACK = 1e-6
# Relative gains below this are none, whatever the mesh.
NO_GAIN = 1e-7
# Name of the gain of a constrained feedback, and of what the deviations add to an expected cost.
GAIN, DEVIATIONS, PLACES = "C", "deviations", ("at the end", "on the way")
# Name of the count that says why a gain is free.
ASKED = "gain_asked"
# Name of the count that says by what other options a run was made again, where it did not find its way as asked.
OTHERWISE = "other_ways"
# Name of the count that says from where a run began in the end, where a solution that was given as a guess led nowhere.
OTHER_START = "other_start"
# Multipliers below this share of the cost are not shown.
NEGLIGIBLE = 1e-6
# Relative difference of costs below which two starts count as having found the same optimum.
SAME_OPTIMUM = 1e-5


def summary(solution: Solution) -> str:
    """A solution in words and tables of plain text, at most 100 columns wide: its `sections`."""
    return as_text(sections(solution))


def sections(solution: Solution) -> list[Section]:
    """A solution in sentences and tables.

    Args:
        solution: converged or not; the first sentence says which.

    Returns:
        Status, violations, cost by term, values at the end, what the closed loop does, residuals of optimality, mesh
        and effort.
    """
    closed = solution.loop is not None

    def shown(block: Block) -> bool:  # the covariances of a closed loop are in its tables
        return block.role == "moving" and not (closed and (block.estimation or block.backward))

    return [
        _head(solution),
        _violations(solution.violations),
        chance_section(solution.chances),
        _costs(solution),
        _numbers(solution, "decision"),
        _states(solution),
        instant_section(solution),
        _numbers(solution, "integral"),
        _unknowns(solution),
        _deviations(solution),
        _feedback(solution),
        _gains(solution),
        *(_matrix(solution, block) for block in solution.blocks if block.kind == "matrix" and shown(block)),
        residual_section(solution),
        _between_nodes(solution),
        without_problem(solution) if solution.within is None else [],
        _effort(solution),
    ]


def _head(solution: Solution) -> Section:
    text = f"{solution.name or 'problem without a name'}: {solution.message} ({solution.method})"
    return [Sentence(text if solution.converged else f"NOT CONVERGED: {text}", warning=not solution.converged)]


def _violations(violations: Mapping[str, float]) -> Section:
    rows = [[name, number(value, 4)] for name, value in stated_first(violations)]
    return _table(["violated constraint", "by"], rows)


def stated_first(violations: Mapping[str, float]) -> list[tuple[str, float]]:
    """Violations by size: first what the user stated, then the gaps of an iterate that could not be brought to it."""

    def order(entry: tuple[str, float]) -> tuple[bool, float]:
        return entry[0].rpartition(": ")[2].startswith("continuity of "), -entry[1]

    return sorted(violations.items(), key=order)


def _table(columns: list[str], rows: list[list[str]]) -> Section:
    """A section of one table; an empty one where there are no rows."""
    return [Table(columns=columns, rows=rows)] if rows else []


def _costs(solution: Solution) -> Section:
    terms = [[name, number(value)] for name, value in solution.cost_terms.items()]
    parts: list[Part] = [Table(columns=["cost", ""], rows=[*terms, ["total", number(solution.cost)]])]
    if solution.loop is not None and DEVIATIONS in solution.cost_terms:
        ended, on_the_way = (number(solution.loop.cost[f"{DEVIATIONS} {where}"], 6) for where in PLACES)
        parts.append(Sentence(f"deviations: {ended} at the end, {on_the_way} on the way"))
        parts += _left_out(solution)
    if solution.optimised:
        parts += _gained(solution)
    missing = Classical.beside(solution.stats).missing
    if missing:
        parts.append(Sentence(f"There is no classical design to compare with: {missing}", ""))
    return parts


def _left_out(solution: Solution) -> Section:
    """What the linear equations along the nominal do not have: curved rates and measurements, noise that grows."""
    effect = solution.mean_effect
    if effect is None:
        return []
    parts: list[Part] = []
    least = NEGLIGIBLE * abs(solution.cost)
    if abs(effect.cost) > least:
        names = [n for b in solution.blocks if b.kind == "state" and b.role == "moving" for n in error_names((b,))]
        spread = standard_deviations(solution.loop.X)[-1] if solution.loop is not None else np.zeros(0)
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = np.nan_to_num(np.abs(effect.mean[-1]) / spread)[: len(names)]
        worst = int(np.argmax(moved))
        text = f"rates and measurements bend, which adds {_added(effect.cost, solution)} through the mean of the "
        text += f"deviations; at the end that of {names[worst]} is {effect.mean[-1, worst]:+.2g}, "
        parts.append(Sentence(f"not in the cost: {text}{moved[worst]:.2g} of its root mean square"))
    if abs(effect.noise_cost) > least:
        text = f"noise that varies with state and control adds {_added(effect.noise_cost, solution)} by the deviations"
        parts.append(Sentence(f"not in the cost: {text}"))
    return parts


def _added(cost: float, solution: Solution) -> str:
    """What is added to the cost, and its share of it."""
    return f"{cost:+.2g}" + (f" ({100 * abs(cost / solution.cost):.2g} %)" if solution.cost else "")


def _gained(solution: Solution) -> Section:
    """What the combined design gains over the classical one, and whether the mesh can tell."""
    classical = Classical.beside(solution.stats)
    if not classical.cost:
        return []
    text = f"classical design: {number(classical.cost)}"
    if classical.same:
        return [Sentence(f"{text}, the same to roundoff")]
    gain = 1.0 - solution.cost / classical.cost
    text += f", of which {100 * gain:.3g} % are gained"
    if NO_GAIN < abs(gain) < solution.mesh_error:
        text += f": less than the error of the mesh, {100 * solution.mesh_error:.2g} %; more intervals can tell"
    return [Sentence(text)]


def _states(solution: Solution) -> Section:
    """Terminal values with targets, multipliers and, where nothing is fed back, standard deviations."""
    blocks = tuple(b for b in solution.blocks if b.kind == "state" and b.role == "moving")
    if not blocks:
        return []
    target = solution.targets
    bound = ~np.isnan(target) if solution.optimised else np.zeros(target.size, dtype=bool)
    columns = [f"state at T = {solution.duration:.8g} s", "value", "target", "multiplier"]
    deviations = solution.loop is None and _estimated(solution)
    if deviations:
        columns.append("standard deviation")
    rows = []
    for b in blocks:
        own = _attitude(solution, b) if b.tangent else []
        for k in range(0 if b.tangent else b.size):
            i = b.offset + k
            multiplier = number(solution.final_multipliers[0][i] if bound[i] else None)
            own.append([entry_names((b,))[k], number(solution.trajectory.x[-1, i]), number(target[i]), multiplier])
        if deviations:
            unit = np.rad2deg(1.0) if b.tangent else 1.0
            spread = [number(v) for v in unit * np.atleast_1d(solution.deviation(b.name)[-1])]
            own = [[*row, *cell] for row, cell in zip(own, [[v] for v in spread] + [["-"]], strict=False)]
        rows += own
    return _table(columns, rows)


def _attitude(solution: Solution, block: Block) -> list[list[str]]:
    """An attitude at the end as rotation vector and angle; what it has to reach is among the constraints."""
    vector = np.rad2deg(rotation_vectors(solution.values[block.name])[-1])
    named = zip([*(f"about {axis}" for axis in "xyz"), "angle"], [*vector, np.linalg.norm(vector)], strict=True)
    return [[f"{block.name}, {name} [deg]", number(float(value)), "-", "-"] for name, value in named]


def _numbers(solution: Solution, role: Role) -> Section:
    """Decisions, or integrals, with their units; a constant gain has its own table."""
    rows = []
    for b in solution.blocks:
        if b.role == role and not (solution.loop is not None and b.name == GAIN):
            values = np.atleast_1d(solution[b.name])
            rows += [[name, number(v), b.unit] for name, v in zip(entry_names((b,)), values, strict=True)]
    return _table([role, "value", "unit"], rows)


def _unknowns(solution: Solution) -> Section:
    """Unknown constants: mean, standard deviation of their estimate at the start and at the end."""
    rows = []
    for b in solution.blocks:
        if b.kind != "unknown":
            continue
        means = np.atleast_1d(solution.values[b.name][0])
        deviations = np.full((2, b.size), np.nan)
        if solution.loop is not None:
            deviations = standard_deviations(solution.loop.E)[:, _rows(solution, b.name)]
        elif _estimated(solution):
            deviations = solution.deviation(b.name).reshape(-1, b.size)
        entries = zip(entry_names((b,)), means, deviations[0], deviations[-1], strict=True)
        rows += [[name, number(mean), number(first), number(last)] for name, mean, first, last in entries]
    return _table(["unknown", "mean", "deviation at 0", "deviation at T"], rows)


def _rows(solution: Solution, name: str) -> list[int]:
    """Rows of the augmented state that belong to a symbol."""
    return [i for i, label in enumerate(solution.augmented) if label.split("[")[0] == name]


def _deviations(solution: Solution) -> Section:
    """What the actual states of a closed loop do at the end, and how much of it the filter does not know."""
    loop = solution.loop
    if loop is None:
        return []
    total, error = standard_deviations(loop.X), standard_deviations(loop.E)
    states = [i for b in solution.blocks if b.kind == "state" for i in _rows(solution, b.name)]
    rows = [
        [
            solution.augmented[i],
            number(total[0, i], 6),
            number(total[-1, i]),
            number(error[-1, i]),
            f"{100 * (error[-1, i] / total[-1, i]) ** 2:.3g} %" if total[-1, i] > 0 else "-",
        ]
        for i in states
    ]
    columns = ["closed loop, root mean squares", "at 0", "at T", "error of the estimate", "of the variance"]
    return _table(columns, rows)


def _feedback(solution: Solution) -> Section:
    """What the feedback asks of the controls, and how far the nominal stays from their bounds in units of it."""
    loop = solution.loop
    if loop is None or not loop.gain.shape[1]:
        return []
    if not loop.Xhat.any():
        reason = (
            "nothing is measured" if solution.filter_gain is None else "what is measured tells nothing of the state"
        )
        return [Sentence(f"{reason}, so nothing is fed back: the actual control is the nominal one", "")]
    spread = np.sqrt(np.maximum(np.einsum("kui,kij,kuj->ku", loop.gain, loop.Xhat, loop.gain), 0.0))
    names = entry_names(tuple(b for b in solution.blocks if b.kind == "control" and b.name != GAIN))
    room = _room(solution, spread)
    rows = []
    for i, name in enumerate(names):
        k = int(np.argmax(spread[:, i]))
        rows.append([name, number(spread[k, i], 6), number(solution.t[k], 4), number(spread[-1, i], 6)])
        rows[-1] += [] if room is None else [number(room[i], 3)]
    columns = ["feedback, root mean squares", "largest", "at t [s]", "at T"]
    return _table(columns + ([] if room is None else ["nearest bound, in rms"]), rows)


def _room(solution: Solution, spread: Array) -> Array | None:
    """Least distance of each control from its bounds, in root mean squares of its feedback; None without bounds."""
    if solution.statement is None:
        return None
    count = spread.shape[1]
    lower, upper = (bound[:count] for bound in solution.statement.control_bounds)
    if not np.isfinite([lower, upper]).any():
        return None
    u = solution.controls[:, :count]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.minimum(u - lower, upper - u) / spread
    ratio[spread <= NO_FEEDBACK * spread.max(axis=0)] = np.inf
    least = ratio.min(axis=0)
    return np.where(np.isfinite(least), np.maximum(least, 0.0), np.nan)


def _gains(solution: Solution) -> Section:
    """A few numbers of each entry of the feedback gain; nothing where there are many."""
    if solution.loop is None or not solution.loop.Xhat.any():  # the estimate stays zero, whatever the gain
        return []
    gain = solution.loop.gain
    controls = entry_names(tuple(b for b in solution.blocks if b.kind == "control" and b.name != GAIN))
    entries = [(u, i) for u in range(gain.shape[1]) for i in range(gain.shape[2])]
    if not entries or len(entries) > MOST_GAINS:
        return _asked(solution)
    middle = int(np.argmin(np.abs(solution.mesh.nodes - 0.5)))
    rows = []
    for u, i in entries:
        history = gain[:, u, i]
        k = int(np.argmax(np.abs(history)))
        chosen = [number(history[j], 5) for j in (0, middle, -1, k)]
        rows.append([f"{controls[u]}, {solution.augmented[i]}", *chosen, number(solution.t[k], 4)])
    if np.ptp(gain, axis=0).max() <= NO_FEEDBACK * np.abs(gain).max():
        return [*_asked(solution), *_table(["gain C, constant", ""], [row[:2] for row in rows])]
    return [*_asked(solution), *_table(["gain C", "at 0", "at T/2", "at T", "largest", "at t [s]"], rows)]


def _asked(solution: Solution) -> Section:
    """Why the gain is not the best one of a Riccati equation, where the covariance of the loop is the reason."""
    asked = solution.stats.get(ASKED, "")
    return [Sentence(f"the gain is free, its entries are controls: X is in {asked}", "")] if asked else []


def _estimated(solution: Solution) -> bool:
    """Whether there is an estimation covariance."""
    return any(b.estimation for b in solution.blocks)


def _matrix(solution: Solution, block: Block) -> Section:
    """A matrix at the end: its lower triangle, or its diagonal where it is large; multipliers of fixed entries."""
    final, labels = solution.values[block.name][-1], block.labels
    kind = "covariance" if block.covariance else "matrix"
    if block.size > LARGEST_MATRIX:
        rows = [[label, number(final[i, i])] for i, label in enumerate(labels)]
        columns = [f"{kind} {block.name} at T, diagonal", ""]
    elif block.size == 1:
        columns, rows = [f"{kind} {block.name} at T", number(final[0, 0])], []
    else:
        rows = [[label, *(number(v, 6) for v in final[i, : i + 1])] for i, label in enumerate(labels)]
        rows = [row + [""] * (block.size + 1 - len(row)) for row in rows]
        columns = [f"{kind} {block.name} at T", *labels]
    multipliers = solution.final_multipliers[1][block.span]
    given = np.ones(multipliers.size, dtype=bool)  # a file without its problem does not tell which entries are fixed
    if solution.statement is not None:
        given = ~np.isnan(solution.statement.boundary_values(solution.parameters).final_matrices[block.span])
    pairs = zip(*half_indices(block.size), multipliers, given, strict=True)
    fixed = [
        [f"{block.name}[{labels[min(i, j)]}, {labels[max(i, j)]}]", number(value)]
        for i, j, value, known in pairs
        if known and not block.backward and abs(value) > NEGLIGIBLE * abs(solution.cost)
    ]
    heading = "at T" if solution.statement is None else "fixed at T"
    return [Table(columns=columns, rows=rows), *_table([heading, "multiplier"], fixed)]


def _between_nodes(solution: Solution) -> Section:
    """What happens to limits where nobody asked: a sentence, empty where they hold."""
    other = solution.origin is Origin.OTHER_TRUTH  # what is passed then is among the violations
    if solution.statement is None or not solution.converged or other:
        return []
    found = [entry for entry in solution.passed_limits() if entry.share > NOTED]
    if not found:
        return []
    worst = found[0]
    where = "the nodes" if solution.mesh.points == 1 else f"{solution.mesh.points} points of each interval"
    if not worst.defined:
        text = f"limits are imposed at {where}; between them '{worst.name}' is NaN or inf, at t = {worst.time:.4g} s"
        return [Sentence(text + ": check_path() lists all")]
    less = "more intervals make" if worst.equation else "points= or more intervals make"
    less = "a smaller tolerance= makes" if worst.imposed else less
    text = (
        f"limits are imposed at {where}; {'there' if worst.imposed else 'between them'} that of '{worst.name}' is "
        f"passed by up to {worst.by:.2g}, {100 * worst.share:.2g} % of it, at t = {worst.time:.4g} s: {less} it less, "
        "check_path() lists all"
    )
    return [Sentence(text)]


def without_problem(solution: Solution) -> Section:
    """What is not told of a solution that was read without its problem, a sentence; empty where that is known."""
    if solution.statement is not None:
        return []
    text = (
        "read without its problem: limits passed between the nodes, conditions at instants and the room that feedback "
        "leaves to bounds are not shown; covocp.load(path, problem) knows them"
    )
    return [Sentence(text)]


def _counted(number: int, what: str) -> str:
    """A number of things in words."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def untried_told(count: int) -> str:
    """What is not known where a limit has ended the comparison of starts."""
    return f"the limit of time or iterations came before {_counted(count, 'other start')} could be compared"


def _effort(solution: Solution) -> Section:
    """Mesh, iterations and time, a sentence."""
    mesh, stats = solution.mesh, solution.stats
    words = [
        _intervals(mesh, solution.extremal.stated, stats),
        f"controls piecewise {mesh.control}",
        _counted(mesh.substeps, "integration step") + " an interval",
        _counted(len(mesh.segments), "shooting segment"),
    ]
    if any(b.kind == "matrix" for b in solution.blocks):
        words.append(f"matrices {'eliminated' if mesh.eliminated else 'as states'}, step '{mesh.step}'")
    effort = [_counted(stats["iterations"], "iteration")] if stats.get("iterations", -1) >= 0 else []
    if (seconds := solution_seconds(stats)) is not None:
        effort.append(f"{seconds:.3g} s")
    if stats.get(OTHERWISE):
        effort.append(f"{'found' if solution.converged else 'nor found'} by {stats[OTHERWISE]}")
    if stats.get(OTHER_START):
        effort.append(f"the guess led nowhere, solved from {stats[OTHER_START]}")
    if stats.get("tried", 1) > 1 and solution.within is None:
        effort.append(f"{stats['tried']} starts tried")
    if "untried" in stats and solution.within is None:
        effort.append(untried_told(stats["untried"]))
    if "left_duration" in stats:
        effort.append(f"cheaper than with a duration of {stats['left_duration']:.3g} s, where it ended first")
    if stats.get("excited"):
        effort.append("another number of switches was cheaper")
    if stats.get("left_saddle"):
        effort.append("started again from a saddle")
    if "starts" in stats and solution.within is None:
        effort.append(starts_told(stats["starts"]))
    lines = [
        Sentence("mesh: " + ", ".join(words)),
        *refinement(stats, "" if solution.within is None else " of all phases"),
    ]
    return lines + ([Sentence("effort: " + ", ".join(effort))] if effort else [])


def _intervals(mesh: Mesh, stated: Statement | None, stats: Mapping[str, Any]) -> str:
    """The number of intervals, how the mesh that was asked for was graded, at how many instants something happens."""
    asked, added, count = stats.get("intervals_asked"), stats.get("nodes_added"), mesh.intervals - len(mesh.instants)
    read = [k for k in mesh.instants if mesh.readings[:, k].any()]
    others = distinct(mesh.nodes[[k for k in mesh.instants if k not in read]])
    held = np.ones(others.size, dtype=bool) if stated is None else near(others, np.array(stated.instants))
    words = _counted(count, "interval")
    if asked is not None and added is not None and any(added):
        places = "at both ends" if all(added) else "at the start" if added[0] else "at the end"
        words = f"{_counted(asked, 'interval')}, graded to {count} {places}"
    elif asked is not None and asked != count:
        words = f"{_counted(asked, 'interval')} asked for, {count} between the nodes that are needed"
    words += f", measurements taken at {_counted(len(read), 'instant')}" if read else ""
    words += f", a node for conditions at {_counted(int(held.sum()), 'instant')}" if held.any() else ""
    return words + (f", the control jumps at {_counted(int((~held).sum()), 'instant')}" if not held.all() else "")


def refinement(stats: Mapping[str, Any], of: str = "") -> list[Sentence]:
    """The meshes that were tried, with the errors of the cost `of` what; nothing where the mesh was given."""
    meshes, errors, asked = (stats.get(name) for name in ("mesh_intervals", "mesh_errors", "refine"))
    if not meshes or not errors or asked is None:
        return []
    words = [" + ".join(str(count) for count in np.atleast_1d(entry)) for entry in meshes]
    tried = ", ".join(f"{count} ({error:.1e})" for count, error in zip(words, errors, strict=False))
    reached = "" if min(errors) <= asked else ", NOT REACHED"
    return [
        Sentence(
            f"refined: {len(meshes)} mesh{'' if len(meshes) == 1 else 'es'}, intervals (error of the cost{of}, "
            f"relative, measured on a finer one): {tried}; asked for {asked:.3g}{reached}"
        )
    ]


def starts_told(starts: Given) -> str:
    """What the starts of a multistart found, by their costs."""
    costs = np.asarray(starts, dtype=float)
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
