"""Whether the linear prediction holds for a simulation, and if not, why."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, standard_deviations
from covocp.base.short_repr import short_repr
from covocp.simulation.sampling import degrees_of_freedom, mean_square_band, robust_deviation
from covocp.statement.augmented import augmented_blocks

if TYPE_CHECKING:
    from covocp.simulation.monte_carlo import MonteCarlo

# A run that ends this many predicted deviations away counts as unstable: no normal one does.
UNSTABLE = 10.0
# And the domain ends this many of them away.
LEFT = 100.0
# A share of runs below this explains nothing.
NOTICEABLE = 0.01
# Share by which deviations as flown may differ from those that the solution promises: of quadratures, not of gains.
AS_PROMISED = 0.1
# Share of the largest predicted deviation of a component on the way below which it is known exactly at the end: what is
# left is of the steps of nominal and runs.
EXACT = 1e-6
# Shares of the nominal's magnitude: below the first, what varies between runs is rounding. Where no more is predicted
# all the way, and no more varies, all runs do the same: they differ from the nominal by the steps of both alone, which
# may be up to the second; longer ones are told where the nominal is.
ROUNDED, STEPS = 1e-12, 1e-4
# Share of what the sample has in excess of the prediction from which on something explains part of it.
PART = 0.5


@dataclass(frozen=True, kw_only=True)
class Component:
    """One component at the end: predicted standard deviation, that of the sample with its band, the bias.

    exact: standard deviations up to this are zero. grown: predicted with what noise that varies adds; NaN: not known.
    """

    name: str
    predicted: float
    sample: float
    low: float
    high: float
    bias: float
    robust: float
    exact: float = 0.0
    grown: float = float("nan")

    @property
    def inside(self) -> bool:
        """Whether the prediction is inside the band of the sample."""
        if self.sample <= self.exact:
            return self.predicted <= self.exact
        return self.low <= self.predicted <= self.high

    @property
    def explained(self) -> bool:
        """Whether it is inside the band with what noise that varies adds, and that is much of the excess."""
        return self.partly and (self.inside or self.low <= self.grown <= self.high)

    @property
    def partly(self) -> bool:
        """Whether noise that varies explains much of what the sample has in excess."""
        return self.inside or self.grown**2 - self.predicted**2 >= PART * (self.sample**2 - self.predicted**2) > 0

    @property
    def ratio(self) -> float:
        """Sample over prediction; NaN where nothing is predicted."""
        return self.sample / self.predicted if self.predicted > 0 else float("nan")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Whether the linear prediction holds at the end.

    deviations: of the states of the actual system from the nominal. errors: of the estimates of states and unknowns.
    left: share of the runs that left the domain. unstable: share that did, or ended more than `UNSTABLE` predicted
    deviations away. asked: share that asked for more control than there is. holds: whether the prediction is inside the
    band for every component, of the deviations where there is a feedback, else of the errors; no run left the domain,
    and the prediction is what the solution promises. law: whether a law of the user's flew. unanswered: share of the
    runs in which it once gave no finite control; they do not count as unstable.
    too_long: what halving the given step changes, in words; "" where it is short enough. unpredicted: components of
    which the prediction is no number. broken: (name, promised, predicted) standard deviations at the end where the
    gains between the nodes do something else than the solution promises. unknown_noise: whether noise varies with what
    deviates, and what that adds is not known.
    """

    deviations: tuple[Component, ...]
    errors: tuple[Component, ...]
    left: float
    unstable: float
    asked: float
    most_asking: float
    fed_back: bool
    limited: bool
    law: bool = False
    unanswered: float = 0.0
    too_long: str = ""
    unpredicted: tuple[str, ...] = ()
    broken: tuple[tuple[str, float, float], ...] = ()
    unknown_noise: bool = False

    __repr__ = short_repr

    @property
    def decisive(self) -> tuple[Component, ...]:
        """The components that decide."""
        return self.deviations if self.fed_back else self.errors

    @property
    def holds(self) -> bool:
        """Whether the linear prediction holds."""
        as_promised = not self.unpredicted and not self.broken
        return self.left == 0.0 and as_promised and all(entry.inside for entry in self.decisive)

    @property
    def outside(self) -> tuple[str, ...]:
        """Names of the components whose prediction lies outside the band."""
        return tuple(entry.name for entry in self.decisive if not entry.inside)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it does not hold, () where it holds.

        Of "step", "unpredicted", "gains", "unanswered", "noise", "unstable", "saturated"; else "law" or "nonlinear".

        Control that a law was given, because there were no limits, explains nothing. Where noise that grows with the
        deviations explains the spread of all components, runs far away are its tails, not unstable.
        """
        if self.holds:
            return ()
        causes = {"step": self.too_long, "unpredicted": self.unpredicted and not self.broken, "gains": self.broken}
        found = [name for name, cause in {**causes, "unanswered": self.unanswered}.items() if cause]
        noise = self._noise
        found += ["noise"] if noise else []
        if (self.unstable >= NOTICEABLE and noise != "all") or self.left > self.unanswered:
            found.append("unstable")
        if self._short >= NOTICEABLE:
            found.append("saturated")
        enough = noise == "all" or any(name != "noise" for name in found)
        return tuple(found) if enough else (*found, "law" if self.law else "nonlinear")

    @property
    def _noise(self) -> str:
        """Whether noise that grows with the deviations explains the spread of "all" components, "part" of it, or ""."""
        missed = [entry for entry in self.decisive if not entry.inside]
        if not missed or not all(entry.partly for entry in missed):
            return ""
        return "all" if all(entry.explained for entry in missed) else "part"

    @property
    def headline(self) -> str:
        """Whether it holds, and for what it does not."""
        what = "spread" if self.fed_back else "errors of the filter"
        if self.holds:
            return f"The linear prediction of the {what} holds"
        listed = ", ".join(self.outside)
        return f"The linear prediction of the {what} FAILS" + (f" for {listed}" if listed else "")

    def __str__(self) -> str:
        """The verdict in words."""
        if self.holds:
            text = f"{self.headline}: it is inside the confidence band of every component."
        else:
            text = f"{self.headline}: " + "; ".join(self._because(reason) for reason in self.reasons) + "."
        missed = [entry for entry in self.errors if not entry.inside]
        if self.fed_back and missed:
            ratios = ", ".join(_compared(entry) for entry in missed)
            text += f" The errors of the filter are not the predicted ones (sample over prediction: {ratios})."
        return text

    def _because(self, reason: str) -> str:
        if reason == "step":
            return f"the given step is too long: {self.too_long}"
        if reason == "unpredicted":
            return f"the linear prediction is no number for {', '.join(self.unpredicted)}, so nothing can be compared"
        if reason == "gains":
            listed = ", ".join(f"{name} {one:.3g} promised, {_number(two)} as flown" for name, one, two in self.broken)
            return (
                f"the gains between the nodes do not do what the solution promises ({listed}): the mesh does not "
                "resolve them, give more nodes where they are steep (grid=)"
            )
        if reason == "unanswered":
            return f"in {_percent(self.unanswered)} of the runs the law once gave no finite control"
        if reason == "noise":
            missed = [entry for entry in self.decisive if not entry.inside]
            listed = ", ".join(f"{entry.name} {entry.grown:.3g}" for entry in missed)
            inside = ", inside the band" if self._noise == "all" else ", of which something is left"
            return (
                "the density of the noise varies with state and control and grows with their deviations, which the "
                f"prediction leaves out: with what they add it is {listed}{inside}"
            )
        if reason == "unstable":
            words = f"{_percent(self.unstable)} of the runs are unstable"
            gone = f" ({_percent(self.left)} left the domain)" if self.left else ""
            return words + gone + (", the law does" if self.law else ", linear gains do") + " not hold them"
        if reason == "saturated":
            most = f", {_percent(self.most_asking)} at one instant" if self.most_asking else ""
            cut = "" if self.limited else " (which they were given)"
            return f"{_percent(self.asked)} of the runs ask for more control than there is{most}{cut}"
        if reason == "law":
            return (
                f"{self._not_enough}, so this law is not the filter and feedback of the design, is "
                "stepped too rarely, or the system is too nonlinear for this spread"
            ) + (f" ({_percent(self.asked)} asked for more control than the nominal has)" if self.asked else "")
        grows = ", or the noise, which varies with it, grows with it too much" if self.unknown_noise else ""
        left = "what is left means that " if "noise" in self.reasons else f"{self._not_enough}, so "
        return f"{left}the system is too nonlinear for this spread{grows}"

    @property
    def _short(self) -> float:
        """Share of the runs that were short of control; a law without limits was given what it asked for."""
        return self.asked if self.limited or not self.law else 0.0

    @property
    def _not_enough(self) -> str:
        """That neither unstable runs nor those short of control explain what is seen: there are none, or too few."""
        if self.unstable or self.left or self._short:
            return "too few runs are unstable or short of control to explain it"
        return "no run is unstable or short of control"


def judge(sample: MonteCarlo) -> Verdict:
    """The verdict on a simulation."""
    stayed, names, n = sample.stayed, sample.augmented, sample.size
    states = sum(b.size for b in augmented_blocks(sample.blocks, names) if b.kind == "state")
    predicted, errors = (standard_deviations(v[-1]) for v in (sample.predicted, sample.predicted_error))
    flown, intended = (np.sqrt(v.clip(0.0))[:states] for v in (np.diagonal(sample.design[-1]), sample.intended))
    broken = ~(np.abs(flown - intended) <= AS_PROMISED * intended) & (intended > 0)
    # Deviations are measured by what is promised; a prediction that is no number, or far too large, excuses none.
    reference = np.where(broken, np.fmin(predicted[:states], intended), predicted[:states])
    reference = np.where(np.isfinite(reference), reference, sample.domain[:states] / LEFT)
    distance = ~(np.abs(sample.deviations[:, :states]) <= UNSTABLE * reference)
    answered = np.isinf(sample.unanswered)
    unstable = ((distance & (reference > 0)).any(axis=1) | ~stayed) & answered
    numbers = predicted if sample.fed_back else errors
    largest = np.nan_to_num(standard_deviations(sample.predicted), nan=0.0, posinf=0.0).max(axis=0)
    exact = EXACT * largest
    magnitude = np.abs(sample.nominal).max(axis=0, initial=0.0)
    same = np.where(largest <= ROUNDED * magnitude, magnitude, 0.0)
    # An error that dies out leaves what the steps of runs and nominal differ by, in all runs alike: feedback or not.
    forgotten = np.where(np.nan_to_num(errors, nan=np.inf) <= ROUNDED * magnitude, magnitude, same)
    to_error = np.hstack([-np.eye(n), np.eye(n)])
    more = (np.diagonal(v) for v in (sample.grown[:n, :n], to_error @ sample.grown @ to_error.T))
    grown, grown_errors = (np.sqrt((v**2 + w).clip(0.0)) for v, w in zip((predicted, errors), more, strict=True))
    level = (stayed, sample.level, exact)
    return Verdict(
        deviations=_entries(names[:states], predicted, grown, sample.deviations, *level, same),
        errors=_entries(names, errors, grown_errors, sample.estimates - sample.deviations, *level, forgotten)
        if sample.estimated
        else (),
        left=sample.left_share,
        unstable=float(unstable.mean()),
        asked=sample.asked_share,
        most_asking=float(sample.asking.max(initial=0.0)),
        fed_back=sample.fed_back,
        limited=sample.limited,
        law=sample.filter == "law",
        unanswered=float(1.0 - answered.mean()),
        too_long="" if sample.step.settled or not sample.step.given else sample.step.reason,
        unpredicted=tuple(name for name, value in zip(names, numbers, strict=True) if not np.isfinite(value)),
        unknown_noise=bool(np.isnan(sample.grown).any()),
        broken=tuple((names[i], float(intended[i]), float(flown[i])) for i in np.flatnonzero(broken).tolist()),
    )


def _entries(
    names: tuple[str, ...],
    predicted: Array,
    grown: Array,
    values: Array,
    stayed: Array,
    level: float,
    exact: Array,
    same: Array,
) -> tuple[Component, ...]:
    """The components of some terminal values, (R, rows); `same`: magnitude of what all runs should do, else 0."""
    inside = values[stayed]
    result = []
    for i, name in enumerate(names):
        column = inside[:, i]
        square = float(np.mean(column**2)) if column.size else np.nan
        fourth = float(np.mean(column**4)) if column.size else np.nan
        alike = column.size and float(column.std()) <= ROUNDED * same[i]
        low, high = mean_square_band(square, degrees_of_freedom(column.size, square, fourth), level)
        result.append(
            Component(
                name=name,
                predicted=float(predicted[i]),
                sample=float(np.sqrt(square)),
                low=float(np.sqrt(low)),
                high=float(np.sqrt(high)),
                bias=float(column.mean()) if column.size else np.nan,
                robust=float(robust_deviation(values[:, i : i + 1])[0]),
                exact=max(float(exact[i]), STEPS * float(same[i]) if alike else 0.0),
                grown=float(grown[i]),
            )
        )
    return tuple(result)


def _compared(entry: Component) -> str:
    """Sample over prediction, or both where nothing is predicted."""
    if entry.predicted > 0:
        return f"{entry.name} {entry.ratio:.3g}"
    return f"{entry.name} {entry.sample:.3g} over {entry.predicted:.3g}"


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "beyond all numbers"


def _percent(share: float) -> str:
    """A share in words."""
    return f"{100 * share:.3g} %"
