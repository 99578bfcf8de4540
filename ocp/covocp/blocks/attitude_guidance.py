"""Guidance to the attitude of greatest power: along the estimated gradient, between pointing zones.

A. Walsh, J. R. Forbes, S. A. Chee, J. J. Ryan, J. Guidance, Control, and Dynamics, 2017, doi 10.2514/1.G002635, with
the corrections of docs/blocks/attitude_seeking.md; the equations are numbered as there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, Unpack

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from covocp.base.arguments import checked, one_of, truth
from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import half_indices
from covocp.base.short_repr import short_repr
from covocp.blocks import attitude_filter as filters
from covocp.blocks.arithmetic import TINY, beside, where
from covocp.blocks.attitude_filter import Correction, GradientEstimate, Memory
from covocp.blocks.attitude_options import Options, Settings, settings_of
from covocp.blocks.checked_function import CheckedFunction
from covocp.blocks.excitation import sine
from covocp.blocks.factors import triangular
from covocp.blocks.quaternions import from_quaternion, quaternion_step
from covocp.blocks.values import array, wrong_argument
from covocp.blocks.zone_programs import MOST_ROWS, SILENT, projection, projection_by_solver, reduced
from covocp.blocks.zones import Zone, ZoneLike, zone_rows, zones_of

Array = NDArray[np.float64]
SettingsName = Literal["recommended", "printed"]
Method = Literal["enumeration", "osqp"]
# (correction, rotation matrix) -> (gradient, factor of its covariance, direction)
Guidance = Callable[[Correction, Expr], tuple[Any, Any, Any]]


@dataclass(frozen=True, kw_only=True, eq=False)
class AttitudeSeeker:
    """A law of attitude seeking, made by `unconstrained`, `projected` or `constrained`.

    Attitudes are unit quaternions with the scalar first: four numbers for nine, whose logarithm is exact up to 180 deg
    and which cannot cease to be rotations but by their length, which is made one.

    Attributes:
        period: of the guidance [s].
        zones: as inclusion zones, with the margin.
        read: casadi.Function (memory, attitude (4,), power) -> memory, for a reading between two guidance steps.
        update: casadi.Function (memory, attitude (4,), power) -> memory, for the reading of a guidance step; power of
            NaN is left out, and so is an attitude of NaN.
        step: casadi.Function (memory) -> desired attitude (4,), until the next guidance step; before the first one the
            attitude of the memory.
        layout: where things are in the memory.
    """

    period: float
    zones: tuple[Zone, ...]
    read: CheckedFunction
    update: CheckedFunction
    step: CheckedFunction
    layout: Memory
    _initial: Array

    __repr__ = short_repr

    def initial(self, attitude: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> Array:
        """The memory before the first reading.

        Args:
            attitude: unit quaternion, which is desired until the first guidance step.

        Raises:
            ProblemError: no four numbers of length one.
        """
        numbers = np.ravel(array("attitude", attitude))
        if numbers.shape != (filters.QUATERNION,) or not abs(np.linalg.norm(numbers) - 1.0) < 1e-6:
            raise wrong_argument("attitude", "a unit quaternion, four numbers", f"{attitude!r}"[:80])
        memory = self._initial.copy()
        memory[self.layout.attitude] = memory[self.layout.guided] = numbers
        return memory

    def law(self) -> ca.Function:
        """A guidance step, `update` and `step`, as `simulate_sampled` takes it.

        Returns:
            casadi.Function (memory, measured (5,): attitude and power, t) -> (memory, desired attitude (4,)).
        """
        memory, measured, t = self._symbols()
        new = self.update(memory, measured[: filters.QUATERNION], measured[filters.QUATERNION])
        names: Any = (["memory", "measured", "t"], ["memory_out", "desired"])
        return self._expanded(ca.Function("attitude_seeking", [memory, measured, t], [new, self.step(new)], *names))

    def reading(self) -> ca.Function:
        """A reading between guidance steps, `read`, as `simulate_sampled` takes it.

        Returns:
            casadi.Function (memory, measured (5,), t) -> memory.
        """
        memory, measured, t = self._symbols()
        new = self.read(memory, measured[: filters.QUATERNION], measured[filters.QUATERNION])
        names: Any = (["memory", "measured", "t"], ["memory_out"])
        return self._expanded(ca.Function("attitude_reading", [memory, measured, t], [new], *names))

    def _symbols(self) -> tuple[Any, Any, Any]:
        return ca.MX.sym("memory", self.layout.size), ca.MX.sym("measured", filters.QUATERNION + 1), ca.MX.sym("t")

    def _expanded(self, function: ca.Function) -> ca.Function:
        """As scalar operations, where the law has no solver in it."""
        return function.expand() if self.update.is_a("SXFunction") else function

    def estimate(self, memory: ArrayLike) -> GradientEstimate:
        """What a memory says of the function.

        Args:
            memory: shape (..., size).

        Returns:
            Gradient and covariance, with the leading axes of the memory.

        Raises:
            ProblemError: another size.
        """
        numbers, layout = array("memory", memory), self.layout
        if isinstance(memory, ca.DM):
            numbers = numbers.ravel()
        if numbers.ndim < 1 or numbers.shape[-1] != layout.size:
            expected = f"shape (..., {layout.size})"
            raise wrong_argument("memory", expected, f"shape {numbers.shape}", "give what update() returned")
        rows, columns = half_indices(filters.AXES)
        lower = np.zeros((*numbers.shape[:-1], filters.AXES, filters.AXES))
        lower[..., rows, columns] = numbers[..., layout.factor]
        return GradientEstimate(
            gradient=numbers[..., layout.gradient].copy(),
            covariance=lower @ np.swapaxes(lower, -1, -2),
            direction=numbers[..., layout.direction].copy(),
            attitude=numbers[..., layout.attitude].copy(),
        )


@checked(settings=one_of("recommended", "printed"))
def unconstrained(*, settings: SettingsName = "recommended", **changes: Unpack[Options]) -> AttitudeSeeker:
    """Steps d = kappa b along the estimated gradient, section 3.

    Args:
        settings: "recommended", or "printed": the paper's numbers.
        **changes: of these settings, see `Options`; `smallest_step` and `largest_step` bound |kappa b|.

    Returns:
        The law.

    Raises:
        ProblemError: an argument that does not fit, an option of another law, step bounds that are crossed.
    """
    found = settings_of("unconstrained", settings, changes)

    def guide(correction: Correction, rotation: Expr) -> tuple[Any, Any, Any]:
        b = correction.gradient
        length = found.kappa * ca.sqrt(ca.fmax(ca.sumsqr(b), TINY))
        share = ca.SX(1)
        if found.largest_step is not None:
            share = ca.fmin(share, found.largest_step / length)
        if found.smallest_step > 0:
            share = ca.fmax(share, ca.if_else(ca.sumsqr(b) > 0, found.smallest_step / length, 1))
        return b, correction.factor, share * b

    return _seeker(found, (), guide)


@checked(settings=one_of("recommended", "printed"), method=one_of("enumeration", "osqp"), curvature=truth)
def projected(
    zones: Sequence[ZoneLike],
    *,
    margin: float = 0.0,
    curvature: bool = False,
    method: Method | None = None,
    settings: SettingsName = "recommended",
    **changes: Unpack[Options],
) -> AttitudeSeeker:
    """Steps along the gradient that is nearest to the estimated one and keeps the zones, (5).

    Args:
        zones: each (body axis, inertial direction, half angle [deg], "inclusion" or "exclusion").
        margin: by which each zone is tightened [deg].
        curvature: keep A d - |d|^2 / 2 >= beta, which is enough for the zones themselves, not A d >= beta.
        method: "enumeration" of the active sets, as scalar operations, of up to three zones; "osqp" of any number,
            which is not exported; None: the first that fits.
        settings: "recommended", or "printed": the paper's numbers.
        **changes: of these settings, see `Options`.

    Returns:
        The law; its estimate and covariance are those of `unconstrained`.

    Raises:
        ProblemError: an argument that does not fit, zones that contradict one another, too many for the method.
    """
    found, made = settings_of("projected", settings, changes), zones_of(zones, margin)
    chosen = method or ("enumeration" if len(made) <= MOST_ROWS else "osqp")
    if chosen == "enumeration":
        _check_count(made, "give method='osqp'")
    elif curvature:
        raise wrong_argument("curvature", "False with method='osqp'", "True", "give at most three zones")

    def guide(correction: Correction, rotation: Expr) -> tuple[Any, Any, Any]:
        b = correction.gradient
        near = b if chosen == "osqp" else projection(b, zone_rows(rotation, made), found.kappa, curvature=curvature)
        return b, correction.factor, near

    return _seeker(found, made, guide, solver=chosen == "osqp" and bool(made))


@checked(settings=one_of("recommended", "printed"), curvature=truth)
def constrained(
    zones: Sequence[ZoneLike],
    *,
    margin: float = 0.0,
    curvature: bool = False,
    settings: SettingsName = "recommended",
    **changes: Unpack[Options],
) -> AttitudeSeeker:
    """The matrix inequality filter, whose gain keeps zones and step bound, by the reduction (8).

    Args:
        zones: each (body axis, inertial direction, half angle [deg], "inclusion" or "exclusion"), at most three.
        margin: by which each zone is tightened [deg].
        curvature: keep A d - |d|^2 / 2 >= beta, which is enough for the zones themselves, not A d >= beta.
        settings: "recommended", or "printed": the paper's numbers.
        **changes: of these settings, see `Options`; `penalty` is that of a zone which cannot be kept.

    Returns:
        The law; its estimate and covariance are those of the gain of least covariance, (9).

    Raises:
        ProblemError: an argument that does not fit, zones that contradict one another, more than three.
    """
    found, made = settings_of("constrained", settings, changes), zones_of(zones, margin)
    _check_count(made, "use projected(method='osqp')")

    def guide(correction: Correction, rotation: Expr) -> tuple[Any, Any, Any]:
        program: Any = {"kappa": found.kappa, "penalty": found.penalty, "largest_step": found.largest_step}
        covariance = correction.factor @ correction.factor.T
        kept = reduced(
            correction.gradient, covariance, zone_rows(rotation, made), **program, curvature=curvature
        ).gradient
        seen = correction.surprise > SILENT
        change = where(seen, kept - correction.gradient)
        grown = change / ca.sqrt(ca.if_else(seen, correction.surprise, 1))
        return correction.gradient + change, triangular(beside(correction.factor, grown)), kept

    return _seeker(found, made, guide)


def _check_count(zones: tuple[Zone, ...], remedy: str) -> None:
    """Few enough for enumeration.

    Raises:
        ProblemError: too many.
    """
    if len(zones) > MOST_ROWS:
        raise wrong_argument(
            "zones", f"at most {MOST_ROWS} zones, whose active sets are gone through", f"{len(zones)}", remedy
        )


def _seeker(settings: Settings, zones: tuple[Zone, ...], guide: Guidance, *, solver: bool = False) -> AttitudeSeeker:
    """The law of a guidance; with `solver` what it hands over is projected afterwards."""
    layout = Memory.of(settings.filter.kept)
    memory = np.zeros(layout.size)
    memory[layout.attitude.start] = memory[layout.guided.start] = 1.0
    memory[layout.attitudes.start : layout.attitudes.stop : filters.QUATERNION] = 1.0
    memory[layout.gradient] = memory[layout.direction] = settings.prior
    rows, columns = half_indices(filters.AXES)
    memory[layout.factor] = np.diag(np.sqrt(settings.prior_covariance))[rows, columns]
    update = _update_function(settings, layout, guide, smooth=not solver)
    return AttitudeSeeker(
        period=settings.period,
        zones=zones,
        read=_read_function(layout),
        update=_solved_update(update, settings, zones, layout) if solver else update,
        step=_step_function(settings, layout),
        layout=layout,
        _initial=memory,
    )


def _reading(layout: Memory) -> tuple[Any, Any, Any]:
    return ca.SX.sym("memory", layout.size), ca.SX.sym("attitude", filters.QUATERNION), ca.SX.sym("power")


def _update_names() -> Any:
    return ["memory", "attitude", "power"], ["memory_out"]


def _checked_update(function: ca.Function) -> CheckedFunction:
    return CheckedFunction(function, ("attitude", "power"), ("attitude",))


def _read_function(layout: Memory) -> CheckedFunction:
    """(memory, attitude, power) -> memory, between guidance steps."""
    memory, attitude, power = _reading(layout)
    new = filters.joined(filters.recorded(filters.parts(memory, layout), attitude, power))
    return _checked_update(ca.Function("read", [memory, attitude, power], [new], *_update_names()))


def _update_function(settings: Settings, layout: Memory, guide: Guidance, *, smooth: bool) -> CheckedFunction:
    """(memory, attitude, power) -> memory, of a guidance step."""
    memory, attitude, power = _reading(layout)
    old = filters.parts(memory, layout)
    correction = filters.corrected(old, attitude, power, settings.filter)
    new = filters.recorded(old, attitude, power)
    gradient, factor, direction = guide(correction, from_quaternion(new.attitude))
    new = new._replace(
        guided=new.attitude,
        steps=old.steps + 1,
        gradient=gradient,
        factor=factor,
        direction=_smoothed(old.direction, direction, settings) if smooth else direction,
    )
    given, made = _update_names()
    options = {"cse": True}
    return _checked_update(
        ca.Function("update", [memory, attitude, power], [filters.joined(new)], given, made, options)
    )


def _smoothed(before: Expr, direction: Expr, settings: Settings) -> Any:
    """Low-pass of first order, (10)."""
    if settings.cutoff is None:
        return direction
    return before + (1 - np.exp(-2 * np.pi * settings.cutoff * settings.period)) * (direction - before)


def _solved_update(update: ca.Function, settings: Settings, zones: tuple[Zone, ...], layout: Memory) -> CheckedFunction:
    """An update whose direction is projected between any number of zones by OSQP."""
    memory, attitude, power = (ca.MX.sym(f"argument_{k}", s.numel()) for k, s in enumerate(_reading(layout)))
    new = ca.Function.__call__(update, memory, attitude, power)
    place = ca.SX.sym("attitude", filters.QUATERNION)
    seen: Any = zone_rows(from_quaternion(place), zones)
    matrix, bounds = ca.Function("rows", [place], list(seen))(new[layout.attitude])
    near = projection_by_solver(new[layout.direction], matrix, bounds, settings.kappa)
    direction = _smoothed(memory[layout.direction], near, settings)
    whole = ca.vertcat(new[: layout.direction.start], direction)
    return _checked_update(ca.Function("update", [memory, attitude, power], [whole], *_update_names()))


def _step_function(settings: Settings, layout: Memory) -> CheckedFunction:
    """(memory) -> desired attitude."""
    memory = ca.SX.sym("memory", layout.size)
    parts = filters.parts(memory, layout)
    t = settings.period * parts.steps
    waves = zip(settings.excitation, settings.excitation_period, settings.excitation_phase, strict=True)
    excitation = [
        sine(t, float(size), float(period), start=-float(phase % (2 * np.pi)) * float(period) / (2 * np.pi))
        for size, period, phase in waves
    ]
    d = where(parts.steps > 0, settings.kappa * parts.direction + ca.vertcat(*excitation))
    names: Any = (["memory"], ["desired"])
    return CheckedFunction(ca.Function("step", [memory], [ca.densify(quaternion_step(parts.attitude, d))], *names))
