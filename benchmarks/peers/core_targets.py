"""The targets of core.py, and the judgement of its cases."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence

from cases import Case
from targets import Figure, difference, figure, ratio, value

AGAINST_REFERENCE = 1.25  # largest time of covocp over that of a script by hand
AGAINST_NAIVE = 3.0  # smallest time of the naive script over covocp's
GROWTH = 2.5  # largest exponent of the time over n
GROWTH_FROM = 8  # smallest n that it is taken over
MEMORY = 200.0  # MB
BUILDING = 0.3  # seconds
IMPORT = 1.5  # largest ratio to the import of CasADi and NumPy
# How many times as long the others take at least, by script and n.
TIMES_AS_LONG = {("rockit", 12): 300.0, ("packed", 12): 25.0, ("packed, one iteration", 20): 5.0}
SAME_COST = 1e-3  # relative; rk4 and gauss differ by 4e-4 at n = 4, another minimum differs by more


def judge_oscillator(cases: Sequence[Case]) -> list[Figure]:
    """Part a."""
    ours, by_hand, naive = (value(cases, "a", code, 4) for code in ("covocp", "packed", "naive"))
    costs = [value(cases, "a", code, 4, key="cost") for code in ("covocp", "packed")]
    return [
        figure("oscillator: relative difference of the cost, covocp and by hand", difference(*costs), most=SAME_COST),
        figure("oscillator: time, covocp / by hand (states)", ratio(ours, by_hand), most=AGAINST_REFERENCE),
        figure("oscillator: time, naive / covocp", ratio(naive, ours), least=AGAINST_NAIVE),
    ]


def judge_size(cases: Sequence[Case], n: int) -> list[Figure]:
    """Part b, one size."""
    name = f"chain, n = {n}"
    ours = value(cases, "b", "covocp", n)
    costs = [value(cases, "b", code, n, key="cost") for code in ("covocp", "eliminated")]
    by_hand = value(cases, "b", "eliminated", n)
    figures = [
        figure(f"{name}: relative difference of the cost, covocp and by hand", difference(*costs), most=SAME_COST),
        figure(f"{name}: time, covocp / by hand (eliminated)", ratio(ours, by_hand), most=AGAINST_REFERENCE),
    ]
    others = {
        "packed": "by hand (states)",
        "packed, one iteration": "one iteration by hand (states)",
        "rockit": "rockit",
    }
    for code, label in others.items():
        if any((case.part, case.code, case.size) == ("b", code, n) for case in cases):
            # Of the one iteration only the solver's time counts: building takes as long again.
            theirs = value(cases, "b", code, n, key="solve" if code.endswith("iteration") else "seconds")
            least = TIMES_AS_LONG.get((code, n), 1.0)
            figures.append(figure(f"{name}: time, {label} / covocp", ratio(theirs, ours), least=least))
    memory = value(cases, "b", "covocp", n, key="memory")
    return [*figures, figure(f"{name}: peak memory of covocp, MB", memory, most=MEMORY)]


def growth(cases: Sequence[Case], sizes: Sequence[int]) -> Figure:
    """Exponent of covocp's time over n, by least squares in logarithms."""
    times = [value(cases, "b", "covocp", n) for n in sizes]
    logarithms = [math.log(time) for time in times if time is not None]
    enough = len(sizes) > 1 and len(logarithms) == len(sizes)
    line = statistics.linear_regression([math.log(n) for n in sizes], logarithms) if enough else None
    return figure(
        f"chain: exponent of covocp's time over n, n = {sizes[0]} to {sizes[-1]}", line and line.slope, most=GROWTH
    )


def judge_building(cases: Sequence[Case]) -> list[Figure]:
    """Part c."""
    figures = []
    for case in cases:
        if case.code == "statement":
            what = f"{case.options['system']}, n = {case.size}: model to frozen statement, s"
            figures.append(figure(what, value(cases, "c", "statement", case.size), most=BUILDING))
    imports = [value(cases, "c", f"import {names}") for names in ("covocp", "casadi, numpy")]
    return [*figures, figure("time of import, covocp / (casadi and numpy)", ratio(*imports), most=IMPORT)]


def judge(cases: Sequence[Case]) -> list[Figure]:
    """All figures of the parts that were measured."""
    parts = {case.part for case in cases}
    figures = judge_oscillator(cases) if "a" in parts else []
    if "b" in parts:
        sizes = sorted({case.size for case in cases if case.part == "b"})
        figures += [figure for n in sizes for figure in judge_size(cases, n)]
        figures.append(growth(cases, [n for n in sizes if n >= GROWTH_FROM]))
    if "c" in parts:
        figures += judge_building(cases)
    return figures
