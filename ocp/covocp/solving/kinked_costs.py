"""Expected costs with kinks in what scatters: second derivatives along the nominal do not see them."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import warn_user
from covocp.base.kinks import MOSTLY_SMOOTH, kinks
from covocp.problem.declarations import Declarations


def mention_kinks(problem: Declarations, phase: str = "") -> None:
    """Warn of an expected cost that has kinks or jumps in states or unknowns that scatter.

    Args:
        problem: with `minimize_expected`, or another one.
        phase: its name where it is one of several: what scatters there may come from another one.
    """
    if problem.expected is None:
        return
    scattering = problem.augmented if phase else _scattering(problem)
    entries = [entry for entry in scattering if getattr(entry, "chart", None) is None]  # attitudes have own pieces
    of = f" of the phase '{phase}'" if phase else ""
    for what, cost in (("running", problem.expected.running), ("terminal", problem.expected.terminal)):
        found = kinks(cost, [entry.symbol for entry in entries]) - MOSTLY_SMOOTH
        if not found:
            continue
        names = [f"'{entry.name}'" for entry in entries if kinks(cost, [entry.symbol]) - MOSTLY_SMOOTH]
        warn_user(
            f"The expected {what} cost{of} has kinks or jumps in {' and '.join(names)}: {', '.join(sorted(found))}. "
            "What deviations cost is had from its second derivatives along the nominal, which do not see them: near "
            "them it is wrong. Write a smooth form, s being about the standard deviation: sqrt(x**2 + s**2) for "
            "abs(x), (x + sqrt(x**2 + s**2))/2 for fmax(x, 0), (1 + tanh(x/s))/2 for x > 0; a table of kind='cubic'."
        )


def _scattering(problem: Declarations) -> list[Any]:
    """States and unknowns that are uncertain, or that something uncertain or the feedback moves."""
    noises = {name: entry.noise for name, entry in problem.rates.items() if entry.noise is not None}
    scattered = {
        entry.symbol.__hash__()
        for entry in problem.augmented
        if not (_is_zero(entry.variance) and _is_zero(noises.get(entry.name, ca.MX(0))))
    }
    if scattered:  # what is uncertain is fed back
        scattered |= {entry.symbol.__hash__() for entry in problem.controls}
    size = 0
    while size < len(scattered):
        size = len(scattered)
        for entry in problem.augmented:
            rate = problem.rates[entry.name].rate if entry.name in problem.rates else ca.MX(0)
            if scattered & {symbol.__hash__() for symbol in ca.symvar(rate)}:
                scattered.add(entry.symbol.__hash__())
    return [entry for entry in problem.augmented if entry.symbol.__hash__() in scattered]


def _is_zero(value: Any) -> bool:
    """Whether an expression is zero whatever the parameters."""
    return bool(value.is_constant()) and not np.any(ca.evalf(value).full())
