"""A constraint on a final variance
================================

Learn the time constant to a given accuracy with the least energy.
"""

import covocp as co

ocp = co.Problem(duration=10.0, name="lag, final variance at most 0.5")
x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
b = ocp.unknown("b", mean=1.0, variance=5.0)
u = ocp.control("u", lower=-1.5, upper=1.5)
ocp.dynamics(x, -b * x + u, noise=1.0)
ocp.measurement("position", x, noise=1.0)
E = ocp.estimation_covariance()
ocp.subject_to(E[b, b], upper=0.5, at="final", name="accuracy of b")
ocp.minimize(running=0.5 * u**2)

solution = co.solve(ocp)
print(f"energy {solution.cost:.5f}, final variance of b {solution[E[b, b]][-1]:.6f}")
print(f"one unit less variance would cost {solution.multiplier('accuracy of b'):.3f} more (its multiplier)")
solution.plot(path="final_variance.png")
