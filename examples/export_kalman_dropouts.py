"""A Kalman filter with missing readings as C
==========================================

Predict and update of a point that moves, one reading in three lost.
"""

import tempfile
from pathlib import Path

import casadi as ca
import numpy as np

import covocp as co
from covocp.blocks import kalman

STEP, LOST = 0.1, 1 / 3
TRANSITION = np.array([[1.0, STEP], [0.0, 1.0]])
NOISE = 0.5 * np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]])  # of an acceleration
H, R = np.array([[1.0, 0.0], [0.0, 1.0]]), np.diag([0.2, 1.0])

x, P, y = ca.SX.sym("x", 2), ca.SX.sym("P", 2, 2), ca.SX.sym("y", 2)
predict = ca.Function(
    "predict", [x, P], kalman.predict(x, P, TRANSITION, NOISE), ["x", "P"], ["estimate", "covariance"]
)
update = ca.Function(
    "update", [x, P, y], kalman.update(x, P, y, H, R, missing="skip"), ["x", "P", "y"], ["estimate", "covariance"]
)
package = co.export_c(
    [predict, update],
    Path(tempfile.mkdtemp()) / "tracker",
    units={"x": "m, m/s", "P": "squares of these", "y": "m, m/s"},
)
print(package.check())

random = np.random.default_rng(5)
laws = package.python()
truth, estimate, covariance = np.zeros(2), np.zeros(2), 10.0 * np.eye(2)
other, spread = estimate.copy(), covariance.copy()
errors, gap = [], 0.0
for _ in range(1000):
    truth = TRANSITION @ truth + np.linalg.cholesky(NOISE) @ random.normal(size=2)
    reading = truth + np.sqrt(np.diag(R)) * random.normal(size=2)
    reading[random.uniform(size=2) < LOST] = np.nan
    estimate, covariance = laws.update(*laws.predict(estimate, covariance), reading)
    moved = kalman.predict(other, spread, TRANSITION, NOISE)
    other, spread = kalman.update(*moved, reading, H, R, missing="skip")
    errors.append(estimate - truth)
    gap = max(gap, float(np.abs(estimate - other).max()))
rms = np.sqrt(np.mean(np.square(errors), axis=0))
print(f"1000 cycles, a third of the readings lost: C and numpy differ by {gap:.1e}")
print(
    f"rms error {rms[0]:.3f} m, {rms[1]:.3f} m/s; the filter expects {np.sqrt(covariance[0, 0]):.3f} m after the last"
)
