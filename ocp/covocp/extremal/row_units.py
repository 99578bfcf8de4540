"""Units of the rows of conditions whose limits tell none: what they vary by along an extremal."""

from __future__ import annotations

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal
from covocp.statement.interval import model_symbols
from covocp.transcription.nlp import Scales


def varied_by(extremal: Extremal, function: ca.Function, units: Scales) -> Array:
    """What each row of a function varies by at most if all variables change by their units, to first order.

    Args:
        extremal: along which.
        function: of all six, as of `Conditions`.
        units: of states, controls and matrices.

    Returns:
        One number for each row; not finite where a slope is not.
    """
    symbols = model_symbols(extremal.statement)
    sizes = ca.DM(np.concatenate([units.x, units.u, units.e]))
    by_unit = ca.fabs(ca.jacobian(function(*symbols), ca.vertcat(*symbols[:3]))) @ sizes
    varied = ca.Function("varied", symbols, [by_unit]).map(extremal.mesh.nodes.size)(*extremal.columns())
    return np.asarray(np.asarray(ca.DM(varied).full()).max(axis=1))
