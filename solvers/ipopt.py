"""Multiple shooting with Ipopt, or any other NLP plugin of CasADi."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from covocp.checks import check_positive, is_whole
from covocp.errors import ProblemError, describe
from covocp.extremal import Extremal, Guess, Outcome
from covocp.guess import choose_scales, quadrature_weights, stiffness
from covocp.hamiltonian import without_passage
from covocp.integrators import COMPILED_SOLVER
from covocp.matrices import Array
from covocp.mesh import Mesh, Options, choose_mesh, choose_step
from covocp.nlp import NLP
from covocp.progress import Progress
from covocp.shooting import transcribe
from covocp.statement import Statement

TOLERANCE = 1e-7
MAX_ITERATIONS = 1000
HISTORY = 20  # of the limited-memory Hessian, measured on the chain of masses
# Shooting states are scaled by more than their magnitude where the Hessian is of limited memory: it then learns the
# curvature along the controls first (chain of 9 masses: 15 iterations instead of 21).
STRETCH = 10.0
# Relative length of the step along the gradient by which the curvature of the cost is probed.
PROBE = 1e-4
SMALLEST_CURVATURE = 1e-6

JIT: dict[str, Any] = {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O2"]}}

# Covariances of a closed loop start where they were simulated, some close to their bound of zero, which they never
# reach: the barrier must not move them far. Best gain: Mars entry takes 10 iterations and had no end before. Free gain:
# measured on seven structures and bounds of the gain of the lag, on two grids.
INSIDE: dict[str, dict[str, Any]] = {
    "best gain": {"mu_init": 1e-5, "bound_push": 1e-8, "bound_frac": 1e-8},
    "free gain": {"mu_init": 1e-2, "bound_push": 1e-4, "bound_frac": 1e-4},
}

MESSAGES = {
    "Solve_Succeeded": "solved",
    "Solved_To_Acceptable_Level": "solved to the acceptable level only: the tolerance asked for was not reached",
    "Infeasible_Problem_Detected": "converged to a point of local infeasibility: the constraints may contradict",
    "Maximum_Iterations_Exceeded": "stopped at the largest number of iterations: start closer, or allow more "
    "(max_iterations=)",
    "Restoration_Failed": "the restoration of feasibility failed: the constraints may contradict, or start elsewhere",
    "User_Requested_Stop": "interrupted by the user",
    "Diverging_Iterates": "the iterates diverge: the cost may be unbounded below; add bounds",
    "Search_Direction_Becomes_Too_Small": "no further progress is possible at this accuracy",
    "Invalid_Number_Detected": "the model became NaN or inf: add bounds that keep it in its domain",
}


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
    step = choose_step(statement, options)
    stiff = stiffness(statement, options.nodes(), options.control, statement.values, matrices=step == "rk4")
    mesh = choose_mesh(statement, options, stiff)
    limited = hessian == "limited-memory" or (hessian == "auto" and mesh.eliminated and bool(statement.matrices))
    limited = limited and plugin == "ipopt"
    settings: dict[str, Any] = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False}
    settings["calc_lam_p"] = False
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
            settings["ipopt"] |= INSIDE["best gain" if statement.behind else "free gain"]
        if limited:
            settings["ipopt"] |= {"hessian_approximation": "limited-memory", "limited_memory_max_history": HISTORY}
    if compile:
        settings |= JIT
        mesh = replace(mesh, linear_solver=COMPILED_SOLVER)
    for key, value in (plugin_options or {}).items():
        settings[key] = {**settings.get(key, {}), **value} if isinstance(value, Mapping) else value
    return ShootingSolver(statement, mesh, plugin, settings, limited)


def _check_options(tolerance: Any, max_iterations: Any, hessian: Any, plugin: Any) -> None:
    """Refuse options that mean nothing, or nothing to the plugin."""
    if tolerance is not None:
        check_positive("tolerance", tolerance)
    if max_iterations is not None and not is_whole(max_iterations, 0):
        raise _option_error("max_iterations", "a number of iterations: 0, 1, 2, ...", max_iterations)
    if hessian not in ("auto", "exact", "limited-memory"):
        raise _option_error("hessian", "'auto', 'exact' or 'limited-memory'", hessian)
    if not ca.has_nlpsol(plugin):
        raise ProblemError(
            describe(
                "The NLP plugin is not there.",
                expected="a plugin of this CasADi, such as 'ipopt' or 'sqpmethod'",
                received=repr(plugin),
                remedy="correct plugin=, or install a CasADi that has it",
            )
        )
    given = {
        "tolerance": tolerance,
        "max_iterations": max_iterations,
        "hessian": None if hessian == "auto" else hessian,
    }
    for name, value in given.items():
        if plugin != "ipopt" and value is not None:
            raise _option_error(name, f"nothing: it is Ipopt's, and '{plugin}' takes plugin_options", value)


def _option_error(name: str, expected: str, received: Any) -> ProblemError:
    return ProblemError(
        describe(
            f"The option '{name}' has a value that does not apply.",
            expected=expected,
            received=repr(received),
            remedy=f"correct {name}=",
        )
    )


class ShootingSolver:
    """A transcribed problem with its NLP solver; the NLP is built at the first guess, which gives its scales."""

    def __init__(self, statement: Statement, mesh: Mesh, plugin: str, settings: dict[str, Any], limited: bool) -> None:
        """Keep the settings; see `prepare`."""
        self._statement, self._mesh = statement, mesh
        self._plugin, self._settings, self._limited = plugin, settings, limited
        self._monitor: _Monitor | None = None
        self._nlp: NLP | None = None
        self._cold: ca.Function | None = None
        self._warm: ca.Function | None = None

    @property
    def mesh(self) -> Mesh:
        """The resolved mesh."""
        return self._mesh

    def solve(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Solve for these parameters from this guess; the last iterate is returned whatever happens."""
        begin = time.perf_counter()
        with self._hushed(progress):
            nlp, solver = self._build(parameters, guess)
        bounds = nlp.bounds(parameters)
        w0 = np.clip(nlp.pack(guess.trajectory), bounds["lbx"], bounds["ubx"])
        scale = self._cost_scale(solver, w0, parameters)
        arguments: dict[str, Any] = {"x0": w0, "p": np.append(parameters, scale), **bounds}
        if guess.multipliers is not None and guess.costates is not None:
            lam_x, lam_g = nlp.pack_multipliers(guess.multipliers, guess.costates)
            arguments |= {"lam_x0": lam_x / scale, "lam_g0": lam_g / scale}
        built = time.perf_counter()
        if self._monitor is not None:
            self._monitor.attach(progress, scale, bounds)
        try:
            with self._hushed(progress):
                result = solver(**arguments)
        except RuntimeError as error:  # a plugin that gives up by raising; its last iterate is lost, the start is not
            result = {"x": ca.DM(w0), "lam_x": ca.DM.zeros(w0.size), "lam_g": ca.DM.zeros(bounds["lbg"].size)}
            reason = str(error).strip().splitlines()[-1]
            stats: dict[str, Any] = {"success": False, "return_status": f"{self._plugin} gave up: {reason}"}
        else:
            stats = solver.stats()
        w, lam_x, lam_g = (np.asarray(result[name].full()).ravel() for name in ("x", "lam_x", "lam_g"))
        counts = {
            "iterations": int(stats.get("iter_count", -1)),
            "build_seconds": built - begin,
            "solve_seconds": time.perf_counter() - built,
            "return_status": str(stats.get("return_status", "")),
            "hessian": "limited-memory" if self._limited else "exact",
        }
        return self._outcome(nlp, w, scale * lam_x, scale * lam_g, parameters, bool(stats["success"]), counts)

    @contextmanager
    def _hushed(self, progress: Progress) -> Iterator[None]:
        """Other plugins than Ipopt print their iterations, each by options of its own: only where somebody watches."""
        if self._plugin == "ipopt" or progress.shown:
            yield
            return
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            yield

    def _outcome(
        self, nlp: NLP, w: Array, lam_x: Array, lam_g: Array, parameters: Array, success: bool, stats: dict[str, Any]
    ) -> Outcome:
        """The iterate as data."""
        trajectory, values = nlp.unpack(w, parameters)
        extremal = Extremal(
            statement=self._statement,
            mesh=self._mesh,
            trajectory=trajectory,
            parameters=parameters,
            multipliers=nlp.unpack_multipliers(lam_x, lam_g, trajectory, parameters),
        )
        status = stats["return_status"]
        return Outcome(
            extremal=without_passage(extremal),
            cost_terms={"terminal": values["terminal"], "running": values["running"]},
            converged=success,
            message=self._message(success, status),
            violations=nlp.violations(values["g"], parameters),
            stats=stats,
        )

    def _message(self, success: bool, status: str) -> str:
        """How the run ended, a sentence."""
        if self._plugin == "ipopt" and status in MESSAGES:
            return MESSAGES[status]
        return "solved" if success else f"{self._plugin} ended with the status '{status}'"

    def _build(self, parameters: Array, guess: Guess) -> tuple[NLP, ca.Function]:
        """The NLP and its solver, made at the first call; a second solver shares the functions for warm starts."""
        if self._nlp is None or self._cold is None:
            scales = choose_scales(self._statement, self._mesh, guess.trajectory, parameters)
            if self._limited:
                # in these units equal changes of two control values cost the same, however long their intervals are
                weights = quadrature_weights(self._mesh)
                units = np.sqrt(weights.mean() / weights)[:, None]
                scales = replace(scales, x=STRETCH * scales.x, u=scales.u * units)
            self._nlp = transcribe(self._statement, self._mesh, scales)
            if self._plugin == "ipopt":
                self._monitor = _Monitor(self._nlp)
            self._cold = self._make({})
        if not guess.warm or self._plugin != "ipopt" or guess.multipliers is None:
            return self._nlp, self._cold
        if self._warm is None:
            shared = {"grad_f": "nlp_grad_f", "jac_g": "nlp_jac_g"} | (
                {} if self._limited else {"hess_lag": "nlp_hess_l"}
            )
            self._warm = self._make(
                {option: self._cold.get_function(name) for option, name in shared.items()}, warm=True
            )
        return self._nlp, self._warm

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
        try:
            return ca.nlpsol("nlp", self._plugin, {"x": nlp.w, "p": nlp.p, "f": nlp.f, "g": nlp.g}, settings)
        except RuntimeError as error:
            raise ProblemError(
                describe(
                    f"The NLP plugin '{self._plugin}' refuses its settings.",
                    expected="options that it has, in plugin_options; a C compiler where compile=True",
                    received=str(error).strip().splitlines()[-1],
                    remedy="correct plugin_options=, or leave compile= out",
                )
            ) from error

    def _cost_scale(self, solver: ca.Function, w0: Array, parameters: Array) -> float:
        """Curvature of the cost along its gradient at the start: in units of it the Hessian is of the order of one.

        Never above the size of the cost and of its slope by the controls, so that the tolerance keeps its meaning.
        """
        if self._plugin != "ipopt":  # each plugin has functions of its own, and a scaling of its own
            return 1.0
        gradient = solver.get_function("nlp_grad_f")
        p = np.append(parameters, 1.0)
        value, first = (np.asarray(v.full()).ravel() for v in gradient(w0, p))
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


class _Monitor(ca.Callback):
    """Ipopt's iteration callback: reports progress, and stops when the user asks."""

    def __init__(self, nlp: NLP) -> None:
        ca.Callback.__init__(self)
        self._sizes = {"x": nlp.w.shape[0], "g": nlp.g.shape[0], "p": nlp.p.shape[0], "f": 1}
        self._progress: Progress | None = None
        self._scale, self._iteration = 1.0, 0
        self._bounds: dict[str, Array] = {}
        self.construct("progress", {})

    def attach(self, progress: Progress, scale: float, bounds: dict[str, Array]) -> None:
        """Report to this progress from now on."""
        self._progress, self._scale, self._bounds, self._iteration = progress, scale, bounds, 0

    def get_n_in(self) -> int:
        """One for each output of the solver."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Whether to stop."""
        return 1

    def get_name_in(self, i: int) -> str:
        """Names of the outputs of the solver."""
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        """The name that nlpsol asks for."""
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Columns."""
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i).removeprefix("lam_")], 1)

    def has_eval_buffer(self) -> bool:
        """Numbers come as they lie in memory: matrices made of them would take longer than a small iteration."""
        return True

    def eval_buffer(self, arg: tuple[memoryview, ...], res: tuple[memoryview, ...]) -> int:
        """One iteration."""
        stop = False
        if self._progress is not None:
            cost, g = (np.frombuffer(arg[ca.nlpsol_out().index(name)], dtype=float) for name in ("f", "g"))
            violation = np.maximum(self._bounds["lbg"] - g, g - self._bounds["ubg"]).max(initial=0.0)
            self._progress.update(self._iteration, float(cost[0]) * self._scale, float(violation))
            self._iteration += 1
            stop = self._progress.stop
        np.frombuffer(res[0], dtype=float)[:] = stop
        return 0
