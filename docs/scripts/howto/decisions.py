"""Choose constants, keep budgets
==============================

A constant that the optimiser chooses is a decision. An integral over the whole time is one number, which may be a cost
or have a limit.
"""

# %%
# What to buy
# -----------
#
# A decision stands wherever a number does: in rates, costs, constraints, initial values, variances and noise. Here it
# is the noise of a sensor; what is more accurate costs more.

import covocp as co

ocp = co.Problem(duration=10.0, name="lag, the sensor is bought")
x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
b = ocp.unknown("b", mean=1.0, variance=5.0)
u = ocp.control("u")
density = ocp.decision("density", guess=1.0, lower=0.01, upper=100.0, unit="m^2 s")
ocp.dynamics(x, -b * x + u, noise=1.0)
ocp.measurement("position", x, noise=density)
E = ocp.estimation_covariance()
ocp.minimize(running=0.5 * u**2, terminal=10.0 * E[b, b] + 0.5 / density)

solution = co.solve(ocp)
print(f"density {float(solution[density]):.4f} m^2 s, cost {solution.cost:.5f}")
print(f"condition of the decisions, relative: {solution.optimality.decisions:.1e}")

# %%
# It is a number of the solution, with its unit in the printout. The guess also says of which magnitude it is. Decisions
# are no part of what the filter estimates: whoever builds the system knows them.
#
# A budget
# --------
#
# The integral of an expression, also of covariances, stands in terminal costs and in constraints, which then hold at
# the end.

average = ocp.integral(E[x, x], name="uncertainty", unit="m^2 s")
ocp.subject_to(average, upper=3.0, name="average accuracy")
tighter = co.solve(ocp)
print(f"density {float(tighter[density]):.4f} m^2 s, cost {tighter.cost:.5f}")
before = co.evaluate(ocp, nominal=solution)
print(f"integral {float(tighter[average]):.5f}, without the constraint {float(before[average]):.5f}")
print(f"multiplier {tighter.multiplier('average accuracy'):.4f}: what one unit more would save")

# %%
# What has been gathered *so far* is no such number: for a limit on it along the path declare a state with this rate,
# ``state(..., initial=0)``. How both are computed says :doc:`/numerics`.
