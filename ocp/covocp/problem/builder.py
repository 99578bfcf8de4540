"""The builder: symbols, dynamics, noise and measurements of a problem; its costs and conditions are in `wanted`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, cast

import casadi as ca
import numpy as np

from covocp.base.arguments import checked, text, truth
from covocp.base.checks import as_number, caller, check_kind, check_positive
from covocp.base.expressions import Given
from covocp.base.threads import methods_one_at_a_time
from covocp.problem.checks import column_expression
from covocp.problem.closed_loop_covariance import ClosedLoopCovariance, with_closed_loop
from covocp.problem.data import data_over_time
from covocp.problem.decisions import with_constant
from covocp.problem.declarations import Declarations, Free, Guess, Measurement
from covocp.problem.estimation_covariance import EstimationCovariance, with_estimation
from covocp.problem.instants import sampled_at
from covocp.problem.integrals import with_integral
from covocp.problem.matrices import plain_matrix
from covocp.problem.measurement_information import stated_noise
from covocp.problem.rates import with_rate
from covocp.problem.symbols import (
    control_vector,
    in_its_shape,
    known_parameter,
    new_symbol,
    unknown_constant,
    vector_state,
)
from covocp.problem.wanted import Wanted

if TYPE_CHECKING:
    from covocp.problem.attitude import Attitude


@methods_one_at_a_time
class Problem(Wanted):
    """An optimal control problem whose state holds vectors and symmetric (covariance) matrices.

    Args:
        duration: terminal time [s], or `Free(guess, lower, upper)`.
        name: appears in printouts and plots.

    Attributes:
        doubts_told: whether it was said what is probably forgotten in it, since the last change.
        duration_read: whether the number of a fixed duration was asked for, and may be in what is declared.

    Raises:
        ProblemError: where the duration is not positive.
    """

    def __init__(self, duration: float | Free, name: str = "") -> None:
        """Start an empty problem."""
        if not isinstance(duration, Free):
            duration = check_positive("duration", duration, unit="s")
        check_kind(name, str, "give name= in words")
        free = duration if isinstance(duration, Free) else None
        symbol = ca.MX.sym("duration") if isinstance(duration, Free) else duration
        self._declarations = Declarations(name=name, duration=symbol, free_duration=free)
        self._statement = self._expanded = None
        self.doubts_told = self.duration_read = False

    @classmethod
    def of(cls, declarations: Declarations) -> Problem:
        """A problem with these declarations."""
        result = cls(declarations.free_duration or declarations.duration, declarations.name)
        result._declarations = declarations
        return result

    @checked(unit=text)
    def state(
        self,
        name: str,
        shape: int = 1,
        *,
        initial: Given,
        final: Given = None,
        lower: Given = -np.inf,
        upper: Given = np.inf,
        guess: Guess = None,
        scale: Given = None,
        variance: Given = None,
        unit: str = "",
    ) -> ca.MX:
        """Declare a nominal vector state.

        Args:
            name: unique name.
            shape: number of components.
            initial: start values, shape () or (shape,); numbers or expressions in parameters; None, also in a sequence:
                free.
            final: values to reach at the end; None, also in a sequence such as [1.0, None]: free.
            lower: lower bounds along the path, at the nodes of the mesh.
            upper: upper bounds along the path, at the nodes of the mesh.
            guess: a number, an array over the nodes, or a function of s = t/T; None: simulated from the controls.
            scale: typical magnitude; None: from bounds, guess and simulated trajectory.
            variance: of the error of the initial estimate: scalar, vector (diagonal) or matrix; None: zero.
            unit: for the axes of plots.

        Returns:
            The symbol, shape (shape, 1).

        Raises:
            ProblemError: name used twice, shapes that do not fit, bounds crossed, values outside the bounds, NaN or
                inf in data, variance not positive semidefinite.
        """
        own = new_symbol(name, self._declare(name, shape), unit)
        entry = vector_state(own, (initial, final), (lower, upper), guess, scale, variance)
        return self._add("states", entry).symbol

    def attitude(
        self,
        name: str,
        *,
        initial: Given,
        final: Given = None,
        rate: Given,
        guess: Guess = None,
        variance: Given = None,
        noise: Given = None,
    ) -> Attitude:
        """Declare an attitude with its rate: a rotation C from inertial to body axes, dC/dt = -omega^x C.

        It is a unit quaternion to solvers, stepped by rotations, so that its length stays one; its error, in
        covariances, gains and noises, is a rotation vector in body axes of three entries [rad].

        Args:
            name: unique name.
            initial: rotation (3, 3) or unit quaternion (4,), numbers or expressions in parameters; None: free.
            final: attitude to reach, likewise; after how many turns is free. None: free.
            rate: angular velocity omega in body axes, shape (3, 1), any expression [rad/s].
            guess: attitudes over the nodes, or a function of s = t/T; None: the shortest way to the final attitude,
                without one simulated from the controls.
            variance: of the error of the initial estimate: scalar, vector (diagonal) or matrix (3, 3) [rad^2].
            noise: power spectral density of noise added to the rate: scalar, vector or matrix (3, 3) [rad^2/s].

        Returns:
            The attitude: `.matrix`, `.quaternion`, `.vector`, `.cosine(...)` for pointing zones, `.error(...)`.

        Raises:
            ProblemError: name used twice, no rotation, shapes that do not fit, variance or density negative.
        """
        from covocp.problem.attitude import with_attitude

        self._declare(name, 1)
        given = {"initial": initial, "final": final, "rate": rate, "guess": guess, "variance": variance, "noise": noise}
        declarations, attitude = with_attitude(self._declarations, name, where=caller(), **given)
        self._change(declarations)
        return attitude

    @checked(unit=text)
    def unknown(self, name: str, mean: Given, variance: Given, *, unit: str = "") -> ca.MX:
        """Declare a constant unknown parameter: part of the augmented state, not integrated in the nominal.

        Args:
            name: unique name.
            mean: its expected value, a number or a vector.
            variance: of that value: scalar, vector (diagonal) or matrix; numbers or expressions in parameters.
            unit: for the axes of plots.

        Returns:
            The symbol, shape (n, 1).

        Raises:
            ProblemError: name used twice, NaN or inf, variance not positive semidefinite or of the wrong size.
        """
        own = new_symbol(name, self._declare(name, int(np.size(as_number(name, "mean", mean)))), unit)
        return self._add("unknowns", unknown_constant(own, mean, variance)).symbol

    @checked(unit=text)
    def parameter(self, name: str, value: Given, *, unit: str = "") -> ca.MX:
        """Declare known numbers that may change from solve to solve without rebuilding.

        Args:
            name: unique name.
            value: a number, a vector (n,) or a matrix (n, m).
            unit: shown in printouts.

        Returns:
            Its symbol, in the shape of the value; columns of a matrix are stacked in `Solution.parameters`.

        Raises:
            ProblemError: name used twice, NaN or inf.
        """
        numbers = as_number(name, "value", value)
        own = new_symbol(name, self._declare(name, int(np.size(numbers))), unit)
        return in_its_shape(self._add("parameters", known_parameter(own, value, numbers)))

    @checked(unit=text)
    def decision(
        self,
        name: str,
        shape: int = 1,
        *,
        guess: Given,
        lower: Given = -np.inf,
        upper: Given = np.inf,
        unit: str = "",
    ) -> ca.MX:
        """Declare a constant that the optimiser chooses, for use wherever a number or an expression is taken.

        Args:
            name: unique name.
            shape: number of components.
            guess: where it starts, shape () or (shape,), within the bounds; its magnitude scales it.
            lower: lower bounds.
            upper: upper bounds.
            unit: for printouts and files.

        Returns:
            The symbol, shape (shape, 1).

        Raises:
            ProblemError: name used twice, bounds crossed, a guess outside of them, NaN or inf; when the problem is
                built: nothing depends on it, the cost falls with it without end.
        """
        own = new_symbol(name, self._declare(name, shape), unit)
        self._change(with_constant(self._declarations, own, lower, upper, guess))
        return cast(ca.MX, own["symbol"])

    @checked(unit=text)
    def integral(self, expression: Given, *, name: str | None = None, unit: str = "") -> ca.MX:
        """The integral of an expression over [0, T], for terminal costs and for constraints at the end.

        Args:
            expression: scalar, of states, controls, matrix states and covariances, decisions, time; per second.
            name: unique name; "integral k" by default. `solution[name]` is the integral up to each node.
            unit: for printouts and files.

        Returns:
            The symbol, shape (1, 1).

        Raises:
            ProblemError: not scalar, nothing in it that moves, another integral in it, name used twice.
        """
        declarations, symbol = with_integral(self._declarations, name, expression, unit)
        self._change(declarations)
        return symbol

    @checked(unit=text)
    def control(
        self,
        name: str,
        shape: int = 1,
        *,
        lower: Given = -np.inf,
        upper: Given = np.inf,
        guess: Guess = 0.0,
        scale: Given = None,
        unit: str = "",
    ) -> ca.MX:
        """Declare a control vector with its bounds, guess and scale (as for states), and unit for the axes of plots.

        Returns:
            The symbol, shape (shape, 1).

        Raises:
            ProblemError: name used twice, shapes that do not fit, bounds crossed.
        """
        own = new_symbol(name, self._declare(name, shape), unit)
        return self._add("controls", control_vector(own, (lower, upper), guess, scale)).symbol

    @checked(unit=text)
    def symmetric(
        self,
        name: str,
        size: int,
        *,
        initial: Given,
        final: Given = None,
        lower: float | None = None,
        guess: Given = None,
        unit: str = "",
    ) -> ca.MX:
        """Declare a general symmetric matrix state, stored as its half-vector.

        Args:
            name: unique name.
            size: number of rows.
            initial: matrix (size, size), or a scalar where size is 1; None, or None for an entry: free.
            final: as `initial`; None: free.
            lower: lower bound of the diagonal entries at the nodes; 0 or more also declares it positive semidefinite.
            guess: a matrix, used where the matrix is an NLP variable and cannot be simulated; None: simulated.
            unit: of its entries, for the axes of plots.

        Returns:
            The full symmetric matrix, shape (size, size).

        Raises:
            ProblemError: name used twice, shape that does not fit, NaN or inf, not symmetric; with `lower` >= 0 an
                initial matrix that is not positive semidefinite.
        """
        size = self._declare(name, size)
        return self._add("matrices", plain_matrix(name, size, unit, initial, final, lower, guess)).matrix

    def estimation_covariance(self, initial: Given = None) -> EstimationCovariance:
        """Add the Kalman-Bucy covariance E of the augmented state (states, then unknowns), [Schmidt 2.5-3].

        Its rate is F E + E F' + Q - E M' U^-1 M E, with F and M the Jacobians of dynamics and measurements along the
        nominal, Q and U the noise densities given to `dynamics` and `measurement`.

        Args:
            initial: covariance at the start; None: from the variances of states and unknowns.

        Returns:
            The covariance; `E[x, b]` gives entries and blocks.

        Raises:
            ProblemError: called twice, nothing to estimate, `initial` not positive semidefinite.
        """
        self._change(with_estimation(self._declarations, initial))
        E = next(matrix for matrix in self._declarations.matrices if matrix.estimation)
        return EstimationCovariance(self._declarations.augmented, E)

    def closed_loop_covariance(self) -> ClosedLoopCovariance:
        """The covariance X of the deviations of the actual system under the feedback of `minimize_expected`.

        Where a condition or a nonlinear cost contains it, the entries of the gain are controls; else it is the best.

        Returns:
            The covariance, for costs and conditions: `X[x, u]` and `X.deviation(u)`.

        Raises:
            ProblemError: called twice, no state or no control declared before it.
        """
        self._change(with_closed_loop(self._declarations))
        return ClosedLoopCovariance.of(self._declarations)

    def dynamics(self, symbol: Given, rate: Given, noise: Given = None) -> None:
        """Give the rate of a state or of a symmetric matrix state.

        Args:
            symbol: what `state` or `symmetric` returned, or its name.
            rate: d(symbol)/dt, of the shape of the symbol, per second.
            noise: power spectral density of additive white noise: scalar, vector (diagonal) or matrix; may depend on
                state, control and time. Only for vector states.

        Raises:
            ProblemError: unknown symbol, rate given twice, shape that does not fit, density negative.
        """
        self._change(with_rate(self._declarations, symbol, rate, noise))

    @checked(unit=text)
    def data(
        self,
        name: str,
        times: Given,
        values: Given,
        *,
        kind: Literal["linear", "cubic"] = "linear",
        unit: str = "",
    ) -> ca.MX:
        """Declare data over time (a reference, a wind, a measured input), for use wherever the time may be.

        Args:
            name: unique name.
            times: rising, shape (K,) [s]; from 0 to the terminal time or beyond, where that is free to its upper bound.
            values: shape (K,), or (K, m) of a vector.
            kind: "linear", with kinks that become nodes of the mesh where it has at least as many intervals and the
                duration is fixed; "cubic", the not-a-knot spline.
            unit: for printouts.

        Returns:
            The value at the running time, shape (m, 1).

        Raises:
            ProblemError: name used twice, times that do not rise or do not cover the duration, too few of them, values
                that are not finite or of another shape, unknown kind.
        """
        self._declare(name, 1)
        return self._add("data", data_over_time(self._declarations, name, times, values, kind, unit)).course.expression

    @checked(unit=text, relative=truth)
    def measurement(
        self,
        name: str,
        expression: Given,
        noise: Given = None,
        *,
        information: Given = None,
        at: Given = None,
        every: Given = None,
        relative: bool = False,
        unit: str = "",
    ) -> None:
        """Add a measurement m = expression + v, continuous with white noise v or taken at instants.

        Args:
            name: unique name.
            expression: of states, unknowns, controls and time, shape (m, 1).
            noise: power spectral density of v, of one that is taken at instants its variance: scalar, vector
                (diagonal) or matrix (correlated), positive definite.
            information: inverse density in place of it: scalar or vector (diagonal), not negative. Where it is zero
                nothing is measured: a sensor that a control switches off, information=w/U, w in [0, 1].
            at: instants at which it is taken [s], rising; the mesh has nodes there.
            every: period [s] in place of them, first taken one period after the start.
            relative: whether `at` or `every` are fractions of the duration, as they must be where it is free.
            unit: for the axes of gains, and for exported code.

        Raises:
            ProblemError: name used twice, singular, negative or of the wrong size, both or neither given, instants
                outside [0, T] or twice, a period longer than the duration.
        """
        value = column_expression(name, "measurement", expression)
        size = self._declare(name, value.shape[0])
        instants = sampled_at(self._declarations, name, at, every, relative)
        density, inverse = stated_noise(name, noise, information, size, sampled=bool(instants))
        own = {"expression": value, "noise": density, "information": inverse, "instants": instants}
        self._add("measurements", Measurement(name=name, unit=unit, where=caller(), **own))
