"""Where a run of Ipopt is led away by its cost: it is made again with steps that may violate conditions less.

A cost that is linear in what a condition limits, as an area is in the way round it, has no curvature of its own: the
first steps go so far that the condition, once so far away, leads nowhere back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.solvers.monitor import AWAY
from covocp.solvers.plugins import merged
from covocp.solving.attempts import counted, from_starts, merit_of, with_stats
from covocp.solving.failure import with_stalled

# Shares of the usual largest violation that steps may end at: the filter of Ipopt refuses more.
NEAR = (1e-1, 1e-2)


def kept_near(
    ready: Callable[..., Prepared],
    prepared: Prepared,
    failed: Outcome,
    guesses: Callable[[], Iterable[Guess]],
    reporter: Progress,
    own: Mapping[str, Any],
) -> tuple[Outcome, Prepared]:
    """Solve again with less room for violations where a run without limits has ended far from what it must meet.

    Args:
        ready: makes the program with other options of Ipopt.
        prepared: what ran.
        failed: the outcome of it, by Ipopt.
        guesses: makes the starts anew.
        reporter: of iterations.
        own: options that were given.

    Returns:
        The outcome that converged and what ran, with the iterations of all; else what was given.
    """
    options, values = own.get("plugin_options") or {}, failed.extremal.parameters
    limited = reporter.limited or reporter.stop or "theta_max_fact" in options.get("ipopt", {})
    if failed.converged or limited or not failed.violations:
        return failed, prepared
    violation = merit_of(prepared, values, failed.extremal.trajectory).violation
    if np.isfinite(violation) and violation < AWAY:
        return failed, prepared
    failed = tried = with_stalled(failed, reporter)  # of the iterations of this run, not of all together
    for share in NEAR:
        near = ready(plugin_options=merged(options, {"ipopt": {"theta_max_fact": share}}))
        try:
            again, _ = from_starts(near, values, guesses(), reporter)
        except (CovocpError, RuntimeError):  # the model has no values there; CasADi's
            continue
        tried = with_stats(again, **counted(tried, again))
        if again.converged:
            named = {"method": "ipopt"} if "method" in failed.stats else {}
            return with_stats(tried, **named), near
        if reporter.stop:
            break
    return with_stats(failed, **{name: tried.stats[name] for name in counted(failed, tried)}), prepared
