"""C code of what covocp computes: trajectories, filters, feedback laws, solvers, compiled and compared with Python."""

from __future__ import annotations

from covocp.export.compiled.package import Check as Check
from covocp.export.compiled.package import CPackage as CPackage
from covocp.export.compiled.package import Timing as Timing
from covocp.export.exporting import export_c as export_c
