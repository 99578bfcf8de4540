"""From one phase of a simulation to the next: what jump, appearance and end do to the runs and to the prediction.

The actual system jumps by its own expression J(x, b) at where it is, with noise of the variance that is stated there; a
state or an unknown that appears is drawn about its mean. The perturbation filter passes its estimate of the deviation
by the tangent along the nominal, as the covariance of the design does (E+ = J E J' + N); the extended filter puts its
own estimate into the expression, and its covariance goes by the tangent there.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, half_length, pack_symbolic, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.simulation.actual import System, unknown_rows
from covocp.simulation.batches import Cloud
from covocp.simulation.run_parts import factor, part
from covocp.simulation.schedule import Estimator
from covocp.solution.solution import Solution
from covocp.statement.chain import Link


@dataclass(frozen=True, kw_only=True, eq=False)
class Passage:
    """What linear theory knows of a junction; n, n+: rows of the augmented state before and after.

    tangent: of the actual system along the nominal, (n+, n); believed: that of the design, by which estimates pass.
    offset: by how much the actual system lands beside the nominal with no deviation, (n+,). noise: (n+, n+).
    """

    tangent: Array
    believed: Array
    offset: Array
    noise: Array

    __repr__ = short_repr

    def predicted(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Mean and covariance of deviation and estimate, stacked, after it."""
        none, rows = np.zeros_like(self.tangent), self.noise.shape[0]
        both = np.block([[self.tangent, none], [none, self.believed]])
        moved, carried = both @ covariance @ both.T, both @ mean
        moved[:rows, :rows] += self.noise
        carried[:rows] += self.offset
        return carried, moved


@dataclass(frozen=True, kw_only=True, eq=False)
class Junction:
    """What carries runs and predictions over.

    function: (state, unknowns, estimate, half-vector E of the extended filter, normal numbers) -> the first four after.
    noises: normal numbers of a run. design, actual: what linear theory knows of it for either system.
    """

    function: ca.Function
    noises: int
    design: Passage
    actual: Passage

    __repr__ = short_repr

    def carried(self, cloud: Cloud) -> Cloud:
        """The cloud with which the next phase starts; its noise is drawn from the streams of the runs."""
        runs = len(cloud.streams)
        drawn = np.array([stream.standard_normal(self.noises) for stream in cloud.streams]).reshape(runs, self.noises)
        given = (cloud.x, cloud.own, cloud.estimate, cloud.E, drawn.T)
        values = self.function.map(runs)(*given)
        x, own, estimate, E = (
            np.asarray(value.full()).reshape(self.function.size1_out(i), runs) for i, value in enumerate(values)
        )
        return Cloud(x=x, own=own, estimate=estimate, E=E, gone=cloud.gone, streams=cloud.streams)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ends:
    """The end of a phase and the start of the next one for a system, with its link between them.

    before, after: solutions of the design. earlier, later: the system in both phases. fixed: names of the unknowns that
    have one value in all runs.
    """

    before: Solution
    after: Solution
    earlier: System
    later: System
    link: Link
    fixed: Container[str] = ()

    __repr__ = short_repr

    @property
    def nominal(self) -> tuple[Array, Array]:
        """State and unknowns before it along the nominal, the unknowns at the mean that the system has."""
        return self.before.trajectory.x[-1, : self.earlier.states], self.earlier.start[self.earlier.states :]

    def given(self, state: Any, unknowns: Any, e: Any = None) -> tuple[Any, Any]:
        """Augmented state after the jump from that before it, and E after it from all half-vectors (None: zero).

        Rows that nothing gives are those with which the system starts.
        """
        earlier, end = self.earlier, self.before.trajectory.x[-1]
        whole = ca.vertcat(state, ca.DM(end[earlier.states : earlier.statement.nx]))
        known = ca.vertcat(ca.DM(earlier.parameters[: earlier.parameters.size - earlier.unknowns]), unknowns)
        e = ca.DM.zeros(earlier.statement.ne) if e is None else e
        duration, later = self.before.duration, ca.DM(self.later.parameters)
        values, halves = self.link.function(whole, e, duration, known, later)
        rows = [ca.MX(float(value)) for value in self.later.start]
        for place, entry in enumerate(self.link.states):
            if entry < self.later.states:
                rows[entry] = values[place]
        for row, column in self.same:
            rows[row] = unknowns[column]
        places = [self.link.matrices.index(k) for k in range(self.later.covariance.start, self.later.covariance.stop)]
        drawn = np.ones(self.later.size)
        drawn[[k for k in unknown_rows(self.later, self.fixed) if k not in dict(self.same)]] = 0.0
        return ca.vertcat(*rows), unpack_symbolic(halves[places], self.later.size) * ca.DM(np.outer(drawn, drawn))

    @property
    def same(self) -> list[tuple[int, int]]:
        """Rows of the later augmented state with unknowns that go on, and which ones before."""
        names = self.before.augmented[self.earlier.states :]
        rows = range(self.later.states, self.later.size)
        return [(r, names.index(self.after.augmented[r])) for r in rows if self.after.augmented[r] in names]

    @property
    def noisy(self) -> list[int]:
        """Rows of the later augmented state that may have noise: those that jump, and those that appear."""
        rows = zip(self.link.states, self.link.names, strict=False)  # the names of the matrices follow
        going = {row for row, name in rows if name.startswith("continuity of") and row < self.later.states}
        going |= {row for row, _ in self.same}
        return [row for row in range(self.later.size) if row not in going]


def junction(design: Ends, actual: Ends, kind: Estimator) -> Junction:
    """What carries a simulation from a phase to the next one.

    Args:
        design: both ends for the system that filter and feedback were designed for.
        actual: for the one that flies.
        kind: of the filter.
    """
    earlier, later, noisy = design.earlier, design.later, actual.noisy
    x, own, w = (ca.MX.sym(*a) for a in (("x", earlier.states), ("own", earlier.unknowns), ("w", len(noisy))))
    believed, landed, noise = _along_nominal(design)
    tangent, flown, added = (believed, landed, noise) if actual is design else _along_nominal(actual)
    known = np.concatenate([np.zeros(earlier.states), actual.nominal[1] - design.nominal[1]])
    # Another mean of an unknown stands in the mean of the deviation before, and is taken off here.
    offset = flown - landed - tangent @ known
    moved, N = actual.given(x, own)
    moved = ca.MX(moved)
    if noisy:
        moved[noisy] += factor(N[noisy, noisy]) @ w
    if kind == "extended":
        y, E = ca.MX.sym("y", earlier.size), ca.MX.sym("E", half_length(earlier.size))
        e = ca.MX.zeros(earlier.statement.ne)
        e[earlier.covariance] = E
        estimate, covariance = design.given(part(y, 0, earlier.states), part(y, earlier.states), e)
        outputs = [estimate, pack_symbolic(covariance)]
    else:
        y, E = ca.MX.sym("y", earlier.size), ca.MX.sym("E", 0)
        outputs = [ca.DM(believed) @ y, ca.MX(0, 1)]
    outputs = [part(moved, 0, later.states), part(moved, later.states), *outputs]
    return Junction(
        function=ca.Function("junction", [x, own, y, E, w], [ca.densify(value) for value in outputs]),
        noises=len(noisy),
        design=Passage(tangent=believed, believed=believed, offset=np.zeros(later.size), noise=noise),
        actual=Passage(tangent=tangent, believed=believed, offset=offset, noise=added),
    )


def _along_nominal(ends: Ends) -> tuple[Array, Array, Array]:
    """Tangent, augmented state after it and noise along the nominal."""
    x, own = ca.MX.sym("x", ends.earlier.states), ca.MX.sym("own", ends.earlier.unknowns)
    moved, N = ends.given(x, own)
    tangent = ca.horzcat(*(ca.jacobian(moved, symbol) for symbol in (x, own)))
    J, landed, noise = ca.Function("along", [x, own], [tangent, moved, N])(*ends.nominal)
    return np.asarray(J.full()), np.asarray(landed.full()).ravel(), np.asarray(noise.full())
