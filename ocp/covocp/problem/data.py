"""Data over time: tables of the running time that cover every duration that may come."""

from __future__ import annotations

import re
from typing import Any, Literal

import casadi as ca
import numpy as np

from covocp.base.checks import as_number, caller
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.later import later
from covocp.base.matrices import Array
from covocp.problem.declarations import Data, Declarations
from covocp.statement.time_data import TimeData

DEGREES = {"linear": 1, "cubic": 3}
# Share of the duration by which its end may miss the last time, and be the same.
SAME = 1e-12


def data_over_time(
    own: Declarations, name: str, times: Given, values: Given, kind: Literal["linear", "cubic"], unit: str
) -> Data:
    """Data of a problem; arguments and errors as of `Problem.data`."""
    knots, columns = as_number(name, "times", times), _columns(name, times, values)
    blocks = later("blocks.tables")  # with scipy, which takes longer to import than all of covocp
    tables = [blocks.table(name, knots, column, kind=kind) for column in columns.T]
    _check_covered(own, name, knots)
    function = _looked_up(name, knots, columns, DEGREES[kind])
    if knots.size - 1 <= blocks.SMALL_CELLS:
        t = ca.SX.sym("t")
        function = ca.Function(_identifier(name), [t], [ca.vertcat(*(entry(t) for entry in tables))])
    expression: Any = function(own.time)
    course = TimeData(name=name, unit=unit, kind=kind, times=np.array(knots), values=columns, expression=expression)
    return Data(course=course, function=function, where=caller())


def _looked_up(name: str, times: Array, values: Array, degree: int) -> ca.Function:
    """Data as a function that looks its piece up: one call, also where all else is written out in scalars.

    Beyond its knots a B-spline is zero: what rounding leads there is taken at the outermost ones.
    """
    from scipy.interpolate import make_interp_spline  # here: importing scipy takes longer than all of covocp

    spline = make_interp_spline(times, values, k=degree)
    count, first, last = values.shape[1], float(times[0]), float(times[-1])
    pieces = ca.Function.bspline("spline", [spline.t.tolist()], spline.c.ravel().tolist(), [spline.k], count)
    t = ca.MX.sym("t")
    return ca.Function(_identifier(name), [t], [pieces(ca.fmin(ca.fmax(t, first), last))], {"never_inline": True})


def used_data(problem: Declarations) -> tuple[TimeData, ...]:
    """The data that are in dynamics, noise, measurements, costs or constraints."""
    if not problem.data:
        return ()
    used = [value for rate in problem.rates.values() for value in (rate.rate, rate.noise)]
    used += [value for m in problem.measurements for value in (m.expression, m.noise, m.information)]
    used += [value for m in problem.matrices if m.backward is not None for value in m.backward.form]
    used += [c.expression for c in problem.constraints] + list(problem.cost or ())
    expression = ca.veccat(*(value for value in used if value is not None))
    called = ca.Function("used", ca.symvar(expression), [expression]).find_functions()
    inside = {function.__hash__() for function in called}
    return tuple(entry.course for entry in problem.data if entry.function.__hash__() in inside)


def _columns(name: str, times: Given, values: Given) -> Array:
    """The values, (K, m)."""
    numbers, count = as_number(name, "values", values), as_number(name, "times", times).shape
    if len(count) != 1 or numbers.ndim not in (1, 2) or numbers.shape[0] != count[0] or not numbers.size:
        raise ProblemError(
            f"The times and the values of the data '{name}' do not fit.",
            expected="times of shape (K,), values of shape (K,) or, of a vector of m entries, (K, m)",
            received=f"times of shape {count}, values of shape {numbers.shape}",
            remedy="give a value, or a row of m values, for each time",
        )
    return np.array(numbers, dtype=float).reshape(count[0], -1)


def check_data_cover(own: Declarations) -> None:
    """All data must reach to the terminal time, which may be another one than when they were declared.

    Raises:
        ProblemError: one of them ends before.
    """
    for entry in own.data:
        _check_covered(own, entry.course.name, entry.course.times)


def _check_covered(own: Declarations, name: str, times: Array) -> None:
    """The times must reach from 0 to the largest terminal time."""
    free = own.free_duration
    longest = float(own.duration) if free is None else free.upper
    if not np.isfinite(longest):
        raise ProblemError(
            f"The data '{name}' cannot cover a duration without an upper bound.",
            expected="Free(guess, lower, upper) with an upper bound that the times reach",
            received=f"times up to {times[-1]:g} s, an upper bound of inf",
            remedy=f"write Free(..., upper={times[-1]:g}), or how the values go on as an expression of Problem.time",
        )
    if times[0] > SAME * longest or times[-1] < longest * (1 - SAME):
        raise ProblemError(
            f"The data '{name}' do not cover the time of the problem.",
            expected=f"times from 0 to {longest:.15g} s"
            + ("" if free is None else ", the upper bound of the duration"),
            received=f"times from {times[0]:.15g} to {times[-1]:.15g} s",
            remedy="give values at both ends too: beyond its times a table knows nothing"
            + ("" if free is None else "; or lower the upper bound, Free(guess, lower, upper)"),
        )


def _identifier(name: str) -> str:
    """The name in letters and digits, as functions and C code need it."""
    return "data_" + re.sub("_+", "_", re.sub("[^0-9A-Za-z]", "_", name)).strip("_")
