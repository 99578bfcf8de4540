"""Where the model changes along a trajectory within the integration steps faster than these and their halves see.

Steps meet the time at regular places, those of half the length at others as regular: whatever has so many periods in
a step that all of them meet it at one place of its period is a constant to both, and what is not a sine, such as a
table, a pulse or a square wave, is to as many steps a period as they like. So the model is met at irregular places
too, and compared with what is known from the regular ones.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.dense_output import mapped
from covocp.extremal.extremal import Extremal
from covocp.extremal.turns import may_turn_often
from covocp.statement.interval import one_sided, repeated
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Trajectory

# Shares of a step at which it and its halves, by the classical Runge-Kutta method, meet the time.
REGULAR = np.array([one_sided(0.0), 0.25, 0.5, 0.75, one_sided(1.0)])
# Irregular places of a step, one in each of so many equal parts of it; in which share of a part follows from both
# numbers, of the step and of the part, by irrational ones, so that it is another one in each and no period fits.
PLACES, BY_STEP, BY_PART = 8, (np.sqrt(5.0) - 1.0) / 2.0, np.sqrt(2.0) - 1.0
# So many steps are looked at, 256 points, before all of them where the model depends on the time through states and
# controls alone: what is fast with these is seldom so for a moment.
SAMPLED = 19
# At so many places in all the model is something else than the parabolas through what halves of the steps meet: a jump
# and a kink have a few, of which halves tell, a period that they do not see has nearly all.
MISSED = 10
# What passes no value more often than this along a line is not looked at: with four humps, or eight jumps, steps were
# right or told with and without it in 250 problems of one to eleven.
FEW = 8
# It is something else by more than the first share of what changes in the step (a sine from two steps and a half a
# period on is none), the second of what changes in the mean step, and roundoff.
ELSE, COUNTS, ROUNDOFF = 0.02, 1e-3, 1e-9


def changes_within_steps(extremal: Extremal) -> bool:
    """Whether rates or running cost change along a trajectory as halves of its steps need not see.

    States and matrices go straight from node to node: what is said is nothing of how the steps are suited to a stiff
    plant, which halves tell, and needs no more than values of the model.

    Args:
        extremal: a trajectory.
    """
    st = extremal.statement
    if st.autonomous and not _turns(st):
        return False
    return _changes(st, extremal.mesh, extremal.trajectory, tuple(extremal.parameters.tolist()))


@lru_cache(maxsize=KEPT)
def _turns(statement: Statement) -> bool:
    """Whether something in the model may rise and fall more than a few times as states and controls move.

    The rates of covariances are made of their forms, which are read in a tenth of the time.
    """
    rates, nominal, forms = statement.rates, statement.nominal, statement.riccati
    functions = [rates]
    if nominal is not None and all(form is not None for form in forms):
        running = rates.factory("running", rates.name_in(), [rates.name_out(2)])
        functions = [nominal, running, *(form for form in forms if form is not None)]
    return any(may_turn_often(own, FEW, (own.n_in() - 2, own.n_in() - 1)) for own in functions)


@lru_cache(maxsize=4)
def _changes(statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: tuple[float, ...]) -> bool:
    steps = np.arange(float(mesh.substeps * np.count_nonzero(np.diff(mesh.nodes) > 0.0)))
    given = statement, mesh, trajectory, np.array(parameters)
    some = steps[np.arange(SAMPLED) * steps.size // SAMPLED]
    if statement.autonomous and steps.size > SAMPLED and not _missed(*given, some):
        return False
    return _missed(*given, steps) >= MISSED


def _missed(statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: Array, steps: Array) -> int:
    """At how many irregular places of some steps a rate or the running cost is something else: the most of one row."""
    shares = _shares(steps)
    with np.errstate(over="ignore", invalid="ignore"):
        values = _values(statement, mesh, trajectory, parameters, shares)
        finite = np.isfinite(values).all(axis=(1, 2))  # a model without a value there: the steps tell
        values, shares = values[finite], shares[finite]
        if not values.size:
            return 0
        change = np.ptp(values, axis=1)
        least = np.maximum(COUNTS * change.mean(axis=0), ROUNDOFF * np.abs(values).max(axis=(0, 1)))
        known, places = values[:, : REGULAR.size], shares[:, REGULAR.size :]
        off = np.abs(values[:, REGULAR.size :] - _parabolas(known, places))
        return int((off > np.maximum(ELSE * change, least)[:, None]).sum(axis=(0, 1)).max())


def _shares(steps: Array) -> Array:
    """Shares of steps, the number of each before them: the regular places, then the others; (steps, places)."""
    part = np.arange(PLACES)
    places = (part + (BY_STEP * steps[:, None] + BY_PART * part) % 1.0) / PLACES
    return np.asarray(steps[:, None] + np.hstack([np.tile(REGULAR, (steps.size, 1)), places]))


def _parabolas(known: Array, shares: Array) -> Array:
    """Values at some places of each step of the parabolas through the regular ones, one in each half of it."""
    c = 2.0 * (shares % 1.0)
    half = np.minimum(c.astype(np.intp), 1)
    c = (c - half)[..., None]
    step = np.arange(known.shape[0])[:, None]
    begin, middle, end = (known[step, 2 * half + i] for i in range(3))
    return np.asarray((1 - c) * (1 - 2 * c) * begin + 4 * c * (1 - c) * middle + c * (2 * c - 1) * end)


def _values(statement: Statement, mesh: Mesh, t: Trajectory, parameters: Array, shares: Array) -> Array:
    """Rates and running cost at these places, (steps, places, rows)."""
    nodes = mesh.nodes
    step = np.floor(shares[:, 0]).astype(np.intp)
    k = np.repeat(np.flatnonzero(np.diff(nodes) > 0.0)[step // mesh.substeps], shares.shape[1])
    c = ((step % mesh.substeps)[:, None] + shares - step[:, None]).ravel() / mesh.substeps

    def between(values: Array) -> Array:
        return np.asarray((values[k] + c[:, None] * (values[k + 1] - values[k])).T)

    controls = t.u[k].T if mesh.control == "constant" else between(t.u)
    times = t.duration * (nodes[k] + c * np.diff(nodes)[k])[None, :]
    along = (between(t.x), controls, between(t.e), times)
    values = np.vstack(mapped(statement.rates, *along, *repeated(t.duration, parameters, k.size)))
    return values.T.reshape(*shares.shape, -1)
