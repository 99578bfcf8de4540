"""Runs of an NLP solver from one start, each in the scales of the point that the last one reached."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.matrices import Array, as_array
from covocp.base.progress import Progress
from covocp.base.residuals import LEFT, VIOLATION, Residuals
from covocp.extremal.costates import without_passage
from covocp.extremal.extremal import ENDED, STOPPED, Extremal, Guess, Merit, Outcome
from covocp.solvers.at_point import AtPoint, Nodes
from covocp.solvers.endings import Ending
from covocp.solvers.monitor import Monitor
from covocp.solvers.plugins import silent
from covocp.solvers.reached import (
    FirstOrder,
    Magnitudes,
    Point,
    Round,
    Start,
    as_given,
    carried,
    not_zero,
    reached_scales,
    residuals,
    similar,
    vanished,
    within_bounds,
)
from covocp.solvers.rounds import HELPED, best_of, helped, left, share_for
from covocp.solvers.statuses import Status, status_of
from covocp.transcription.program import Arrays, Program, Trajectories
from covocp.transcription.separable import FOR_OWN, slopes

MAX_ITERATIONS = 1000
# Runs from one start, each in the scales of the point that the last one reached.
LARGEST_ROUNDS = 6
# Runs beside these that ended where they began: the tolerance is still to be tightened until they move.
MOST_IDLE = 6
# So many of them are in the scales that the user gave; where these do not do, the point tells better.
GIVEN_ROUNDS = 3
# Iterations of a run that met its tolerance but not the limit, if none before took more; where the Hessian is learnt.
FEW_MORE, FEW_MORE_LEARNT = 50, 300
# Relative length of the step along the gradient by which the curvature of the cost is probed.
PROBE = 1e-4
SMALLEST_CURVATURE = 1e-6
# Distance from the optimum in magnitudes, of slopes, below which a run starts at rest: nothing smaller is a unit.
AT_REST = 1e-9

# Solvers of a program: from a start, from one with multipliers, and where a run crawled: with a Hessian that begins
# with this, so that a step along a slope without curvature goes to the bounds (17 of 36 experiments with bounded inputs
# ran into the limit of iterations). From the start on that finds other minima, of 60 random problems two worse ones.
Kind = Literal["cold", "warm", "bold"]
BOLD = 1e-4
# Options of functions of CasADi that are compiled.
COMPILED = ("jit", "compiler", "jit_options", "jit_cleanup", "jit_serialize")

NOT_EVALUABLE = "the model has no values where the solver ended (this is its start): bound what leaves its domain; {}"

STALE = "the tolerance was met in the scales of the start, but not in those of the point that was reached"
REMEDY = "start closer (guess=), or give the magnitudes of states and controls (scale=)"


class Runs:
    """Runs of an NLP solver on one program; it is built at the first start, which gives its scales."""

    # What is made of a program, and of no other.
    _OF_PROGRAM: tuple[str, ...] = ("_nlp", "_monitor", "_solvers", "_functions", "_nodes", "_slopes")

    def __init__(
        self,
        build: Callable[[Magnitudes | None, Trajectories, Arrays], Program],
        plugin: str,
        settings: dict[str, Any],
        limited: bool,
        limit: float,
    ) -> None:
        """Keep the settings.

        Args:
            build: the program in some magnitudes; None: in those of trajectories, with these parameters.
            plugin: of CasADi.
            settings: of the plugin.
            limited: whether its Hessian is of limited memory.
            limit: of the residuals of a converged point.
        """
        self._build_program = build
        self._plugin, self._settings, self._limited, self._limit = plugin, settings, limited, limit
        # Ipopt tells its functions and its iterations, and takes multipliers to start from
        self._open = plugin == "ipopt"
        self._strictness = self._share = 1.0  # of the tolerance, and of the unit of the cost
        self._patience: int | None = None  # iterations of a run from a point that has converged
        self._most = settings.get("ipopt", {}).get("max_iter", MAX_ITERATIONS)
        self._monitor: Monitor | None = None
        self._nlp: Program | None = None
        self._solvers: dict[Kind, Any] = {}  # of the program
        self._functions: Any = None  # the solver of it that was made first and has the functions of all
        self._nodes: Nodes | None = None  # its functions, where they are had together
        self._slopes: FirstOrder | None = None

    def solve(self, parameters: Arrays, guesses: tuple[Guess, ...], progress: Progress) -> tuple[Round, dict[str, Any]]:
        """Run from these guesses, one for each part; the last iterate is returned whatever happens.

        Where the run converged in the scales of the start, but not in those of the point it reached, it goes on from
        there in new ones.

        Returns:
            The last run, and its counts.
        """
        begin = time.perf_counter()
        self._share, self._patience = 1.0, None
        if self._strictness < 1.0:
            self._strictness = 1.0
            self._solvers.pop("warm", None)
        trajectories = tuple(guess.trajectory for guess in guesses)
        known = [(g.multipliers, g.costates) for g in guesses if g.multipliers is not None and g.costates is not None]
        dual = len(known) == len(guesses)
        warm = dual and all(guess.warm for guess in guesses)
        units = tuple(guess.scales for guess in guesses if guess.scales is not None)
        known_units = units if len(units) == len(guesses) else None
        if any(guess.rival and not guess.alike for guess in guesses):
            self._nlp = None  # magnitudes of the way through an obstacle are none of those round it
        nlp, solver = self._build(known_units, trajectories, parameters, warm, progress.shown)
        built = time.perf_counter()
        start = Start(w=nlp.pack(trajectories))
        if dual:
            lam_x, lam_g = nlp.pack_multipliers([m for m, _ in known], [c for _, c in known])
            start = Start(w=start.w, lam_x=lam_x, lam_g=lam_g)
        tentative = any(guess.tentative for guess in guesses)
        first = self._run(nlp, solver, start, parameters, progress, tentative)
        lost = self._lost_way(first.status)
        if lost and tentative:  # there are other starts
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
        unsettled = last.converged and not last.settled and last.residuals is not None
        counts[LEFT] = last.residuals.left if unsettled and last.residuals is not None else 0.0
        counts |= {"concave": True} if any(entry.point.concave for entry in rounds) else {}
        return last, counts | lost | ({"rounds": len(rounds)} if len(rounds) > 1 else {})

    def merit(self, parameters: Arrays, trajectories: Trajectories) -> Merit:
        """Of trajectories, in the program that they would be solved in."""
        nlp, _ = self._build(None, trajectories, parameters, False, False)
        return self._first_order().merit(nlp.pack(trajectories), parameters)

    def _rounds(self, nlp: Program, first: Point, parameters: Arrays, progress: Progress) -> list[Round]:
        """The first run judged in the scale of the point it reached, and further ones from there until that holds.

        A round that fails is followed by one without multipliers. The last entry is the one to return: a converged one,
        or the best.
        """
        done = [self._judged(nlp, first, parameters)]
        begun: tuple[Any, ...] = ()
        idle, made, kept = 0, self._made(), None
        while not done[-1].settled and not progress.stop and len(done) < LARGEST_ROUNDS + min(idle, MOST_IDLE):
            best = best_of(done)
            if best.converged and not helped(done):
                break
            if best.residuals is None or sum(entry.point.iterations for entry in done) >= self._most:
                break
            if best.converged and kept is None:
                kept = self._made()
            given = len(done) < GIVEN_ROUNDS
            if best.converged and len(done) == 1:  # first in the program that there is: another one takes its time
                own, start = nlp, Start(w=best.point.w, lam_x=best.point.lam_x, lam_g=best.point.lam_g)
            else:
                own, start = self._rescaled(best, nlp, parameters, dual=done[-1] is best, given=given)
            before, begun = begun, (id(best), done[-1] is best)
            # the run would end where it begins, or as the last one did, which began there too
            if self._open and ((done[-1] is best and own is best.nlp) or before == begun):
                self._tighten(best.residuals if best.converged else best.residuals.of_changes())
            more = FEW_MORE_LEARNT if self._limited else FEW_MORE
            self._patience = max(more, *(entry.point.iterations for entry in done)) if best.converged else None
            point = self._run(own, self._solver(start.lam_x is not None), start, parameters, progress)
            found = self._judged(own, point, parameters, again=True)
            # magnitudes that vanish with the cost leave nothing to compare it with, but the point before
            better = best.converged and left(found) <= HELPED * left(best)
            done.append(replace(found, converged=found.converged or better))
            idle += point.iterations == 0
        kept = self._made() if kept is None else kept  # what has converged in a program is solved again in that
        self.__dict__.update(made if vanished(nlp, kept["_nlp"]) else kept)
        if not done[-1].settled:
            done.append(done.pop(done.index(best_of(done))))
        return done

    def _made(self) -> dict[str, Any]:
        """What was made of the present program."""
        return {name: getattr(self, name) for name in self._OF_PROGRAM}

    def _tighten(self, found: Residuals) -> None:
        """Ask more of the runs that follow.

        Of the slope by larger numbers, not by a smaller tolerance: differences of the cost that are much smaller than
        one are taken for nothing by Ipopt's filter, which then goes by the roundoff of the constraints.
        """
        slope = max(found.slope, found.complementarity) / self._limit
        missed = max(found.infeasibility / self._limit, found.violation / VIOLATION)
        if slope > 1.0:
            self._share *= share_for(slope)
        if missed > 1.0:
            self._strictness *= share_for(missed)
            self._solvers.pop("warm", None)

    def _judged(self, nlp: Program, point: Point, parameters: Arrays, again: bool = False) -> Round:
        """A run, from such a point or not, with its residuals where it ended at a point that may be stationary."""
        where = point.where
        status = self._ending(point.status)
        if not (point.success or (status is not None and status.judged) or self._ran_out()):
            return Round(nlp=nlp, point=point, where=where, residuals=None, converged=False, settled=False)
        first = self._first_order()
        found = residuals(first, point, parameters, where, None)
        if not found.hold(self._limit):  # an upper bound so far
            scales = reached_scales(nlp, where[0], parameters, again=again)
            found = residuals(first, point, parameters, where, scales)
            if not found.hold(self._limit):
                inside = within_bounds(nlp, point, parameters)
                its = residuals(first, inside, parameters, inside.where, scales)
                kept = found.hold_of_changes(self._limit)
                if its.hold(self._limit) or (not kept and its.hold_of_changes(self._limit)):
                    point, where, found = inside, inside.where, its
        converged = found.hold(self._limit) or found.hold_of_changes(self._limit)
        settled = found.settle(self._limit)
        return Round(nlp=nlp, point=point, where=where, residuals=found, converged=converged, settled=settled)

    def _ran_out(self) -> bool:
        """Whether the last run took all the iterations that a point which has converged may be left for."""
        return self._patience is not None and self._monitor is not None and self._monitor.spent

    def _rescaled(
        self, last: Round, first: Program, parameters: Arrays, dual: bool, given: bool
    ) -> tuple[Program, Start]:
        """The NLP in the scales of the point that a run reached, or the given ones, and that point in its units."""
        nlp = last.nlp
        reached = reached_scales(nlp, last.where[0], parameters, again=nlp is not first)
        scales = not_zero(nlp, as_given(nlp, reached) if given else reached)
        if nlp is not self._nlp or not similar(nlp, scales):
            self._transcribe(scales, last.where[0], parameters)
        assert self._nlp is not None
        return self._nlp, carried(last.point, nlp, self._nlp, dual=dual)

    def _run(
        self,
        nlp: Program,
        solver: Any,
        start: Start,
        parameters: Arrays,
        progress: Progress,
        tentative: bool = False,
    ) -> Point:
        """One run of the NLP solver; a tentative one may be given up."""
        bounds = nlp.bounds(parameters)
        w0 = np.clip(start.w, bounds["lbx"], bounds["ubx"])
        scale = self._cost_scale(w0, parameters)
        arguments: dict[str, Any] = {"x0": w0, "p": nlp.p_of(parameters, scale), **bounds}
        if start.lam_x is not None and start.lam_g is not None:
            arguments |= {"lam_x0": start.lam_x / scale, "lam_g0": start.lam_g / scale}
        if self._monitor is not None:
            self._monitor.attach(progress, scale, bounds, tentative, self._may_crawl, self._patience)
        result, stats = self._called(solver, arguments)
        concave = bool(stats.get("concave"))
        if self._monitor is not None and self._monitor.crawled:
            concave = True
            self._monitor.attach(progress, scale, bounds, tentative, patience=self._patience)
            taken = int(stats.get("iter_count", 0))
            arguments["x0"] = np.clip(_numbers(result["x"]), bounds["lbx"], bounds["ubx"])
            result, stats = self._called(self._solver(False, bold=True), arguments)
            stats["iter_count"] = int(stats.get("iter_count", 0)) + taken
        w, lam_x, lam_g = (_numbers(result[name]) for name in ("x", "lam_x", "lam_g"))
        if not stats["success"] and progress.spent and self._monitor is not None and self._monitor.best is not None:
            best = self._monitor.best
            w, lam_x, lam_g = best.w, best.lam_x, best.lam_g
        success, status = bool(stats["success"]), str(stats.get("return_status", ""))
        if self._monitor is not None and self._monitor.astray:
            status = Status.DIVERGING.name_of_ipopt
        evaluable = True
        try:
            where = nlp.unpack(w, parameters)
        except RuntimeError:  # a solve inside the model that gives up: the last iterate is lost, the start is not
            w, lam_x, lam_g, where = w0, 0.0 * lam_x, 0.0 * lam_g, nlp.unpack(w0, parameters)
            success, status, evaluable = False, NOT_EVALUABLE.format(status), False
        with np.errstate(over="ignore"):  # of iterates that left all numbers
            lam_x, lam_g = scale * lam_x, scale * lam_g
        return Point(
            w=w,
            lam_x=lam_x,
            lam_g=lam_g,
            where=where,
            success=success,
            status=status,
            iterations=int(stats.get("iter_count", -1)),
            evaluable=evaluable,
            concave=concave,
        )

    @property
    def _may_crawl(self) -> bool:
        """Whether a run may end in unit steps along the gradient, and what it begins with is not given."""
        own = self._settings.get("ipopt", {})
        return self._plugin == "ipopt" and self._limited and "limited_memory_init_val" not in own

    def _called(self, solver: Any, arguments: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """What the solver returns, and its counts; where it gives up by raising, the start."""
        try:
            found = solver(**arguments), dict(solver.stats())
            if (together := self._together()) is not None:
                together.rest()
            return found
        except (RuntimeError, np.linalg.LinAlgError) as error:
            w0, rows = arguments["x0"], arguments["lbg"].size
            reason = str(error).strip().splitlines()[-1]
            result = {"x": w0, "lam_x": np.zeros(w0.size), "lam_g": np.zeros(rows)}
            return result, {"success": False, "return_status": f"{self._plugin} gave up: {reason}"}

    def _ending(self, name: str) -> Ending | None:
        """The ending of that name; None for those that only a plugin knows."""
        return status_of(name)

    def _lost_way(self, status: str) -> dict[str, Any]:
        """Whether the run lost its way, as a count."""
        if self._monitor is not None and self._monitor.wandered:
            return {"wandered": STOPPED}
        known = self._ending(status)
        return {"wandered": ENDED} if known is not None and known.lost else {}

    def outcome(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Where the runs on the program of one statement end, as data; arguments as of `solve`."""
        last, counts = self.solve((parameters,), (guess,), progress)
        (extremal,) = extremals(last, (parameters,))
        values = last.where[1]
        return Outcome(
            extremal=without_passage(extremal),
            cost_terms={"terminal": values["terminal"], "running": values["running"]},
            converged=last.converged,
            message=self.message(last),
            violations=last.nlp.violations(values["g"], (parameters,)),
            stats=counts,
        )

    def message(self, last: Round) -> str:
        """How the run ended, a sentence."""
        status, known = last.point.status, self._ending(last.point.status)
        if last.converged:
            return str(known or Status.SOLVED) if last.point.success else str(Status.SOLVED)
        if last.residuals is not None and last.point.success:
            return f"{STALE}: {last.residuals}; {REMEDY}"
        if not last.point.evaluable:
            return status
        if known is Status.NO_STEP and not self._limited:  # what may find a way was given
            return Status.NO_STEP.words
        return f"{self._plugin} ended with the status '{status}'" if known is None else str(known)

    def _build(
        self, units: Magnitudes | None, trajectories: Trajectories, parameters: Arrays, warm: bool, watched: bool
    ) -> tuple[Program, Any]:
        """The program, made at the first call, in these units or those of the trajectories, and its solver.

        Other plugins than Ipopt print their iterations where somebody watches that call.
        """
        if self._nlp is None:
            if not self._open and not watched:
                self._settings = silent(self._plugin, self._settings)
            self._transcribe(units, trajectories, parameters)
        assert self._nlp is not None
        return self._nlp, self._solver(warm)

    def _transcribe(self, scales: Magnitudes | None, trajectories: Trajectories, parameters: Arrays) -> None:
        """The program in these scales."""
        self._nlp = self._build_program(scales, trajectories, parameters)
        if self._open:
            self._monitor = Monitor(self._nlp)
        self._solvers, self._functions, self._nodes, self._slopes = {}, None, None, None

    def _solver(self, warm: bool, bold: bool = False) -> Any:
        """The solver for starts with multipliers, or without; other plugins than Ipopt have one for all.

        `bold`: where a run crawled; one that begins with a small Hessian.
        """
        kind: Kind = "bold" if bold else "warm" if warm and self._open else "cold"
        if kind not in self._solvers:
            shared: dict[str, ca.Function] = {}
            if self._functions is not None:
                names = {"grad_f": "nlp_grad_f", "jac_g": "nlp_jac_g", "hess_lag": "nlp_hess_l"}
                names = {option: name for option, name in names.items() if option != "hess_lag" or not self._limited}
                shared = {option: self._functions.get_function(name) for option, name in names.items()}
            self._solvers[kind] = self._make(shared, kind)
            self._functions = self._functions or self._solvers[kind]
        return self._solvers[kind]

    def _make(self, functions: dict[str, ca.Function], kind: Kind = "cold") -> Any:
        nlp = self._nlp
        assert nlp is not None
        settings = {**self._settings, **functions}
        problem: dict[str, Any] = {"x": nlp.w, "p": nlp.p, "f": nlp.f, "g": nlp.g}
        # slopes that are had together, in compiled code, unless Ipopt is asked for others
        if nlp.gradient is not None and self._open and settings.get("no_nlp_grad"):
            self._nodes = self._nodes or Nodes(nlp)
            problem, settings = self._nodes.problem, {**settings, **self._nodes.slopes}
        elif nlp.pieces and not settings.keys() & {"jac_g", *FOR_OWN}:
            compiled: dict[str, Any] = {name: settings[name] for name in COMPILED if name in settings}
            own, sizes = (nlp.pieces, nlp.w, nlp.p, nlp.g.shape[0]), [part.statement.np for part in nlp.parts]
            owner = None if compiled else nlp.parts[0].statement  # which lives as long as what is made here
            settings = slopes(*own, second=not self._limited, sizes=sizes, options=compiled, owner=owner) | settings
        elif nlp.jacobian is not None and "jac_g" not in settings:
            outputs, names = [nlp.g, nlp.jacobian], (["x", "p"], ["g", "jac_g_x"])
            settings["jac_g"] = ca.Function("nlp_jac_g", [nlp.w, nlp.p], outputs, *names)
        if self._monitor is not None:
            settings["iteration_callback"] = self._monitor
        if kind == "bold":
            settings["ipopt"] = {**settings["ipopt"], "limited_memory_init_val": BOLD}
        if kind == "warm":
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
            return ca.nlpsol("nlp", self._plugin, problem, settings)
        except RuntimeError as error:
            raise ProblemError(
                f"The NLP plugin '{self._plugin}' refuses its settings.",
                expected="options that it has, in plugin_options; a C compiler where compile=True",
                received=str(error).strip().splitlines()[-1],
                remedy="correct plugin_options=, or leave compile= out",
            ) from error

    def _cost_scale(self, w0: Array, parameters: Arrays) -> float:
        """Curvature of the cost along its gradient at the start: in units of it the Hessian is of the order of one.

        Never above the size of the cost and of its slope by the controls, so that the tolerance keeps its meaning.
        """
        if not self._open:  # each plugin has functions of its own, and a scaling of its own
            return 1.0
        with np.errstate(all="ignore"):  # where numbers are too large to be squared there is no curvature to be seen
            return self._share * self._curvature_along(self._first_order(), w0, parameters)

    def _first_order(self) -> FirstOrder:
        """The slopes of the present program, by the functions of its solver where that tells them."""
        if self._slopes is None:
            assert self._nlp is not None
            self._slopes = FirstOrder(self._nlp, self._functions if self._open else None, self._together())
        return self._slopes

    def _together(self) -> AtPoint | None:
        """The functions of the present program, where they are had together."""
        return None if self._nodes is None else self._nodes.of

    def _curvature_along(self, of: FirstOrder, w0: Array, parameters: Arrays) -> float:
        """|g' H g| / g' g of the cost, g its slopes, and what stands for it where it is no number."""
        assert self._nlp is not None
        value, first = of.cost(w0, parameters)
        if not np.isfinite(value):
            self._nlp.check_finite(w0, parameters)
        size = float(np.linalg.norm(first))
        largest = max(abs(value), float(np.abs(first[self._nlp.chosen]).max(initial=0.0)))
        if not np.isfinite(size) or size == 0.0:
            return 1.0
        largest = largest if largest > 0.0 else size
        step = PROBE / size
        _, second = of.cost(w0 - step * first, parameters)
        curvature = abs(float((first - second) @ first)) / (step * size**2)
        if not np.isfinite(curvature):
            return largest
        return float(np.clip(curvature, SMALLEST_CURVATURE * largest, max(largest, AT_REST * curvature)))


def _numbers(value: Any) -> Array:
    """What a solver gives, a matrix of CasADi's or an array, as numbers one after the other."""
    return as_array(value).ravel().astype(float, copy=False)


def extremals(last: Round, parameters: Arrays) -> tuple[Extremal, ...]:
    """Where a run ended, as data."""
    nlp, point, trajectories = last.nlp, last.point, last.where[0]
    multipliers = nlp.unpack_multipliers(point.lam_x, point.lam_g, trajectories, parameters)
    return tuple(
        Extremal(stated=part.statement, mesh=part.mesh, trajectory=trajectory, parameters=own, multipliers=found)
        for (part, trajectory, own), found in zip(nlp.each(trajectories, parameters), multipliers, strict=True)
    )
