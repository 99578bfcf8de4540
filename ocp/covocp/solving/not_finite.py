"""A run along given controls that is not finite or goes astray: by the model, or by steps that are too long for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np

from covocp.base.buffered import Buffered
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.given_controls import NOT_FINITE
from covocp.extremal.mesh_error import mesh_error
from covocp.extremal.step_order import moved_by_halves
from covocp.transcription.first_guess import diverges
from covocp.transcription.mesh import LARGEST_SUBSTEPS, Options

# Error of an integration that chooses its own steps, relative; calls of the model it may take; what counts as infinite.
ACCURACY, MOST_CALLS, INFINITE = 1e-6, 50_000, 1e100
# Largest relative error of the cost of a run with the shortest steps that is taken for one.
TAKEN = 1e-2
# Ranges of a state by which halving the steps moves it where a run is doubted, and where it grows beyond all that is
# known of it; by which a run is then astray.
DOUBTED, GROWN, ASTRAY = 1e3, 0.1, 1.0
TOO_LONG = "the integration steps are too long for the model, which stays finite along this nominal"
UNSURE = (
    "with integration steps of half the length a state, a covariance or the cost becomes NaN or inf along this "
    "nominal: take more intervals or substeps="
)
NOT_KNOWN = (
    "the run becomes NaN or inf along this nominal; whether by the model or by steps that are too long is not known: "
    "try more intervals, substeps= or step='rodas'"
)


class _EnoughError(Exception):
    """The model was called so often that it is not known where it goes."""


@dataclass(frozen=True, kw_only=True)
class _Followed:
    """The nominal where the length of each step follows from its error.

    Attributes:
        end: time [s] up to which it is finite: the duration where it is so all the way; NaN where the model would have
            to be called too often to know.
        states: at the nodes, (N + 1, nx); NaN from where on it is not known.
    """

    end: float
    states: Array

    __repr__ = short_repr


def _followed(extremal: Extremal) -> _Followed:
    """The nominal by steps that are as short as they must be.

    Args:
        extremal: a trajectory whose controls and initial state count, of a nominal that does not depend on matrices.
    """
    from scipy.integrate import LSODA  # here: few runs are lost, and importing covocp must not take long

    st, t, p = extremal.statement, extremal.trajectory, extremal.parameters
    assert st.nominal is not None
    arguments = [ca.MX.sym(name, size) for name, size in (("x", st.nx), ("u", st.nu), ("t", 1), ("T", 1), ("p", st.np))]
    call = Buffered(ca.Function("rates", arguments, [ca.densify(st.nominal(*arguments)[0])]))
    calls = 0

    def rates(time: float, x: Array) -> Array:
        nonlocal calls
        calls += 1
        if calls > MOST_CALLS:
            raise _EnoughError
        u = extremal.controls_at(np.array([min(max(time / t.duration, 0.0), 1.0)]))[0]
        found = call(x, u, np.array([time]), np.array([t.duration]), p)
        return np.full(st.nx, np.nan) if found is None else found[0]

    known, x = 0.0, t.x[0]
    states = np.full((extremal.time.size, st.nx), np.nan)
    states[0] = x
    size = ACCURACY * 1e-3 * max(float(np.abs(x).max(initial=0.0)), 1e-6)
    with np.errstate(all="ignore"):
        for k, (begin, end) in enumerate(pairwise(extremal.time), start=1):  # rates may jump at a node
            if end > begin:
                solver = LSODA(rates, begin, x, end, rtol=ACCURACY, atol=size)
                try:
                    while solver.status == "running":
                        solver.step()
                        if not np.isfinite(solver.y).all() or np.abs(solver.y).max(initial=0.0) > INFINITE:
                            return _Followed(end=known, states=states)
                        known = float(solver.t)
                except _EnoughError:
                    return _Followed(end=float("nan"), states=states)
                except ValueError:  # scipy's, of numbers that are none
                    return _Followed(end=known, states=states)
                if solver.status == "failed":
                    return _Followed(end=known, states=states)
                x = solver.y
            states[k] = x
    return _Followed(end=t.duration, states=states)


def with_shortest_steps(outcome: Outcome, options: Options, run: Callable[[Options], Outcome]) -> Outcome:
    """A run that is not finite or goes astray once more with as many steps as there may be; else why it does.

    A run is looked at that is not finite, or that shorter steps would not leave finite or take far away; what it costs
    says nothing, and it does not count as evaluated, unless its states are those of the model.

    Args:
        outcome: of the run.
        options: of its mesh.
        run: with other options.
    """
    extremal = outcome.extremal
    st, duration = extremal.statement, extremal.trajectory.duration
    moved = moved_by_halves(extremal) if outcome.converged else np.inf
    if moved <= DOUBTED and not (moved > GROWN and _grown(extremal)):
        return outcome
    if st.coupled or st.nominal is None:
        return _without_value(outcome, UNSURE) if outcome.converged and not np.isfinite(moved) else outcome
    followed = _followed(extremal)
    lost = not np.isfinite(moved)
    if np.isnan(followed.end):
        return _without_value(outcome, NOT_KNOWN) if lost else outcome
    if followed.end < duration:
        return _without_value(outcome, f"{NOT_FINITE}, at t = {followed.end:.4g} s") if lost else outcome
    astray = _astray(extremal, followed.states)
    if not astray:
        return _without_value(outcome, UNSURE) if lost and outcome.converged else outcome
    least, best = TAKEN, outcome
    for step in ("rodas", "rk4") if options.substeps == "auto" else ():
        try:
            found = run(replace(options, step=step, substeps=LARGEST_SUBSTEPS))
        except ProblemError:  # steps of this kind are too long as they are at the start
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            error = mesh_error(found.extremal, found.cost_terms["running"]) if found.converged else np.inf
        if error < least:
            least, best = error, found
    if best is not outcome:
        return best
    others = "or substeps=" if options.step == "rodas" else "substeps= or step='rodas'"
    grid = "take more intervals (grid= where it is fast)"
    remedy = f"{grid} {others}" if options.step == "rodas" else f"{grid}, {others}"
    return _without_value(outcome, f"{TOO_LONG} ({astray}): {remedy}")


def _grown(extremal: Extremal) -> bool:
    """Whether a state grows beyond all that is known of it."""
    return diverges(extremal.trajectory.x, extremal.statement.boundary_values(extremal.parameters)[1])


def _without_value(outcome: Outcome, message: str) -> Outcome:
    """An outcome whose numbers say nothing, with the reason."""
    return replace(outcome, converged=False, message=message, violations={})


def _astray(extremal: Extremal, states: Array) -> str:
    """Where a run is first astray from the states at the nodes that are right, (N + 1, nx), in words; "" nowhere."""
    x, names = extremal.trajectory.x, extremal.statement.state_names
    size = np.abs(states).max(axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(x - states) / np.where(size > 0.0, size, 1.0)
    off = np.where(np.isfinite(x), off, np.inf)
    rows = np.flatnonzero((off > ASTRAY).any(axis=1))
    if not rows.size:
        return ""
    k = int(rows[0])
    i = int(off[k].argmax())
    return f"at t = {extremal.time[k]:.4g} s '{names[i]}' is {x[k, i]:.3g} in place of {states[k, i]:.3g}"
