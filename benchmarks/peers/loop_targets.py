"""The targets of closed_loop.py, and the judgement of its cases."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cases import Case
from targets import Figure, difference, figure, ratio, value

# Converged costs on fine meshes: Mars with w = 1e-5, section 6.12.
COSTS = {"mars": 5.7667749e-4, "lag": 2.027146}
NAMES = {"mars": "Mars", "lag": "6.12"}
SAME_COST = 1e-4  # relative
COARSE_COST = 5e-3  # the same on a coarse mesh, where covariance steps differ
# Largest time of covocp's F3 over that of the script by hand; least time of that script over that of covocp's default.
# On the lag, a tenth of a second, the checks after the solution weigh as much as the solution: stated only.
AGAINST_HAND: dict[str, float | None] = {"mars": 1.25, "lag": None}
TIMES_AS_LONG: dict[str, float | None] = {"mars": 3.0, "lag": None}
LINEAR = 0.03  # relative error of the linear prediction of Mars's terminal deviations
SAMPLING = 4.0  # standard errors of a sample deviation, which are 1/sqrt(2 runs)


def judge_system(cases: Sequence[Case], part: str, system: str, size: int, reference: bool) -> list[Figure]:
    """Parts a and b; the cost is compared with the reference, or on a coarse mesh with that of the script by hand."""
    name, by_hand = NAMES[system], value(cases, part, "f3", size)
    times = {code: value(cases, part, code, size) for code in ("covocp", "covocp, states")}
    costs = {code: value(cases, part, code, size, key="cost") for code in ("covocp", "covocp, states", "f3")}
    true = COSTS[system] if reference else costs.pop("f3")
    labels = {"covocp": "covocp", "covocp, states": "covocp, F3", "f3": "F3 by hand"}
    against = "the converged one" if reference else "F3 by hand"
    iteration = value(cases, part, "covocp, gradient", size, key="iteration")
    return [
        *[
            figure(
                f"{name}: relative difference of the cost, {labels[code]} and {against}",
                difference(cost, true),
                most=SAME_COST if reference else COARSE_COST,
            )
            for code, cost in costs.items()
        ],
        figure(f"{name}: time, F3 by hand / covocp", ratio(by_hand, times["covocp"]), least=TIMES_AS_LONG[system]),
        figure(
            f"{name}: time, covocp, F3 / F3 by hand", ratio(times["covocp, states"], by_hand), most=AGAINST_HAND[system]
        ),
        figure(f"{name}: time of an iteration of the gradient method, s", iteration),
        *[
            figure(f"{name}: peak memory, {label}, MB", value(cases, part, code, size, key="memory"))
            for code, label in {**labels, "covocp, gradient": "covocp, gradient method"}.items()
        ],
    ]


def spread(cases: Sequence[Case], code: str) -> float | None:
    """Largest relative difference of a sample's terminal deviations from the prediction of the covariances."""
    sample, prediction = (
        next((result for case in cases if case.code == one for result in case.results if key in result), None)
        for one, key in ((code, "rms"), ("covocp, simulate", "predicted"))
    )
    if sample is None or prediction is None:
        return None
    pairs = zip(sample["rms"], prediction["predicted"], strict=True)
    return max(abs(one / other - 1) for one, other in pairs)


def judge_runs(cases: Sequence[Case]) -> list[Figure]:
    """Part c."""
    ours, loop = (next(case for case in cases if case.code == code) for code in ("covocp, simulate", "loop"))
    runs = [case.options["runs"] for case in (ours, loop)]
    times = [value(cases, "c", case.code) for case in (ours, loop)]
    return [
        figure(f"Monte Carlo of Mars: time, {runs[0]} runs by covocp / {runs[1]} in the loop", ratio(*times), most=1.0),
        *[
            figure(
                f"Monte Carlo of Mars: largest relative difference of sample and prediction, {label}",
                spread(cases, case.code),
                most=round(LINEAR + SAMPLING / math.sqrt(2 * count), 3),
            )
            for case, count, label in zip((ours, loop), runs, ("covocp", "the loop"), strict=True)
        ],
        *[
            figure(f"Monte Carlo of Mars: peak memory, {label}, MB", value(cases, "c", code, key="memory"))
            for code, label in (("covocp, simulate", "covocp"), ("loop", "the loop"))
        ],
    ]
