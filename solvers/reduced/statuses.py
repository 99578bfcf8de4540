"""How a run of the reduced method ends: in words, and what to do then."""

from __future__ import annotations

from covocp.solvers.endings import Ending


class Status(Ending):
    """What it means, what to do."""

    SOLVED = ("solved", "")
    STOPPED = ("interrupted by the user", "")
    ITERATIONS = ("stopped at the largest number of iterations", "start closer, or allow more (max_iterations=)")
    INFEASIBLE = ("no step brings the constraints closer", "they may contradict, or start elsewhere")
    NO_PROGRESS = ("no further progress is possible at this accuracy", "method='ipopt' may find a way")
    NO_NUMBER = ("the model became NaN or inf", "add bounds that keep it in its domain")
    GROWS = (
        "the plant is too unstable to be solved in its controls alone",
        "use method='ipopt', whose nodes hold the states",
    )

    def __init__(self, words: str, advice: str) -> None:
        """Keep the parts of the value by name."""
        self.words, self.advice = words, advice

    @property
    def lost(self) -> bool:
        """Whether another start may lead somewhere."""
        return self in (Status.INFEASIBLE, Status.NO_NUMBER)

    @property
    def judged(self) -> bool:
        """Whether the point may be stationary, although the run does not say so."""
        return self is Status.NO_PROGRESS
