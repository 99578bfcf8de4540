"""How many runs met each condition on a probability, at each time and at all of them, beside what was asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.normal import shown_probability
from covocp.base.pages import Section, Sentence, Table, number
from covocp.simulation.sampling import share_band

if TYPE_CHECKING:
    from covocp.simulation.monte_carlo import MonteCarlo


@dataclass(frozen=True, kw_only=True)
class Share:
    """The share of the runs that met a condition on a probability; one that left the domain did not.

    name: of the condition, of its row where there are several that hold by themselves. place: "path", "initial" or
    "final". asked: the probability. runs: that were simulated.
    least: smallest share at one stored time (of the start or the end: there), time [s]; band: of the probability there,
    (low, high), of the level of the simulation for all stored times together. predicted: by the covariances of what was
    simulated, of several rows together by Boole's bound.
    always, always_band: of the runs that met it at all instants: along the path less than at each of them.
    end, end_band: at the end.
    """

    name: str
    place: str
    asked: float
    runs: int
    least: float
    time: float
    band: tuple[float, float]
    predicted: float
    always: float
    always_band: tuple[float, float]
    end: float
    end_band: tuple[float, float]

    @property
    def met(self) -> bool:
        """Whether the runs do not contradict that the probability is reached at each time."""
        return self.asked <= self.band[1]


def chance_shares(sample: MonteCarlo) -> Mapping[str, Share]:
    """The shares of a simulation, by name."""
    chosen, runs, result = sample.inequalities, sample.runs, {}
    for limits in chosen.chances:
        asked = {limits.name: limits.probability} if limits.joint else dict.fromkeys(limits.names, limits.each)
        for name, probability in asked.items():
            i = next(k for k, row in enumerate(chosen.rows) if row.chance and row.name == name)
            once = {"initial": 0, "final": sample.t.size - 1}.get(limits.place)
            missing = np.rint(sample.violating[:, i] * runs)
            k = int(np.argmax(missing)) if once is None else once
            tests = 1 if once is not None else sample.t.size
            always, end = (int(np.count_nonzero(v[:, i])) for v in (sample.violated, sample.at_end))
            result[name] = Share(
                name=name,
                place=limits.place,
                asked=probability,
                runs=runs,
                least=1.0 - float(missing[k]) / runs,
                time=float(sample.t[k]),
                band=_band(int(missing[k]), runs, 1.0 - (1.0 - sample.level) / tests),
                predicted=1.0 - float(sample.promised[k, i]),
                always=1.0 - always / runs,
                always_band=_band(always, runs, sample.level),
                end=1.0 - end / runs,
                end_band=_band(end, runs, sample.level),
            )
    return result


def _band(missing: int, runs: int, level: float) -> tuple[float, float]:
    """Confidence band of the probability of being met."""
    low, high = share_band(missing, runs, level)
    return 1.0 - float(high), 1.0 - float(low)


def chance_section(sample: MonteCarlo) -> Section:
    """A table of the shares, and which of the probabilities were missed."""
    shares = list(sample.chances.values())
    if not shares:
        return []
    columns = ["chance", "asked", "met by, at least", "band", "at t [s]", "predicted", ""]
    rows, paths = [], []
    for q in shares:
        rows.append([q.name, f"{100 * q.asked:.12g} %", _percent(q.least), _interval(q.band)])
        rows[-1] += [number(q.time, 4), _percent(q.predicted), "" if q.met else "NOT MET"]
        if q.place == "path":
            paths.append([q.name, _percent(q.always), _interval(q.always_band), _percent(q.end), _interval(q.end_band)])
    tables = [Table(columns=columns, rows=rows, words=(0, len(columns) - 1))]
    if paths:
        tables.append(Table(columns=["chance", "met at all times by", "band", "met at T by", "band"], rows=paths))
    missed = [q for q in shares if not q.met]
    text = "The probabilities asked for are met within the band of the runs."
    if missed:
        listed = ", ".join(f"{q.name} ({shown_probability(q.asked)} asked, {q.least:.4g} met)" for q in missed)
        why = " for this truth" if sample.truth else ": the linearised spread, or the normal law, does not hold there"
        text = f"The probability is NOT MET by {listed}{why if sample.verdict.holds else ', see the verdict below'}."
    note = "Each time by itself is what chance() asks for; the first band is for all stored times together."
    return [*tables, Sentence(text, "", warning=bool(missed)), Sentence(note, "")]


def _percent(share: float) -> str:
    return f"{100 * share:.4g} %"


def _interval(band: tuple[float, float]) -> str:
    return f"{100 * band[0]:.4g} .. {100 * band[1]:.4g} %"
