"""A solver in C that plans again and again
========================================

From where the lag is, for the time that is left, with what is known: the plan identifies the time constant. Each
second C is given the state, the covariance of the estimate and the remaining time, starts from the plan before, and
returns a new one.
"""

import subprocess
import tempfile
from pathlib import Path

import covocp as co
from covocp.models import unknown_lag

LOOP = """\
#include "lag_planner.h"
#include <stdio.h>

int main(void)
{
    static lag_planner_workspace workspace;
    lag_planner_real t[LAG_PLANNER_SOLVE_TIME], u[LAG_PLANNER_SOLVE_U], x[LAG_PLANNER_SOLVE_X];
    lag_planner_real variables[LAG_PLANNER_SOLVE_VARIABLES], cost, infeasibility, stationarity;
    lag_planner_real E[4] = {1.0, 0.0, 0.0, 5.0};   /* of x and b, at the start */
    lag_planner_real state = 0.0, left = 10.0;
    const lag_planner_real b = 1.1, weight = 10.0, *guess = NULL;
    int k, status;
    for (k = 0; k < 6; ++k) {
        status = lag_planner_solve(&workspace, state, E, weight, b, left, guess, t, u, x, &cost, &infeasibility,
            &stationarity, variables);
        printf("%d s: x = %6.3f, status %d, cost %8.5f, slope left %.0e, first control %7.4f\\n",
            k, state, status, cost, stationarity, u[0]);
        guess = variables;
        state += -b * state + u[0];              /* a second later, roughly */
        E[3] = 5.0 - 0.4 * (k + 1);              /* and a little more is known of b */
        left -= 1.0;
    }
    return status;
}
"""

problem = unknown_lag.problem(weight=10.0)
package = co.export_c(problem, Path(tempfile.mkdtemp()) / "lag_planner", intervals=20)
print(package.check())
solution = co.solve(problem, intervals=20, progress=False)
plan = package.python()()  # no arguments: those of the export
print(f"cost in C {plan['cost']:.10f}, by Ipopt {solution.cost:.10f}")

folder = package.directory.parent  # beside the package, whose folder holds what the export writes
(folder / "loop.c").write_text(LOOP, encoding="utf-8")
sources = ["loop.c", "lag_planner/lag_planner.c", "lag_planner/lag_planner_casadi.c"]
flags = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-O1", "-Ilag_planner"]
command = ["cc", *flags, *sources, "-lm", "-o", "loop"]
subprocess.run(command, cwd=folder, check=True)
print(subprocess.run(["./loop"], cwd=folder, check=True, capture_output=True, text=True).stdout, end="")
time = package.time()["solve"]
print(f"a plan takes {time.c / 1e6:.1f} ms in C, {time.virtual_machine / 1e6:.1f} ms in CasADi")
