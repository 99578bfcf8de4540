"""Problem and method joined: solving, warm starts, evaluation of given controls, comparison of methods."""

from covocp.solving.evaluation import evaluate as evaluate
from covocp.solving.methods import methods as methods
from covocp.solving.once import solve as solve
from covocp.solving.solver import Solver as Solver
