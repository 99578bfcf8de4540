"""Problem -> frozen statement: everything that a user declared becomes CasADi functions of stacked vectors."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.geometry import Geometry
from covocp.base.matrices import pack_symbolic, unpack_symbolic
from covocp.base.riccati_rates import inverse, recognise, riccati_rate, same
from covocp.problem.chances import check_uncertain, uncertainties
from covocp.problem.checks import check_dynamics
from covocp.problem.data import used_data
from covocp.problem.decisions import check_decisions
from covocp.problem.declarations import Declarations
from covocp.problem.ends import boundary, tied_values, with_end_conditions
from covocp.problem.inequalities import conditions_at, conditions_inside, row_names
from covocp.problem.integrals import check_integrals
from covocp.problem.matrices import Matrix, Spread
from covocp.problem.measurement_information import check_readings, inverse_density
from covocp.problem.rates import process_noise
from covocp.problem.samples import measured_blocks, samples
from covocp.problem.stacked import Stacked, stack
from covocp.problem.table_ranges import table_ranges
from covocp.statement.chances import ChanceLimits
from covocp.statement.entries import error_names, error_size
from covocp.statement.statement import Block, Duration, Loop, Statement


def freeze(problem: Declarations, *, part: bool = False) -> Statement:
    """Build the statement of a problem.

    Args:
        problem: what is declared.
        part: whether it is one of several phases: what costs and what can be chosen may then lie in the others.

    Raises:
        ProblemError: dynamics or cost missing, symbols of another problem, a cost that depends on nothing, a
            measurement noise that is singular.
    """
    _check_complete(problem, part)
    problem = with_end_conditions(problem)
    stacked = stack(problem)
    x, u, e, t, _, p = stacked.inputs
    rates = _state_rates(problem, stacked)
    matrix_rates, riccati, sources, measurement = _matrix_rates(problem, stacked, rates)
    running, terminal = stacked.substitute(*(problem.cost or ()))
    coupled = bool(ca.depends_on(rates, e)) if problem.matrices else False
    running_uses = bool(ca.depends_on(running, e)) if problem.matrices else False
    running_uses = running_uses or bool(problem.sampled and problem.expansion is not None)
    nominal = None
    if not coupled:
        cost = ca.DM(0) if running_uses else running
        nominal = stacked.function("nominal", [rates, cost], without=("matrices",))
    everything = ca.veccat(rates, matrix_rates, running)
    return Statement(
        name=problem.name,
        blocks=_blocks(problem),
        duration=_duration(problem),
        values=np.concatenate(
            [np.zeros(0), *(q.value for q in problem.parameters), *(q.mean for q in problem.unknowns)]
        ),
        nominal=nominal,
        rates=stacked.function("rates", [rates, matrix_rates, running]),
        terminal=stacked.function("terminal", [terminal], without=("control", "time")),
        boundary=boundary(problem),
        tied=tied_values(problem),
        matrix_end=_matrix_end(problem, stacked),
        loop=_loop(problem, stacked),
        riccati=riccati,
        sources=sources,
        measurement=measurement,
        measurements=measured_blocks(problem.continuous),
        information=_information(problem, stacked),
        samples=samples(problem, stacked),
        data=used_data(problem),
        tables=table_ranges(problem, stacked),
        path=conditions_at(problem, stacked, "path"),
        start=conditions_at(problem, stacked, "initial"),
        end=conditions_at(problem, stacked, "final"),
        inside=conditions_inside(problem, stacked),
        chances=_chances(problem, stacked),
        state_bounds=_bounds(problem.states),
        control_bounds=_bounds(problem.controls),
        matrix_lower=np.concatenate([np.zeros(0), *(_diagonal_bounds(entry) for entry in problem.matrices)]),
        guesses={q.name: q.guess for q in _all(problem.states, problem.controls, problem.matrices)},
        scales={q.name: q.scale for q in _all(problem.states, problem.controls) if q.scale is not None},
        augmented=error_names(problem.augmented),
        coupled=coupled,
        symbolic=stacked.symbolic,
        geometry=Geometry.of(problem.states),
        autonomous=not ca.depends_on(everything, t),
        noise_varies=_noise_varies(problem),
        running_uses_matrices=running_uses,
        symbols=_symbols(problem),
        matrix_parameters={e.name: (e.size // e.columns, e.columns) for e in problem.parameters if e.columns > 1},
        expression=_expression_builder(stacked, problem.spread),
    )


def _all(*groups: Iterable[Any]) -> list[Any]:
    """Declarations of several kinds in one list."""
    return [entry for group in groups for entry in group]


def _check_complete(problem: Declarations, part: bool) -> None:
    """Everything that must be declared is there, and nothing comes from another problem."""
    moving = _all(problem.states, (m for m in problem.matrices if not m.estimation and m.backward is None))
    check_dynamics(moving, problem.rates)
    if not any(state.role == "moving" for state in problem.states):
        raise ProblemError(
            "The problem has no state.",
            expected="at least one state beside decisions and integrals",
            received=", ".join(state.name for state in problem.states) or "none",
            remedy="add one by state(); its rate may be 0",
        )
    if problem.cost is None:
        raise ProblemError(
            "The problem has no cost.",
            expected="minimize(running=..., terminal=...), or minimize_expected",
            received="none",
            remedy="say what is to be minimised",
        )
    if not problem.controls and problem.free_duration is None and not part:
        free = [s for s in problem.states if not s.initial.is_constant() or np.isnan(ca.evalf(s.initial).full()).any()]
        if not free:
            raise ProblemError(
                "There is nothing to choose.",
                expected="a control, a free initial value or a free duration",
                received="none of them",
                remedy="declare a control by control()",
            )
    entry_augmented = sum(error_size(entry) for entry in problem.augmented)
    covariance = next((m for m in problem.matrices if m.estimation), None)
    if covariance is not None and covariance.size != entry_augmented:
        raise ProblemError(
            "States or unknowns were declared after estimation_covariance().",
            expected="estimation_covariance() after the last state() and unknown()",
            received=f"a covariance of {covariance.size} rows for {entry_augmented} states and unknowns",
            remedy="move the call down",
        )
    _check_symbols(problem, part)
    check_integrals(problem)
    if not part:
        check_decisions(problem)
        check_uncertain([c.chance for c in problem.constraints if c.chance is not None], uncertainties(problem))
    check_readings(problem.measurements, problem.matrices)


def _check_symbols(problem: Declarations, part: bool) -> None:
    """Every symbol in every expression belongs to this problem; the cost depends on something."""
    known = _symbols(problem)
    hashes = {symbol.__hash__() for symbol in known.values()}
    expressions: list[tuple[str, Any]] = [
        (f"the rate of '{name}'", entry.rate) for name, entry in problem.rates.items()
    ]
    expressions += [(f"the noise of '{k}'", v.noise) for k, v in problem.rates.items() if v.noise is not None]
    expressions += [
        (f"measurement '{m.name}'", value) for m in problem.measurements for value in (m.expression, m.noise)
    ]
    expressions += [(f"'{c.name}'", c.expression) for c in problem.constraints]
    cost = ca.veccat(*(problem.cost or ()))
    expressions += [("the cost", cost)]
    if problem.spread is not None:
        hashes.add(problem.spread.symbol.__hash__())
    everything = ca.veccat(*(expression for _, expression in expressions))
    every_known = all(symbol.__hash__() in hashes for symbol in ca.symvar(everything))
    for what, expression in () if every_known else expressions:  # to ask for the symbols of each takes longer
        for symbol in ca.symvar(expression):
            if symbol.__hash__() not in hashes:
                twin = symbol.name() in known
                raise ProblemError(
                    f"There is an unknown symbol '{symbol.name()}' in {what}.",
                    expected="symbols of this problem: " + ", ".join(known),
                    received=str(expression)[:200] + (" with a symbol of another problem" if twin else ""),
                    remedy=f"use the '{symbol.name()}' that was declared in this problem"
                    if twin
                    else f"declare '{symbol.name()}' with state(), unknown(), parameter() or control()",
                )
    passing: list[Any] = [*problem.controls, SimpleNamespace(name="time", symbol=problem.time)]
    terminal_cost = problem.cost[1] if problem.cost is not None else ca.MX(0)
    terminal = {symbol.__hash__() for symbol in ca.symvar(terminal_cost)}
    for entry in passing:
        if entry.symbol.__hash__() in terminal:
            raise ProblemError(
                f"The terminal cost contains '{entry.name}'.",
                expected="states, matrix states, parameters and the duration",
                received=str(terminal_cost)[:200],
                remedy="use Problem.duration for the terminal time, of data casadi.substitute(data, problem.time, "
                "casadi.MX(problem.duration)); controls belong into the running cost",
            )
    constants = {q.symbol.__hash__() for q in _all(problem.parameters, problem.unknowns)}
    constants.add(problem.time.__hash__())
    longer = problem.free_duration is not None and problem.cost is not None and not problem.cost[0].is_zero()
    if not part and not longer and all(symbol.__hash__() in constants for symbol in ca.symvar(cost)):
        raise ProblemError(
            "The cost depends on nothing that can be chosen.",
            expected="a cost of states, controls, matrix states or the free duration",
            received="running = {}, terminal = {}".format(*problem.cost or ()),
            remedy="check the arguments of minimize()",
        )


def _symbols(problem: Declarations) -> dict[str, Any]:
    """All symbols by name."""
    entries = _all(problem.states, problem.controls, problem.matrices, problem.unknowns, problem.parameters)
    symbols = {entry.name: entry.symbol for entry in entries} | {"time": problem.time}
    if problem.free_duration is not None:
        symbols["duration"] = problem.duration
    return symbols


def _state_rates(problem: Declarations, stacked: Stacked) -> Any:
    """Rate of the stacked state."""
    return ca.vertcat(*stacked.substitute(*(problem.rates[state.name].rate for state in problem.states)))


def _matrix_rates(
    problem: Declarations, stacked: Stacked, rates: Expr
) -> tuple[Any, tuple[Any, ...], tuple[int | None, ...], Any]:
    """Rates of all half-vectors, their Riccati forms where they have one, what feeds them, and the measurement."""
    e = stacked.inputs[2]
    measurement = _measurement(problem, stacked)
    values: list[Any] = []
    forms: list[Any] = []
    sources: list[int | None] = []
    estimated: Any = None
    offset = 0
    for entry in problem.matrices:
        source = None
        half = e[offset : offset + entry.symbol.shape[0]]
        offset += entry.symbol.shape[0]
        if entry.estimation:
            form: Any = _kalman_form(problem, stacked, rates, measurement)
            estimated = (len(forms), half, form[2])
            values.append(pack_symbolic(riccati_rate(unpack_symbolic(half, entry.size), *form)))
        elif entry.backward is not None:
            form = tuple(stacked.substitute(*entry.backward.form))
            values.append(pack_symbolic(riccati_rate(unpack_symbolic(half, entry.size), *form)))
        else:
            values += stacked.substitute(problem.rates[entry.name].rate)
            plain = entry.role == "moving" and stacked.symbolic is ca.SX
            form = recognise(values[-1], half, entry.size) if plain else None
        if form is not None and ca.depends_on(ca.veccat(*form), e):
            form = _fed_form(values[-1], half, form, estimated, e) if entry.covariance else None
            source = None if form is None else estimated[0]
        sources.append(source)
        forms.append(form and stacked.function(f"riccati_{len(forms)}", list(form), without=("matrices",)))
    function = measurement and stacked.function("measurement", list(measurement), without=("matrices",))
    empty = stacked.symbolic(0, 1)
    return ca.vertcat(empty, *values), tuple(forms), tuple(sources), function


def _fed_form(rate: Expr, half: Expr, form: Any, estimated: Any, e: Expr) -> Any:
    """F, Q, 0 of a covariance of rate F X + X F' + Q + E W E, E the estimation covariance; None where it is another.

    Args:
        rate: half-vector of the rate.
        half: that of the covariance X.
        form: its F, Q, W as they were recognised, with E in them.
        estimated: position, half-vector and W of E; None where there is none.
        e: all half-vectors.
    """
    if estimated is None or form[0].shape != estimated[2].shape:
        return None
    _, error, information = estimated
    plain = tuple(ca.substitute([*form], [error], [ca.SX.zeros(error.shape)]))
    if ca.depends_on(ca.veccat(*plain), e):
        return None
    E = unpack_symbolic(error, form[0].shape[0])
    own = riccati_rate(unpack_symbolic(half, form[0].shape[0]), *plain)
    return plain if same(rate, pack_symbolic(own + E @ information @ E), e) else None


def _measurement(problem: Declarations, stacked: Stacked) -> tuple[Any, Any, Any] | None:
    """Stacked measurement, its Jacobian M and the noise density U."""
    if not problem.continuous:
        return None
    values = stacked.substitute(*(m.expression for m in problem.continuous))
    density = ca.diagcat(*stacked.substitute(*(m.noise for m in problem.continuous)))
    value = ca.vertcat(*values)
    return value, stacked.augmented_jacobian(value), density


def _kalman_form(problem: Declarations, stacked: Stacked, rates: Expr, measurement: Expr) -> tuple[Any, Any, Any]:
    """F, Q and W = M' U^-1 M of the Kalman-Bucy covariance [Schmidt 2.5-3]."""
    geometry, rows = stacked.geometry, stacked.geometry.size
    velocity = geometry.velocity(stacked.inputs[0][:rows], rates[:rows])
    drift = stacked.augmented_jacobian(ca.vertcat(velocity, ca.DM.zeros(stacked.unknowns, 1)))
    if not geometry.plain:
        drift += ca.diagcat(geometry.drift(velocity), ca.DM(stacked.unknowns, stacked.unknowns))
    (noise,) = stacked.substitute(process_noise(problem))
    if measurement is None:
        return drift, noise, stacked.symbolic(*drift.shape)
    _, jacobian, density = measurement
    blocks = [
        (stacked.substitute(m.noise)[0], None if m.information is None else stacked.substitute(m.information)[0])
        for m in problem.continuous
    ]
    return drift, noise, jacobian.T @ inverse_density(density, blocks, inverse) @ jacobian


def _information(problem: Declarations, stacked: Stacked) -> ca.Function | None:
    """What is stated as information, one below the other."""
    stated = [ca.diag(entry.information) for entry in problem.continuous if entry.information is not None]
    if not stated:
        return None
    return stacked.function("information", stacked.substitute(ca.vertcat(*stated)), without=("matrices",))


def _noise_varies(problem: Declarations) -> bool:
    """Whether a noise density depends on more than parameters."""
    densities = [entry.noise for entry in problem.rates.values() if entry.noise is not None]
    densities += [entry.noise for entry in problem.measurements]
    constants = {q.symbol.__hash__() for q in _all(problem.parameters, problem.unknowns)}
    return any(symbol.__hash__() not in constants for density in densities for symbol in ca.symvar(density))


def _blocks(problem: Declarations) -> tuple[Block, ...]:
    """Where each symbol lies."""
    blocks = []
    parameters = 0
    for kind, group in (
        ("state", problem.states),
        ("control", problem.controls),
        ("matrix", problem.matrices),
        ("parameter", problem.parameters),
        ("unknown", problem.unknowns),
    ):
        offset = parameters if kind == "unknown" else 0
        for entry in group:
            blocks.append(
                Block(
                    name=entry.name,
                    kind=kind,  # type: ignore[arg-type]
                    size=entry.size,
                    offset=offset,
                    labels=entry.labels if isinstance(entry, Matrix) else (),
                    covariance=isinstance(entry, Matrix) and entry.covariance,
                    estimation=isinstance(entry, Matrix) and entry.estimation,
                    backward=isinstance(entry, Matrix) and entry.backward is not None,
                    unit=entry.unit,
                    tangent=getattr(entry, "tangent", 0),
                    role=getattr(entry, "role", "moving"),
                )
            )
            offset += blocks[-1].length
        if kind == "parameter":
            parameters = offset
    return tuple(blocks)


def _duration(problem: Declarations) -> Duration:
    """The terminal time."""
    free = problem.free_duration
    if free is None:
        number = float(problem.duration)
        return Duration(guess=number, lower=number, upper=number)
    return Duration(guess=free.guess, lower=free.lower, upper=free.upper)


def _matrix_end(problem: Declarations, stacked: Stacked) -> ca.Function | None:
    """Half-vectors of the matrices that run backward, at the end."""
    ends = [entry.backward.end for entry in problem.matrices if entry.backward is not None]
    if not ends:
        return None
    values = ca.vertcat(*(pack_symbolic(end) for end in stacked.substitute(*ends)))
    return stacked.function("matrix_end", [values], without=("control", "matrices", "time"))


def _loop(problem: Declarations, stacked: Stacked) -> Loop | None:
    """What the feedback of an expected cost sees, as functions."""
    v = problem.expansion
    if v is None:
        return None
    slopes = [ca.densify(entry) for entry in stacked.substitute(v.F, v.G, v.A, v.B, v.N, v.Q)]
    (gain, running, terminal, end) = stacked.substitute(v.gain, v.running, v.terminal, v.end)
    weighed = slopes[3].shape[0]  # controls; what follows them, a free gain, is not in the running cost
    own_weight = ca.hessian(running, stacked.inputs[1])[0][:weighed, :weighed]
    by_parts = None
    if v.alternative is not None:
        by_parts = stacked.function("by_parts", stacked.substitute(v.alternative, v.product))
    spread, spread_end = _spread_costs(problem, stacked)
    return Loop(
        expansion=stacked.function("expansion", slopes, without=("matrices",)),
        gain=stacked.function("gain", [ca.densify(gain)]),
        running=stacked.function("running", [running], without=("matrices",)),
        terminal=stacked.function("terminal", [terminal, ca.densify(end)], without=("control", "matrices", "time")),
        extra_control=stacked.function("extra", [ca.densify(slopes[3] - own_weight)], without=("matrices",)),
        weighed=None
        if v.weighed is None
        else stacked.function("weighed", list(map(ca.densify, stacked.substitute(*v.weighed))), without=("matrices",)),
        by_parts=by_parts,
        spread=spread,
        spread_end=spread_end,
        shared=v.shared,
    )


def _spread_costs(problem: Declarations, stacked: Stacked) -> tuple[ca.Function | None, ca.Function | None]:
    """What the covariance of the closed loop adds to the running and to the terminal cost, as functions of it."""
    v, spread = problem.expansion, problem.spread
    if v is None or v.spread is None or spread is None:
        return None, None
    joint = stacked.symbolic.sym("joint", spread.symbol.shape[0])  # type: ignore[attr-defined]
    values = stacked.substitute(*v.spread, spread=joint)
    x, u, _, t, duration, p = stacked.inputs
    return (
        ca.Function("spread", [x, u, t, duration, p, joint], values[:1]),
        ca.Function("spread_end", [x, duration, p, joint], values[1:]),
    )


def _chances(problem: Declarations, stacked: Stacked) -> tuple[ChanceLimits, ...]:
    """The conditions on probabilities, as functions of the nominal."""
    result = []
    for constraint in problem.constraints:
        chance = constraint.chance
        if chance is None:
            continue
        assert chance.slopes is not None
        values = [ca.densify(v) for v in stacked.substitute(chance.expression, *chance.slopes)]
        result.append(
            ChanceLimits(
                name=chance.name,
                names=tuple(row_names(constraint)),
                place=chance.at,
                lower=chance.lower,
                upper=chance.upper,
                probability=chance.probability,
                each=chance.each,
                joint=chance.joint,
                function=stacked.function("chance", values),
                matrix=chance.spread,
            )
        )
    return tuple(result)


def _bounds(entries: Expr) -> tuple[Any, Any]:
    """Stacked lower and upper bounds."""
    lower = np.concatenate([np.zeros(0), *(entry.lower for entry in entries)])
    upper = np.concatenate([np.zeros(0), *(entry.upper for entry in entries)])
    return lower, upper


def _diagonal_bounds(entry: Matrix) -> Any:
    """Lower bounds of a half-vector: the given one on the diagonal, none elsewhere."""
    bounds = np.full((entry.size, entry.size), -np.inf)
    if entry.lower is not None:
        np.fill_diagonal(bounds, entry.lower)
    rows, columns = np.triu_indices(entry.size)
    return bounds[columns, rows]


def _expression_builder(stacked: Stacked, spread: Spread | None) -> Callable[..., ca.Function]:
    """What turns a user's expression into a function of the six stacked inputs, and of the half-vector of X if asked.

    Where X is no symbol of the program there are the six in any case.
    """

    def build(expression: Expr, *, scattered: bool = False) -> ca.Function:
        if scattered and spread is not None and spread.value is not None:
            return stacked.with_spread("expression", [expression], spread.size)
        return stacked.function("expression", stacked.substitute(expression))

    return build
