"""Filter and feedback of the first-order lag as C
===============================================

Exported, compiled, compared with Python, and flown against the actual lag.
"""

import tempfile
from pathlib import Path

import numpy as np

import covocp as co
from covocp.models import unknown_lag

STEPS = 1000
STIFFNESS, VARIANCE = 1.1, 0.01  # of the lag that is flown; of what the design thinks it might be

problem = unknown_lag.steering(parameter_variance=VARIANCE)
solution = co.solve(problem, intervals=80, progress=False)
folder = Path(tempfile.mkdtemp()) / "lag"
package = co.export_c(solution, folder)
print(package.check())  # at random points, at the ends of the time and beyond, with NaN and infinity


def fly(controller, seed=1):
    """The actual lag under noise, the control held between the steps of the controller."""
    random = np.random.default_rng(seed)
    h = solution.duration / STEPS
    x, history = random.normal(), []
    controller.init()
    u = float(controller.state["control"])
    for k in range(STEPS):
        x += h * (-STIFFNESS * x + u) + np.sqrt(h) * random.normal()
        reading = x + random.normal() / np.sqrt(h) if k % 7 else np.nan  # every seventh is missing
        u = float(controller.step(reading, (k + 1) * h).item())
        history.append((x, u))
    return np.array(history)


in_c, in_python = fly(package.python().step), fly(package.reference().step)
print(f"{STEPS} steps in the loop: C and Python differ by {np.abs(in_c - in_python).max():.1e}")
print(f"x(T) = {in_c[-1, 0]:.3f}, meant to be {solution['x'][-1]:g} with deviation {solution.deviation('x')[-1]:.3f}")
print(co.simulate(solution, 100, seed=1, law=package.python(), period=0.02, progress=False))
for name, t in package.time().items():
    print(f"{name}: {t.c:.0f} ns in C, {t.virtual_machine:.0f} in CasADi, {t.python:.0f} from Python")
