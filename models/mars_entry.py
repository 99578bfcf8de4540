"""Entry into the atmosphere of Mars with uncertain density: lift chosen so that filter and feedback miss little.

G. T. Schmidt, Sc.D. thesis, M.I.T. 1971, chapter 7 and appendix F. Feet, radians, seconds, slugs. The vehicle has a
constant drag coefficient and a lift-to-drag ratio u set by its bank; it measures two accelerations in inertial axes.

    dh/dt = v sin(gamma),   dtheta/dt = v cos(gamma)/(r + h),   g = g0 (r/(r + h))^2,   D = b rho v^2/2
    dv/dt = -g sin(gamma) - D,   dgamma/dt = -g cos(gamma)/v + v cos(gamma)/(r + h) + D u/v
    dlambda/dt = -v sin(gamma)/H + n,   lambda = ln(rho),   <n n'> = c/rho delta,   m = T(theta - gamma) (-D, D u) + v
    J = 1/2 tr S(T) X(T) + 1/2 int tr(B C X' C') dt + 1/2 w int (u - 1/2)^2 dt,   h(T), theta(T) prescribed, T = 915 s

The thesis has the density itself as fifth state; its logarithm gives the same to first order and is well scaled. The
term in w is not in the thesis (w = None): without it the problem is linear in u but for the filter's information, its
minima are bang-bang and many, with J near 3.5e-4.

Terminal deviations, recomputed on 732 intervals (range: r times that of theta):

|                              | J            | range ft | altitude ft | velocity ft/s | path angle rad |
|------------------------------|--------------|----------|-------------|---------------|----------------|
| constant u = 0.5, published  |              | 5942     | 16937       | 28.7          | 0.0074         |
| constant u = 0.5             | 6.57123e-4   | 5952     | 16973       | 28.76         | 0.0077         |
| combined optimum, published  |              | 4232     | 16193       | 5.35          | 0.0015         |
| optimum for w = 1e-5         | 5.7667749e-4 | 4213.9   | 16358.4     | 9.472         | 0.00264        |

Constant u = 0.5 arrives at h = 29620 ft, theta = 0.59831, v = 1296 ft/s, gamma = -0.360, with at most 3.49 g and a heat
rate of 23.6. The optimum for w = 1e-5 has 5.424501e-4 of its J from the covariances, 0.303 <= u <= 0.793, v(T) =
1184 ft/s, 3.25 g and 23.36.

The default options solve it (100 intervals: J to five digits, a few seconds; 183 are the 5 s of the source). The
gradient method takes some 500 iterations, a minute, to a relative 1e-6 of J; ten give most of the gain. Without the
term in w a start decides which minimum is found: guess="multistart", or `bang_bang` for the best that is known.

Errata (data="printed" keeps the first three): the printed r = 10.86e6 ft contradicts 0.5983 rad = 1257.1 miles and the
trajectories; 11.0951e6 ft fits both. The printed S(T) is 5280^2 too large for feet: it is 1e-4 mile^-2 of altitude and
500 rad^-2 of range. The printed E55(0) and c mean a density known to a factor of 3400; only upper bounds near 1e-21 and
1e-14 can be inferred, and the recommended values lie below them. The shaping filter of the density decays where F = f_x
grows, during the descent; the published deviations are those of f_x, as here (14,700 ft of range otherwise). In table
7-3 5942 against 4232 ft is 40 %, not 24.2 %, which belongs to section 6.12. In 7.7 cite 7.5-10 for G; in (7.6-1) one
factor 1/2 is too many.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

Array = npt.NDArray[np.float64]

DURATION = 915.0  # s
BANG_BANG_RATIOS = (1.0, 0.5, 0.0, 0.8, 1.0, 0.0, 1.0, 0.2, 0.0, 1.0)
BANG_BANG_SWITCHES = np.array([15.5, 16.5, 23.5, 25.5, 42.5, 136.5, 149.5, 150.5, 181.5]) / 183.0  # of t/T
GRAVITY = 12.3  # g0, ft/s^2
EARTH_GRAVITY = 32.174  # ft/s^2, unit of the load factor
BALLISTIC_COEFFICIENT = 1.023  # b = c_d a/m, ft^2/slug
SURFACE_DENSITY = 4.8e-5  # slug/ft^3
SCALE_HEIGHT = 30000.0  # H = 1/beta, ft
START = {"h": 328000.0, "theta": 0.0, "v": 15000.0, "gamma": -0.19}  # ft, rad, ft/s, rad
TARGET = {"h": 29600.0, "theta": 0.5983}  # ft, rad
POSITION_VARIANCE = 2.56e8  # ft^2, vertical and horizontal
VELOCITY_VARIANCE = 10.0  # (ft/s)^2
PATH_ANGLE_VARIANCE = 4.44e-8  # rad^2
ACCELEROMETER_NOISE = 0.02  # ft^2/s^3
REFERENCE = 0.5  # constant lift-to-drag ratio, and centre of the regularization
FEET_PER_MILE = 5280.0
# Typical deviations: they make the covariance well scaled.
SCALES = {"h": 16000.0, "theta": 16000.0 / 11.1e6, "v": 100.0, "gamma": 0.01, "log_density": 1.0}
LIFT_TO_DRAG = "lift_to_drag"


@dataclass(frozen=True, kw_only=True)
class Data:
    """What differs between the printed data and the recommended ones."""

    radius: float
    """r [ft]"""
    density: float
    """rho(0) [slug/ft^3]"""
    density_variance: float
    """E55(0) [(slug/ft^3)^2]"""
    density_noise: float
    """c: the density of the noise of rho is c rho [slug/(ft^3 s)]."""
    altitude_weight: float
    """S11(T) [1/ft^2]"""
    range_weight: float
    """S22(T) [1/rad^2]"""


DATA = {
    "recommended": Data(
        radius=11.0951e6,
        density=SURFACE_DENSITY * float(np.exp(-START["h"] / SCALE_HEIGHT)),
        density_variance=8.55e-22,
        density_noise=4.5e-15,
        altitude_weight=1e-4 / FEET_PER_MILE**2,
        range_weight=500.0,
    ),
    "printed": Data(
        radius=10.86e6,
        density=8e-10,
        density_variance=8.55e-12,
        density_noise=4.5e-6,
        altitude_weight=2.78e3,
        range_weight=1.39e10,
    ),
}

# Tables 7-1 and 7-2 against altitude [ft]: density [slug/ft^3] and scale height [ft]. From node to node they agree
# within 3 %, but for the low atmosphere between 32,810 and 65,620 ft (8 %).
TABLE_ALTITUDE = (0.0, 16405.0, 32810.0, 65620.0, 98430.0, 131240.0, 164050.0, 246075.0, 328100.0, 492150.0)
TABLE_DENSITY = {
    "high": (2.79e-5, 2.25e-5, 1.79e-5, 1.06e-5, 5.70e-6, 2.77e-6, 1.23e-6, 1.31e-7, 1.38e-8, 1.68e-10),
    "mean": (2.85e-5, 2.17e-5, 1.61e-5, 7.91e-6, 3.06e-6, 1.00e-6, 3.12e-7, 1.73e-8, 1.00e-9, 3.78e-12),
    "low": (2.40e-5, 1.66e-5, 1.09e-5, 3.29e-6, 8.07e-7, 1.86e-7, 4.01e-8, 6.03e-10, 4.73e-12),
}
TABLE_SCALE_HEIGHT = {
    "high": (78415.0, 74478.0, 69885.0, 55120.0, 49871.0, 42653.0, 39043.0, 36091.0, 36747.0, 37731.0),
    "mean": (62995.0, 58073.0, 52824.0, 39043.0, 30185.0, 27887.0, 28216.0, 28544.0, 28872.0, 29857.0),
    "low": (45934.0, 41668.0, 36091.0, 23951.0, 22967.0, 21982.0, 20998.0, 18373.0, 15748.0, 15420.0),
}


@dataclass(frozen=True, kw_only=True)
class Atmosphere:
    """A model atmosphere, tables 7-1 and 7-2; the low one has no density above 328,100 ft."""

    kind: str
    altitude: Array
    """[ft], of the scale heights; the densities are those of the first ones."""
    density: Array
    """[slug/ft^3]"""
    scale_height: Array
    """H [ft]: d ln(rho)/dh = -1/H."""

    __repr__ = short_repr

    def density_at(self, altitude: npt.ArrayLike) -> Array:
        """Density [slug/ft^3] at some altitudes [ft], its logarithm linear between the nodes and beyond them."""
        h, logarithm = self.altitude[: self.density.size], np.log(self.density)
        x = np.asarray(altitude, dtype=float)
        i = np.clip(np.searchsorted(h, x, side="right") - 1, 0, h.size - 2)
        return np.asarray(np.exp(logarithm[i] + (x - h[i]) * (logarithm[i + 1] - logarithm[i]) / (h[i + 1] - h[i])))

    def scale_height_at(self, altitude: npt.ArrayLike) -> Array:
        """Scale height [ft] at some altitudes [ft], linear between the nodes, constant beyond them."""
        return np.asarray(np.interp(np.asarray(altitude, dtype=float), self.altitude, self.scale_height))

    def scale_height_expression(self, altitude: ca.MX) -> ca.MX:
        """The same as an expression [ft] of the altitude [ft]."""
        slopes = [0.0, *np.diff(self.scale_height) / np.diff(self.altitude), 0.0]
        # A sum of ramps: unlike an interpolant it expands to scalar operations.
        ramps = [change * ca.fmax(altitude - h, 0) for change, h in zip(np.diff(slopes), self.altitude, strict=True)]
        result: ca.MX = self.scale_height[0] + ca.sum1(ca.vertcat(*ramps))
        return result


def atmosphere(kind: str = "mean") -> Atmosphere:
    """A model atmosphere, Schmidt tables 7-1 and 7-2.

    Args:
        kind: "high", "mean" or "low", by the density at great altitudes.

    Raises:
        ProblemError: where the kind is unknown.
    """
    return _tabulated(kind)


def problem(
    duration: float | co.Free = DURATION,
    control_weight: float = 0.1,
    regularization: float | None = 1e-5,
    lower: float = 0.0,
    upper: float = 1.0,
    data: str = "recommended",
) -> co.Problem:
    """Mars entry with an exponential atmosphere, Schmidt [7.7-1].

    Args:
        duration: T [s], or `Free`.
        control_weight: B, of the squared deviations of the lift-to-drag ratio [cost/s].
        regularization: w, of the squared distance of the nominal ratio from 1/2 [cost/s] (parameter "regularization");
            None: without this term, whose minima are bang-bang. B does not contain w.
        lower: smallest lift-to-drag ratio.
        upper: largest one.
        data: "recommended", or "printed" for those of appendix F.

    Returns:
        The problem, with states "h" [ft], "theta" [rad], "v" [ft/s], "gamma" [rad] and "log_density" [ln(slug/ft^3)],
        control "lift_to_drag", measurement "accelerometers" [ft/s^2] and the covariance "E" of the states.

    Raises:
        ProblemError: where the data are unknown, the control weight not positive, or the bounds cross.
    """
    return _entry(None, duration, control_weight, regularization, lower, upper, data)


def truth(
    atmosphere: str = "mean",
    duration: float | co.Free = DURATION,
    control_weight: float = 0.1,
    regularization: float | None = 1e-5,
    lower: float = 0.0,
    upper: float = 1.0,
    data: str = "recommended",
) -> co.Problem:
    """The same entry through a tabulated atmosphere: what may fly instead of what filter and feedback assume.

    The density starts at that of the atmosphere and follows its scale height, dlambda/dt = -v sin(gamma)/H(h) + n. The
    relative uncertainty at the start is that of the design.

    Args:
        atmosphere: "high", "mean" or "low", tables 7-1 and 7-2.
        duration: as in `problem`, and so are the others.
        control_weight: B [cost/s].
        regularization: w [cost/s].
        lower: smallest lift-to-drag ratio.
        upper: largest one.
        data: "recommended" or "printed".

    Returns:
        A problem with the names of `problem`.

    Raises:
        ProblemError: as `problem`, and where the atmosphere is unknown.
    """
    return _entry(_tabulated(atmosphere), duration, control_weight, regularization, lower, upper, data)


def reference() -> dict[str, float]:
    """The lift-to-drag ratio of the reference design, constant; for `evaluate(problem, nominal=reference())`."""
    return {LIFT_TO_DRAG: REFERENCE}


def bang_bang(s: npt.ArrayLike) -> Array:
    """The lift-to-drag ratio near the best minimum known without the term in w, J = 3.503e-4, as a guess.

    Found by guess="multistart" on 183 intervals; `solve(problem(regularization=None), intervals=183,
    guess={"lift_to_drag": bang_bang})` ends there.

    Args:
        s: t/T, any shape.

    Returns:
        Values between 0 and 1, of the shape of s.
    """
    return np.asarray(np.array(BANG_BANG_RATIOS)[np.searchsorted(BANG_BANG_SWITCHES, np.asarray(s, dtype=float))])


def load_factor(problem: co.Problem) -> ca.MX:
    """Aerodynamic acceleration b rho v^2/2 sqrt(1 + u^2) in units of the earth's gravity, Schmidt figure 7-6.

    Args:
        problem: that `problem` or `truth` made.

    Returns:
        An expression: `solution[load_factor(problem)]` has its values at the nodes.

    Raises:
        ProblemError: where the problem is another one.
    """
    v, log_density, u = _symbols(problem, ("v", "log_density", LIFT_TO_DRAG))
    drag = 0.5 * BALLISTIC_COEFFICIENT * ca.exp(log_density) * v**2
    result: ca.MX = drag * ca.sqrt(1 + u**2) / EARTH_GRAVITY
    return result


def heat_rate(problem: co.Problem) -> ca.MX:
    """Convective heat rate 1e-8 rho^(1/2) v^3, rho in slug/ft^3 and v in ft/s; the constant is for display only.

    Args:
        problem: that `problem` or `truth` made.

    Returns:
        An expression: `solution[heat_rate(problem)]` has its values at the nodes.

    Raises:
        ProblemError: where the problem is another one.
    """
    v, log_density = _symbols(problem, ("v", "log_density"))
    result: ca.MX = 1e-8 * ca.exp(0.5 * log_density) * v**3
    return result


def figures() -> dict[str, Any]:
    """What the figures of Schmidt 7.7 show: the combined optimum and a constant lift-to-drag ratio; by title."""
    entry = problem()
    h, theta, v, gamma, u = _symbols(entry, ("h", "theta", "v", "gamma", LIFT_TO_DRAG))
    miss = ("rms", DATA["recommended"].radius * theta)
    designs = [("combined", entry), ("constant lift-to-drag ratio", entry, reference())]
    flight = {
        "lift-to-drag ratio (7-1)": u,
        "altitude (7-2) [ft]": h,
        "velocity (7-4) [ft/s]": v,
        "path angle (7-5) [rad]": gamma,
        "load factor (7-6) [g]": load_factor(entry),
        "heat rate (7-7)": heat_rate(entry),
    }
    errors = {
        "rms range (7-8, 7-9) [ft]": miss,
        "rms altitude (7-10) [ft]": ("rms", h),
        "rms velocity (7-11) [ft/s]": ("rms", v),
        "velocity gain (7-12) [s/ft]": ("C", v),
        "range gain (7-13) [1/rad]": ("C", theta),
        "rms feedback": ("rms", u),
    }
    return {
        "Schmidt 7.7: flight": {"designs": designs, "names": [flight]},
        "Schmidt 7.7: altitude over range": {"designs": designs, "names": [{"altitude (7-3) [ft]": h}], "over": theta},
        "Schmidt 7.7: deviations and gains": {"designs": designs, "names": [errors]},
    }


def _tabulated(kind: str) -> Atmosphere:
    """What `atmosphere` returns."""
    _check_known("model atmosphere", kind, TABLE_DENSITY)
    return Atmosphere(
        kind=kind,
        altitude=np.array(TABLE_ALTITUDE),
        density=np.array(TABLE_DENSITY[kind]),
        scale_height=np.array(TABLE_SCALE_HEIGHT[kind]),
    )


def _entry(
    air: Atmosphere | None,
    duration: float | co.Free,
    control_weight: float,
    regularization: float | None,
    lower: float,
    upper: float,
    data: str,
) -> co.Problem:
    """The problem for a tabulated atmosphere, or for the exponential one."""
    _check_known("set of data", data, DATA)
    numbers, b, r = DATA[data], BALLISTIC_COEFFICIENT, DATA[data].radius
    ocp = co.Problem(duration=duration, name="Mars entry" + (f", {air.kind} atmosphere" if air else ""))
    density = numbers.density if air is None else float(air.density_at(START["h"]))
    variances = {
        "h": POSITION_VARIANCE,
        "theta": POSITION_VARIANCE / (r + START["h"]) ** 2,
        "v": VELOCITY_VARIANCE,
        "gamma": PATH_ANGLE_VARIANCE,
        "log_density": numbers.density_variance / numbers.density**2,
    }
    start = {**START, "log_density": float(np.log(density))}
    units = {"h": "ft", "theta": "rad", "v": "ft/s", "gamma": "rad", "log_density": "ln(slug/ft^3)"}
    h, theta, v, gamma, log_density = (
        ocp.state(
            name, initial=start[name], final=TARGET.get(name), variance=variances[name], scale=SCALES[name], unit=unit
        )
        for name, unit in units.items()
    )
    # a function is taken as it is, a number would be bent; nothing is symmetric here
    u = ocp.control(LIFT_TO_DRAG, lower=lower, upper=upper, guess=lambda s: np.full_like(s, REFERENCE))
    distance = r + h  # from the centre of Mars
    gravity = GRAVITY * (r / distance) ** 2
    drag = 0.5 * b * ca.exp(log_density) * v**2
    scale_height = SCALE_HEIGHT if air is None else air.scale_height_expression(h)
    ocp.dynamics(h, v * ca.sin(gamma))
    ocp.dynamics(theta, v * ca.cos(gamma) / distance)
    ocp.dynamics(v, -gravity * ca.sin(gamma) - drag)
    ocp.dynamics(gamma, (v / distance - gravity / v) * ca.cos(gamma) + drag * u / v)
    ocp.dynamics(log_density, -v * ca.sin(gamma) / scale_height, noise=numbers.density_noise * ca.exp(-log_density))
    # [7.5-11]: along and across the velocity, turned from the path into inertial axes.
    along, across, angle = -drag, drag * u, theta - gamma
    sine, cosine = ca.sin(angle), ca.cos(angle)
    inertial = ca.vertcat(cosine * along + sine * across, cosine * across - sine * along)
    ocp.measurement("accelerometers", inertial, noise=ACCELEROMETER_NOISE, unit="ft/s^2")
    ocp.estimation_covariance()
    running: Any = 0.0
    if regularization is not None:
        running = 0.5 * ocp.parameter("regularization", regularization) * (u - REFERENCE) ** 2
    ocp.minimize_expected(
        running=running,
        terminal_weight={h: numbers.altitude_weight, theta: numbers.range_weight},
        control_weight={u: control_weight},
    )
    return ocp


def _symbols(problem: co.Problem, names: tuple[str, ...]) -> list[Any]:
    """Symbols of states and controls by name."""
    entries: list[Any] = [*problem.declarations.states, *problem.declarations.controls]
    known: dict[str, Any] = {entry.name: entry.symbol for entry in entries}
    missing = [name for name in names if name not in known]
    if missing:
        raise co.ProblemError(
            "This is not a problem of Mars entry.\n"
            "  expected: a problem that mars_entry.problem() or mars_entry.truth() made\n"
            f"  received: '{problem.name}', without {', '.join(missing)}\n"
            "  remedy:   pass the problem that was solved"
        )
    return [known[name] for name in names]


def _check_known(what: str, name: str, known: Iterable[str]) -> None:
    names = list(known)
    if name not in names:
        raise co.ProblemError(
            f"Mars entry has no such {what}.\n"
            f"  expected: {', '.join(map(repr, names))}\n"
            f"  received: {name!r}\n"
            "  remedy:   choose one of them"
        )
