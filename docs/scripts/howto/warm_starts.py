"""Solve the same problem many times
=================================

A `Solver` is built once. Parameters change from solve to solve, and an earlier solution is the best guess.
"""

# %%
# Parameters
# ----------
#
# What may change is declared as a parameter; means of unknowns are parameters as well.

import covocp as co
from covocp.plot import plot_solutions

ocp = co.Problem(duration=10.0, name="lag with a weight")
x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
b = ocp.unknown("b", mean=1.0, variance=5.0)
u = ocp.control("u")
weight = ocp.parameter("weight", 10.0)
ocp.dynamics(x, -b * x + u, noise=1.0)
ocp.measurement("position", x, noise=1.0)
E = ocp.estimation_covariance()
ocp.minimize(running=0.5 * u**2, terminal=weight * E[b, b])

solver = co.Solver(ocp, intervals=100)
previous, solutions = None, {}
for value in (10.0, 8.0, 6.0, 4.0):
    cold = solver.solve({"weight": value}, progress=False)
    previous = solver.solve({"weight": value}, guess=previous, progress=False)
    print(f"weight {value:4}: cost {previous.cost:.6f}, {previous.stats['iterations']} iterations warm", end="")
    print(f", {cold.stats['iterations']} cold")
    solutions[f"weight {value:g}"] = previous

panels = {"x": "x", "u": "u", "variance of b": E[b, b]}
plot_solutions(list(solutions.values()), panels, labels=list(solutions), path="weights.png")

# %%
# Other meshes
# ------------
#
# A solution is a guess on any mesh, and from any file.

previous.save("weight_4.npz")
finer = co.solve(ocp, intervals=200, guess=co.load("weight_4.npz"), parameters={"weight": 4.0})
print(f"200 intervals: cost {finer.cost:.8f}, {finer.stats['iterations']} iterations")

# %%
# Guesses by name
# ---------------
#
# A guess may be a number, values over the nodes, waypoints spread evenly in time, or a function of t/T.
# ``guess="multistart"`` adds random starts and returns the best.

start = co.solve(ocp, guess={"u": lambda s: 1.0 - s, "x": [0.0, 1.5, 1.0]})
many = co.solve(ocp, guess="multistart", starts=4, seed=0, progress=False)
print(f"cost from this guess {start.cost:.6f}, the best of several starts {many.cost:.6f}: {many.message}")
