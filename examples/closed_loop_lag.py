"""A lag with unknown time constant in closed loop
===============================================

It is steered by feedback from its filter, three ways (thesis 6.12).

The gain of the combined design is one of the linear covariance model: with a variance of 5 a third of the lags is
unstable, which linear gains cannot hold. `monte_carlo.py` shows where the linear model is right.
"""

from math import erf, sqrt

import numpy as np

import covocp as co
from covocp.models import unknown_lag
from covocp.plot import plot_solutions

grid = 1 - (1 - np.linspace(0, 1, 81)) ** 2  # finer towards the end, where feedback and push come
problem = unknown_lag.steering()
learning = co.solve(unknown_lag.problem(weight=1.0, final=1.0), grid=grid)  # thesis 5.3: the input that learns b
designs = {
    "combined": co.solve(problem, grid=grid),  # nominal, filter and feedback chosen together
    "classical": co.solve(problem, grid=grid, nominal="deterministic"),  # least energy, then filter and feedback
    "identification": co.evaluate(problem, nominal=learning),  # in the same loop
}

print("nominal           energy  deviations       J  X_xx(T)  E_xx(T)  E_bb(T)  area x")
for name, s in designs.items():
    energy, E, area = s.cost_terms["running"], s["E"][-1], np.trapezoid(s["x"], s.t)
    print(f"{name:16} {energy:7.4f}     {s.cost - energy:7.4f} {s.cost:7.4f}", end="  ")
    print(f"{s.covariance('x')[-1, 0, 0]:7.4f}  {E[0, 0]:7.4f}  {E[1, 1]:7.4f} {area:7.4f}")

more = 100 * (designs["classical"].cost / designs["combined"].cost - 1)
print(f"\nThe classical design costs {more:.1f} % more (published: 24.2 %). The combined one keeps less area under x,")
print("so that b matters less, and learns less about b. The input that learns b best is the worst nominal of all.")
unstable = 50 * (1 - erf(unknown_lag.MEAN / sqrt(2 * 5.0)))
print(f"\nIn the linear model, that is: with a variance of 5 of b {unstable:.0f} % of the actual lags are unstable,")
print("which these gains cannot hold. The published gain is none of the actual system.")

panels = {
    "u (figure 6-1)": "u",
    "x (6-5)": "x",
    "rms of x (6-2, 6-3)": ("rms", "x"),
    "rms error of b (6-4)": ("rms", "b"),
}
plot_solutions(list(designs.values()), panels, "C", labels=list(designs), path="closed_loop_lag.png")
