"""First an experiment, then the way
=================================

An experiment of free duration learns the constant of a lag with a good sensor. Then the lag is steered with a poor one,
and its filter goes on with what the experiment taught, correlations included.
"""

import covocp as co

experiment = co.Problem(duration=co.Free(guess=3.0, lower=0.5, upper=20.0), name="experiment")
x = experiment.state("x", initial=0.0, variance=1.0)
b = experiment.unknown("b", mean=1.0, variance=5.0)
u = experiment.control("u", lower=-3.0, upper=3.0)
experiment.dynamics(x, -b * x + u, noise=0.05)
experiment.measurement("good sensor", x, noise=0.05)
E = experiment.estimation_covariance()
experiment.minimize(running=0.1 * u**2, terminal=0.3 * experiment.duration)

steering = co.Problem(duration=4.0, name="steering")
y = steering.state("x", initial=None, final=2.0)
c = steering.unknown("b", mean=1.0, variance=5.0)
w = steering.control("u", lower=-3.0, upper=3.0)
steering.dynamics(y, -c * y + w, noise=0.05)
steering.measurement("poor sensor", y, noise=1.0)
F = steering.estimation_covariance()
steering.minimize(running=0.1 * w**2, terminal=10.0 * F[y, y])

phases = co.Phases([experiment, steering], name="experiment, then steering")
solution = co.solve(phases, intervals=50)
print(solution)
learnt = solution["experiment"].deviation("b")
print(f"\nthe experiment takes {solution.durations[0]:.3f} s and brings b from {learnt[0]:.3f} to {learnt[-1]:.3f}")
print(f"deviation of x at the end: {solution['steering'].deviation('x')[-1]:.4f}")
solution.plot(path="experiment_then_steering.png")
