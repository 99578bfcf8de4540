"""Closed loops that the tests of the simulation share."""

import casadi as ca
import numpy as np
from problems import graded

import covocp as co
from covocp.models import unknown_lag
from covocp.simulation.actual import design_system
from covocp.simulation.run_parts import Limits, Setting

GRADED = graded(40)


def steered(variance=0.1, **options):
    """The solution of 6.12 for some variance of the inverse time constant."""
    problem = unknown_lag.steering(parameter_variance=variance)
    return co.solve(problem, grid=GRADED, progress=False, **options)


def linear_quadratic(frequency=1.3, restoring=None, noise=1.0, size=2):
    """Linear dynamics, quadratic cost, correlated noises, a measurement that contains the control: theory is exact."""
    problem = co.Problem(duration=4.0, name="oscillator")
    r = problem.state("r", size, initial=np.eye(size)[0], final=np.zeros(size), variance=np.linspace(0.1, 0.2, size))
    w = problem.parameter("w", frequency)
    u = problem.control("u", 2, lower=-4.0, upper=4.0)
    pull = restoring or (lambda value: value)
    rate = ca.vertcat(r[1], -w * pull(r[0])) + u
    density = noise * np.array([[0.1, 0.05], [0.05, 0.2]])
    if size == 2:
        problem.dynamics(r, rate, noise=density)
    else:
        problem.dynamics(r, ca.vertcat(rate, ca.MX.zeros(size - 2)))
    problem.measurement("p", ca.vertcat(r[0] + 0.3 * u[1], r[1]), noise=np.array([[0.05, 0.02], [0.02, 0.1]]))
    problem.minimize_expected(
        running=0.5 * ca.sumsqr(u) + 0.1 * r[0] ** 2 + 0.05 * u[0] * r[1],
        terminal=0.3 * r[0] ** 2,
        terminal_weight={r: np.linspace(2.0, 3.0, size)},
    )
    return problem


def open_loop(rate=None, *, noise=0.2, measured=True, variance=0.5, initial=1.0, duration=3.0):
    """One state with an estimation covariance and a control that matters to nothing else."""
    problem = co.Problem(duration=duration, name="open loop")
    x = problem.state("x", initial=initial, variance=variance)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, (rate or (lambda x, u: -0.7 * x))(x, u), noise=noise(x) if callable(noise) else noise)
    if measured:
        problem.measurement("m", x, noise=0.1)
    problem.estimation_covariance()
    problem.minimize(running=(u - 0.1) ** 2)
    return problem


def setting_of(solution, kind="perturbation"):
    """What `simulate` makes of a solution, without limits."""
    design = design_system(solution)
    free, domain = np.full(design.fed_back, np.inf), np.full(design.size, 1e300)
    limits = Limits(lower=-free, upper=free, least=-free, most=free)
    return Setting(solution=solution, design=design, actual=design, filter=kind, limits=limits, domain=domain)
