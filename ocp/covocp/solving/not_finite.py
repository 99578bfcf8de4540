"""A run along given controls that is not finite: of the model, or of steps that are too long for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np

from covocp.base.buffered import Buffered
from covocp.base.errors import ProblemError
from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.mesh_error import mesh_error
from covocp.transcription.mesh import LARGEST_SUBSTEPS, Options

# Error of an integration that chooses its own steps, relative; calls of the model it may take; what counts as infinite.
ACCURACY, MOST_CALLS, INFINITE = 1e-6, 50_000, 1e100
# Largest relative error of the cost of a run with the shortest steps that is taken for one.
TAKEN = 1e-2
TOO_LONG = (
    "the integration steps are too long for the model, which stays finite along this nominal: take more intervals "
    "(grid= where it is fast), substeps= or step='rodas'"
)
NOT_KNOWN = (
    "the run becomes NaN or inf along this nominal; whether by the model or by steps that are too long is not known: "
    "try more intervals, substeps= or step='rodas'"
)


class _EnoughError(Exception):
    """The model was called so often that it is not known where it goes."""


def ends_at(extremal: Extremal) -> float:
    """The time [s] up to which the nominal is finite where the length of each step follows from its error.

    Args:
        extremal: a trajectory whose controls and initial state count, of a nominal that does not depend on matrices.

    Returns:
        The duration where it is finite all the way; NaN where the model would have to be called too often to know.
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
    size = ACCURACY * 1e-3 * max(float(np.abs(x).max(initial=0.0)), 1e-6)
    with np.errstate(all="ignore"):
        for begin, end in zip(extremal.time[:-1], extremal.time[1:], strict=True):  # rates may jump at a node
            if end <= begin:
                continue
            solver = LSODA(rates, begin, x, end, rtol=ACCURACY, atol=size)
            try:
                while solver.status == "running":
                    solver.step()
                    if not np.isfinite(solver.y).all() or np.abs(solver.y).max(initial=0.0) > INFINITE:
                        return known
                    known = float(solver.t)
            except _EnoughError:
                return float(np.nan)
            except ValueError:  # scipy's, of numbers that are none
                return known
            if solver.status == "failed":
                return known
            x = solver.y
    return t.duration


def with_shortest_steps(outcome: Outcome, options: Options, run: Callable[[Options], Outcome]) -> Outcome:
    """A run that is not finite once more with as many steps as there may be; else why it is not.

    Args:
        outcome: of the run; as it is where the nominal is finite.
        options: of its mesh.
        run: with other options.
    """
    extremal = outcome.extremal
    st, duration = extremal.statement, extremal.trajectory.duration
    if st.coupled or st.nominal is None or np.isfinite(extremal.trajectory.x).all():
        return outcome
    end = ends_at(extremal)
    if np.isnan(end):
        return replace(outcome, message=NOT_KNOWN)
    if end < duration:
        return replace(outcome, message=f"{outcome.message}, at t = {end:.4g} s")
    least, best = TAKEN, outcome
    for step in ("rodas", "rk4") if options.substeps == "auto" else ():
        try:
            found = run(replace(options, step=step, substeps=LARGEST_SUBSTEPS))
        except ProblemError:  # steps of this kind are too long as they are at the start
            continue
        error = mesh_error(found.extremal, found.cost_terms["running"]) if found.converged else np.inf
        if error < least:
            least, best = error, found
    return best if best is not outcome else replace(outcome, message=TOO_LONG)
