"""Problem and method joined: solving, warm starts, evaluation of given controls, comparison of methods."""

from typing import TYPE_CHECKING

from covocp.base.later import attributes
from covocp.solving.methods import methods as methods
from covocp.solving.once import solve as solve
from covocp.solving.solver import Solver as Solver

if TYPE_CHECKING:
    from covocp.solving.evaluation import evaluate as evaluate
else:
    __getattr__ = attributes(__name__, {"evaluate": "solving.evaluation"})
