"""What print and a notebook show of a simulation: a table at the end and sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from covocp.base.matrices import Array
from covocp.base.pages import Part, Section, Sentence, Table, as_text, number
from covocp.simulation.chances import chance_section
from covocp.simulation.verdict import Component

if TYPE_CHECKING:
    from covocp.simulation.monte_carlo import MonteCarlo

# Failures that are listed one by one.
LISTED = 5


def summary(sample: MonteCarlo) -> str:
    """A simulation in words and tables of plain text, at most 100 columns wide: its `sections`."""
    return as_text(sections(sample))


def sections(sample: MonteCarlo) -> list[Section]:
    """A simulation in sentences and tables: what was simulated, and sample against prediction with its verdict."""
    return [
        _head(sample),
        _entries(sample, "deviation at T", sample.verdict.deviations, sample.design),
        _entries(sample, "error of the filter at T", sample.verdict.errors, sample.design_error),
        _cost(sample),
        chance_section(sample),
        _violations(sample),
        _shares(sample),
        [Sentence(f"{sample.verdict}{_expectations(sample)}", "", warning=not sample.verdict.holds)],
    ]


def _head(sample: MonteCarlo) -> Section:
    name = sample.name or "problem without a name"
    what = f"{sample.filter} filter" + (" and feedback" if sample.fed_back else ", no feedback (open-loop control)")
    if sample.filter == "law":
        what = f"a law stepped every {sample.period:.6g} s"
    lines: list[Part] = [Sentence(f"{name}: {sample.runs} runs of the actual system, seed {sample.seed}, {what}")]
    if sample.truth:
        lines.append(Sentence(f"truth: {sample.truth}"))
    step = sample.step
    length = (
        f"{step.longest:.6g} s"
        if np.isclose(step.shortest, step.longest)
        else (f"{step.shortest:.3g} to {step.longest:.3g} s")
    )
    lines.append(Sentence(f"step: {length}, {step.reason}"))
    wrong = [f"FAILED: {failure}" for failure in sample.failed[:LISTED]]
    if sample.interrupted:
        wrong.insert(0, f"INTERRUPTED: {sample.runs} of {sample.requested} runs were simulated")
    if len(sample.failed) > LISTED:
        wrong.append(f"FAILED: {len(sample.failed) - LISTED} other tasks")
    return [*lines, *(Sentence(line, warning=True) for line in wrong)]


def _entries(sample: MonteCarlo, title: str, entries: tuple[Component, ...], design: Array) -> Section:
    """One row for each component; the design's own expectation where the truth is another system."""
    if not entries:
        return []
    columns = [title, "predicted", "sample", "band", "ratio", "mean", "robust", ""]
    rows = []
    for i, entry in enumerate(entries):
        rows.append(
            [
                entry.name,
                *(number(value, 4) for value in (entry.predicted, entry.sample)),
                f"{number(entry.low, 4)} .. {number(entry.high, 4)}",
                number(entry.ratio, 4),
                number(entry.bias, 3),
                number(entry.robust, 4),
                "" if entry.inside else "OUTSIDE",
            ]
        )
        if sample.truth:
            expected = float(np.sqrt(design[-1, i, i]))
            rows[-1].insert(1, number(expected, 4))
    if sample.truth:
        columns.insert(1, "design")
    return [Table(columns=columns, rows=rows, words=(0, len(columns) - 1))]


def _expectations(sample: MonteCarlo) -> str:
    """What the design expected where the truth is another system, and the sample says otherwise."""
    if not sample.truth:
        return ""
    expected = np.sqrt(np.diagonal(sample.design[-1]))
    missed = [
        f"{entry.name} {number(value, 4)}, sample {number(entry.sample, 4)}"
        for entry, value in zip(sample.verdict.deviations, expected, strict=False)
        if not (entry.low <= value <= entry.high or max(value, entry.sample) <= entry.exact)
    ]
    return f" The design expects another spread: {'; '.join(missed)}." if missed else ""


def _cost(sample: MonteCarlo) -> Section:
    if not np.isfinite(sample.cost):
        return []
    text = f"mean cost {number(sample.cost, 6)} (standard error {number(sample.cost_error, 2)})"
    if np.isfinite(sample.predicted_cost):
        text += f", predicted {number(sample.predicted_cost, 6)}"
    if sample.truth and np.isfinite(sample.design_cost):
        text += f", by the design {number(sample.design_cost, 6)}"
    if sample.spread_cost:
        text += f"; without {number(sample.spread_cost, 6)} of the design that is not linear in X, which no run has"
    gone = int(np.count_nonzero(~sample.stayed))
    return [Sentence(text + (f"; without the {gone} runs that left the domain" if gone else ""))]


def _violations(sample: MonteCarlo) -> Section:
    """Who violates the constraints of the problem; bounds that no run leaves and chances are left out."""
    shown = [entry for entry in sample.violations.values() if (entry.runs or not entry.bound) and not entry.chance]
    left_out = sample.inequalities.left_out.items()
    text = [Sentence(f"Not counted: {', '.join(f'{name} ({why})' for name, why in left_out)}.", "")] if left_out else []
    if not shown:
        return text
    columns = ["runs that violate", "at", "at any time", "at T", "promised", "most at once", "at t [s]", "promised", ""]
    rows = []
    for entry in shown:
        kind = (
            "bounds"
            if entry.bound
            else {"initial": "start", "final": "end", "inside": "instant"}.get(entry.place, "path")
        )
        once = entry.place in ("initial", "inside")
        end = ["-", "-"] if once else [_share(entry.end_share), _share(entry.promised_end)]
        rows.append([entry.name, kind, _share(entry.share), *end, _share(entry.most), number(entry.most_time, 4)])
        rows[-1] += [_share(entry.promised_most), "" if entry.as_promised else "OUTSIDE"]
    table = Table(columns=columns, rows=rows, words=(0, 1, len(columns) - 1))
    note = (
        "Promised: by the predicted covariances, for normal deviations and to first order; OUTSIDE: beyond the band of "
        f"{100 * sample.level:.4g} % about the share of the runs at the end (at the start, at the instant)."
    )
    return [table, Sentence(note, ""), *text]


def _share(value: float) -> str:
    """A share in percent, for a table."""
    return "-" if np.isnan(value) else f"{100 * value:.3g} %"


def _shares(sample: MonteCarlo) -> Section:
    """Who left what, and what the columns mean."""
    factor = "inside the domain" if sample.left_share == 0 else "that stayed inside the domain"
    lines = [
        f"Predicted, sample and robust are standard deviations about the nominal, of the runs {factor} (robust: from "
        f"the median of all runs); the band has a probability of {100 * sample.level:.4g} %."
    ]
    if sample.left_share:
        first = float(sample.left.min())
        lines.append(
            f"{100 * sample.left_share:.3g} % of the runs left the domain (100 predicted deviations), the first at "
            f"{first:.4g} s."
        )
    if sample.asked_share:
        most = 100 * float(sample.asking.max(initial=0.0))
        kept = "it was limited to that" if sample.limited else "they were given it: limits= changes that"
        lines.append(
            f"{100 * sample.asked_share:.3g} % of the runs asked for more control than there is ({most:.3g} % at one "
            f"instant); {kept}."
        )
    return [Sentence(line, "") for line in lines]
