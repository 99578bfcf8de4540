"""How hard to identify
====================

The first-order lag with three weights on the final variance of its constant (thesis 5.3).
"""

import covocp as co
from covocp.models import unknown_lag
from covocp.plot import plot_solutions

solutions = []
for weight in (0.1, 1.0, 10.0):
    solution = co.solve(unknown_lag.problem(weight=weight, final=1.0))
    variance = solution.covariance("b")[-1, 0, 0]
    energy = solution.cost_terms["running"]
    print(f"weight {weight:4g}: J = {solution.cost:.6f}, energy {energy:.4f}, final variance of b {variance:.4f}")
    print(" ", co.certify(solution))
    solutions.append(solution)
plot_solutions(solutions, labels=["weight 0.1", "weight 1", "weight 10"], path="identification_weights.png")
