"""From starts to an outcome: one start after the other until the method finds its way, or the best of many."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import field, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import Interrupted, OutsideDomainError, ProblemError, warn_user
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Guess, Merit, Outcome, Prepared
from covocp.solution.solution import Solution
from covocp.transcription.starts import completed
from covocp.transcription.steering import nominal_states
from covocp.transcription.trajectory import Trajectory, between

if TYPE_CHECKING:
    from covocp.extremal.links import ChainOutcome
    from covocp.solution.phases import PhasesSolution

AnyOutcome: TypeAlias = "Outcome | ChainOutcome"
Found = TypeVar("Found", Outcome, Solution)
Start = TypeVar("Start")
# Starts that are tried where a method loses its way.
TRIED = 4
# A run has come to where a rival begins if the states differ nowhere by more than this share of how far they move.
APART = 0.05
# A rival costs what it was thought to, up to this share.
TOLD = 0.01
# Starts that are bent to other sides: so many are run at most. Those that cost and learn the same up to this share are
# mirror images. A rival counts where it is cheaper by more than the last share.
MOST_SIDES, SAME, CHEAPER = 2, 1e-9, 1e-7
# Places on the way from where a rival begins to what was found at which the cost is looked at.
ALONG = (0.0, 1 / 6, 1 / 3, 1 / 2, 2 / 3, 5 / 6)
# A violation of conditions that is little, in units of their rows.
LITTLE = 1e-2
NO_MERIT = Merit(np.nan, np.nan, np.nan)
# Of a problem made ready: the sides that its last run from them has compared, and from which of them its best came.
_LED: WeakKeyDictionary[Prepared, tuple[tuple[Trajectory, ...], Guess]] = WeakKeyDictionary()


def from_starts(
    prepared: Prepared, values: Array, guesses: Iterable[Guess], reporter: Progress
) -> tuple[Outcome, Guess]:
    """Solve from the first start from which the method finds its way, and from its rivals: the cheapest counts.

    A method that loses its way (`wandered` among its counts) is stopped while other starts are left. Where it does from
    all of them, the first run counts: it is made again, and not stopped, where it was stopped. Where a run fails from a
    start that a feedback holds, there is another one that is left to itself. Rivals, which come first among the
    guesses, are tried after the first start, but for those to whose way that has led already.

    Returns:
        The outcome, and the start from which it came.

    Raises:
        OutsideDomainError: no start lies within the domain of the model (says what the first one lacks).
    """
    runs = _Runs(prepared=prepared, values=values, reporter=reporter)
    rivals, others = _parted(guesses)
    own = next(others, None)
    if own is not None:
        first, *beside = _sides(prepared, values, own) if own.sides else [own]
        rivals, others = [*beside, *rivals], chain([first], others)
    for count in range(TRIED):
        guess = next(others, None)
        more = guess is not None and runs.goes_on(guess)
        if count == 0:
            runs.compare(rivals)
        if not more or reporter.stop or runs.trusted:
            break
    outcome, start = runs.best()
    if own is not None and own.sides and start.alike and outcome.converged and not reporter.stop:
        _LED[prepared] = own.sides, start
    return outcome, start


def _sides(prepared: Prepared, values: Array, own: Guess) -> list[Guess]:
    """The start, then those bent to other sides that are worth a run, its rivals.

    Where the same were compared before, the one that has led to the best: so it does again.
    """
    sides, led = _LED.get(prepared, ((), own))
    if sides is own.sides:
        return [replace(led, rival=False)]
    first, *mirrored = own.sides
    alone = merit_of(prepared, values, own.trajectory)  # first: its magnitudes are those of the program
    alone = alone if first is own.trajectory else merit_of(prepared, values, first)
    merits = [(merit_of(prepared, values, t), Guess(trajectory=t, alike=True, rival=True)) for t in mirrored]
    return [replace(own, alike=True), *worth_a_run(alone, merits)]


def merit_of(prepared: Prepared, values: Array, trajectory: Trajectory) -> Merit:
    """Of a trajectory; NaN where the model has no values along it: what runs from there says so."""
    try:
        return prepared.merit(values, trajectory)
    except (OutsideDomainError, RuntimeError, np.linalg.LinAlgError):  # what CasADi raises is a RuntimeError
        return NO_MERIT


def worth_a_run(own: Merit, others: Sequence[tuple[Merit, Start]]) -> list[Start]:
    """Of other starts with their merits those that are worth a run beside the problem's own one: the best first.

    Mirror images of that, and of one another, are not.
    """
    if not np.isfinite(own).all():
        return []
    finite = [entry for entry in others if np.isfinite(entry[0]).all()]
    little = max([own.violation, *(merit.violation for merit, _ in finite)]) <= LITTLE
    size = max([abs(own.cost), *(abs(merit.cost) for merit, _ in finite)])
    found: list[tuple[Merit, Start]] = []
    for merit, start in sorted(finite, key=lambda entry: (0.0 if little else entry[0].violation, entry[0].cost)):
        if not any(alike(merit, other, size) for other in (own, *(kept for kept, _ in found))):
            found.append((merit, start))
    return [start for _, start in found[:MOST_SIDES]]


def alike(one: Merit, other: Merit, size: float) -> bool:
    """Whether two starts are mirror images of one another: costs, beside this size of them, and conditions agree."""
    conditions = max(abs(one.violation - other.violation), abs(one.mark - other.mark) / max(1.0, abs(one.mark)))
    return abs(one.cost - other.cost) <= SAME * size and conditions <= SAME


def _as_told(outcome: Outcome, rival: Guess) -> bool:
    """Whether an outcome costs what a rival was thought to."""
    return bool(abs(cost_of(outcome) - rival.about) <= TOLD * abs(rival.about))


def _parted(guesses: Iterable[Guess]) -> tuple[list[Guess], Iterator[Guess]]:
    """The rivals, which come first, and the other starts, which are made when they are asked for."""
    rest = iter(guesses)
    rivals: list[Guess] = []
    for guess in rest:
        if not guess.rival:
            return rivals, chain([guess], rest)
        rivals.append(guess)
    return rivals, rest


@dataclass(kw_only=True)
class _Runs:
    """Runs of a method from several starts."""

    prepared: Prepared
    values: Array
    reporter: Progress
    tried: list[tuple[Outcome, Guess]] = field(default_factory=list)
    refused: list[OutsideDomainError] = field(default_factory=list)
    trusted: bool = False
    left: int = 0  # rivals that a limit of time or iterations has left without an outcome

    __repr__ = short_repr

    def run(self, guess: Guess) -> Outcome | None:
        """The outcome from a start; None where that lies outside the domain of the model."""
        try:
            outcome = self.prepared.solve(self.values, replace(guess, tentative=not guess.warm), self.reporter)
        except OutsideDomainError as error:
            self.refused.append(error)
            return None
        self.tried.append((outcome, guess))
        return outcome

    def goes_on(self, guess: Guess) -> bool:
        """Try a start that is no rival; whether what comes of it says little of those after it."""
        outcome = self.run(guess)
        if outcome is None:
            return True
        return not outcome.converged and (bool(outcome.stats.get("wandered")) or guess.held)

    def compare(self, rivals: list[Guess]) -> None:
        """Try the rivals, but for those to whose way a run has led already, or that will be dearer for certain.

        What they will cost is certain, and the best of them are found, where one of them has come to cost that.
        """
        for rival in rivals:
            led = self._led(rival)
            self.trusted |= led is not None and _as_told(led, rival)
        for count, rival in enumerate(rivals):
            if self.reporter.stop:
                self.left += len(rivals) - count
                break
            least = min((cost_of(one) for one, _ in self.tried if one.converged), default=np.inf)
            certain = self._led(rival) is not None or (self.trusted and rival.about >= least)
            chosen = None if certain else self._on_its_way(rival)
            if chosen is not None:
                outcome = self.run(chosen)
                if outcome is not None and outcome.converged:
                    self.trusted |= _as_told(outcome, rival)
                elif self.reporter.stop:
                    self.left += 1

    def _on_its_way(self, rival: Guess) -> Guess | None:
        """From where to run for a rival: None where the cost falls all the way from there to what was found.

        A bend that is far too large says nothing of valleys: its own cost falls whatever lies below. Then what was
        found is turned to the side of the rival, which is as large as it is best on the other one.
        """
        found = [outcome for outcome, _ in self.tried if outcome.converged]
        if not rival.alike or not found:
            return rival
        best = min(found, key=cost_of)
        place = self._before_a_hump(rival.trajectory, best)
        turned = _turned(self.tried[0][1].trajectory, rival.trajectory, best) if place is None else None
        if turned is not None:
            place = self._before_a_hump(turned, best)
        return None if place is None else replace(rival, trajectory=place)

    def _before_a_hump(self, begins: Trajectory, best: Outcome) -> Trajectory | None:
        """Where the cost is least on the straight way to what was found; None where it falls all the way.

        There is no other valley then. Nothing is known of that where conditions are violated on the way, which may lie
        between two valleys: then the way begins where it does.
        """
        way = [between(begins, best.extremal.trajectory, share) for share in ALONG]
        merits = [merit_of(self.prepared, self.values, place) for place in way]
        costs = np.array([*(merit.cost for merit in merits), cost_of(best)])
        if not (max(merit.violation for merit in merits) <= LITTLE and np.isfinite(costs).all()):
            return begins
        if (np.diff(costs) < 0.0).all():
            return None
        valleys = np.flatnonzero((costs[:-1] <= costs[1:]) & (np.append(np.inf, costs[:-2]) >= costs[:-1]))
        return way[int(min(valleys, key=lambda k: costs[k]))]

    def _led(self, rival: Guess) -> Outcome | None:
        """A run that has come about to where a rival begins."""
        begins = rival.trajectory.x
        for outcome, _ in self.tried:
            ends = outcome.extremal.trajectory.x
            alike = outcome.converged and ends.shape == begins.shape
            if alike and (np.abs(ends - begins) <= APART * np.ptp(ends, axis=0)).all():
                return outcome
        return None

    def best(self) -> tuple[Outcome, Guess]:
        """The cheapest outcome with the counts of all; where none converged that of the last start that is no rival."""
        if not self.tried:
            raise self.refused[0]
        outcome, guess = self._best()
        if self.left and outcome.converged:
            outcome = replace(outcome, stats={**outcome.stats, "untried": self.left})
        return outcome, guess

    def _best(self) -> tuple[Outcome, Guess]:
        converged = [one for one in self.tried if one[0].converged]
        if any(guess.rival for _, guess in self.tried) and converged:
            outcome, guess = min(converged, key=lambda one: cost_of(one[0]))
            first, least = cost_of(converged[0][0]), cost_of(outcome)
            outcome, guess = converged[0] if first - least <= CHEAPER * abs(least) else (outcome, guess)
            return _with_all(outcome, [one for one, _ in self.tried]), guess
        tried = [one for one in self.tried if not one[1].rival] or self.tried
        outcome, guess = tried[-1]
        if not outcome.converged and tried[0][1].held and not tried[0][0].stats.get("wandered"):
            outcome, guess = tried[0]
        elif not outcome.converged and outcome.stats.get("wandered") and not self.reporter.stop:
            guess = tried[0][1]
            outcome = self.prepared.solve(self.values, guess, self.reporter)
        if len(self.tried) > 1:
            outcome = replace(outcome, stats={**outcome.stats, "tried": len(self.tried)})
        return outcome, guess


def _with_all(best: Outcome, outcomes: list[Outcome]) -> Outcome:
    """The best outcome with the iterations and times of all runs."""
    if len(outcomes) == 1:
        return best
    names = [name for name in ("iterations", "solve_seconds") if name in best.stats]
    return with_stats(best, tried=len(outcomes), **{name: sum(one.stats[name] for one in outcomes) for name in names})


def _turned(first: Trajectory, rival: Trajectory, best: Outcome) -> Trajectory | None:
    """What was found with those controls turned to the other side which a rival has there; None where it has none."""
    extremal, middle = best.extremal, 0.5 * (first.u + rival.u)
    found = extremal.trajectory
    if found.u.shape != middle.shape:
        return None
    apart, sizes = np.abs(rival.u - first.u).max(axis=0), np.abs(first.u - middle).max(axis=0)
    across = (apart > 0.0) & (apart >= sizes)
    if not across.any():
        return None
    st, mesh, parameters = extremal.statement, extremal.mesh, extremal.parameters
    u = np.where(across, np.clip(2.0 * middle - found.u, *st.control_bounds), found.u)
    start, duration = found.x[0], float(found.duration)
    try:
        x = nominal_states(st, mesh, start, u, duration, parameters)
        return completed(st, mesh, parameters, u, start=start, duration=duration, x=x)
    except (ProblemError, RuntimeError):  # the model has no values there; CasADi's
        return None


def mention_left(error: OutsideDomainError) -> None:
    """Warn that the solution given as a guess was left for the problem's own start."""
    problem = str(error).splitlines()[0]
    warn_user(f"The solution that was given is no guess for these values, so the own start was taken: {problem}")


def best_of(
    prepared: Any,
    values: Any,
    guesses: Iterable[Any],
    count: int,
    reporter: Progress,
    own: Callable[[], tuple[AnyOutcome, Any]] | None = None,
) -> Any:
    """The cheapest converged outcome of several starts, with the costs of all of them (NaN: did not converge).

    `own`: how the problem is solved without random starts, which comes first.

    Of one problem, or of several phases: then parameters and guesses are tuples, one for each.

    A start outside the domain of the model counts as one that did not converge.

    Raises:
        ProblemError: all of them lie outside it, or cannot begin (says what the first one lacks).
    """
    best: Any = None
    stopped: tuple[int, Any] | None = None
    refused: list[ProblemError] = []
    costs: list[float] = []
    for guess in chain([] if own is None else [None], guesses):
        try:
            if guess is None and own is not None:
                outcome, _ = own()
            else:
                outcome = prepared.solve(values, _tentative(guess), reporter)
        except ProblemError as error:
            if guess is not None and not isinstance(error, OutsideDomainError):
                raise
            refused.append(error)
            costs.append(np.nan)
            continue
        cost = cost_of(outcome)
        costs.append(cost if outcome.converged else np.nan)
        if best is None or (outcome.converged, -cost) > (best.converged, -cost_of(best)):
            best = outcome
        if stopped is None and guess is not None and outcome.stats.get("wandered"):
            stopped = len(costs) - 1, guess
        if reporter.stop:
            break
    if best is None:
        raise refused[0]
    if not best.converged and stopped is not None and not reporter.stop:
        place, guess = stopped
        best = prepared.solve(values, guess, reporter)
        costs[place] = cost_of(best) if best.converged else np.nan
    return replace(best, stats={**best.stats, "starts": costs, "asked": count})


def _tentative(guess: Guess | tuple[Guess, ...]) -> Any:
    """A guess, or one for each phase, from which a method need not find its way."""
    if isinstance(guess, Guess):
        return replace(guess, tentative=True)
    return tuple(replace(own, tentative=True) for own in guess)


def cost_of(outcome: Outcome | ChainOutcome) -> float:
    """All terms together."""
    return float(sum(outcome.cost_terms.values())) if isinstance(outcome, Outcome) else outcome.cost


def rank(outcome: Outcome) -> tuple[float, float]:
    """Less is better: what meets the conditions by its cost, anything else by what it violates."""
    numbers = max(outcome.violations.values(), default=0.0), cost_of(outcome)
    violation, cost = (number if np.isfinite(number) else np.inf for number in numbers)
    return violation, cost


def counted(first: AnyOutcome | Solution, second: AnyOutcome) -> dict[str, Any]:
    """Iterations and times of two runs together."""
    names = ("iterations", "build_seconds", "solve_seconds")
    both = [name for name in names if name in first.stats and name in second.stats]
    return {name: first.stats[name] + second.stats[name] for name in both}


def with_stats(found: Found, /, **stats: Any) -> Found:
    """An outcome, or a solution, with more that is told of it."""
    return replace(found, stats={**found.stats, **stats})


def interrupted(solution: Solution | PhasesSolution) -> Interrupted:
    """What a run ends with that Ctrl-C stopped: it carries what was found until then."""
    starts = solution.stats.get("starts")
    if starts is None:
        found = "the last iterate" if not solution.converged else "a solution"
    else:
        found = f"the best of {len(starts)} of {solution.stats['asked']} starts"
        found += "" if solution.converged else ", of which none converged"
    return Interrupted(f"Interrupted. On this error (.solution): {found}.", solution=solution)  # type: ignore[arg-type]
