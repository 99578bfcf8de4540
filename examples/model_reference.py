"""Model-reference adaptation
==========================

The gains follow the error to a model, and the unknown plant is never identified::

    dx/dt = a x + b u,   dxm/dt = -am xm + am r,   u = kx x + kr r

with a and the size of b unknown to the law::

    dkx/dt = -g x e sgn b,   dkr/dt = -g r e sgn b,   e = x - xm

With V = e^2 + abs(b) (dkx^2 + dkr^2) / g, dV/dt = -2 am e^2; two frequencies in x and r make the gains converge.
"""

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

a, b, am, g = 1.0, 3.0, 4.0, 2.0
ideal = np.array([-(a + am) / b, am / b])

state, reference = ca.SX.sym("state", 4), ca.SX.sym("r")
x, xm, kx, kr = ca.vertsplit(state)
error = x - xm
law = ca.Function("law", [state, reference], [kx * x + kr * reference])
loop = ca.Function(
    "loop",
    [state, reference],
    [
        ca.vertcat(
            a * x + b * law(state, reference),
            -am * xm + am * reference,
            -g * x * error * np.sign(b),
            -g * reference * error * np.sign(b),
        )
    ],
)
t = np.linspace(0.0, 20.0, 801)
run = solve_ivp(
    lambda t, z: loop(z, 4 * np.sin(3 * t)).full().ravel(), (0.0, 20.0), np.zeros(4), t_eval=t, rtol=1e-9, atol=1e-10
)
print(f"kx(20) = {run.y[2, -1]:.5f}   ideal {ideal[0]:.5f}")
print(f"kr(20) = {run.y[3, -1]:.5f}    ideal {ideal[1]:.5f}")
tracking = run.y[0] - run.y[1]
print(f"largest error to the model: {np.abs(tracking).max():.3f}, in the last 2 s {np.abs(tracking[t > 18]).max():.1e}")

figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(7, 5), layout="constrained")
above.plot(t, run.y[1], "k--", label="model")
above.plot(t, run.y[0], label="plant")
above.set(ylabel="x", ylim=(-4.5, 6.5), title="model-reference adaptation")
above.legend(loc="upper right", ncols=2)
for gain, limit, label in zip(run.y[2:], ideal, ("kx", "kr"), strict=True):
    (line,) = below.plot(t, gain, label=label)
    below.axhline(limit, color=line.get_color(), linestyle=":")
below.set(xlabel="t [s]", ylabel="gain (dotted: ideal)")
below.legend(loc="center right")
figure.savefig("model_reference.png", dpi=120)
