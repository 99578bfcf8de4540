"""A solution: plain data at the nodes, indexed by the user's symbols and names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import casadi as ca
import numpy as np

from covocp.base.arguments import checked, one_of, truth
from covocp.base.checks import is_whole
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, has_key
from covocp.base.expressions import Given
from covocp.base.later import later
from covocp.base.matrices import Array, read_only, smallest_eigenvalue
from covocp.base.threads import cached, methods_one_at_a_time
from covocp.extremal.closed_loop import ClosedLoop, close_loop
from covocp.extremal.costates import discrete_costates
from covocp.extremal.dense_output import dense_output
from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.hamiltonian import Costates
from covocp.extremal.mesh_error import mesh_error
from covocp.extremal.nodes import filter_gains, rates_along
from covocp.extremal.path_limits import Passed, left_tables, limited, passed_limits
from covocp.extremal.polynomials import Dense
from covocp.extremal.spread_limits import passed_by_spread, spread_names
from covocp.solution.chances import Reached, reached
from covocp.solution.costs import identity_of_costs, split_cost
from covocp.solution.covariances import all_covariances, are_semidefinite, covariance_between
from covocp.solution.duals import costate_of, multiplier_of
from covocp.solution.origin import Origin, origin_of
from covocp.solution.reading import by_name, expression_values, name_in, other_loop
from covocp.solution.sample import Sample, asked_times
from covocp.statement.conditions import Conditions
from covocp.statement.entries import entry_names
from covocp.statement.names import block_of, entry_values, unknown_name
from covocp.statement.statement import Block, Statement
from covocp.transcription.before_reading import ESTIMATE
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Multipliers, Trajectory

if TYPE_CHECKING:
    from pathlib import Path

    import matplotlib.figure

    from covocp.extremal.links import Within
    from covocp.extremal.mean_effect import MeanEffect
    from covocp.extremal.optimality import Optimality
    from covocp.extremal.phase_loops import PhaseLoop
    from covocp.solution.fingerprint import Fingerprint


@methods_one_at_a_time
@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """An optimal control problem solved (or its last iterate: see `converged`).

    `solution[key]`, with the symbol, its name, or any expression of the problem's symbols, gives the values at the
    nodes, time first: (K,) for scalars, (K, n) for vectors, (K, n, n) for matrices. Under another truth (`evaluate`) X
    and Xhat are those under it; E is what the filter of the design computes.

    Attributes:
        name: of the problem.
        method: that found it.
        converged: whether the method's own test was met.
        message: how the method ended.
        cost_terms: terminal and running cost.
        extremal: mesh, trajectory, parameters and multipliers, with the problem where that is known.
        rates: of x and e stacked, at the nodes, (K, nx + ne).
        end_rates: at the ends of the intervals with their own control, which may jump there, (K - 1, nx + ne).
        filter_gain: Kalman gain E M' U^-1 at the nodes, (K, n, m); None without a measured covariance.
        loop: covariances, gain and expected cost of the closed loop; None where nothing is fed back.
        mesh_error: relative change of the cost by shorter integration steps, mostly halves (to first order).
        violations: of constraints, by name.
        stats: iterations, times, what the method counts.
        blocks: where each symbol lies.
        augmented: names of the rows of the estimation covariance.
        targets: final values of the states, NaN where they are free.
        constraints: names of the rows of the inequalities, by place: "path", "start", "end", "instants".
        chances: what is reached of the conditions on probabilities, by the linearised spread.
        stored_problem: of a solution read from a file, what its problem was, to tell it from others.
        within: of one of several phases, what the others say of it.
    """

    name: str
    method: str
    converged: bool
    message: str
    cost_terms: Mapping[str, float]
    extremal: Extremal
    rates: Annotated[Array, "nodes xe"]
    end_rates: Annotated[Array, "intervals xe"]
    filter_gain: Annotated[Array, "nodes augmented any"] | None
    mesh_error: float
    violations: Mapping[str, float]
    stats: Mapping[str, Any]
    blocks: tuple[Block, ...]
    augmented: tuple[str, ...]
    targets: Annotated[Array, "x"]
    constraints: Mapping[str, tuple[str, ...]]
    loop: ClosedLoop | None = None
    chances: tuple[Reached, ...] = ()
    stored_costates: Costates | None = None
    stored_dense: Dense | None = None
    stored_optimality: Optimality | None = None
    stored_problem: Fingerprint | None = None
    within: Within | None = None

    @staticmethod
    def of(
        outcome: Outcome,
        method: str,
        within: Within | None = None,
        closed: PhaseLoop | None = None,
        *,
        assess: bool = True,
    ) -> Solution:
        """The solution of an outcome, with the estimate of its mesh error, or nan in its place.

        `closed` is the loop of one of several phases, which begins where that before it ends. A method that lets
        another one solve says which, among its counts.
        """
        extremal, st = outcome.extremal, outcome.extremal.statement
        rates, end_rates = rates_along(extremal)
        loop = None if closed is None else closed.loop
        if closed is None and st.loop is not None and np.isfinite(rates).all():
            loop = close_loop(extremal)
        read_only(extremal.trajectory)
        solution = Solution(
            name=st.name,
            method=str(outcome.stats.get("method", method)),
            converged=outcome.converged,
            message=outcome.message,
            cost_terms=split_cost(outcome.cost_terms, loop, 0.0 if closed is None else closed.handed),
            extremal=extremal,
            rates=rates,
            end_rates=end_rates,
            filter_gain=filter_gains(extremal),
            mesh_error=mesh_error(extremal, outcome.cost_terms["running"], within) if assess else np.nan,
            violations=dict(outcome.violations),
            stats=dict(outcome.stats),
            blocks=st.blocks,
            augmented=st.augmented,
            targets=st.boundary_values(extremal.parameters)[1],
            constraints={
                "path": st.path.names,
                "start": st.start.names,
                "end": st.end.names,
                "instants": st.inside.names,
            },
            loop=loop,
            within=within,
        )
        return read_only(replace(solution, chances=reached(solution)))

    @property
    def mesh(self) -> Mesh:
        """Nodes, controls, covariance step."""
        return self.extremal.mesh

    @property
    def trajectory(self) -> Trajectory:
        """x, u, e at the nodes, terminal time [s]."""
        return self.extremal.trajectory

    @property
    def parameters(self) -> Array:
        """Stacked values of known parameters and means of unknowns."""
        return self.extremal.parameters

    @property
    def multipliers(self) -> Multipliers:
        """Of the constraints."""
        return self.extremal.multipliers

    @property
    def statement(self) -> Statement | None:
        """The problem solved; None for a solution read from a file."""
        return self.extremal.stated

    @property
    def cost(self) -> float:
        """The cost, sum of its terms."""
        return float(sum(self.cost_terms.values()))

    @property
    def optimised(self) -> bool:
        """Whether the nominal was chosen for this cost, not given nor taken from the deterministic one."""
        return self.origin is Origin.OPTIMISED

    @property
    def origin(self) -> Origin:
        """How it came about: optimised, classical, given, or under another truth."""
        return origin_of(self.method, self.stats)

    @property
    def status(self) -> str:
        """How the run ended, in words."""
        return self.message if self.converged else f"NOT CONVERGED: {self.message}"

    @property
    def duration(self) -> float:
        """Terminal time [s]."""
        return self.trajectory.duration

    @property
    def t(self) -> Array:
        """Times of the nodes [s], shape (K,)."""
        return self.extremal.time

    @property
    def gains(self) -> Mapping[str, Array]:
        """Gains at the nodes over the augmented state: "K" of the filter (K, n, m), "C" of the feedback (K, nu, n)."""
        gains = {} if self.filter_gain is None else {"K": self.filter_gain}
        return gains if self.loop is None else {**gains, "C": self.loop.gain}

    @property
    def symbols(self) -> Mapping[str, Any]:
        """The user's symbols by name; empty for a solution read from a file."""
        return self.statement.symbols if self.statement is not None else {}

    @cached
    def costates(self) -> Costates:
        """p and the costates of the half-vectors at the nodes, read-only; computed when first asked for."""
        return self.stored_costates or discrete_costates(self.extremal)[0]

    @cached
    def optimality(self) -> Optimality:
        """Residuals of the necessary conditions, mesh error and smallest covariance eigenvalue."""
        from covocp.solution.assessed import optimality_of

        return optimality_of(self)

    @property
    def cost_identity(self) -> float | None:
        """Relative difference of the cost and of the expected cost from the loop's own covariances (E-1).

        None without a closed loop, and where the cost is the latter one: under other statistics than the design's.
        """
        return identity_of_costs(self)

    @cached
    def mean_effect(self) -> MeanEffect | None:
        """What curved rates and measurements do to the mean of the loop, left out of the cost; None where unknown."""
        from covocp.solution.assessed import mean_effect_of

        return mean_effect_of(self)

    @cached
    def smallest_eigenvalue(self) -> float:
        """Smallest eigenvalue of the covariances at all nodes; inf without covariances."""
        return min((smallest_eigenvalue(matrix) for matrix in all_covariances(self)), default=np.inf)

    @cached
    def semidefinite(self) -> bool:
        """Whether all covariances are positive semidefinite up to roundoff at all nodes."""
        return are_semidefinite(self)

    def block(self, name: str) -> Block:
        """Where a name, or that of an entry of a vector, lies."""
        found = block_of(name, self.blocks) if isinstance(name, str) else None
        if found is None:
            raise unknown_name(name, tuple(b.name for b in self.blocks))
        return found

    @cached
    def values(self) -> Mapping[str, Array]:
        """Values of all symbols at the nodes by name; read-only."""
        found = by_name(self, self.t, self.trajectory.x, self.controls, self.trajectory.e)
        if (other := other_loop(self)) is not None and ESTIMATE in found:
            found[ESTIMATE] = other.Xhat
        return read_only(found)

    @property
    def controls(self) -> Array:
        """Controls at all K nodes; a constant control holds its last value at the last node."""
        return self.extremal.controls

    def __contains__(self, key: object) -> bool:
        """Whether there is such a symbol, name, entry or expression."""
        return has_key(self, key)

    def __getitem__(self, key: Given) -> Array:
        """Values at the nodes of a symbol, a name, an entry of one, or an expression; decisions, integrals: numbers.

        Raises:
            ProblemError: where the name is unknown, or the expression contains a symbol of another problem.
        """
        found = name_in(self, key, missing_ok=isinstance(key, ca.MX))
        if not found:
            return expression_values(self, key)
        values, own = entry_values(self.values, found), block_of(found, self.blocks)
        return values if own is None or own.role == "moving" else np.squeeze(values[-1])

    @checked(side=one_of("after", "before"))
    def at(self, t: Given, side: str = "after") -> Sample:
        """Values at other times than the nodes.

        States and matrices as the integrator computes them between the nodes (`dense`), controls as they were
        transcribed.

        Args:
            t: a time or an array of times [s], within [0, duration].
            side: "after" or "before", where something jumps there: a covariance at a measurement that is taken then.

        Returns:
            What `[symbol or name]` gives the values of; without Xhat where `evaluate(..., truth=)` put other statistics
            than the design's, under which it is known at the nodes only.

        Raises:
            ProblemError: where a time lies outside, or is not a number.
        """
        times = asked_times("at", t, self.duration, "the solution")
        before = side == "before"
        z = self.dense.at(self.mesh.placed(times / self.duration), before=before)
        u = self.controls_at(times, before=before)
        nx = self.trajectory.x.shape[1]
        values = by_name(self, times, z[:, :nx], u, z[:, nx:])
        if other_loop(self) is not None:
            values.pop(ESTIMATE, None)  # under this truth it is known at the nodes only
        if np.ndim(t) == 0:
            values = {name: value[0] for name, value in values.items()}
        return Sample(t=t, values=values, symbols=self.symbols)

    @checked(before=truth)
    def controls_at(self, times: Given, *, before: bool = False) -> Array:
        """Controls at a time (nu,), or at an array of times [s] (K, nu); where they jump those after it, or before it.

        Raises:
            ProblemError: where a time lies outside, or is not a number.
        """
        row = asked_times("controls_at", times, self.duration, "the solution")
        u = self.extremal.controls_at(self.mesh.placed(row / self.duration), before=before)
        return u[0] if np.ndim(times) == 0 else u

    @cached
    def dense(self) -> Dense:
        """States and half-vectors between the nodes, read-only; computed when first asked for."""
        return self.stored_dense or dense_output(self.extremal)

    @cached
    def _dense_states(self) -> Dense:
        """The same of the states alone, which costs less where there are matrices."""
        return dense_output(self.extremal, matrices=False)

    def costate(self, symbol: Given) -> Array:
        """Costate of a state or its entry, (K,) or (K, n), or of a matrix, the symmetric P of (K, n, n).

        Raises:
            ProblemError: where the symbol is neither.
        """
        return costate_of(self, symbol)

    def multiplier(self, key: Given) -> Array:
        """Multiplier of a constraint, by its name, or of the terminal values of a state or a matrix.

        The multiplier of an inequality is positive at its upper bound: the cost falls by it for one unit more room. For
        terminal values it is l of p(T) = k_x + l, zero where they are free; the cost rises by -l for one unit more.

        Args:
            key: the name of a constraint, or the symbol or name of a state or a matrix.

        Returns:
            Of a path constraint (K,) or (K, rows), multipliers of the discretised problem at the nodes (what acts
            between two nodes is shared between them), whose sum the cost falls by for one unit more room at all times;
            of terminal and initial ones and of those at an instant () or (rows,); of a state () or (n,); of a matrix
            (n, n).

        Raises:
            ProblemError: where there is no such constraint or symbol.
        """
        return multiplier_of(self, key)

    @property
    def final_multipliers(self) -> tuple[Array, Array]:
        """Of the terminal values of states and half-vectors, without what the phases after it cost by them."""
        m = self.multipliers
        if self.within is None:
            return m.final, m.final_matrices
        return m.final - self.within.end, m.final_matrices - self.within.end_matrices

    def covariance(self, a: Given, b: Given = None) -> Array:
        """Covariance of the deviations of the actual system between two symbols, (K, size of a, size of b).

        That of the errors of the estimate where nothing is fed back, E + Xhat (and Z, where the statistics are not
        those of the design) in a closed loop.

        Args:
            a: a state or an unknown, or an entry of it, symbol or name: p, "p", p[0], "p[0]".
            b: another one; None: a itself.

        Raises:
            ProblemError: where there is no estimation covariance, or the symbol is not in it.
        """
        return covariance_between(self, a, b)

    def deviation(self, symbol: Given) -> Array:
        """Standard deviation of a state, an unknown or an entry of one, (K,) or (K, n), in its unit."""
        variances = np.diagonal(self.covariance(symbol), axis1=1, axis2=2)
        values = np.sqrt(np.maximum(variances, 0.0))
        return np.asarray(values[:, 0] if values.shape[1] == 1 else values)

    def check_path(self, points: int = 10) -> Mapping[str, float]:
        """Largest violation of each path constraint and state bound along the true path.

        They are imposed at a few points of each interval (`points=` of `solve`); this looks at the ends of `points`
        equal parts of it, and wherever the path bends sharply. Memory does not grow with the points. Under another
        truth (`evaluate`), constraints on the covariance X of the closed loop are looked at where that is known: at the
        nodes.

        Args:
            points: parts of each interval.

        Returns:
            Violation by name, in the unit of the constraint; only those that are violated by more than 1e-5 of their
            limit, the accuracy of the path; inf where a constraint is NaN or inf.

        Raises:
            ProblemError: where `points` is not a positive whole number.
            CovocpError: where the solution was read from a file without its problem.
        """
        if not is_whole(points):
            raise ProblemError(
                "check_path needs a number of parts of each interval.",
                expected="1, 2, 3, ...",
                received=repr(points),
                remedy="correct points",
            )
        return {entry.name: entry.by for entry in self.passed_limits(points)}

    def passed_limits(self, points: int = 10) -> tuple[Passed, ...]:
        """What `check_path` finds, with the share of the limit and the time, the worst first."""
        if not limited(self.extremal):
            return ()
        path = self.extremal.statement.path
        found = passed_limits(self.extremal, self._dense_for(path), points)
        other = other_loop(self)
        if other is None or path.scattered is None:
            return found
        believed = spread_names(self.extremal.statement)
        known = [entry for entry in found if entry.name not in believed]
        known += passed_by_spread(self.extremal, other, path=True)
        return tuple(sorted(known, key=lambda entry: -entry.share))

    def left_tables(self, points: int = 10) -> tuple[Passed, ...]:
        """Tables that are read beyond their outermost knots along the true path, the worst first.

        Args:
            points: equal parts of each interval at whose ends it is looked at.

        Returns:
            Of each argument of a table that is passed its name, by how much in its own unit, and the time [s].
        """
        tables = self.extremal.statement.tables
        return () if tables is None else left_tables(self.extremal, self._dense_for(tables), points)

    def _dense_for(self, rows: Conditions) -> Dense:
        """What some conditions need between the nodes: the states, and the matrices where they read them."""
        whole = self.stored_dense or "dense" in self.__dict__ or rows.uses_matrices
        return self.dense if whole else self._dense_states

    def plot(self, *names: Any, **options: Any) -> matplotlib.figure.Figure:
        """Draw the solution; see `covocp.plot.figure.plot_solutions`."""
        figures = later("plot.figure")
        figures.check_plot_options(options)
        return figures.plot_solutions([self], *names, **options)  # type: ignore[no-any-return]

    def save(self, path: str | Path) -> Path:
        """Write the solution to a .npz or .json file; see `covocp.solution.storage.save`."""
        return later("solution.storage").save(self, path)  # type: ignore[no-any-return]

    def to_xarray(self) -> Any:
        """The solution as an xarray.Dataset; see `covocp.solution.dataset.to_xarray`."""
        return later("solution.dataset").to_xarray(self)

    def __repr__(self) -> str:
        """One line: what a console shows of a solution that nobody prints is no page of numbers."""
        return f"<{type(self).__name__} of '{self.name}' by {self.method}: {self.status}, cost {self.cost:.8g}>"

    def __str__(self) -> str:
        """The summary that print shows."""
        return str(later("solution.report").summary(self))

    def _repr_html_(self) -> str:
        """What a notebook shows: the same summary, and the figure."""
        from covocp.base.pages import as_html

        return as_html(later("solution.report").sections(self), later("plot.embedding").embedded(self.plot))

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the entries of the state."""
        return entry_names(tuple(b for b in self.blocks if b.kind == "state"))
