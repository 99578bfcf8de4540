"""When to stop identifying
========================

Time costs something too, so the terminal time is free.
"""

import covocp as co
from covocp.models import free_time_integrator, unknown_lag

for weight in (0.2, 1.0):
    solution = co.solve(free_time_integrator.problem(time_weight=weight))
    exact = free_time_integrator.exact(weight)
    print(f"integrator, time weight {weight}: T = {solution.duration:.8f} s (closed form {exact.duration:.8f} s)")

solution = co.solve(unknown_lag.problem(final=1.0, duration_weight=0.5))
print(f"lag: T = {solution.duration:.4f} s, transversality {solution.optimality.transversality:.1e}")
solution.plot(path="free_terminal_time.png")
