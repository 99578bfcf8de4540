"""Calls that do not fit the function: a name that it does not know, or one that it needs, as an error of our own.

Python says it by a TypeError. It is turned into a `ProblemError` once it is there, so that calls that fit cost nothing.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from inspect import Parameter, signature
from typing import Any

from covocp.base.errors import ProblemError, no_option, shown

BY_POSITION = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
BY_NAME = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
# Characters of what a docstring says of an argument: about two lines.
LONGEST = 220


def called_as(function: Callable[..., Any]) -> str:
    """What the user calls a function: "Problem.state()"; of what makes an object the class."""
    return f"{function.__qualname__.removesuffix('.__init__')}()"


def refused_call(
    function: Callable[..., Any], owner: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> ProblemError | None:
    """The error of a call that does not fit its function, or None where the TypeError came from elsewhere.

    Args:
        function: that was called.
        owner: what the user calls it.
        args: by position, an object of which it is a method among them.
        kwargs: by name.
    """
    known = signature(function)
    try:
        known.bind(*args, **kwargs)
    except TypeError:
        pass
    else:
        return None
    parameters = list(known.parameters.values())
    if parameters and parameters[0].name == "self" and args:
        parameters, args = parameters[1:], args[1:]
    by_position = [p.name for p in parameters if p.kind in BY_POSITION]
    what = _with_name(owner, by_position, args, kwargs)
    by_name = [p.name for p in parameters if p.kind in BY_NAME]
    if not any(p.kind == Parameter.VAR_KEYWORD for p in parameters):
        for name in kwargs:
            if name not in by_name:
                return no_option(what, name, kwargs[name], by_name, otherwise=_otherwise(function))
    for name in by_position[: len(args)]:
        if name in kwargs:
            return _given_twice(what, name, args[by_position.index(name)], kwargs[name])
    if len(args) > len(by_position) and not any(p.kind == Parameter.VAR_POSITIONAL for p in parameters):
        return _too_many(what, by_position, [name for name in by_name if name not in by_position], args)
    given = {*by_position[: len(args)], *kwargs}
    needed = [p.name for p in parameters if p.default is Parameter.empty and p.kind in (*BY_POSITION, *BY_NAME)]
    return _missing(function, what, [name for name in needed if name not in given], given, parameters)


def _with_name(owner: str, by_position: list[str], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> str:
    """The owner with the name that the user gives to what is declared: "Problem.state('x')"."""
    if by_position[:1] != ["name"]:
        return owner
    name = args[0] if args else kwargs.get("name")
    return f"{owner.removesuffix('()')}({name!r})" if isinstance(name, str) and owner.endswith("()") else owner


def _otherwise(function: Callable[..., Any]) -> str:
    """What to do with a name that no other one resembles: the class of a method may take it when it is made."""
    owner, _, method = function.__qualname__.rpartition(".")
    kind = getattr(sys.modules.get(function.__module__), owner, object)
    made = kind.__init__ if "__init__" in vars(kind) and kind is not object else None
    takes_options = made is not None and any(
        p.kind == Parameter.VAR_KEYWORD for p in signature(made).parameters.values()
    )
    return (
        f"remove it, or give it to {owner}() where it is an option there" if takes_options else "correct or remove it"
    )


def _given_twice(what: str, name: str, first: object, second: object) -> ProblemError:
    """Of an argument by position and by name."""
    return ProblemError(
        f"{what} is given '{name}' twice.",
        expected="each argument once",
        received=f"{shown(first, 40)} by position, {name}={shown(second, 40)} by name",
        remedy="remove one of them",
    )


def _too_many(what: str, by_position: list[str], by_name: list[str], args: tuple[Any, ...]) -> ProblemError:
    """Of more arguments by position than there are."""
    names = "".join(f" {name}," for name in by_position).rstrip(",")
    others = f"; by name: {', '.join(by_name)}" if by_name else ""
    return ProblemError(
        f"{what} is given too many arguments by position.",
        expected=(f"at most {len(by_position)} by position:{names}" if names else "none by position") + others,
        received=f"{len(args)} by position: {', '.join(shown(value, 30) for value in args)}"[:200],
        remedy=f"give the others by name, such as {by_name[0]}=" if by_name else "remove the others",
    )


def _missing(
    function: Callable[..., Any], what: str, missing: list[str], given: set[str], parameters: list[Parameter]
) -> ProblemError:
    """Of arguments that are needed; what they are stands in the docstring."""
    meanings = [f"{name}: {meaning}" for name in missing if (meaning := _meaning(function, name))]
    listed = " and ".join(f"'{name}'" for name in missing)
    return ProblemError(
        f"{what} needs {listed}.",
        expected="; ".join(meanings) or ", ".join(f"{name}=" for name in missing),
        received=", ".join(p.name for p in parameters if p.name in given) or "no argument",
        remedy=f"add {', '.join(f'{name}=' for name in missing)}",
    )


def _meaning(function: Callable[..., Any], name: str) -> str:
    """The first sentence on an argument in the docstring of a function, or of the class that it makes an object of."""
    owner: Any = function
    if function.__name__ == "__init__":
        owner = getattr(sys.modules.get(function.__module__), function.__qualname__.partition(".")[0], function)
    found = re.search(rf"^( +){name}: (.*(?:\n\1 +\S.*)*)", owner.__doc__ or "", re.MULTILINE)
    if found is None:
        return ""
    sentence = re.split(r"\.(?:\s|$)", " ".join(found[2].split()))[0]
    return sentence if len(sentence) <= LONGEST else f"{sentence[:LONGEST].rsplit(' ', 1)[0]} ..."
