"""Without covariances
===================

Then covocp is an ordinary optimal-control tool: three problems that everybody tries first.
"""

import covocp as co
from covocp.models import brachistochrone, bryson_denham, goddard_rocket

bryson = co.solve(bryson_denham.problem(), intervals=90)
print(f"Bryson-Denham: J = {bryson.cost:.6f} (optimum 4)")
print(f"  between the nodes the bound is exceeded by {max(bryson.check_path().values(), default=0.0):.1e}")
fall = co.solve(brachistochrone.problem())
print(f"brachistochrone: {fall.duration:.6f} s")
rocket = co.solve(goddard_rocket.problem(), intervals=200)
print(f"Goddard rocket: peak altitude {-rocket.cost:.5f} (published 1.01283)")
rocket.plot(path="plain_problems.png")
