"""Damping or stiffness of an oscillator
=====================================

One or the other is identified while the oscillator is moved (thesis 5.4): the input decides what is learnt.
"""

import covocp as co
from covocp.models import damped_oscillator
from covocp.plot import plot_solutions

designs = {"least energy": (0.0, 0.0), "learn the damping": (1000.0, 0.0), "learn the stiffness": (0.0, 1000.0)}
solver = co.Solver(damped_oscillator.problem(), intervals=200)  # built once, solved for three pairs of weights
solutions = []
for label, (damping, stiffness) in designs.items():
    solution = solver.solve({"damping_weight": damping, "stiffness_weight": stiffness})
    sigma = {name: solution.deviation(name)[-1] for name in ("a", "b")}
    print(
        f"{label:20s} J = {solution.cost:.4f}, energy {solution.cost_terms['running']:.2f}, "
        f"final deviations: a {sigma['a']:.4f}, b {sigma['b']:.4f}"
    )
    solutions.append(solution)
plot_solutions(solutions, labels=list(designs), path="damped_oscillator.png")
