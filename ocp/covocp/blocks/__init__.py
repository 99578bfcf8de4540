"""Laws as symbolic functions: each written once, for optimal control problems, simulations, scripts and C code.

Arguments may be numbers, numpy arrays or CasADi expressions; what comes back is numeric when all of them are. Blocks
know nothing of problems, grids or solvers.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

__all__ = ["attitude_seeking", "kalman", "peak_seeking", "riccati", "so3", "tables", "theta_d"]

if TYPE_CHECKING:
    from covocp.blocks import attitude_seeking as attitude_seeking
    from covocp.blocks import kalman as kalman
    from covocp.blocks import peak_seeking as peak_seeking
    from covocp.blocks import riccati as riccati
    from covocp.blocks import so3 as so3
    from covocp.blocks import tables as tables
    from covocp.blocks import theta_d as theta_d
else:
    # A law is imported when it is first asked for: stating a problem needs rotations, and not what others need.
    def __getattr__(name):
        if name in __all__:
            return importlib.import_module(f"{__name__}.{name}")
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")

    def __dir__():
        return sorted([*__all__, "__all__", "__doc__", "__file__", "__name__", "__path__"])
