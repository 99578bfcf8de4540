"""The solution of several phases: one ordinary solution for each, and what holds where they meet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.arguments import checked, one_of
from covocp.base.dataclass import dataclass
from covocp.base.errors import MissingAttributeError, ProblemError, has_key, spelling
from covocp.base.expressions import Given
from covocp.base.later import later
from covocp.base.matrices import Array
from covocp.base.pages import Section, Sentence, Table, as_html, as_text, number
from covocp.base.threads import methods_one_at_a_time
from covocp.solution.known_links import KnownLink, check_links
from covocp.solution.report import refinement, sections, starts_told, stated_first, untried_told, without_problem
from covocp.solution.sample import Sample, asked_times
from covocp.solution.solution import Solution
from covocp.statement.chain import Link
from covocp.statement.names import name_of, sizes_of, unknown_name

if TYPE_CHECKING:
    from pathlib import Path

    import matplotlib.figure

# Residual where phases meet from which on the printout worries about it.
LARGE_LINK = 1e-4
# What the solution of a phase has, beside what its class shows.
OF_A_PHASE = tuple(field.name for field in fields(Solution))


def check_whole(solution: Solution, what: str) -> None:
    """A solution must be one of a whole problem, not of a phase.

    Args:
        solution: to be checked.
        what: is asked of it, a function.

    Raises:
        ProblemError: it is that of a phase.
    """
    if solution.within is not None:
        raise ProblemError(
            f"{what} does not apply to one of several phases.",
            expected="the solution of a Problem by itself",
            received=f"the phase '{solution.name}'",
            remedy="what it would say of the phase alone is not true of all phases together",
        )


def check_begins(solution: Solution, what: str) -> None:
    """A solution must not be that of a phase into which feedback has brought deviations that were estimated before.

    Args:
        solution: to be checked.
        what: is asked of it, a function.

    Raises:
        ProblemError: it is.
    """
    if solution.within is not None and solution.loop is not None and solution.loop.Xhat[0].any():
        raise ProblemError(
            f"{what} does not apply to the phase '{solution.name}': it begins with what the feedback before it left.",
            expected="the first phase, or the solution of a Problem by itself",
            received=f"the phase '{solution.name}', whose estimate is not zero where it begins",
            remedy="its covariances, gains and cost are in .loop, .gains and .cost",
        )


@methods_one_at_a_time
@dataclass(frozen=True, kw_only=True, eq=False)
class PhasesSolution:
    """Several phases solved as one problem (or their last iterate: see `converged`).

    `solution[name]` or `solution[number]` is the `Solution` of a phase, whose costates, multipliers and residuals are
    those within the whole: p at its end contains what the later phases cost. Its times begin at zero.

    Attributes:
        name: of the whole.
        method: that found it.
        converged: whether the method's own test was met.
        message: how the method ended.
        phases: their solutions in order.
        link_residuals: where each phase meets the next, the largest difference of p and k_x + J' p+, relative to p or,
            where that is less, as a change of the cost by what of it is variable; see
            `covocp.extremal.links.link_residual`; nan along controls that were given, where p+ is had from the later
            phase alone.
        violations: of constraints, by name with that of the phase.
        stats: iterations, times, what the method counts.
        links: what passes from each phase to the next; none where it was read from a file without its phases.
        known_links: of a solution read from a file, what these were, to tell them from others.
    """

    name: str
    method: str
    converged: bool
    message: str
    phases: tuple[Solution, ...]
    link_residuals: tuple[float, ...]
    violations: Mapping[str, float]
    stats: Mapping[str, Any]
    links: tuple[Link, ...] = ()
    known_links: tuple[KnownLink, ...] = ()

    # What functions say that take one problem or solution.
    instead = "give one of its phases, solution[name]; what concerns all phases together is not available here"

    def __post_init__(self) -> None:
        """Links that are given to a solution from a file must be those that it was solved with.

        Raises:
            ProblemError: they are others (says what differs).
        """
        if self.links and self.known_links:
            check_links(self.known_links, self.links)

    if not TYPE_CHECKING:  # else every attribute would pass for known

        def __getattr__(self, name: str) -> Any:
            """Say where to find what the solution of a phase has; only asked for what is not here.

            Raises:
                AttributeError: always.
            """
            kind = type(self).__name__
            if name.startswith("_") or name in dir(type(self)) or name not in (*dir(Solution), *OF_A_PHASE):
                raise AttributeError(f"'{kind}' object has no attribute '{name}'", name=name, obj=self)
            phases = [phase.name for phase in vars(self).get("phases", ())]
            raise MissingAttributeError(
                f"'{name}' is that of one phase, and this is the solution of several.",
                expected="one of the phases " + ", ".join(repr(phase) for phase in phases),
                received=f".{name} of a {kind}",
                remedy=f"index a phase first: solution[{phases[0] if phases else 'name'!r}].{name}",
            )

    @property
    def cost(self) -> float:
        """The cost of all phases."""
        return float(sum(phase.cost for phase in self.phases))

    @property
    def cost_terms(self) -> Mapping[str, float]:
        """The cost of each phase by its name."""
        return {phase.name: phase.cost for phase in self.phases}

    @property
    def status(self) -> str:
        """How the run ended, in words."""
        return self.message if self.converged else f"NOT CONVERGED: {self.message}"

    @property
    def durations(self) -> Array:
        """Of the phases [s], shape (phases,)."""
        return np.array([phase.duration for phase in self.phases])

    @property
    def duration(self) -> float:
        """Of all phases together [s]."""
        return float(self.durations.sum())

    @property
    def starts(self) -> Array:
        """When each phase begins [s], shape (phases,); the first one at zero."""
        return np.concatenate([np.zeros(1), np.cumsum(self.durations)[:-1]])

    @property
    def t(self) -> Array:
        """Times of the nodes of all phases [s]; where two meet the time is there twice."""
        return np.concatenate([start + phase.t for start, phase in zip(self.starts, self.phases, strict=True)])

    def __len__(self) -> int:
        """Number of phases."""
        return len(self.phases)

    def __iter__(self) -> Iterator[Solution]:
        """The phases in order."""
        return iter(self.phases)

    def __contains__(self, key: object) -> bool:
        """Whether there is such a phase: a name, a number, or what is returned for one."""
        return any(phase is key for phase in self.phases) or has_key(self, key)

    def __getitem__(self, key: Given) -> Solution:
        """The solution of a phase, by its name or its number (from 0; -1 is the last).

        Raises:
            ProblemError: there is no such phase.
        """
        names = [phase.name for phase in self.phases]
        if isinstance(key, str) and key in names:
            return self.phases[names.index(key)]
        whole = isinstance(key, (int, np.integer)) and not isinstance(key, bool)
        if whole and -len(names) <= key < len(names):
            return self.phases[int(key)]
        raise ProblemError(
            f"There is no phase '{key}'.",
            expected="one of " + ", ".join(repr(name) for name in names) + f", or a number from 0 to {len(names) - 1}",
            received=repr(key)[:100],
            remedy=spelling(key, names, "index a phase first: solution[name][symbol]; or use solution.at(t)[symbol]"),
        )

    @checked(side=one_of("before", "after"))
    def at(self, t: Given, *, side: str = "after") -> Sample:
        """Values at any times of the whole, between the nodes as the integrator computes them.

        Args:
            t: a time or an array of times [s], within [0, duration].
            side: where two phases meet, and where something is measured at an instant: "after" (what the later one
                starts with) or "before" (what the earlier one ends with).

        Returns:
            What `[name]` gives the values of; NaN in phases that have no such name. Matrices whose size differs
            between phases, such as E where states appear, are left out: ask the phase.

        Raises:
            ProblemError: where a time lies outside, or is not a number; another side.
        """
        times = asked_times("at", t, self.duration, "all phases")
        found = np.searchsorted(self.starts[1:], times, side="right" if side == "after" else "left")
        samples: list[tuple[Any, Mapping[str, Array]]] = []
        for k, phase in enumerate(self.phases):
            chosen = np.flatnonzero(found == k)
            local = np.clip(times[chosen] - self.starts[k], 0.0, phase.duration)
            samples.append((chosen, phase.at(local if chosen.size else np.zeros(1), side=side).values))
        values = _merged(samples, times)
        if np.ndim(t) == 0:
            values = {name: value[0] for name, value in values.items()}
        return Sample(t=t, values=values, symbols={})

    def plot(self, *names: Any, **options: Any) -> matplotlib.figure.Figure:
        """Draw all phases over the whole time; see `covocp.plot.phases.plot_phases`."""
        figures = later("plot.phases")
        later("plot.figure").check_plot_options(options, figures.plot_phases)
        return figures.plot_phases(self, *names, **options)  # type: ignore[no-any-return]

    def save(self, path: str | Path) -> Path:
        """Write all phases to a .npz or .json file; see `covocp.solution.phases_storage.save`."""
        return later("solution.phases_storage").save(self, path)  # type: ignore[no-any-return]

    def sections(self) -> list[Section]:
        """The whole, and each phase, in sentences and tables."""
        text = f"{self.name or 'phases'}: {self.message} ({self.method})"
        head: Section = [Sentence(text if self.converged else f"NOT CONVERGED: {text}", warning=not self.converged)]
        rows = [
            [phase.name, number(start, 6), number(start + phase.duration, 6), number(phase.cost, 8)]
            for start, phase in zip(self.starts, self.phases, strict=True)
        ]
        rows.append(["all phases", number(0.0, 6), number(self.duration, 6), number(self.cost, 8)])
        table: Section = [Table(columns=["phase", "from [s]", "to [s]", "cost"], rows=rows)]
        pairs = zip(self.phases[:-1], self.phases[1:], self.link_residuals, strict=True)
        met = [
            [f"{one.name} to {two.name}", number(value, 3) + (" LARGE" if value > LARGE_LINK else "")]
            for one, two, value in pairs
            if not np.isnan(value)
        ]
        columns = ["costates where phases meet: p against k_x + J' p+ (relative)", ""]
        links: Section = [Table(columns=columns, rows=met)] if met else []
        effort = refinement(self.stats)
        if "starts" in self.stats:
            effort.append(Sentence(starts_told(self.stats["starts"])))
        if self.stats.get("tried", 1) > 1:
            effort.append(Sentence(f"{self.stats['tried']} starts tried"))
        if "untried" in self.stats:
            effort.append(Sentence(untried_told(self.stats["untried"])))
        violated = [[name, number(value, 4)] for name, value in stated_first(self.violations)]
        limits: Section = [Table(columns=["violated constraint", "by"], rows=violated)] if violated else []
        phases = [section for phase in self.phases for section in sections(phase)]
        return [head, limits, table, without_problem(self.phases[0]), effort, links, *phases]

    def __repr__(self) -> str:
        """One line."""
        names = ", ".join(phase.name for phase in self.phases)
        return f"<PhasesSolution of '{self.name}' ({names}) by {self.method}: {self.status}, cost {self.cost:.8g}>"

    def __str__(self) -> str:
        """The summary that print shows."""
        return as_text(self.sections())

    def _repr_html_(self) -> str:
        """What a notebook shows: the same summary, and the figure."""
        return as_html(self.sections(), later("plot.embedding").embedded(self.plot))


def limits_of_each(solution: PhasesSolution, limits: Given) -> list[Any]:
    """Limits of each phase from those of all: of a dict what a phase has controls of.

    Raises:
        ProblemError: no phase has a control of that name.
    """
    if not isinstance(limits, Mapping):
        return [limits] * len(solution)
    known = [tuple(block.name for block in phase.blocks if block.kind == "control") for phase in solution]
    every = {name: 0 for names in known for name in names}
    result: list[dict[Any, Any]] = [{} for _ in known]
    for key, value in limits.items():
        found = [
            name_of(key, phase.symbols, names, missing_ok=True, sizes=sizes_of(phase.blocks))
            for phase, names in zip(solution, known, strict=True)
        ]
        if not any(found):
            raise unknown_name(key, tuple(every))
        for own, name in zip(result, found, strict=True):
            if name:
                own[name] = value
    return list(result)


def _merged(samples: list[tuple[Any, Mapping[str, Array]]], times: Array) -> dict[str, Array]:
    """Values by name at all times from those of the phases at theirs; NaN where a phase has no such name."""
    shapes: dict[str, set[tuple[int, ...]]] = {}
    for _, values in samples:
        for name, value in values.items():
            shapes.setdefault(name, set()).add(value.shape[1:])
    result: dict[str, Array] = {}
    for name, found in shapes.items():
        if len(found) > 1 or name in ("time", "duration"):
            continue
        whole = np.full((times.size, *next(iter(found))), np.nan)
        for chosen, values in samples:
            if chosen.size and name in values:
                whole[chosen] = values[name]
        result[name] = whole
    return {"time": times, **result}
