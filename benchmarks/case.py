"""One benchmark case in its own process: `python case.py '{"code": ..., "system": ..., ...}'` prints one line of JSON.

Times are taken inside the process and leave out the imports; the peak memory is that of the whole process.
"""

from __future__ import annotations

import importlib
import json
import resource
import sys
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


def run(case: dict[str, Any]) -> dict[str, Any]:
    """Run a case; its result with the total time in seconds and the peak memory in MB."""
    codes = {"covocp": covocp_solve, "statement": covocp_statement}
    result = codes.get(case["code"], peer)(case)
    unit = 2**20 if sys.platform == "darwin" else 2**10
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    return {**result, "seconds": result["build"] + result["solve"], "memory": memory}


if __name__ == "__main__":
    outcome = run(json.loads(sys.argv[1]))
    sys.stdout.flush()
    sys.stdout.write("\n" + json.dumps(outcome) + "\n")
