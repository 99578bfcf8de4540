"""Design trajectory and feedback together
=======================================

State the actual system with its noises, and what it costs to miss, in place of a deterministic cost.
"""

# %%
# An expected cost
# ----------------

import covocp as co
from covocp.plot import plot_solutions

ocp = co.Problem(duration=10.0, name="lag in closed loop")
x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
b = ocp.unknown("b", mean=1.0, variance=1.0)
u = ocp.control("u")
ocp.dynamics(x, -b * x + u, noise=1.0)
ocp.measurement("position", x, noise=1.0)
ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0})

combined = co.solve(ocp)
print(combined)

# %%
# Against the classical design
# ----------------------------
#
# Nominal of the deterministic cost first, filter and feedback around it.

classical = co.solve(ocp, nominal="deterministic")
print(f"combined {combined.cost:.5f}, classical {classical.cost:.5f}")

plot_solutions([combined, classical], "x", "u", ("rms", "b"), "C", labels=["combined", "classical"], path="designs.png")

# %%
# A nominal of one's own
# ----------------------
#
# In the same loop: filter, gains and covariances along controls that are given, over t/T.

pushed = co.evaluate(ocp, nominal={"u": lambda s: 2.0 * s**8})
print(f"expected cost {pushed.cost:.4f}; it misses its target by {pushed.violations['final value of x']:.3f}")

# %%
# Gains and covariances
# ---------------------

print("feedback gain at the start and at the end:", combined.gains["C"][0].round(3), combined.gains["C"][-1].round(3))
X, E = combined.loop.X[-1, 0, 0], combined.loop.E[-1, 0, 0]
print(f"variance of x at the end {X:.4f}, of the error of its estimate {E:.4f}")

# %%
# A feedback that is allowed less (only some entries, constant, bounded) is stated by `Gain`; see :doc:`/closed_loop`.
