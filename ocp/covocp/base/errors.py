"""The errors that covocp raises, and the warnings that it gives."""

from __future__ import annotations

import sys
import warnings
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from covocp.solution.solution import Solution

PACKAGE = __name__.partition(".")[0]
# Likeness of two names (difflib's ratio) from which on one may be a slip of the other: "fricton" and "friction" have
# 0.93, "position" and "friction" 0.63.
ALIKE = 0.75
# Whether warnings are held back, in this thread: the filters of the module `warnings` belong to all threads.
_HELD_BACK = ContextVar("held_back", default=False)


class CovocpError(Exception):
    """Base of every error that covocp raises on purpose: it says four things.

    Attributes:
        problem: what is wrong, with the user's name of the thing.
        expected: what is needed; empty where the sentence says it all.
        received: what was given.
        remedy: what to do next.
    """

    def __init__(self, problem: str, *, expected: str = "", received: str = "", remedy: str = "") -> None:
        """Make the message of what is given, a line each."""
        parts = {"expected": expected, "received": received, "remedy": remedy}
        lines = [f"\n  {name + ':':9s} {text}" for name, text in parts.items() if text]
        super().__init__(problem + "".join(lines))
        self.problem, self.expected, self.received, self.remedy = problem, expected, received, remedy

    def __reduce__(self) -> tuple[Any, ...]:
        """As it was made, in another process too: what is kept beside the message is set again, where it can be."""
        return _remade, (type(self), self.problem, _travelling(self.__dict__))

    def __copy__(self) -> CovocpError:
        """With everything that is kept beside the message, within a process."""
        return _remade(type(self), self.problem, self.__dict__)

    def __deepcopy__(self, memo: object) -> CovocpError:
        """As `copy.copy`: what solutions hold never changes."""
        return self.__copy__()


class ProblemError(CovocpError, ValueError):
    """The statement of a problem, or an option, is wrong: says which name, what was given and what is needed."""


class OutsideDomainError(ProblemError):
    """A start lies where the model gives no numbers; another one may not."""


class MissingAttributeError(ProblemError, AttributeError):
    """An attribute that something else has, which can be had from this; `hasattr` sees that it is not here."""


class SolveError(CovocpError, RuntimeError):
    """A solver ended without a solution.

    Attributes:
        solution: the last iterate as a `Solution` (its `status` says that it did not converge), or None where not
            even one iterate exists. It can be saved, plotted and used as a guess.
        violations: largest violation of each violated constraint, by the name of the constraint, in its own unit.
    """

    def __init__(
        self,
        problem: str,
        *,
        expected: str = "",
        received: str = "",
        remedy: str = "",
        solution: Solution | None = None,
        violations: Mapping[str, float] | None = None,
    ) -> None:
        """Keep the last iterate and the violated constraints beside the message."""
        super().__init__(problem, expected=expected, received=received, remedy=remedy)
        self.solution = solution
        self.violations = dict(violations or {})


class Interrupted(KeyboardInterrupt):
    """Ctrl-C stopped a solver: a `KeyboardInterrupt`, so that a loop of solves ends too.

    Attributes:
        solution: the last iterate as a `Solution`, or the best of the starts that were solved before.
    """

    def __init__(self, message: str, *, solution: Solution | None = None) -> None:
        """Keep what was found beside the message."""
        super().__init__(message)
        self.solution = solution

    def __reduce__(self) -> tuple[Any, ...]:
        """As it was made, in another process too, with what of it can be pickled."""
        return type(self), self.args, _travelling(self.__dict__)

    def __copy__(self) -> Interrupted:
        """With what was found, within a process."""
        made = Interrupted(*self.args)
        made.__dict__.update(self.__dict__)
        return made

    def __deepcopy__(self, memo: object) -> Interrupted:
        """As `copy.copy`: what solutions hold never changes."""
        return self.__copy__()


class NotSent:
    """What stands on an error that came from another process, in place of something that cannot be pickled.

    It is false, prints as a sentence that says so, and whatever is asked of it raises an error with that sentence.

    Args:
        name: of the attribute of the error.
        kind: of what stood there.
    """

    def __init__(self, name: str, kind: str) -> None:
        """Keep what it was."""
        self._name, self._kind = name, kind

    def __repr__(self) -> str:
        """The sentence."""
        return (
            f"<the {self._kind} stayed in the process that raised this error: symbols of CasADi cannot be pickled. "
            f"To keep it, call error.{self._name}.save(path) there>"
        )

    def __bool__(self) -> bool:
        """It is nothing."""
        return False

    def __getattr__(self, attribute: str) -> Any:
        """What it had is not here.

        Raises:
            MissingAttributeError: always; `hasattr` sees that it is not here.
        """
        if attribute.startswith("_"):  # asked for by the machinery of Python, while it is made too
            raise AttributeError(attribute)
        raise self._missing(MissingAttributeError, f".{attribute}")

    def __getitem__(self, key: object) -> Any:
        """What it had is not here.

        Raises:
            ProblemError: always.
        """
        raise self._missing(ProblemError, f"[{shown(key, 40)}]")

    def _missing(self, error: type[ProblemError], asked: str) -> ProblemError:
        return error(
            f"The {self._kind} of this error stayed in the process that raised it.",
            expected="numbers, which can be pickled; it is made of symbols and functions of CasADi",
            received=f".{self._name}{asked} in another process",
            remedy=f"save it there: except the error, call error.{self._name}.save(path), raise again, and read the "
            "file by covocp.load(path)",
        )


class ExportError(CovocpError, RuntimeError):
    """Something cannot be exported or written: says what, and why."""


class CovocpWarning(UserWarning):
    """The result is usable, but the user should know something about it (mesh too coarse, saddle point left)."""


def remedy_for_symbols(error: BaseException, otherwise: str) -> str:
    """What to do about an error of a user's function that was given symbols; CasADi's own words do not say it."""
    text = str(error)
    if "to_double" in text:
        return "symbols have no number: take casadi.sin and its like in place of math.sin, and no float() of them"
    if "truth value" in text:
        return "symbols are neither true nor false: take casadi.if_else, casadi.fmin and casadi.fmax, not if, min, max"
    return otherwise


def _travelling(kept: Mapping[str, Any]) -> dict[str, Any]:
    """What an error keeps, by name, as it goes to another process."""
    import pickle  # here: few errors go to another process

    sent: dict[str, Any] = {}
    for name, value in kept.items():
        try:
            pickle.dumps(value)
        except Exception:  # whatever classes of others raise: the error that is told must not be lost for it
            sent[name] = NotSent(name, type(value).__name__.lower())
        else:
            sent[name] = value
    return sent


def _remade(kind: type[CovocpError], problem: str, kept: dict[str, Any]) -> CovocpError:
    """An error from what it was made of."""
    error = kind(problem, **{name: kept[name] for name in ("expected", "received", "remedy")})
    error.__dict__.update(kept)
    return error


def warn_user(message: str) -> None:
    """Give a `CovocpWarning` that names the line of the user's own code from which the toolbox was called.

    Args:
        message: what the user should know.
    """
    if _HELD_BACK.get():
        return
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == PACKAGE:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, CovocpWarning, stacklevel=level)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Hold back the warnings of covocp meanwhile, in this thread: they concern something that the user does not see."""
    token = _HELD_BACK.set(True)
    try:
        yield
    finally:
        _HELD_BACK.reset(token)


def last_line(error: BaseException) -> str:
    """What an error of CasADi's says at last: before that stand the functions that called each other."""
    return " ".join(str(error).strip().splitlines()[-1:])[:200]


@contextmanager
def evaluating(name: str) -> Iterator[None]:
    """What CasADi raises where a model has no value (a singular factorisation, a number too large), as an own error.

    Args:
        name: of the problem.

    Raises:
        SolveError: without a solution.
    """
    try:
        yield
    except RuntimeError as error:
        if isinstance(error, CovocpError):
            raise
        raise SolveError(
            f"'{name or 'The problem'}' has no value somewhere between its guess and its end: a solve of linear "
            f"equations inside it fails, or a number is too large ({last_line(error)}). Give another guess, bounds "
            "that keep the model in its domain, or other units."
        ) from error


def shown(value: object, length: int = 100, form: Callable[[object], str] = repr) -> str:
    """The beginning of what Python shows of a value, on one line; of numbers that are too long for it the type."""
    try:
        return " ".join(form(value).split())[:length]
    except ValueError:
        return type(value).__name__


def kind_and_name(value: object) -> str:
    """Type and name of something, or its beginning where it has no name: one line."""
    name = getattr(value, "name", None)
    # What could have a name and has none may print as a page: its representation is a line.
    text = f"'{name}'" if isinstance(name, str) and name else shown(value, 60, repr if isinstance(name, str) else str)
    return f"{type(value).__name__}: {text}"


def spelling(name: object, known: Iterable[str], otherwise: str) -> str:
    """The remedy for a name that is not known: the known one that is nearly the same, where there is one.

    A symbol that prints as a known name and is not known is that of another problem.

    Args:
        name: what was given, a word or a symbol.
        known: what could be given.
        otherwise: the remedy where nothing is near.
    """
    import difflib  # here: most programs make no mistakes, and importing covocp must not take long

    known = tuple(known)
    if hasattr(name, "is_symbolic") and str(name) in known:
        return f"it is a symbol of another problem: take that of this problem, or the name as a string, '{name}'"
    lower = {word.casefold(): word for word in known}
    found = difflib.get_close_matches(str(name).casefold(), lower, n=1, cutoff=ALIKE)
    return f"check the spelling: perhaps '{lower[found[0]]}' is meant" if found else otherwise


def no_export_option(what: str, name: str, value: object, known: Sequence[str]) -> ExportError:
    """The error of an option of `export_c` that means nothing to what is exported."""
    return ExportError(
        f"export_c has no option '{name}' for {what}.",
        expected="one of " + ", ".join(known),
        received=f"{name}={value!r}"[:100],
        remedy=spelling(name, known, "leave it out"),
    )


def no_option(
    what: str,
    name: str,
    value: object,
    known: Iterable[str],
    beside: Collection[str] = (),
    otherwise: str = "correct or remove it",
) -> ProblemError:
    """The error for an option that is not there.

    Args:
        what: that has no such option, the subject of the sentence.
        name: of the option.
        value: that was given to it.
        known: the options that there are.
        beside: other arguments of the call, which may be meant too; one that is given here is known elsewhere.
        otherwise: the remedy where no name is near.
    """
    names = sorted(known)
    elsewhere = f"'{name}' belongs to the call that solves, such as Solver.solve({name}=...)" if name in beside else ""
    return ProblemError(
        f"{what} has no option '{name}'.",
        expected="one of " + ", ".join(names),
        received=f"{name}={value!r}"[:100],
        remedy=elsewhere or spelling(name, [*names, *beside], otherwise),
    )


def has_key(owner: Any, key: object) -> bool:
    """Whether what refuses unknown keys by a `ProblemError` knows one."""
    try:
        owner[key]
    except ProblemError:
        return False
    return True
