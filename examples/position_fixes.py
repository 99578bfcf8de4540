"""Position fixes now and then
===========================

A vehicle with an unknown drag has a speedometer, and is told its position every four seconds: nominal, filter and
feedback are chosen together, and the variances are a saw tooth.
"""

import covocp as co

ocp = co.Problem(duration=12.0, name="position fixes")
x = ocp.state("x", initial=0.0, variance=0.25, unit="m")
v = ocp.state("v", initial=0.0, variance=0.01, unit="m/s")
drag = ocp.unknown("drag", mean=0.1, variance=0.0003, unit="1/m")
thrust = ocp.control("thrust", guess=0.3, unit="m/s^2")

ocp.dynamics(x, v)
ocp.dynamics(v, thrust - drag * v * v, noise=2e-3)
ocp.measurement("speed", v, noise=0.02)  # all the time, white noise of this density
ocp.measurement("fix", x, noise=0.04, every=4.0)  # at 4, 8 and 12 s, noise of this variance
ocp.minimize_expected(running=0.5 * thrust**2, terminal=5.0 * (x - 10.0) ** 2 + 5.0 * v**2)

solution = co.solve(ocp, intervals=60, tolerance=1e-9)
print(solution)
for time in (4.0, 8.0, 12.0):
    before, after = (solution.at(time, side)["E"][0, 0] ** 0.5 for side in ("before", "after"))
    print(f"at {time:4.1f} s the position is known to {before:.2f} m, after the fix to {after:.2f} m")
solution.plot(path="position_fixes.png")

sample = co.simulate(solution, runs=2000, seed=1)
print(f"\n{sample}")
