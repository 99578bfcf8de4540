"""What a statement says and probably does not mean: nothing that could be learnt, readings that nothing reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from covocp.base.arguments import is_number
from covocp.base.errors import warn_user
from covocp.base.expressions import Given
from covocp.base.matrices import half_indices, real_numbers
from covocp.solving.kinked_costs import mention_kinks
from covocp.statement.names import chosen_entry
from covocp.statement.statement import Block, Statement
from covocp.transcription.mesh import Options

if TYPE_CHECKING:
    from covocp.problem.builder import Problem
    from covocp.problem.declarations import Declarations
    from covocp.problem.phases import Phases

# A guess with fewer rows than this share of the nodes is a row of waypoints.
WAYPOINTS = 0.5


def mention_forgotten(problem: Problem) -> None:
    """Warn of what is probably forgotten in a problem that is to be solved or evaluated; once for each statement."""
    if problem.doubts_told:
        return
    problem.doubts_told = True
    for mention in (_mention_nothing_learnt, _mention_unused_measurements, _mention_spread_noise, _mention_idle):
        mention(problem.declarations)
    mention_kinks(problem.declarations)


def mention_forgotten_in(phases: Phases) -> None:
    """Warn of controls on which nothing depends in their phase, and of kinks; once for each statement of the phases."""
    chain = phases.chain()
    if phases.doubts_told is chain:
        return
    phases.doubts_told = chain
    for name, problem in zip(phases.names, phases.problems, strict=True):
        _mention_idle(problem.stated, f" of the phase '{name}'")
        mention_kinks(problem.stated, name)


def mention_lengths(guesses: Mapping[str, Any], options: Options, statement: Statement) -> None:
    """Warn of guesses that look like values at the nodes and have another number of them.

    Args:
        guesses: by name.
        options: of the mesh, graded or not.
        statement: of the symbols, whose sizes tell what of a guess is over time.
    """
    blocks = {block.name: block for block in statement.blocks}
    known = {options.intervals, options.intervals + 1, options.nodes().size - 1, options.nodes().size}
    for name, guess in guesses.items():
        rows = _rows_over_time(guess, blocks.get(name))
        if rows >= WAYPOINTS * options.intervals and rows not in known:
            warn_user(
                f"The guess of '{name}' has {rows} rows, and {options.intervals} intervals have "
                f"{options.intervals + 1} nodes: its rows are taken as evenly spread over the duration. Give a row for "
                "each node, a few waypoints, or a function of t/T."
            )


def mention_clock(statement: Statement, elapsed: Given, parameters: Mapping[str, Any] | None) -> None:
    """Warn of a problem with a clock of its own that is planned again later on, and of which nothing says so."""
    later = is_number(elapsed) and elapsed > 0  # other values are refused where they are read
    if later and not statement.autonomous and (parameters is None or parameters == {}):
        warn_user(
            f"'{statement.name or 'The problem'}' depends on the time, which begins at 0 again: elapsed= says what is "
            "left of the guess and moves no clock. Write t0 + ocp.time with a parameter t0 and give its value "
            "(parameters={'t0': ...}); of data over time state the problem anew with those from now on."
        )


def _rows_over_time(guess: Given, block: Block | None) -> int:
    """Rows of a guess that is an array over time, 0 of any other: one value for each entry has no time.

    Such are the guesses of decisions and matrices, and those that gains have where the user gave none.
    """
    timeless = block is not None and (block.role != "moving" or block.kind == "matrix")
    if guess is None or callable(guess) or timeless:
        return 0
    try:
        shape = real_numbers(guess).shape
    except (TypeError, ValueError, OverflowError):  # no array: refused where it is read
        return 0
    size = 1 if block is None else block.size
    if not shape or (size > 1 and shape == (size,)):
        return 0
    if shape[1:] == (size,):
        return int(shape[0])
    return int(shape[1] if shape[0] == size and len(shape) == 2 else shape[0])


def _mention_nothing_learnt(problem: Declarations) -> None:
    """A cost or a condition of the variance of an unknown that no measurement depends on: it never changes."""
    E = next((matrix for matrix in problem.matrices if matrix.estimation), None)
    if E is None or not problem.unknowns:
        return
    seen = _seen(problem)
    unseen = {
        i
        for i, label in enumerate(E.labels)
        for q in problem.unknowns
        if label.split("[")[0] == q.name and q.symbol.__hash__() not in seen
    }
    rows, columns = half_indices(E.size)
    constant = [i in unseen and j in unseen for i, j in zip(rows, columns, strict=True)]
    if not any(constant) or _correlated(E.initial, unseen, rows, columns):
        return
    running, terminal = problem.cost if problem.cost is not None else (ca.MX(0), ca.MX(0))
    places = [("running cost", running), ("terminal cost", terminal)]
    places += [(f"condition '{c.name}'", c.expression) for c in problem.constraints]
    for what, expression in places:
        if not ca.depends_on(expression, E.symbol):
            continue
        used = ca.which_depends(expression, E.symbol, 1, False)
        names = sorted({E.labels[i] for i, u, c in zip(rows, used, constant, strict=True) if u and c})
        if names:
            listed = " and ".join(f"'{name}'" for name in names)
            reason = "no measurement depends on it" if problem.measurements else "there is no measurement"
            warn_user(
                f"Nothing is learnt about {listed}: {reason}, and its variance in the {what} keeps its first value "
                "whatever is done. Add measurement(name, expression, noise) of something that depends on it."
            )
            return


def _seen(problem: Declarations) -> set[int]:
    """Hashes of the symbols that measurements depend on, at once or through the rates of states."""
    rates = {s.symbol.__hash__(): problem.rates[s.name].rate for s in problem.states if s.name in problem.rates}
    seen: set[int] = set()
    waiting = [symbol for m in problem.measurements for symbol in ca.symvar(m.expression)]
    while waiting:
        key = waiting.pop().__hash__()
        if key not in seen:
            seen.add(key)
            waiting += ca.symvar(rates[key]) if key in rates else []
    return seen


def _correlated(initial: Given, unseen: set[int], rows: Given, columns: Given) -> bool:
    """Whether the first covariance joins what is not measured with the rest, or may do so."""
    if initial is None or ca.symvar(initial):
        return initial is not None and initial.nnz() > 0 and not _block_diagonal(initial, unseen, rows, columns)
    values = np.asarray(ca.evalf(ca.densify(initial)).full()).ravel()
    return any(v != 0 and (i in unseen) != (j in unseen) for v, i, j in zip(values, rows, columns, strict=True))


def _block_diagonal(initial: Given, unseen: set[int], rows: Given, columns: Given) -> bool:
    """Whether a symbolic first covariance has no entries between two groups of rows."""
    sparsity = (initial if isinstance(initial, ca.MX) else ca.sparsify(initial)).sparsity()
    present = set(sparsity.row())
    return not any(
        k in present and (i in unseen) != (j in unseen) for k, (i, j) in enumerate(zip(rows, columns, strict=True))
    )


def _mention_unused_measurements(problem: Declarations) -> None:
    """Measurements without a covariance of errors, an expected cost or a matrix of the user's own."""
    if problem.measurements and problem.expected is None and not problem.matrices:
        names = ", ".join(f"'{m.name}'" for m in problem.measurements)
        warn_user(
            f"Nothing uses the measurement{'s' if len(problem.measurements) > 1 else ''} {names}: no covariance is "
            "asked for. Call estimation_covariance() and use it in the cost or a condition, or state the cost by "
            "minimize_expected()."
        )


def _mention_spread_noise(problem: Declarations) -> None:
    """One noise density for all rows of a state of which some row is the rate of another: position and velocity."""
    for state in problem.states:
        entry = problem.rates.get(state.name)
        if entry is None or state.size == 1 or not entry.one_density or entry.noise is None:
            continue
        if entry.noise.is_constant() and not np.any(ca.evalf(entry.noise).full()):
            continue
        row = next((i for i in range(state.size) if _is_another(entry.rate[i], state.symbol, i)), None)
        if row is not None:
            listed = ", ".join("q" if i != row else "0" for i in range(state.size))
            warn_user(
                f"The noise of '{state.name}' is one number for its {state.size} rows, so {state.name}[{row}], whose "
                f"rate is another row of it, has white noise of its own. Give a density for each row: noise=[{listed}] "
                f"where that is not meant, [{', '.join('q' * state.size)}] where it is."
            )


def _mention_idle(problem: Declarations, of: str = "") -> None:
    """Controls on which nothing depends: no method moves them from where they start. `of`: the phase, in words."""
    used = {symbol.__hash__() for symbol in ca.symvar(ca.veccat(ca.MX(0, 1), *_written(problem)))}
    idle = [control.name for control in problem.controls if control.symbol.__hash__() not in used]
    if idle:
        listed = " and ".join(f"'{name}'" for name in idle)
        warn_user(
            f"Nothing depends on the control{'s' if len(idle) > 1 else ''} {listed}{of}: no rate, noise, measurement, "
            "cost or condition changes with it, and a solution has its starting guess. Use it in one of them, or leave "
            "it out."
        )


def _written(problem: Declarations) -> list[ca.MX]:
    """All expressions of a problem."""
    entries: list[tuple[Any, ...]] = [tuple(problem.cost or ())]
    entries += [(entry.rate, entry.noise) for entry in problem.rates.values()]
    entries += [(entry.expression, entry.noise, entry.information) for entry in problem.measurements]
    entries += [(entry.expression,) for entry in problem.constraints]
    entries += [(entry.expression,) for entry in problem.chances]
    if problem.expected is not None:
        expected = problem.expected
        entries += [(expected.running, expected.terminal, expected.terminal_weight, expected.control_weight)]
    return [value for entry in entries for value in entry if isinstance(value, ca.MX)]


def _is_another(rate: Given, symbol: Given, row: int) -> bool:
    """Whether a rate is just another entry of the same state."""
    found = chosen_entry(rate, symbol)
    return found >= 0 and found != row
