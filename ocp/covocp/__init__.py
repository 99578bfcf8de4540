"""Optimal control of a trajectory together with its uncertainty.

    import covocp as co

    ocp = co.Problem(duration=10.0)
    x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u - x, noise=0.1)
    ocp.measurement("position", x, noise=1.0)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 2.0})
    print(co.solve(ocp))

To state a problem: `Problem`, `Free` (its terminal time), `Gain` (constraints on its feedback), `Phases` (problems
one after the other), `table` (numbers over one to three variables); expressions are CasADi's. To solve it: `solve`,
`Solver` (again and again, from anywhere: `movable`), `compare` (several methods), `evaluate` (a given control),
`methods`. To judge a solution:
`certify` (is it the global minimum?), `worth` (does the combined design pay?), `simulate` (Monte Carlo of the actual
system), `simulate_law`, `simulate_sampled`. To keep and to fly it: `Solution.save`, `load`, `export_c`. Filters and
laws by themselves: `blocks`. What this installation has: `build_info`. What is wrong is said by `ProblemError`,
`SolveError` and `ExportError`, all of them `CovocpError`, and by `CovocpWarning`.

`help(covocp.solve)` and so on have the details; docs/api.md of the repository lists every name and option on one page.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from covocp.base.errors import CovocpError as CovocpError
from covocp.base.errors import CovocpWarning as CovocpWarning
from covocp.base.errors import ExportError as ExportError
from covocp.base.errors import Interrupted as Interrupted
from covocp.base.errors import ProblemError as ProblemError
from covocp.base.errors import SolveError as SolveError
from covocp.problem.builder import Problem as Problem
from covocp.problem.declarations import Free as Free
from covocp.problem.declarations import Gain as Gain
from covocp.solution.solution import Solution as Solution
from covocp.solving.elsewhere import movable as movable
from covocp.solving.methods import methods as methods
from covocp.solving.once import solve as solve
from covocp.solving.solver import Solver as Solver

__all__ = [
    "Problem",
    "Free",
    "Gain",
    "Phases",
    "solve",
    "Solver",
    "movable",
    "Solution",
    "PhasesSolution",
    "methods",
    "compare",
    "Comparison",
    "evaluate",
    "certify",
    "Certificate",
    "worth",
    "Worth",
    "simulate",
    "MonteCarlo",
    "PhasesMonteCarlo",
    "table",
    "Table",
    "simulate_law",
    "simulate_sampled",
    "SampledSimulation",
    "LawSimulation",
    "export_c",
    "CPackage",
    "load",
    "blocks",
    "build_info",
    "CovocpError",
    "ProblemError",
    "SolveError",
    "Interrupted",
    "ExportError",
    "CovocpWarning",
]

if TYPE_CHECKING:
    __version__: str
    from covocp import blocks as blocks
    from covocp.analysis.certificate import Certificate as Certificate
    from covocp.analysis.certificate import certify as certify
    from covocp.analysis.combined_gain import Worth as Worth
    from covocp.analysis.combined_gain import worth as worth
    from covocp.blocks.tables import Table as Table
    from covocp.blocks.tables import table as table
    from covocp.export import CPackage as CPackage
    from covocp.export import export_c as export_c
    from covocp.passage.library import build_info as build_info
    from covocp.problem.phases import Phases as Phases
    from covocp.simulation import MonteCarlo as MonteCarlo
    from covocp.simulation import PhasesMonteCarlo as PhasesMonteCarlo
    from covocp.simulation import simulate as simulate
    from covocp.simulation.laws import LawSimulation as LawSimulation
    from covocp.simulation.laws import simulate_law as simulate_law
    from covocp.simulation.sampled_loop import SampledSimulation as SampledSimulation
    from covocp.simulation.sampled_loop import simulate_sampled as simulate_sampled
    from covocp.solution.phases import PhasesSolution as PhasesSolution
    from covocp.solving.comparison import Comparison as Comparison
    from covocp.solving.comparison import compare as compare
    from covocp.solving.evaluation import evaluate as evaluate
    from covocp.solving.loading import load as load
else:
    # What is done with a solution is imported when it is first asked for: so the import stays as light as CasADi's,
    # and nothing here imports a method.
    _LATER = {
        "Certificate": "covocp.analysis.certificate",
        "certify": "covocp.analysis.certificate",
        "Comparison": "covocp.solving.comparison",
        "compare": "covocp.solving.comparison",
        "evaluate": "covocp.solving.evaluation",
        "load": "covocp.solving.loading",
        "Phases": "covocp.problem.phases",
        "build_info": "covocp.passage.library",
        "CPackage": "covocp.export",
        "export_c": "covocp.export",
        "LawSimulation": "covocp.simulation.laws",
        "simulate_law": "covocp.simulation.laws",
        "simulate_sampled": "covocp.simulation.sampled_loop",
        "SampledSimulation": "covocp.simulation.sampled_loop",
        "PhasesSolution": "covocp.solution.phases",
        "MonteCarlo": "covocp.simulation",
        "PhasesMonteCarlo": "covocp.simulation",
        "simulate": "covocp.simulation",
        "Table": "covocp.blocks.tables",
        "table": "covocp.blocks.tables",
        "Worth": "covocp.analysis.combined_gain",
        "worth": "covocp.analysis.combined_gain",
    }

    def __getattr__(name):
        if name == "blocks":
            return importlib.import_module("covocp.blocks")
        if name == "__version__":
            metadata = importlib.import_module("importlib.metadata")
            try:
                return metadata.version("covocp")
            except metadata.PackageNotFoundError:  # a folder that is imported from where it lies; help() asks for it
                return "(not installed)"
        if name in _LATER:
            return getattr(importlib.import_module(_LATER[name]), name)
        raise AttributeError(f"module 'covocp' has no attribute '{name}'")

    def __dir__():
        return sorted([*__all__, "__all__", "__doc__", "__file__", "__name__", "__path__", "__version__"])
