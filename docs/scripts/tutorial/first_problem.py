"""From a first problem to C code
==============================

Ten minutes, one system: a first-order lag whose time constant is not known. It is moved so that the constant is
learnt, then steered by feedback from its filter, simulated with all its noise, and written as C. What stands below a
step is what it printed when this page was built.
"""

# %%
# State the system
# ----------------
#
# A `Problem` collects what is known of the actual system, name by name; expressions are CasADi's. The state has a
# nominal start, a target, and the variance of its estimate at the start. The constant ``b`` is unknown: it has a mean
# and a variance, and is estimated together with the state. Noise is given by its power spectral density.

import shutil

import covocp as co


def lag(variance):
    """A lag dx/dt = -b x + u with its symbols; the cost is left open."""
    ocp = co.Problem(duration=10.0, name="lag with unknown time constant")
    x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=variance)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=1.0)
    return ocp, x, b, u


ocp, x, b, u = lag(variance=5.0)

# %%
# Solve it
# --------
#
# What is wanted first: little energy, and at the end a small variance of ``b``. The covariance of the filter's error
# is a symbol like any other, indexed by states and unknowns.

E = ocp.estimation_covariance()
ocp.minimize(running=0.5 * u**2, terminal=10.0 * E[b, b])

solution = co.solve(ocp, intervals=100)
print(solution)

# %%
# The printout begins with the cost by term and the values at the end. The residuals of the necessary conditions say
# how far the solution is from an optimum, and the two errors of the mesh what the discretisation costs. Where one of
# them is larger than usual, a sentence says what to do about it.
#
# Values at the nodes are had by symbol, by name, or by any expression of symbols.

print(f"{solution.t.size} nodes; u(0) = {solution[u][0]:.4f}, E_bb(T) = {solution[E[b, b]][-1]:.4f}")
deviation = solution.deviation(b)
print(f"standard deviation of b: {deviation[0]:.3f} at the start, {deviation[-1]:.3f} at the end")

# %%
# See it
# ------
#
# Each state with its standard deviation, the control, and the unknown. ``path`` writes a file; in a notebook the
# figure shows itself.

solution.plot(path="solution.png")

# %%
# The control first pushes, so that ``b`` shows in the measurements, then brings the state to its target.
#
# Compare and certify
# -------------------
#
# A second method, of first order and without an NLP solver, solves the same problem. Agreement of two methods that
# share only the statement is a check of both.

print(co.compare(ocp, methods=["ipopt", "gradient"], intervals=100))

# %%
# Both find a local minimum. For a system that is linear in states and controls, with unknown constants, `certify` can
# prove more.

print(co.certify(solution))

# %%
# Close the loop
# --------------
#
# So far the control was a function of time. Now the lag is flown by feedback from its filter, and nominal, filter and
# feedback are chosen together. The cost is the *expected* cost of the actual system; ``terminal_weight`` says what it
# costs to miss the target. Nothing else changes in the statement.

loop, x, b, u = lag(variance=5.0)
loop.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0})

print(co.worth(loop))

# %%
# `worth` estimates beforehand what a combined design gains over the classical one, whose nominal comes from the
# deterministic cost. Both designs:

combined = co.solve(loop)
classical = co.solve(loop, nominal="deterministic")
print(f"expected cost: combined {combined.cost:.4f}, classical {classical.cost:.4f}")

combined.plot(gains=True, path="combined.png")

# %%
# Simulate it
# -----------
#
# These covariances are predictions to first order. `simulate` runs the actual nonlinear system, with its noises, its
# filter and its feedback, and says whether the prediction holds.

runs = co.simulate(combined, runs=500, seed=1, progress=False)
print(runs.verdict)

# %%
# Here it does not hold, and must not: ``b`` has the variance 5 about 1, so a third of the actual lags is unstable,
# and no linear feedback that was designed for the mean holds them. With a smaller variance of ``b`` the prediction is
# right (and there is little left to gain over the classical design):

near, x, b, u = lag(variance=0.05)
near.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0})
print(co.worth(near))

# %%
design = co.solve(near)
runs = co.simulate(design, runs=1000, seed=1, progress=False)
print(runs)
runs.plot(path="runs.png")

# %%
# Write it as C
# -------------
#
# `export_c` writes nominal, gains, filter and feedback law as C99 without dynamic memory: one step for each sample.

package = co.export_c(design, "lag_c", period=0.05)
print(", ".join(sorted(path.name for path in package.directory.iterdir())))

# %%
# Where there is a C compiler, ``check`` builds the package and compares it with Python at random points, at the ends
# of the time and beyond, and with readings that are missing. ``python()`` loads what was compiled, so that the C code
# itself can fly the simulated system.

if shutil.which("cc"):
    print(package.check())
    print(co.simulate(design, runs=200, seed=1, law=package.python(), period=0.05, progress=False))
else:
    print("no C compiler here")

# %%
# Go on
# -----
#
# - :doc:`/howto/index`: one question a page.
# - :doc:`/gallery/index`: longer examples.
# - :doc:`/closed_loop` and :doc:`/numerics`: what is computed, and how.
# - :doc:`/api`: every name and option.
