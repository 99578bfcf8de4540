"""Feedback gains that are simpler than the best ones
==================================================

Without the unknown's estimate, constant, or both.
"""

import covocp as co
from covocp.plot import plot_solutions


def steering(gain: co.Gain | None = None) -> co.Problem:
    """The lag of thesis 6.12, with a constrained gain or the best one."""
    ocp = co.Problem(duration=10.0, name="lag with a constrained feedback gain")
    x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=1.0)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0}, gain=gain)
    return ocp


# Bounds keep a solver away from gains so large that the covariance of the estimate means nothing on the mesh.
bounds = {"lower": -5.0, "upper": 5.0}
best = co.solve(steering())
cases = {
    "free entries, for comparison": co.Gain(**bounds),
    "of x alone": co.Gain(structure=[[1, 0]], **bounds),
    "constant": co.Gain(constant=True, **bounds),
    "constant, of x alone": co.Gain(structure=[[1, 0]], constant=True, **bounds),
}
print(f"{'the best gain':30} J = {best.cost:.6f}")
solutions = [best]
for name, gain in cases.items():
    solution = co.solve(steering(gain))  # the nominal is chosen anew, for this gain
    last = solution.gains["C"][-1, 0]
    loss = 100 * (solution.cost / best.cost - 1)
    print(f"{name:30} J = {solution.cost:.6f}, {loss:.2f} % more; C(T) = ({last[0]:.3f}, {last[1]:.3f})")
    solutions.append(solution)
print("With a constrained gain the cost is had from E and Xhat (E-1); that from S (E-20) holds for the best gain only.")
chosen = [solutions[i] for i in (0, 2, 3, 4)]
labels = ["best gain", *list(cases)[1:]]
plot_solutions(chosen, "u", ("rms", "x"), "C", labels=labels, sigmas=(), path="constrained_gain.png")
