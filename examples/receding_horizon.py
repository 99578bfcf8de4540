"""Planning again while learning
=============================

A lag whose rate b is unknown is brought from 2 m to 0, and b is to be known well. One plan for 8 s rests on what was
known at the start. Here every 0.25 s a plan is made for the next 4 s, from the estimate and the covariance of then:
`Solver.solve(initial=, means=, covariance=)` takes them as parameters of a problem that is built once, and starts from
what is left of the plan before (`guess=`, `elapsed=`). Most is learnt while x is large: at rest little tells of b.
"""

import matplotlib.pyplot as plt
import numpy as np

import covocp as co
from covocp.problem.filters import extended_filter

STEP, STEPS, HORIZON = 0.25, 32, 4.0
TRUE_RATE = 0.4  # 1/s
NOISE, ACCURACY = 0.01, 0.02  # power spectral densities of the process [m^2/s] and of the measurement [m^2 s]

ocp = co.Problem(HORIZON, "lag, planned again")
x = ocp.state("x", initial=2.0, variance=0.01, unit="m")
b = ocp.unknown("b", mean=1.0, variance=0.25, unit="1/s")
u = ocp.control("u", lower=-1.5, upper=1.5, unit="m/s")
ocp.dynamics(x, -b * x + u, noise=NOISE)
ocp.measurement("y", x, noise=ACCURACY)
E = ocp.estimation_covariance()
ocp.minimize(running=0.5 * x**2 + 0.1 * u**2, terminal=40.0 * E[b, b])

solver = co.Solver(ocp, "auto", intervals=32)
predict, update = extended_filter(ocp, step=STEP)
rng = np.random.default_rng(2)

actual, estimate, covariance = 2.0 + 0.1 * rng.standard_normal(), np.array([2.0, 1.0]), np.diag([0.01, 0.25])
plan, history = None, []
for k in range(STEPS + 1):
    history.append((k * STEP, actual, *estimate, np.sqrt(covariance[1, 1])))
    plan = solver.solve(
        initial={x: estimate[0]},
        means={b: estimate[1]},
        covariance=covariance,
        guess=plan,
        elapsed=None if plan is None else STEP,
        iteration_limit=50,
        assess=False,
        progress=False,
    )
    control = float(np.mean(plan.controls_at(np.linspace(0.0, STEP, 5))))
    for _ in range(25):  # the actual lag, whose rate nobody knows
        actual += STEP / 25 * (-TRUE_RATE * actual + control)
        actual += np.sqrt(NOISE * STEP / 25) * rng.standard_normal()
    reading = actual + np.sqrt(ACCURACY / STEP) * rng.standard_normal()
    moved = predict(estimate, covariance, control, 0.0)
    found = update(*moved, reading, control, 0.0)
    estimate, covariance = found[0].full().ravel(), found[1].full()

t, states, state_estimates, rates, deviations = np.array(history).T
print(f"{'t [s]':>5} {'x [m]':>7} {'estimate':>9} {'b [1/s]':>8} {'deviation':>10}")
for row in history[::4]:
    print(f"{row[0]:5.2f} {row[1]:7.3f} {row[2]:9.3f} {row[3]:8.3f} {row[4]:10.3f}")
print(f"The rate is {TRUE_RATE} 1/s; the last plan took {plan.stats['iterations']} iterations.")

figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(7, 5), layout="constrained")
above.plot(t, states, label="state")
above.plot(t, state_estimates, "--", label="estimate")
above.plot(t[-1] + plan.t, plan["x"], ":", label="last plan")
above.set_ylabel("x [m]")
above.legend()
below.plot(t, rates, label="estimate of b")
below.fill_between(t, rates - 2 * deviations, rates + 2 * deviations, alpha=0.2, label="two standard deviations")
below.axhline(TRUE_RATE, color="k", lw=0.8, label="actual rate")
below.set(xlabel="t [s]", ylabel="b [1/s]")
below.legend()
figure.savefig("receding_horizon.png", dpi=120)
