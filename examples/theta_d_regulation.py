"""Agile aircraft: regulation by θ-D
=================================

Back from 30 deg of angle of attack by θ-D and its filter (Xin and Balakrishnan 2009, figures 1 to 4).

Weights in both readings of the paper's units. First the cost of laws that know the state, over the true optimum by
Ipopt; then the loop with a filter that starts 5 deg off, and the extended Kalman filter beside it.
"""

import warnings

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import covocp as co
from covocp.blocks import sdre, theta_d
from covocp.models import agile_aircraft
from covocp.simulation.laws import extended_filter, gain_filter, simulate_law

# The optimum is a yardstick here: its controls are not flown alone.
warnings.filterwarnings("ignore", message="The plant is unstable")

x, u = ca.SX.sym("x", 5), ca.SX.sym("u")
A0, bilinear, B, H = agile_aircraft.matrices()
A = x[1] * ca.DM(bilinear)
plant = ca.Function("plant", [x, u], [(ca.DM(A0) + A) @ x + ca.DM(B) @ u])
PAPER = {"k": agile_aircraft.FACTOR, "l": agile_aircraft.DECAY}


def optimum(units):
    """The optimal control problem by multiple shooting, on a grid that is fine where the canard moves."""
    grid = np.linspace(0, 1, 201) ** 2
    return co.solve(agile_aircraft.problem(units), intervals=200, grid=grid, progress=False)


def costs(units, scenario, optimal):
    """Cost of laws that know the state over the optimal one."""
    arguments = x, A0, A, B, scenario.Q, scenario.R
    laws = {
        "linear regulator": theta_d.regulator(*arguments, terms=1),
        "θ-D, k = 1": theta_d.regulator(*arguments, **PAPER),
    }
    for terms in (2, 3, 4):
        laws[f"θ-D, k = 0, {terms} terms"] = theta_d.regulator(*arguments, terms=terms)
    laws["Riccati at every state"] = sdre.regulator(*arguments)
    running = ca.Function("running", [x, u], [0.5 * (ca.bilin(ca.DM(scenario.Q), x, x) + scenario.R * u**2)])
    final = theta_d.expansion(*arguments, terms=1).riccati
    for name, law in laws.items():
        run = simulate_law(plant, law, initial=scenario.start, duration=40.0, running=running, samples=2)
        print(f"  {name:24s}{(run.cost[-1] + 0.5 * run.x[-1] @ final @ run.x[-1]) / optimal:8.4f}")
    radius = np.degrees(theta_d.radius(A0, bilinear, B, scenario.Q, scenario.R))
    print(f"  (the series converges up to {radius:.1f} deg)")


def loops(scenario):
    """θ-D law with the θ-D filter, its printed form, and the extended Kalman filter."""
    law = theta_d.regulator(x, A0, A, B, scenario.Q, scenario.R, **PAPER)
    arguments = x, A0, A, H, scenario.W, scenario.V
    observers = {
        "θ-D filter": gain_filter(plant, theta_d.filter_gain(*arguments, **PAPER), H, scenario.estimate),
        "as printed": gain_filter(plant, theta_d.filter_gain(*arguments, **PAPER, printed=True), H, scenario.estimate),
        "extended Kalman": extended_filter(plant, H, scenario.W, scenario.V, scenario.estimate, scenario.W),
    }
    options = {"initial": scenario.start, "duration": 20.0, "samples": 2001}
    return {name: simulate_law(plant, law, observer=observer, **options) for name, observer in observers.items()}


def report(runs):
    """What the paper says of its figures, in numbers."""
    for name, run in runs.items():
        errors = np.degrees(np.abs(run.filter_state[:, :5] - run.x)[:, [1, 3]]).max(axis=1)
        converged = run.t[np.flatnonzero(errors > 0.1)[-1]]
        settled = run.t[np.flatnonzero(np.abs(run.x[:, 1]) > np.radians(1.5))[-1]]
        print(
            f"  {name:16s} estimates to 0.1 deg after {converged:.2f} s, attack to 1.5 deg after {settled:5.2f} s,"
            f" overshoot {np.degrees(run.x[:, 1].min()):.2f} deg, canard {run.x[:, 4].min():.1f} deg"
        )


def draw(column, units, runs, solution):
    run = runs["θ-D filter"]
    other = runs["extended Kalman"]
    attack, rates, canard, errors = column
    attack.plot(run.t, np.degrees(run.x[:, 1]), label="θ-D")
    attack.plot(run.t, np.degrees(run.filter_state[:, 1]), "--", label="its estimate")
    attack.plot(solution.t, np.degrees(solution["alpha"]), "k:", label="optimum, state known")
    attack.set(title=f"angles weighted in {units}", ylabel="angle of attack [deg]")
    rates.plot(run.t, np.degrees(run.x[:, 2]), label="pitch rate [deg/s]")
    rates.plot(run.t, np.degrees(run.x[:, 3]), label="path angle [deg]")
    rates.set(ylabel="pitch rate, path angle")
    canard.plot(run.t, run.x[:, 4], label="θ-D")
    canard.plot(solution.t, solution["canard"], "k:", label="optimum, state known")
    canard.set(ylabel="canard [deg]")
    for name, one in (("θ-D filter", run), ("extended Kalman filter", other)):
        errors.plot(one.t, np.degrees(one.filter_state[:, 1] - one.x[:, 1]), label=name)
    errors.set(ylabel="error of the estimated\nangle of attack [deg]", xlabel="t [s]")
    for axes in column:
        axes.set_xlim(0, 15)
        axes.legend()
        axes.grid(alpha=0.3)


figure, panels = plt.subplots(4, 2, figsize=(10, 11), sharex=True, layout="constrained")
for column, units in zip(panels.T, ("rad", "deg"), strict=True):
    scenario = agile_aircraft.regulation(units)
    best = optimum(units)
    print(f"angles weighted in {units}: optimal cost {best.cost:.1f}, cost of the laws over it")
    costs(units, scenario, best.cost)
    results = loops(scenario)
    report(results)
    draw(column, units, results, best)
figure.savefig("theta_d_regulation.png", dpi=120)
print("As published: quick estimates, no large overshoot, moderate canard, filters much alike.")
