"""Panels of one quantity over another: paths, with the ellipses of their covariance, start and target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.plot.curves import Drawn, Ellipse, Panel, shortened, unit_of
from covocp.statement.names import block_of

# Ellipses along a path, evenly spread over the time.
ELLIPSES = 9


def over_panels(drawn: Sequence[Drawn], panels: list[Panel], key: Given, units: Mapping[str, str]) -> list[Panel]:
    """The panels with another quantity than time as abscissa.

    Args:
        drawn: the solutions.
        panels: over time.
        key: name or expression of the abscissa.
        units: by name.

    Raises:
        ProblemError: it is not a scalar.
    """
    changed = []
    for panel in panels:
        curves = []
        for curve in panel.curves:
            solution = drawn[curve.order].solution
            at_nodes = solution[key]
            if at_nodes.ndim != 1:
                raise ProblemError(
                    "The abscissa of a figure is one number at each time.",
                    expected="a scalar state, control or expression",
                    received=f"{shortened(key)}, {at_nodes[0].size} numbers",
                    remedy="choose over= among the scalars, or one entry of it",
                )
            smooth = solution.at(curve.t)[key] if isinstance(key, str) else np.interp(curve.t, solution.t, at_nodes)
            curves.append(replace(curve, t=smooth))
        ellipses = tuple(e for d in drawn for e in _ellipses(d, key, panel)) if len(panel.entries) == 1 else ()
        plain = [replace(curve, deviation=None) for curve in curves] if ellipses else curves
        path = isinstance(key, str) and _is_state(drawn, key) and _is_state(drawn, panel.key)
        changed.append(
            replace(
                panel,
                curves=tuple(plain),
                path=path,
                equal=path and _comparable(key, panel.key, units),
                ellipses=ellipses,
            )
        )
    return changed


def _is_state(drawn: Sequence[Drawn], name: str) -> bool:
    blocks = [block_of(name, d.solution.blocks) for d in drawn]
    return any(block is not None and block.kind == "state" for block in blocks)


def _comparable(one: str, other: str, units: Mapping[str, str]) -> bool:
    """Whether two states are measured in the same unit: they say so, or they are entries of one vector."""
    if unit_of(one, units) or unit_of(other, units):
        return unit_of(one, units) == unit_of(other, units)
    return one.split("[")[0] == other.split("[")[0]


def _ellipses(drawn: Drawn, key: Given, panel: Panel) -> list[Ellipse]:
    """Ellipses of two states or unknowns at some nodes, where both are uncertain."""
    rows = [drawn.rows(name) if isinstance(name, str) else [] for name in (key, panel.key)]
    blocks = [block_of(name, drawn.solution.blocks) for name in (key, panel.key) if isinstance(name, str)]
    turned = any(block is not None and block.tangent for block in blocks)  # its rows are not of its entries
    if turned or any(len(own) != 1 for own in rows) or rows[0] == rows[1]:
        return []
    solution = drawn.solution
    full = solution.values[drawn.covariance.name] if drawn.covariance is not None else np.zeros(0)
    if solution.loop is not None:
        full = solution.loop.X
    pair = [own[0] for own in rows]
    nodes = np.unique(np.searchsorted(solution.t, np.linspace(0.0, 1.0, ELLIPSES) * solution.duration * (1 - 1e-12)))
    centres = np.column_stack([solution[key], solution[panel.key]])
    covariances = full[:, pair][:, :, pair]
    return [
        Ellipse(centre=centres[k], covariance=covariances[k], order=drawn.order)
        for k in nodes
        if np.isfinite(covariances[k]).all() and np.diagonal(covariances[k]).max() > 0
    ]


def outline(covariance: Array, size: float, points: int = 121) -> Array:
    """Points (2, points) of the ellipse of a covariance at some standard deviations."""
    scale = np.sqrt(np.diag(covariance).clip(np.finfo(float).tiny))  # components of unequal units
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    circle = np.vstack([np.cos(angle), np.sin(angle)])
    return np.asarray(size * scale[:, None] * (vectors @ (np.sqrt(values.clip(0.0))[:, None] * circle)))
