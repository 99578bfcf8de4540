"""Is the predicted spread the real one?
=====================================

Thousands of runs of the actual nonlinear systems, with noise and feedback.
"""

import numpy as np

import covocp as co
from covocp.models import mars_entry, unknown_lag

grid = 1 - (1 - np.linspace(0, 1, 81)) ** 2
print("lag with unknown time constant: mean square of x at the end, each variance of b with its own design")
for variance in (0.01, 0.1, 1.0, 5.0):
    design = co.solve(unknown_lag.steering(parameter_variance=variance), grid=grid)
    runs = co.simulate(design, runs=4000, seed=1, step=0.01)
    low, high = (band[-1] ** 2 for band in runs.deviation_band("x"))
    predicted, sample = runs.predicted_deviation("x")[-1] ** 2, runs.deviation("x")[-1] ** 2
    print(f"variance {variance:g}: predicted {predicted:.3f}, sample {sample:.3f} ({low:.3f} to {high:.3f}), ", end="")
    print(f"{100 * runs.share_beyond('x', 10.0):.0f} % of the runs end more than 10 away\n  {runs.verdict}")
    if variance == 0.01:
        runs.plot(path="monte_carlo_lag.png")

problem, unregularised = mars_entry.problem(), mars_entry.problem(regularization=None)
designs = {
    "constant lift-to-drag ratio": co.evaluate(problem, nominal=mars_entry.reference()),
    "regularised optimum": co.solve(problem),
    "bang-bang optimum": co.solve(unregularised, intervals=183, guess={"lift_to_drag": mars_entry.bang_bang}),
}
for name, design in designs.items():
    runs = co.simulate(design, runs=1000, seed=1, step=0.3)
    ratios = [runs.deviation(key)[-1] / runs.predicted_deviation(key)[-1] for key in ("h", "theta", "v", "gamma")]
    print(f"\nMars, {name}: sample over predicted deviation of altitude, range, velocity, path angle")
    print("  " + ", ".join(f"{ratio:.3f}" for ratio in ratios))
    print(f"  {runs.verdict}")
    if name == "regularised optimum":
        runs.plot("h", "theta", ("theta", "h"), ("v", "gamma"), path="monte_carlo_mars.png")
