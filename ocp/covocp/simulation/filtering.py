"""What the filters of a run make of a step: readings of both halves, and the covariance in between.

During half a step the filter is given the mean of the actual measurement, white noise of the density 2 U/h included, as
one reading. The perturbation filter takes it with the gains of the design: for the first half with that of a reading
after E(t), E M'(M E M' + 2 U/h)^-1, for the second with that of one before E(t + h), which is h/2 K(t + h). The
extended filter takes it by the update of its own covariance (Joseph's form, row by row), and moves that by the tangent
Phi of the estimate's own Heun step:

    E -> Phi (E + h/2 Q) Phi' + h/2 Q+.

So an estimate never overshoots its reading, and a covariance stays positive semidefinite, however long the step is: the
scheme `strang` of the design's own covariances. Gains depend on what was known before a reading: Ito's sense.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from covocp.base.expressions import Given
from covocp.base.matrices import pack_symbolic, unpack_symbolic
from covocp.blocks.arithmetic import apply
from covocp.blocks.updates import updating
from covocp.simulation.run_parts import UNREAD, Run, control_of, estimate_of, factor, part, read_at, replaced, system_at
from covocp.simulation.schedule import by_rows, read_gain

# Less than any share of a reading that is taken.
LEAST_SHARE = 1e-9


def corrected(run: Run, z: Given, c: dict[str, Any], noise: Given, h: Given, *, late: bool) -> Any:
    """The state of a run after the reading of half a step.

    Args:
        run: its symbols.
        z: state of the run.
        c: coefficients at this end of the step.
        noise: normal numbers, one for each measured value.
        h: length of the step.
        late: whether it is the second half.
    """
    setting, design = run.setting, run.setting.design
    if setting.flown or not design.measured:
        return z
    _, fed = control_of(run, z, c)
    u = ca.vertcat(fed, part(c["u"], design.fed_back))
    actual = system_at(run, setting.actual, (z[run.spans["x"]], run.own), u, c)
    reading = actual.h + ca.sqrt(2 / h) * (factor(actual.U) @ noise)
    y = z[run.spans["estimate"]]
    if setting.filter == "perturbation":
        expected = c["h"] + c["M"] @ y + c["Hu"] @ (fed - part(c["u"], 0, design.fed_back))
        gain = h / 2 * c["K"] if late else c["early"]
        return replaced(z, run.spans["estimate"], y + gain @ (reading - expected))
    own = system_at(run, design, estimate_of(run, z), u, c)
    covariance = unpack_symbolic(z[run.spans["E"]], design.size)
    law = updating("sequential", "raise")
    none = run.symbolic.zeros(design.size)
    change, spread = apply(law, none, covariance, reading - own.h, own.M, 2 / h * own.U)
    estimate = design.geometry.move(y, change)
    return replaced(replaced(z, run.spans["estimate"], estimate), run.spans["E"], pack_symbolic(spread))


def read_now(run: Run, c: dict[str, Any], noise: Given, reading: Given) -> Any:
    """The state of a run after what is read at an instant; of a law's run the value itself, for its next step.

    Args:
        run: its symbols.
        c: coefficients there.
        noise: normal numbers, one for each value that can be read.
        reading: what is taken of each measurement: 0 or 1, or a part, whose noise is larger by so much.
    """
    setting, design, z = run.setting, run.setting.design, run.z
    taken = by_rows(design.statement, reading)
    _, fed = control_of(run, z, c)
    u = ca.vertcat(fed, part(c["u"], design.fed_back))
    actual = read_at(run, setting.actual, (z[run.spans["x"]], run.own), u, c)
    scatter = ca.if_else(taken > 0, 1 / ca.sqrt(ca.fmax(taken, LEAST_SHARE)), 0) * (factor(actual.R) @ noise)
    value = actual.h + scatter
    if setting.flown:
        before = z[run.spans["read"]]
        known = ca.if_else(before < UNREAD, before, 0)
        return replaced(z, run.spans["read"], ca.if_else(taken > 0, known + taken * value, before))
    y = z[run.spans["estimate"]]
    if setting.filter == "perturbation":
        expected = c["hr"] + c["Hr"] @ y + c["Hru"] @ (fed - part(c["u"], 0, design.fed_back))
        return replaced(z, run.spans["estimate"], y + c["Kr"] @ (value - expected))
    own = read_at(run, design, estimate_of(run, z), u, c)
    covariance = unpack_symbolic(z[run.spans["E"]], design.size)
    root = ca.sqrt(taken)
    gain = read_gain(design.statement, covariance, own.H, own.R, reading)
    left = run.symbolic.eye(design.size) - gain @ own.H
    seen = ca.if_else(taken > 0, 1 / ca.fmax(root, LEAST_SHARE), 0)
    spread = left @ covariance @ left.T + gain @ (ca.diag(seen) @ own.R @ ca.diag(seen)) @ gain.T
    estimate = design.geometry.move(y, gain @ (value - own.h))
    return replaced(replaced(z, run.spans["estimate"], estimate), run.spans["E"], pack_symbolic(ca.densify(spread)))


def moved_covariance(run: Run, z: Given, ahead: Given, sides: list[dict[str, Any]], h: Given) -> Any:
    """Half-vector of the extended filter's covariance after the motion of a step, before its second reading.

    Args:
        run: its symbols.
        z: state of the run at the start of the motion.
        ahead: Heun's first guess of its end.
        sides: coefficients at both ends.
        h: length of the step.
    """
    design = run.setting.design
    slopes, noises = [], []
    for state, c in zip((z, ahead), sides, strict=True):
        u = ca.vertcat(control_of(run, state, c)[1], part(c["u"], design.fed_back))
        at = system_at(run, design, estimate_of(run, state), u, c)
        slopes.append(at.F)
        noises.append(at.Q)
    first, second = slopes
    tangent = run.symbolic.eye(design.size) + h / 2 * (first + second + h * (second @ first))
    before = unpack_symbolic(z[run.spans["E"]], design.size) + h / 2 * noises[0]
    return pack_symbolic(ca.densify(tangent @ before @ tangent.T + h / 2 * noises[1]))
