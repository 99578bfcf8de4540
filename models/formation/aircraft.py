"""Follower of a formation flight: a Boeing 747-100 about level flight, with a linear-quadratic tracker of positions.

Eleven states, deviations from trim at 40,000 ft and Mach 0.8 in stability axes, but for y and h, which are positions in
the formation:

    w, v, u         velocity downward, to the right, forward [m/s]
    phi, theta, psi roll (right wing down), pitch (nose up), yaw (nose right) [rad]
    p, q, r         their rates [rad/s]
    y, h            to the right of the leader, above its wake [m]

    dx/dt = A x + B c + e C_l,   c = elevator, aileron, rudder [rad], thrust [0.3 of the weight]

C_l is the rolling moment coefficient by the leader's vortices, positive where it lowers the right wing. Kinematics:

    dy/dt = v + U0 psi,   dh/dt = U0 theta - w,   dphi/dt = p,   dtheta/dt = q,   dpsi/dt = r

Eigenvalues -0.3717 +- 0.8869i and -0.00329 +- 0.0672i (longitudinal), -0.0331 +- 0.9470i, -0.5633, -0.00726 (lateral),
and 0 three times: yaw and positions.

The aileron of this condition is weak, C_l = 0.01 takes 42 deg: its column is five times as large here, that of ailerons
and spoilers together, and C_l = 0.01 takes 8.4 deg. It is a choice of unit.

Tracker, every 0.1 s: c = -K (x - x_c, z), where x_c is zero but for the commanded y_c and h_c, and z are the sums of
0.1 s times y - y_c, h - h_c, u, phi. K is by the discrete Riccati equation; of 15 modes the slowest has modulus 0.9835.

Sources: B. Etkin, L. D. Reid, Dynamics of flight, 3rd ed., Wiley 1996, equations (4.9,18) and (4.9,19), chapters 6
(derivatives) and 7 (controls); its data are those of R. K. Heffley, W. F. Jewell, NASA CR-2144, 1972. The form of the
tracker is that of J. J. Ryan, J. L. Speyer, Peak-seeking control using gradient and Hessian estimates, American Control
Conference 2010, which prints neither aircraft nor weights: the weights are chosen here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg

from covocp.base.arguments import check_argument, checked, is_number, positive
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.blocks import riccati

Array = npt.NDArray[np.float64]

STATES = ("w", "v", "u", "phi", "theta", "psi", "p", "q", "r", "y", "h")
CONTROLS = ("elevator", "aileron", "rudder", "thrust")
TRACKED = ("y", "h", "u", "phi")  # whose sums are the states of the tracker
STEP = 0.1  # s
ROLL_EFFECTORS = 5.0  # of the aileron alone

WEIGHT, GRAVITY = 2.83176e6, 9.81  # N, m/s^2
MASS = WEIGHT / GRAVITY  # kg
AREA, CHORD, SPAN = 511.0, 8.324, 59.64  # m^2, m
SPEED, DENSITY = 235.9, 0.3045  # U0 [m/s], kg/m^3
PRESSURE = 0.5 * DENSITY * SPEED**2  # Pa
INERTIA = {"x": 0.247e8, "y": 0.449e8, "z": 0.673e8, "xz": -0.212e7}  # kg m^2
# Forces [N] and moments [N m] by states; dw is the rate of w.
LONGITUDINAL = {
    "X": {"u": -1.982e3, "w": 4.025e3},
    "Z": {"u": -2.595e4, "w": -9.030e4, "q": -4.524e5, "dw": 1.909e3},
    "M": {"u": 1.593e4, "w": -1.563e5, "q": -1.521e7, "dw": -1.702e4},
}
LATERAL = {
    "Y": {"v": -1.610e4, "p": 0.0, "r": 0.0},
    "L": {"v": -3.062e5, "p": -1.076e7, "r": 9.925e6},
    "N": {"v": 2.131e5, "p": -1.330e6, "r": -8.934e6},
}
# Coefficients by controls [1/rad].
ELEVATOR = {"X": -3.818e-6, "Z": -0.3648, "M": -1.444}
AILERON = {"Y": 0.0, "L": -1.368e-2, "N": -1.973e-4}
RUDDER = {"Y": 0.1146, "L": 6.976e-3, "N": -0.1257}
THRUST = 0.3 * WEIGHT  # N, at control 1

# Deviations that cost the same, of states and sums; the other states cost nothing.
DEVIATIONS = {"u": 0.5, "phi": np.deg2rad(1.0), "y": 0.5, "h": 0.5}  # m/s, rad, m
SUMS = {"y": 3.0, "h": 3.0, "u": 3.0, "phi": np.deg2rad(5.0)}  # m s, m, rad s
DEFLECTIONS = (np.deg2rad(3.0), np.deg2rad(10.0), np.deg2rad(5.0), 0.1)


class Model(NamedTuple):
    """A, (11, 11), B, (11, 4), and the column e of the rolling moment by vortices, (11, 1)."""

    A: Array
    B: Array
    vortex: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracker:
    """The model of a step and the law of the tracker, c = -gain (x - x_c, z); arrays are read-only.

    Args:
        step: T [s].
        model: x+ = A x + B c + e C_l.
        gain: K, shape (4, 15).
        closed: transition matrix of (x, z) in closed loop, shape (15, 15).
        eigenvalues: of it, shape (15,).
    """

    step: float
    model: Model
    gain: Array
    closed: Array
    eigenvalues: npt.NDArray[np.complex128]

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Trim:
    """Steady flight in the wake at a position; arrays are read-only.

    Args:
        state: shape (11,).
        sums: z of the tracker, shape (4,).
        controls: shape (4,).
    """

    state: Array
    sums: Array
    controls: Array

    __repr__ = short_repr


@checked(roll_effectors=positive)
def continuous(*, roll_effectors: float = ROLL_EFFECTORS) -> Model:
    """The aircraft in continuous time.

    Args:
        roll_effectors: rolling and yawing moment of the aileron control over that of the aileron alone.

    Raises:
        ProblemError: a factor that is not positive.
    """
    A, B, vortex = np.zeros((11, 11)), np.zeros((11, 4)), np.zeros((11, 1))
    _fill_longitudinal(A, B)
    _fill_lateral(A, B, vortex, roll_effectors)
    for rate, angle in (("p", "phi"), ("q", "theta"), ("r", "psi")):
        A[_at(angle), _at(rate)] = 1.0
    A[_at("y"), [_at("v"), _at("psi")]] = 1.0, SPEED
    A[_at("h"), [_at("theta"), _at("w")]] = SPEED, -1.0
    return Model(_frozen(A), _frozen(B), _frozen(vortex))


@checked(step=positive, roll_effectors=positive)
def sampled(step: float = STEP, *, roll_effectors: float = ROLL_EFFECTORS) -> Model:
    """The aircraft from sample to sample, controls and rolling moment held between.

    Args:
        step: T [s].
        roll_effectors: as for `continuous`.

    Raises:
        ProblemError: a step or a factor that is not positive.
    """
    model = continuous(roll_effectors=roll_effectors)
    inputs = np.hstack([model.B, model.vortex])
    system = np.zeros((16, 16))
    system[:11] = np.hstack([model.A, inputs])
    transition = scipy.linalg.expm(system * step)[:11]
    return Model(_frozen(transition[:, :11]), _frozen(transition[:, 11:15]), _frozen(transition[:, 15:]))


@checked(step=positive, roll_effectors=positive)
def tracker(step: float = STEP, *, roll_effectors: float = ROLL_EFFECTORS) -> Tracker:
    """The linear-quadratic tracker of positions.

    Args:
        step: T [s].
        roll_effectors: as for `continuous`.

    Raises:
        ProblemError: a step or a factor that is not positive, or one with which there is no regulator.
    """
    model = sampled(step, roll_effectors=roll_effectors)
    augmented = riccati.integral_states(model.A, model.B, _selection(), step=step)
    states = [1 / DEVIATIONS[name] ** 2 if name in DEVIATIONS else 0.0 for name in STATES]
    Q = np.diag(states + [1 / SUMS[name] ** 2 for name in TRACKED])
    R = np.diag(1 / np.square(DEFLECTIONS))
    regulator = riccati.lqr(augmented.A, augmented.B, Q, R, discrete=True)
    closed = augmented.A - augmented.B @ regulator.gain
    return Tracker(
        step=float(step),
        model=model,
        gain=regulator.gain,
        closed=_frozen(closed),
        eigenvalues=regulator.eigenvalues,
    )


def trimmed(tracker: Tracker, rolling_moment: float | Array, position: npt.ArrayLike = (0.0, 0.0)) -> Trim:
    """Steady flight under a rolling moment, wings level, in closed loop: states, sums and controls that stay.

    Args:
        tracker: whose sums hold the controls.
        rolling_moment: C_l by the vortices at the position, one number.
        position: (y, h), which is commanded too, shape (2,) [m].

    Raises:
        ProblemError: a moment or a position that is not finite numbers.
    """
    single = isinstance(rolling_moment, np.ndarray) and rolling_moment.size == 1  # as a table gives it
    moment = np.asarray(rolling_moment).item() if single else rolling_moment
    check_argument("trimmed()", "rolling_moment", lambda v: "" if is_number(v) else "a finite number", moment)
    at = np.asarray(position, dtype=object)
    fits = at.shape == (2,) and all(is_number(value) for value in at)
    check_argument("trimmed()", "position", lambda _: "" if fits else "two finite numbers, y and h", position)
    A, B, vortex = tracker.model
    system = np.block([[A - np.eye(11), B], [_selection(), np.zeros((4, 4))]])
    steady = np.linalg.solve(system, np.concatenate([-vortex[:, 0] * moment, np.zeros(4)]))
    state, controls = steady[:11], steady[11:]
    sums = -np.linalg.solve(tracker.gain[:, 11:], controls + tracker.gain[:, :11] @ state)
    state[-2:] += at.astype(float)
    return Trim(state=_frozen(state), sums=_frozen(sums), controls=_frozen(controls))


def _fill_longitudinal(A: Array, B: Array) -> None:
    """Rows of u, w and q, Etkin and Reid (4.9,18)."""
    X, Z, M = LONGITUDINAL["X"], LONGITUDINAL["Z"], LONGITUDINAL["M"]
    m, Iy, g = MASS, INERTIA["y"], GRAVITY
    heavy = m - Z["dw"]  # m'
    mu = M["dw"] / heavy
    states = [_at(name) for name in ("u", "w", "q")]
    A[_at("u"), states] = X["u"] / m, X["w"] / m, 0.0
    A[_at("u"), _at("theta")] = -g
    force = np.array([Z["u"], Z["w"], Z["q"] + m * SPEED])
    A[_at("w"), states] = force / heavy
    A[_at("q"), states] = (np.array([M["u"], M["w"], M["q"]]) + mu * force) / Iy
    lift, moment = (ELEVATOR[name] * PRESSURE * AREA for name in ("Z", "M"))
    B[_at("u"), [0, 3]] = ELEVATOR["X"] * PRESSURE * AREA / m, THRUST / m
    B[_at("w"), 0] = lift / heavy
    B[_at("q"), 0] = (moment * CHORD + mu * lift) / Iy


def _fill_lateral(A: Array, B: Array, vortex: Array, roll_effectors: float) -> None:
    """Rows of v, p and r, Etkin and Reid (4.9,19)."""
    force = np.array([[LATERAL[row][name] for name in ("v", "p", "r")] for row in ("Y", "L", "N")])
    force[0, 2] -= MASS * SPEED
    inertia = np.array(
        [[MASS, 0.0, 0.0], [0.0, INERTIA["x"], -INERTIA["xz"]], [0.0, -INERTIA["xz"], INERTIA["z"]]]
    )  # its inverse has 1/I_x', I_zx', 1/I_z'
    rows = np.array([_at(name) for name in ("v", "p", "r")])
    A[rows[:, None], rows] = np.linalg.solve(inertia, force)
    A[_at("v"), _at("phi")] = GRAVITY
    sizes = PRESSURE * AREA * np.array([1.0, SPAN, SPAN])
    by_control = [[roll_effectors * AILERON[row], RUDDER[row]] for row in ("Y", "L", "N")]
    B[rows, 1:3] = np.linalg.solve(inertia, sizes[:, None] * np.array(by_control))
    vortex[rows, 0] = np.linalg.solve(inertia, [0.0, sizes[1], 0.0])


def _selection() -> Array:
    """What is summed, of the states, (4, 11)."""
    return np.asarray(np.eye(11)[[_at(name) for name in TRACKED]])


def _at(name: str) -> int:
    """Place of a state."""
    return STATES.index(name)


def _frozen(values: npt.ArrayLike) -> Array:
    """A read-only array."""
    result = np.array(values, dtype=float)
    result.setflags(write=False)
    return result
