"""Solutions that were kept in files, with the problem that was solved attached again."""

from __future__ import annotations

from pathlib import Path

from covocp.base.checks import check_kind
from covocp.base.threads import one_at_a_time
from covocp.problem.builder import Problem
from covocp.solution.attaching import attached
from covocp.solution.solution import Solution
from covocp.solution.storage import read


@one_at_a_time
def load(path: str | Path, problem: Problem | None = None) -> Solution:
    """Read a solution that `save` wrote; nothing in the file is executed.

    Args:
        path: a .npz or .json file.
        problem: the problem that was solved, attached again: expressions of its symbols, `check_path` and everything
            else that needs the model can then be asked for. Without it the solution knows names only. It is compared
            with the problem that was solved: symbols, duration, bounds, limits, initial and final values and variances,
            declared parameters and means, and the values of equations, noises, costs and constraints at points kept in
            the file. A parameter may also have the value that was solved for; guesses and scales may differ.

    Returns:
        The solution, equal to the saved one to the last bit. With a problem, what its values at the nodes violate is
        among its `violations`.

    Raises:
        ProblemError: no such file, not a file of this format or version, damaged (a checksum tells), or of another
            problem (says what differs).
    """
    solution = read(path)
    if problem is None:
        return solution
    check_kind(problem, Problem, "give the problem that was solved, or load without one")
    return attached(solution, problem.statement())
