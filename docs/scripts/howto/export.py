"""Export to C
===========

A solution, a block or a whole solver becomes a folder of C99 sources, without dynamic memory.
"""

# %%
# A controller
# ------------
#
# Filter, gains and nominal in one struct; ``period`` makes it a sampled one, ``limits`` are those of the control.

import shutil
from pathlib import Path

import casadi as ca
import numpy as np

import covocp as co
from covocp.blocks import kalman
from covocp.models import unknown_lag

compiler = shutil.which("cc") is not None
solution = co.solve(unknown_lag.steering(parameter_variance=0.01), progress=False)
package = co.export_c(solution, "lag", period=0.05, limits={"u": (-4.0, 4.0)})
print("files:", ", ".join(sorted(path.name for path in Path("lag").iterdir())))

# %%
# Built, compared with Python, and timed, where there is a C compiler:

if compiler:
    print(package.check())
    for name, time in package.time().items():
        print(f"{name}: {time.c:.0f} ns in C, {time.virtual_machine:.0f} ns in CasADi")

# %%
# The interface is a header with all sizes, units and status codes. Its beginning:

print("\n".join(Path("lag/lag.h").read_text().splitlines()[:60]))

# %%
# Blocks
# ------
#
# Any `casadi.Function`, or several in one package: here a filter that may miss readings.

x, P, y = ca.SX.sym("x", 2), ca.SX.sym("P", 2, 2), ca.SX.sym("y")
transition, noise, row = np.array([[1.0, 0.1], [0.0, 1.0]]), 0.01 * np.eye(2), np.array([[1.0, 0.0]])
predicted = kalman.predict(x, P, transition, noise)
updated = kalman.update(x, P, y, row, 0.2, missing="skip")
predict = ca.Function("predict", [x, P], predicted, ["x", "P"], ["estimate", "covariance"])
update = ca.Function("update", [x, P, y], updated, ["x", "P", "y"], ["estimate", "covariance"])
tracker = co.export_c([predict, update], "tracker", units={"x": "m, m/s", "y": "m"})
print(tracker.check() if compiler else sorted(path.name for path in tracker.directory.iterdir()))

# %%
# A solver
# --------
#
# A problem becomes the solver of its NLP: initial values, parameters and the duration are arguments.

planner = co.export_c(unknown_lag.problem(weight=10.0), "planner", intervals=20)
if compiler:
    plan = planner.python().solve(initial_x=0.2, duration=8.0)
    print(f"status {plan['status']}, cost {plan['cost']:.6f}")

# %%
# :doc:`/export` has all options, what is checked, and what has no C code. In the shell: ``covocp export
# unknown_lag:steering lag --period 0.05``.
