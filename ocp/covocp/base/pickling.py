"""What holds symbols and functions of CasADi cannot be pickled, and says so in words that help."""

from __future__ import annotations

from typing import Any, NoReturn, TypeVar

from covocp.base.errors import ProblemError

Kind = TypeVar("Kind", bound=type[Any])


def not_pickled(kind: Kind) -> Kind:
    """Let the objects of a class, none of which changes, refuse to be pickled; copies are the objects themselves.

    Problems, solvers and solutions hold them, so that these refuse it too.

    Args:
        kind: a frozen dataclass; the decorator stands above `@dataclass`.

    Returns:
        The same class.
    """
    for name, function in (("__reduce_ex__", _refused), ("__copy__", _itself), ("__deepcopy__", _itself)):
        setattr(kind, name, function)
    return kind


def _refused(self: object, protocol: object) -> NoReturn:
    """What pickle calls.

    Raises:
        ProblemError: always.
    """
    raise ProblemError(
        "Problems, solvers and solutions cannot be pickled.",
        expected="numbers; the problem in them is made of symbols and functions of CasADi",
        received=f"a {type(self).__name__.lower()} with its symbols",
        remedy="write a solution by solution.save(path) and read it by covocp.load(path), in another process too (what "
        "was read can be pickled); build Problem and Solver anew there",
    )


def _itself(self: Any, memo: object = None) -> Any:
    """What never changes needs no copy."""
    return self
