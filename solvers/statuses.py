"""How a run of Ipopt ends: in words, what to do then, and what it means for the starts that are left."""

from __future__ import annotations

from covocp.solvers.endings import Ending


class Status(Ending):
    """Ipopt's own name of the ending, what it means, what to do."""

    SOLVED = ("Solve_Succeeded", "solved", "")
    ACCEPTABLE = (
        "Solved_To_Acceptable_Level",
        "solved to the acceptable level only",
        "the tolerance asked for was not reached",
    )
    INFEASIBLE = (
        "Infeasible_Problem_Detected",
        "converged to a point of local infeasibility",
        "the constraints may contradict",
    )
    ITERATIONS = (
        "Maximum_Iterations_Exceeded",
        "stopped at the largest number of iterations",
        "start closer, or allow more (max_iterations=)",
    )
    RESTORATION = (
        "Restoration_Failed",
        "the restoration of feasibility failed",
        "the constraints may contradict, or start elsewhere",
    )
    STOPPED = ("User_Requested_Stop", "interrupted by the user", "")
    DIVERGING = ("Diverging_Iterates", "the iterates diverge", "the cost may be unbounded below; add bounds")
    NO_PROGRESS = ("Search_Direction_Becomes_Too_Small", "no further progress is possible at this accuracy", "")
    NO_STEP = (
        "Error_In_Step_Computation",
        "no step from there leads on at this accuracy",
        "method='ipopt' with hessian='exact' may find a way",
    )
    NO_NUMBER = (
        "Invalid_Number_Detected",
        "the model became NaN or inf",
        "add bounds that keep it in its domain",
    )

    def __init__(self, name_of_ipopt: str, words: str, advice: str) -> None:
        """Keep the parts of the value by name."""
        self.name_of_ipopt, self.words, self.advice = name_of_ipopt, words, advice

    @property
    def lost(self) -> bool:
        """Whether another start may lead somewhere."""
        return self in (Status.INFEASIBLE, Status.RESTORATION, Status.NO_NUMBER)

    @property
    def judged(self) -> bool:
        """Whether the point may be stationary, although Ipopt does not say so."""
        return self in (Status.ACCEPTABLE, Status.NO_PROGRESS, Status.NO_STEP)


def status_of(name: str) -> Status | None:
    """The ending of that name; None for those of other plugins."""
    return next((status for status in Status if status.name_of_ipopt == name), None)
