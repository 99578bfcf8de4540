"""What the measurements tell of a state by themselves: a magnitude of states that are known well where they start."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from covocp.base.matrices import Array, stacked
from covocp.base.quadrature import gauss_transition
from covocp.statement.interval import repeated
from covocp.statement.statement import Statement
from covocp.transcription.trajectory import Trajectory

# Places of the horizon, after the first one, at which the information is looked at.
PLACES = 16
# Size of a control that nothing tells, at most.
LARGEST_UNIT = 1e7


def estimated_rows(statement: Statement) -> dict[int, int]:
    """Rows of the augmented state by entry of the state; constants to be chosen and what is known exactly have none."""
    rows = {name: row for row, name in enumerate(statement.augmented)}
    return {k: rows[name] for k, name in enumerate(statement.state_names) if name in rows}


def resolutions(statement: Statement, along: Trajectory, parameters: Array) -> Array:
    """Standard deviations to which all measurements of the horizon tell each initial state, were it alone unknown.

    1/sqrt(G_ii) of the observability Gramian, the integral of Phi' W Phi and the sum of Phi' H' R^-1 H Phi over the
    instants, with the drift F of the start. A nominal that moves less tells no more than one that rests. What is more
    than controls of their own sizes move the state is not known: the sensor sees next to nothing from the start.

    Returns:
        Shape (nx,), inf where nothing sees a state or where that is not known.
    """
    result = np.full(statement.nx, np.inf)
    forms = [f for b, f in zip(statement.matrices, statement.riccati, strict=True) if b.estimation and f is not None]
    if not forms or statement.coupled or not np.isfinite(along.x).all():
        return result
    count = PLACES + 1
    x, u, times, duration = _points(along, np.arange(count))
    rest = repeated(duration, parameters, count)
    drifts, _, informations = (stacked(v, count) for v in forms[0].map(count)(x.T, u.T, times[None], *rest))
    drift = drifts[0]
    if not np.isfinite(drift).all():
        return result
    with np.errstate(all="ignore"):  # an unstable plant overflows: what grows so is seen
        part = drift * along.duration / PLACES
        step = gauss_transition([part, part], np.eye(len(drift)), np.linalg.solve)
        moved = [np.eye(len(drift))]
        for _ in range(PLACES):
            moved.append(step @ moved[-1])
        seen = np.einsum("pji,pji->i", moved, informations @ np.array(moved)) * along.duration / PLACES
        for place, rows, variance in _read(statement, along, parameters):
            read = rows @ moved[place]
            seen += np.sum(read * np.linalg.solve(variance, read), axis=0)
        reached = _reached(statement, _points(along, 0), parameters, np.array(moved) * along.duration / PLACES)
        for k, row in estimated_rows(statement).items():
            resolved = seen[row] ** -0.5 if seen[row] > 0 else np.inf
            result[k] = resolved if resolved <= reached[row] else np.inf
    return result


def _reached(statement: Statement, start: tuple[Any, ...], parameters: Array, moved: Array) -> Array:
    """How far controls of their own sizes move each row of the augmented state, by its slopes at the start.

    Half the range between bounds, a scale that is given, or the guess; where nothing tells a size, the largest unit.
    """
    x, u, time, duration = start
    lower, upper = statement.control_bounds
    sizes = np.where(u == 0, LARGEST_UNIT, np.abs(u))
    for block in statement.controls:
        sizes[block.span] = statement.scales.get(block.name, sizes[block.span])
    sizes = np.where(np.isfinite(upper - lower), 0.5 * (upper - lower), sizes)
    assert statement.nominal is not None
    rest = (time, duration, parameters)
    rate, *others = (
        np.asarray(statement.nominal(x, u + change, *rest)[0].full()).ravel()
        for change in (np.zeros(u.size), *np.diag(sizes))
    )
    pushed = np.zeros((moved.shape[1], u.size))
    for k, row in estimated_rows(statement).items():
        pushed[row] = [other[k] - rate[k] for other in others]
    return np.asarray(np.abs(moved @ pushed).sum(axis=(0, 2)))


def _read(statement: Statement, along: Trajectory, parameters: Array) -> Iterator[tuple[int, Array, Array]]:
    """Of each measurement at each of its instants: the place, rows of the Jacobian H, and the variance R."""
    samples = statement.samples
    if samples is None:
        return
    for block, instants in zip(samples.blocks, samples.places, strict=True):
        for instant in instants:
            place = round(instant * PLACES)
            _, jacobian, variance = (v.full() for v in samples.measurement(*_points(along, place), parameters))
            yield place, jacobian[block.span], variance[block.span, block.span]


def _points(along: Trajectory, places: Any) -> tuple[Any, Any, Any, float]:
    """States, controls, times and the duration near one of the places of a trajectory, or some of them."""
    shares = places / PLACES
    x, u = (values[np.rint(shares * (values.shape[0] - 1)).astype(int)] for values in (along.x, along.u))
    return x, u, shares * along.duration, along.duration
