"""θ-D servo and filter of the agile aircraft as C
===============================================

In the loop over the whole of scenario 2, against Python.
"""

import tempfile
from pathlib import Path

import casadi as ca
import numpy as np

import covocp as co
from covocp.blocks import theta_d
from covocp.models import agile_aircraft
from covocp.simulation.laws import gain_filter

PATH = [0.0, 0.0, 0.0, 1.0, 0.0]  # the path angle is followed
PAPER = {"k": agile_aircraft.FACTOR, "l": agile_aircraft.DECAY}

x, u, t = ca.SX.sym("x", 5), ca.SX.sym("u"), ca.SX.sym("t")
A0, bilinear, B, H = agile_aircraft.matrices()
A = x[1] * ca.DM(bilinear)
scenario = agile_aircraft.tracking()
plant = ca.Function("plant", [x, u], [(ca.DM(A0) + A) @ x + ca.DM(B) @ u])
servo = theta_d.servo(x, A0, A, B, PATH, scenario.Q, scenario.R, **PAPER)
angle, integral = agile_aircraft.path_command(t)
whole = ca.SX.sym("whole", 6)  # estimate and the integral of the estimated path angle
reference = ca.vertcat(0, 0, 0, angle, 0, integral)
law = ca.Function("servo", [whole, t], [servo(whole, t, reference)], ["estimate", "time"], ["command"])
gain = theta_d.filter_gain(x, A0, A, H, scenario.W, scenario.V, **PAPER)
gain = ca.Function("filter", [x, t], [gain(x, t)], ["estimate", "time"], ["gain"])

package = co.export_c(
    [law, gain],
    Path(tempfile.mkdtemp()) / "aircraft",
    ranges={"estimate": (-0.5, 0.5), "time": (0.0, scenario.duration)},
    units={"time": "s", "command": "deg"},
)
print(package.check())


def fly(servo, gain):
    """Scenario 2: path angle 0, 45, 0 deg."""
    observer = gain_filter(plant, gain, H, scenario.estimate, integrate=PATH)
    breaks = (agile_aircraft.RISE_END, agile_aircraft.FALL_START, agile_aircraft.FALL_END)
    return co.simulate_law(
        plant, servo, initial=np.zeros(5), observer=observer, duration=scenario.duration, samples=601, breaks=breaks
    )


compiled, evaluated = package.python(), package.reference()
in_c, in_python = fly(compiled.servo, compiled.filter), fly(evaluated.servo, evaluated.filter)
gap = np.abs(in_c.x - in_python.x).max(axis=0) / np.abs(in_python.x).max(axis=0)
print(f"{scenario.duration:g} s in the loop: C and Python differ by {gap.max():.1e} of the largest state")
print(f"path angle at 14.9 s: {np.degrees(in_c.x[298, 3]):.1f} deg, meant to be 45")
for name, time in package.time().items():
    print(f"{name}: {time.c:.0f} ns in C, {time.virtual_machine:.0f} in CasADi")
