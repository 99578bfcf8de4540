"""What the cases of core.py run in their processes, from the options of a case to its result."""

from __future__ import annotations

import importlib
import time
from typing import Any


def covocp_solve(case: dict[str, Any]) -> dict[str, Any]:
    """Build the model and solve it with default options, as a user waits for it."""
    import covocp as co
    from covocp.models import damped_oscillator, mass_chain

    importlib.import_module("covocp.solvers.ipopt")  # looked up by name when it is first asked for
    start = time.perf_counter()
    if case["system"] == "oscillator":
        problem = damped_oscillator.problem(damping_weight=1000.0, stiffness_weight=0.0)
    else:
        problem = mass_chain.problem(masses=case["masses"])
    built = time.perf_counter()
    solution = co.solve(problem, intervals=case["intervals"], progress=False)
    solved = time.perf_counter()
    stats = solution.stats
    return {
        "cost": float(solution.cost),
        "iterations": next((int(stats[key]) for key in ("iterations", "iter_count") if key in stats), None),
        "status": str(solution.status),
        "build": built - start,
        "solve": solved - built,
    }


def covocp_statement(case: dict[str, Any]) -> dict[str, Any]:
    """Build the model and freeze its statement."""
    from covocp.models import damped_oscillator, mass_chain

    start = time.perf_counter()
    if case["system"] == "oscillator":
        problem = damped_oscillator.problem(damping_weight=1000.0, stiffness_weight=0.0)
    else:
        problem = mass_chain.problem(masses=case["masses"])
    problem.statement()
    return {"build": time.perf_counter() - start, "solve": 0.0}


def peer(case: dict[str, Any]) -> dict[str, Any]:
    """Solve with one of the peers."""
    import peers_systems

    module = importlib.import_module(f"peers_{case['code']}")
    options = {name: case[name] for name in ("max_iter", "wrapped") if name in case}
    start = time.perf_counter()
    system = peers_systems.oscillator() if case["system"] == "oscillator" else peers_systems.chain(case["masses"])
    stated = time.perf_counter()
    result: dict[str, Any] = module.solve(system, case["intervals"], **options)
    result["build"] += stated - start
    return result
