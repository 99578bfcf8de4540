"""Agile aircraft: tracking by θ-D
===============================

Path angle 0, 45, 0 deg by the θ-D servo and its filter (Xin and Balakrishnan 2009, figures 5 to 7).

Weights in both readings of the paper's units; only degrees track as published. Then the extended Kalman filter, the
variant whose speed derivatives depend on the angle of attack too, where the θ-D filter diverges, and runs with noise.
"""

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

from covocp import ProblemError
from covocp.blocks import sdre, theta_d
from covocp.models import agile_aircraft
from covocp.simulation.laws import extended_filter, gain_filter, simulate_law

PATH = [0.0, 0.0, 0.0, 1.0, 0.0]
PAPER = {"k": agile_aircraft.FACTOR, "l": agile_aircraft.DECAY}
x, u, t = ca.SX.sym("x", 5), ca.SX.sym("u"), ca.SX.sym("t")


def loop(units, speed_column=False):
    """Plant, servo law and filters."""
    A0, bilinear, B, H = agile_aircraft.matrices(speed_column)
    A = x[1] * ca.DM(bilinear)
    scenario = agile_aircraft.tracking(units)
    plant = ca.Function("plant", [x, u], [(ca.DM(A0) + A) @ x + ca.DM(B) @ u])
    servo = theta_d.servo(x, A0, A, B, PATH, scenario.Q, scenario.R, **PAPER)
    angle, integral = agile_aircraft.path_command(t)
    whole = ca.SX.sym("whole", 6)  # estimate and the integral of the estimated path angle
    law = ca.Function("law", [whole, t], [servo(whole, t, ca.vertcat(0, 0, 0, angle, 0, integral))])
    arguments = x, A0, A, H, scenario.W, scenario.V
    start, W, V = scenario.estimate, scenario.W, scenario.V
    observers = {
        "θ-D filter": gain_filter(plant, theta_d.filter_gain(*arguments, **PAPER), H, start, integrate=PATH),
        "extended Kalman filter": extended_filter(plant, H, W, V, start, W, integrate=PATH),
    }
    return plant, law, observers


def run(plant, law, observer, **noise):
    options = {"duration": 30.0, "samples": 601, "breaks": (5.0, 15.0, 20.0)}
    return simulate_law(plant, law, initial=np.zeros(5), observer=observer, **options, **noise)


def riccati_servo(units):
    """The servo with the gain of the Riccati equation at every state, which knows the state."""
    A0, bilinear, B, _ = agile_aircraft.matrices()
    scenario = agile_aircraft.tracking(units)
    system = theta_d.integral_states(x, A0, x[1] * ca.DM(bilinear), B, PATH)
    solution = sdre.solution(*system, scenario.Q, scenario.R)
    gains = [(system[3].T @ solution([0, np.radians(a), 0, 0, 0, 0]) / scenario.R)[0, 5] for a in (1.5, 1.57)]
    print(f"  gain of the Riccati servo on the integral at 1.50 and 1.57 deg: {gains[0]:.3f}, {gains[1]:.3f}")

    def law(state, time):
        angle, integral = agile_aircraft.path_command(time)
        return -system[3].T @ solution(state) @ (state - [0, 0, 0, angle, 0, integral]) / scenario.R

    whole = ca.SX.sym("whole", 6)
    rate = (ca.DM(A0) + whole[1] * ca.DM(bilinear)) @ whole[:5] + ca.DM(B) @ u
    plant = ca.Function("plant", [whole, u], [ca.vertcat(rate, whole[3])])
    try:
        simulate_law(plant, law, initial=np.zeros(6), duration=30.0, breaks=(5.0, 15.0, 20.0))
    except ProblemError as error:
        print("  Riccati servo:", str(error).splitlines()[0])


command = np.degrees(agile_aircraft.path_command(np.linspace(0, 30, 601))[0])
figure, panels = plt.subplots(3, 2, figsize=(10, 9), sharex=True, layout="constrained")
track, speed, attack, canard, difference, stress = panels.ravel()
track.plot(np.linspace(0, 30, 601), command, "k:", label="command")
for units in ("rad", "deg"):
    print(f"angles weighted in {units}")
    plant, law, observers = loop(units)
    results = {name: run(plant, law, observer) for name, observer in observers.items()}
    for name, result in results.items():
        gamma = np.degrees(result.x[:, 3])
        rms = np.sqrt(np.mean((gamma - command) ** 2))
        print(
            f"  {name:22s} path angle at 14.9 s {gamma[298]:.1f} deg, rms error {rms:.1f} deg, "
            f"slowest {result.x[:, 0].min():.0f} m/s"
        )
    riccati_servo(units)
    result, other = results.values()
    track.plot(result.t, np.degrees(result.x[:, 3]), label=f"weights in {units}")
    speed.plot(result.t, result.x[:, 0], label=f"weights in {units}")
    attack.plot(result.t, np.degrees(result.x[:, 1]), label=f"weights in {units}")
    canard.plot(result.t, result.x[:, 4], label=f"weights in {units}")
    for name, one in results.items():
        difference.plot(one.t, np.degrees(one.filter_state[:, 3] - one.x[:, 3]), label=f"{name}, {units}")

print("with speed derivatives that depend on the angle of attack, weights in deg")
plant, law, observers = loop("deg", speed_column=True)
stress.plot(np.linspace(0, 30, 601), command, "k:", label="command")
for name, observer in observers.items():
    result = run(plant, law, observer)
    known = np.isfinite(result.x).all(axis=1)
    end = f"diverges at {result.t[known][-1]:.1f} s" if result.diverged else "stays bounded"
    print(f"  {name:22s} {end}")
    stress.plot(result.t[known], np.degrees(result.x[known, 3]), label=name)

plant, law, observers = loop("deg")
noise = {"runs": 200, "process_noise": np.diag([1e-2, 1e-6, 1e-6, 0.0, 0.0]), "measurement_noise": 1e-3, "seed": 1}
runs = run(plant, law, observers["θ-D filter"], **noise)
spread = np.degrees(runs.x[:, :, 3].std(axis=0))
print(f"200 runs with noise, weights in deg: path angle within {spread.max():.2f} deg (one sigma) of its mean")

labels = ("path angle [deg]", "speed [m/s], from trim", "angle of attack [deg], from trim", "canard [deg], from trim")
for axes, label in zip(panels.ravel(), (*labels, "error of the estimated\npath angle [deg]", ""), strict=True):
    axes.set(ylabel=label)
stress.set(ylabel="path angle [deg]", title="with a speed column", ylim=(-60, 90))
for axes in panels.ravel():
    axes.legend(loc="lower right" if axes is stress else "best")
    axes.grid(alpha=0.3)
for axes in panels[-1]:
    axes.set_xlabel("t [s]")
figure.savefig("theta_d_tracking.png", dpi=120)
print(
    "As published: the path angle follows (weights in deg). Not as published: the extended Kalman filter is no worse."
)
