"""A law of one's own in the actual system
=======================================

Beside the designed one: what do filter and feedback of the design gain?
"""

import numpy as np

import covocp as co
from covocp.models import lqg_double_integrator

PERIOD = 0.1  # s
solution = co.solve(lqg_double_integrator.problem(), progress=False)


class AlphaBeta:
    """Position and speed by an alpha-beta filter, pulled to zero; four numbers chosen by hand."""

    def __init__(self, alpha, beta, stiffness, damping):
        self.alpha, self.beta, self.stiffness, self.damping = alpha, beta, stiffness, damping

    def init(self):
        self.position, self.speed, self.control = 1.0, 0.0, 0.0

    def step(self, measurement, time):
        if np.isfinite(measurement[0]):  # at time zero nothing is measured yet
            self.position += PERIOD * self.speed
            self.speed += PERIOD * self.control
            error = measurement[0] - self.position
            self.position += self.alpha * error
            self.speed += self.beta / PERIOD * error
        self.control = -self.stiffness * self.position - self.damping * self.speed
        return self.control


designed = co.simulate(solution, runs=1000, seed=1, progress=False)
own = co.simulate(solution, runs=1000, seed=1, law=AlphaBeta(0.2, 0.02, 1.0, 1.4), period=PERIOD, progress=False)
for name, runs in (("designed filter and feedback", designed), ("own law", own)):
    spread = ", ".join(f"{key} {runs.deviation(key)[-1]:.3f}" for key in ("position", "speed"))
    print(f"{name}: mean cost {runs.cost:.3f} +- {runs.cost_error:.3f}; at the end {spread}")
print(own.verdict)
own.plot(path="own_law.png")
