"""Gain scheduling
===============

Linear regulators of several operating points, interpolated by where the system is asked to be.

A pendulum on a cart, held leaning at an angle by the acceleration of the cart::

    d2 angle/dt2 = sin angle + u cos angle,   u = -tan angle at rest

The further it leans, the faster it falls and the less the cart can do about it.
"""

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

from covocp.blocks import riccati

x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
rate = ca.vertcat(x[1], ca.sin(x[0]) + u * ca.cos(x[0]))
plant = ca.Function("plant", [x, u], [rate])
slopes = ca.Function("slopes", [x, u], [ca.jacobian(rate, x), ca.jacobian(rate, u)])

points = np.radians([0.0, 15.0, 30.0, 45.0, 55.0, 65.0, 70.0])
designs = [
    riccati.lqr(*(slope.full() for slope in slopes([angle, 0.0], -np.tan(angle))), np.eye(2), 1.0) for angle in points
]
gains = np.array([design.gain.ravel() for design in designs])
table = [ca.interpolant(f"k{i}", "linear", [points], gains[:, i]) for i in range(2)]


def scheduled(angle):
    return np.array([float(entry(abs(angle))) for entry in table])


def reference(t):
    """Lean from 0 to 65 degrees in 20 s."""
    return np.radians(65.0) * np.clip(t / 20.0, 0.0, 1.0)


def run(gain_at):
    def loop(t, state):
        angle = reference(t)
        deviation = state - [angle, np.radians(65.0) / 20.0 if t < 20.0 else 0.0]
        return plant(state, -np.tan(angle) - gain_at(angle) @ deviation).full().ravel()

    fallen = lambda t, state: abs(state[0]) - np.pi / 2  # noqa: E731
    fallen.terminal = True
    return solve_ivp(loop, (0.0, 30.0), [0.05, 0.0], rtol=1e-7, atol=1e-9, max_step=0.05, events=fallen)


runs = {"scheduled gains": run(scheduled), "gains of the upright point": run(lambda _: gains[0])}
for angle, design in zip(points, designs, strict=True):
    A, B = (slope.full() for slope in slopes([angle, 0.0], -np.tan(angle)))
    fixed = np.linalg.eigvals(A - B @ gains[:1]).real.max()
    print(
        f"{np.degrees(angle):3.0f} deg   K = {design.gain[0, 0]:7.4f} {design.gain[0, 1]:7.4f}   slowest mode "
        f"{design.eigenvalues.real.max():7.4f} 1/s, with the gains of 0 deg {fixed:7.4f} 1/s"
    )
for name, result in runs.items():
    end = f"falls at {result.t[-1]:.1f} s" if result.status == 1 else f"ends at {np.degrees(result.y[0, -1]):.3f} deg"
    print(f"{name}: {end}")

figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
axes.plot(t := np.linspace(0, 30, 200), np.degrees(reference(t)), "k--", label="reference")
for name, result in runs.items():
    axes.plot(result.t, np.degrees(result.y[0]), label=name)
axes.set(xlabel="t [s]", ylabel="angle [deg]", title="leaning pendulum: gain scheduling")
axes.legend()
figure.savefig("gain_scheduling.png", dpi=120)
