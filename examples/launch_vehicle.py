"""A launch vehicle in four phases
===============================

Six boosters, three boosters, first stage, second stage: what is empty drops off, and the mass in orbit is the largest.
"""

import covocp as co
from covocp.models import launch_vehicle

solution = co.solve(launch_vehicle.phases(), intervals=20)
print(f"in orbit: {-1e3 * solution.cost:.3f} kg after {solution.duration:.3f} s (published: 7529.712 kg, 924.139 s)\n")
for start, phase in zip(solution.starts, solution, strict=True):
    mass = phase["m"]
    print(f"{phase.name:15s} {start:7.2f} s to {start + phase.duration:7.2f} s: {mass[0]:8.3f} t to {mass[-1]:8.3f} t")
print(f"\nvelocity where the stages separate: {solution.at(261.0)['v']} km/s")
solution.plot("m", "v", "u", path="launch_vehicle.png")
