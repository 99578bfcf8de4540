"""Indirect adaptive control
=========================

Least squares learns the plant while a regulator designed for the estimate controls it::

    y+ = a1 y + a2 y- + b u + noise

The law knows neither a1, a2 nor b, and at sample 150 they change. Each sample: least squares with forgetting, then
`riccati.lqr` for the estimate as if it were the truth (certainty equivalence). The regulator leaves little to learn
from, so the estimates drift; they stay where they give nearly the best gain.
"""

import matplotlib.pyplot as plt
import numpy as np

from covocp import ProblemError
from covocp.blocks import kalman, riccati

SAMPLES, CHANGE, NOISE = 300, 150, 0.05
PLANTS = np.array(
    [[1.8, -0.7, 0.5], [1.4, -0.9, -0.4]]
)  # a1, a2, b: unstable, then oscillating with the sign of b changed
WEIGHT, CONTROL_WEIGHT = np.diag([1.0, 0.0]), 0.1


def regulator(plant):
    """Gain of u = -K (y, y-) for a1, a2, b."""
    A = np.array([[plant[0], plant[1]], [1.0, 0.0]])
    return riccati.lqr(A, np.array([plant[2], 0.0]), WEIGHT, CONTROL_WEIGHT, discrete=True).gain.ravel()


def run(design, forgetting=0.95):
    """Costs, estimates and outputs of all samples; where `design(k, estimate)` is None, the control is a random one."""
    generator = np.random.default_rng(1)
    y, before = 1.0, 1.0
    estimate, covariance = kalman.diffuse_start(3, 100.0)
    costs, estimates, outputs = [], [], []
    for k in range(SAMPLES):
        gain = design(k, estimate)
        u = generator.standard_normal() if gain is None else float(-gain @ [y, before])
        plant = PLANTS[int(k >= CHANGE)]
        regressor = np.array([y, before, u])
        following = float(plant @ regressor) + NOISE * generator.standard_normal()
        estimate, covariance = kalman.recursive_least_squares(
            estimate, covariance, regressor, following, forgetting=forgetting
        )
        costs.append(y**2 + CONTROL_WEIGHT * u**2)
        y, before = following, y
        estimates.append(estimate)
        outputs.append(y)
    return np.array(costs), np.array(estimates), np.array(outputs)


def adaptive(k, estimate):
    try:
        return regulator(estimate)
    except ProblemError:  # an estimate that no control can stabilise, such as the first one, b = 0
        return None


known = [regulator(plant) for plant in PLANTS]
costs, estimates, outputs = run(adaptive)
ideal_costs, _, ideal_outputs = run(lambda k, _: known[int(k >= CHANGE)])
for name, when in (("before the change", slice(100, CHANGE)), ("at the end", slice(SAMPLES - 50, SAMPLES))):
    plant = PLANTS[int(when.start >= CHANGE)]
    print(f"{name:18s} largest error of the estimates {np.abs(estimates[when.stop - 1] - plant).max():.3f}", end="   ")
    print(f"cost a sample {costs[when].mean():.5f}, with the plant known {ideal_costs[when].mean():.5f}")
largest, ideal = (np.abs(history[CHANGE:]).max() for history in (outputs, ideal_outputs))
print(f"largest |y| after the change: {largest:.2f}, with the plant known {ideal:.2f}")

figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(7, 5), layout="constrained")
above.plot(outputs, label="adaptive")
above.plot(ideal_outputs, label="plant known", linewidth=1)
above.set(ylabel="y", title="regulator for the estimated plant")
above.legend()
truth = PLANTS[(np.arange(SAMPLES) >= CHANGE).astype(int)]
for column, label in enumerate(("a1", "a2", "b")):
    (line,) = below.plot(estimates[:, column], label=label)
    below.plot(truth[:, column], ":", color=line.get_color())
below.set(xlabel="sample", ylim=(-1.5, 3.7), ylabel="estimate (dotted: truth)")
below.legend(ncols=3)
figure.savefig("adaptive_regulator.png", dpi=120)
