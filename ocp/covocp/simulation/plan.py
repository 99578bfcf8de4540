"""What simulating some runs takes, ready to be sent to another process: CasADi functions and tables of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.geometry import Geometry
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.simulation.constraints import Place, Row, counted_rows
from covocp.simulation.flown import Flown, sample_indices
from covocp.simulation.run_parts import Setting, factor, run_symbols
from covocp.simulation.run_step import finish_function, observe_function, read_function, start_of, step_function
from covocp.simulation.schedule import Grid, coefficients, indices, readings_of, table


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """All that a worker needs for any range of runs; the functions are those of `run_step`.

    step: (state of a run, noise, own unknowns, coefficients of the step) -> state after it, deviation and estimate.
    read: the same of steps of no length, at which something is read; None where nothing is.
    observe: (state, unknowns, coefficients at a time) -> deviation, its estimate, deviation of the control, flags.
    finish: (state, unknowns) -> terminal cost of the run; None without an expected cost.
    steps: coefficients, a row for each step; reads: which of them have no length: nothing moves; times: at which they
        start [s].
    stored: indices of the times at which moments are kept; stored_coefficients: a row for each of them.
    start: state of a run that starts at its mean; unknowns: their mean; motion: how x moves.
    spread: factor of the covariance of the start, (n, n).
    domain: largest deviations and estimates that count as inside, (2n,).
    spans: where the parts of a run's state lie.
    noises: normal numbers that a step takes; states: rows of its error; fed_back: controls m.
    seed: of all runs; pilot: whether these runs are for choosing the step, with random numbers of their own.
    pairing: of which two noises of its halves each noise of a step is the sum, (noises, 2); None: it is none.
    paths: number of runs whose histories are kept.
    flown: the law of the user; samples: indices of the times at which it is stepped.
    watched: the place of each inequality; once: of those at an instant which of `stored` it is, else -1.
    """

    step: ca.Function
    read: ca.Function | None
    observe: ca.Function
    finish: ca.Function | None
    steps: Array
    reads: Any
    times: Array
    stored: Any
    stored_coefficients: Array
    start: Array
    unknowns: Array
    motion: Geometry
    spread: Array
    domain: Array
    spans: Mapping[str, slice]
    noises: int
    states: int
    fed_back: int
    seed: int
    pilot: bool
    pairing: Any
    paths: int
    flown: Flown | None
    samples: Any
    watched: tuple[Place, ...]
    once: Any

    __repr__ = short_repr

    @property
    def estimates(self) -> bool:
        """Whether there are estimates."""
        return self.flown is None or self.flown.estimates

    @property
    def size(self) -> int:
        """Rows n of the augmented state."""
        return int(self.spread.shape[0])


def make_plan(
    setting: Setting,
    grid: Grid,
    stored: Array,
    *,
    seed: int,
    paths: int = 0,
    pilot: bool = False,
    pairs: bool = False,
) -> Plan:
    """The plan of a simulation.

    Args:
        setting: what is simulated.
        grid: the steps.
        stored: times of theirs at which moments are kept [s].
        seed: of the random numbers.
        paths: number of runs whose histories are kept.
        pilot: whether the runs are for choosing the step.
        pairs: whether noises are sums of those of two half steps.
    """
    design = setting.design
    chosen = coefficients(design, setting.filter)
    before, after = table(setting.solution, grid, chosen)
    varying = np.flatnonzero(((before != before[0]) | (after != before[0])).any(axis=0))
    watched, at = counted_rows(design), indices(grid, stored)
    lengths = np.hstack([grid.h[:, None], readings_of(setting.solution, grid).T])
    run = run_symbols(setting, chosen, len(watched.at("path")), watched.sums)
    return Plan(
        step=step_function(run, before[0], varying),
        read=read_function(run, before[0], varying),
        observe=observe_function(run),
        finish=finish_function(run),
        steps=np.hstack([before[:, varying], after[:, varying], lengths]),
        reads=grid.share > 0,
        times=grid.t[:-1],
        stored=at,
        stored_coefficients=np.vstack([before, after[-1:]])[at],
        start=start_of(run),
        unknowns=setting.actual.start[design.entries :],
        motion=design.motion,
        spread=np.asarray(factor(ca.DM(setting.actual.variance)).full()),
        # An unknown is what it is: only its estimate can run away.
        domain=np.concatenate([setting.domain[: design.states], np.full(design.unknowns, np.inf), setting.domain]),
        spans=run.spans,
        noises=run.noises,
        states=design.states,
        fed_back=design.fed_back,
        seed=seed,
        pilot=pilot,
        pairing=run.pairing if pairs else None,
        paths=paths,
        flown=setting.flown,
        samples=sample_indices(setting.flown, grid),
        watched=tuple(row.place for row in watched.rows),
        once=np.array([_once(row, grid.t[at]) for row in watched.rows], dtype=int),
    )


def _once(row: Row, stored: Array) -> int:
    """Which of the stored times an inequality at an instant is looked at; -1 where it is none of them."""
    found = row.among(stored) if row.place == "inside" else None
    return -1 if found is None else found
