"""How much a combined design can gain over the classical one, before it is computed.

The classical design takes its nominal from the deterministic cost, so along it only the statistics have a slope by the
control: h_u = 1/2 [tr(P dE) + tr(S dXhat) + ...]_u [Schmidt 6.3-30]. The step d that lowers the expected cost most for
its size, int du' L_uu du dt, within the terminal conditions and the bounds, is

    d = -W^-1 (h_u + R'l),     W = L_uu (where that is singular: the scale of the controls),

and the first-order change of the expected cost along it, relative to that cost, is a figure of merit: zero where
nominal and statistics separate. For a cost that is quadratic with the curvature L_uu a full step would gain half of it;
how much is gained truly along d is seen by evaluating the expected cost at a few steps.
"""

from __future__ import annotations

from dataclasses import field, replace
from typing import Any

import numpy as np

from covocp.base.checks import check_kind
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, SolveError
from covocp.base.expressions import Given
from covocp.base.matrices import Array, distinct
from covocp.base.pages import Section, Sentence, Table, as_html, as_text
from covocp.base.threads import one_at_a_time
from covocp.extremal.costates import discrete_costates
from covocp.extremal.curvature import held_jacobian
from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.given_controls import evaluate_controls
from covocp.extremal.metric import mass_matrix
from covocp.problem.builder import Problem
from covocp.solution.solution import Solution
from covocp.solving.beside_classical import is_roundoff
from covocp.solving.evaluation import evaluate
from covocp.solving.once import solve
from covocp.statement.separation import separates
from covocp.transcription.first_guess import control_scale
from covocp.transcription.mesh import Options
from covocp.transcription.scales import magnitudes
from covocp.transcription.steering import Run, final_pull

# Steps along the statistical gradient at which the expected cost is evaluated.
# Corrections of the final values, and the miss, in magnitudes of the states, at which they end.
CORRECTIONS, MET = 12, 1e-8
# Largest miss of a final value, in the magnitude of its state, that is weighed to first order.
MISSED = 1e-3
STEPS = tuple(2.0 ** np.arange(2, -13, -1))
# Share of its cost by which that of a run along the controls of a classical design may differ: one that leaves the
# nominal of an unstable plant says nothing of what changes of the controls cost.
FOLLOWED = 1e-5
# Relative gains below which the classical design is as good, and above which the combined one is worth its while.
NOTHING, MUCH = 1e-4, 1e-2


@dataclass(frozen=True, kw_only=True, eq=False)
class Worth:
    """What a combined design promises.

    Attributes:
        classical: the classical design.
        first_order: first-order change of the expected cost for the full step along the statistical gradient, relative
            to the cost, positive; the cost of the deviations' slope in units of L_uu.
        gain: relative decrease of the expected cost found along the statistical gradient: a lower estimate of what the
            combined design gains.
        direction: of the control, at its values, (N + 1 or N, nu).
        step: share of the full step at which `gain` was found.
    """

    classical: Solution = field(repr=False)
    first_order: float
    gain: float
    direction: Array = field(repr=False)
    step: float

    @property
    def verdict(self) -> str:
        """What the numbers mean, a sentence."""
        if not np.isfinite([self.gain, self.first_order]).all():
            return "not known: the figures are no numbers"
        if self.gain >= MUCH:
            return f"worth solving: at least {100 * self.gain:.1f} % of the expected cost can be saved"
        if any(block.role == "decision" for block in self.classical.blocks):
            return "little to gain by the controls; decisions were held, and what others gain is not known"
        if self.gain < NOTHING and self.first_order < NOTHING:
            statement = self.classical.statement
            if statement is not None and separates(statement):
                return "nothing to gain: nominal and statistics separate; the classical design will do"
            return "nothing to gain: this nominal hardly moves the statistics; the classical design will do"
        return "little to gain: the classical design is nearly as good"

    def __str__(self) -> str:
        """The summary that print shows."""
        return as_text(self._sections())

    def _repr_html_(self) -> str:
        """What a notebook shows: the same summary."""
        return as_html(self._sections())

    def _sections(self) -> list[Section]:
        """The verdict, and the numbers behind it."""
        found = f", at {self.step:g} of the full step" if self.gain > 0 else ""
        rows = [
            ["expected cost of the classical design", f"{self.classical.cost:.8g}"],
            ["first-order change along the gradient", f"{100 * self.first_order:.3g} % of it"],
            ["decrease found along the gradient", f"{100 * self.gain:.3g} % of it{found}"],
        ]
        verdict = Sentence(f"{self.classical.name or 'problem without a name'}: {self.verdict}")
        return [[verdict, Table(columns=["", ""], rows=rows, words=(0, 1))]]


@one_at_a_time
def worth(problem: Problem, *, nominal: Given = None, intervals: int | None = None, **options: Any) -> Worth:
    """Estimate what choosing the nominal together with filter and feedback gains over the classical design.

    Decisions keep the values of `nominal`, which must be given where there are any: what others gain comes on top.

    Args:
        problem: with an expected cost.
        nominal: the classical nominal, as in `evaluate`; None: from the deterministic cost.
        intervals: number of control intervals; None: 100, along a solution its own mesh.
        options: of the mesh, as in `solve`.

    Returns:
        The estimate; it costs one deterministic solution and a few evaluations.

    Raises:
        ProblemError: no expected cost, constrained gains; decisions, or no deterministic cost, and no `nominal`.
        SolveError: the deterministic problem was not solved, something is NaN or inf along the nominal, or a run along
            its controls leaves it: the plant is too unstable to look along them.
    """
    check_kind(problem, Problem, "worth(problem), with minimize_expected()")
    expected = problem.declarations.expected
    if expected is None or expected.gain is not None:
        raise ProblemError(
            "worth() compares the classical with the combined design.",
            expected="a problem with minimize_expected() and the best gain",
            received=f"'{problem.name}' with " + ("a constrained gain" if expected else "minimize()"),
            remedy="compare solutions by their costs instead",
        )
    chosen = [state.name for state in problem.states if state.role == "decision"]
    if chosen and nominal is None:
        raise ProblemError(
            f"worth() looks along the controls, and '{chosen[0]}' is a decision: which value is meant?",
            expected="nominal=, which gives the decisions too",
            received="decisions: " + ", ".join(chosen),
            remedy="give nominal=solve(problem, nominal='deterministic'), or a dict of controls and decisions",
        )
    if nominal is None:
        classical = solve(problem, intervals=intervals, nominal="deterministic", progress=False, **options)
    else:
        classical = evaluate(problem, nominal=nominal, intervals=intervals, **options)
    _check_numbers(classical)
    size, extremal = abs(classical.cost), classical.extremal
    mesh = Options(grid=distinct(extremal.mesh.nodes), control=classical.mesh.control)  # type: ignore[arg-type]
    alike = nominal is None and separates(extremal.statement)
    if alike or is_roundoff(size, extremal.statement, mesh, extremal.parameters):
        still = np.zeros_like(extremal.trajectory.u)
        return Worth(classical=classical, first_order=0.0, gain=0.0, direction=still, step=0.0)
    along = _followed(classical)
    cost = float(sum(along.cost_terms.values()))
    direction, ell, slope = _statistical_gradient(along.extremal)
    first = float(-np.sum(slope * direction)) / size
    gain, best = 0.0, 0.0
    for step in STEPS if first > np.finfo(float).eps else ():
        decrease = (cost - _changed(along.extremal, step * direction, ell)) / size
        if decrease > gain:
            gain, best = decrease, step
        elif best:
            break
    return Worth(classical=classical, first_order=first, gain=gain, direction=direction, step=best)


def _check_numbers(classical: Solution) -> None:
    """There must be a classical design: else nothing could be gained over it, whatever the truth is.

    Raises:
        SolveError: the run along the nominal is not finite.
    """
    if not classical.converged or not np.isfinite(classical.cost):
        told = "" if classical.converged else f": {classical.message}"
        raise SolveError(
            f"worth() compares with the classical design of '{classical.name}', which has none along this nominal"
            f"{told}.",
            expected="a nominal along which states, covariances, conditions and the expected cost are finite",
            received=f"an expected cost of {classical.cost:g}",
            remedy="give another nominal, or bounds that keep the model in its domain",
            solution=classical,
        )


def _followed(classical: Solution) -> Outcome:
    """The classical design by one run along its controls, which must stay at its nominal.

    Raises:
        SolveError: it does not.
    """
    own, t = classical.extremal, classical.extremal.trajectory
    if len(own.mesh.segments) == 1:
        terms = dict(classical.cost_terms)
        return Outcome(extremal=own, cost_terms=terms, converged=True, message="", violations={}, stats={})
    mesh = replace(own.mesh, segments=(own.mesh.intervals,), eliminated=True)
    run = evaluate_controls(own.statement, mesh, t.u, t.duration, own.parameters, t.x[0])
    cost = float(sum(run.cost_terms.values()))
    if run.converged and abs(cost - classical.cost) <= FOLLOWED * abs(classical.cost):
        return run
    raise SolveError(
        f"worth() looks along the controls, and '{classical.name}' is too unstable for that: by roundoff a run along "
        "those of the classical design leaves its nominal.",
        expected=f"an expected cost of {classical.cost:.8g} of that run",
        received=f"{cost:.8g}",
        remedy="compare the costs of both designs: solve(problem), and solve(problem, nominal='deterministic')",
        solution=classical,
    )


def _statistical_gradient(extremal: Extremal) -> tuple[Array, Array, Array]:
    """Step d, multipliers l of what is held, slope of the expected cost by the control values (without l)."""
    st, mesh, u = extremal.statement, extremal.mesh, extremal.trajectory.u
    _, slopes, _ = discrete_costates(extremal)
    rows = held_jacobian(extremal)
    scale = np.concatenate([control_scale(st, b, u[:, b.span]) for b in st.controls])
    given = _metric(extremal)
    plain = np.asarray(np.kron(mass_matrix(mesh, extremal.trajectory.duration, 1).full(), np.diag(scale**-2.0)))
    metric = plain if given is None else given
    lower, upper = st.control_bounds
    free = ~np.repeat(np.isin(np.arange(mesh.control_nodes), mesh.idle), st.nu)
    for _ in range(u.size):
        solved = np.linalg.solve(metric[np.ix_(free, free)], np.column_stack([slopes.ravel()[free], rows[:, free].T]))
        gram = rows[:, free] @ solved[:, 1:]
        ell = -np.linalg.pinv(gram, rcond=1e-10) @ (rows[:, free] @ solved[:, 0])
        direction = np.zeros(u.size)
        direction[free] = -(solved[:, 0] + solved[:, 1:] @ ell)
        d = direction.reshape(u.shape)
        stuck = (((u <= lower) & (d < 0)) | ((u >= upper) & (d > 0))).ravel() & free
        if not stuck.any():
            break
        free &= ~stuck
    step = np.asarray(direction.reshape(mesh.control_nodes, st.nu))
    if given is None:  # no curvature tells how far to go: as far as the control's own scale
        step /= max(float(np.abs(step / scale).max(initial=0.0)), float(np.finfo(float).tiny))
    return step, ell, slopes


def _metric(extremal: Extremal) -> Array | None:
    """int du' L_uu du dt over the control values; None where L_uu is singular."""
    st, mesh = extremal.statement, extremal.mesh
    assert st.loop is not None
    x, u, _, t, duration, p = extremal.columns()
    count = mesh.intervals + 1
    B = np.asarray(st.loop.expansion.map(count)(x, u, t, duration, p)[3].full())
    extra = np.asarray(st.loop.extra_control.map(count)(x, u, t, duration, p).full())
    curvature = (B - extra).reshape(st.nu, count, st.nu).transpose(1, 0, 2).mean(axis=0)
    if np.linalg.eigvalsh(curvature)[0] <= 0:
        return None
    return np.asarray(np.kron(mass_matrix(mesh, extremal.trajectory.duration, 1).full(), curvature))


def _changed(extremal: Extremal, change: Array, ell: Array) -> float:
    """The expected cost after a change of the controls, within their bounds and to the same final values.

    What steering leaves of a miss is weighed by l; where bounds leave much of it the change is none that is possible,
    and costs inf.
    """
    st, t = extremal.statement, extremal.trajectory
    mesh = replace(extremal.mesh, segments=(extremal.mesh.intervals,), eliminated=True)
    u, fixed = np.clip(t.u + change, *st.control_bounds), ~np.isnan(st.boundary_values(extremal.parameters)[1])
    scales = magnitudes(st, t, extremal.parameters)
    if fixed.any():
        known = {"start": t.x[0], "duration": t.duration, "parameters": extremal.parameters}
        run = Run(statement=st, mesh=mesh, scale=scales.x, units=scales.u, **known)
        u = _met(run, tuple(np.flatnonzero(fixed).tolist()), t.x[-1, fixed], u)
    outcome = evaluate_controls(st, mesh, u, t.duration, extremal.parameters, t.x[0])
    missed = (outcome.extremal.trajectory.x[-1] - t.x[-1])[fixed]
    if not (np.abs(missed) <= MISSED * scales.x[fixed]).all():
        return np.inf
    cost = float(sum(outcome.cost_terms.values())) + float(ell[: missed.size] @ missed)
    return cost if np.isfinite(cost) else np.inf


def _met(run: Run, fixed: tuple[int, ...], target: Array, u: Array) -> Array:
    """Controls near the given ones, within their bounds, that bring some states to final values where they can.

    Each correction is that of least energy by the controls that are not at a bound.
    """
    lower, upper = run.statement.control_bounds
    for _ in range(CORRECTIONS):
        gap, slope = final_pull(run, fixed, target, u, often=False)
        free = ((u > lower) & (u < upper)).ravel()
        if not np.isfinite(slope).all() or not np.linalg.norm(gap) > MET or not free.any():
            break
        weighed = slope[:, free] / run.weights[free]
        change = np.zeros(u.size)
        change[free] = -weighed.T @ np.linalg.pinv(weighed @ slope[:, free].T, rcond=1e-10) @ gap
        u = run.clip(u + change.reshape(u.shape))
    return u
