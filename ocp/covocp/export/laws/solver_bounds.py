"""What a plan of an exported solver must keep, and whether the mesh of the export bears the start that is given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr, Given
from covocp.base.linear_solve import COMPILED_SOLVER, linear_solve
from covocp.base.matrices import pack_symbolic, unpack_symbolic
from covocp.export.laws.law import LARGEST
from covocp.transcription.nlp import NLP

# Fatrop widens bounds by this, relative to their size or to 1 where they are smaller, and offers no option for it.
WIDENED = 1e-8
# Share of the cost by which a plan may be off because the first step of its mesh is too long for its start.
COARSE = 0.01
# Change of ln E in a step below which Simpson's rule is exact but for rounding.
SHORT = 1e-6


def nlp_bounds(nlp: NLP, p: Given, duration: Given) -> dict[str, Any]:
    """Bounds of the NLP as expressions of the parameters: `NLP.bounds` with symbols where values are prescribed."""
    st, mesh = nlp.statement, nlp.mesh
    numbers = nlp.bounds(st.values)
    known = [np.flatnonzero(~np.isnan(v)) for v in st.boundary_values(st.values)]
    values = st.boundary(p)
    count = len(mesh.starts)
    last_e = st.nx * count + st.ne * (count - 1)
    places = [(0, known[0], values[0], nlp.scales.x), (st.nx * (count - 1), known[1], values[1], nlp.scales.x)]
    if not mesh.eliminated:
        places += [(st.nx * count, known[2], values[2], nlp.scales.e), (last_e, known[3], values[3], nlp.scales.e)]
    lower, upper = ca.MX(ca.DM(numbers["lbx"])), ca.MX(ca.DM(numbers["ubx"]))
    for offset, rows, value, scale in places:
        if rows.size:
            fixed = value[rows.tolist()] / ca.DM(scale[rows])
            lower[(offset + rows).tolist()] = fixed
            upper[(offset + rows).tolist()] = fixed
    if duration is not None:
        lower[-1] = upper[-1] = duration / nlp.scales.duration
    lbg, ubg = ca.MX(ca.DM(numbers["lbg"])), ca.MX(ca.DM(numbers["ubg"]))
    offset = 0
    for entry in nlp.rows:
        size = entry.lower.size
        if entry.kind == "final_matrices":
            target = values[3][known[3].tolist()] / ca.DM(entry.scale)
            lbg[offset : offset + size] = target
            ubg[offset : offset + size] = target
        offset += size
    return {"lbx": lower, "ubx": upper, "lbg": lbg, "ubg": ubg}


def narrowed(bounds: dict[str, Any]) -> dict[str, Any]:
    """Bounds that fatrop widens to these; those that are equal stay, as fatrop leaves them, and so do infinite ones."""
    result = {}
    for lower, upper in (("lbx", "ubx"), ("lbg", "ubg")):
        room = (bounds[upper] - bounds[lower]) / 2
        for name, sign in ((lower, 1.0), (upper, -1.0)):
            widened = WIDENED * ca.fmin(ca.fmax(1.0, ca.fabs(bounds[name])), LARGEST)
            result[name] = bounds[name] + sign * ca.fmin(widened, room)
    return result


def outside(nlp: NLP, p: Given) -> Any:
    """By how much prescribed states are beyond their declared bounds, in the units of the NLP; the largest of them.

    In the bounds of the NLP their value stands in place of both.
    """
    st, found = nlp.statement, list[Any]([ca.MX(0.0)])
    lower, upper = st.state_bounds
    for value, numbers in zip(st.boundary(p)[:2], st.boundary_values(st.values)[:2], strict=True):
        for bound, sign in ((lower, -1.0), (upper, 1.0)):
            rows = np.flatnonzero(~np.isnan(numbers) & np.isfinite(bound))
            if rows.size:
                excess = sign * (value[rows.tolist()] - ca.DM(bound[rows]))
                found.append(ca.mmax(excess / ca.DM(nlp.scales.x[rows])))
    return ca.mmax(ca.vertcat(*found))


def coarse(nlp: NLP, p: Given, evaluated: Sequence[Any]) -> Any:
    """Whether the first step of the mesh is too long for what is uncertain at the start; None where none can be.

    What is not measured at the start, such as a speed, is by its drift an error of what is a little later: so E is
    looked at as it begins, and as F alone moves it to the middle of the first step of Simpson's rule.

    Args:
        nlp: the transcription.
        p: parameters of the statement.
        evaluated: states, half-vectors, controls at the nodes, duration, running and terminal cost of the plan.
    """
    st, mesh = nlp.statement, nlp.mesh
    pairs = zip(st.matrices, st.riccati, strict=True)
    block, form = next(((b, f) for b, f in pairs if b.estimation and f is not None), (None, None))
    if block is None or form is None or not st.running_uses_matrices:
        return None
    x, e, u, duration, running, terminal = evaluated[:6]
    start = (x[:, 0], u[:, 0])
    h = duration * float(np.diff(mesh.nodes[:2]).item()) * 2 / max(mesh.substeps, 2)
    drift, _, known = form(*start, 0.0, duration, p)
    E = unpack_symbolic(e[block.span, 0], block.size)
    phi = _moved(drift * h / 2)
    errors = []
    for largest in (E, phi @ E @ phi.T):
        first = ca.MX(e[:, 0])
        first[block.span] = pack_symbolic(largest)
        later = ca.MX(first)
        later[block.span] = e[block.span, 1]
        costs = [st.rates(*start, own, 0.0, duration, p)[2] for own in (first, later)]
        errors.append(_simpson_error(h, largest, known, costs[0] - costs[1]))
    return ca.fmax(*errors) > COARSE * ca.fabs(running + terminal)


def _moved(A: Expr) -> Any:
    """exp(A) by its diagonal Pade approximant (1, 1): of order 2, and no growth where nothing grows, however stiff."""
    unit = ca.MX.eye(A.shape[0])
    return linear_solve(unit - A / 2, unit + A / 2, COMPILED_SOLVER)


def _simpson_error(h: Expr, E: Expr, known: Expr, change: Expr) -> Any:
    """By how much Simpson's rule is wrong over a step in which E falls by what is learnt.

    While E falls like E0 / (1 + k t), k the mean of the rates at the start (the eigenvalues of E0 M'U^-1 M, each with
    its own weight), Simpson's rule over h takes for its mean, in units of E0,
    (1 + 4 / (1 + k h / 2) + 1 / (1 + k h)) / 6 in place of ln(1 + k h) / (k h). What that adds to the cost is counted
    by the change of the running cost from E0 to E after the first interval.

    Args:
        h: length of the step.
        E: covariance from which it falls.
        known: M'U^-1 M.
        change: of the running cost from there to after the first interval.
    """
    product = E @ known
    k = ca.trace(product @ product) / ca.fmax(ca.trace(product), np.finfo(float).tiny)
    kh = ca.fmax(h * k, SHORT)
    mean = (1 + 4 / (1 + kh / 2) + 1 / (1 + kh)) / 6 - ca.log1p(kh) / kh
    return h * mean * (1 + kh) / kh * ca.fabs(change)
