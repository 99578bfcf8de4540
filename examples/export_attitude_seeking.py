"""C code of an attitude seeker
============================

The constrained guidance law as C99: compiled, compared with Python, timed, and flown in the loop.

The compiled functions know one vector, the memory: readings of the window, gradient, factor of its covariance. In it
are the Kalman filter, two pointing zones and the bound of the step; there is no allocation and no solver in them.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import covocp as co
from covocp.blocks import attitude_seeking, so3
from covocp.models import antenna_pointing
from covocp.models.antenna.patch import Patch
from covocp.models.antenna.spacecraft import Spacecraft

STEP, DURATION, NOISE = 0.1, 80.0, 0.05
seeker = attitude_seeking.constrained(antenna_pointing.ZONES)
craft, antenna = Spacecraft(), Patch()
plant = antenna_pointing.plant(craft)
received = antenna.function()


def flown(read, update, step):
    """Ten readings a second, two decisions a second: histories of power and attitude."""
    generator = np.random.default_rng(0)
    attitude = so3.to_quaternion(antenna_pointing.INITIAL_ATTITUDE)
    state, memory, desired = np.concatenate([attitude, np.zeros(6)]), seeker.initial(attitude), attitude
    powers, attitudes = [], []
    for k in range(1, round(DURATION / STEP) + 1):
        state = plant(state, desired, 0.0, np.zeros(0)).full().ravel()
        power = float(received(state[:4], [0.0, 0.0, 1.0])[0])
        measured = power + NOISE * generator.standard_normal()
        if k % 5:
            memory = read(memory, state[:4], measured)
        else:
            memory = update(memory, state[:4], measured)
            desired = step(memory)
        powers.append(power)
        attitudes.append(state[:4])
    return np.array(powers), np.array(attitudes)


with tempfile.TemporaryDirectory() as folder:
    package = co.export_c([seeker.read, seeker.update, seeker.step], Path(folder) / "seeker")
    print(package.build())
    print(package.check())
    print(package.time())
    compiled = package.python()
    power, attitudes = flown(compiled["read"], compiled["update"], compiled["step"])
python, _ = flown(seeker.read, seeker.update, seeker.step)
print(f"largest difference between the flight in C and in Python: {np.abs(power - python).max():.1e} W")
print(f"power: {power[0]:.2f} W at the start, {power[-200:].mean():.2f} W over the last 20 s, {antenna.peak} W at most")

t = STEP * np.arange(1, len(power) + 1)
figure, (above, below) = plt.subplots(2, 1, figsize=(8, 6), layout="constrained", sharex=True)
above.plot(t, power)
above.axhline(antenna.peak, color="k", ls=":")
above.set(ylabel="power [W]")
for zone in attitude_seeking.zones_of(antenna_pointing.ZONES):
    below.plot(t, zone.value(so3.from_quaternion(attitudes)), label=zone.name)
below.axhline(0.0, color="k", lw=0.8)
below.set(xlabel="t [s]", ylabel="zones, kept where ≥ 0")
below.legend(fontsize="small")
for axes in (above, below):
    axes.grid(alpha=0.3)
figure.savefig("export_attitude_seeking.png", dpi=120)
