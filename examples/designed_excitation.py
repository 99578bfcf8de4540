"""Excitation that is designed
===========================

How to move so that the Hessian and the gradient of an unknown function are best known: a path of the length and time of
a circle.
"""

from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np

import covocp as co
from covocp.models import designed_excitation as model

options = {"substeps": 2, "progress": False}
problem = model.problem()  # from rest at the command and back, 4.4 m in 120 s
circling = model.circling()
circle = co.evaluate(model.problem(begin=circling["begin"]), nominal=circling["nominal"])
there_and_back = co.solve(problem, intervals=60, **options)
inside = co.solve(model.problem(ends="free", reach=model.RADIUS), intervals=40, **options)
anywhere = co.solve(model.problem(ends="free"), guess=inside, intervals=40, **options)
print(f"circle by evaluate: {circle.cost:.3f} counts^2")

print("\nfrom other random starts, 40 intervals:")
for seed in (2, 5, 12):
    again = co.solve(problem, guess=model.start(2, seed), intervals=40, **options)
    print(f"  start {seed}: {again.cost:.4f}")

shorter = model.RADIUS * np.pi / (np.pi + 1.0)  # so that the way out and back is in the same length
paths = {
    "circle": model.classical(),
    "circle, out and back": model.circle_and_back(shorter),
    "designed, from rest and back": model.path(there_and_back),
    "designed, within the circle": model.path(inside),
    "designed, anywhere": model.path(anywhere),
}
flights = {name: model.fly(path, runs=4000, seed=1) for name, path in paths.items()}
print("\ntrace of the covariance of (M r^2, b r) [counts^2], r = 0.7 m")
print(
    "                              length  farthest  continuous  10 s means: predicted, measured     seeker: measured"
)
for name, path in paths.items():
    found, far = flights[name], np.linalg.norm(path.position, axis=1).max()
    (mean, error), (sought, spread) = found.measured("once"), found.measured("seeker")
    exact, predicted = np.trace(found.continuous), np.trace(found.once_covariance)
    print(
        f"{name:<29} {path.length:5.2f} m {far:6.2f} m {exact:10.2f} {predicted:14.2f}, {mean:5.2f} +- {error:.2f}"
        f" {sought:18.2f} +- {spread:.2f}"
    )
    print(f"  M11, M22, M12, b1, b2: {np.round(np.sqrt(np.diag(found.continuous)), 2)} counts, standard deviations")

print("\none input, 2.8 m in 120 s:")
sine = model.classical(1)
line = co.solve(model.problem(1), intervals=60, **options)
stroke = model.start(1, 3)  # the default guess ends in a local optimum here, 1.55
near = co.solve(model.problem(1, ends="free", reach=model.RADIUS), guess=stroke, intervals=40, **options)
lines = {"sine": sine, "designed, from rest and back": model.path(line), "designed, within the sine": model.path(near)}
for name, path in lines.items():
    found = model.fly(path, runs=4000, seed=1)
    mean, error = found.measured("once")
    exact, predicted = np.trace(found.continuous), np.trace(found.once_covariance)
    print(f"{name:<29} continuous {exact:.3f}, predicted {predicted:.3f}, measured {mean:.3f} +- {error:.3f}")

figure, (plan, history, errors) = plt.subplots(1, 3, figsize=(14, 4.8), layout="constrained")
for k, (name, path) in enumerate(paths.items()):
    plan.plot(*path.position.T, color=f"C{k}", label=name)
    plan.plot(*path.position[0], "o", color=f"C{k}")
    spread = np.sqrt(np.trace(model.covariance(path), axis1=1, axis2=2))
    history.semilogy(path.t, spread, color=f"C{k}")
plan.set(
    xlabel="first input from the command [m]", ylabel="second input [m]", aspect="equal", title="paths, from the dots"
)
history.set(xlabel="t [s]", ylabel="root of the trace [counts]", title="what is not known of (M r², b r)")
places = np.arange(len(paths))
for shift, label, values in (
    (-0.2, "predicted, 10 s means", [np.trace(found.once_covariance) for found in flights.values()]),
    (0.2, "measured, 4000 functions", [found.measured()[0] for found in flights.values()]),
):
    errors.bar(places + shift, values, 0.4, label=label, color="0.3" if shift < 0 else "0.7")
bars = [3.0 * found.measured()[1] for found in flights.values()]
errors.errorbar(places + 0.2, [found.measured()[0] for found in flights.values()], bars, fmt="none", color="k")
errors.set_xticks(places, [fill(name, 12) for name in paths], fontsize="x-small")
errors.set(ylabel="mean square error [counts²]", title="the filter flown (bars: 3 standard errors)")
figure.legend(*plan.get_legend_handles_labels(), loc="outside lower left", ncols=5, fontsize="small")
errors.legend(fontsize="small")
history.grid(alpha=0.3)
figure.savefig("designed_excitation.png", dpi=120)
