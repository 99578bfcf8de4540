"""What the form of the controls costs where limits along the path act: measured on a mesh with more nodes.

There H_u is no measure: multipliers of limits act at points, so that costates jump from point to point and H_u with
them, all along a limit that the best control just keeps; and where a limit takes hold between two nodes, no
multiplier says so. The problem is solved again instead, from the solution, with one node more in each interval, two
more where a control changes much, limits at all of them; the difference of the costs counts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.matrices import Array
from covocp.extremal.dense_output import dense_output
from covocp.extremal.extremal import Extremal
from covocp.extremal.links import Within
from covocp.transcription.halved_steps import refined_run
from covocp.transcription.instants import completed
from covocp.transcription.mesh import Mesh, control_places, readings_at, step_unit
from covocp.transcription.nlp import NLP, QUIET
from covocp.transcription.remeshing import divided
from covocp.transcription.scales import choose_scales
from covocp.transcription.separable import slopes
from covocp.transcription.trajectory import Trajectory
from covocp.transcription.transcribing import transcribe

# Entries of the matrices up to which they are variables of the finer mesh: those of six rows. More take too long.
MOST_ENTRIES = 21
# The whole error in the change by the finer mesh: where the control meets a limit the order is two, and halves leave a
# quarter; a ramp in place of a jump becomes a third as long. So 0.64 to 1.49 of the true error (docs/numerics.md).
WHOLE = 4.0 / 3.0
# The start is a solution but for what is sought: the barrier begins small and leaves it where it is.
SETTINGS: dict[str, Any] = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    "max_iter": 60,
    "mu_strategy": "adaptive",
    "mu_init": 1e-4,
    "bound_push": 1e-6,
    "bound_frac": 1e-6,
    "bound_relax_factor": 1e-9,
    "fixed_variable_treatment": "make_parameter_nodual",
    "perturb_always_cd": "yes",  # rows that say the same, as of constant controls at both ends of the last interval
}
# Scaled residual at which an iterate meets all constraints; slope, in the same units, of an optimum: Ipopt passes over
# it where multipliers are large; a gain, relative, that is large whatever is left of it.
MET, LEVEL, LARGE = 1e-6, 1e-3, 1e-3
# Costs below this count as zero.
NO_COST = 1e-12


def change_on_finer_mesh(extremal: Extremal, size: float, within: Within | None) -> float | None:
    """Estimated error of the cost by the form of the controls and by limits that are missed between the nodes.

    Both have the same cause, a control that cannot follow its limit, and largely cancel: what is left of them counts.

    Args:
        extremal: the solution.
        size: of the cost, in which it is measured.
        within: what the rest of a chain says of it: the states are then held at both ends.

    Returns:
        The error relative to `size`; None where the finer mesh was not solved, or has too large matrices.
    """
    st = extremal.statement
    if st.ne > MOST_ENTRIES or (within is not None and st.behind):
        return None
    try:
        with np.errstate(all="ignore"):
            return _change(extremal, max(size, NO_COST), within)
    except (CovocpError, RuntimeError, ArithmeticError, ValueError, np.linalg.LinAlgError):
        return None  # a step that cannot be differentiated, a start without a value


def _change(extremal: Extremal, size: float, within: Within | None) -> float | None:
    """The same, where nothing fails."""
    st, t, parameters = extremal.statement, extremal.trajectory, extremal.parameters
    mesh, start = _finer(extremal)
    nlp = transcribe(st, mesh, choose_scales(st, mesh, start, parameters), taken=within is None)
    w, p = nlp.pack(start), np.append(parameters, size)
    bounds = nlp.bounds(parameters)
    cost = nlp.f
    if within is not None:
        _hold(nlp, w, parameters, bounds)
        if st.duration.free:
            cost += within.by_duration / size * nlp.scales.duration * (nlp.w[-1] - w[-1])
        if st.ne:  # what they cost later
            count, last = mesh.intervals + 1, mesh.intervals
            ends = slice(count * st.nx + last * st.ne, count * (st.nx + st.ne))
            cost += ca.dot(within.end_matrices * nlp.scales.e / size, nlp.w[ends] - w[ends])
    settings: dict[str, Any] = {**QUIET, "ipopt": SETTINGS}
    if nlp.pieces:
        settings |= slopes(nlp.pieces, nlp.w, nlp.p, nlp.g.shape[0], second=True, owner=st)
    solver = ca.nlpsol("finer", "ipopt", {"x": nlp.w, "p": nlp.p, "f": cost, "g": nlp.g}, settings)
    found = {name: np.asarray(value).ravel() for name, value in solver(x0=w, p=p, **bounds).items()}
    before = refined_run(st, extremal.mesh, t, parameters, 1).running
    before += float(st.terminal(t.x[-1], t.e[-1], t.duration, parameters))
    gained = before / size - float(found["f"][0])
    if not np.isfinite(gained):
        return None
    stats: dict[str, Any] = solver.stats()
    if not (
        stats["success"] and stats["iterations"]["inf_du"][-1] <= LEVEL
    ):  # one that meets all constraints shows what can be gained at least
        excess = np.maximum(bounds["lbg"] - found["g"], found["g"] - bounds["ubg"])
        return WHOLE * gained if gained > LARGE and excess.max(initial=0.0) < MET else None
    return WHOLE * abs(gained)


def _finer(extremal: Extremal) -> tuple[Mesh, Trajectory]:
    """The mesh with more nodes, each a segment of its own, its steps no longer than before; the solution there."""
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    nodes = completed(st, divided(mesh.nodes, t.u, mesh.control == "constant"), extremal.parameters)
    unit = step_unit(st, mesh)
    finer = replace(
        mesh,
        nodes=nodes,
        segments=(1,) * (nodes.size - 1),
        readings=readings_at(st, nodes),
        eliminated=False,
        substeps=unit * -(-mesh.substeps // (2 * unit)),
    )
    dense, before = dense_output(extremal), finer.instants
    z = dense.at(nodes)
    z[before] = dense.at(nodes[before], before=True)
    u = extremal.controls_at(control_places(nodes, mesh.control))
    if mesh.control == "linear":
        u[before] = extremal.controls_at(nodes[before], before=True)
    return finer, Trajectory(x=z[:, : st.nx], e=z[:, st.nx :], u=u, duration=t.duration)


def _hold(nlp: NLP, w: Array, parameters: Array, bounds: dict[str, Array]) -> None:
    """Hold the states at both ends where they are (in place), also a little beyond a limit."""
    nx, last = nlp.statement.nx, nlp.mesh.intervals * nlp.statement.nx
    kept = np.zeros(w.size, dtype=bool)
    kept[:nx] = kept[last : last + nx] = True
    for name in ("lbx", "ubx"):
        bounds[name] = np.where(kept, w, bounds[name])
    g, lower, upper = nlp.unpack(w, parameters)[1]["g"], bounds["lbg"], bounds["ubg"]
    limits = lower < upper
    bounds["ubg"] = np.where(limits & (g > upper) & (g < upper + MET), g, upper)
    bounds["lbg"] = np.where(limits & (g < lower) & (g > lower - MET), g, lower)
