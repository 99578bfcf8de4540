"""How stiff a problem is at its start, and the mesh whose steps follow from it."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.buffered import Matrices
from covocp.base.errors import CovocpError, ProblemError
from covocp.base.matrices import Array, stacked, unpack
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Statement
from covocp.transcription.choosing import choose_mesh, choose_step
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.first_guess import controls_guess, starts
from covocp.transcription.instants import with_instants
from covocp.transcription.mesh import STIFFNESS_PER_STEP, Graded, Mesh, Options, Stiffness

# Real part over modulus of an eigenvalue below which what it belongs to dies out before it turns.
DAMPED = -0.5


def resolve_mesh(statement: Statement, options: Options, parameters: Array) -> Mesh:
    """The mesh of some options, its steps chosen by the stiffness of the problem at its start."""
    options = with_instants(statement, options, parameters)
    stiff = stiffness(statement, options, parameters)
    return choose_mesh(statement, options, choose_step(statement, options, stiff), stiff)


def stiffness(statement: Statement, options: Options, parameters: Array, *, at_end: bool = False) -> Stiffness:
    """The stiffness at the start, for the longest interval: of f_x, and for the matrices of 2 (F - E W).

    A graded mesh knows that of the filter on each of its intervals, or that of the nominal along a solution.
    `at_end`: with the final values of the states that have one; none where the model has no value there.

    Raises:
        ProblemError: the model has no value at its start.
    """
    try:
        return _stiffness(statement, options, parameters, at_end)
    except RuntimeError as error:  # CasADi's: of a solve of linear equations inside the model, or a product of it
        if isinstance(error, CovocpError):
            raise
        if at_end:
            return Stiffness(nominal=0.0, oscillating=0.0, decaying=0.0)
        x0 = statement.boundary_values(parameters)[0]
        raise ProblemError(
            f"{statement.name or 'The problem'!r} cannot be evaluated where it starts.",
            expected="rates and measurements with values and slopes at the initial state",
            received="a solve of linear equations inside them that fails (a singular matrix), with initial values "
            f"{np.array2string(x0, precision=4, threshold=8)} (nan: free) and the guess of the controls",
            remedy="give other initial values, or a guess= of the controls, off the singularity",
        ) from error


def _stiffness(statement: Statement, options: Options, parameters: Array, at_end: bool) -> Stiffness:
    """What `stiffness` returns."""
    nodes, control = options.nodes(), options.control
    u = controls_guess(statement, nodes[:2], control)[0]
    mesh = Mesh(nodes=nodes, control=control, substeps=1, segments=(nodes.size - 1,), eliminated=True, step="rk4")
    x, e = starts(statement, mesh, parameters)
    if at_end:
        final = statement.boundary_values(parameters)[1]
        x = np.where(np.isnan(final), x, final)
    duration = statement.duration.guess
    arguments = [ca.DM(given) for given in (x, u, e, 0.0, duration, parameters)]
    rates = _eigenvalues(state_jacobian(statement).call(arguments)[0].full())
    longest = duration * float(np.diff(nodes).max())
    matrices = 0.0
    for block, form, source in zip(statement.matrices, statement.riccati, statement.sources, strict=True):
        if block.role == "integral":
            continue
        if form is None or source is not None:
            slope = _matrix_jacobian(statement).call(arguments)[0].full()
            matrices = max(matrices, _largest(_eigenvalues(slope)))
            break
        if block.estimation and isinstance(options.grid, Graded) and options.grid.stiffness is not None:
            matrices = max(matrices, options.grid.stiffness / longest)
            continue
        drift, _, information = (np.asarray(v.full()) for v in form.call([*arguments[:2], *arguments[3:]]))
        with np.errstate(invalid="ignore"):  # a density that is zero: refused by its name later
            filtered = drift - unpack(e[block.span], block.size) @ information
        matrices = max(matrices, 2 * _largest(_eigenvalues(filtered)))
    if isinstance(options.grid, Graded) and options.grid.nominal is not None:
        return replace(options.grid.nominal, matrices=longest * matrices)
    return Stiffness(
        nominal=longest * _largest(rates),
        oscillating=longest * _largest(rates[rates.real >= DAMPED * np.abs(rates)]),
        decaying=longest * _largest(rates[rates.real <= 0.0]),
        matrices=longest * matrices,
        growing=longest * float(rates.real.max(initial=0.0)),
    )


def fits(statement: Statement, mesh: Mesh, parameters: Array) -> bool:
    """Whether the explicit steps of a mesh are short enough at the start for other parameters, looked at quickly.

    Args:
        statement: the problem.
        mesh: of it.
        parameters: their values, (np,).

    Returns:
        False also where a quick look does not tell: implicit steps, matrices in explicit ones, a start that is guessed.
    """
    x = statement.boundary_values(parameters)[0]
    if mesh.step == "rodas" or (mesh.step == "rk4" and statement.ne) or statement.tied or np.isnan(x).any():
        return False
    duration, longest = statement.duration.guess, float(np.diff(mesh.nodes).max())
    u = controls_guess(statement, mesh.nodes[:2], mesh.control)[0]
    try:
        slopes = _slopes_in_numbers(statement).evaluated(x, u, np.zeros(statement.ne), 0.0, duration, parameters)[0]
    except RuntimeError:  # the longer look tells
        return False
    return duration * longest * _largest(_eigenvalues(slopes)) <= STIFFNESS_PER_STEP * mesh.substeps


def nominal_along(
    statement: Statement, nodes: Array, columns: tuple[Array | float, ...], places: Array, duration: float
) -> Stiffness:
    """The stiffness of the nominal along a solution, for the intervals of another mesh; that of matrices is left out.

    Args:
        statement: the problem.
        nodes: of the other mesh, t/T.
        columns: the six arguments at the nodes of the solution, a column each (`Extremal.columns`).
        places: t/T of these.
        duration: T [s].
    """
    values = state_jacobian(statement).map(places.size)(*columns)
    slopes = stacked(values, places.size)
    rates = np.linalg.eigvals(np.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)).astype(complex)
    sizes = np.abs(rates)
    kinds = {
        "nominal": sizes,
        "oscillating": np.where(rates.real >= DAMPED * sizes, sizes, 0.0),
        "decaying": np.where(rates.real <= 0.0, sizes, 0.0),
        "growing": np.maximum(rates.real, 0.0),
    }
    first = np.clip(np.searchsorted(places, nodes[:-1], side="right") - 1, 0, places.size - 1)
    last = np.clip(np.searchsorted(places, nodes[1:]), 0, places.size - 1)
    first, last = np.minimum(first, last), np.maximum(first, last)  # of an interval without length
    h = duration * np.diff(nodes)
    largest = {name: value.max(axis=1, initial=0.0) for name, value in kinds.items()}
    found = {
        name: float(np.max([h[k] * value[first[k] : last[k] + 1].max() for k in range(h.size)], initial=0.0))
        for name, value in largest.items()
    }
    return Stiffness(**found)


def _eigenvalues(matrix: Array) -> NDArray[np.complex128]:
    """Eigenvalues; none of a matrix that is not finite."""
    return np.linalg.eigvals(matrix).astype(complex) if np.isfinite(matrix).all() else np.zeros(0, complex)


def _largest(values: NDArray[np.complex128]) -> float:
    return float(np.abs(values).max(initial=0.0))


@lru_cache(maxsize=KEPT)
def state_jacobian(statement: Statement) -> ca.Function:
    """f_x as a function of the six arguments."""
    symbols = model_symbols(statement)
    if statement.nominal is None:
        rate = statement.rates(*symbols)[0]
    else:
        rate = statement.nominal(*symbols[:2], *symbols[3:])[0]
    return ca.Function("jacobian", symbols, [ca.jacobian(rate, symbols[0])])


@lru_cache(maxsize=KEPT)
def _slopes_in_numbers(statement: Statement) -> Matrices:
    """The same, for numbers."""
    return Matrices(state_jacobian(statement))


def _matrix_jacobian(statement: Statement) -> ca.Function:
    """V_e as a function of the six arguments."""
    symbols = model_symbols(statement)
    return ca.Function("jacobian", symbols, [ca.jacobian(statement.rates(*symbols)[1], symbols[2])])
