"""What is wanted of a problem: its cost, and the conditions that hold along the way."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from covocp.base.arguments import checked, truth
from covocp.base.expressions import Given
from covocp.base.threads import methods_one_at_a_time
from covocp.problem.chances import with_chance
from covocp.problem.checks import as_expression
from covocp.problem.constraints import with_constraint
from covocp.problem.declarations import Gain, Place
from covocp.problem.declared import Declared
from covocp.problem.expected_cost import check_first_cost, expected_cost


@methods_one_at_a_time
class Wanted(Declared):
    """Declarations to which a cost and conditions are added; `Problem` adds what they are about.

    Errors call the methods those of `Problem`, which the user makes.
    """

    @checked("Problem.minimize()")
    def minimize(self, running: Given = 0.0, terminal: Given = 0.0) -> None:
        """State the deterministic cost: terminal + integral of running over [0, T].

        Args:
            running: L(x, u, E, t), scalar, cost per second.
            terminal: k(x(T), E(T), T), scalar; tr(C E(T)) is written as such.

        Raises:
            ProblemError: not scalar, or given twice.
        """
        check_first_cost(self._declarations, "minimize")
        cost = (
            as_expression("minimize", "running cost", running, (1, 1)),
            as_expression("minimize", "terminal cost", terminal, (1, 1)),
        )
        self._change(replace(self._declarations, cost=cost))

    @checked("Problem.minimize_expected()")
    def minimize_expected(
        self,
        running: Given = 0.0,
        terminal: Given = 0.0,
        *,
        terminal_weight: Given = None,
        control_weight: Given = None,
        gain: Gain | None = None,
    ) -> None:
        """State the expected cost <terminal + integral of running> of the actual system under linear feedback.

        The actual control is u - C dx', dx' the Kalman filter's estimate of the deviation from the nominal. The cost is
        expanded to second order about the nominal [Schmidt 6.3]; nominal, filter and gain are chosen together.

        Args:
            running: L(x, u, t), scalar, cost per second.
            terminal: k(x(T), T), scalar.
            terminal_weight: added to k_xx, by symbol or name, also of an entry: {x: 2.0, p[0]: 1.0}; what missing a
                prescribed final value costs.
            control_weight: weight B of the deviations of the controls, by symbol or name, in place of L_uu; needed
                where L_uu is not positive definite.
            gain: constraints on the gain C (structure, constancy, bounds); None: the best one.

        Raises:
            ProblemError: not scalar, cost given twice, weights that do not fit or are negative.
        """
        own = self._declarations
        check_first_cost(own, "minimize_expected")
        expected = expected_cost(own, running, terminal, terminal_weight, control_weight, gain)
        self._change(replace(own, expected=expected))

    @checked("Problem.subject_to()", relative=truth)
    def subject_to(
        self,
        expression: Given,
        *,
        lower: Given = None,
        upper: Given = None,
        equals: Given = None,
        at: Place | float | None = None,
        relative: bool = False,
        side: Literal["before", "after"] | None = None,
        name: str | None = None,
        between: Literal["auto"] | None = None,
    ) -> None:
        """Require lower <= expression <= upper, or expression = equals.

        Path constraints hold at the nodes of the mesh, and at the ends of the integration steps where an interval has
        several (`points=` of `solve`); `Solution.check_path` looks between them. With constant controls a path
        constraint holds at each node with the control of the interval that starts there (at the last node: the last
        control).

        Args:
            expression: of states, controls, matrix states, decisions, integrals, time; a column or a scalar.
            lower: numbers, shape of the expression; None: no lower bound.
            upper: numbers, shape of the expression; None: 0 where no lower bound is given either, else no upper bound.
            equals: numbers, shape of the expression, in place of both.
            at: "path", "initial", "final", or an instant inside the horizon [s], at which the mesh gets a node; None:
                "path", and "final" for integrals and for decisions alone.
            relative: whether the instant is a share of the duration, as it must be where that is free.
            side: of an instant: "after" what is measured then and with the control that goes on, as by default, or
                "before" it and with the control that ends.
            name: appears in every diagnostic; "constraint k" by default.
            between: "auto": imposed at more and more points of each interval, until the largest violation between them
                is below 1e-4 of the limit (with `refine`, its tolerance, where that is smaller, but for 2e-5).

        Raises:
            ProblemError: no variable in the expression, bounds crossed or both infinite, unknown place, an instant that
                is none or at an end, an integral elsewhere than at the end.
        """
        limits = (lower, upper, equals)
        given = (expression, limits, at, name, between, relative, side)
        self._change(with_constraint(self._declarations, *given))

    @checked("Problem.chance()", joint=truth)
    def chance(
        self,
        expression: Given,
        *,
        lower: Given = None,
        upper: Given = None,
        probability: float,
        at: Place = "path",
        joint: bool = False,
        smallest: float = 0.0,
        name: str | None = None,
    ) -> None:
        """Require lower <= expression <= upper of the actual system with a probability, by its linearised spread.

        The spread is that of the closed loop where the cost is `minimize_expected`, else that of the system along its
        open-loop control, which no measurement makes smaller. Along the path the probability holds at each time by
        itself. Between two limits it is exact for a normal law.

        Args:
            expression: of states, unknowns, with feedback also controls; decisions, time; a column or a scalar.
            lower: numbers, shape of the expression; None: no lower limit.
            upper: numbers, shape of the expression; None: no upper limit.
            probability: inside (0, 1), of each row; between two limits at least 0.1.
            at: "path", "initial" or "final".
            joint: whether all rows together keep their limits with it: each takes an equal share of the risk.
            smallest: standard deviations s are taken as sqrt(s^2 + smallest^2), in the unit of the expression; give
                one where s may vanish, so that it has a slope there.
            name: appears in every diagnostic; "chance k" by default.

        Raises:
            ProblemError: probability outside (0, 1), no limit, limits that cross or are equal, an integral or a
                matrix in the expression; when the problem is built: nothing in it scatters.
        """
        given = {"probability": probability, "joint": joint, "smallest": smallest}
        self._change(with_chance(self._declarations, expression, lower, upper, at, name, **given))
