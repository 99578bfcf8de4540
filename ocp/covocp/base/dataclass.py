"""Python's dataclasses, defined in a tenth of the time: what is compiled for a class is compiled when it is first made.

`dataclasses.dataclass` compiles six functions for each frozen class, which takes half a millisecond; the hundreds of
classes of this package so took longer to import than numpy. Of those functions only the constructor depends on the
fields in a way that costs when it runs: it is compiled at the first construction, the others are closures.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import MISSING, Field, FrozenInstanceError
from reprlib import recursive_repr
from typing import TYPE_CHECKING, Any


class _Factory:
    """Where a signature shows that the default is made anew for each object."""

    def __repr__(self) -> str:
        return "<factory>"


_FACTORY = _Factory()


class _LaterInit:
    """In place of the constructor of a class until it is first asked for, by Python or by anybody else."""

    def __init__(self, cls: type[Any]) -> None:
        self._cls = cls

    def __get__(self, instance: object | None, owner: type | None = None) -> Any:
        init = _compiled_init(self._cls)
        _put(self._cls, "__init__", init)
        return init.__get__(instance, owner)


def _compiled_init(cls: type[Any]) -> Any:
    """The constructor of a frozen dataclass, with the signature that Python's own has."""
    own = dataclasses.fields(cls)
    names: dict[str, Any] = {"_set": object.__setattr__, "_FACTORY": _FACTORY}
    by_position: list[str] = []
    by_name: list[str] = []
    lines: list[str] = []
    for f in own:  # in a function that has the defaults, as Python's own is made
        value, argument = f.name, f.name
        if f.default_factory is not MISSING:
            names[f"_make_{f.name}"] = f.default_factory
            value = f"_make_{f.name}()"
            if f.init:
                argument, value = f"{f.name}=_FACTORY", f"{value} if {f.name} is _FACTORY else {f.name}"
        elif f.default is not MISSING:
            if not f.init:
                continue  # it is the attribute of the class
            names[f"_default_{f.name}"] = f.default
            argument = f"{f.name}=_default_{f.name}"
        if f.init:
            (by_name if f.kw_only else by_position).append(argument)
        lines.append(f"  _set(self, {f.name!r}, {value})\n")
    if hasattr(cls, "__post_init__"):
        lines.append("  self.__post_init__()\n")
    arguments = ", ".join(["self", *by_position, *(["*", *by_name] if by_name else [])])
    made: dict[str, Any] = {}
    body = "".join(lines) or "  pass\n"
    text = f"def make({', '.join(names)}):\n def __init__({arguments}):\n{body} return __init__"
    exec(text, vars(sys.modules[cls.__module__]), made)  # of its module: annotations are resolved there
    init = made["make"](**names)
    given = [f for kw_only in (False, True) for f in own if f.init and f.kw_only == kw_only]
    init.__annotations__ = {**{f.name: f.type for f in given}, "return": None}
    return init


def _immutable(cls: type[Any], names: frozenset[str]) -> dict[str, Callable[..., Any]]:
    """What refuses that a field is changed; a subclass may have other attributes."""

    def assign(self: Any, name: str, value: Any) -> None:
        if type(self) is cls or name in names:
            raise FrozenInstanceError(f"cannot assign to field {name!r}")
        super(cls, self).__setattr__(name, value)

    def delete(self: Any, name: str) -> None:
        if type(self) is cls or name in names:
            raise FrozenInstanceError(f"cannot delete field {name!r}")
        super(cls, self).__delattr__(name)

    return {"__setattr__": assign, "__delattr__": delete}


def _shown(own: tuple[Field[Any], ...]) -> dict[str, Callable[..., Any]]:
    """What writes an object out as the call that makes it."""

    def show(self: Any) -> str:
        entries = ", ".join([f"{f.name}={getattr(self, f.name)!r}" for f in own if f.repr])
        return f"{type(self).__qualname__}({entries})"

    return {"__repr__": recursive_repr()(show)}


def _compared(own: tuple[Field[Any], ...]) -> dict[str, Callable[..., Any]]:
    """What compares objects by their fields, and the number for a dictionary."""

    def equal(self: Any, other: Any) -> Any:
        if type(other) is not type(self):
            return NotImplemented
        return tuple([getattr(self, n) for n in compared]) == tuple([getattr(other, n) for n in compared])

    def number(self: Any) -> int:
        return hash(tuple([getattr(self, n) for n in hashed]))

    compared = [f.name for f in own if f.compare]
    hashed = [f.name for f in own if (f.compare if f.hash is None else f.hash)]
    return {"__eq__": equal, "__hash__": number}


def _put(cls: type[Any], name: str, function: Any) -> None:
    """A function as a method, as if it stood in the body of the class."""
    function.__module__, function.__name__, function.__qualname__ = cls.__module__, name, f"{cls.__qualname__}.{name}"
    setattr(cls, name, function)


def _frozen(cls: type[Any], kw_only: bool, eq: bool) -> type[Any]:
    """A class as a frozen dataclass; what stands in its body stays."""
    dataclasses.dataclass(init=False, repr=False, eq=False, kw_only=kw_only)(cls)
    with suppress(AttributeError):  # asked for by Python's decorator where somebody derives a dataclass
        params = cls.__dataclass_params__
        params.init, params.repr, params.eq, params.frozen = True, True, eq, True
    own, body = dataclasses.fields(cls), vars(cls)
    functions = _immutable(cls, frozenset([f.name for f in own]))
    if eq:
        functions |= _compared(own)
    if "__repr__" not in body:
        functions |= _shown(own)
    for name, function in functions.items():
        if body.get(name) is None:  # Python puts None for the hash beside an __eq__
            function.__annotations__ = {}  # help() shows none
            _put(cls, name, function)
    if "__init__" not in body:
        cls.__init__ = _LaterInit(cls)
    return cls


if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:

    def dataclass(cls=None, /, *, frozen=False, kw_only=False, eq=True):
        """`dataclasses.dataclass` with these of its options, for what has no InitVar; the objects are the same.

        Args:
            cls: the class where the decorator has no options.
            frozen: nobody changes a field; others are left to Python's own, as those without docstring or derived are.
            kw_only: the constructor takes the fields by name.
            eq: objects are compared by their fields, else they are equal to themselves.

        Returns:
            The class, or its decorator.
        """

        def decorated(kind):
            if frozen and kind.__doc__ and not dataclasses.is_dataclass(kind):
                return _frozen(kind, kw_only, eq)
            return dataclasses.dataclass(frozen=frozen, kw_only=kw_only, eq=eq)(kind)

        return decorated if cls is None else decorated(cls)
