"""Phases -> frozen chain: each phase becomes a statement, and what passes between two of them a link."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NoReturn

import casadi as ca
import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.matrices import half_length, pack_symbolic
from covocp.problem.decisions import decisions_of, entries_used, stated, unused_names
from covocp.problem.declarations import Declarations, Parameter
from covocp.problem.expected_cost import ESTIMATE, GAIN
from covocp.problem.freeze import freeze
from covocp.problem.matrices import Matrix
from covocp.problem.phase_chances import with_phase_chances
from covocp.problem.phase_feedback import WEIGHT, deviations, in_phase, tangent, with_feedback
from covocp.statement.chain import Chain, Link
from covocp.statement.entries import entries_of, entry_names, error_size
from covocp.statement.statement import Statement


def chain_of(name: str, names: Sequence[str], phases: Sequence[Declarations], jumps: Sequence[Any]) -> Chain:
    """The frozen chain.

    Args:
        name: of the whole.
        names: of the phases.
        phases: what is declared in each.
        jumps: `Jump` records.

    Raises:
        ProblemError: what does not fit.
    """
    phases = [replace(phase, name=own) for phase, own in zip(phases, names, strict=True)]
    for phase in phases:
        _check_kinds(phase)
    _check_constants(phases)
    jumping = [{j.name: j for j in jumps if j.phase == k} for k in range(len(phases))]
    phases = with_feedback(with_phase_chances(phases, jumps), jumping)
    _check_cost(phases)
    _check_decisions(phases, jumps)
    own = [replace(phases[0], cost=phases[0].cost or _no_cost())]
    links: list[Link] = []
    for k in range(1, len(phases)):
        _check_pair(own[-1], phases[k], jumping[k])
        carried = _carried(own[-1], phases[k])
        later = _carrying(phases[k], carried)
        links.append(_link(own[-1], later, carried, jumping[k]))
        own.append(replace(later, cost=later.cost or _no_cost()))
    statements = tuple(_frozen(phase) for phase in own)
    return Chain(name=name, statements=statements, links=tuple(_weighed(statements, links)))


def _weighed(statements: Sequence[Statement], links: Sequence[Link]) -> Iterator[Link]:
    """The links with the places of S of a closed loop: at the later start, and among the parameters before it."""
    for link, before, after in zip(links, statements[:-1], statements[1:], strict=True):
        if not after.behind:
            yield link
            continue
        span = next(block.span for block in before.of_kind("parameter") if block.name == WEIGHT)
        yield replace(link, behind=tuple(after.entries(after.behind)), weights=tuple(range(span.start, span.stop)))


def _frozen(phase: Declarations) -> Statement:
    """The statement of a phase; what is wrong with it is said with its name."""
    try:
        return freeze(phase, part=True)
    except ProblemError as error:
        raise in_phase(phase, error) from error


def _no_cost() -> tuple[ca.MX, ca.MX]:
    """Of a phase that costs nothing by itself."""
    return ca.MX(0), ca.MX(0)


def _refuse(what: str, expected: str, received: str, remedy: str) -> NoReturn:
    raise ProblemError(what, expected=expected, received=received, remedy=remedy)


def _check_kinds(phase: Declarations) -> None:
    """What phases cannot have, by name."""
    for constraint in phase.constraints:
        if constraint.chance is not None:
            _refuse(
                f"The phase '{phase.name}' has the chance condition '{constraint.chance.name}' of a spread of its own.",
                "phases as they were stated, so that what scatters goes through all of them",
                "a problem that movable() returned",
                "give the problem itself",
            )
    for state in phase.states:
        if state.chart is not None:
            _refuse(
                f"The phase '{phase.name}' has the attitude '{state.name}'.",
                "states that are vectors",
                "attitude()",
                "describe it by angles in a state(), or solve one Problem by itself",
            )


def _check_cost(phases: Sequence[Declarations]) -> None:
    """Some phase says what is to be minimised, and something in all of them can be chosen."""
    if all(phase.cost is None for phase in phases):
        _refuse(
            "No phase has a cost.",
            "minimize(running=..., terminal=...) in one of them at least",
            "none",
            "say what is to be minimised; a height at the end belongs into the last phase",
        )
    chosen = any(phase.controls or phase.free_duration is not None or decisions_of(phase) for phase in phases)
    first_free = any(
        not s.initial.is_constant() or np.isnan(ca.evalf(s.initial).full()).any() for s in phases[0].states
    )
    if not chosen and not first_free:
        _refuse(
            "There is nothing to choose in any phase.",
            "a control, a free duration, a decision or a free initial value in one of them at least",
            "none of them",
            "declare a control by control(), or a duration by Free(guess)",
        )


def _groups(phase: Declarations) -> dict[str, tuple[str, Any]]:
    """Kind and declaration of all that has a name and may go on."""
    kinds: list[tuple[str, Iterable[Any]]] = [
        ("state", [s for s in phase.states if s.role == "moving"]),
        ("decision", decisions_of(phase)),
        ("unknown", phase.unknowns),
        ("parameter", phase.parameters),
        ("control", phase.controls),
        ("matrix", [m for m in phase.matrices if m.role == "moving"]),
    ]
    return {entry.name: (kind, entry) for kind, group in kinds for entry in group}


def _check_constants(phases: Sequence[Declarations]) -> None:
    """What is constant is the same in all phases, and is not left out between two of them."""
    groups = [_groups(phase) for phase in phases]
    for first, one in enumerate(groups):
        for second in range(first + 1, len(groups)):
            for name in one.keys() & groups[second].keys():
                (kind, entry), (other_kind, other) = one[name], groups[second][name]
                where = f"'{phases[first].name}' and '{phases[second].name}'"
                if kind != other_kind:
                    _refuse(
                        f"The phases {where} have '{name}' as different things.",
                        "one kind for each name: what has the same name goes on",
                        f"a {kind} (declared at {entry.where}) and a {other_kind} (declared at {other.where})",
                        "choose another name for one of them",
                    )
                _check_same(name, kind, where, entry, other)
                between = [phases[k].name for k in range(first + 1, second) if name not in groups[k]]
                if between and kind in ("decision", "unknown"):
                    _refuse(
                        f"The {kind} '{name}' of the phases {where} is missing between them.",
                        "it in every phase from its first to its last one, so that it is one constant",
                        f"none in '{between[0]}'",
                        f"declare it there too: {kind}('{name}', ...)",
                    )


def _check_same(name: str, kind: str, where: str, one: Any, other: Any) -> None:
    """Size and unit of what has the same name; values of what is constant."""
    growing = kind == "matrix" and one.of_deviations and other.of_deviations  # with what appears
    if kind != "control" and not growing and one.size != other.size:
        _refuse(
            f"The sizes of '{name}' in the phases {where} do not fit.",
            "the same number of components, or a jump() from one to the other of another name",
            f"{one.size} and {other.size}",
            "correct one of them, or choose another name",
        )
    if one.unit and other.unit and one.unit != other.unit:
        _refuse(
            f"The units of '{name}' in the phases {where} do not fit.",
            "one unit for each name",
            f"'{one.unit}' and '{other.unit}'",
            "convert one of them, or choose another name",
        )
    values = {"unknown": ("mean", "variance"), "parameter": ("value",)}.get(kind, ())
    for what in values:
        a, b = (_number(getattr(entry, what)) for entry in (one, other))
        if not np.array_equal(a, b):
            _refuse(
                f"The {what} of the {kind} '{name}' in the phases {where} differs.",
                f"one {kind} for each name: the same {what}, which the later phase does not start anew",
                f"{np.array2string(a, threshold=8)} and {np.array2string(b, threshold=8)}",
                "give the same numbers in both, or another name",
            )


def _number(value: Any) -> Any:
    """Numbers; of an expression of parameters its text."""
    if isinstance(value, ca.MX):
        return ca.evalf(value).full() if not ca.symvar(value) else np.array(str(value))
    return np.asarray(value)


def _check_decisions(phases: Sequence[Declarations], jumps: Sequence[Any]) -> None:
    """Something in some phase, or what passes between two, depends on each entry of each decision."""
    passing = [value for jump in jumps for value in (jump.expression, jump.noise)]
    declared = [(phase, entry) for phase in phases for entry in decisions_of(phase)]
    used: dict[str, Any] = {}
    for phase, entry in declared:
        own = entries_used([*stated(phase), *passing], entry.symbol)
        before = used.get(entry.name, own)  # sizes that differ are refused where the phases meet
        used[entry.name] = before | own if before.shape == own.shape else before
    for _, entry in declared:
        if names := unused_names(entry, used[entry.name]):
            _refuse(
                f"Nothing depends on the decision {names} (declared at {entry.where}).",
                "its symbol in dynamics, noise, initial values, costs, constraints or jumps of some phase",
                "none of them contains it",
                f"use {names} where it acts, or remove it",
            )


def _check_pair(before: Declarations, after: Declarations, jumps: dict[str, Any]) -> None:
    """What goes on has no initial value of its own."""
    known = {state.name for state in before.states if state.role == "moving"}
    pair = f"from '{before.name}' to '{after.name}'"
    for state in after.states:
        if state.role != "moving" or not (state.name in known or state.name in jumps):
            continue
        how = "jumps" if state.name in jumps else "goes on"
        free = not ca.symvar(state.initial) and bool(np.isnan(ca.evalf(state.initial).full()).all())
        if not free:
            _refuse(
                f"'{state.name}' {how} {pair} and has an initial value too.",
                f"initial=None for '{state.name}' in '{after.name}'",
                str(state.initial)[:100],
                "remove it; a value to pass through is final= of the phase before",
            )
        if not _vanishes(state.variance):
            _refuse(
                f"'{state.name}' {how} {pair} and has a variance too.",
                f"no variance for '{state.name}' in '{after.name}': its covariance goes on",
                str(state.variance)[:100],
                "remove it; what a jump adds is its noise=",
            )
    names = {matrix.name for matrix in before.matrices if matrix.role == "moving"}
    for matrix in after.matrices:
        if matrix.estimation and matrix.name not in names:
            _refuse(
                f"'{after.name}' has an estimation covariance, and '{before.name}' before it has none.",
                "estimation_covariance() in every phase up to the last one that has it",
                f"none in '{before.name}'",
                "call estimation_covariance() there too: what is not measured there grows with its noise",
            )
        passes = matrix.of_deviations or _of_estimate(after, matrix)
        plain = not passes and matrix.role == "moving" and matrix.name in names and matrix.backward is None
        if plain and not _free_matrix(matrix):
            _refuse(
                f"The matrix '{matrix.name}' goes on {pair} and has an initial value too.",
                f"initial=None for '{matrix.name}' in '{after.name}'",
                str(matrix.initial)[:100],
                "remove it",
            )
        if matrix.estimation and not _by_variances(matrix, after):
            _refuse(
                f"The estimation covariance of '{after.name}' has an initial value, and goes on {pair}.",
                "estimation_covariance() without initial= in a later phase",
                str(matrix.initial)[:100],
                "remove it; the variance of a state that appears is its variance=",
            )


def _of_estimate(phase: Declarations, matrix: Matrix) -> bool:
    """Whether a matrix is the covariance of the estimate in a loop whose gain is optimised."""
    return phase.expansion is not None and matrix.name == ESTIMATE


def _free_matrix(matrix: Matrix) -> bool:
    """Whether a matrix has no initial value."""
    return matrix.initial is None or (
        not ca.symvar(matrix.initial) and bool(np.isnan(ca.evalf(matrix.initial).full()).all())
    )


def _by_variances(matrix: Matrix, phase: Declarations) -> bool:
    """Whether an estimation covariance starts with the variances of what it is of."""
    stated = pack_symbolic(ca.diagcat(*(entry.variance for entry in phase.augmented)))
    return bool(_vanishes(matrix.initial - stated)) or str(matrix.initial) == str(stated)


def _vanishes(value: Any) -> bool:
    return not ca.symvar(value) and not np.asarray(ca.evalf(value).full()).any()


def _carried(before: Declarations, after: Declarations) -> list[tuple[Matrix, Parameter]]:
    """The matrices of the later phase that go on, each with the parameter that stands for its initial value."""
    names = {matrix.name for matrix in before.matrices if matrix.role == "moving"}
    result = []
    for matrix in after.matrices:
        if matrix.role != "moving" or matrix.backward is not None or matrix.name not in names:
            continue
        name, size = f"{matrix.name}(0)", half_length(matrix.size)
        start = np.asarray(ca.evalf(pack_symbolic(ca.MX.eye(matrix.size))).full()).ravel()
        symbol = ca.MX.sym(name, size)
        own = Parameter(name=name, symbol=symbol, size=size, where=matrix.where, unit=matrix.unit, value=start)
        result.append((matrix, own))
    return result


def _carrying(phase: Declarations, carried: list[tuple[Matrix, Parameter]]) -> Declarations:
    """The phase whose matrices start with parameters, the last of the known ones."""
    given = {matrix.name: parameter.symbol for matrix, parameter in carried}
    matrices = tuple(replace(m, initial=given.get(m.name, m.initial)) for m in phase.matrices)
    parameters = (*phase.parameters, *(parameter for _, parameter in carried))
    return replace(phase, matrices=matrices, parameters=parameters)


def _link(
    before: Declarations, after: Declarations, carried: list[tuple[Matrix, Parameter]], jumps: dict[str, Any]
) -> Link:
    """What passes from one phase to the next."""
    expected = before.expansion is not None
    own = (GAIN,) if expected else ()  # each phase has a gain of its own, also where it is constant
    known = {s.name: s for s in before.states if s.role != "integral" and s.name not in own}
    values: list[Any] = []
    entries: list[int] = []
    names: list[str] = []
    offset = 0
    for state in after.states:
        span = range(offset, offset + state.size)
        offset = span.stop
        if state.role == "integral" or not (state.name in jumps or state.name in known):
            continue
        values.append(jumps[state.name].expression if state.name in jumps else known[state.name].symbol)
        entries += span
        word = "jump of" if state.name in jumps else "continuity of"
        names += [f"{word} {name} from '{before.name}' to '{after.name}'" for name in entry_names((state,))]
    halves: list[Any] = []
    places: list[int] = []
    offset = 0
    going = {matrix.name for matrix, _ in carried}
    earlier = {matrix.name: matrix for matrix in before.matrices}
    for matrix in after.matrices:
        span = range(offset, offset + matrix.symbol.shape[0])
        offset = span.stop
        if matrix.name not in going:
            continue
        halves.append(_passed(before, after, earlier[matrix.name], jumps))
        places += span
        names += [f"continuity of {name} from '{before.name}' to '{after.name}'" for name in entries_of(matrix)]
    size = sum(error_size(entry) for entry in before.augmented)
    covariance = ca.MX.sym("X", size, size)
    first = sum(p.size for p in after.parameters) - sum(p.size for _, p in carried)
    count = sum(p.size for _, p in carried)
    return Link(
        states=tuple(entries),
        matrices=tuple(places),
        parameters=tuple(range(first, first + count)),
        names=tuple(names),
        function=_function(before, after, jumps, [ca.vertcat(ca.MX(0, 1), *values), ca.vertcat(ca.MX(0, 1), *halves)]),
        deviations=_function(before, after, jumps, deviations(before, after, jumps, covariance), covariance)
        if expected
        else None,
    )


def _passed(before: Declarations, after: Declarations, matrix: Matrix, jumps: dict[str, Any]) -> Any:
    """The half-vector that a matrix goes on with.

    A covariance of deviations by the tangents of the jumps, J E J' + N, with the variances of what appears and the
    noise of the jumps; that of their estimate by J Xhat J', since nobody knows these; others as they are.
    """
    estimate = _of_estimate(before, matrix)
    if not (matrix.of_deviations or estimate):
        return matrix.symbol
    _, J, added = tangent(before, after, jumps)
    moved = J @ matrix.matrix @ J.T
    return pack_symbolic(moved if estimate else moved + added)


def _function(
    before: Declarations, after: Declarations, jumps: dict[str, Any], values: list[Any], further: Expr = None
) -> ca.Function:
    """(x, e, T, p of the phase before, p of the later one[, a further symbol]) -> values.

    Raises:
        ProblemError: a symbol that is no part of how the phase before ends.
    """
    groups: list[list[Any]] = [
        [entry.symbol for entry in before.states],
        [entry.symbol for entry in before.matrices],
        [before.duration] if before.free_duration is not None else [],
        [*(entry.symbol for entry in before.parameters), *(entry.symbol for entry in before.unknowns)],
        [*(entry.symbol for entry in after.parameters), *(entry.symbol for entry in after.unknowns)],
    ]
    known = {symbol.__hash__() for k in (0, 2, 3) for symbol in groups[k]}
    starting = {symbol.__hash__() for symbol in groups[4]}
    for jump in jumps.values():
        _check_known(f"The jump of '{jump.name}'", before, ca.veccat(jump.expression, jump.noise), known)
    for entry in after.augmented:
        if entry.name not in jumps and entry.name not in {own.name for own in before.augmented}:
            _check_known(f"The variance of '{entry.name}'", after, entry.variance, starting)
    sizes = [sum(symbol.shape[0] for symbol in group) for group in groups]
    stacked = [ca.MX.sym(name, size) for name, size in zip(("x", "e", "T", "p", "later"), sizes, strict=True)]
    if before.free_duration is None:
        stacked[2] = ca.MX.sym("T")
    arguments: list[Any] = []
    for group, column in zip(groups, stacked, strict=True):
        offsets = np.cumsum([0, *(symbol.shape[0] for symbol in group)]).tolist()
        arguments += [column[i:j] for i, j in pairwise(offsets)]
    more = [] if further is None else [further]
    inner = ca.Function("link", [*(symbol for group in groups for symbol in group), *more], values)
    outputs = [ca.densify(value) for value in inner.call([*arguments, *more], True, False)]
    inputs = ["x", "e", "T", "p", "later", *("X" for _ in more)]
    return ca.Function("link", [*stacked, *more], outputs, inputs, [f"value_{i}" for i in range(len(outputs))])


def _check_known(what: str, phase: Declarations, expression: Any, known: set[Any]) -> None:
    """An expression contains symbols of one phase only, those that are known where phases meet.

    Raises:
        ProblemError: another one.
    """
    for symbol in ca.symvar(expression):
        if symbol.__hash__() not in known:
            _refuse(
                f"{what} contains '{symbol.name()}'.",
                f"numbers, and of '{phase.name}' what has one value there: in jumps its states at the end, unknowns, "
                "parameters, decisions and its duration; in variances its parameters",
                f"'{symbol.name()}'",
                f"use the symbols that the problem '{phase.name}' returned; controls, covariances and the time have "
                "no place there",
            )
