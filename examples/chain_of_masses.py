"""A covariance of 78 entries
==========================

Five masses in a row: stiffness and damping are identified by pushing the first.
"""

import covocp as co
from covocp.models import mass_chain

solution = co.solve(mass_chain.problem(masses=5), intervals=100)
print(f"J = {solution.cost:.6f} in {solution.stats['iterations']} iterations")
for name in ("k", "d"):
    sigma = solution.deviation(name)
    print(f"standard deviation of {name}: {sigma[0]:.4f} at the start, {sigma[-1]:.4f} at the end")
solution.plot("y", "k", "d", "u", path="chain_of_masses.png")
