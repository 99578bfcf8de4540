"""The sensor that is worth its price
==================================

Choose how accurate a sensor is, and how stiff a spring, together with the motion that learns the damping.
"""

import covocp as co

ocp = co.Problem(duration=6.0, name="oscillator, sensor and spring are chosen")
density = ocp.decision("density", guess=0.05, lower=1e-3, upper=1.0, unit="m^2 s")
stiffness = ocp.decision("stiffness", guess=2.0, lower=0.5, upper=4.0, unit="1/s^2")
x = ocp.state("x", initial=0.0, variance=0.1, unit="m")
v = ocp.state("v", initial=0.0, variance=0.1, unit="m/s")
damping = ocp.unknown("damping", mean=0.3, variance=0.04, unit="1/s")
force = ocp.control("force", lower=-1.0, upper=1.0, unit="m/s^2")

ocp.dynamics(x, v)
ocp.dynamics(v, -stiffness * x - damping * v + force, noise=1e-3)
ocp.measurement("position", x, noise=density)
E = ocp.estimation_covariance()

energy = ocp.integral(force**2, name="energy", unit="m^2/s^3")
ocp.subject_to(energy, upper=2.0, name="energy budget")
ocp.minimize(terminal=100.0 * E[damping, damping] + 0.01 / density)

solution = co.solve(ocp)
print(solution)
print(f"\nsensor of {float(solution[density]):.4f} m^2 s on a spring of {float(solution[stiffness]):.4f} 1/s^2")
print(f"one unit more energy would save {solution.multiplier('energy budget'):.4f}")
solution.plot(path="bought_sensor.png")
