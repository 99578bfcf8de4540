"""covocp: optimal control of a trajectory together with its uncertainty."""

from __future__ import annotations

if __name__ != "covocp":
    raise ImportError(
        "This folder is the source of the package 'covocp'. Install it (pip install -e .) and import covocp instead."
    )

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
