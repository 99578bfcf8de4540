"""Whether a mesh suits other values of the parameters than those that it was made for."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, unpack
from covocp.base.short_repr import short_repr
from covocp.statement.statement import Statement
from covocp.transcription.choosing import against_elimination
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.first_guess import controls_guess
from covocp.transcription.grading import graded, needs_grading
from covocp.transcription.instants import with_instants
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.stiffness import fits, resolve_mesh

# Share of its nodes by which a mesh that is graded anew must have more to be taken, or share of the present first or
# last interval that its own must be below: of many intervals a few more nodes at the start are no large share, and
# without them a cost is off as by those of few (200 intervals, a prior of 1e4 times the declared one: 25 %).
MORE_NODES, SHORTER = 0.1, 0.3
# Factor by which a variance at the start, or the rate at which it falls, must grow before the mesh is graded anew where
# little time is to be taken. A mesh that is graded for one of them bears twice that: 1e-4 of a cost of the variance.
GROWN = 1.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Beginning:
    """How uncertain a problem begins, which its mesh is graded for.

    Attributes:
        variances: of what is estimated, (n,).
        rate: largest eigenvalue of E W at the start: how fast measurements let a variance fall [1/s].
    """

    variances: Array
    rate: float

    __repr__ = short_repr

    def beyond(self, known: Beginning) -> bool:
        """Whether more is uncertain than a mesh is known to bear, or falls faster."""
        return bool((self.variances > GROWN * known.variances).any()) or self.rate > GROWN * known.rate

    def beside(self, other: Beginning) -> Beginning:
        """The larger of both in each of their numbers."""
        variances = np.maximum(self.variances, other.variances)
        return Beginning(variances=variances, rate=max(self.rate, other.rate))


def beginning(statement: Statement, options: Options, parameters: Array) -> Beginning:
    """How a problem begins for some parameters, looked at quickly; nothing where its mesh is not graded.

    Args:
        statement: whose covariances the mesh is graded for.
        options: before they were graded.
        parameters: their values, (np,).
    """
    nothing = Beginning(variances=np.zeros(0), rate=0.0)
    if options.grid is not None or not needs_grading(statement):
        return nothing
    block = next((one for one in statement.matrices if one.estimation), None)
    if block is None:
        return nothing
    x, _, e, _ = statement.boundary_values(parameters)
    E = unpack(np.nan_to_num(e[block.span]), block.size)
    found = Beginning(variances=np.diagonal(E), rate=0.0)
    if np.isnan(x).any() or statement.tied:
        return found
    u = controls_guess(statement, np.array([0.0, 1.0]), options.control)[0]
    try:
        information = _information(statement).evaluated(x, u, 0.0, statement.duration.guess, parameters)[0]
    except RuntimeError:  # the variances tell
        return found
    product = E @ information
    rate = np.abs(np.linalg.eigvals(product)).max(initial=0.0) if np.isfinite(product).all() else 0.0
    return replace(found, rate=float(rate))


@lru_cache(maxsize=KEPT)
def _information(statement: Statement) -> Matrices:
    """M'U^-1 M as a function of state, control, time, duration and parameters, in numbers."""
    form = next(f for b, f in zip(statement.matrices, statement.riccati, strict=True) if b.estimation)
    assert form is not None
    inputs = form.mx_in()
    return Matrices(ca.Function("information", inputs, [form.call(inputs)[2]]))


def regraded(statement: Statement, options: Options, present: Options, parameters: Array) -> Options | None:
    """Options with the nodes that a default mesh has for some parameters, where these are clearly more than at present.

    Args:
        statement: whose covariances and gains the mesh is graded for.
        options: before they were graded.
        present: of the present mesh.
        parameters: their values, (np,).
    """
    if options.grid is not None:
        return None
    wanted = graded(statement, options, parameters)
    more, own = wanted.nodes(), present.nodes()
    ends, own_ends = (np.diff(nodes)[[0, -1]] for nodes in (more, own))
    finer = more.size > own.size and bool((ends < SHORTER * own_ends).any())
    return wanted if finer or more.size > (1.0 + MORE_NODES) * own.size else None


def other_nodes(
    statement: Statement,
    ungraded: tuple[Statement, Options],
    present: Options,
    values: tuple[Array, Array],
    *,
    look: bool,
) -> Options | None:
    """Options with other nodes where the present ones are too coarse, or the model jumps at other times; else None.

    Args:
        statement: the problem.
        ungraded: whose covariances and gains the mesh is graded for, and the options before it was.
        present: of the present mesh.
        values: of the parameters, present and next ones, (np,) each.
        look: whether to look at the grading.
    """
    before, after = values
    more = regraded(*ungraded, present, after) if look else None
    if statement.kinks(after) != statement.kinks(before):  # times that parameters say
        whole = with_instants(statement, graded(*ungraded, after), after)
        return more if np.array_equal(whole.nodes(), present.nodes()) else whole
    return more if more is None else with_instants(statement, more, after)


def suits(statement: Statement, options: Options, mesh: Mesh, parameters: Array) -> bool:
    """Whether the steps of a mesh are as short, and as stable, as those that would be chosen for some parameters.

    Args:
        statement: the problem.
        options: that the mesh was chosen by at first.
        mesh: its present steps may be shorter.
        parameters: their values, (np,).

    Raises:
        ProblemError: steps that the user gave diverge for these values.
    """
    if fits(statement, mesh, parameters):
        return True
    if statement.matrices and not (mesh.eliminated and against_elimination(statement)):  # that the method asks for
        options = replace(options, covariances="eliminated" if mesh.eliminated else "states")
    if mesh.step == "rodas":  # as many implicit steps as are needed, not as explicit ones would be
        options = replace(options, step="rodas")
    wanted = resolve_mesh(statement, options, parameters)
    return wanted.substeps <= mesh.substeps and not (wanted.step == "rodas" != mesh.step)
