"""Derivatives along directions, of whatever gives values: compiled code or CasADi's own operations."""

import casadi as ca
import numpy as np


def tangents_of(values, arguments, directions, given):
    """How values move where the arguments, given, do along directions."""
    function, t = ca.Function("values", arguments, values), ca.MX.sym("t")
    along = function.call([v + t * ca.DM(d) for v, d in zip(arguments, directions, strict=True)])
    tangent = ca.Function("tangent", [t, *arguments], [ca.jtimes(v, t, 1) for v in along])
    return [np.asarray(v.full()) for v in tangent.call([0, *given])]
