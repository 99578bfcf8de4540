"""Tracking in a wind that was forecast
====================================

A drone follows a course between waypoints. The wind was forecast for each half second, the sensor is poor behind a
building: three tables over time. Feedback and feedforward are chosen together; then the drone meets another wind.
"""

import matplotlib.pyplot as plt
import numpy as np

import covocp as co

SECONDS = np.arange(0.0, 12.5, 0.5)
FORECAST = 0.8 * np.sin(2 * np.pi * SECONDS / 6.2)
BEHIND = [0.0, 5.0, 6.0, 12.0], [0.02, 0.02, 0.4, 0.4]


def drone(wind=FORECAST):
    """A drone that is to follow a course across the wind."""
    ocp = co.Problem(duration=12.0, name="tracking in the wind")
    air = ocp.data("wind", SECONDS, wind, kind="cubic", unit="m/s")
    course = ocp.data("course", [0.0, 3.0, 5.0, 9.0, 12.0], [0.0, 2.0, 2.0, -1.0, 0.0], unit="m")
    error = ocp.data("error", *BEHIND, unit="m^2 s")
    y = ocp.state("y", initial=0.0, variance=0.01, unit="m")
    v = ocp.state("v", initial=0.0, variance=0.01, unit="m/s")
    thrust = ocp.control("thrust", unit="m/s^2")
    ocp.dynamics(y, v + air)
    ocp.dynamics(v, thrust - v, noise=0.05)
    ocp.measurement("position", y, noise=error)
    ocp.minimize_expected(running=0.1 * thrust**2 + 10.0 * (y - course) ** 2)
    return ocp, y, course


ocp, y, course = drone()
solution = co.solve(ocp)
print(solution)

other, *_ = drone(0.9 * FORECAST + 0.2)
forecast = co.simulate(solution, 500, seed=1)
actual = co.simulate(solution, 500, seed=1, truth=other)
print(f"\nmean cost in the wind that was forecast {forecast.cost:.3f}, in the actual one {actual.cost:.3f}")

figure, axes = plt.subplots(2, 1, sharex=True, figsize=(8, 6), constrained_layout=True)
for runs, color, label in ((forecast, "C0", "in the forecast wind"), (actual, "C1", "in another one")):
    mean, spread = runs.mean(y), runs.deviation(y, about="mean")
    axes[0].fill_between(runs.t, mean - 2 * spread, mean + 2 * spread, color=color, alpha=0.3, lw=0)
    axes[0].plot(runs.t, mean, color=color, label=f"mean and two deviations, {label}")
axes[0].plot(solution.t, solution[course], "k--", label="course")
axes[0].set_ylabel("y [m]")
axes[0].legend(fontsize=8)
axes[1].plot(solution.t, solution["thrust"], label="thrust [m/s^2]")
axes[1].plot(SECONDS, FORECAST, "o-", ms=3, label="wind that was forecast [m/s]")
axes[1].set_xlabel("t [s]")
axes[1].legend(fontsize=8)
figure.savefig("tracking_in_the_wind.png", dpi=120)
