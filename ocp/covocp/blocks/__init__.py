"""Laws as symbolic functions: each written once, for optimal control problems, simulations, scripts and C code.

Arguments may be numbers, numpy arrays or CasADi expressions; what comes back is numeric when all of them are. Blocks
know nothing of problems, grids or solvers.
"""

from __future__ import annotations

from covocp.blocks import attitude_seeking as attitude_seeking
from covocp.blocks import kalman as kalman
from covocp.blocks import peak_seeking as peak_seeking
from covocp.blocks import riccati as riccati
from covocp.blocks import so3 as so3
from covocp.blocks import tables as tables
from covocp.blocks import theta_d as theta_d
