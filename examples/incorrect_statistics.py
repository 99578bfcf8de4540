"""Noise that is not what was designed for
=======================================

Filter and feedback meet more disturbance, and better measurements, than they were designed for (thesis 6.11).
"""

import numpy as np

import covocp as co
from covocp.models import unknown_lag
from covocp.plot import plot_solutions

grid = 1 - (1 - np.linspace(0, 1, 81)) ** 2
problem = unknown_lag.steering()  # designed with Q = 1, U = 1
truth = unknown_lag.steering(process_noise=2.0, measurement_noise=0.5)
solutions, labels = [], []
for name, nominal in {"combined": "combined", "classical": "deterministic"}.items():
    design = co.solve(problem, grid=grid, nominal=nominal)
    true = co.evaluate(design, truth=truth)  # nominal and gains kept, covariances of the truth
    E, Xhat, Z, X = (matrix[-1, 0, 0] for matrix in (true.loop.E, true.loop.Xhat, true.loop.Z, true.loop.X))
    print(f"{name}: J predicted {design.cost:.5f}, true {true.cost:.5f}")
    print(f"  at the end X = {X:.5f} of E = {E:.5f}, Xhat = {Xhat:.5f}, and Z = {Z:.5f}: no longer zero")
    right = co.evaluate(truth, nominal=design)  # filter and feedback designed for the truth
    print(f"  filter and feedback that knew would have cost {right.cost:.5f} along the same nominal")
    solutions += [design, true]
    labels += [f"{name}, as designed", f"{name}, in truth"]
plot_solutions(solutions, "x", ("rms", "x"), ("rms", "b"), labels=labels, path="incorrect_statistics.png")
