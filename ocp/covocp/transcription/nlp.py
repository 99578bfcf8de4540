"""A transcribed problem: variables, bounds, constraint rows, and the way back to trajectory and multipliers."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.dataclass import dataclass
from covocp.base.errors import OutsideDomainError
from covocp.base.expressions import slopes_by
from covocp.base.matrices import Array, is_semidefinite, unpack
from covocp.base.short_repr import short_repr
from covocp.statement.statement import Statement
from covocp.transcription.before_reading import hold, unfed
from covocp.transcription.mesh import Mesh
from covocp.transcription.separable import Piece
from covocp.transcription.trajectory import Multipliers, Trajectory

# Scaled residual above which a constraint of a failed run is reported as violated.
VIOLATION = 1e-6
# Settings of CasADi's nlpsol in which it is silent and does not raise.
QUIET = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False, "calc_lam_p": False}


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Typical magnitudes of the entries of x, u, e and T; the NLP works in units of them.

    Those of the controls are the same at all nodes, shape (nu,), or one for each control value, (nodes, nu).
    """

    x: Array
    u: Array
    e: Array
    duration: float

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Rows:
    """A group of constraint rows: `names[i % len(names)]` is the user's name of row i; value = expression / scale."""

    kind: str
    expression: Any
    lower: Array
    upper: Array
    names: tuple[str, ...]
    scale: Array
    dense: bool = False

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class NLP:
    """A transcribed problem: minimise f(w, p) subject to bounds on w and g(w, p); everything scaled.

    `p` stacks the parameters of the statement and the scale of the cost. `evaluate` maps (w, p) to x, e, u at the
    nodes (columns), the terminal time, running cost, terminal cost and g. `backward` maps them to the half-vectors at
    the start of the matrices that run backward; None where none does. `gradient`, f and its slopes by w, and
    `jacobian`, the slopes of g, are there where CasADi's own take longer, else None. `pieces`, where there are some,
    add up to f and g.
    """

    statement: Statement
    mesh: Mesh
    scales: Scales
    w: Any
    p: Any
    f: Any
    g: Any
    rows: tuple[Rows, ...]
    gradient: tuple[Any, Any] | None
    jacobian: Any
    evaluate: ca.Function
    backward: ca.Function | None = None
    pieces: tuple[Piece, ...] = ()

    __repr__ = short_repr

    def pack(self, trajectory: Trajectory) -> Array:
        """The scaled variables of a trajectory."""
        nodes = list(self.mesh.starts)
        parts = [trajectory.x[nodes] / self.scales.x]
        if not self.mesh.eliminated:
            parts.append(trajectory.e[nodes] / self.scales.e)
        parts.append(trajectory.u / self.scales.u)
        stacked = [part.ravel() for part in parts]
        if self.statement.duration.free:
            stacked.append(np.array([trajectory.duration / self.scales.duration]))
        return np.concatenate(stacked)

    def unpack(self, w: Array, parameters: Array) -> tuple[Trajectory, dict[str, Any]]:
        """The trajectory at all nodes, and the cost terms and constraint values, of some variables."""
        x, e, u, duration, running, terminal, g = self._evaluated.evaluated(w, np.append(parameters, 1.0))
        trajectory = Trajectory(x=x.T, u=u.T, e=e.T, duration=float(duration.item()))
        return trajectory, {"running": float(running.item()), "terminal": float(terminal.item()), "g": g.ravel()}

    @cached_property
    def _evaluated(self) -> Matrices:
        """`evaluate`, for numbers."""
        return Matrices(self.evaluate)

    def bounds(self, parameters: Array) -> dict[str, Array]:
        """Bounds of w and g (nlpsol's names) for these parameters."""
        st = self.statement
        x0, xf, e0, ef = st.boundary_values(parameters)
        count = len(self.mesh.starts)
        xl, xu = np.tile(st.state_bounds[0], (count, 1)), np.tile(st.state_bounds[1], (count, 1))
        xl[1:, st.decisions], xu[1:, st.decisions] = -np.inf, np.inf  # one bound for one number
        _fix(xl[0], xu[0], x0)
        _fix(xl[-1], xu[-1], xf)
        lows, highs = [xl / self.scales.x], [xu / self.scales.x]
        waiting = unfed(st, self.mesh, e0)
        if not self.mesh.eliminated:
            el, eu = np.tile(st.matrix_lower, (count, 1)), np.full((count, st.ne), np.inf)
            if waiting is not None:
                el[:, waiting.matrices] = -np.inf
            if st.tied is not None:
                e0[list(st.tied.matrices)] = 0.0  # inserted: these variables stand for nothing
            _fix(el[0], eu[0], e0)
            _fix(el[-1], eu[-1], ef)
            lows.append(el / self.scales.e)
            highs.append(eu / self.scales.e)
        ul, uu = (np.tile(limit, (self.mesh.control_nodes, 1)) for limit in st.control_bounds)
        if waiting is not None:
            hold(waiting, ul, uu)
        for bounds, limits in ((lows, ul), (highs, uu)):
            bounds.append(limits / self.scales.u)
            bounds[-1][self.mesh.idle] = 0.0  # these variables stand for nothing
        if st.duration.free:
            lows.append(np.array([st.duration.lower / self.scales.duration]))
            highs.append(np.array([st.duration.upper / self.scales.duration]))
        lbg = np.concatenate([np.zeros(0), *(rows.lower for rows in self.rows)])
        ubg = np.concatenate([np.zeros(0), *(rows.upper for rows in self.rows)])
        offset = 0
        for rows in self.rows:
            if rows.kind == "final_matrices":
                target = ef[~np.isnan(ef)] / rows.scale
                lbg[offset : offset + rows.lower.size] = ubg[offset : offset + rows.lower.size] = target
            offset += rows.lower.size
        return {
            "lbx": np.concatenate([v.ravel() for v in lows]),
            "ubx": np.concatenate([v.ravel() for v in highs]),
            "lbg": lbg,
            "ubg": ubg,
        }

    def violations(self, excess: Array, parameters: Array) -> dict[str, float]:
        """Largest violation of each violated constraint, in its own unit, by name; from those of all rows, scaled."""
        if not (excess > VIOLATION).any():
            return {}
        result: dict[str, float] = {}
        fixed = ~np.isnan(self.statement.boundary_values(parameters)[1])
        offset = 0
        for rows in self.rows:
            size = rows.lower.size
            for i in np.flatnonzero(excess[offset : offset + size] > VIOLATION):
                name = rows.names[i % len(rows.names)]
                if rows.kind == "gap_x" and i >= size - len(rows.names) and fixed[i % len(rows.names)]:
                    name = f"final value of {self.statement.state_names[i % len(rows.names)]}"
                result[name] = max(result.get(name, 0.0), float(excess[offset + i] * rows.scale[i]))
            offset += size
        return dict(sorted(result.items(), key=lambda entry: -entry[1]))

    def unpack_multipliers(self, lam_x: Array, lam_g: Array, trajectory: Trajectory, parameters: Array) -> Multipliers:
        """Multipliers of the statement's constraints from those of the NLP (for a cost scale of 1)."""
        st, mesh = self.statement, self.mesh
        by_kind, offset = {}, 0
        for rows in self.rows:
            by_kind[rows.kind] = lam_g[offset : offset + rows.lower.size] / rows.scale
            offset += rows.lower.size
        zero = Multipliers.zero(st, mesh)
        parts = self._split(lam_x)
        states, matrices = zero.states.copy(), zero.matrices.copy()
        starts = list(mesh.starts)
        states[starts[1:-1]] = (parts["x"] / self.scales.x)[1:-1]
        states[0, st.decisions] = (parts["x"] / self.scales.x)[0, st.decisions]
        if "state_bounds" in by_kind:
            bounded = st.bounded_states
            inside = sorted(set(range(mesh.intervals + 1)) - set(starts))
            states[np.ix_(np.array(inside, dtype=np.intp), np.array(bounded, dtype=np.intp))] = by_kind[
                "state_bounds"
            ].reshape(len(inside), len(bounded))
        inside_states = zero.inside_states.copy()
        if "bounds_inside" in by_kind:
            bounded = st.bounded_states
            inside_states[..., bounded] = by_kind["bounds_inside"].reshape(*inside_states.shape[:2], len(bounded))
        end = by_kind.get("end", zero.end)
        path = by_kind.get("path", zero.path.ravel()).reshape(zero.path.shape)
        costate = by_kind["gap_x"][-st.nx :]
        slope_x, slope_e = terminal_slopes(st, trajectory, parameters, end, path[-1])
        final_matrices = zero.final_matrices.copy()
        gaps = [by_kind[kind].reshape(len(mesh.segments), -1) for kind in ("gap_x", "gap_e") if kind in by_kind]
        if "e" in parts:
            matrices[starts[1:-1]] = (parts["e"] / self.scales.e)[1:-1]
            final_matrices = by_kind["gap_e"][-st.ne :] - slope_e
        elif "final_matrices" in by_kind:
            known = ~np.isnan(st.boundary_values(parameters)[3])
            final_matrices[known] = by_kind["final_matrices"]
        inside_path = by_kind.get("path_inside", zero.inside_path.ravel()).reshape(zero.inside_path.shape)
        parts_inside = [by_kind[inside_kind(i)] for i in range(len(st.inside.parts))]
        return Multipliers(
            final=costate - slope_x,
            final_matrices=final_matrices,
            end=end,
            start=by_kind.get("start", zero.start),
            instants=np.concatenate([np.zeros(0), *parts_inside]),
            path=path,
            states=states,
            matrices=matrices,
            controls=self._acting(parts["u"] / self.scales.u),
            gaps=np.hstack(gaps),
            inside_path=np.where(st.path.equations, 0.0, inside_path),  # which hold at the nodes
            inside_states=inside_states,
        )

    def bounds_at_ends(self, lam_x: Array) -> tuple[Array, Array]:
        """Multipliers of the bounds on the states at the first and at the last node, (nx,) each.

        Without those of decisions, which are among the multipliers of states (`unpack_multipliers`).
        """
        states = self._split(lam_x)["x"] / self.scales.x
        states[:, self.statement.decisions] = 0.0
        return states[0], states[-1]

    def _acting(self, controls: Array) -> Array:
        """Multipliers of the control bounds, none where another control acts."""
        controls[self.mesh.idle] = 0.0
        return controls

    def pack_multipliers(self, multipliers: Multipliers, costates: tuple[Array, Array]) -> tuple[Array, Array]:
        """Multipliers of the NLP (for a cost scale of 1) from those of the statement and the costates at the nodes."""
        starts = list(self.mesh.starts)
        inside = sorted(set(range(self.mesh.intervals + 1)) - set(starts))
        st = self.statement
        bounded = st.bounded_states
        known = ~np.isnan(st.boundary_values(st.values)[3])
        values = {
            "gap_x": costates[0][starts[1:]],
            "gap_e": costates[1][starts[1:]],
            "state_bounds": multipliers.states[
                np.ix_(np.array(inside, dtype=np.intp), np.array(bounded, dtype=np.intp))
            ],
            "bounds_inside": multipliers.inside_states[..., bounded],
            "path": multipliers.path,
            "path_inside": multipliers.inside_path,
            "start": multipliers.start,
            "end": multipliers.end,
            "final_matrices": multipliers.final_matrices[known],
            "backward_ends": multipliers.final_matrices[st.entries(st.behind)],
        } | {inside_kind(i): own for i, own in enumerate(st.inside.split(multipliers.instants))}
        lam_g = [values[rows.kind].ravel() * rows.scale for rows in self.rows]
        lam_x = [multipliers.states[starts] * self.scales.x]
        if not self.mesh.eliminated:
            lam_x.append(multipliers.matrices[starts] * self.scales.e)
        lam_x.append(multipliers.controls * self.scales.u)
        if st.duration.free:
            lam_x.append(np.zeros(1))
        return np.concatenate([v.ravel() for v in lam_x]), np.concatenate([np.zeros(0), *lam_g])

    def units(self, scales: Scales) -> Array:
        """Other magnitudes of the variables, in the units of this NLP, an entry for each variable."""
        st, count, nodes = self.statement, len(self.mesh.starts), self.mesh.control_nodes
        parts = [np.tile(scales.x / self.scales.x, count)]
        if not self.mesh.eliminated:
            parts.append(np.tile(scales.e / self.scales.e, count))
        parts.append(np.broadcast_to(scales.u / self.scales.u, (nodes, st.nu)).ravel())
        if st.duration.free:
            parts.append(np.array([scales.duration / self.scales.duration]))
        return np.concatenate(parts)

    def row_units(self, scales: Scales) -> Array:
        """Other magnitudes of what the rows of g compare, in units of these rows; 1 where rows have no magnitude."""
        whole = {"gap_x": scales.x, "gap_e": scales.e}
        parts = [
            np.tile(whole[rows.kind], rows.lower.size // whole[rows.kind].size) / rows.scale
            if rows.kind in whole
            else np.ones(rows.lower.size)
            for rows in self.rows
        ]
        return np.concatenate([np.zeros(0), *parts])

    def _split(self, w: Array) -> dict[str, Array]:
        """Parts of a vector of the size of the variables, a row for each node."""
        st, count, nodes = self.statement, len(self.mesh.starts), self.mesh.control_nodes
        lengths = (
            {"x": (count, st.nx)} | ({} if self.mesh.eliminated else {"e": (count, st.ne)}) | {"u": (nodes, st.nu)}
        )
        parts, offset = {}, 0
        for name, shape in lengths.items():
            parts[name] = w[offset : offset + shape[0] * shape[1]].reshape(shape)
            offset += shape[0] * shape[1]
        return parts


def inside_kind(number: int) -> str:
    """Kind of the rows of the conditions at one of the instants."""
    return f"instant {number}"


def terminal_slopes(
    statement: Statement, trajectory: Trajectory, parameters: Array, end: Array, path: Array
) -> tuple[Array, Array]:
    """Slopes by x(T) and by the half-vectors at T of terminal cost and of the inequalities that act there."""
    t, slopes = trajectory, _terminal_numbers(statement)
    by_x, by_e = slopes.evaluated(t.x[-1], t.e[-1], t.u[-1], t.duration, parameters, end, path)
    return by_x.ravel(), by_e.ravel()


class TerminalBends(NamedTuple):
    """By form: whether the slope of a terminal cost by x(T) moves with it, and that by half-vectors with both."""

    states: bool
    matrices: bool


@lru_cache(maxsize=4)
def terminal_bends(statement: Statement) -> TerminalBends:
    """Which slopes at T are not constant; those of conditions there count by x(T) where these are curved."""
    slopes = _terminal_slopes(statement)
    moves = [[slopes.jac_sparsity(of, by).nnz() > 0 for by in range(2)] for of in range(2)]
    return TerminalBends(moves[0][0], any(moves[1]))


@lru_cache(maxsize=4)
def _terminal_numbers(statement: Statement) -> Matrices:
    """`_terminal_slopes` of numbers."""
    return Matrices(_terminal_slopes(statement))


@lru_cache(maxsize=4)
def _terminal_slopes(statement: Statement) -> ca.Function:
    """(x, e, u at T, T, parameters, multipliers of conditions at the end, of those along the path) -> slopes."""
    x, e, u = (ca.MX.sym(name, size) for name, size in (("x", statement.nx), ("e", statement.ne), ("u", statement.nu)))
    t, p = ca.MX.sym("T"), ca.MX.sym("p", statement.np)
    end, path = ca.MX.sym("end", statement.end.size), ca.MX.sym("path", statement.path.size)
    value = statement.terminal(x, e, t, p)
    for conditions, weights in ((statement.end, end), (statement.path, path)):
        if conditions.size:
            value += ca.dot(weights, conditions.function(x, u, e, t, t, p))
    return ca.Function("terminal_slopes", [x, e, u, t, p, end, path], slopes_by(value, (x, e)))


def _fix(lower: Array, upper: Array, values: Array) -> None:
    """Fix the entries that have a value (in place)."""
    known = ~np.isnan(values)
    lower[known] = upper[known] = values[known]


def check_costs(
    statement: Statement, trajectory: Trajectory, running: float, terminal: float, *, evaluated: bool = False
) -> None:
    """Costs of a first trajectory, or of one that is evaluated, must be finite.

    Raises:
        OutsideDomainError: names the one that is not.
    """
    what, expected = "the initial guess", "a finite cost where the solver starts"
    remedy = "give another guess of controls or states, or bounds that keep the model in its domain"
    if evaluated:
        what, expected = "this nominal", "a finite cost of what is evaluated"
        remedy = "give another nominal, or keep what the cost depends on where it has a value"
    for name, value, where in (("running", running, "along"), ("terminal", terminal, "at the end of")):
        if not np.isfinite(value):
            last = np.array2string(trajectory.x[-1], precision=4, threshold=8)
            received, broken = f"final state {last}", _broken_covariance(statement, trajectory)
            lost = np.flatnonzero(~np.isfinite(trajectory.x).all(axis=1))
            if lost.size:  # segments behind it begin at guessed states, so the last one says nothing
                received = f"states that are NaN or inf at node {lost[0]} of {trajectory.x.shape[0] - 1}"
                remedy = (
                    "where the integration steps are too long for the model take more intervals (grid= where it is "
                    f"fast), substeps= or step='rodas'; else {remedy}"
                )
            elif broken or not np.isfinite(trajectory.e).all():
                received = broken or received
                remedy = (
                    "the steps of the matrices are too long: use covariance_step='gauss', more substeps or intervals"
                )
            raise OutsideDomainError(
                f"The cost '{name}' is {value} {where} {what}.",
                expected=expected,
                received=f"{received}, T = {trajectory.duration:g} s",
                remedy=remedy,
            )


def _broken_covariance(statement: Statement, trajectory: Trajectory) -> str:
    """A covariance along a trajectory that is none, which it becomes by steps that are too long; "" where all are."""
    for block in (b for b in statement.matrices if b.covariance):
        matrices = unpack(trajectory.e[:, block.span], block.size)
        if np.isfinite(matrices).all() and not is_semidefinite(matrices):
            least = np.linalg.eigvalsh(matrices)[:, 0]
            k = int(least.argmin())
            return f"'{block.name}' with the eigenvalue {least[k]:.3g} at node {k} of {least.size - 1}"
    return ""
