"""What moves the command of a peak seeker between its steps: the ramp to the next command, persistent excitation."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.arguments import checked, is_number, positive
from covocp.base.expressions import Expr
from covocp.blocks.values import array, is_symbolic, wrong_argument


@checked(period=positive, step=positive)
def ramp(command: Expr, increment: Expr, *, period: float, step: float) -> Any:
    """The command a step later: at the rate increment / period, so that it has moved by the increment after a period.

    Args:
        command: shape (n,) or a number.
        increment: what `Seeker.step` returned at the beginning of the period, shape (n,).
        period: of the seeker [s].
        step: of the plant [s].

    Returns:
        The command at the end of the step, in the units of the command.

    Raises:
        ProblemError: period or step that are not positive, a command and an increment that do not fit.
    """
    if not is_symbolic(command, increment):
        given, moved = array("command", command), array("increment", increment)
        if given.ndim and given.shape != moved.shape:
            raise wrong_argument("increment", f"shape {given.shape}, that of the command", f"shape {moved.shape}")
        return given + moved * (step / period) if given.ndim or moved.ndim else float(given + moved * (step / period))
    return command + increment * (step / period)


@checked(period=positive)
def sine(t: Expr, amplitude: Expr, period: float, *, start: float = 0.0, end: float = np.inf) -> Any:
    """Excitation amplitude * sin(2 pi (t - start) / period) between two times, zero outside.

    Args:
        t: a number, an array of them, or an expression [s].
        amplitude: of each input, a number or shape (n,).
        period: [s].
        start: when it begins [s].
        end: when it ends [s].

    Returns:
        What is added to the command: as t where the amplitude is a number, otherwise with a last axis of n (an
        expression: a column).

    Raises:
        ProblemError: an amplitude or a time that does not fit.
    """
    phase = _phase(t, period, start, end)
    if is_symbolic(t, amplitude):
        return amplitude * ca.sin(phase) * _active(t, start, end)
    size = array("amplitude", amplitude)
    wave = np.sin(phase) * _active(t, start, end)
    return wave * float(size) if size.ndim == 0 else np.multiply.outer(wave, size.ravel())


@checked(period=positive)
def circle(t: Expr, radius: float, period: float, *, start: float = 0.0, end: float = np.inf) -> Any:
    """Excitation of two inputs, radius * (sin, cos) of 2 pi (t - start) / period between two times, zero outside.

    Args:
        t: a number, an array of them, or an expression [s].
        radius: in the units of the command.
        period: [s].
        start: when it begins [s].
        end: when it ends [s].

    Returns:
        What is added to the command, shape (2,), of an array of times (..., 2), of an expression a column.

    Raises:
        ProblemError: a radius or a time that does not fit.
    """
    if not is_symbolic(radius) and not is_number(radius):
        raise wrong_argument("radius", "a number", f"{radius!r}"[:60])
    phase, active = _phase(t, period, start, end), _active(t, start, end)
    if is_symbolic(t, radius):
        return radius * active * ca.vertcat(ca.sin(phase), ca.cos(phase))
    return np.stack([np.sin(phase) * active, np.cos(phase) * active], axis=-1) * radius


def _phase(t: Expr, period: float, start: float, end: float) -> Any:
    """Angle since the start [rad].

    Raises:
        ProblemError: times that are none, or in the wrong order.
    """
    if not is_number(start) or not (is_number(end) or end == np.inf) or end <= start:
        raise wrong_argument("end", "a time after start, or inf", f"start={start!r}, end={end!r}")
    return 2 * np.pi / period * ((t if is_symbolic(t) else array("t", t)) - start)


def _active(t: Expr, start: float, end: float) -> Any:
    """1 from the start on until the end, otherwise 0."""
    if is_symbolic(t):
        return (t >= start) if end == np.inf else ca.logic_and(t >= start, t < end)
    times = array("t", t)
    return ((times >= start) & (times < end)).astype(float)
