"""What the arguments of a public function may be, said once above the function and checked when it is called.

    @checked(runs=whole(2), progress=truth, step=optional(positive))
    def simulate(...)

A kind looks at a value and says what it should have been, or "" where it is one. What depends on other arguments, or
takes arrays and expressions, is checked where it is read (`covocp.base.checks`). Names that the function does not know,
and those that it needs, are told too (`covocp.base.calls`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from inspect import Parameter, signature
from typing import Any, ParamSpec, TypeVar

import numpy as np

from covocp.base.calls import called_as, refused_call
from covocp.base.errors import ProblemError, shown
from covocp.base.expressions import Given

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)
Kind = Callable[[Any], str]

# Whole numbers above this count nothing that fits into a memory.
MOST = 10**7


def checked(called: str = "", /, **kinds: Kind) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """The function, whose named arguments must be of these kinds.

    Args:
        called: what the user calls the arguments of, where it is not the function: "the method 'ipopt'".
        kinds: by name of the argument.

    Raises:
        ProblemError: by the function, where an argument is not of its kind, not known, or missing.
    """

    def of(function: Callable[P, R]) -> Callable[P, R]:
        parameters = signature(function).parameters.values()
        positional = [
            p.name for p in parameters if p.kind in (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
        ]
        owner = called or called_as(function)

        @wraps(function)
        def with_checks(*args: P.args, **kwargs: P.kwargs) -> R:
            for name, value in (*zip(positional, args, strict=False), *kwargs.items()):
                kind = kinds.get(name)
                if kind is not None:
                    check_argument(owner, name, kind, value)
            try:
                return function(*args, **kwargs)
            except TypeError:
                error = refused_call(function, owner, args, kwargs)
                if error is None:
                    raise
            raise error

        return with_checks

    return of


def checked_class(cls: C) -> C:
    """The class, which refuses arguments that it does not know, and says which it needs."""
    of: Any = cls
    of.__init__ = checked()(of.__init__)
    return cls


def check_argument(owner: str, name: str, kind: Kind, value: Given) -> None:
    """An argument must be of a kind.

    Raises:
        ProblemError: it is not.
    """
    expected = kind(value)
    if expected:
        raise ProblemError(
            f"The option '{name}' of {owner} has a value that does not apply.",
            expected=expected,
            received=shown(value),
            remedy=f"correct {name}=",
        )


def truth(value: Given) -> str:
    """True or False (also as 0 and 1)."""
    plain = isinstance(value, (bool, np.bool_)) or (isinstance(value, (int, np.integer)) and value in (0, 1))
    return "" if plain else "True or False"


def whole(least: int, most: int | None = MOST) -> Kind:
    """A whole number from `least` on."""
    expected = f"{least}, {least + 1}, {least + 2}, ..." + ("" if most is None else f", at most {most:.3g}")

    def kind(value: Given) -> str:
        return "" if is_whole(value, least, most) else expected

    return kind


def is_whole(value: Given, least: int = 1, most: int | None = MOST) -> bool:
    """Whether the value is a whole number (no truth value) within these limits; most=None: without an upper one."""
    kind = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return kind and bool(value >= least and (most is None or value <= most))


def is_number(value: Given) -> bool:
    """Whether the value is a finite real number, also one of numpy; no truth value."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        return False
    try:
        return bool(np.isfinite(float(value)))
    except OverflowError:  # a whole number that no float can hold
        return False


def positive(value: Given) -> str:
    """A finite number above zero."""
    return "" if is_number(value) and value > 0 else "a finite number > 0"


def share(value: Given) -> str:
    """A number in (0, 1]."""
    return "" if is_number(value) and 0 < value <= 1 else "a number in (0, 1]"


def text(value: Given) -> str:
    """Words."""
    return "" if isinstance(value, str) else "a text"


def one_of(*words: str) -> Kind:
    """One of some words."""
    expected = ", ".join(map(repr, words[:-1])) + f" or {words[-1]!r}"
    return lambda value: "" if isinstance(value, str) and value in words else expected


def mapping(value: Given) -> str:
    """A dict by name."""
    return "" if isinstance(value, Mapping) else "a dict"


def texts(value: Given) -> str:
    """A sequence of words."""
    fits = isinstance(value, (list, tuple)) and all(isinstance(word, str) for word in value)
    return "" if fits else "a list of texts"


def texts_by_name(value: Given) -> str:
    """A dict of words by words."""
    fits = isinstance(value, Mapping) and all(isinstance(word, str) for pair in value.items() for word in pair)
    return "" if fits else "a dict of name to text"


def a_function(value: Given) -> str:
    """Something to be called, also a casadi.Function."""
    return "" if callable(value) else "a function"


def positives(value: Given) -> str:
    """A sequence of finite numbers above zero; it may be empty."""
    fits = isinstance(value, (list, tuple, np.ndarray)) and np.ndim(np.asarray(value, dtype=object)) == 1
    return "" if fits and not any(positive(number) for number in value) else "a list of finite numbers > 0"


def sequence(value: Given) -> str:
    """A list or a tuple."""
    return "" if isinstance(value, (list, tuple)) else "a list"


def either(*kinds: Kind) -> Kind:
    """Any of several kinds."""
    return lambda value: " or ".join(kind(value) for kind in kinds) if all(kind(value) for kind in kinds) else ""


def optional(kind: Kind) -> Kind:
    """None, or of a kind."""

    def wanted(value: Given) -> str:
        expected = "" if value is None else kind(value)
        return expected and f"{expected}, or None"

    return wanted


def a(*types: type, called: str = "") -> Kind:
    """An object of a type."""
    expected = called or " or ".join(f"a {kind.__name__}" for kind in types)
    return lambda value: "" if isinstance(value, types) else expected
