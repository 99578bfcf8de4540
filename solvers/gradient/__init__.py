"""The first-order gradient method: `method` is the way in, the other modules are its parts."""

from __future__ import annotations

from covocp.solvers.gradient.method import NOT_TAKEN as NOT_TAKEN
from covocp.solvers.gradient.method import GradientSolver as GradientSolver
from covocp.solvers.gradient.method import Iteration as Iteration
from covocp.solvers.gradient.method import one_iteration as one_iteration
from covocp.solvers.gradient.method import prepare as prepare
from covocp.solvers.gradient.method import prepare_chain as prepare_chain
