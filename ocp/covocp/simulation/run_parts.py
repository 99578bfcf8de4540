"""Symbols of one run, and the pieces that its steps are made of, whichever filter flies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.geometry import Geometry
from covocp.base.matrices import Array, half_length
from covocp.base.short_repr import short_repr
from covocp.simulation.actual import Linearised, Read, System
from covocp.simulation.flown import Flown
from covocp.simulation.schedule import Coefficients, Estimator
from covocp.solution.solution import Solution

# A pivot of a factorisation counts as zero below this share of its diagonal entry.
PIVOT = 1e-12
# What stands for nothing read: comparisons with NaN are simplified away in expressions.
UNREAD = 1e300


@dataclass(frozen=True, kw_only=True, eq=False)
class Limits:
    """Limits of the fed-back controls, (m,) each.

    lower, upper: what the actual control can do. least, most: what counts as all that there is; the same, or the bounds
    of the problem where the actual control has no limits.
    """

    lower: Array
    upper: Array
    least: Array
    most: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Setting:
    """What is simulated: the solution, both systems, the kind of filter, limits of the control, domain.

    domain: largest deviations, of the actual system and of the estimate, that count as inside, (n,).
    flown: the law, where it is that of the user.
    """

    solution: Solution
    design: System
    actual: System
    filter: Estimator
    limits: Limits
    domain: Array
    flown: Flown | None = None

    __repr__ = short_repr

    @property
    def costs(self) -> bool:
        """Whether a run has a cost: where the expected one was minimised."""
        return self.design.statement.loop is not None


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """Symbols of one run, and where the parts of its state lie.

    z: the state; own: its unknowns. spans: "x", "estimate", "E" (of the extended filter), "measured" (what a law has
    measured since its last step, an integral), "sums" (integrals that were declared), "cost", "asked" and "violated"
    (flags), "held" (control of a law), "read" (what a law has read since its last step, UNREAD where nothing).
    noisy: states with process noise; watched: number of inequalities along the path; sums: where the integrals lie in
    the state of the problem.
    """

    setting: Setting
    coefficients: Coefficients
    symbolic: Any
    z: Any
    own: Any
    spans: Mapping[str, slice]
    noisy: list[int]
    watched: int
    sums: tuple[int, ...] = ()

    __repr__ = short_repr

    @property
    def parts_of_noise(self) -> list[int]:
        """Where the noises of the motion, of the measurement of both halves and of what is read begin, and the end."""
        measured, motion, read = self.setting.design.measured, len(self.noisy), self.setting.design.sampled
        return [0, motion, motion + measured, motion + 2 * measured, motion + 2 * measured + read]

    @property
    def noises(self) -> int:
        """Number of normal numbers that a step takes."""
        return self.parts_of_noise[-1]

    @property
    def pairing(self) -> Array:
        """For each noise of a step the two noises of its halves that it is the sum of, (noises, 2), these stacked."""
        motion, early, late, read = (
            np.arange(i, j) for i, j in zip(self.parts_of_noise, self.parts_of_noise[1:], strict=False)
        )
        first = np.concatenate([motion, early, self.noises + early, read])
        second = np.concatenate([self.noises + motion, late, self.noises + late, self.noises + read])
        return np.stack([first, second], axis=1)

    @property
    def moving(self) -> slice:
        """The part of the state that has a rate."""
        return slice(0, self.spans["cost"].stop)

    @property
    def geometry(self) -> Geometry:
        """How that part moves."""
        design = self.setting.design
        estimate: Geometry | int = design.geometry if self.setting.filter == "extended" else design.size
        rest = self.moving.stop - self.spans["estimate"].stop
        return Geometry.stacked(design.motion, estimate, rest)


def run_symbols(setting: Setting, coefficients: Coefficients, watched: int = 0, sums: tuple[int, ...] = ()) -> Run:
    """Symbols of a run; watched: number of inequalities along its path; sums: entries of its integrals."""
    design, actual = setting.design, setting.actual
    scalar = design.statement.symbolic is ca.SX and actual.statement.symbolic is ca.SX
    symbolic: Any = ca.SX if scalar else ca.MX
    noise = actual.linear.sparsity_out("Q")
    sizes = {
        "x": design.entries,
        "estimate": design.start.size if setting.filter == "extended" else design.size,
        "E": half_length(design.size) if setting.filter == "extended" else 0,
        "measured": design.measured if setting.flown else 0,
        "sums": len(sums),
        "cost": int(setting.costs),
        "asked": design.fed_back,
        "violated": watched,
        "held": design.fed_back if setting.flown else 0,
        "read": design.sampled if setting.flown else 0,
    }
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return Run(
        setting=setting,
        coefficients=coefficients,
        symbolic=symbolic,
        z=symbolic.sym("z", ends[-1]),
        own=symbolic.sym("own", design.unknowns),
        spans={name: slice(i, j) for name, i, j in zip(sizes, ends[:-1], ends[1:], strict=True)},
        noisy=[i for i in range(design.states) if noise.has_nz(i, i)],
        watched=watched,
        sums=sums,
    )


def factor(covariance: Given) -> Any:
    """Lower triangular L with L L' = covariance, DM, SX or MX; the columns of zero pivots are zero."""
    size = covariance.shape[0]
    L: list[list[Any]] = [[0.0] * size for _ in range(size)]
    for j in range(size):
        pivot = covariance[j, j] - sum(L[j][k] ** 2 for k in range(j))
        inverted = ca.if_else(pivot > PIVOT * covariance[j, j], 1 / ca.sqrt(pivot), 0)
        for i in range(j, size):
            L[i][j] = (covariance[i, j] - sum(L[i][k] * L[j][k] for k in range(j))) * inverted
    return ca.vertcat(*(ca.horzcat(*row) for row in L))


def system_at(
    run: Run, system: System, augmented: tuple[Any, Any], u: Given, c: dict[str, Any], t: Given = None
) -> Linearised:
    """What `System.model` gives for a state and unknowns; rows that no run has are those of the nominal."""
    x, unknowns = augmented
    design, parameters = run.setting.design, system.parameters
    state = part(ca.vertcat(x, part(c["x"], design.entries)), 0, system.statement.nx)
    known = ca.DM(parameters[: parameters.size - system.unknowns])
    time = c["t"] if t is None else t
    duration = run.setting.solution.duration
    return system.model(state, part(u, 0, system.statement.nu), time, duration, ca.vertcat(known, unknowns))


def read_at(run: Run, system: System, augmented: tuple[Any, Any], u: Given, c: dict[str, Any]) -> Read:
    """What `System.read` gives for a state and unknowns, as `system_at` does."""
    x, unknowns = augmented
    state = part(ca.vertcat(x, part(c["x"], run.setting.design.entries)), 0, system.statement.nx)
    known = ca.DM(system.parameters[: system.parameters.size - system.unknowns])
    control, duration = part(u, 0, system.statement.nu), run.setting.solution.duration
    return system.read(state, control, c["t"], duration, ca.vertcat(known, unknowns))


def part(column: Given, first: int, last: int | None = None) -> Any:
    """Some rows of a column; (0, 1) where there are none, which slicing a single number does not give."""
    size = int(column.shape[0])
    return ca.vertsplit(column, [0, first, size if last is None else last, size])[1]


def replaced(column: Given, rows: slice, values: Given) -> Any:
    """A column with other values in some rows."""
    return ca.vertcat(part(column, 0, rows.start), values, part(column, rows.stop))


def estimated_deviation(run: Run, z: Given, c: dict[str, Any]) -> Any:
    """The estimate of the deviation from the nominal, (n,)."""
    estimate = z[run.spans["estimate"]]
    if run.setting.filter != "extended":
        return estimate
    return run.setting.design.geometry.difference(estimate, nominal_column(run, c))


def nominal_column(run: Run, c: dict[str, Any]) -> Any:
    """The augmented state of the nominal."""
    design = run.setting.design
    return ca.vertcat(part(c["x"], 0, design.entries), ca.DM(design.start[design.entries :]))


def deviations(run: Run, z: Given, c: dict[str, Any]) -> Any:
    """Deviation from the nominal and the filter's estimate of it, (2n,)."""
    actual = ca.vertcat(z[run.spans["x"]], run.own)
    moved = run.setting.design.geometry.difference(actual, nominal_column(run, c))
    return ca.densify(ca.vertcat(moved, estimated_deviation(run, z, c)))


def control_of(run: Run, z: Given, c: dict[str, Any]) -> tuple[Any, Any]:
    """The control that the feedback asks for, and the one that there is, both of the fed-back rows."""
    if run.setting.flown:
        asked = part(z, run.spans["held"].start, run.spans["held"].stop)
    else:
        asked = part(c["u"], 0, run.setting.design.fed_back) - c["C"] @ estimated_deviation(run, z, c)
    limits, applied = run.setting.limits, []
    for i, (low, high) in enumerate(zip(limits.lower.tolist(), limits.upper.tolist(), strict=True)):
        value = ca.fmax(asked[i], low) if np.isfinite(low) else asked[i]
        applied.append(ca.fmin(value, high) if np.isfinite(high) else value)
    return asked, ca.vertcat(run.symbolic(0, 1), *applied)


def estimate_of(run: Run, z: Given) -> tuple[Any, Any]:
    """State and unknowns as the extended filter has them."""
    y, entries = z[run.spans["estimate"]], run.setting.design.entries
    return part(y, 0, entries), part(y, entries)
