"""State-dependent noise
=====================

Three costs, three trajectories, against their closed forms (thesis 3.4).
"""

import numpy as np

import covocp as co
from covocp.models import noisy_integrator
from covocp.plot import plot_solutions

cases = {"energy only": (0.0, 0.0), "variance along the way": (0.0, 1.0), "final variance": (1.0, 0.0)}
solutions = []
for label, (terminal, integral) in cases.items():
    solution = co.solve(noisy_integrator.problem(terminal_weight=terminal, integral_weight=integral))
    exact = noisy_integrator.exact(terminal, integral, solution.t)
    print(f"{label:24s} J = {solution.cost:.8f}   largest error of u {np.abs(solution['u'] - exact.u).max():.1e}")
    solutions.append(solution)
plot_solutions(solutions, labels=list(cases), path="noisy_integrator.png")
