"""A corridor kept with a probability
==================================

Limits that the actual system keeps with 99 per cent, by its position between two walls and by its actuator.
"""

import covocp as co

ocp = co.Problem(duration=4.0, name="corridor")
x = ocp.state("x", initial=0.0, final=1.0, variance=0.01, unit="m")
v = ocp.state("v", initial=0.0, final=0.0, variance=0.01, unit="m/s")
u = ocp.control("u", unit="m/s2")
ocp.dynamics(x, v)
ocp.dynamics(v, u, noise=0.02)
ocp.measurement("position", x, noise=0.002)
ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 5.0, v: 2.0})
ocp.chance(x, lower=-0.3, upper=1.3, probability=0.99, name="walls")
ocp.chance(u, upper=0.7, probability=0.99, smallest=1e-3, name="actuator")

solution = co.solve(ocp, intervals=40)
print(solution)

# The gain acts where a limit asks for it: each band touches its limit where the probability is just 99 per cent.
solution.plot("x", "walls", "actuator", "C", path="corridor.png")

runs = co.simulate(solution, runs=20000, seed=1)
print(runs)
