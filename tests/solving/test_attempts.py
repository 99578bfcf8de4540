"""From several starts to one outcome: which are tried, and which counts."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np

from covocp.extremal.extremal import Extremal, Guess, Outcome
from covocp.solving.attempts import from_starts
from covocp.transcription.trajectory import Trajectory


def start(level: float, *, rival: bool = False, about: float = np.nan) -> Guess:
    """A start that is told by the height of its path."""
    x = np.array([[0.0], [level], [1.0]])
    trajectory = Trajectory(x=x, u=np.zeros((3, 1)), e=np.zeros((3, 0)), duration=1.0)
    return Guess(trajectory=trajectory, rival=rival, about=about)


def outcome(guess: Guess, cost: float, *, converged: bool = True, wandered: bool = False) -> Outcome:
    """That ends where it began."""
    extremal: Extremal = SimpleNamespace(trajectory=guess.trajectory)  # type: ignore[assignment]
    stats = {"iterations": 1, "solve_seconds": 0.0, **({"wandered": "far"} if wandered else {})}
    return Outcome(
        extremal=extremal, cost_terms={"running": cost}, converged=converged, message="", violations={}, stats=stats
    )


@dataclass
class Method:
    """A method that is told by the height of a start what comes of it, and after how many runs a limit is reached."""

    known: dict[float, dict]
    limit: int = 100
    mesh: None = None
    runs: list[float] = field(default_factory=list)
    stop: bool = False

    def solve(self, _, guess, __):
        level = float(guess.trajectory.x[1, 0])
        self.runs.append(level)
        self.stop = len(self.runs) >= self.limit
        return outcome(guess, **self.known[level])


def cost_from(method: Method, *guesses: Guess) -> float:
    found, _ = from_starts(method, np.zeros(0), iter(guesses), method)
    return sum(found.cost_terms.values()) if found.converged else np.inf


def test_dearer_rivals_do_not_displace_the_first_start():
    method = Method({5.0: {"cost": 3.0}, -5.0: {"cost": 2.0}, 1.0: {"cost": 1.0}})
    assert cost_from(method, start(5.0, rival=True), start(-5.0, rival=True), start(1.0), start(9.0)) == 1.0
    assert method.runs == [1.0, 5.0, -5.0]


def test_a_poor_rival_does_not_stop_the_starts_after_one_that_lost_its_way():
    method = Method({5.0: {"cost": 1e4}, 1.0: {"cost": 0.0, "converged": False, "wandered": True}, 2.0: {"cost": 5.0}})
    assert cost_from(method, start(5.0, rival=True, about=4.0), start(1.0), start(2.0), start(9.0)) == 5.0


def test_a_rival_that_costs_what_it_was_thought_to_stops_them():
    method = Method({5.0: {"cost": 4.01}, 1.0: {"cost": 0.0, "converged": False, "wandered": True}})
    assert cost_from(method, start(5.0, rival=True, about=4.0), start(1.0), start(2.0)) == 4.01


def test_a_rival_counts_that_is_solved_as_a_limit_is_reached():
    method = Method({5.0: {"cost": 2.0}, 1.0: {"cost": 3.0}}, limit=2)
    assert cost_from(method, start(5.0, rival=True), start(-5.0, rival=True), start(1.0)) == 2.0
    assert method.runs == [1.0, 5.0]


def test_the_way_that_the_first_start_led_to_is_not_tried_again():
    method = Method({1.0: {"cost": 3.0}, -5.0: {"cost": 2.5}, 5.0: {"cost": 9.0}})
    rivals = [start(-5.0, rival=True, about=2.5), start(1.01, rival=True, about=3.0), start(5.0, rival=True, about=3.1)]
    assert cost_from(method, *rivals, start(1.0)) == 2.5
    assert method.runs == [1.0, -5.0]


def test_where_all_fail_the_first_start_counts():
    failed = {"cost": 0.0, "converged": False}
    method = Method({1.0: failed, 5.0: failed})
    found, guess = from_starts(method, np.zeros(0), iter([start(5.0, rival=True), start(1.0)]), method)
    assert not found.converged
    assert guess.trajectory.x[1, 0] == 1.0
