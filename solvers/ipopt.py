"""Multiple shooting with Ipopt, or any other NLP plugin of CasADi."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca

from covocp.base.arguments import checked, mapping, one_of, optional, positive, text, truth, whole
from covocp.base.errors import ProblemError, warn_user
from covocp.base.expressions import Given
from covocp.base.linear_solve import COMPILED_SOLVER
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.residuals import LIMIT
from covocp.extremal.extremal import Guess, Merit, Outcome
from covocp.extremal.links import ChainOutcome
from covocp.passage.library import build_info
from covocp.passage.sweep import passed_by
from covocp.solvers.plugins import merged
from covocp.solvers.reached import Magnitudes
from covocp.solvers.runs import MAX_ITERATIONS, Runs, extremals
from covocp.statement.chain import Chain
from covocp.statement.statement import Statement
from covocp.transcription.domain import WIDENED, needs_exact_bounds
from covocp.transcription.first_guess import starts
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.nlp import QUIET
from covocp.transcription.pieces import is_separable
from covocp.transcription.program import Arrays, Program, Trajectories, alone, joined
from covocp.transcription.scales import choose_scales, evened
from covocp.transcription.sequences import Passage
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.trajectory import Trajectory
from covocp.transcription.transcribing import transcribe

TOLERANCE = 1e-7
# What is left at a point is judged by residuals of the first order, larger than tolerances on slopes by this factor.
LIMIT_PER_TOLERANCE = LIMIT / TOLERANCE
# Rows of a covariance up to which nobody waits for CasADi's own operations.
LARGEST_UNTOLD = 8
HISTORY = 20  # of the limited-memory Hessian, measured on the chain of masses
# Weight of violations where Ipopt decides whether a step must make the cost less (1 by default). Near an optimum
# violations are rounding: a step that lessens them is taken then at any cost, and one of a Hessian that is learnt may
# cost a hundredth. A slew was left so for a thousand iterations from where it needs ten more.
NO_BARGAIN = 1e-15
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

KINDS = {
    "tolerance": optional(positive),
    "max_iterations": optional(whole(0)),
    "hessian": one_of("auto", "exact", "limited-memory"),
    "plugin": text,
    "plugin_options": optional(mapping),
    "compile": truth,
}


@checked("the method 'ipopt'", **KINDS)
def prepare(
    statement: Statement,
    options: Options,
    parameters: Array | None = None,
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
        parameters: values (np,) that the mesh is made for; None: the declared ones.
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
    own = (tolerance, max_iterations, hessian, plugin, plugin_options, compile)
    values = (statement.values if parameters is None else parameters,)
    (mesh,), settings, limited, limit = _made_ready((statement,), (options,), values, *own)
    return ShootingSolver(statement, mesh, plugin, settings, limited, limit)


@checked("the method 'ipopt'", **KINDS)
def prepare_chain(
    chain: Chain,
    options: tuple[Options, ...],
    *,
    tolerance: float | None = None,
    max_iterations: int | None = None,
    hessian: str = "auto",
    plugin: str = "ipopt",
    plugin_options: Mapping[str, Any] | None = None,
    compile: bool = False,
) -> ChainSolver:
    """Transcribe a chain of problems and make its NLP solver; arguments and errors as of `prepare`.

    Args:
        chain: the problems.
        options: mesh and formulation of each.
        tolerance: of Ipopt.
        max_iterations: of Ipopt.
        hessian: of Ipopt.
        plugin: name of a CasADi NLP plugin.
        plugin_options: passed to CasADi's nlpsol as they are.
        compile: whether the functions of the NLP are compiled.
    """
    own = (tolerance, max_iterations, hessian, plugin, plugin_options, compile)
    values = tuple(statement.values for statement in chain.statements)
    meshes, settings, limited, limit = _made_ready(chain.statements, options, values, *own)
    return ChainSolver(chain, meshes, plugin, settings, limited, limit)


def _made_ready(
    statements: tuple[Statement, ...],
    options: tuple[Options, ...],
    parameters: Arrays,
    tolerance: float | None,
    max_iterations: int | None,
    hessian: str,
    plugin: str,
    plugin_options: Mapping[str, Any] | None,
    compile: bool,
) -> tuple[tuple[Mesh, ...], dict[str, Any], bool, float]:
    """Meshes, settings of the plugin, whether its Hessian is of limited memory, and what residuals may be left."""
    _check_options(tolerance, max_iterations, hessian, plugin)
    meshes = tuple(map(resolve_mesh, statements, options, parameters))
    pairs = list(zip(statements, meshes, strict=True))
    eliminated = any(mesh.eliminated and st.matrices for st, mesh in pairs)
    limited = hessian == "limited-memory" or (hessian == "auto" and eliminated)
    limited = limited and plugin == "ipopt"
    if limited and not compile:
        _mention_slowness(pairs)
    settings: dict[str, Any] = dict(QUIET)
    if plugin == "ipopt":
        settings["ipopt"] = {
            "print_level": 0,
            "sb": "yes",
            "tol": TOLERANCE if tolerance is None else tolerance,
            # bounds that are passed by a share of themselves make the cost less, on every mesh
            "bound_relax_factor": min(WIDENED, TOLERANCE if tolerance is None else tolerance),
            "max_iter": MAX_ITERATIONS if max_iterations is None else max_iterations,
            # multipliers of fixed variables come from the costates; Ipopt would evaluate the gradient twice for them
            "fixed_variable_treatment": "make_parameter_nodual",
            # above what MUMPS expects to need; it is given more where that is not enough. 1000 by default
            "mumps_mem_percent": 100,
        }
        for (statement, mesh), values in zip(pairs, parameters, strict=True):
            if statement.loop is not None and not mesh.eliminated:
                settings["ipopt"] |= INSIDE[_gain_kind(statement)]
            start, e0 = starts(statement, mesh, values)
            # a decided variance that is relaxed below its bound would be negative
            if statement.decisions or needs_exact_bounds(statement, mesh, start, e0, values):
                settings["ipopt"]["bound_relax_factor"] = 0.0
        if limited:
            settings["ipopt"] |= {"hessian_approximation": "limited-memory", "limited_memory_max_history": HISTORY}
            if eliminated:
                settings["ipopt"]["delta"] = NO_BARGAIN
    if compile:
        settings |= JIT
        meshes = tuple(replace(mesh, linear_solver=COMPILED_SOLVER) for mesh in meshes)
    settings = merged(settings, plugin_options or {})
    if plugin == "ipopt" and not any(str(name).startswith("calc_") and settings[name] for name in settings):
        settings["no_nlp_grad"] = True  # the slope of the Lagrangian by w and p, which nothing else asks for
    limit = max(LIMIT, LIMIT_PER_TOLERANCE * settings.get("ipopt", {}).get("tol", TOLERANCE))
    return meshes, settings, limited, limit


def _gain_kind(statement: Statement) -> str:
    """Which of the settings of closed loops: by whether X, the covariance of the loop, is in costs or conditions."""
    if statement.behind:
        return "best gain"
    asked = any(entry.realised is not None for entry in statement.conditions)
    asked = asked or (statement.loop is not None and statement.loop.shared)
    asked = asked or (statement.loop is not None and statement.loop.spread is not None)
    return "asked gain" if asked else "free gain"


def _mention_slowness(pairs: list[tuple[Statement, Mesh]]) -> None:
    """Tell that large covariances pass without compiled code."""
    info = build_info()
    sizes = [matrix.size for statement, mesh in pairs if mesh.eliminated for matrix in statement.matrices]
    if not info["compiled"] and max(sizes, default=0) > LARGEST_UNTOLD:
        warn_user(
            f"A covariance of {max(sizes)} rows is solved without the compiled passage, which is several times faster: "
            f"{info['library']}. Install a C compiler and covocp again; the numbers are the same."
        )


def _check_options(tolerance: Given, max_iterations: Given, hessian: Given, plugin: Given) -> None:
    """Refuse a plugin that is not there, and options that mean nothing to it."""
    if not _is_there(plugin):
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


@cache
def _is_there(plugin: str) -> bool:
    """Whether this CasADi has an NLP plugin; asking it looks for files each time."""
    return bool(ca.has_nlpsol(plugin))


class ShootingSolver:
    """A problem with its NLP solver; the NLP is built at the first guess, which gives its scales."""

    def __init__(
        self, statement: Statement, mesh: Mesh, plugin: str, settings: dict[str, Any], limited: bool, limit: float
    ) -> None:
        """Keep the settings; see `prepare`. `limit`: of the residuals of a converged point."""
        self._statement, self._mesh = statement, mesh
        taken = plugin == "ipopt"  # others differentiate the slopes themselves
        self._runs = Runs(_builder(None, (statement,), (mesh,), limited, taken), plugin, settings, limited, limit)

    @property
    def mesh(self) -> Mesh:
        """The resolved mesh."""
        return self._mesh

    def solve(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Solve for these parameters from this guess; the last iterate is returned whatever happens."""
        return self._runs.outcome(parameters, guess, progress)

    def merit(self, parameters: Array, trajectory: Trajectory) -> Merit:
        """What the controls of a trajectory cost, and how they meet the conditions."""
        return self._runs.merit((parameters,), (trajectory,))


class ChainSolver:
    """A chain of problems with its NLP solver; as `ShootingSolver`."""

    def __init__(
        self,
        chain: Chain,
        meshes: tuple[Mesh, ...],
        plugin: str,
        settings: dict[str, Any],
        limited: bool,
        limit: float,
    ) -> None:
        """Keep the settings; see `prepare_chain`."""
        self._chain, self._meshes = chain, meshes
        separable = all(is_separable(st, mesh) for st, mesh in zip(chain.statements, meshes, strict=True))
        build = _builder(chain, chain.statements, meshes, limited, plugin == "ipopt" and separable)
        self._runs = Runs(build, plugin, settings, limited, limit)

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """The resolved meshes."""
        return self._meshes

    def solve(self, parameters: Arrays, guesses: tuple[Guess, ...], progress: Progress) -> ChainOutcome:
        """Solve for these parameters from these guesses; the last iterate is returned whatever happens."""
        last, counts = self._runs.solve(parameters, guesses, progress)
        costs = [{name: entry[name] for name in ("terminal", "running")} for entry in last.where[1]["parts"]]
        return ChainOutcome(
            extremals=extremals(last, parameters),
            link_multipliers=last.nlp.link_multipliers(last.point.lam_g),
            bounds_at_ends=last.nlp.bounds_at_ends(last.point.lam_x),
            cost_terms=tuple(costs),
            converged=last.converged,
            message=self._runs.message(last),
            violations=last.nlp.violations(last.where[1]["g"], parameters),
            stats=counts,
            with_passages=True,
        )


def _builder(
    chain: Chain | None,
    statements: tuple[Statement, ...],
    meshes: tuple[Mesh, ...],
    limited: bool,
    taken: bool = False,
) -> Callable[[Magnitudes | None, Trajectories, Arrays], Program]:
    """What makes the program in some magnitudes, or in those of trajectories where there are none."""

    passage: Passage = passed_by if limited and chain is None else None

    def build(scales: Magnitudes | None, trajectories: Trajectories, parameters: Arrays) -> Program:
        pairs = list(zip(statements, meshes, strict=True))
        if scales is None:
            along = zip(pairs, trajectories, parameters, strict=True)
            scales = tuple(choose_scales(*pair, trajectory, own) for pair, trajectory, own in along)
        if limited:
            scales = tuple(evened(own, mesh) for own, mesh in zip(scales, meshes, strict=True))
        made = zip(pairs, scales, strict=True)
        parts = tuple(transcribe(*pair, own, passage, taken=taken) for pair, own in made)
        return alone(parts[0]) if chain is None else joined(chain, parts)

    return build
