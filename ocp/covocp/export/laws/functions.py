"""CasADi functions as laws: blocks, filters, feedback laws, whatever somebody has written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import ExportError
from covocp.base.matrices import Array
from covocp.export.laws.law import Law, Points, Port, flat, shaped, stacked_size
from covocp.export.text.names import identifier

# Decades of the magnitudes at which functions without given ranges are compared.
DECADES = (-1.0, 1.0)


def function_laws(
    functions: Sequence[ca.Function], ranges: Mapping[str, Any], units: Mapping[str, str], tolerance: float
) -> list[Law]:
    """The laws of some CasADi functions.

    Args:
        functions: with different names.
        ranges: of inputs by name, (lower, upper), between which C is compared with Python; others are normal numbers.
        units: of inputs and outputs by name.
        tolerance: largest relative deviation.

    Raises:
        ExportError: a function without outputs, two of the same name, a range or unit of nothing.
    """
    laws, names = [], set[str]()
    inputs = {name for f in functions for name in f.name_in()}
    both = inputs | {name for f in functions for name in f.name_out()}
    for what, given, known, kind in (("ranges", ranges, inputs, "input"), ("units", units, both, "input or output")):
        for name in given:
            if name not in known:
                raise ExportError(
                    f"{what} names '{name}', which is no {kind}.",
                    expected="one of " + ", ".join(sorted(known)),
                    received=repr(name),
                    remedy=f"correct {what}=",
                )
    for function in functions:
        if function.name() in names:
            raise ExportError(
                f"Two functions are called '{function.name()}'.",
                expected="functions with different names",
                received=", ".join(f.name() for f in functions),
                remedy="make them with different names: casadi.Function('update', ...)",
            )
        names.add(function.name())
        laws.append(_law(function, ranges, units, tolerance))
    return laws


def _law(function: ca.Function, ranges: Mapping[str, Any], units: Mapping[str, str], tolerance: float) -> Law:
    """One function with dense, flat arguments."""
    taken: set[str] = set()
    inputs = [_port(function.name_in(i), function.size_in(i), taken, units) for i in range(function.n_in())]
    outputs = []
    for i in range(function.n_out()):
        name = function.name_out(i)
        outputs.append(_port(f"{name}_out" if name in taken else name, function.size_out(i), taken, units, name))
    if not stacked_size(tuple(outputs)):
        raise ExportError(
            f"The function '{function.name()}' returns nothing.",
            expected="at least one output",
            received=str(function),
            remedy="leave it out",
        )
    given = {
        _name: ranges[function.name_in(i)]
        for i, _name in enumerate(p.name for p in inputs)
        if function.name_in(i) in ranges
    }
    kept = tuple(port for port in inputs if port.size)
    return Law(
        name="real_law" if function.name() == "real" else function.name(),  # <package>_real is a type
        kind="function",
        about=(str(function),),
        core=_core(function, inputs, outputs),
        inputs=kept,
        outputs=tuple(port for port in outputs if port.size),
        points=_points(kept, _limits(kept, given)),
        tolerance=tolerance,
    )


def _port(name: str, shape: tuple[int, int], taken: set[str], units: Mapping[str, str], key: str | None = None) -> Port:
    return Port(
        name=identifier(name, taken),
        rows=shape[0],
        columns=shape[1],
        unit=units.get(key if key is not None else name, ""),
    )


def _core(function: ca.Function, inputs: list[Port], outputs: list[Port]) -> ca.Function:
    """The function with flat columns; those without entries are left out."""
    symbolic: Any = ca.SX if function.is_a("SXFunction") else ca.MX
    columns = [symbolic.sym(port.name, port.size) for port in inputs if port.size]
    rest = iter(columns)
    arguments = [
        shaped(next(rest), port.rows, port.columns) if port.size else symbolic(port.rows, port.columns)
        for port in inputs
    ]
    results = function.call(arguments, symbolic is ca.SX, False)
    values = [flat(value) for value, port in zip(results, outputs, strict=True) if port.size]
    return ca.Function(function.name(), columns, values)


def _limits(ports: tuple[Port, ...], ranges: Mapping[str, Any]) -> dict[str, tuple[Array, Array]]:
    """Lower and upper values of the ports that have a range, flat."""
    limits = {}
    for port in ports:
        if port.name not in ranges:
            continue
        try:
            low, high = (
                np.broadcast_to(np.asarray(bound, dtype=float), port.shape).ravel() for bound in ranges[port.name]
            )
        except (TypeError, ValueError):
            low, high = np.array([1.0]), np.array([0.0])
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
            raise ExportError(
                f"The range of '{port.name}' does not fit.",
                expected=f"(lower, upper), finite, numbers or of shape {port.shape}",
                received=repr(ranges[port.name])[:100],
                remedy="correct ranges=",
            )
        limits[port.name] = (low, high)
    return limits


def _points(ports: tuple[Port, ...], limits: Mapping[str, tuple[Array, Array]]) -> Points:
    """Zero, ones, large numbers (square matrices: times unity), both ends of the ranges, NaN, then random points."""

    def edge(kind: int) -> Array:
        parts = []
        for port in ports:
            low, high = limits.get(port.name, (np.zeros(port.size), np.ones(port.size)))
            plain = port.name not in limits
            square = plain and port.rows == port.columns > 1
            unit = np.eye(port.rows).ravel() if square else np.ones(port.size)
            parts.append(
                [
                    unit if square else low,
                    high if not square else 2.0 * unit,
                    (1e6 if plain else 1.0) * (unit if square else high),
                ][kind]
            )
        return np.concatenate([np.zeros(0), *parts])

    def points(random: np.random.Generator, count: int) -> Array:
        rows = [edge(0), edge(1), edge(2), np.full(stacked_size(ports), np.nan)]
        for _ in range(count - len(rows)):
            rows.append(
                np.concatenate([np.zeros(0), *(_random(port, limits.get(port.name), random) for port in ports)])
            )
        return np.array(rows[:count])

    return points


def _random(port: Port, limits: tuple[Array, Array] | None, random: np.random.Generator) -> Array:
    """Random values of one port: uniform in its range, positive definite where it is square, else normal."""
    if limits is not None:
        return np.asarray(random.uniform(*limits))
    magnitude = 10.0 ** random.uniform(*DECADES)
    if port.rows == port.columns > 1:
        root = random.standard_normal((port.rows, port.rows))
        return np.asarray(magnitude * (root @ root.T / port.rows + 0.1 * np.eye(port.rows))).ravel()
    return np.asarray(magnitude * random.standard_normal(port.size))
