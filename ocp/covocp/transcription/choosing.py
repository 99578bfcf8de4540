"""What "auto" means: the mesh and the steps of a problem, chosen by its stiffness where the options leave them open."""

from __future__ import annotations

import numpy as np

from covocp.base.errors import ProblemError
from covocp.statement.statement import Statement
from covocp.transcription.before_reading import waits
from covocp.transcription.covariance_steps import StepKind
from covocp.transcription.mesh import STIFFNESS_PER_STEP, Mesh, Options, Stiffness, explicit_substeps, readings_at

# Shooting segments where matrices are eliminated; where there are many states as few as these, about so many states at
# the starts of all: an iteration of Ipopt takes as long as an evaluation there (chain of masses of 28 and 58 states).
ELIMINATED_SEGMENTS, FEWEST_SEGMENTS, SEGMENT_STATES = 10, 5, 120
# Logarithm of what a change may grow to within one of them. With e^17 a regulator of an unstable plant ended away from
# its optimum: by any control the end of a segment moves further than a cost can tell.
GROWTH = 5.0
# Entries of E and S up to which their step is written out in scalars where they are variables.
SCALAR_ENTRIES = 12
# Entries of covariances up to which a constraint on them along the path makes them variables. Chain of masses with a
# bound on the variance of the stiffness, 50 intervals, seconds of the first solve as variables and eliminated:
# 10 entries 0.42 and 0.71, 21 entries 0.92 and 1.26, 36 entries 5.4 and 1.5, 55 entries 9.7 and 2.3.
PATH_ENTRIES = 21
# h times the largest rate of a decaying nominal from which on classical Runge-Kutta diverges.
STABILITY_LIMIT = 2.78
# Steps an interval that a nominal may need by classical Runge-Kutta before it is stepped implicitly.
EXPLICIT_SUBSTEPS = 8
# Implicit steps an interval, at most: what happens faster than these has died out. DC motor with a time constant of
# 1/20 of an interval, error of the cost with 1, 2, 3, 4, 8 steps: 6e-3, 5e-4, 1e-4, 1e-4, 2e-5.
IMPLICIT_SUBSTEPS = 4
# Gauss steps an interval, at least, where a gain is a control and the estimate learns all the time: by two of them a
# large gain while little is estimated costs nothing where the rule of the running cost does not look.
FED_SUBSTEPS = 4


def choose_mesh(statement: Statement, options: Options, step: StepKind, stiffness: Stiffness) -> Mesh:
    """Resolve every "auto".

    Args:
        statement: the problem.
        options: what the user asked for.
        step: as chosen by `choose_step`.
        stiffness: of the problem on this mesh (`guess.stiffness`).

    Raises:
        ProblemError: options that contradict the problem.
    """
    nodes = options.nodes()
    intervals = nodes.size - 1
    eliminated = _choose_eliminated(statement, options)
    if options.segments == "auto":
        count = intervals
        if eliminated and statement.matrices:
            grown = float(np.nan_to_num(intervals * stiffness.growing / GROWTH, posinf=intervals))
            usual = int(np.clip(SEGMENT_STATES // max(statement.nx, 1), FEWEST_SEGMENTS, ELIMINATED_SEGMENTS))
            count = min(max(usual, int(np.ceil(grown))), intervals)
    else:
        count = min(options.segments, intervals)
    if options.substeps == "auto":
        if step == "rodas":
            implicit = int(np.clip(np.ceil(np.sqrt(stiffness.nominal)), 1, IMPLICIT_SUBSTEPS))
            substeps = max(implicit, explicit_substeps(stiffness.oscillating))
        else:
            substeps = explicit_substeps(max(stiffness.nominal, stiffness.matrices if step == "rk4" else 0.0))
    else:
        substeps = options.substeps
    if step != "rodas" and stiffness.decaying > STABILITY_LIMIT * substeps:
        raise _too_few_substeps(substeps, stiffness.decaying)
    paired = statement.running_uses_matrices and (step != "rk4" or bool(statement.behind))
    if paired and statement.fed and options.substeps == "auto":
        substeps = max(substeps, FED_SUBSTEPS)
    if paired and substeps % 2:
        substeps += 1  # Simpson's rule for the running cost takes them in pairs
    substeps, points = _choose_points(statement, options, substeps, 2 if paired else 1)
    return Mesh(
        nodes=nodes,
        control=options.control,
        substeps=substeps,
        segments=segment_lengths(intervals, count),
        eliminated=eliminated,
        step=step,
        points=points,
        readings=readings_at(statement, nodes),
    )


def segment_lengths(intervals: int, count: int) -> tuple[int, ...]:
    """So many segments of as many intervals as possible, the longer ones first."""
    short, longer = divmod(intervals, count)
    return (short + 1,) * longer + (short,) * (count - longer)


def _choose_points(statement: Statement, options: Options, substeps: int, group: int) -> tuple[int, int]:
    """Substeps, and points of an interval where limits are imposed: ends of groups of so many substeps.

    An interval that needs substeps holds changes that its ends do not show, which the optimiser would use.

    Raises:
        ProblemError: given substeps that do not end at the given points.
    """
    if options.substeps == "auto" and _asks_for_gain(statement):
        substeps = max(substeps, 2 * group)  # the spread of the controls is free where it begins, at t = 0
    if not (statement.path.size or statement.bounded_states):
        return substeps, 1
    if options.points == "auto":
        return substeps, max(1, substeps // group)
    least = options.points * group if options.points > 1 else 1
    if options.substeps != "auto" and substeps % least:
        raise ProblemError(
            f"The points at which limits are imposed are no ends of {'pairs of ' * (group > 1)}integration steps.",
            expected=f"substeps={least}, {2 * least}, ... for points={options.points}",
            received=f"substeps={options.substeps}",
            remedy="leave substeps='auto', or take a divisor of them as points",
        )
    return -(-substeps // least) * least, options.points


def _asks_for_gain(statement: Statement) -> bool:
    """Whether a gain is free because X is in a condition or a cost, perhaps of another phase.

    By one Runge-Kutta step an interval a large gain at the start takes Xhat below zero, and the cost with it: runs
    from an optimum went on until they had no iterations left (a pendulum with a limit at the end that did not act).
    """
    loop = statement.loop
    if loop is None:
        return False
    return loop.shared or loop.spread is not None or any(entry.realised is not None for entry in statement.conditions)


def _too_few_substeps(substeps: int, rate: float) -> ProblemError:
    """Explicit steps that diverge."""
    needed = int(np.ceil(rate / STIFFNESS_PER_STEP))
    return ProblemError(
        "The integration steps of the nominal are too long: classical Runge-Kutta diverges.",
        expected=f"about {needed} steps an interval: the fastest rate of the system, at its start, times the "
        f"longest interval is {rate:.3g}",
        received=f"{substeps} steps an interval",
        remedy=f"leave step= and substeps= 'auto' (implicit steps where they apply), or give substeps={needed} or "
        "more intervals",
    )


def choose_step(statement: Statement, options: Options, stiffness: Stiffness) -> StepKind:
    """The step of nominal and covariances.

    Args:
        statement: the problem.
        options: what the user asked for.
        stiffness: of the problem on this mesh.

    Returns:
        "rodas" where the nominal is too stiff for explicit steps, or asked for; else the covariance step.

    Raises:
        ProblemError: a step that does not apply.
    """
    covariance = _choose_covariance_step(statement, options, stiffness)
    riccati = statement.riccati_forms
    possible = riccati and not statement.fed and options.covariance_step in ("auto", "gauss")
    if options.step == "rodas" and not possible:
        raise ProblemError(
            "step='rodas' does not apply: it goes with gauss steps of the covariances.",
            expected="matrices of Riccati or Lyapunov form, stepped by gauss, that the nominal does not depend on",
            received="a gain that is a control, and an estimate that learns all the time"
            if statement.fed
            else f"covariance_step='{options.covariance_step}'"
            if riccati
            else "a matrix of another form: " + ", ".join(block.name for block in statement.matrices),
            remedy="leave step='auto', with more substeps= where the system is stiff",
        )
    needed = explicit_substeps(stiffness.nominal)
    too_few = options.substeps == "auto" or options.substeps < needed
    dies_out = explicit_substeps(stiffness.oscillating) <= EXPLICIT_SUBSTEPS
    stiff = options.step == "auto" and needed > EXPLICIT_SUBSTEPS and too_few and dies_out
    return "rodas" if possible and (options.step == "rodas" or stiff) else covariance


def _choose_covariance_step(statement: Statement, options: Options, stiffness: Stiffness) -> StepKind:
    """The covariance step: gauss where every rate has the Riccati form, else rk4.

    Where E and S of a closed loop are variables and small, rk4: written out in scalars, its exact derivatives cost a
    third of those of gauss's linear systems (lag of section 6.12, 6 entries). For large ones these are cheaper (Mars
    entry, 30 entries: 1.6 and 0.2 s for Hessian and Jacobian, with rk4 1.8 and 0.7 s and twice the memory).

    Where a gain is a control and all is measured all the time, few steps of rk4 are cheaper than those that keep Xhat
    semidefinite, and do: a wall of a double integrator takes a third of the time. Readings make it as narrow as can be.
    So many steps as a stiff nominal needs are too many to be written out.
    """
    riccati = statement.riccati_forms
    if options.covariance_step == "auto":
        small = statement.ne <= SCALAR_ENTRIES
        stated = bool(statement.behind) and small and not _choose_eliminated(statement, options)
        if statement.fed:
            many = explicit_substeps(stiffness.matrices) > EXPLICIT_SUBSTEPS
            stiff = explicit_substeps(stiffness.nominal) > EXPLICIT_SUBSTEPS
            stated = stiff or (statement.samples is None and not many)
        return "gauss" if riccati and not stated else "rk4"
    if options.covariance_step != "rk4" and not riccati:
        pairs = zip(statement.matrices, statement.riccati, strict=True)
        names = [block.name for block, form in pairs if form is None and block.role == "moving"]
        reason = "feeds back into the nominal" if statement.coupled else "is not of the form F E + E F' + Q - E W E"
        raise ProblemError(
            f"covariance_step='{options.covariance_step}' does not apply: the rate of "
            f"{', '.join(names) or 'a matrix'} {reason}.",
            expected="rates of Riccati or Lyapunov form that depend on the nominal only",
            received=", ".join(names) or "a coupled problem",
            remedy="use covariance_step='rk4' (or leave it 'auto')",
        )
    if options.covariance_step == "strang" and statement.fed:
        raise ProblemError(
            "covariance_step='strang' does not apply: the covariance of the estimate gains what its error loses, all "
            "the time.",
            expected="'gauss' or 'rk4' where a gain is a control",
            received="covariance_step='strang'",
            remedy="leave covariance_step='auto'",
        )
    return options.covariance_step


def _choose_eliminated(statement: Statement, options: Options) -> bool:
    """Whether the matrices are eliminated: where they can be, are no integrals, and no path constraint needs a few.

    Eliminated is faster for every covariance of benchmarks/measurements/formulations.py, down to a single variance.
    Integrals along the nominal have second derivatives that cost nothing as variables, and their sum over the whole
    path is ill-conditioned without them: an information matrix of 21 entries takes 45 iterations and 1.5 s, eliminated
    900 and 10 s (`models.designed_excitation`). A gain that acts only along what was read has curvature of very
    different size in its directions: an ellipse at the end takes 7 iterations with exact second derivatives, with an
    approximate Hessian 655.
    """
    if not statement.matrices:
        return True
    obstacle = against_elimination(statement)
    if options.covariances == "eliminated" and obstacle:
        raise ProblemError(
            "The matrices cannot be eliminated.",
            expected="matrices that follow from the nominal",
            received=obstacle,
            remedy="use covariances='states' (or leave it 'auto')",
        )
    if options.covariances != "auto":
        return options.covariances == "eliminated"
    if statement.integrals or waits(statement) or statement.fed:
        return False
    few = statement.loop is not None or statement.ne <= PATH_ENTRIES
    return not obstacle and not (statement.path.uses_matrices and few)


def against_elimination(statement: Statement) -> str:
    """Why the matrices of a shooting method cannot be eliminated; "" where they can.

    A method that propagates them always, such as gradient steps, does so all the same.
    """
    tied = () if statement.tied is None else statement.tied.matrices
    own = sorted(set(statement.entries(statement.ahead)) - set(tied))
    initial = statement.boundary_values(statement.values)[2][own]
    if statement.coupled:
        return "the rate of a state depends on a matrix"
    if np.isnan(initial).any():
        return "an initial value of a matrix is free"
    if statement.fed:
        return "a gain is a control"
    if bounded := _bounded_matrices(statement):
        return f"the diagonal of {', '.join(bounded)} has a lower bound that its rate does not ensure"
    return ""


def _bounded_matrices(statement: Statement) -> list[str]:
    """Matrices with lower bounds on the diagonal that only a variable can keep.

    An estimation covariance stays positive semidefinite by itself, and so does a state of Riccati or Lyapunov form
    that is only asked not to be negative.
    """
    names = []
    for block, form in zip(statement.matrices, statement.riccati, strict=True):
        lower = statement.matrix_lower[block.span]
        lower = lower[np.isfinite(lower)]
        if lower.size and not block.estimation and (form is None or lower.max() > 0):
            names.append(block.name)
    return names
