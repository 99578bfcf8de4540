"""From one phase of a simulation to the next: what jump, appearance and end do to the runs and to the prediction.

The actual system jumps by its expression J(x, b) at where it is, with noise of the variance that is stated there; a
state or an unknown that appears is drawn about its mean. The perturbation filter passes its estimate of the deviation
by the tangent along the nominal, as the covariance of the design does (E+ = J E J' + N); the extended filter puts its
own estimate into the expression, and its covariance goes by the tangent there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array, half_length, pack_symbolic, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.simulation.actual import System
from covocp.simulation.batches import Cloud
from covocp.simulation.run_parts import factor, part
from covocp.simulation.schedule import Estimator
from covocp.solution.solution import Solution
from covocp.statement.chain import Link


@dataclass(frozen=True, kw_only=True, eq=False)
class Junction:
    """What carries runs and prediction over; n, n+: rows of the augmented state before and after.

    function: (state, unknowns, estimate, half-vector E of the extended filter, normal numbers) -> the first four after.
    noises: normal numbers of a run; tangent: of the augmented states along the nominal, (n+, n); noise: (n+, n+).
    """

    function: ca.Function
    noises: int
    tangent: Array
    noise: Array

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

    def predicted(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Mean and covariance of deviation and estimate, stacked, after it."""
        none = np.zeros_like(self.tangent)
        both = np.block([[self.tangent, none], [none, self.tangent]])
        moved = both @ covariance @ both.T
        moved[: self.noise.shape[0], : self.noise.shape[0]] += self.noise
        return both @ mean, moved


@dataclass(frozen=True, kw_only=True, eq=False)
class _Ends:
    """The end of a phase and the start of the next one, with the link between them."""

    before: Solution
    after: Solution
    earlier: System
    later: System
    link: Link

    def given(self, state: Any, unknowns: Any, e: Any) -> tuple[Any, Any]:
        """Augmented state after the jump from that before it, and E after it from all half-vectors.

        Rows that nothing gives are those of the later nominal.
        """
        end, p = self.before.trajectory.x[-1], self.before.parameters
        whole = ca.vertcat(state, ca.DM(end[self.earlier.states :]))
        known = ca.vertcat(ca.DM(p[: p.size - self.earlier.unknowns]), unknowns)
        values, halves = self.link.function(whole, e, self.before.duration, known, ca.DM(self.after.parameters))
        rows = [ca.MX(float(value)) for value in self.later.start]
        for place, entry in enumerate(self.link.states):
            if entry < self.later.states:
                rows[entry] = values[place]
        for row, column in self.same:
            rows[row] = unknowns[column]
        places = [self.link.matrices.index(k) for k in range(self.later.covariance.start, self.later.covariance.stop)]
        return ca.vertcat(*rows), unpack_symbolic(halves[places], self.later.size)

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


def junction(
    before: Solution, after: Solution, earlier: System, later: System, link: Link, kind: Estimator
) -> Junction:
    """What carries a simulation from a phase to the next one.

    Args:
        before: solution of the phase that ends.
        after: of the next one.
        earlier: the system of the phase that ends.
        later: of the next one.
        link: between them.
        kind: of the filter.
    """
    ends = _Ends(before=before, after=after, earlier=earlier, later=later, link=link)
    n, still, noisy = earlier.size, earlier.unknowns, ends.noisy
    x, own, w = ca.MX.sym("x", earlier.states), ca.MX.sym("own", still), ca.MX.sym("w", len(noisy))
    nothing = ca.DM.zeros(before.trajectory.e.shape[1])
    moved, N = ends.given(x, own, nothing)
    tangent = ca.horzcat(*(ca.jacobian(moved, symbol) for symbol in (x, own)))
    at = ca.Function("at", [x, own], [tangent, N])
    end = before.trajectory.x[-1, : earlier.states], before.parameters[before.parameters.size - still :]
    J, spread = (np.asarray(v.full()) for v in at(*end))
    actual = ca.MX(moved)
    if noisy:
        actual[noisy] += factor(N[noisy, noisy]) @ w
    if kind == "extended":
        y, E = ca.MX.sym("y", n), ca.MX.sym("E", half_length(n))
        e = ca.MX(nothing)
        e[earlier.covariance] = E
        estimate, covariance = ends.given(part(y, 0, earlier.states), part(y, earlier.states), e)
        outputs = [estimate, pack_symbolic(covariance)]
    else:
        y, E = ca.MX.sym("y", n), ca.MX.sym("E", 0)
        outputs = [ca.DM(J) @ y, ca.MX(0, 1)]
    outputs = [part(actual, 0, later.states), part(actual, later.states), *outputs]
    function = ca.Function("junction", [x, own, y, E, w], [ca.densify(value) for value in outputs])
    return Junction(function=function, noises=len(noisy), tangent=J, noise=spread)
