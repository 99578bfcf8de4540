"""Measurements by the information that they give: the inverse of the density of their noise, which may be zero."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca

from covocp.base.checks import check_density, density_matrix
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.problem.declarations import Measurement
from covocp.problem.matrices import Matrix

# The density that stands for no information is the inverse of this: a sensor of such noise tells nothing in double
# precision, and squares of it are still numbers.
LEAST = 1e-30


def stated_noise(name: str, noise: Expr, information: Expr, size: int, *, sampled: bool = False) -> tuple[Any, Any]:
    """Density of the noise of a measurement, and the information where that was stated (else None); size x size.

    Args:
        name: of the measurement.
        noise: its density, or the variance of one that is taken at instants.
        information: the inverse density.
        size: rows.
        sampled: whether it is taken at instants.

    Raises:
        ProblemError: both or none given, wrong size, negative, singular density, information that is not diagonal,
            information of what is taken at instants.
    """
    if sampled and information is not None:
        raise ProblemError(
            f"The measurement '{name}' is taken at instants, and information= is the inverse of a density.",
            expected="noise=, the variance of what is read at an instant",
            received="information=",
            remedy="give noise=; at instants at which nothing is measured leave them out of at=",
        )
    what = "noise variance" if sampled else "noise density"
    if (noise is None) == (information is None):
        raise ProblemError(
            f"The noise of the measurement '{name}' is given {'not at all' if noise is None else 'twice'}.",
            expected="noise=, the variance of what is read at an instant"
            if sampled
            else "noise=, its power spectral density, or information=, the inverse of it",
            received="neither" if noise is None else "both",
            remedy="give one of them",
        )
    if information is None:
        density = density_matrix(name, what, noise, size)
        if density.is_constant():
            check_density(name, what, ca.evalf(density).full(), definite=True)
        return density, None
    stated = density_matrix(name, "information", information, size)
    if stated.is_constant():
        stated = ca.MX(ca.sparsify(ca.evalf(stated)))
    diagonal = ca.densify(ca.diag(stated))
    if any(row != column for row, column in zip(*stated.sparsity().get_triplet(), strict=True)):  # zeros have none
        raise ProblemError(
            f"The information of the measurement '{name}' is not diagonal.",
            expected=f"a number or {size} numbers" if size > 1 else "a number",
            received=str(stated)[:200],
            remedy="state measurements without correlation, or give their noise= as a matrix",
        )
    return ca.diag(1.0 / ca.fmax(diagonal, LEAST)), ca.diag(diagonal)


def inverse_density(density: Expr, blocks: list[tuple[Any, Any]], invert: Callable[[Any], Any]) -> Any:
    """U^-1 of all measurements together, without dividing by what was stated as information.

    Args:
        density: U of all of them.
        blocks: of each measurement the density and the stated information (None: none), in the symbols of `density`.
        invert: the inverse of a density.
    """
    if all(stated is None for _, stated in blocks):
        return invert(density)
    return ca.diagcat(*(invert(noise) if stated is None else stated for noise, stated in blocks))


def check_readings(measurements: Sequence[Measurement], matrices: Sequence[Matrix]) -> None:
    """An instrument reads the actual system: what it shows, and its noise, know no covariance."""
    names = {entry.symbol.__hash__(): entry.name for entry in matrices}
    for measurement in measurements:
        stated = measurement.noise if measurement.information is None else measurement.information
        for what, value in (("", measurement.expression), ("noise density of ", stated)):
            for symbol in ca.symvar(value):
                if symbol.__hash__() in names:
                    raise ProblemError(
                        f"The {what}measurement '{measurement.name}' contains the matrix "
                        f"'{names[symbol.__hash__()]}' (declared at {measurement.where}).",
                        expected="states, unknowns, controls, parameters and time",
                        received=str(value)[:200],
                        remedy="measure what the actual system shows; matrices go into costs and constraints",
                    )
