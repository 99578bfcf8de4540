"""One step of one run of the actual system with its filter and feedback, as CasADi functions.

A step of length h is split in three (Strang): what is measured during its first half, the motion of the state x, of the
estimate y and of the cost without measurement, what is measured during its second half. The filter takes the means of
what is measured as readings (`filtering`), which no step size makes unstable. The motion goes by Heun's method with the
process noise added (Ito):

    z* = z + h a(z, t) + g,    z+ = z + h/2 (a(z, t) + a(z*, t + h)) + g,    g = B(z + h/2 a(z, t), t + h/2) sqrt(h) w,

w standard normal, B B' the spectral density: the noise is held over the step, at the value that it has half a step on
without noise. Additive noise gives moments of second order in h; noise that depends on the state those of Ito.

The perturbation filter estimates the deviation from the nominal with the gains of the design, in actual measurements m:

    dy = (F y + G du + K (m - h - M y - h_u du)) dt,    du = sat(u - C y) - u.

The extended filter estimates the state itself, linearised where it is, with a covariance of its own in each run.

A law of the user takes the place of both: its control is held over the steps between its samples, while the actual
measurement is integrated for its next one.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Given
from covocp.base.matrices import Array, half_length
from covocp.simulation.constraints import Place, asked_margins, beyond, counted_rows, violations
from covocp.simulation.filtering import corrected, moved_covariance, read_now
from covocp.simulation.run_parts import (
    UNREAD,
    Run,
    control_of,
    deviations,
    estimate_of,
    factor,
    part,
    replaced,
    system_at,
)


def start_of(run: Run) -> Array:
    """State of a run that starts at its mean, its filter at the mean of the design."""
    design, solution = run.setting.design, run.setting.solution
    z = np.zeros(run.z.shape[0])
    z[run.spans["x"]] = run.setting.actual.start[: design.entries]
    if run.setting.flown:
        z[run.spans["held"]] = solution.controls[0, : design.fed_back]
        z[run.spans["read"]] = UNREAD
    if run.setting.filter == "extended":
        z[run.spans["estimate"]] = design.start
        z[run.spans["E"]] = solution.trajectory.e[0][design.covariance]
    return z


def step_function(run: Run, constant: Array, varying: Given) -> ca.Function:
    """One step of a run.

    Args:
        run: its symbols.
        constant: values of the coefficients; zeros among them vanish from the graph.
        varying: which of them are inputs instead.

    Returns:
        (state, noise, own unknowns, varying coefficients at both ends and h) -> state after the step; deviation from
        the nominal and estimate of it there (2n).
    """
    w, rest = run.symbolic.sym("w", run.noises), run.symbolic.sym("rest", 1 + run.setting.design.statement.readings)
    h = rest[0]
    motion, early, late, _ = ca.vertsplit(w, run.parts_of_noise)
    if run.setting.flown:
        motion = ca.vertcat(motion, (early + late) / np.sqrt(2.0))
    symbols, sides = _sides(run, constant, varying)
    moving, end = run.moving, run.spans["held"].start
    z = corrected(run, run.z, sides[0], early, h, late=False)
    move = run.geometry.move
    first, applied = _drift(run, z, sides[0])
    g = _noise(run, move(z[moving], h / 2 * first), applied, sides, h) @ (ca.sqrt(h) * motion)
    g = ca.vertcat(g, run.symbolic.zeros(first.shape[0] - g.shape[0]))
    ahead = ca.vertcat(move(z[moving], h * first + g), part(z, moving.stop))
    second, _ = _drift(run, ahead, sides[1])
    after = ca.vertcat(move(z[moving], h / 2 * (first + second) + g), part(z, moving.stop))
    if run.setting.filter == "extended":
        after = replaced(after, run.spans["E"], moved_covariance(run, z, ahead, sides, h))
    after = corrected(run, after, sides[1], late, h, late=True)
    flags = ca.fmax(part(z, moving.stop, end), _flags(run, sides[0], ("path",)))
    outputs = [ca.densify(ca.vertcat(after[moving], flags, part(z, end))), deviations(run, after, sides[1])]
    options = {"cse": True} if run.symbolic is ca.SX else {}
    return ca.Function("step", [run.z, w, run.own, ca.vertcat(*symbols, rest)], outputs, options)


def _sides(run: Run, constant: Array, varying: Given) -> tuple[list[Any], list[dict[str, Any]]]:
    """Symbols of the coefficients that vary, at both ends of a step, and all coefficients there by name."""
    symbols = [run.symbolic.sym(name, varying.size) for name in ("before", "after")]
    sides = []
    for symbol in symbols:
        column = run.symbolic(ca.DM(constant))
        if varying.size:
            column[varying.tolist()] = symbol
        sides.append(run.coefficients.split(column))
    return symbols, sides


def read_function(run: Run, constant: Array, varying: Given) -> ca.Function | None:
    """What is read at an instant, as `step_function` with steps of no length; None where nothing is."""
    design = run.setting.design
    if not design.sampled:
        return None
    w, rest = run.symbolic.sym("w", run.noises), run.symbolic.sym("rest", 1 + design.statement.readings)
    symbols, sides = _sides(run, constant, varying)
    noise = ca.vertsplit(w, run.parts_of_noise)[3]
    after = read_now(run, sides[0], noise, rest[1:])
    flags = ca.fmax(part(after, run.moving.stop, run.spans["held"].start), _flags(run, sides[0], ("path",)))
    after = ca.vertcat(after[run.moving], flags, part(after, run.spans["held"].start))
    outputs = [ca.densify(after), deviations(run, after, sides[1])]
    return ca.Function("read", [run.z, w, run.own, ca.vertcat(*symbols, rest)], outputs)


def observe_function(run: Run) -> ca.Function:
    """(state, unknowns, coefficients at a time) -> deviation, its estimate, deviation of the control, flags.

    The flags: "asked" of each fed-back control, then whether each inequality is violated, those of all places.
    """
    column = run.symbolic.sym("c", run.coefficients.rows)
    c = run.coefficients.split(column)
    _, applied = control_of(run, run.z, c)
    moved = applied - part(c["u"], 0, run.setting.design.fed_back)
    y = ca.vertcat(deviations(run, run.z, c), moved, _flags(run, c, ("path", "initial", "final", "inside")))
    return ca.Function("observe", [run.z, run.own, column], [ca.densify(y)])


def finish_function(run: Run) -> ca.Function | None:
    """(state, unknowns) -> k + 1/2 d'(S(T) - k_xx) d: terminal cost, with the weights that are not in k."""
    design, solution = run.setting.design, run.setting.solution
    loop, end = design.statement.loop, solution.trajectory.x[-1]
    if loop is None:
        return None
    known = solution.parameters[: solution.parameters.size - design.unknowns]

    def terminal(augmented: Given) -> Any:
        state = ca.vertcat(part(augmented, 0, design.entries), ca.DM(end[design.entries :]))
        return loop.terminal(state, solution.duration, ca.vertcat(ca.DM(known), part(augmented, design.entries)))

    symbolic: Any = design.statement.symbolic
    d = symbolic.sym("d", design.size)
    nominal = ca.DM(np.concatenate([end[: design.entries], design.start[design.entries :]]))
    k, weight = terminal(design.geometry.move(nominal, d))
    extra = ca.Function("extra", [d], [weight - ca.hessian(k, d)[0]])(np.zeros(design.size))
    actual = ca.vertcat(run.z[run.spans["x"]], run.own)
    moved = design.geometry.difference(actual, nominal)
    cost = terminal(actual)[0] + ca.dot(moved, extra @ moved) / 2
    return ca.Function("finish", [run.z, run.own], [ca.densify(cost)])


def _drift(run: Run, z: Given, c: dict[str, Any]) -> tuple[Any, Any]:
    """Rate of the moving part of the state, the whole control applied."""
    setting, design, x = run.setting, run.setting.design, z[run.spans["x"]]
    _, fed = control_of(run, z, c)
    u = ca.vertcat(fed, part(c["u"], design.fed_back))
    actual = system_at(run, setting.actual, (x, run.own), u, c)
    moved = fed - part(c["u"], 0, design.fed_back)
    parts = [part(actual.rate, 0, design.states)]
    if setting.flown:
        parts += [run.symbolic.zeros(design.size), actual.h]
    elif setting.filter == "perturbation":
        parts.append(c["F"] @ z[run.spans["estimate"]] + c["G"] @ moved)
    else:
        expected = system_at(run, design, estimate_of(run, z), u, c).rate
        parts += [expected, run.symbolic.zeros(half_length(design.size))]
    known = ca.DM(setting.solution.parameters[: setting.solution.parameters.size - design.unknowns])
    state, p = ca.vertcat(x, part(c["x"], design.entries)), ca.vertcat(known, run.own)
    if run.sums:
        assert design.statement.nominal is not None
        gathered = design.statement.nominal(state, u, c["t"], setting.solution.duration, p)[0]
        parts += [gathered[k] for k in run.sums]
    if design.statement.loop is not None:
        cost = design.statement.loop.running(state, u, c["t"], setting.solution.duration, p)
        cost += ca.dot(moved, c["extra"] @ moved) / 2
        if design.statement.loop.weighed is not None:  # a run has no covariance X, but the deviations of which it is
            d = part(deviations(run, z, c), 0, design.size)
            of_state, crossed = ca.horzsplit(c["weighed"], [0, design.size, design.size + design.fed_back])
            cost += ca.dot(d, of_state @ d) / 2 + ca.dot(d, crossed @ moved)
        parts.append(cost)
    return ca.vertcat(*parts), u


def _noise(run: Run, z: Given, u: Given, sides: list[dict[str, Any]], h: Given) -> Any:
    """Factor of the noise of x, per root second; below it that of what a law measures, (rows, noises of the motion)."""
    setting, design = run.setting, run.setting.design
    t = sides[0]["t"] + h / 2
    actual = system_at(run, setting.actual, (z[run.spans["x"]], run.own), u, sides[0], t)
    process = run.symbolic(design.states, len(run.noisy))
    if run.noisy:
        process[run.noisy, :] = factor(actual.Q[run.noisy, run.noisy])
    if setting.flown and design.measured:
        return ca.diagcat(process, ca.vertcat(run.symbolic(design.size, design.measured), factor(actual.U)))
    return process


def _flags(run: Run, c: dict[str, Any], places: tuple[Place, ...]) -> Any:
    """One where more control is asked for than there is, one for each inequality of some places that is violated."""
    limits = run.setting.limits
    asked, fed = control_of(run, run.z, c)
    allowed = asked_margins(run.setting.solution, limits.least, limits.most)
    flags = [beyond(asked[i], *ends) for i, ends in enumerate(zip(limits.least, limits.most, allowed, strict=True))]
    violated = violations(run, run.z, fed, c)
    flags += [violated[i] for i in counted_rows(run.setting.design).at(*places)]
    return ca.vertcat(run.symbolic(0, 1), *flags)
