"""The result of simulating several phases: what the runs did in each, and whether the prediction holds in all."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, has_key, spelling
from covocp.base.expressions import Given
from covocp.base.later import later
from covocp.base.matrices import Array
from covocp.base.pages import Section, Sentence, as_html, as_text
from covocp.base.threads import methods_one_at_a_time
from covocp.simulation.monte_carlo import MonteCarlo
from covocp.simulation.report import sections

if TYPE_CHECKING:
    import matplotlib.figure


@methods_one_at_a_time
@dataclass(frozen=True, kw_only=True, eq=False)
class PhasesMonteCarlo:
    """Simulated runs through several phases.

    `sample[name]` or `sample[number]` is the `MonteCarlo` of a phase, its times from zero. Run k is the same run in all
    of them; one that left the domain in a phase is outside it in the later ones from their start, where its deviation
    counts as infinite and its estimate as zero.

    Attributes:
        name: of the whole.
        phases: what the runs did in each, in order.
        starts: when each phase begins [s], (phases,).
    """

    name: str
    phases: tuple[MonteCarlo, ...]
    starts: Array

    @property
    def runs(self) -> int:
        """Number of runs that were simulated."""
        return self.phases[0].runs

    @property
    def left(self) -> Array:
        """Time of the whole at which a run left the domain [s], inf where it did not, (R,)."""
        times = [start + phase.left for start, phase in zip(self.starts, self.phases, strict=True)]
        return np.asarray(np.min(times, axis=0))

    @property
    def left_share(self) -> float:
        """Share of the runs that left the domain in some phase."""
        return self.phases[-1].left_share

    @property
    def holds(self) -> bool:
        """Whether the linear prediction holds at the end of every phase."""
        return all(phase.verdict.holds for phase in self.phases)

    @property
    def failing(self) -> tuple[str, ...]:
        """The phases at whose end it does not."""
        return tuple(phase.name for phase in self.phases if not phase.verdict.holds)

    def __len__(self) -> int:
        """Number of phases."""
        return len(self.phases)

    def __iter__(self) -> Iterator[MonteCarlo]:
        """The phases in order."""
        return iter(self.phases)

    def __contains__(self, key: object) -> bool:
        """Whether there is such a phase: a name, a number, or what is returned for one."""
        return any(phase is key for phase in self.phases) or has_key(self, key)

    def __getitem__(self, key: Given) -> MonteCarlo:
        """What the runs did in a phase, by its name or its number (from 0; -1 is the last).

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
            remedy=spelling(key, names, "index a phase first: sample[name].deviation(symbol)"),
        )

    def plot(self, *names: Any, **options: Any) -> matplotlib.figure.Figure:
        """Draw the runs over the whole time; see `covocp.simulation.phase_clouds.plot_phase_runs`."""
        module = later("simulation.phase_clouds")
        later("plot.figure").check_plot_options(options, module.plot_phase_runs)
        return module.plot_phase_runs(self, *names, **options)  # type: ignore[no-any-return]

    def sections(self) -> list[Section]:
        """The whole, and each phase, in sentences and tables."""
        first, failing = self.phases[0], self.failing
        fed_back = any(phase.fed_back for phase in self.phases)
        flown = f"{first.filter} filter" + (" and feedback" if fed_back else ", no feedback")
        flown = "a law in each phase" if first.filter == "law" else flown
        what = f"{self.runs} runs through {len(self)} phases, seed {first.seed}, {flown}"
        verdict = f"The linear prediction of the {'spread' if fed_back else 'errors of the filter'} "
        verdict += f"FAILS at the end of {', '.join(failing)}." if failing else "holds at the end of every phase."
        head: Section = [Sentence(f"{self.name or 'phases'}: {what}")]
        end: Section = [Sentence(verdict, warning=bool(failing))]
        return [head, *(section for phase in self.phases for section in sections(phase)), end]

    def __repr__(self) -> str:
        """One line."""
        names = ", ".join(phase.name for phase in self.phases)
        return f"<PhasesMonteCarlo of '{self.name}' ({names}): {self.runs} runs, {'holds' if self.holds else 'FAILS'}>"

    def __str__(self) -> str:
        """The summary that print shows."""
        return as_text(self.sections())

    def _repr_html_(self) -> str:
        """What a notebook shows: the same summary, and the figure."""
        return as_html(self.sections(), later("plot.embedding").embedded(self.plot))
