"""Is a combined design worth its while?
=====================================

An estimate from the classical one, before the combined one is computed.
"""

import casadi as ca

import covocp as co
from covocp.models import mars_entry, unknown_lag
from covocp.plot import plot_solutions


def linear_quadratic() -> co.Problem:
    """A double integrator with a quadratic cost: nominal and statistics separate, nothing can be gained."""
    ocp = co.Problem(duration=3.0, name="linear plant, quadratic cost")
    x = ocp.state("x", 2, initial=[1.0, 0.0], variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, 1.0])
    ocp.measurement("position", x[0], noise=1.0)
    ocp.minimize_expected(running=0.5 * u**2 + ca.dot(x, x), terminal=ca.dot(x, x))
    return ocp


problems = {
    f"lag, variance of b {variance:g}": (unknown_lag.steering(parameter_variance=variance), None)
    for variance in (0.01, 0.1, 1.0, 5.0)
}
problems["linear, quadratic"] = (linear_quadratic(), None)
problems["Mars entry"] = (mars_entry.problem(), mars_entry.reference())
print("gain in % of the cost    first order  found at least    true")
for name, (problem, nominal) in problems.items():
    worth = co.worth(problem, nominal=nominal)
    true = 1 - co.solve(problem).cost / worth.classical.cost
    percent = [100 * gain for gain in (worth.first_order, worth.gain, true)]
    print(f"{name:26} {percent[0]:9.3f} {percent[1]:15.3f} {percent[2]:7.3f}  {worth.verdict.split(':')[0]}")

lag, _ = problems["lag, variance of b 5"]
worth = co.worth(lag)
moved = worth.classical["u"] + worth.step * worth.direction[:, 0]
designs = {
    "classical": worth.classical,
    "moved along the statistical gradient": co.evaluate(lag, nominal={"u": moved}),
    "combined": co.solve(lag),
}
plot_solutions(list(designs.values()), "x", "u", labels=list(designs), path="worth.png")
