"""Riccati and Lyapunov equations, regulators and what is known of their closed loops."""

from __future__ import annotations

from covocp.blocks.algebraic import continuous as continuous
from covocp.blocks.algebraic import discrete as discrete
from covocp.blocks.algebraic import lyapunov as lyapunov
from covocp.blocks.algebraic import undetectable as undetectable
from covocp.blocks.algebraic import unstabilisable as unstabilisable
