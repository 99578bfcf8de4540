"""Constrain a covariance
======================

An entry of a covariance is an expression. It may be bounded at the end or along the path, like any other.
"""

# %%
# At the end
# ----------
#
# The least energy that leaves a variance of ``b`` of at most 0.5:

import casadi as ca

import covocp as co

ocp = co.Problem(duration=10.0, name="lag, final variance at most 0.5")
x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
b = ocp.unknown("b", mean=1.0, variance=5.0)
u = ocp.control("u")
ocp.dynamics(x, -b * x + u, noise=1.0)
ocp.measurement("position", x, noise=1.0)
E = ocp.estimation_covariance()
ocp.subject_to(E[b, b], upper=0.5, at="final", name="accuracy of b")
ocp.minimize(running=0.5 * u**2)

solution = co.solve(ocp)
print(f"energy {solution.cost:.5f}, variance of b at the end {solution[E[b, b]][-1]:.6f}")
print(f"multiplier {solution.multiplier('accuracy of b'):.3f}: what one unit less of variance would cost")

# %%
# Along the path
# --------------
#
# ``at="path"`` is the default. Here a deviation is meant to stay below 0.85, which is a variance of 0.7225, from the
# third second on: an expression may depend on the time.

ocp.subject_to(E[x, x] - ca.if_else(ocp.time < 3.0, 1.0, 0.7225), name="variance of x")
path = co.solve(ocp)
later = path.t >= 3.0
print(f"energy {path.cost:.5f}, largest variance of x after 3 s {path[E[x, x]][later].max():.4f}")
print(f"violation between the nodes: {max(path.check_path().values(), default=0.0):.1e}")
path.plot(path="path.png")

# %%
# Constraints on a few covariances along the path make them variables of the NLP (``covariances="states"``); an entry
# at the end does not. :doc:`/numerics` says which formulation is taken when.
