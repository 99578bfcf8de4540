"""A wall, an ellipse at the end, a margin of the actuator
=======================================================

Conditions on the covariance of the closed loop: the gain is chosen so that they hold.
"""

import numpy as np

import covocp as co
from covocp.plot import plot_solutions


def carriage(kept: bool) -> co.Problem:
    """A carriage that is sent close to a wall and back; with conditions on how widely it scatters, or without."""
    ocp = co.Problem(duration=10.0, name="carriage" + (" that keeps clear" if kept else ""))
    x = ocp.state("x", initial=0.0, final=0.0, variance=0.01, unit="m")
    v = ocp.state("v", initial=0.0, final=0.0, variance=1e-4, unit="m/s")
    u = ocp.control("u", unit="m/s2")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=2e-4)
    ocp.measurement("position", x, noise=0.01)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=0.5 * u**2 + 2 * (x - 1.9) ** 2, terminal_weight={x: 5.0, v: 5.0})
    if kept:
        ocp.subject_to(x + 3 * X.deviation(x), upper=2.0, name="wall")
        ocp.subject_to(X[x, x] / 0.085**2, upper=1.0, at="final", name="end")
    return ocp


free = co.solve(carriage(kept=False), intervals=60)
kept = co.solve(carriage(kept=True), intervals=60)
print(kept)
for solution in (free, kept):
    beyond = np.max(solution["x"] + 3 * solution.deviation("x"))
    print(f"{solution.name:28} J = {solution.cost:.4f}, x + 3 deviations at most {beyond:.4f} m", end="")
    print(f", deviation at the end {solution.deviation('x')[-1]:.4f} m")
runs = co.simulate(kept, runs=20000, seed=1)
print(runs)
# bands of three deviations: one of them keeps clear of the wall
figure = plot_solutions([free, kept], "x", ("rms", "x"), "C", labels=["best gain", "keeps clear"], sigmas=(3,))
figure.axes[0].axhline(2.0, color="black", linestyle="--", linewidth=1.0)
figure.axes[0].annotate("wall", (0.2, 2.0), xytext=(0, -3), textcoords="offset points", va="top")
figure.savefig("covariance_steering.png")
