"""What the cases of closed_loop.py run in their processes, from the options of a case to its result."""

from __future__ import annotations

import importlib
import time
import warnings
from typing import Any

REFERENCE = 0.5  # constant lift-to-drag ratio along which the Monte Carlo runs fly


def covocp_solve(case: dict[str, Any]) -> dict[str, Any]:
    """Build the model and solve it from the guess of the script by hand, as a user waits for it.

    The user also waits for the closed loop along the solution and for the classical design that it is compared with.
    """
    import numpy as np
    import peers_loops

    import covocp as co
    from covocp.models import mars_entry, unknown_lag

    method = case.get("method", "ipopt")
    importlib.import_module(f"covocp.solvers.{method}")  # looked up by name when it is first asked for
    control = {"mars": "lift_to_drag", "lag": "u"}[case["system"]]
    loop = getattr(peers_loops, case["system"])()
    guess = loop.guess(np.linspace(0.0, loop.duration, case["intervals"] + 1))
    options = case.get("options", {})
    few = "max_iterations" in options  # their time is asked for, not where they end
    start = time.perf_counter()
    problem = mars_entry.problem() if case["system"] == "mars" else unknown_lag.steering()
    built = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # coarse meshes of a quick run
        solution = co.solve(
            problem,
            method,
            intervals=case["intervals"],
            guess={control: guess},
            progress=False,
            allow_failure=True,
            **options,
        )
    solved = time.perf_counter()
    stats = solution.stats
    if not solution.converged and not few:
        raise RuntimeError(f"not solved: {solution.message}")
    return {
        "cost": float(solution.cost),
        "iterations": int(stats["iterations"]),
        "status": str(solution.status),
        "iteration": stats["solve_seconds"] / max(1, int(stats["iterations"])),
        "build": built - start,
        "solve": solved - built,
    }


def by_hand(case: dict[str, Any]) -> dict[str, Any]:
    """Solve with the script by hand."""
    import peers_f3
    import peers_loops

    start = time.perf_counter()
    loop = getattr(peers_loops, case["system"])()
    stated = time.perf_counter()
    result = peers_f3.solve(loop, case["intervals"])
    if result["status"] != "Solve_Succeeded":
        raise RuntimeError(f"not solved: {result['status']}")
    result["build"] += stated - start
    return result


def covocp_simulate(case: dict[str, Any]) -> dict[str, Any]:
    """Evaluate constant lift (not timed), then simulate it."""
    import numpy as np

    import covocp as co
    from covocp.models import mars_entry

    simulate = co.simulate  # looked up by name when it is first asked for
    design = co.evaluate(mars_entry.problem(), nominal=mars_entry.reference(), intervals=case["intervals"])
    start = time.perf_counter()
    result = simulate(design, case["runs"], 1, step=case["step"], progress=False)
    seconds = time.perf_counter() - start
    rms = np.sqrt(np.mean(result.deviations**2, axis=0))
    predicted = np.sqrt(np.diagonal(result.predicted[-1]))
    return {"rms": rms.tolist(), "predicted": predicted.tolist(), "build": 0.0, "solve": seconds}


def loop_simulate(case: dict[str, Any]) -> dict[str, Any]:
    """The same by the plain numpy loop."""
    import peers_monte_carlo

    return peers_monte_carlo.simulate(case["runs"], case["step"], REFERENCE)
