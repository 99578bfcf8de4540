"""Multiple shooting with Ipopt, or any other NLP plugin of CasADi."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.arguments import checked, mapping, one_of, optional, positive, text, truth, whole
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.linear_solve import COMPILED_SOLVER
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.residuals import LIMIT
from covocp.extremal.costates import without_passage
from covocp.extremal.extremal import ENDED, STOPPED, Extremal, Guess, Outcome
from covocp.solvers.monitor import Monitor
from covocp.solvers.plugins import merged, silent
from covocp.solvers.reached import (
    FirstOrder,
    Point,
    Round,
    Start,
    carried,
    not_zero,
    reached_scales,
    residuals,
    similar,
)
from covocp.solvers.statuses import Status, status_of
from covocp.statement.statement import Statement
from covocp.transcription.domain import needs_exact_bounds
from covocp.transcription.first_guess import starts
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.nlp import NLP, QUIET, Scales, check_finite
from covocp.transcription.scales import choose_scales, evened
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.transcribing import transcribe

TOLERANCE = 1e-7
MAX_ITERATIONS = 1000
# What is left at a point is judged by residuals of the first order, larger than tolerances on slopes by this factor.
LIMIT_PER_TOLERANCE = LIMIT / TOLERANCE
# Runs from one start, each in the scales of the point that the last one reached.
LARGEST_ROUNDS = 6
# A run that ends after so few iterations had met its tolerance where it began: the next one has this share of it.
AT_ONCE, STRICTER = 1, 0.03
HISTORY = 20  # of the limited-memory Hessian, measured on the chain of masses
# Relative length of the step along the gradient by which the curvature of the cost is probed.
PROBE = 1e-4
SMALLEST_CURVATURE = 1e-6

JIT: dict[str, Any] = {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O2"]}}

# Covariances of a closed loop start where they were simulated, some close to their bound of zero, which they never
# reach: the barrier must not move them far. Best gain: Mars entry takes 10 iterations and had no end before. Free gain:
# measured on seven structures and bounds of the gain of the lag, on two grids. A gain that conditions on X ask for
# begins where it nearly meets them; where gains count for little, at the start, a barrier that falls by steps wanders,
# and steps that may leave the neighbourhood of the start end at gains so large that no integration step follows them.
INSIDE: dict[str, dict[str, Any]] = {
    "best gain": {"mu_init": 1e-5, "bound_push": 1e-8, "bound_frac": 1e-8},
    "free gain": {"mu_init": 1e-2, "bound_push": 1e-4, "bound_frac": 1e-4},
    "asked gain": {
        "mu_strategy": "adaptive",
        "adaptive_mu_globalization": "kkt-error",
        "theta_max_fact": 0.1,
        "bound_push": 1e-4,
        "bound_frac": 1e-4,
    },
}

NOT_EVALUABLE = "the model has no values where the solver ended (this is its start): bound what leaves its domain; {}"

STALE = "the tolerance was met in the scales of the start, but not in those of the point that was reached"
REMEDY = "start closer (guess=), or give the magnitudes of states and controls (scale=)"


@checked(
    "the method 'ipopt'",
    tolerance=optional(positive),
    max_iterations=optional(whole(0)),
    hessian=one_of("auto", "exact", "limited-memory"),
    plugin=text,
    plugin_options=optional(mapping),
    compile=truth,
)
def prepare(
    statement: Statement,
    options: Options,
    *,
    tolerance: float | None = None,
    max_iterations: int | None = None,
    hessian: str = "auto",
    plugin: str = "ipopt",
    plugin_options: Mapping[str, Any] | None = None,
    compile: bool = False,
) -> ShootingSolver:
    """Transcribe a problem and make its NLP solver.

    Args:
        statement: the problem.
        options: mesh and formulation.
        tolerance: of Ipopt, on the scaled optimality conditions; None: 1e-7.
        max_iterations: of Ipopt; None: 1000.
        hessian: of Ipopt: "auto" (limited-memory where matrices are eliminated, else exact), "exact" or
            "limited-memory".
        plugin: name of a CasADi NLP plugin, such as "ipopt", "sqpmethod" or "fatrop"; another one than Ipopt takes its
            own settings by plugin_options, and shows its own iterations where there is a terminal.
        plugin_options: passed to CasADi's nlpsol as they are.
        compile: whether the functions of the NLP are compiled by the C compiler of the machine.

    Returns:
        The solver; `solve` may be called often.

    Raises:
        ProblemError: an option is wrong, or the model is not finite where the solver starts.
    """
    _check_options(tolerance, max_iterations, hessian, plugin)
    mesh = resolve_mesh(statement, options, statement.values)
    limited = hessian == "limited-memory" or (hessian == "auto" and mesh.eliminated and bool(statement.matrices))
    limited = limited and plugin == "ipopt"
    settings: dict[str, Any] = dict(QUIET)
    if plugin == "ipopt":
        settings["ipopt"] = {
            "print_level": 0,
            "sb": "yes",
            "tol": TOLERANCE if tolerance is None else tolerance,
            "max_iter": MAX_ITERATIONS if max_iterations is None else max_iterations,
            # multipliers of fixed variables come from the costates; Ipopt would evaluate the gradient twice for them
            "fixed_variable_treatment": "make_parameter_nodual",
        }
        if statement.loop is not None and not mesh.eliminated:
            settings["ipopt"] |= INSIDE[_gain_kind(statement)]
        start, e0 = starts(statement, mesh, statement.values)
        # a decided variance that is relaxed below its bound would be negative
        if statement.decisions or needs_exact_bounds(statement, mesh, start, e0, statement.values):
            settings["ipopt"]["bound_relax_factor"] = 0.0
        if limited:
            settings["ipopt"] |= {"hessian_approximation": "limited-memory", "limited_memory_max_history": HISTORY}
    if compile:
        settings |= JIT
        mesh = replace(mesh, linear_solver=COMPILED_SOLVER)
    settings = merged(settings, plugin_options or {})
    limit = max(LIMIT, LIMIT_PER_TOLERANCE * settings.get("ipopt", {}).get("tol", TOLERANCE))
    return ShootingSolver(statement, mesh, plugin, settings, limited, limit)


def _gain_kind(statement: Statement) -> str:
    """Which of the settings of closed loops: by whether X, the covariance of the loop, is in costs or conditions."""
    if statement.behind:
        return "best gain"
    conditions = (statement.path, statement.start, statement.end)
    asked = any(entry.realised is not None for entry in conditions)
    asked = asked or (statement.loop is not None and statement.loop.spread is not None)
    return "asked gain" if asked else "free gain"


def _check_options(tolerance: Given, max_iterations: Given, hessian: Given, plugin: Given) -> None:
    """Refuse a plugin that is not there, and options that mean nothing to it."""
    if not ca.has_nlpsol(plugin):
        raise ProblemError(
            "The NLP plugin is not there.",
            expected="a plugin of this CasADi, such as 'ipopt' or 'sqpmethod'",
            received=repr(plugin),
            remedy="correct plugin=, or install a CasADi that has it",
        )
    given = {
        "tolerance": tolerance,
        "max_iterations": max_iterations,
        "hessian": None if hessian == "auto" else hessian,
    }
    for name, value in given.items():
        if plugin != "ipopt" and value is not None:
            raise ProblemError(
                f"The option '{name}' has a value that does not apply.",
                expected=f"nothing: it is Ipopt's, and '{plugin}' takes plugin_options",
                received=repr(value),
                remedy=f"correct {name}=",
            )


class ShootingSolver:
    """A transcribed problem with its NLP solver; the NLP is built at the first guess, which gives its scales."""

    def __init__(
        self, statement: Statement, mesh: Mesh, plugin: str, settings: dict[str, Any], limited: bool, limit: float
    ) -> None:
        """Keep the settings; see `prepare`. `limit`: of the residuals of a converged point."""
        self._statement, self._mesh = statement, mesh
        self._plugin, self._settings, self._limited, self._limit = plugin, settings, limited, limit
        self._strictness = 1.0
        self._most = settings.get("ipopt", {}).get("max_iter", MAX_ITERATIONS)
        self._monitor: Monitor | None = None
        self._nlp: NLP | None = None
        self._cold: ca.Function | None = None
        self._warm: ca.Function | None = None

    @property
    def mesh(self) -> Mesh:
        """The resolved mesh."""
        return self._mesh

    def solve(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Solve for these parameters from this guess; the last iterate is returned whatever happens.

        Where the run converged in the scales of the start, but not in those of the point it reached, it goes on from
        there in new ones.
        """
        begin = time.perf_counter()
        if self._strictness < 1.0:
            self._strictness, self._warm = 1.0, None
        nlp, solver = self._build(parameters, guess, progress.shown)
        built = time.perf_counter()
        start = Start(w=nlp.pack(guess.trajectory))
        if guess.multipliers is not None and guess.costates is not None:
            lam_x, lam_g = nlp.pack_multipliers(guess.multipliers, guess.costates)
            start = Start(w=start.w, lam_x=lam_x, lam_g=lam_g)
        first = self._run(nlp, solver, start, parameters, progress, guess.tentative)
        lost = self._lost_way(first.status)
        if lost and guess.tentative:  # there are other starts
            rounds = [self._judged(nlp, first, parameters)]
        else:
            rounds = self._rounds(nlp, first, parameters, progress)
        last = rounds[-1]
        counts = {
            "iterations": sum(entry.point.iterations for entry in rounds) if last.point.iterations >= 0 else -1,
            "build_seconds": built - begin,
            "solve_seconds": time.perf_counter() - built,
            "return_status": last.point.status,
            "hessian": "limited-memory" if self._limited else "exact",
        }
        counts |= lost | ({"rounds": len(rounds)} if len(rounds) > 1 else {})
        return self._outcome(last, parameters, counts)

    def _rounds(self, nlp: NLP, first: Point, parameters: Array, progress: Progress) -> list[Round]:
        """The first run judged in the scale of the point it reached, and further ones from there until that holds.

        A round that fails is followed by one without multipliers. The last entry is the one to return: a converged one,
        or the best.
        """
        done = [self._judged(nlp, first, parameters)]
        while not done[-1].converged and not progress.stop and len(done) < LARGEST_ROUNDS:
            best = min(done, key=lambda entry: entry.worst)
            if best.residuals is None or sum(entry.point.iterations for entry in done) >= self._most:
                break
            at_once = 0 <= done[-1].point.iterations <= AT_ONCE
            if self._plugin == "ipopt" and done[-1] is best and at_once:  # new scales alone do not move it
                self._tighten()
            nlp, start = self._rescaled(best, done[0].nlp, parameters, dual=done[-1] is best)
            solver = self._warm_solver() if start.lam_x is not None else self._cold
            assert solver is not None
            point = self._run(nlp, solver, start, parameters, progress)
            done.append(self._judged(nlp, point, parameters, again=True))
        if not done[-1].converged:
            done.append(done.pop(done.index(min(done, key=lambda entry: entry.worst))))
        return done

    def _tighten(self) -> None:
        """Ask more of Ipopt in the warm starts that follow."""
        self._strictness *= STRICTER
        self._warm = None

    def _judged(self, nlp: NLP, point: Point, parameters: Array, again: bool = False) -> Round:
        """A run, from such a point or not, with its residuals where it ended at a point that may be stationary."""
        where = point.where
        status = status_of(point.status)
        if not (point.success or (status is not None and status.judged)):
            return Round(nlp=nlp, point=point, where=where, residuals=None, converged=False)
        assert self._cold is not None
        first = FirstOrder(nlp, self._cold, self._plugin)
        found = residuals(first, point, parameters, where, None)
        if not found.hold(self._limit):  # an upper bound so far
            found = residuals(first, point, parameters, where, reached_scales(nlp, where[0], parameters, again=again))
        return Round(nlp=nlp, point=point, where=where, residuals=found, converged=found.hold(self._limit))

    def _rescaled(self, last: Round, first: NLP, parameters: Array, dual: bool) -> tuple[NLP, Start]:
        """The NLP in the scales of the point that a run reached, and that point in its units."""
        nlp = last.nlp
        scales = not_zero(nlp, reached_scales(nlp, last.where[0], parameters, again=nlp is not first))
        if nlp is not self._nlp or not similar(nlp, scales):
            self._transcribe(scales)
        assert self._nlp is not None
        return self._nlp, carried(last.point, nlp, self._nlp, dual=dual)

    def _run(
        self,
        nlp: NLP,
        solver: ca.Function,
        start: Start,
        parameters: Array,
        progress: Progress,
        tentative: bool = False,
    ) -> Point:
        """One run of the NLP solver; a tentative one may be given up."""
        bounds = nlp.bounds(parameters)
        w0 = np.clip(start.w, bounds["lbx"], bounds["ubx"])
        scale = self._cost_scale(solver, w0, parameters)
        arguments: dict[str, Any] = {"x0": w0, "p": np.append(parameters, scale), **bounds}
        if start.lam_x is not None and start.lam_g is not None:
            arguments |= {"lam_x0": start.lam_x / scale, "lam_g0": start.lam_g / scale}
        if self._monitor is not None:
            self._monitor.attach(progress, scale, bounds, tentative)
        try:
            result = solver(**arguments)
        except RuntimeError as error:  # a plugin that gives up by raising; its last iterate is lost, the start is not
            result = {"x": ca.DM(w0), "lam_x": ca.DM.zeros(w0.size), "lam_g": ca.DM.zeros(bounds["lbg"].size)}
            reason = str(error).strip().splitlines()[-1]
            stats: dict[str, Any] = {"success": False, "return_status": f"{self._plugin} gave up: {reason}"}
        else:
            stats = solver.stats()
        w, lam_x, lam_g = (np.asarray(result[name].full()).ravel() for name in ("x", "lam_x", "lam_g"))
        success, status = bool(stats["success"]), str(stats.get("return_status", ""))
        evaluable = True
        try:
            where = nlp.unpack(w, parameters)
        except RuntimeError:  # a solve inside the model that gives up: the last iterate is lost, the start is not
            w, lam_x, lam_g, where = w0, 0.0 * lam_x, 0.0 * lam_g, nlp.unpack(w0, parameters)
            success, status, evaluable = False, NOT_EVALUABLE.format(status), False
        return Point(
            w=w,
            lam_x=scale * lam_x,
            lam_g=scale * lam_g,
            where=where,
            success=success,
            status=status,
            iterations=int(stats.get("iter_count", -1)),
            evaluable=evaluable,
        )

    def _lost_way(self, status: str) -> dict[str, Any]:
        """Whether the run lost its way, as a count."""
        if self._monitor is not None and self._monitor.wandered:
            return {"wandered": STOPPED}
        known = status_of(status)
        return {"wandered": ENDED} if known is not None and known.lost else {}

    def _outcome(self, last: Round, parameters: Array, stats: dict[str, Any]) -> Outcome:
        """The iterate as data."""
        nlp, point = last.nlp, last.point
        trajectory, values = last.where
        extremal = Extremal(
            stated=self._statement,
            mesh=self._mesh,
            trajectory=trajectory,
            parameters=parameters,
            multipliers=nlp.unpack_multipliers(point.lam_x, point.lam_g, trajectory, parameters),
        )
        return Outcome(
            extremal=without_passage(extremal),
            cost_terms={"terminal": values["terminal"], "running": values["running"]},
            converged=last.converged,
            message=self._message(last),
            violations=nlp.violations(values["g"], parameters),
            stats=stats,
        )

    def _message(self, last: Round) -> str:
        """How the run ended, a sentence."""
        status, known = last.point.status, status_of(last.point.status)
        if last.converged:
            return str(known or Status.SOLVED) if last.point.success else str(Status.SOLVED)
        if last.residuals is not None and last.point.success:
            return f"{STALE}: {last.residuals}; {REMEDY}"
        if not last.point.evaluable:
            return status
        return f"{self._plugin} ended with the status '{status}'" if known is None else str(known)

    def _build(self, parameters: Array, guess: Guess, watched: bool) -> tuple[NLP, ca.Function]:
        """The NLP and its solver, made at the first call; a second solver shares the functions for warm starts.

        Other plugins than Ipopt print their iterations where somebody watches that call.
        """
        if self._nlp is None or self._cold is None:
            if self._plugin != "ipopt" and not watched:
                self._settings = silent(self._plugin, self._settings)
            self._transcribe(choose_scales(self._statement, self._mesh, guess.trajectory, parameters))
        assert self._nlp is not None
        assert self._cold is not None
        if not guess.warm or guess.multipliers is None:
            return self._nlp, self._cold
        return self._nlp, self._warm_solver()

    def _transcribe(self, scales: Scales) -> None:
        """The NLP in these scales, and its solver."""
        if self._limited:
            scales = evened(scales, self._mesh)
        self._nlp = transcribe(self._statement, self._mesh, scales)
        if self._plugin == "ipopt":
            self._monitor = Monitor(self._nlp)
        self._cold, self._warm = self._make({}), None

    def _warm_solver(self) -> ca.Function:
        """The solver for starts with multipliers; other plugins than Ipopt have one for all."""
        assert self._cold is not None
        if self._plugin != "ipopt":
            return self._cold
        if self._warm is None:
            shared = {"grad_f": "nlp_grad_f", "jac_g": "nlp_jac_g"} | (
                {} if self._limited else {"hess_lag": "nlp_hess_l"}
            )
            self._warm = self._make(
                {option: self._cold.get_function(name) for option, name in shared.items()}, warm=True
            )
        return self._warm

    def _make(self, functions: dict[str, ca.Function], warm: bool = False) -> ca.Function:
        nlp = self._nlp
        assert nlp is not None
        settings = {**self._settings, **functions}
        if nlp.jacobian is not None and "jac_g" not in settings:
            settings["jac_g"] = nlp.jacobian
        if self._monitor is not None:
            settings["iteration_callback"] = self._monitor
        if warm:
            settings["ipopt"] = {
                **settings["ipopt"],
                "warm_start_init_point": "yes",
                "warm_start_bound_push": 1e-8,
                "warm_start_mult_bound_push": 1e-8,
                "warm_start_slack_bound_push": 1e-8,
                "mu_init": 1e-6,
            }
            settings["ipopt"]["tol"] *= self._strictness
        try:
            return ca.nlpsol("nlp", self._plugin, {"x": nlp.w, "p": nlp.p, "f": nlp.f, "g": nlp.g}, settings)
        except RuntimeError as error:
            raise ProblemError(
                f"The NLP plugin '{self._plugin}' refuses its settings.",
                expected="options that it has, in plugin_options; a C compiler where compile=True",
                received=str(error).strip().splitlines()[-1],
                remedy="correct plugin_options=, or leave compile= out",
            ) from error

    def _cost_scale(self, solver: ca.Function, w0: Array, parameters: Array) -> float:
        """Curvature of the cost along its gradient at the start: in units of it the Hessian is of the order of one.

        Never above the size of the cost and of its slope by the controls, so that the tolerance keeps its meaning.
        """
        if self._plugin != "ipopt":  # each plugin has functions of its own, and a scaling of its own
            return 1.0
        with np.errstate(all="ignore"):  # where numbers are too large to be squared there is no curvature to be seen
            return self._curvature_along(solver.get_function("nlp_grad_f"), w0, np.append(parameters, 1.0))

    def _curvature_along(self, gradient: ca.Function, w0: Array, p: Array) -> float:
        """|g' H g| / g' g of the cost, g its slopes, and what stands for it where it is no number."""
        value, first = (np.asarray(v.full()).ravel() for v in gradient(w0, p))
        if not np.isfinite(value[0]) and self._nlp is not None:
            check_finite(self._nlp, w0, p[:-1])
        size = float(np.linalg.norm(first))
        count = self._mesh.control_nodes * self._statement.nu + int(self._statement.duration.free)
        largest = max(abs(float(value[0])), float(np.abs(first[first.size - count :]).max(initial=0.0)))
        if not np.isfinite(size) or size == 0.0:
            return 1.0
        largest = largest if largest > 0.0 else size
        step = PROBE / size
        second = np.asarray(gradient(w0 - step * first, p)[1].full()).ravel()
        curvature = abs(float((first - second) @ first)) / (step * size**2)
        return float(np.clip(curvature, SMALLEST_CURVATURE * largest, largest)) if np.isfinite(curvature) else largest
