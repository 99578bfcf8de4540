"""Goddard's rocket: greatest height of a vertical ascent, with full thrust, a singular arc and a coast.

R. H. Goddard, "A method of reaching extreme altitudes", Smithsonian Miscellaneous Collections 71(2), 1919; data in the
normalised form of A. E. Bryson, Dynamic Optimization, 1999, as in E. D. Dolan, J. J. More and T. S. Munson, COPS 3.0,
Argonne National Laboratory ANL/MCS-TM-273, 2004, "Goddard rocket". Units: the radius of the earth h0, the initial mass
m0 and the gravity on the ground g0; hence the time sqrt(h0/g0), 806 s, and the speed sqrt(g0 h0), 7.9 km/s.

    dh/dt = v,   dv/dt = (thrust - D)/m - 1/h^2,   dm/dt = -thrust/c,   D = 310 v^2 exp(-500 (h - 1))
    h(0) = 1,   v(0) = 0,   m(0) = 1,   m(T) = 0.6,   0 <= thrust <= 3.5,   c = 1/2,   J = -h(T),   T free

Published: J = -1.01283. The three arcs one after the other (the singular one lies where m/h^2 = (1 + v/c) D) give full
thrust until t = 0.0235097, the singular arc until m = 0.6 at t = 0.0726707, a coast until v = 0 at T = 0.1988563, and
J = -1.0128369183. There is no covariance.
"""

from __future__ import annotations

import casadi as ca

import covocp as co

DRAG = 310.0  # v_c m0 / (2 g0), v_c = 620: drag at unit speed on the ground
DENSITY_DECAY = 500.0  # of the air, for one radius of the earth
EXHAUST_SPEED = 0.5  # c, in sqrt(g0 h0)
LARGEST_THRUST = 3.5  # in m0 g0
FINAL_MASS = 0.6  # in m0


def problem() -> co.Problem:
    """Vertical ascent of a rocket to its greatest height, COPS 3.0; normalised units.

    Returns:
        The problem, with states "h" (from the centre of the earth), "v" (speed) and "m" (mass) and control "thrust".
    """
    ocp = co.Problem(duration=co.Free(guess=0.2, lower=0.05, upper=1.0), name="Goddard's rocket")
    h = ocp.state("h", initial=1.0, lower=1.0, guess=lambda s: 1.0 + 0.01 * s)
    v = ocp.state("v", initial=0.0, lower=0.0, guess=lambda s: 0.4 * s * (1.0 - s))
    m = ocp.state("m", initial=1.0, final=FINAL_MASS, lower=FINAL_MASS, upper=1.0, guess=lambda s: 1.0 - 0.4 * s)
    thrust = ocp.control("thrust", lower=0.0, upper=LARGEST_THRUST, guess=1.0)
    _move(ocp, h, v, m, thrust)
    ocp.minimize(terminal=-h)
    return ocp


def _move(ocp: co.Problem, h: ca.MX, v: ca.MX, m: ca.MX, thrust: ca.MX | float) -> None:
    """The equations of motion."""
    drag = DRAG * v**2 * ca.exp(-DENSITY_DECAY * (h - 1.0))
    ocp.dynamics(h, v)
    ocp.dynamics(v, (thrust - drag) / m - 1.0 / h**2)
    ocp.dynamics(m, -thrust / EXHAUST_SPEED)


def phases() -> co.Phases:
    """The same ascent in three phases of free duration: full thrust, the singular arc, a coast; normalised units.

    Returns:
        The phases "full thrust", "singular arc", which alone has the control "thrust", and "coast".
    """
    problems: list[co.Problem] = []
    for name, guess, upper in (("full thrust", 0.02, 0.1), ("singular arc", 0.05, 0.2), ("coast", 0.12, 0.5)):
        ocp = co.Problem(duration=co.Free(guess=guess, lower=0.001, upper=upper), name=name)
        first = not problems
        h = ocp.state("h", initial=1.0 if first else None, lower=1.0)
        v = ocp.state("v", initial=0.0 if first else None, lower=0.0)
        m = ocp.state("m", initial=1.0 if first else None, lower=FINAL_MASS, upper=1.0)
        thrust: ca.MX | float = LARGEST_THRUST if first else 0.0
        if name == "singular arc":
            thrust = ocp.control("thrust", lower=0.0, upper=LARGEST_THRUST, guess=1.5)
        _move(ocp, h, v, m, thrust)
        problems.append(ocp)
    problems[-1].subject_to(m, lower=FINAL_MASS, upper=FINAL_MASS, at="final", name="final mass")
    problems[-1].minimize(terminal=-h)
    return co.Phases(problems, name="Goddard's rocket")
