"""Fly a law of one's own
======================

Any object with ``step(measurement, time)`` can fly the simulated system, beside the filter and feedback of a design.
"""

# %%
# A law
# -----
#
# Each period it is given the mean of the readings over that period, and returns the whole control, which is held
# until the next step. At time zero nothing is measured yet: the readings are NaN.

import numpy as np

import covocp as co
from covocp.models import lqg_double_integrator

PERIOD = 0.1  # s


class AlphaBeta:
    """Position and speed by an alpha-beta filter, pulled to zero."""

    def init(self):
        self.position, self.speed, self.control = 1.0, 0.0, 0.0

    def step(self, measurement, time):
        if np.isfinite(measurement[0]):
            self.position += PERIOD * self.speed
            self.speed += PERIOD * self.control
            error = measurement[0] - self.position
            self.position += 0.2 * error
            self.speed += 0.02 / PERIOD * error
        self.control = -self.position - 1.4 * self.speed
        return self.control


# %%
# Beside the design
# -----------------
#
# The same seed gives both the same noise.

solution = co.solve(lqg_double_integrator.problem(), progress=False)
designed = co.simulate(solution, runs=500, seed=1, progress=False)
own = co.simulate(solution, runs=500, seed=1, law=AlphaBeta(), period=PERIOD, progress=False)
for name, runs in (("filter and feedback of the design", designed), ("own law", own)):
    print(f"{name}: mean cost {runs.cost:.3f} +- {runs.cost_error:.3f}")
print(own)
own.plot(path="own_law.png")

# %%
# A law that has an attribute ``estimate`` (the deviation of states and unknowns from the nominal) is compared with
# the actual one. The controller that `export_c` compiles is such an object, too: ``law=package.python()``.
#
# Plants, filters and laws that are functions, without a problem, go into `simulate_law`; see :doc:`/blocks/theta_d`.
