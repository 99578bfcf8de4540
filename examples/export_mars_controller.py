"""Mars entry as C
===============

Nominal, filter and feedback; for samples of half a second, and for any time between steps.
"""

import tempfile
from pathlib import Path

import numpy as np

import covocp as co
from covocp.models import mars_entry

PERIOD, FEET_PER_MILE = 0.5, 5280.0

problem = mars_entry.problem()
solution = co.evaluate(problem, nominal=mars_entry.reference())  # constant lift-to-drag ratio
folder = Path(tempfile.mkdtemp())
packages = {
    "any time between steps": co.export_c(solution, folder / "entry", limits="bounds"),
    f"samples of {PERIOD} s": co.export_c(solution, folder / "entry_sampled", period=PERIOD, limits="bounds"),
}

statement = solution.statement
T, parameters = solution.duration, solution.parameters


def rate(x, u, t):
    return statement.nominal(x, u, t, T, parameters)[0].full().ravel()


def fly(controller, seed=3):
    """One entry: initial deviation, noise of density and accelerometers, control held between the steps."""
    random = np.random.default_rng(seed)
    start = np.linalg.cholesky(solution["E"][0]) @ random.normal(size=statement.nx)
    x, u, h = solution.trajectory.x[0] + start, solution.controls[0], PERIOD
    controller.init()
    controls = []
    for k in range(round(T / h)):
        t = k * h
        noise = statement.loop.expansion(x, u, t, T, parameters)[5].full()
        a = rate(x, u, t)
        b = rate(x + h / 2 * a, u, t + h / 2)
        c = rate(x + h / 2 * b, u, t + h / 2)
        x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, u, t + h))
        x += np.sqrt(h * np.diag(noise)) * random.normal(size=x.size)
        value, _, density = (v.full() for v in statement.measurement(x, u, t + h, T, parameters))
        reading = value.ravel() + np.sqrt(np.diag(density) / h) * random.normal(size=value.size)
        u = controller.step(reading, t + h)
        controls.append(u)
    return x, np.array(controls)


aim = solution.trajectory.x[-1]
for name, package in packages.items():
    print(f"\n{name}\n{package.check()}")
    (end, in_c), (_, in_python) = fly(package.python().step), fly(package.reference().step)
    miss = mars_entry.DATA["recommended"].radius * (end[1] - aim[1])
    print(f"{in_c.shape[0]} steps in the loop: C and Python differ by {np.abs(in_c - in_python).max():.1e}")
    print(f"this entry misses by {miss / FEET_PER_MILE:.2f} miles in range, {end[0] - aim[0]:.0f} ft in altitude")
    time = package.time()["step"]
    print(f"a step takes {time.c / 1000:.2f} microseconds in C, {time.virtual_machine / 1000:.1f} in CasADi")
