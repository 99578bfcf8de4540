"""Sequential quadratic programming in the controls alone: `method` is the way in, the other modules are its parts."""

from __future__ import annotations

from covocp.solvers.reduced.method import prepare as prepare
