"""The sequence of subproblems in place of an NLP solver of CasADi: called as these are, and never built anew."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from covocp.base.matrices import Array
from covocp.solvers.at_point import AtPoint
from covocp.solvers.monitor import Monitor
from covocp.solvers.reduced.condensed import Bounds, Layout, layout_of
from covocp.solvers.reduced.curvature import Curvature, first_curvature
from covocp.solvers.reduced.sequence import Functions, Memory, Place, Sequence
from covocp.solvers.reduced.statuses import Status
from covocp.transcription.program import Program


class Engine:
    """The functions of a program, and what was learnt of it."""

    def __init__(self, program: Program, tolerance: float, most: int, monitor: Monitor) -> None:
        """Make the functions.

        Args:
            program: of one statement whose matrices are no variables.
            tolerance: see `Sequence`.
            most: iterations.
            monitor: that is told of each iteration.
        """
        self._program, self._monitor = program, monitor
        self.tolerance, self._most = tolerance, most
        self._of = AtPoint(program)
        self._memory: Memory | None = None
        self._layout: tuple[bytes, Layout] | None = None
        self._stats: dict[str, Any] = {}

    def __call__(
        self, *, x0: Array, p: Array, lam_x0: Any = None, lam_g0: Any = None, **limits: Array
    ) -> dict[str, Array]:
        """Solve; arguments and results by the names of CasADi's solvers. Multipliers to start from are not needed."""
        bounds = Bounds(**{name: np.asarray(value, dtype=float) for name, value in limits.items()})
        layout = self._layout_of(bounds)
        start = self._at(layout, p)(x0)
        if start is None:
            self._program.check_finite(x0, (p[:-1],))
            self._stats = {"success": False, "return_status": str(Status.NO_NUMBER), "iter_count": 0}
            return {"x": x0, "lam_x": np.zeros(x0.size), "lam_g": np.zeros(bounds.lbg.size)}
        sequence = Sequence(
            Functions(full=self._at(layout, p), value=self._values(p)),
            layout,
            bounds,
            first=self._first(layout, p),
            tolerance=self.tolerance,
            most=self._most,
            watch=self._monitor.seen,
        )
        memory = self._memory if lam_g0 is not None else None  # what was learnt at a plan helps near it
        if memory is not None and memory.curvature.matrix.shape[0] != layout.chosen.size:
            memory = None
        with np.errstate(all="ignore"):  # a step into numbers too large to be squared is one that is not taken
            ended = sequence.run(start, memory)
        self._memory = ended.memory if ended.status is Status.SOLVED else None
        self._stats = {
            "success": ended.status is Status.SOLVED,
            "return_status": str(ended.status),
            "iter_count": ended.iterations,
            "concave": sequence.concave,
        }
        return {"x": ended.place.w, "lam_x": ended.lam_x, "lam_g": ended.lam_g}

    def _layout_of(self, bounds: Bounds) -> Layout:
        """The layout for these bounds; that of the last call where the same are fixed or infinite."""
        limited = np.isfinite(bounds.lbx) | np.isfinite(bounds.ubx)
        key = np.concatenate([bounds.ubx > bounds.lbx, limited]).tobytes()
        if self._layout is None or self._layout[0] != key:
            self._layout = key, layout_of(self._program, bounds, self._of.pattern)
        return self._layout[1]

    def stats(self) -> dict[str, Any]:
        """How the last call ended."""
        return self._stats

    def forget(self) -> None:
        """Begin the next run without what was learnt."""
        self._memory = None

    @property
    def functions(self) -> AtPoint:
        """Of the program."""
        return self._of

    def _at(self, layout: Layout, p: Array) -> Callable[[Array], Place | None]:
        """Everything at a point."""

        def full(w: Array) -> Place | None:
            outputs = self._of.full(w, p)
            if outputs is None or not all(np.isfinite(values).all() for values in outputs):
                return None
            cost, g, slope, entries = outputs
            return Place(w=w, cost=float(cost[0]), slope=slope, g=g, jacobian=layout.slopes(entries))

        return full

    def _values(self, p: Array) -> Callable[[Array], tuple[float, Array] | None]:
        """Cost and rows at a point."""

        def value(w: Array) -> tuple[float, Array] | None:
            outputs = self._of.value(w, p)
            if outputs is None or not all(np.isfinite(values).all() for values in outputs):
                return None
            return float(outputs[0][0]), outputs[1]

        return value

    def _slope(self, w: Array, p: Array) -> Array:
        """Slope of the cost; NaN where it has none."""
        outputs = self._of.full(w, p)
        return np.full(w.size, np.nan) if outputs is None else outputs[2]

    def _first(self, layout: Layout, p: Array) -> Callable[[Place], Curvature]:
        (part,) = self._program.parts

        def first(place: Place) -> Curvature:
            trajectory, _ = part.unpack(place.w, p[:-1])
            return first_curvature(
                part,
                layout.chosen,
                place.w,
                trajectory,
                p[:-1],
                lambda w: self._slope(w, p),
                float(p[-1]),
            )

        return first
