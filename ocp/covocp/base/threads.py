"""One thread at a time: CasADi's solvers and its linear algebra hold memory of their own and end the process otherwise.

MUMPS inside Ipopt has static data, CasADi's OpenBLAS waits for ever when several threads call it, and a CasADi function
that two threads share may write where the other reads. So whatever covocp offers that calls CasADi takes its turn:
several threads may use the same problem, solver or solution and get the same numbers as one after the other. Processes
run in parallel. For as long as a turn lasts linear algebra has one thread (`covocp.base.blas`); in one that may be long
a Ctrl-C that CasADi turns into an error of its own stays a KeyboardInterrupt (`covocp.base.ctrl_c`).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from types import FunctionType
from typing import Any, Generic, ParamSpec, Self, TypeVar, overload

from covocp.base.blas import Limits, one_blas_thread
from covocp.base.calls import called_as, refused_call
from covocp.base.ctrl_c import LISTENER

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)


class _Turn:
    """A lock that a thread may take again while it has it, and can hand over while it waits for other threads."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._owner, self._taken = 0, 0  # whose it is, and how many times; written by the owner alone
        self._limits: Limits | None = None

    def __enter__(self) -> None:
        self._lock.acquire()
        if not self._taken:
            self._owner = threading.get_ident()
            self._limits = one_blas_thread()
        self._taken += 1

    def __exit__(self, *_: object) -> None:
        self._taken -= 1
        if not self._taken:
            self._owner = 0
            if self._limits is not None:
                self._limits.restore_original_limits()
        self._lock.release()

    @property
    def _depth(self) -> int:
        """How many times this thread has it."""
        return self._taken if self._owner == threading.get_ident() else 0

    @contextmanager
    def handed_over(self) -> Iterator[None]:
        """Let other threads have their turn meanwhile."""
        depth = self._depth
        for _ in range(depth):
            self.__exit__()
        try:
            yield
        finally:
            for _ in range(depth):
                self.__enter__()

    def after_fork(self) -> None:
        """A new process has one thread: what other threads held in the old one is free here."""
        depth = self._depth
        self._lock, self._owner, self._taken = threading.RLock(), 0, 0
        for _ in range(depth):
            self.__enter__()


# Special methods that may call CasADi: making, indexing and showing.
SHOWN = ("__init__", "__getitem__", "__str__", "__repr__", "_repr_html_")
# Those of them that take no longer than listening to Ctrl-C does.
BRIEF = ("__getitem__", "__repr__")

TURN = _Turn()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=TURN.after_fork)


def one_at_a_time(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which waits for its turn; a call that does not fit it is refused by a `ProblemError`."""

    @wraps(function)
    def listening(*args: P.args, **kwargs: P.kwargs) -> R:
        with LISTENER:
            return function(*args, **kwargs)

    return _refusing(listening, function)


def briefly(function: Callable[P, R]) -> Callable[P, R]:
    """As `one_at_a_time`, of a function that takes no longer than listening to Ctrl-C does: this is left to others."""
    return _refusing(function, function)


def _refusing(called: Callable[P, R], function: Callable[P, R]) -> Callable[P, R]:
    """What is called in turn, with the refusal of calls that do not fit the function."""

    @wraps(function)
    def in_turn(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with TURN:
                return called(*args, **kwargs)
        except TypeError:
            error = refused_call(function, called_as(function), args, kwargs)
            if error is None:
                raise
        raise error

    return in_turn


def methods_one_at_a_time(cls: C) -> C:
    """The class with methods and properties that wait for their turn (printing included, other special ones not)."""
    for name, value in list(vars(cls).items()):
        if name.startswith("_") and name not in SHOWN:
            continue
        if name == "__init__":
            value = getattr(cls, name)  # a dataclass compiles it when it is asked for
        if isinstance(value, FunctionType):
            setattr(cls, name, briefly(value) if name in BRIEF else one_at_a_time(value))
        elif isinstance(value, property) and value.fget is not None:
            setattr(cls, name, property(briefly(value.fget), doc=value.__doc__))
    return cls


class cached(Generic[R]):  # noqa: N801 - a decorator, named like functools.cached_property
    """A property that is computed when it is first asked for, by one thread, and kept.

    functools.cached_property would do, but up to Python 3.11 it has a lock of its own: two locks that two threads take
    in different orders hold both of them for ever.
    """

    def __init__(self, function: Callable[[Any], R]) -> None:
        """Keep the function; its name is that of the attribute."""
        self._function = function
        self._name = function.__name__
        self.__doc__ = function.__doc__

    @overload
    def __get__(self, instance: None, owner: type) -> Self: ...
    @overload
    def __get__(self, instance: object, owner: type) -> R: ...
    def __get__(self, instance: object | None, owner: type) -> Self | R:
        """The value; Python finds it in the instance from the second time on."""
        if instance is None:
            return self
        with TURN:
            kept = instance.__dict__
            if self._name not in kept:
                with LISTENER:
                    kept[self._name] = self._function(instance)
            value: R = kept[self._name]
        return value
