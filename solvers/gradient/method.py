"""First-order gradient method in matrix form, G. T. Schmidt, Sc.D. thesis, M.I.T. 1971, chapter 4.

One iteration: integrate x and E forward; integrate p, P and the influence functions R backward; step by
-W^-1 (h_u + H_u' l) so that the terminal conditions are met to first order. It knows no NLP and needs the Hamiltonian
only, H_u for the step and H_uu for its weighting: so it checks what shooting finds.

Corrections to the source: the predicted miss is -I_kj - I_kk l [4.3-20]; with T free the miss changes by dx/dt dT too
and the coefficient of dT is that of h, not of H (appendix D). The multiplier of an off-diagonal entry of E is 2 P_ij.

Beyond the source:

- W = w H_uu (made positive definite), w the curvature seen along the last step, and the metric of the step learns from
  the last steps what W does not say of the curvature (`memory`). Both are raised fourfold where the cost and the
  terminal conditions do not change as predicted (merit J + sum nu |dz|, largest of the last values).
- The step is taken in the space of the controls (piecewise linear or constant): the projection of the source's step.
- Bounds on the controls and on T: projection of the step in the metric W. Inequalities: penalties (`penalty`).
- Terminal conditions on matrices and equalities between final values have influence functions like those on x.
- Free initial values: p(0) and P(0) are the slopes by them.
- Expected costs (appendix E, with free T and inequalities as above): S is integrated backward after x and E, and its
  costate -Xhat/2 forward before p and P; see `influence`. The weight of the terminal conditions is part of S(T).

The stop test does not depend on W; see `prepare`.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse.linalg import splu

from covocp.base.arguments import checked, one_of, positive, share, whole
from covocp.base.checks import as_number
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, shown
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.extremal.decisions import with_tied_multipliers
from covocp.extremal.extremal import Extremal, Guess, Merit, Outcome
from covocp.solvers.gradient.chain_method import GradientChainSolver, check_domain, check_phases
from covocp.solvers.gradient.descent import solve_step
from covocp.solvers.gradient.influence import build_sweeps
from covocp.solvers.gradient.iterate import Space, make_space
from covocp.solvers.gradient.lengths import lengths
from covocp.solvers.gradient.memory import learnt
from covocp.solvers.gradient.penalty import penalty_groups
from covocp.solvers.gradient.records import Iterate
from covocp.solvers.gradient.search import End, Search, Settings, Variant
from covocp.solvers.gradient.statuses import Status
from covocp.statement.chain import Chain
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import controls_guess
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.mirrored import conditions_on_matrices
from covocp.transcription.nlp import check_costs
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.trajectory import Trajectory

# Relative difference of two entries of a metric that count as equal.
SYMMETRIC = 1e-9
# Options of the mesh that this method has no use for, and why; `solving.methods` does not offer them.
NOT_TAKEN = {
    "segments": "it belongs to shooting",
    "covariances": "it belongs to shooting",
    "points": "its penalties act at the nodes",
}


KINDS = {
    "variant": one_of("gradient", "chord"),
    "weight_factor": positive,
    "fraction": share,
    "tolerance": positive,
    "violation_tolerance": positive,
    "max_iterations": whole(1),
}


@checked("the method 'gradient'", **KINDS)
def prepare(
    statement: Statement,
    options: Options,
    parameters: Array | None = None,
    *,
    variant: Variant = "gradient",
    weight: Given = "adaptive",
    weight_factor: float = 1.0,
    fraction: float = 1.0,
    tolerance: float = 1e-6,
    violation_tolerance: float = 1e-6,
    max_iterations: int = 2000,
) -> GradientSolver:
    """Compile the sweeps of the gradient method.

    The run has converged when

    - sqrt(int |s H_u|^2 dt) <= tolerance sqrt(int |s h|^2 dt), h the sum of the absolute terms of H_u (or
      |H_uu| |u|, where more), s the magnitudes of the controls (their `scale`), H_u projected on the controls'
      space and on the bounds, l the least-squares multiplier in this metric;
    - |dJ/dT| T and |dJ/dx_i(0)| s_i of a free duration and of free initial values <= tolerance (|k| + |int L dt|);
    - the violation of every inequality / its magnitude <= violation_tolerance, and |dz_j| / (magnitude of z_j) <= a
      hundredth of it;
    - what is left in the scale of the point that was reached holds, complementarity included (`covocp.base.residuals`).

    Args:
        statement: the problem.
        options: mesh; `segments` and `covariances` mean nothing here, and inequalities are met at the nodes only.
        parameters: values (np,) that the mesh is made for; None: the declared ones.
        variant: "gradient", or "chord": solve H_u(x, E, p, P, u_c) = 0 along the present x, E, p, P and step towards
            u_c [4.2-10].
        weight: W: "adaptive" (w H_uu, w from predicted and actual changes), "curvature" (H_uu, fixed factor), or a
            number, a vector (nu,), a matrix (nu, nu) or matrices at the nodes (N + 1, nu, nu): as it is.
        weight_factor: factor on W; with "adaptive" the first one is found by a probe and this multiplies it.
        fraction: d of step 5, in (0, 1]: share of the miss of the terminal conditions removed by a step.
        tolerance: on the slopes, see above.
        violation_tolerance: on terminal conditions and inequalities, see above.
        max_iterations: of all passes together.

    Returns:
        The solver; `solve` may be called often.

    Raises:
        ProblemError: an option is wrong.
    """
    parameters = statement.values if parameters is None else parameters
    mesh = _meshed(statement, options, parameters)
    _check_weight(weight, statement.nu, mesh.nodes.size)
    settings = _settings(variant, weight, weight_factor, fraction, tolerance, violation_tolerance, max_iterations)
    return GradientSolver(statement, options, mesh, lengths(statement, mesh, options, parameters).pairs(mesh), settings)


@checked("the method 'gradient'", **KINDS)
def prepare_chain(
    chain: Chain,
    options: tuple[Options, ...],
    *,
    variant: Variant = "gradient",
    weight: Given = "adaptive",
    weight_factor: float = 1.0,
    fraction: float = 1.0,
    tolerance: float = 1e-6,
    violation_tolerance: float = 1e-6,
    max_iterations: int = 2000,
) -> GradientChainSolver:
    """Compile the sweeps for several phases; arguments and errors as of `prepare`.

    Args:
        chain: the phases.
        options: mesh of each.
        variant: "gradient".
        weight: W: "adaptive", "curvature" or a number.
        weight_factor: factor on W.
        fraction: d of step 5.
        tolerance: on the slopes, relative to those of all phases.
        violation_tolerance: on terminal conditions.
        max_iterations: of all passes together.
    """
    settings = _settings(variant, weight, weight_factor, fraction, tolerance, violation_tolerance, max_iterations)
    check_phases(chain, settings)
    _check_weight(weight, 1, 0)
    meshes = tuple(_meshed(st, own, st.values) for st, own in zip(chain.statements, options, strict=True))
    return GradientChainSolver(chain, options, meshes, settings)


def _meshed(statement: Statement, options: Options, parameters: Array) -> Mesh:
    """The mesh in one segment with propagated matrices.

    Raises:
        ProblemError: one of the options that are not taken.
    """
    for name, why in NOT_TAKEN.items():
        value = getattr(options, name)
        if value != "auto" and not (name == "points" and value == 1):  # 1 asks for what it does
            raise ProblemError(
                f"The gradient method takes no '{name}': {why}.",
                expected=f"no {name}=",
                received=f"{name}={value!r}"[:100],
                remedy=f"leave it out, or solve by 'ipopt', which has {name}=",
            )
    mesh = resolve_mesh(statement, options, parameters)
    return replace(mesh, segments=(mesh.intervals,), eliminated=True, points=1)


def _settings(
    variant: Variant,
    weight: Given,
    weight_factor: float,
    fraction: float,
    tolerance: float,
    violation_tolerance: float,
    max_iterations: int,
) -> Settings:
    """Options as plain numbers."""
    return Settings(
        variant=variant,
        weight=weight,
        weight_factor=float(weight_factor),
        fraction=float(fraction),
        tolerance=float(tolerance),
        violation_tolerance=float(violation_tolerance),
        max_iterations=int(max_iterations),
    )


def _check_weight(weight: Given, nu: int, nodes: int) -> None:
    """Refuse a metric W that is none."""
    if isinstance(weight, str):
        if weight not in ("adaptive", "curvature"):
            raise _option_error("weight", "'adaptive', 'curvature', a number or an array", weight)
        return
    values = as_number("weight", "option", weight)
    shapes = values.shape in ((), (nu,), (nu, nu), (nodes, nu, nu))
    if not shapes or not np.isfinite(values).all() or not _definite(values):
        expected = (
            f"positive numbers of shape () or ({nu},), positive definite ones ({nu}, {nu}) or ({nodes}, {nu}, {nu})"
        )
        raise _option_error("weight", expected, weight)


def _definite(values: Array) -> bool:
    """Whether numbers are positive, or matrices symmetric and positive definite."""
    if values.ndim < 2:
        return bool((values > 0).all())
    symmetric = np.allclose(values, np.swapaxes(values, -1, -2), rtol=SYMMETRIC, atol=0.0)
    return symmetric and bool((np.linalg.eigvalsh(values) > 0).all())


def _option_error(name: str, expected: str, received: Given) -> ProblemError:
    return ProblemError(
        f"The option '{name}' of the gradient method has an unknown value.",
        expected=expected,
        received=shown(received),
        remedy=f"correct {name}=",
    )


class GradientSolver:
    """The compiled sweeps with the settings of the method."""

    def __init__(self, statement: Statement, options: Options, mesh: Mesh, pairs: int, settings: Settings) -> None:
        """Keep the settings; see `prepare`. The sweeps are compiled at the first call of `solve`.

        pairs: steps of the costates in an interval, for the values that the mesh was made for.
        """
        self._statement, self._options, self._mesh = statement, options, mesh
        self._pairs, self._settings = pairs, settings
        self._sweeps: Any = None
        self._groups: Any = ()

    @property
    def mesh(self) -> Mesh:
        """The resolved mesh: one segment, matrices propagated."""
        return self._mesh

    def solve(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Solve for these parameters from this guess; the last iterate is returned whatever happens."""
        begin = time.perf_counter()
        found = lengths(self._statement, self._mesh, self._options, parameters)
        if found.pairs(self._mesh) > self._pairs:  # the mesh may be kept for faster costates
            self._pairs, self._sweeps = found.pairs(self._mesh), None
        misled = found.reason(self._mesh, self._pairs)
        space = self.space(parameters, guess)
        built = time.perf_counter()
        current = space.first(guess)
        if np.isfinite(current.run.z).all():
            check_costs(self._statement, self._trajectory(current), current.run.running, current.run.terminal)
        check_domain(current.run.finite, misled)
        search = Search(space, self._settings, progress)
        end = search.run(current)
        judged = search.space
        assert isinstance(judged, Space)
        return self._outcome(
            judged,
            end,
            misled,
            {
                "iterations": search.control.iterations,
                "build_seconds": built - begin,
                "solve_seconds": time.perf_counter() - built,
                "return_status": str(end.status),
                "variant": self._settings.variant,
                "weight": search.control.weight,
                "passes": search.passes,
                "backward_steps": self._pairs,
                "history": tuple(search.control.history),
            },
        )

    def merit(self, parameters: Array, trajectory: Trajectory) -> Merit:
        """What the controls of a trajectory cost, and how they meet the conditions."""
        guess = Guess(trajectory=trajectory)
        with np.errstate(all="ignore"):
            iterate = self.space(parameters, guess).first(guess)
        excess = max((float(np.max(own, initial=0.0)) for own in iterate.penalty.excess), default=0.0)
        last = iterate.run.z[-1, self._statement.nx :]  # covariances, which count where conditions read them
        known = float(np.abs(last).sum()) if conditions_on_matrices(self._statement) else 0.0
        return Merit(float(iterate.run.cost), excess, known)

    def space(self, parameters: Array, guess: Guess) -> Space:
        """The unknowns of the method for these parameters, with the compiled sweeps."""
        if self._sweeps is None:
            self._sweeps = build_sweeps(self._statement, self._mesh, self._pairs)
            self._groups = penalty_groups(self._statement, self._mesh, self._sweeps.terminal.rows)
        return make_space(self._sweeps, self._groups, parameters, guess)

    def _trajectory(self, iterate: Iterate) -> Trajectory:
        """The run of an iterate as data."""
        run, nx = iterate.run, self._statement.nx
        u = self._mesh.acting(run.u.T).T
        return Trajectory(x=run.z[:, :nx], u=u, e=run.z[:, nx:], duration=run.duration)

    def _outcome(self, space: Space, end: End, misled: str, stats: dict[str, Any]) -> Outcome:
        """The last iterate as data; `misled`: the reason of a run that failed, where its steps are too long."""
        run = end.iterate.run
        return Outcome(
            extremal=with_tied_multipliers(
                Extremal(
                    stated=self._statement,
                    mesh=self._mesh,
                    trajectory=self._trajectory(end.iterate),
                    parameters=space.parameters,
                    multipliers=space.multipliers(end.iterate, end.measures),
                )
            ),
            cost_terms={"terminal": run.terminal, "running": run.running},
            converged=end.status is Status.SOLVED,
            message=end.status.told(misled),
            violations=space.violations(end.iterate, self._settings.violation_tolerance),
            stats=stats,
        )


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """One iteration of 4.2 or 4.3 and what it predicted; every number in the source's notation.

    I_kk (q, q), I_kj (q,), I_jj: the integrals of step 4. ell (q,): step 5. change (K, nu): du of step 6 at the control
    values; duration_change: dT. predicted_cost, actual_cost: dJ; predicted_miss, actual_miss: dz(T).
    """

    I_kk: Array
    I_kj: Array
    I_jj: float
    ell: Array
    change: Array
    duration_change: float
    predicted_cost: float
    actual_cost: float
    predicted_miss: Array
    actual_miss: Array

    __repr__ = short_repr


def one_iteration(
    statement: Statement, options: Options, *, weight: Given = 1.0, fraction: float = 1.0, duration_weight: float = 1.0
) -> Iteration:
    """One gradient iteration from the guess of the controls as it stands, without step control.

    Args:
        statement: the problem; its guess must be arrays or functions (a number would be bent).
        options: mesh.
        weight: W, as in `prepare`.
        fraction: d of step 5.
        duration_weight: b of 4.3, for a free terminal time.

    Returns:
        Integrals, step, predicted and actual changes.
    """
    solver = prepare(statement, options, weight=weight, fraction=fraction)
    mesh, parameters = solver.mesh, statement.values
    x0, _, e0, _ = (np.nan_to_num(v) for v in statement.boundary_values(parameters))
    u = controls_guess(statement, mesh.nodes, mesh.control)
    nodes = np.ones((mesh.intervals + 1, 1))
    start = Trajectory(x=nodes * x0, u=u, e=nodes * e0, duration=statement.duration.guess)
    space = solver.space(parameters, Guess(trajectory=start))
    space = replace(space, extra=np.full(space.extra.size, duration_weight))
    current = space.first(Guess(trajectory=start))
    linear = space.linearise(current)
    metric = space.metric(current, linear, np.zeros(space.conditions), weight)
    n = space.controls
    inner = metric[:n][:, :n].tocsc()
    target = -fraction * current.run.miss
    step = solve_step(learnt(metric, ()), linear.slope, linear.rows, target, *space.room(current))
    following = space.at(current.point + step.change)
    solved = splu(inner).solve(np.column_stack([linear.slope[:n], linear.rows[:, :n].T]))
    return Iteration(
        I_kk=linear.rows[:, :n] @ solved[:, 1:],
        I_kj=linear.rows[:, :n] @ solved[:, 0],
        I_jj=float(linear.slope[:n] @ solved[:, 0]),
        ell=step.ell,
        change=step.change[:n].reshape(u.shape),
        duration_change=following.run.duration - current.run.duration,
        predicted_cost=float(linear.slope @ step.change),
        actual_cost=following.run.cost - current.run.cost,
        predicted_miss=linear.rows @ step.change,
        actual_miss=following.run.miss - current.run.miss,
    )
