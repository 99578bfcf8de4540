"""C code of a peak seeker
=======================

A peak seeker in two inputs as C99: compiled, compared with Python, timed, and flown in the loop.

A vehicle with a lag of a second looks for the strongest signal of a beacon that it measures with noise. The compiled
functions know one vector, the memory; there is no allocation and no linear solver in them.
"""

import tempfile
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import covocp as co
from covocp.blocks import peak_seeking

STEP, PERIOD, DURATION = 0.1, 2.0, 160.0
BEACON, NOISE = np.array([8.0, -3.0]), 0.2

seeker = peak_seeking.seeker(
    2,
    window=10,
    noise=NOISE**2 * STEP / PERIOD,  # of a mean over a period
    drift=(1e-5, 1e-5, 1e-5, 1e-3, 1e-3),
    prior_covariance=(0.1, 0.1, 0.1, 1.0, 1.0),
    prior=np.zeros(5),
    smallest_curvature=0.05,
    largest_step=1.0,
    maximum=True,
)

x, increment, t, none = ca.SX.sym("x", 4), ca.SX.sym("increment", 2), ca.SX.sym("t"), ca.SX.sym("none", 0)
place, command = x[:2], x[2:]
excited = command + peak_seeking.circle(t, 0.5, 20.0)
following = place + (1.0 - np.exp(-STEP)) * (excited - place)
plant = ca.Function(
    "plant",
    [x, increment, t, none],
    [ca.vertcat(following, peak_seeking.ramp(command, increment, period=PERIOD, step=STEP))],
)
noise = ca.SX.sym("noise")
strength = 5.0 / (1.0 + ca.sumsqr(place - BEACON) / 30.0)
sensor = ca.Function("sensor", [x, t, noise], [ca.vertcat(place, strength + NOISE * noise)])

with tempfile.TemporaryDirectory() as folder:
    package = co.export_c([seeker.update, seeker.step], Path(folder) / "beacon")
    print(package.build())
    print(package.check())
    print(package.time())
    compiled = package.python()

    def flown(memory, measured, time):
        """The law as it would run on board: update, then step."""
        memory = compiled["update"](memory, measured[:2], measured[2])
        return memory, compiled["step"](memory)

    loop = {
        "initial": np.zeros(4), "memory": seeker.initial(), "step": STEP, "period": PERIOD, "duration": DURATION,
    }  # fmt: skip
    run = co.simulate_sampled(plant, sensor, flown, **loop)
python = co.simulate_sampled(plant, sensor, seeker.law(), **loop)
print(f"largest difference between the flight in C and in Python: {np.abs(run.x - python.x).max():.1e} m")
distance = np.linalg.norm(run.x[0, :, :2] - BEACON, axis=1)
print(f"distance from the beacon: {distance[0]:.1f} m at the start, {distance[-200:].mean():.2f} m over the last 20 s")

figure, (path, history) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
path.plot(*run.x[0, :, :2].T, lw=1.0)
path.plot(*BEACON, "r*", ms=12, label="beacon")
path.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
history.plot(run.t, distance, label="distance [m]")
history.plot(run.samples, run.measured[0, :, 2], ".", label="measured signal")
history.set(xlabel="t [s]")
for axes in (path, history):
    axes.legend()
    axes.grid(alpha=0.3)
figure.savefig("export_peak_seeker.png", dpi=120)
