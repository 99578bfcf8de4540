"""Fly a design against another truth
==================================

What if the actual system is not what the design was made for? A second problem states the truth.
"""

# %%
# The design
# ----------

import covocp as co


def lag(mean=1.0, process=1.0, measurement=1.0):
    """A lag in closed loop with a mean of its unknown constant and two noise densities."""
    ocp = co.Problem(duration=10.0, name="lag")
    x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
    b = ocp.unknown("b", mean=mean, variance=0.05)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=process)
    ocp.measurement("position", x, noise=measurement)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0})
    return ocp


design = co.solve(lag())

# %%
# Other statistics, to first order
# --------------------------------
#
# `evaluate` keeps nominal and gains, and propagates the covariances of the truth. Then estimate and error are
# correlated: Z is no longer zero.

truth = lag(process=2.0, measurement=0.5)
expected = co.evaluate(design, truth=truth)
print(f"expected cost {expected.cost:.4f}, designed for {design.cost:.4f}")
print(f"variance of x at the end {expected.loop.X[-1, 0, 0]:.4f}, Z {expected.loop.Z[-1, 0, 0]:.4f}")

# %%
# Monte Carlo
# -----------
#
# `simulate` runs the actual nonlinear system of the truth with filter and feedback of the design. The prediction is
# that of the truth, so it says whether the first order is enough.

runs = co.simulate(design, runs=1000, seed=1, truth=truth, progress=False)
print(runs)
runs.plot(path="runs.png")

# %%
# Other dynamics
# --------------
#
# The truth may have another mean of the unknown, or other rates; only its symbols must be those of the design.

slower = co.simulate(design, runs=1000, seed=1, truth=lag(mean=0.7), progress=False)
print(slower.verdict)
print(f"mean cost {slower.cost:.4f}, expected by the design {design.cost:.4f}")
