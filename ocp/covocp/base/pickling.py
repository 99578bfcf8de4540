"""What is made of symbols and functions of CasADi cannot be pickled, and says so; results are pickled without them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
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


def pickled_without(**left: Callable[[], Any]) -> Callable[[Kind], Kind]:
    """Let the objects of a class, none of which changes, be pickled without some fields; copies are themselves.

    Args:
        left: by the name of the field what makes that which is in its place in another process, such as `dict` for
            symbols by name: what is asked for by a name has its answer there too.

    Returns:
        The decorator of a frozen dataclass; it stands above `@dataclass`.
    """

    def decorated(kind: Kind) -> Kind:
        def reduced(self: Any, protocol: object) -> tuple[Any, ...]:
            kept = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left}
            return _restored, (kind, kept, left)

        for name, function in (("__reduce_ex__", reduced), ("__copy__", _itself), ("__deepcopy__", _itself)):
            setattr(kind, name, function)
        return kind

    return decorated


def _restored(kind: type[Any], kept: Mapping[str, Any], left: Mapping[str, Callable[[], Any]]) -> Any:
    """An object from what was pickled of it."""
    return kind(**kept, **{name: make() for name, make in left.items()})


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
