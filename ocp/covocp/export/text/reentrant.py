"""Static memory in the code that CasADi writes, moved to the stack where nothing is kept in it."""

from __future__ import annotations

import re

# CasADi gives each function with memory static structs, and counters that hand them out, not safe for threads. That of
# sqpmethod has only pointers into the caller's work arrays, set at each call, so a local one does the same.
LOCAL = "sqpmethod"
DATA = re.compile(rf"struct casadi_{LOCAL}_data\* d ?= ?&casadi_(f\d+)_mem\[mem\];")
TAKEN = re.compile(r"\bcasadi_f\d+_checkout\(\);")


def reentrant(source: str) -> str:
    """The same code, the data of sqpmethod on the stack, so that several calls may run at the same time."""
    for name in DATA.findall(source):
        source = source.replace(f"mid = casadi_{name}_checkout();", "mid = 0;")
        source = source.replace(f"casadi_{name}_release(mid);", "")
        source = re.sub(rf"^static .*\bcasadi_{name}_mem\[.*\];\n", "", source, flags=re.MULTILINE)
    return DATA.sub(f"struct casadi_{LOCAL}_data own, *d = &own;", source)


def shares_memory(source: str) -> bool:
    """Whether a call works in memory that another one would work in at the same time."""
    return TAKEN.search(source) is not None
