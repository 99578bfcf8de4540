"""The steady-state filter, had from the control Riccati equation of the dual problem."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import checked, truth
from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.gains import innovation_gain, kalman_gain
from covocp.base.short_repr import short_repr
from covocp.blocks.algebraic import Words, frozen, sorted_modes, stabilising, weights
from covocp.blocks.duality import Estimation, dual
from covocp.blocks.updates import joseph_form, row_matrix
from covocp.blocks.values import matrix, square

Array = NDArray[np.float64]

WORDS = Words(
    names=("transition", "H", "noise", "R"),
    reach=(
        "(transition, H)",
        "detectable",
        "measure the mode, or take it out of the model",
        "H does not see",
    ),
    see=(
        "(transition, noise^1/2)",
        "stabilisable",
        "give the mode a little noise, or run predict and update, whose gain goes to zero for such a mode",
        "the noise does not excite",
    ),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Filter:
    """A filter in steady state; arrays are read-only.

    Args:
        prior: M, covariance before a measurement, shape (n, n).
        posterior: P, covariance after it, shape (n, n); in continuous time the same.
        gain: L, of y - H x, shape (n, m).
        eigenvalues: of the error's transition (I - L H) Phi, in continuous time of F - L H, shape (n,).
    """

    prior: Array
    posterior: Array
    gain: Array
    eigenvalues: NDArray[np.complex128]

    __repr__ = short_repr


@checked(discrete=truth)
def steady_state(transition: Expr, H: Expr, noise: Expr, R: Expr, *, discrete: bool = True) -> Filter:
    """Steady state of the Kalman filter (item 4), discrete or continuous, by duality with the regulator.

    Args:
        transition: Phi, shape (n, n); in continuous time F [1/s].
        H: shape (m, n), or (n,) for one measurement.
        noise: Gamma1 R_w Gamma1', positive semidefinite, shape (n, n); in continuous time a spectral density.
        R: covariance (spectral density) of the measurement noise, positive definite, shape (m, m).
        discrete: False: the Kalman-Bucy filter, dx/dt = F x.

    Returns:
        Covariances, gain and modes.

    Raises:
        ProblemError: expressions, shapes that do not fit, indefinite noise, singular R; (transition, H) not detectable
            or (transition, noise^1/2) not stabilisable: names the mode.
    """
    rows = row_matrix("H", H, square("transition", transition).shape[0])
    density, spread = matrix("noise", noise), matrix("R", R)
    problem = dual(Estimation(transition=transition, measurement=rows, noise=density, measurement_noise=spread))
    matrices = weights(
        problem.transition, problem.input, problem.state_weight, problem.control_weight, problem.cross, WORDS
    )
    prior = stabilising(*matrices, discrete=discrete, detectable=True, words=WORDS)
    phi, rows, U = matrices[0].T, matrices[1].T, matrices[3]
    unit = np.eye(len(prior))
    if discrete:
        gain, _ = innovation_gain(prior, rows, U, np.linalg.solve)
        posterior, error = joseph_form(prior, gain, rows, U), (unit - gain @ rows) @ phi
    else:
        gain = kalman_gain(prior, rows, U)
        posterior, error = prior, phi - gain @ rows
    return Filter(prior=frozen(prior), posterior=frozen(posterior), gain=frozen(gain), eigenvalues=sorted_modes(error))
