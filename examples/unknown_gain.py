"""An integrator whose gain is unknown
===================================

The optimum is a constant control, not the printed exponential (thesis 3.5).
"""

import numpy as np

import covocp as co
from covocp.models import unknown_gain

solution = co.solve(unknown_gain.problem())
print(f"u between {solution['u'].min():.6f} and {solution['u'].max():.6f}: constant")
print(f"J = {solution.cost:.8f}")
kappa = 2 * 0.5 / 1.0  # the correction sheet's u = kappa x(T) exp(kappa t) / (b (exp(kappa T) - 1))
t = solution.t
printed = kappa * np.exp(kappa * t) / np.expm1(kappa)
energy = np.trapezoid(0.5 * printed**2, t)
print(f"the printed control meets the same E(T) and needs {energy - 0.5:.4f} more energy")
solution.plot(path="unknown_gain.png")
