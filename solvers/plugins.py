"""How the NLP and QP plugins of CasADi are told to print nothing: each by options of its own.

They print from C, or through Python's `sys.stdout`, which belongs to all threads of the process: replacing it, even for
a moment, loses what others print. A plugin that is not listed here prints what it likes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# In place of qpOASES, CasADi's default, whose copyright notice no option silences.
QPSOL = "qrqp"
TAKES_QPSOL = ("sqpmethod", "feasiblesqpmethod")
SILENT: dict[str, dict[str, Any]] = {
    "sqpmethod": {"print_header": False, "print_iteration": False, "print_status": False},
    "feasiblesqpmethod": {"print_header": False, "print_iteration": False, "print_status": False},
    "fatrop": {"fatrop": {"print_level": 0}},
    "blocksqp": {"print_header": False, "print_iteration": False, "print_maxit_reached": False},
    "qrsqp": {"print_header": False, "print_iteration": False},
    "sleqp": {"print_level": 0},
    "uno": {"uno": {"logger": "SILENT"}},
}
SILENT_QP: dict[str, dict[str, Any]] = {
    "qrqp": {"print_header": False, "print_iter": False, "print_info": False},
    "ipqp": {"print_header": False, "print_iter": False, "print_info": False},
    "qpoases": {"printLevel": "none"},
    "osqp": {"osqp": {"verbose": False}},
    "highs": {"highs": {"output_flag": False}},
}


def silent(plugin: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """The options given to a plugin beside those that silence it and its QP solver; what is given counts.

    Args:
        plugin: name of the NLP plugin.
        given: its options by the user.
    """
    options = merged(SILENT.get(plugin, {}), given)
    if plugin in TAKES_QPSOL:
        qpsol = str(options.setdefault("qpsol", QPSOL))
        options["qpsol_options"] = merged(SILENT_QP.get(qpsol, {}), options.get("qpsol_options", {}))
    return options


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Options with others on top, nested ones too."""
    result = dict(first)
    for key, value in second.items():
        nested = isinstance(value, Mapping) and isinstance(result.get(key), Mapping)
        result[key] = merged(result[key], value) if nested else value
    return result
