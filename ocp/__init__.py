"""covocp: optimal control of a trajectory together with its uncertainty."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if __name__ != "covocp":
    raise ImportError(
        "This folder is the source of the package 'covocp'. Install it (pip install -e .) and import covocp instead."
    )

from covocp.certify import Certificate as Certificate
from covocp.certify import certify as certify
from covocp.declarations import Free as Free
from covocp.errors import CovocpError as CovocpError
from covocp.errors import CovocpWarning as CovocpWarning
from covocp.errors import ExportError as ExportError
from covocp.errors import ProblemError as ProblemError
from covocp.errors import SolveError as SolveError
from covocp.methods import Solver as Solver
from covocp.methods import methods as methods
from covocp.methods import solve as solve
from covocp.problem import Problem as Problem
from covocp.solution import Solution as Solution
from covocp.storage import load as load

if TYPE_CHECKING:
    from covocp.solvers.compare import Comparison as Comparison
    from covocp.solvers.compare import compare as compare
else:

    def __getattr__(name):
        """What compares methods, looked up when it is first asked for: nothing here imports a method."""
        if name in ("compare", "Comparison"):
            return getattr(importlib.import_module("covocp.solvers.compare"), name)
        raise AttributeError(f"module 'covocp' has no attribute '{name}'")
