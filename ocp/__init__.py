"""covocp: optimal control of a trajectory together with its uncertainty."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if __name__ != "covocp":
    raise ImportError(
        "This folder is the source of the package 'covocp'. Install it (pip install -e .) and import covocp instead."
    )

from covocp.declarations import Free as Free
from covocp.declarations import Gain as Gain
from covocp.errors import CovocpError as CovocpError
from covocp.errors import CovocpWarning as CovocpWarning
from covocp.errors import ExportError as ExportError
from covocp.errors import ProblemError as ProblemError
from covocp.errors import SolveError as SolveError
from covocp.evaluate import evaluate as evaluate
from covocp.methods import Solver as Solver
from covocp.methods import methods as methods
from covocp.methods import solve as solve
from covocp.problem import Problem as Problem
from covocp.solution import Solution as Solution

if TYPE_CHECKING:
    __version__: str
    from covocp.certificate import Certificate as Certificate
    from covocp.certificate import certify as certify
    from covocp.export import CPackage as CPackage
    from covocp.export import export_c as export_c
    from covocp.law_simulation import LawSimulation as LawSimulation
    from covocp.law_simulation import simulate_law as simulate_law
    from covocp.merit import Worth as Worth
    from covocp.merit import worth as worth
    from covocp.simulation import MonteCarlo as MonteCarlo
    from covocp.simulation import simulate as simulate
    from covocp.solvers.compare import Comparison as Comparison
    from covocp.solvers.compare import compare as compare
    from covocp.storage import load as load
else:
    # What is done with a solution is imported when it is first asked for: so the import stays as light as CasADi's,
    # and nothing here imports a method.
    _LATER = {
        "Certificate": "covocp.certificate",
        "certify": "covocp.certificate",
        "Comparison": "covocp.solvers.compare",
        "compare": "covocp.solvers.compare",
        "load": "covocp.storage",
        "CPackage": "covocp.export",
        "export_c": "covocp.export",
        "LawSimulation": "covocp.law_simulation",
        "simulate_law": "covocp.law_simulation",
        "MonteCarlo": "covocp.simulation",
        "simulate": "covocp.simulation",
        "Worth": "covocp.merit",
        "worth": "covocp.merit",
    }

    def __getattr__(name):
        if name == "blocks":
            return importlib.import_module("covocp.blocks")
        if name == "__version__":
            return importlib.import_module("importlib.metadata").version("covocp")
        if name in _LATER:
            return getattr(importlib.import_module(_LATER[name]), name)
        raise AttributeError(f"module 'covocp' has no attribute '{name}'")

    def __dir__():
        return sorted([*globals(), *_LATER])
