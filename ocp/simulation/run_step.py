"""One step of one run of the actual system with its filter and feedback, as CasADi functions.

The joint system of the state x and of the estimate y goes by Heun's method with the noises added (Ito):

    z* = z + h a(z, t) + g,    z+ = z + h/2 (a(z, t) + a(z*, t + h)) + g,    g = B(z + h/2 a(z, t), t + h/2) sqrt(h) w,

w standard normal, B B' the spectral densities: the noises are held over the step, at the values that they have half a
step on without noise. Additive noise gives moments of second order in h; noise that depends on the state those of Ito.

The perturbation filter estimates the deviation from the nominal with the gains of the design, in actual measurements m:

    dy = (F y + G du + K (m - h - M y - h_u du)) dt,    du = sat(u - C y) - u.

The extended filter estimates the state itself, linearised where it is, with a covariance of its own in each run.

A law of the user takes the place of both: its control is held over the steps between its samples, while the actual
measurement is integrated for its next one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from covocp.matrices import Array, half_length, pack_symbolic, unpack_symbolic
from covocp.riccati import inverse, riccati_rate
from covocp.simulation.actual import System
from covocp.simulation.flown import Flown
from covocp.simulation.schedule import Coefficients, Estimator, filter_gain
from covocp.solution import Solution

# A pivot of a factorisation counts as zero below this share of its diagonal entry.
PIVOT = 1e-12
# Bounds count as kept within this share of their size.
BOUND_MARGIN = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Limits:
    """Limits of the fed-back controls, (m,) each.

    lower, upper: what the actual control can do. least, most: what counts as all that there is; the same, or the bounds
    of the problem where the actual control has no limits.
    """

    lower: Array
    upper: Array
    least: Array
    most: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Setting:
    """What is simulated: the solution, both systems, the kind of filter, limits of the control, domain.

    domain: largest deviations, of the actual system and of the estimate, that count as inside, (n,).
    flown: the law, where it is that of the user.
    """

    solution: Solution
    design: System
    actual: System
    filter: Estimator
    limits: Limits
    domain: Array
    flown: Flown | None = None

    @property
    def costs(self) -> bool:
        """Whether a run has a cost: where the expected one was minimised."""
        return self.design.statement.loop is not None


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """Symbols of one run, and where the parts of its state lie.

    z: the state; own: its unknowns. spans: "x", "estimate", "E" (of the extended filter), "measured" (what a law has
    measured since its last step, an integral), "cost", "asked" and "outside" (flags), "held" (control of a law).
    noisy: states with process noise; bounded: states, and fed-back controls, with bounds.
    """

    setting: Setting
    coefficients: Coefficients
    symbolic: Any
    z: Any
    own: Any
    spans: Mapping[str, slice]
    noisy: list[int]
    bounded: tuple[list[int], list[int]]

    @property
    def noises(self) -> int:
        """Number of normal numbers that a step takes."""
        return len(self.noisy) + self.setting.design.measured

    @property
    def moving(self) -> slice:
        """The part of the state that has a rate."""
        return slice(0, self.spans["cost"].stop)


def run_symbols(setting: Setting, coefficients: Coefficients) -> Run:
    """Symbols of a run."""
    design, actual = setting.design, setting.actual
    scalar = design.statement.symbolic is ca.SX and actual.statement.symbolic is ca.SX
    symbolic: Any = ca.SX if scalar else ca.MX
    noise = actual.linear.sparsity_out("Q")
    bounded = bounded_rows(design)
    sizes = {
        "x": design.states,
        "estimate": design.size,
        "E": half_length(design.size) if setting.filter == "extended" else 0,
        "measured": design.measured if setting.flown else 0,
        "cost": int(setting.costs),
        "asked": design.fed_back,
        "outside": sum(map(len, bounded)),
        "held": design.fed_back if setting.flown else 0,
    }
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return Run(
        setting=setting,
        coefficients=coefficients,
        symbolic=symbolic,
        z=symbolic.sym("z", ends[-1]),
        own=symbolic.sym("own", design.unknowns),
        spans={name: slice(i, j) for name, i, j in zip(sizes, ends[:-1], ends[1:], strict=True)},
        noisy=[i for i in range(design.states) if noise.has_nz(i, i)],
        bounded=bounded,
    )


def bounded_rows(design: System) -> tuple[list[int], list[int]]:
    """Rows of the states, and of the fed-back controls, that have a bound."""
    st = design.statement
    states, controls = (
        np.flatnonzero(np.isfinite(low[:rows]) | np.isfinite(high[:rows])).tolist()
        for (low, high), rows in ((st.state_bounds, design.states), (st.control_bounds, design.fed_back))
    )
    return states, controls


def start_of(run: Run) -> Array:
    """State of a run that starts at its mean, its filter at the mean of the design."""
    design, solution = run.setting.design, run.setting.solution
    z = np.zeros(run.z.shape[0])
    z[run.spans["x"]] = run.setting.actual.start[: design.states]
    if run.setting.flown:
        z[run.spans["held"]] = solution.controls[0, : design.fed_back]
    if run.setting.filter == "extended":
        z[run.spans["estimate"]] = design.start
        z[run.spans["E"]] = solution.trajectory.e[0][design.covariance]
    return z


def step_function(run: Run, constant: Array, varying: Any) -> ca.Function:
    """One step of a run.

    Args:
        run: its symbols.
        constant: values of the coefficients; zeros among them vanish from the graph.
        varying: which of them are inputs instead.

    Returns:
        (state, noise, own unknowns, varying coefficients at both ends and h) -> state after the step; deviation from
        the nominal and estimate of it there (2n).
    """
    w, h = run.symbolic.sym("w", run.noises), run.symbolic.sym("h")
    symbols = [run.symbolic.sym(name, varying.size) for name in ("before", "after")]
    sides = []
    for symbol in symbols:
        column = run.symbolic(ca.DM(constant))
        if varying.size:
            column[varying.tolist()] = symbol
        sides.append(run.coefficients.split(column))
    z, moving = run.z, run.moving
    first, asked, applied = _drift(run, z, sides[0])
    half = z[moving] + h / 2 * first
    g = _noise(run, half, applied, sides, h) @ (ca.sqrt(h) * w)
    g = ca.vertcat(g, run.symbolic.zeros(first.shape[0] - g.shape[0]))
    second, _, _ = _drift(run, ca.vertcat(z[moving] + h * first + g, _rows(z, moving.stop)), sides[1])
    after = z[moving] + h / 2 * (first + second) + g
    end = run.spans["held"].start
    flags = ca.fmax(_rows(z, moving.stop, end), _flags(run, after, asked, applied))
    outputs = [ca.densify(ca.vertcat(after, flags, _rows(z, end))), _moved(run, after, sides[1])]
    options = {"cse": True} if run.symbolic is ca.SX else {}
    return ca.Function("step", [z, w, run.own, ca.vertcat(*symbols, h)], outputs, options)


def observe_function(run: Run) -> ca.Function:
    """(state, unknowns, coefficients at a time) -> deviation, its estimate, deviation of the control, flags "asked"."""
    column = run.symbolic.sym("c", run.coefficients.rows)
    c = run.coefficients.split(column)
    asked, applied = _control(run, run.z, c)
    moved = applied - _rows(c["u"], 0, run.setting.design.fed_back)
    y = ca.vertcat(_moved(run, run.z, c), moved, *_asked_flags(run, asked))
    return ca.Function("observe", [run.z, run.own, column], [ca.densify(y)])


def finish_function(run: Run) -> ca.Function | None:
    """(state, unknowns) -> k + 1/2 d'(S(T) - k_xx) d: terminal cost, with the weights that are not in k."""
    design, solution = run.setting.design, run.setting.solution
    loop, end = design.statement.loop, solution.trajectory.x[-1]
    if loop is None:
        return None
    known = solution.parameters[: solution.parameters.size - design.unknowns]

    def terminal(augmented: Any) -> Any:
        state = ca.vertcat(_rows(augmented, 0, design.states), ca.DM(end[design.states :]))
        return loop.terminal(state, solution.duration, ca.vertcat(ca.DM(known), _rows(augmented, design.states)))

    symbolic: Any = design.statement.symbolic
    v = symbolic.sym("v", design.size)
    k, weight = terminal(v)
    nominal = np.concatenate([end[: design.states], design.start[design.states :]])
    extra = ca.Function("extra", [v], [weight - ca.hessian(k, v)[0]])(nominal)
    actual = ca.vertcat(run.z[run.spans["x"]], run.own)
    cost = terminal(actual)[0] + ca.dot(actual - nominal, extra @ (actual - nominal)) / 2
    return ca.Function("finish", [run.z, run.own], [ca.densify(cost)])


def factor(covariance: Any) -> Any:
    """Lower triangular L with L L' = covariance, DM, SX or MX; the columns of zero pivots are zero."""
    size = covariance.shape[0]
    L: list[list[Any]] = [[0.0] * size for _ in range(size)]
    for j in range(size):
        pivot = covariance[j, j] - sum(L[j][k] ** 2 for k in range(j))
        inverted = ca.if_else(pivot > PIVOT * covariance[j, j], 1 / ca.sqrt(pivot), 0)
        for i in range(j, size):
            L[i][j] = (covariance[i, j] - sum(L[i][k] * L[j][k] for k in range(j))) * inverted
    return ca.vertcat(*(ca.horzcat(*row) for row in L))


def _linear(run: Run, system: System, augmented: tuple[Any, Any], u: Any, c: dict[str, Any], t: Any = None) -> Any:
    """What `System.linear` returns for a state and unknowns; rows that no run has are those of the nominal."""
    x, unknowns = augmented
    design, parameters = run.setting.design, system.parameters
    state = _rows(ca.vertcat(x, _rows(c["x"], design.states)), 0, system.statement.nx)
    known = ca.DM(parameters[: parameters.size - system.unknowns])
    time = c["t"] if t is None else t
    duration = run.setting.solution.duration
    return system.linear(state, _rows(u, 0, system.statement.nu), time, duration, ca.vertcat(known, unknowns))


def _rows(column: Any, first: int, last: int | None = None) -> Any:
    """Some rows of a column; (0, 1) where there are none, which slicing a single number does not give."""
    size = int(column.shape[0])
    return ca.vertsplit(column, [0, first, size if last is None else last, size])[1]


def _own_deviation(run: Run, z: Any, c: dict[str, Any]) -> Any:
    """The estimate of the deviation from the nominal, (n,)."""
    estimate = z[run.spans["estimate"]]
    return estimate - _nominal(run, c) if run.setting.filter == "extended" else estimate


def _nominal(run: Run, c: dict[str, Any]) -> Any:
    design = run.setting.design
    return ca.vertcat(_rows(c["x"], 0, design.states), ca.DM(design.start[design.states :]))


def _moved(run: Run, z: Any, c: dict[str, Any]) -> Any:
    """Deviation from the nominal and the filter's estimate of it, (2n,)."""
    actual = ca.vertcat(z[run.spans["x"]], run.own)
    return ca.densify(ca.vertcat(actual - _nominal(run, c), _own_deviation(run, z, c)))


def _control(run: Run, z: Any, c: dict[str, Any]) -> tuple[Any, Any]:
    """The control that the feedback asks for, and the one that there is, both of the fed-back rows."""
    if run.setting.flown:
        asked = _rows(z, run.spans["held"].start)
    else:
        asked = _rows(c["u"], 0, run.setting.design.fed_back) - c["C"] @ _own_deviation(run, z, c)
    limits, applied = run.setting.limits, []
    for i, (low, high) in enumerate(zip(limits.lower.tolist(), limits.upper.tolist(), strict=True)):
        value = ca.fmax(asked[i], low) if np.isfinite(low) else asked[i]
        applied.append(ca.fmin(value, high) if np.isfinite(high) else value)
    return asked, ca.vertcat(run.symbolic(0, 1), *applied)


def _drift(run: Run, z: Any, c: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Rate of the moving part of the state, the control asked for, the whole control applied."""
    setting, design, x = run.setting, run.setting.design, z[run.spans["x"]]
    asked, fed = _control(run, z, c)
    u = ca.vertcat(fed, _rows(c["u"], design.fed_back))
    rate, _, _, _, h, _, _, _ = _linear(run, setting.actual, (x, run.own), u, c)
    moved = fed - _rows(c["u"], 0, design.fed_back)
    parts = [_rows(rate, 0, design.states)]
    if setting.flown:
        parts += [run.symbolic.zeros(design.size), h]
    elif setting.filter == "perturbation":
        parts.append(c["drift"] @ z[run.spans["estimate"]] + c["input"] @ moved + c["K"] @ (h - c["h"]))
    else:
        parts += _extended(run, z, u, h, c)
    if design.statement.loop is not None:
        known = ca.DM(setting.solution.parameters[: setting.solution.parameters.size - design.unknowns])
        state, p = ca.vertcat(x, _rows(c["x"], design.states)), ca.vertcat(known, run.own)
        cost = design.statement.loop.running(state, u, c["t"], setting.solution.duration, p)
        parts.append(cost + ca.dot(moved, c["extra"] @ moved) / 2)
    return ca.vertcat(*parts), asked, u


def _estimated(run: Run, z: Any) -> tuple[Any, Any]:
    """State and unknowns as the extended filter has them."""
    y, states = z[run.spans["estimate"]], run.setting.design.states
    return _rows(y, 0, states), _rows(y, states)


def _extended(run: Run, z: Any, u: Any, h: Any, c: dict[str, Any]) -> list[Any]:
    """Rates of estimate and covariance of the filter that is linearised at its estimate."""
    design = run.setting.design
    rate, F, _, Q, expected, M, _, U = _linear(run, design, _estimated(run, z), u, c)
    half = z[run.spans["E"]]
    information = M.T @ inverse(U) @ M if design.measured else run.symbolic(design.size, design.size)
    change = riccati_rate(unpack_symbolic(half, design.size), F, Q, information)
    return [rate + filter_gain(half, design.size, M, U) @ (h - expected), pack_symbolic(ca.densify(change))]


def _noise(run: Run, z: Any, u: Any, sides: list[dict[str, Any]], h: Any) -> Any:
    """Factor of the noises of x and of the estimate, (states + n, noises), per root second."""
    setting, design = run.setting, run.setting.design
    t = sides[0]["t"] + h / 2
    _, _, _, Q, _, _, _, U = _linear(run, setting.actual, (z[run.spans["x"]], run.own), u, sides[0], t)
    process = run.symbolic(design.states, len(run.noisy))
    if run.noisy:
        process[run.noisy, :] = factor(Q[run.noisy, run.noisy])
    if not design.measured:
        return ca.vertcat(process, run.symbolic(design.size, len(run.noisy)))
    if setting.flown:
        return ca.diagcat(process, ca.vertcat(run.symbolic(design.size, design.measured), factor(U)))
    if setting.filter == "perturbation":
        K = (sides[0]["K"] + sides[1]["K"]) / 2
    else:
        _, _, _, _, _, M, _, assumed = _linear(run, design, _estimated(run, z), u, sides[0], t)
        K = filter_gain(z[run.spans["E"]], design.size, M, assumed)
    return ca.diagcat(process, K @ factor(U))


def _flags(run: Run, after: Any, asked: Any, u: Any) -> Any:
    """One where more control is asked for than there is, one where states or controls leave their bounds."""
    statement = run.setting.design.statement
    flags = _asked_flags(run, asked)
    bounds = statement.state_bounds, statement.control_bounds
    for rows, values, (low, high) in zip(run.bounded, (after, u), bounds, strict=True):
        flags += [_beyond(values[i], low[i], high[i]) for i in rows]
    return ca.vertcat(run.symbolic(0, 1), *flags)


def _asked_flags(run: Run, asked: Any) -> list[Any]:
    limits = run.setting.limits
    return [_beyond(asked[i], limits.least[i], limits.most[i]) for i in range(limits.least.size)]


def _beyond(value: Any, low: float, high: float) -> Any:
    """One where a value lies outside its bounds by more than rounding."""
    result: Any = 0.0
    if np.isfinite(low):
        result = value < low - BOUND_MARGIN * max(1.0, abs(low))
    if np.isfinite(high):
        result = ca.logic_or(result, value > high + BOUND_MARGIN * max(1.0, abs(high)))
    return result
