"""One problem by several methods or formulations, side by side."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.arguments import check_argument, checked, either, mapping, optional, sequence, text, truth
from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError, Interrupted, ProblemError, spelling
from covocp.base.expressions import Given
from covocp.base.later import later
from covocp.base.pages import Section, Sentence, Table, as_html, as_text, number
from covocp.base.short_repr import short_repr
from covocp.base.threads import methods_one_at_a_time, one_at_a_time
from covocp.extremal.mesh_error import NO_COST
from covocp.problem.phases import Phases
from covocp.solution.phases import PhasesSolution
from covocp.solution.solution import Solution
from covocp.solving.methods import METHODS, method_options
from covocp.solving.once import solve
from covocp.solving.solver import Solver, check_problem
from covocp.statement.conditions import beyond
from covocp.transcription.mesh import Options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from covocp.problem.builder import Problem

COMPARED = ("ipopt", "gradient")
SOLVE_OPTIONS = ("starts", "seed", "guess", "parameters")
INTERRUPTED = "interrupted by the user"


@dataclass(frozen=True, kw_only=True)
class Row:
    """One run of a comparison.

    Attributes:
        label: of the run, unique.
        method: its name.
        solution: what came out, converged or not, of phases a `PhasesSolution`; None where nothing did.
        reason: why there is no converged solution; "" where there is one.
        seconds: building and solving, as a user waits for it.
    """

    label: str
    method: str
    solution: Solution | Any | None = field(repr=False)
    reason: str
    seconds: float

    __repr__ = short_repr


@methods_one_at_a_time
@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs of one problem; prints as a table, indexed by label (the method's name by default) or number.

    Attributes:
        name: of the problem.
        rows: the runs in the order asked for.
    """

    name: str
    rows: tuple[Row, ...]

    __repr__ = short_repr

    @property
    def solutions(self) -> Mapping[str, Solution | Any]:
        """What came out, by label, converged or not."""
        return {row.label: row.solution for row in self.rows if row.solution is not None}

    @property
    def converged(self) -> bool:
        """Whether every run found a solution."""
        return all(not row.reason for row in self.rows)

    @property
    def best(self) -> float:
        """Least cost of the converged runs; NaN where none converged."""
        costs = [row.solution.cost for row in self.rows if row.solution is not None and row.solution.converged]
        return min(costs, default=float("nan"))

    def __getitem__(self, key: str | int) -> Solution | Any:
        """The solution of a label or number.

        Raises:
            ProblemError: no such label, or nothing came out of that run.
        """
        labels = [row.label for row in self.rows]
        row = None
        if isinstance(key, int) and not isinstance(key, bool) and -len(labels) <= key < len(labels):
            row = self.rows[key]
        elif isinstance(key, str) and key in labels:
            row = self.rows[labels.index(str(key))]
        if row is None or row.solution is None:
            raise ProblemError(
                f"The comparison has no solution '{key}'.",
                expected="one of " + (", ".join(self.solutions) or "none: no run came to an end"),
                received=repr(key) if row is None else f"{key}: {row.reason}",
                remedy="ask for one of them",
            )
        return row.solution

    def __iter__(self) -> Iterator[Row]:
        """The rows."""
        return iter(self.rows)

    def __len__(self) -> int:
        """Number of runs."""
        return len(self.rows)

    def plot(self, *names: Any, path: str | Path | None = None, **options: Any) -> Figure:
        """Draw all solutions in one figure; see `covocp.plot.figure.plot_solutions`.

        Raises:
            ProblemError: they are of phases.
        """
        if self._of_phases:
            raise _wrong(
                "Solutions of phases are not drawn in one figure.",
                "solutions of a Problem",
                f"those of '{self.name}'",
                "draw each by itself: comparison[label].plot()",
            )
        figures = later("plot.figure")
        figures.check_plot_options(options)
        labels = list(self.solutions)
        title = options.pop("title", self.name or None)
        return figures.plot_solutions(  # type: ignore[no-any-return]
            list(self.solutions.values()),
            *names,
            labels=options.pop("labels", labels),
            title=title,
            path=path,
            **options,
        )

    @property
    def _of_phases(self) -> bool:
        """Whether the runs are of phases."""
        return any(isinstance(solution, PhasesSolution) for solution in self.solutions.values())

    def __str__(self) -> str:
        """The table that print shows."""
        return as_text(self._sections())

    def _repr_html_(self) -> str:
        """What a notebook shows: the same table, and the figure."""
        drawn = self.solutions and not self._of_phases
        return as_html(self._sections(), later("plot.embedding").embedded(self.plot) if drawn else "")

    def _sections(self) -> list[Section]:
        """The name, the table, why runs failed, and what the columns mean."""
        columns = ["method", "cost", "gap", "stationarity", "costates", "end", "eigenvalue", "iterations", "seconds"]
        rows = [[row.label, *_entries(row, self.best)] for row in self.rows]
        legend = (
            "gap: relative to the least cost of a converged run; stationarity: relative, as in each solution; "
            "costates: multipliers against backward integration; end: largest miss of a terminal condition; "
            "eigenvalue: smallest one of the covariances"
        )
        return [
            [Sentence(self.name)] if self.name else [],
            [Table(columns=columns, rows=rows)],
            [Sentence(f"{row.label}: {row.reason}", warning=True) for row in self.rows if row.reason],
            [Sentence(legend, "")],
        ]


@one_at_a_time
@checked(methods=either(text, sequence), progress=truth, method_options=optional(mapping))
def compare(
    problem: Problem | Phases,
    methods: Sequence[Any] = COMPARED,
    *,
    intervals: Given = None,
    guess: Given = None,
    progress: bool = True,
    method_options: Mapping[str, Mapping[str, Any]] | None = None,
    **options: Any,
) -> Comparison:
    """Solve a problem by several methods, or in several formulations, and set the results side by side.

    Args:
        problem: what to solve; or phases.
        methods: names of methods, or (label, method, options) for a formulation of its own, such as
            ("states", "ipopt", {"covariances": "states"}).
        intervals: number of control intervals; None: 100, and 16 of the first mesh with `refine`.
            Of phases as of `solve`.
        guess: where all runs start; see `Solver.solve`; of phases `solve`.
        progress: whether to show the iterations on a terminal.
        method_options: options by method.
        options: for all runs; every method must know them.

    Returns:
        The comparison. A run that fails is a row with its reason.

    Raises:
        ProblemError: the statement is wrong, a method or an option is unknown, or two runs have the same label.
    """
    if isinstance(problem, Phases):
        name = problem.chain().name
    else:
        check_problem(problem)
        name = problem.statement().name
    runs = _runs(methods, {"intervals": intervals, "guess": guess, **options}, dict(method_options or {}))
    rows: list[Row] = []
    for label, method, chosen in runs:
        if rows and INTERRUPTED in rows[-1].reason:
            rows.append(Row(label=label, method=method, solution=None, reason="not run: interrupted", seconds=0.0))
        else:
            rows.append(_run(problem, label, method, chosen, progress))
    return Comparison(name=name, rows=tuple(rows))


def _run(problem: Problem | Phases, label: str, method: str, options: dict[str, Any], progress: bool) -> Row:
    """One run, whatever comes of it."""
    begin = time.perf_counter()
    starting = {name: options.pop(name) for name in SOLVE_OPTIONS if name in options}
    solution: Solution | Any | None = None
    reason = ""
    try:
        if isinstance(problem, Phases):
            solution = solve(problem, method, progress=progress, allow_failure=True, **options, **starting)
        else:
            solution = Solver(problem, method, **options).solve(progress=progress, allow_failure=True, **starting)
        reason = "" if solution.converged else f"did not converge: {solution.message}"
    except Interrupted as error:
        solution, reason = error.solution, f"{INTERRUPTED}: {error}"
    except Exception as error:  # whatever a method raises: the other runs are wanted all the same
        text = " ".join(str(error).split())
        reason = text if isinstance(error, CovocpError) else f"{type(error).__name__}: {text}"
    return Row(label=label, method=method, solution=solution, reason=reason, seconds=time.perf_counter() - begin)


def _runs(
    methods: Sequence[Any], shared: dict[str, Any], by_method: dict[str, Mapping[str, Any]]
) -> list[tuple[str, str, dict[str, Any]]]:
    """Label, method and options of each run, all names known."""
    runs: list[tuple[str, str, dict[str, Any]]] = []
    for entry in [methods] if isinstance(methods, str) else methods:
        label, method, own = (entry, entry, {}) if isinstance(entry, str) else _triple(entry)
        if method not in METHODS:
            raise _wrong("There is no such method.", "one of " + ", ".join(METHODS), repr(method), "correct methods=")
        if label in [run[0] for run in runs]:
            raise _wrong(
                "Two runs have the same label.",
                "different labels",
                repr(label),
                "give (label, method, options) with another label",
            )
        shared_by_method = by_method.get(method, {})
        check_argument("compare()", "method_options", mapping, shared_by_method)
        chosen = {**shared, **shared_by_method, **own}
        known = _option_names(method)
        for name in chosen:
            if name not in known:
                raise _wrong(
                    f"The method '{method}' has no option '{name}'.",
                    "one of " + ", ".join(sorted(known)),
                    f"{name}={chosen[name]!r}",
                    spelling(name, known, "give it to the methods that know it: method_options={method: {...}}"),
                )
        runs.append((label, method, chosen))
    if unused := [name for name in by_method if name not in [run[1] for run in runs]]:
        raise _wrong(
            "There are options for a method that is not compared.",
            "one of " + ", ".join(dict.fromkeys(run[1] for run in runs)),
            ", ".join(map(str, unused)),
            "correct method_options=",
        )
    if not runs:
        raise _wrong("There is nothing to compare.", "at least one method", "none", "correct methods=")
    return runs


def _triple(entry: Given) -> tuple[str, str, dict[str, Any]]:
    """(label, method, options) of an entry that is not a name."""
    if isinstance(entry, tuple) and len(entry) == 3 and isinstance(entry[2], Mapping):
        return str(entry[0]), str(entry[1]), dict(entry[2])
    raise _wrong(
        "A run of a comparison is not understood.",
        "the name of a method, or (label, method, {option: value})",
        repr(entry)[:100],
        "correct methods=",
    )


def _option_names(method: str) -> set[str]:
    """Options of a method, of every mesh, and of every start."""
    return set(method_options(method)) | {f.name for f in fields(Options)} | set(SOLVE_OPTIONS)


def _wrong(problem: str, expected: str, received: str, remedy: str) -> ProblemError:
    return ProblemError(problem, expected=expected, received=received, remedy=remedy)


def _entries(row: Row, best: float) -> list[str]:
    """Cost, gap, residuals, iterations and time of a row as words."""
    seconds = number(row.seconds, 3)
    solution = row.solution
    if solution is None:
        return ["-", "-", "-", "-", "-", "-", "-", seconds]
    gap = (solution.cost - best) / max(abs(best), NO_COST)
    phases: tuple[Solution, ...] = tuple(solution) if isinstance(solution, PhasesSolution) else (solution,)
    slope, costates = None, None
    with suppress(CovocpError, RuntimeError, ArithmeticError, ValueError):
        slope = _largest([phase.optimality.stationarity for phase in phases])
        costates = _largest([phase.optimality.costate_difference for phase in phases])
    iterations = int(solution.stats.get("iterations", -1))
    smallest = min(phase.smallest_eigenvalue for phase in phases)
    return [
        number(solution.cost, 9),
        "-" if not solution.converged or np.isnan(gap) else "0" if gap == 0 else f"{gap:.1e}",
        _short(slope),
        _short(costates),
        _short(_largest([terminal_miss(phase) for phase in phases])),
        "-" if np.isinf(smallest) else f"{smallest:.2e}",
        str(iterations) if iterations >= 0 else "-",
        seconds,
    ]


def _largest(values: list[float | None]) -> float | None:
    """The largest of those that are known."""
    return max((value for value in values if value is not None), default=None)


def _short(value: float | None) -> str:
    return "-" if value is None or np.isnan(value) else f"{value:.1e}"


def terminal_miss(solution: Solution) -> float | None:
    """Largest violation of a condition at the end or at an instant, in its own unit; None: the problem is not known."""
    st = solution.statement
    if st is None:
        return None
    _, final, _, final_matrices = st.boundary_values(solution.parameters)
    reached = (solution.trajectory.x[-1], solution.trajectory.e[-1])
    misses = [
        beyond(values[~np.isnan(goal)], goal[~np.isnan(goal)], goal[~np.isnan(goal)])  # NaN: free
        for values, goal in zip(reached, (final, final_matrices), strict=True)
    ]
    for conditions, place, values in solution.extremal.inequalities():
        if place in ("end", "instants"):
            misses.append(beyond(values[0], conditions.lower, conditions.upper))
    return float(np.concatenate(misses).max(initial=0.0))
