"""One benchmark case in its own process: `python case.py '{"function": ..., ...}'` prints one line of JSON.

Times are taken inside the process and leave out the imports; the peak memory is that of the whole process.
"""

from __future__ import annotations

import importlib
import json
import resource
import sys
from typing import Any


def run(case: dict[str, Any]) -> dict[str, Any]:
    """Call the function of a case, "module.name"; its result with the total time in seconds and the peak in MB."""
    module, name = case["function"].split(".")
    result = getattr(importlib.import_module(module), name)(case)
    unit = 2**20 if sys.platform == "darwin" else 2**10
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    return {**result, "seconds": result["build"] + result["solve"], "memory": memory}


if __name__ == "__main__":
    outcome = run(json.loads(sys.argv[1]))
    sys.stdout.flush()
    sys.stdout.write("\n" + json.dumps(outcome) + "\n")
