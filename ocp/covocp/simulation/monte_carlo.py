"""The result of a simulation: moments, terminal scatter, costs, shares of runs, and a verdict; plain arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.arguments import checked, one_of
from covocp.base.arguments import truth as a_truth
from covocp.base.checks import as_number
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.later import later
from covocp.base.matrices import Array, standard_deviations
from covocp.base.pages import as_html
from covocp.base.pickling import pickled_without
from covocp.base.short_repr import short_repr
from covocp.base.threads import cached, methods_one_at_a_time
from covocp.simulation.chances import Share, chance_shares
from covocp.simulation.constraints import Rows
from covocp.simulation.counts import Count, count
from covocp.simulation.rows import place_of
from covocp.simulation.sampling import Moments, degrees_of_freedom, mean_band, mean_square_band, robust_deviation
from covocp.simulation.step_choice import StepChoice
from covocp.simulation.verdict import Verdict, judge
from covocp.simulation.workers import Failure
from covocp.statement.statement import Block

if TYPE_CHECKING:
    import matplotlib.figure


@methods_one_at_a_time
@pickled_without(symbols=dict)
@dataclass(frozen=True, kw_only=True, eq=False)
class MonteCarlo:
    """Simulated runs of an actual system with its filter and feedback.

    Deviations are those of the actual system from the nominal of the solution, over the augmented state of n rows
    (states, then unknowns). Moments are about the nominal and over the runs that are inside the domain at that time.
    n: rows of the augmented state, m: controls that are fed back, K: stored times, R: runs that were simulated.

    Attributes:
        name: of the problem.
        requested: number of runs asked for.
        numbers: of the runs that were simulated, (R,).
        seed: of the random numbers.
        filter: "perturbation", "extended", or "law" where a law of the user's flew.
        period: time between two steps of the law [s], else NaN.
        estimated: whether there are estimates; a law may have none.
        fed_back: whether there is a feedback; False: plant and filter along an open-loop control.
        truth: what was simulated instead of the design's system, in words; "" where it is the design's.
        level: probability of the confidence bands.
        step: the integration step and why.
        t: stored times [s], (K,).
        nominal: augmented state of the nominal, (K, n); nominal_control: its controls that are fed back, (K, m).
        moments: of deviation, estimate of it and deviation of the control, stacked, at the stored times.
        predicted: linear prediction for what was simulated: mean squares of the deviation, (K, n, n);
            predicted_error: of the error of the estimate; predicted_mean: mean of the deviation, (K, n);
            predicted_control: mean squares of the deviation of the controls fed back, (K, m, m).
        design, design_error: the same mean squares as the design expects them; they differ where there is a truth.
        intended: mean squares of the deviation at the end that the solution itself promises, (n,); they differ from
            those of the design where the mesh does not resolve its gains. NaN without feedback.
        grown: what noise that varies with state and control adds to the covariance of deviation and estimate at the end
            by their spread, which the prediction leaves out, (2n, 2n); zero where the prediction holds or no density
            bends, NaN where it is not known.
        deviations: at the end, (R, n); of a run that left the domain, just before it did.
        estimates: the filter's estimates of them, (R, n); those of a law at its last step, NaN where it has none.
        costs: of each run, (R,); NaN where it left the domain, or without an expected cost.
        predicted_cost: linear prediction for what was simulated, NaN where there is none; design_cost: of the design.
        spread_cost: what of the cost of the design is not linear in the covariance X of the closed loop: no run has it,
            and it is in none of the others.
        left: time at which a run left the domain [s], inf where it did not, (R,).
        domain: deviations at which it is left, (n,).
        unanswered: time at which the law of a run first gave no finite control [s], inf where it always did, (R,).
        asked: whether a run asked for more control than there is at some instant, (R, m).
        asking: share of the runs that ask for more at each stored time, (K, m).
        limits: what counts as all the control there is, (lower, upper), (m,) each; limited: whether the actual control
            stays within them.
        inequalities: those that runs can violate, bounds of states and controls among them.
        violated: whether a run violates each at some time (of the start, the end, an instant: then), (R, rows); at_end:
            whether it does at the end, which a run that left the domain counts for, (R, rows).
        violating: share of the runs that do at each stored time, (K, rows); promised: probability of it by the
            predicted covariances, for normal deviations, (K, rows).
        paths: deviation, estimate and deviation of the control of the first runs, (runs, K, 2n + m).
        failed: runs that were not simulated because their task failed.
        interrupted: whether it was stopped before the last run.
        blocks: where each symbol lies; symbols: by name, none where it was pickled: names mean the same.
        augmented: names of the rows.
    """

    name: str
    requested: int
    numbers: Any
    seed: int
    filter: str
    period: float
    estimated: bool
    fed_back: bool
    truth: str
    level: float
    step: StepChoice
    t: Array
    nominal: Array
    nominal_control: Array
    moments: Moments
    predicted: Array
    predicted_error: Array
    predicted_mean: Array
    predicted_control: Array
    intended: Array
    grown: Array
    design: Array
    design_error: Array
    deviations: Array
    estimates: Array
    costs: Array
    predicted_cost: float
    design_cost: float
    spread_cost: float
    left: Array
    domain: Array
    unanswered: Array
    asked: Any
    asking: Array
    limits: tuple[Array, Array]
    limited: bool
    inequalities: Rows
    violated: Any
    at_end: Any
    violating: Array
    promised: Array
    paths: Array
    failed: tuple[Failure, ...]
    interrupted: bool
    blocks: tuple[Block, ...]
    augmented: tuple[str, ...]
    symbols: Mapping[str, Any] = field(repr=False)

    __repr__ = short_repr

    @property
    def runs(self) -> int:
        """Number of runs that were simulated."""
        return int(self.numbers.size)

    @property
    def stayed(self) -> Any:
        """Which runs are inside the domain at the end, (R,)."""
        return np.isinf(self.left)

    @property
    def left_share(self) -> float:
        """Share of the runs that left the domain."""
        return float(1.0 - self.stayed.mean())

    def mean(self, key: Given) -> Array:
        """Sample mean of the actual values of a state, an unknown or a control, (K,) or (K, size).

        Of an attitude, which has no mean as a vector, that of its deviation: a rotation vector in body axes.
        """
        rows, block = self.rows(key)
        nominal = self.nominal_control if block.kind == "control" else self.nominal
        return self._shaped(nominal[:, block_rows(rows, block, self.size)] + self.moments.mean[:, rows], block)

    def bias(self, key: Given) -> Array:
        """Sample mean of the deviation from the nominal, (K,) or (K, size)."""
        rows, block = self.rows(key)
        return self._shaped(self.moments.mean[:, rows], block)

    def mean_band(self, key: Given) -> tuple[Array, Array]:
        """Confidence band of the mean, (low, high)."""
        rows, block = self.rows(key)
        variance = np.diagonal(self.moments.product, axis1=1, axis2=2)[:, rows] - self.moments.mean[:, rows] ** 2
        values = self.mean(key).reshape(self.t.size, -1)
        low, high = mean_band(values, variance, self.moments.count[:, None], self.level)
        return self._shaped(low, block), self._shaped(high, block)

    @checked("covariance()", about=one_of("nominal", "mean"))
    def covariance(self, a: Given, b: Given = None, *, about: str = "nominal") -> Array:
        """Sample covariance of the deviations of two symbols, (K, size of a, size of b).

        Args:
            a: state, unknown or control, symbol or name.
            b: another one; None: a itself.
            about: "nominal", as the linear prediction has it, or "mean", the sample's own.
        """
        one, two = self.rows(a)[0], self.rows(a if b is None else b)[0]
        product = self.moments.product[:, one, two]
        if about == "nominal":
            return product
        mean = self.moments.mean
        return np.asarray(product - mean[:, one, None] * mean[:, None, two])

    def deviation(self, key: Given, *, about: str = "nominal") -> Array:
        """Sample standard deviation, (K,) or (K, size), in the unit of the symbol; see `covariance`."""
        _, block = self.rows(key)
        return self._shaped(standard_deviations(self.covariance(key, about=about)), block)

    def deviation_band(self, key: Given) -> tuple[Array, Array]:
        """Confidence band of the standard deviation about the nominal, (low, high)."""
        rows, block = self.rows(key)
        square = np.diagonal(self.moments.product, axis1=1, axis2=2)[:, rows]
        freedom = degrees_of_freedom(self.moments.count[:, None], square, self.moments.fourth[:, rows])
        low, high = mean_square_band(square, freedom, self.level)
        return self._shaped(np.sqrt(low), block), self._shaped(np.sqrt(high), block)

    def predicted_deviation(self, key: Given) -> Array:
        """Standard deviation about the nominal that linear theory predicts, (K,) or (K, size)."""
        rows, block = self.rows(key)
        predicted = self.predicted_control if block.kind == "control" else self.predicted
        return self._shaped(standard_deviations(predicted)[:, block_rows(rows, block, self.size)], block)

    def error_covariance(self, a: Given, b: Given = None) -> Array:
        """Sample covariance of the errors of the estimates of two symbols, (K, size of a, size of b).

        Raises:
            ProblemError: a law flew that tells no estimate.
        """
        if not self.estimated:
            raise ProblemError(
                "There are no errors of estimates.",
                expected="a filter of the design, or a law with an attribute 'estimate'",
                received="a law without one",
                remedy="let the law tell its estimate of the deviation from the nominal, (n,)",
            )
        one, two = self.rows(a, controls=False)[0], self.rows(a if b is None else b, controls=False)[0]
        n, product = self.size, self.moments.product
        actual, estimate = product[:, :n, :n], product[:, n : 2 * n, n : 2 * n]
        cross = product[:, n : 2 * n, :n]
        return np.asarray((actual + estimate - cross - cross.transpose(0, 2, 1))[:, one, two])

    def terminal(self, key: Given) -> Array:
        """Deviations of all runs at the end, (R,) or (R, size)."""
        rows, block = self.rows(key, controls=False)
        return self._shaped(self.deviations[:, rows], block)

    def robust_deviation(self, key: Given) -> Array:
        """Deviation at the end from the median of all runs, those that left the domain too; () or (size,)."""
        rows, block = self.rows(key, controls=False)
        values = robust_deviation(self.deviations[:, rows])
        return np.asarray(values[0] if block.size == 1 else values)

    def share_beyond(self, key: Given, value: Given) -> float:
        """Share of the runs whose deviation at the end is larger than a value in some component.

        A run that left the domain counts as beyond.
        """
        rows, block = self.rows(key, controls=False)
        limit = as_number(block.name, "largest deviation", value)
        if limit.size not in (1, block.size) or not (limit >= 0).all():
            raise ProblemError(
                f"The largest deviation of '{block.name}' does not fit.",
                expected="a number that is not negative" + (f", or {block.size} of them" if block.size > 1 else ""),
                received=repr(value),
                remedy="correct value",
            )
        beyond = (np.abs(self.deviations[:, rows]) > limit.ravel()).any(axis=1)
        return float((beyond | ~self.stayed).mean())

    @property
    def size(self) -> int:
        """Rows n of the augmented state."""
        return int(self.nominal.shape[1])

    @property
    def cost(self) -> float:
        """Mean cost of the runs that stayed inside the domain; NaN without an expected cost."""
        values = self.costs[self.stayed]
        return float(values.mean()) if values.size else np.nan

    @property
    def cost_error(self) -> float:
        """Standard error of the mean cost."""
        values = self.costs[self.stayed]
        return float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else np.nan

    @property
    def asked_share(self) -> float:
        """Share of the runs that asked for more control than there is, at some instant."""
        return float(self.asked.any(axis=1).mean()) if self.asked.size else 0.0

    @property
    def outside_share(self) -> dict[str, float]:
        """Share of the runs that left the bounds of a state or control at some instant, by name."""
        return {entry.name: entry.share for entry in self.violations.values() if entry.bound}

    @cached
    def violations(self) -> Mapping[str, Count]:
        """How many runs violate each constraint, and each bound of a state or control, of the problem, by name.

        Without equalities, which no noisy run meets, and what is the same in all runs: `inequalities.left_out`.
        """
        flags = self.violated, self.at_end, self.violating
        found = count(self.inequalities.rows, *flags, self.promised, self.t, self.level)
        return {entry.name: entry for entry in found}

    @cached
    def chances(self) -> Mapping[str, Share]:
        """The share of the runs that met each condition on a probability, by name, with confidence bands."""
        return chance_shares(self)

    @cached
    def verdict(self) -> Verdict:
        """Whether the linear prediction is inside the confidence bands at the end, and if not, why."""
        return judge(self)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain arrays, numbers and texts, by name."""
        left_out = {"moments", "step", "failed", "blocks", "symbols", "limits", "inequalities"}
        result = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}
        result |= {f"moments.{f.name}": getattr(self.moments, f.name) for f in fields(self.moments)}
        result |= {"step": self.step.longest, "step_reason": self.step.reason, "failed": [str(f) for f in self.failed]}
        result["inequalities"] = tuple(row.name for row in self.inequalities.rows)
        return result | {"limits.lower": self.limits[0], "limits.upper": self.limits[1]}

    def plot(self, *names: Any, **options: Any) -> matplotlib.figure.Figure:
        """Draw the runs; see `covocp.simulation.clouds.plot_monte_carlo`."""
        module = later("simulation.clouds")
        later("plot.figure").check_plot_options(options, module.plot_monte_carlo)
        return module.plot_monte_carlo(self, *names, **options)  # type: ignore[no-any-return]

    def __str__(self) -> str:
        """The summary that print shows."""
        return str(later("simulation.report").summary(self))

    def _repr_html_(self) -> str:
        """What a notebook shows: the same summary, and the figure."""
        figure = later("plot.embedding").embedded(self.plot)
        return as_html(later("simulation.report").sections(self), figure)

    @checked(controls=a_truth)
    def rows(self, key: Given, *, controls: bool = True) -> tuple[slice, Block]:
        """Where a symbol, or an entry of one, lies among the rows (2n + m) of `moments`, and its block.

        Raises:
            ProblemError: where it is not among them.
        """
        return place_of(self, key, controls=controls)

    @staticmethod
    def _shaped(values: Array, block: Block) -> Array:
        return np.asarray(values[:, 0] if block.size == 1 else values)


def block_rows(rows: slice, block: Block, size: int) -> slice:
    """Rows of a symbol in the nominal, of its rows among deviation, estimate and control."""
    shift = 2 * size if block.kind == "control" else 0
    return slice(rows.start - shift, rows.stop - shift)
