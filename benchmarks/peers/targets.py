"""Figures with targets, made from the measured cases."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cases import Case


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure with its target; `holds` is None where it was not measured, or has none."""

    what: str
    target: str
    measured: str = "not measured"
    holds: bool | None = None


def value(cases: Sequence[Case], part: str, code: str, size: int = 0, *, key: str = "seconds") -> float | None:
    """Median of a case: None where it did not run, NaN where covocp failed."""
    case = next((case for case in cases if (case.part, case.code, case.size) == (part, code, size)), None)
    if case is None:
        return None
    ours = case.code.startswith(("covocp", "statement", "import covocp"))
    return math.nan if case.error and ours else case.median(key)


def figure(what: str, measured: float | None, *, most: float | None = None, least: float | None = None) -> Figure:
    """Figure for a number that must not exceed `most`, or must reach `least`, or is stated; its unit is in `what`."""
    target = f"at most {most:g}" if most is not None else f"at least {least:g}" if least is not None else "-"
    if measured is None:
        return Figure(what=what, target=target)
    if math.isnan(measured):
        return Figure(what=what, target=target, measured="failed", holds=False)
    holds = (most is None or measured <= most) and (least is None or measured >= least)
    return Figure(what=what, target=target, measured=f"{measured:.3g}", holds=None if target == "-" else holds)


def ratio(over: float | None, under: float | None) -> float | None:
    """Quotient, None where a part is missing."""
    return None if over is None or under is None else over / under


def difference(one: float | None, other: float | None) -> float | None:
    """Relative difference of two costs, None where one is missing."""
    quotient = ratio(one, other)
    return None if quotient is None else abs(quotient - 1)


def figures_table(figures: Sequence[Figure]) -> str:
    """Figures and targets as a table."""
    verdict = {True: "pass", False: "**fail**", None: "-"}
    lines = ["| figure | target | measured | |", "|---|---|---|---|"]
    lines += [f"| {f.what} | {f.target} | {f.measured} | {verdict[f.holds]} |" for f in figures]
    return "\n".join(lines)
