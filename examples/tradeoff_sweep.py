"""The trade-off between energy and knowledge
==========================================

One problem, built once, solved for 25 weights with warm starts.
"""

import numpy as np
from matplotlib.figure import Figure

import covocp as co
from covocp.models import unknown_lag

solver = co.Solver(unknown_lag.problem(final=1.0), intervals=100)
weights = np.geomspace(0.05, 50.0, 25)
previous, energies, variances, iterations = None, [], [], []
for weight in weights:
    previous = solver.solve({"weight": weight}, guess=previous, progress=False)
    energies.append(previous.cost_terms["running"])
    variances.append(previous.covariance("b")[-1, 0, 0])
    iterations.append(previous.stats["iterations"])
print(f"{weights.size} solutions, {np.mean(iterations[1:]):.1f} iterations each after the first ({iterations[0]})")
print(
    f"variance of b from {variances[0]:.3f} for energy {energies[0]:.3f} to {variances[-1]:.3f} for {energies[-1]:.3f}"
)

figure = Figure(figsize=(6, 4), layout="constrained")
axes = figure.add_subplot()
axes.plot(variances, energies, "o-", markersize=3)
axes.set_xscale("log")
axes.set_xticks([0.2, 0.5, 1.0, 2.0], labels=["0.2", "0.5", "1", "2"])
axes.set_xticks([], minor=True)
axes.set_xlabel("final variance of b")
axes.set_ylabel("energy of the control")
axes.grid(alpha=0.3)
figure.savefig("tradeoff_sweep.png", dpi=150)
