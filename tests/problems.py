"""Problems that several tests share, each with what is known about its solution without solving it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.stats import linregress

import covocp as co

# Largest eigenvalue of the information operator of the first-order lag for T = 10 s [specification, 6.4].
LAG_EIGENVALUE = 0.43495704

# Cost of the first-order lag, by (x(T), weight of E_bb(T)) [specification, 6.4].
LAG_COSTS = {
    (0.0, 0.1): 0.44818922,
    (0.0, 1.0): 1.91442319,
    (0.0, 10.0): 6.55106209,
    (1.0, 0.1): 1.30521661,
    (1.0, 1.0): 2.62300222,
    (1.0, 10.0): 7.08523968,
}

TIGHT = {"rtol": 1e-11, "atol": 1e-12, "method": "DOP853"}


@dataclass(frozen=True)
class Lag:
    """The first-order lag with unknown time constant [specification, 6.4], and its symbols."""

    problem: co.Problem
    x: Any
    b: Any
    u: Any
    E: Any


def lag(weight=10.0, final=1.0, *, noise=1.0, guess=0.0, duration=10.0):
    """Parameters: "weight", "start", "final" (of x), "initial" (half-vector of E(0))."""
    ocp = co.Problem(duration=duration, name="lag")
    C22, start, end = ocp.parameter("weight", weight), ocp.parameter("start", 0.0), ocp.parameter("final", final)
    half = ocp.parameter("initial", [1.0, 0.0, 5.0])
    x = ocp.state("x", initial=start, final=end)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u", guess=guess)
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=noise)
    E = ocp.estimation_covariance(initial=ca.blockcat([[half[0], half[1]], [half[1], half[2]]]))
    ocp.minimize(running=0.5 * u**2, terminal=C22 * E[b, b])
    return Lag(problem=ocp, x=x, b=b, u=u, E=E)


def constrained_gain(constant):
    """A closed loop whose gain is optimised: one number, or one at each time."""
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", initial=1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, -x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    gain = co.Gain(constant=constant, lower=0.0, upper=3.0)
    ocp.minimize_expected(running=0.5 * (x**2 + u**2), gain=gain)
    return ocp


def graded(intervals):
    """Nodes that are dense towards the end, where 6.12 has a boundary layer [specification, 9.1]."""
    return 1 - (1 - np.linspace(0, 1, intervals + 1)) ** 2


def solve(problem, **options):
    return co.solve(problem, **{"progress": False, **options})


def unassessed(problem, method="ipopt", *, guess=None, parameters=None, **options):
    """A solution that is compared with another one: nothing is looked at after the run, to save time."""
    return co.Solver(problem, method, **options).solve(parameters, guess=guess, progress=False, assess=False)


def order(counts, errors):
    """Observed order of convergence: minus the slope of log error over log count."""
    return -linregress(np.log(counts), np.log(np.abs(errors))).slope


def simulate(rate, start, t, u):
    """States at the nodes t of dz/dt = rate(t, z, u), u linear between the nodes, by scipy."""
    z = [np.asarray(start, dtype=float)]
    for i in range(t.size - 1):

        def slope(s, value, i=i):
            c = (s - t[i]) / (t[i + 1] - t[i])
            return rate(s, value, u[i] + c * (u[i + 1] - u[i]))

        z.append(solve_ivp(slope, (t[i], t[i + 1]), z[-1], **TIGHT).y[:, -1])
    return np.array(z)


def least_fuel() -> tuple[co.Problem, float]:
    """Two thrusters, each on for t with t (3 - t) = 1."""
    ocp = co.Problem(3.0)
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    ahead, back = ocp.control("ahead", lower=0.0, upper=1.0), ocp.control("back", lower=0.0, upper=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, ahead - back)
    ocp.minimize(running=ahead + back)
    return ocp, 3.0 - float(np.sqrt(5.0))


def beside_switches(off: float, ramp: float) -> np.ndarray:
    """A grid for `least_fuel` whose ramps in place of its switches are too late, and early, by a share of the time."""
    begin = least_fuel()[1] / 6.0 + off
    end = begin + ramp
    return np.array([0.0, begin, end, 0.35, 0.5, 0.65, 1.0 - end, 1.0 - begin, 1.0])
