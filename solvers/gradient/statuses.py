"""How a run of the gradient method ends: in words, and what to do then."""

from __future__ import annotations

from covocp.solvers.endings import Ending

RAISE_WEIGHT = "raise the weight, or weight_factor"


class Status(Ending):
    """What it means, what to do."""

    SOLVED = ("solved", "")
    STOPPED = ("interrupted by the user", "")
    ITERATIONS = ("stopped at the largest number of iterations", "start closer, or allow more")
    UNMET = ("the terminal conditions do not come closer", "the bounds may forbid them, or start elsewhere")
    UNMET_BY_FIXED_WEIGHT = ("the terminal conditions do not come closer", RAISE_WEIGHT)
    DIVERGING = ("the steps diverge", RAISE_WEIGHT)
    NO_DECREASE = (
        "no step lowers the cost as predicted",
        "the slopes may be wrong at this mesh; use more intervals",
    )
    NO_NUMBER = (
        "the slopes are NaN or inf where the cost is not",
        "bound what the model cannot be differentiated at",
    )
    VIOLATED = ("the penalties do not remove the violations", "they may contradict")

    def __init__(self, words: str, advice: str) -> None:
        """Keep the parts of the value by name."""
        self.words, self.advice = words, advice

    def told(self, misled: str) -> str:
        """In words; of a run that failed with steps that are too long these, `misled`, are the reason."""
        by_itself = self in (Status.SOLVED, Status.STOPPED, Status.ITERATIONS)
        return misled if misled and not by_itself else str(self)
