"""Antenna pointing by attitude seeking
====================================

Three guidance laws turn an antenna to a source that none of them knows, by the power that it receives.

The spacecraft measures a noisy power and its attitude. A Kalman filter estimates the gradient of the power in body axes
from the last readings; one law follows it, one projects it between an exclusion and an inclusion zone, one builds zones
and a bound of the step into the filter. With the numbers of the paper the loop of guidance and low-pass oscillates.
"""

from covocp.models import antenna_pointing

for law in ("unconstrained", "projected", "constrained"):
    runs = antenna_pointing.simulate(law, runs=64)
    print(runs, end="\n\n")
    runs.plot(f"antenna_{law}.png")
runs.plot("antenna_gradient.png", gradient=True)

printed = antenna_pointing.simulate("constrained", runs=64, settings="printed")
print(printed, end="\n\n")
printed.plot("antenna_printed_settings.png")

moving = antenna_pointing.simulate("constrained", runs=64, zones=[], source_rate=(0.002, 0.0, 0.0))
print("A source that moves by 0.11 deg/s, no zones")
print(moving)
