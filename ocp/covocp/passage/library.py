"""The compiled library of the passage: where it is, whether it can be used, and its functions by their C names."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import platform
from collections.abc import Callable
from functools import lru_cache
from typing import Any

MODULE = "covocp.passage._passage"

# Of the arguments of the functions and of what they mean; a library of an earlier one would give wrong numbers.
VERSION = 14

_WHOLE, _ADDRESS = ctypes.c_int, ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "passage_new": (_ADDRESS, (_ADDRESS, _WHOLE, _WHOLE, ctypes.c_size_t)),
    "passage_bytes": (ctypes.c_size_t, (_ADDRESS, _WHOLE, ctypes.c_size_t)),
    "passage_held": (ctypes.c_size_t, (_ADDRESS,)),
    "passage_free": (None, (_ADDRESS,)),
    "passage_trim": (None, ()),
    "passage_forward": (None, (_ADDRESS,) * 7),
    "passage_reverse": (_WHOLE, (_ADDRESS,) * 12),
    "passage_tangent": (_WHOLE, (_ADDRESS,) * 19),
    "exported_length": (ctypes.c_size_t, (_ADDRESS, _WHOLE)),
    "exported_forward": (None, (_ADDRESS,) * 6),
    "exported_slopes": (None, (_ADDRESS,) * 7),
    "transitions": (_WHOLE, (_WHOLE,) * 2 + (_ADDRESS,) * 2 + (_WHOLE,) * 3 + (_ADDRESS,) * 5),
    "columns": (_WHOLE, (_WHOLE, _ADDRESS, _ADDRESS, _WHOLE, _WHOLE, _ADDRESS, _ADDRESS, _WHOLE, _WHOLE)),
    "operations": (
        ctypes.c_longlong,
        (ctypes.c_char_p, ctypes.c_size_t, ctypes.c_longlong, _WHOLE, _ADDRESS)
        + (_WHOLE,) * 4
        + (_ADDRESS,) * 2
        + (_WHOLE,)
        + (_ADDRESS,) * 3,
    ),
    "derived_program": (
        _WHOLE,
        (_WHOLE, _WHOLE) + (_ADDRESS,) * 2 + (_WHOLE,) * 3 + (_ADDRESS,) * 3 + (_WHOLE,) + (_ADDRESS,) * 4,
    ),
    "passed_back": (_WHOLE, (_WHOLE,) * 2 + (_ADDRESS,) * 2 + (_WHOLE,) * 3 + (_ADDRESS,) * 7),
}

# What the library has twice, the second time for newer processors (newer.c).
_TWICE = ("passage_forward", "passage_reverse", "passage_tangent", "transitions", "passed_back", "columns")


@lru_cache(maxsize=1)
def _loaded() -> tuple[dict[str, Callable[..., Any]] | None, str]:
    """The functions of the library, None without it, and where it lies or why it cannot be used."""
    found = importlib.util.find_spec(MODULE)
    if found is None or found.origin is None:
        return None, "it was not built: the installation found no C compiler"
    try:
        library = ctypes.CDLL(found.origin)
        version = _version(library)
        if version != VERSION:
            return None, f"it was built from version {version} of its source, not {VERSION}: install covocp again"
        newer = _TWICE if library.passage_newer() else ()
        functions = {name: getattr(library, f"{name}_newer" if name in newer else name) for name in _SIGNATURES}
        functions["addresses"] = importlib.import_module(MODULE).addresses
    except (ImportError, OSError, AttributeError) as error:
        return None, f"it cannot be loaded: {error}"
    for name, (result, arguments) in _SIGNATURES.items():
        functions[name].restype, functions[name].argtypes = result, arguments
    return functions, found.origin


def _version(library: ctypes.CDLL) -> int:
    """Of the source that a library was built from; the first ones do not tell."""
    function = getattr(library, "passage_version", None)
    return 1 if function is None else int(function())


def functions() -> dict[str, Callable[..., Any]] | None:
    """The functions of the library by their C names; None where the plain expressions have to do."""
    return _loaded()[0]


def needed() -> dict[str, Callable[..., Any]]:
    """The same, where it is known that they are there."""
    there = functions()
    assert there is not None
    return there


def build_info() -> dict[str, str | bool]:
    """Tell whether the compiled passage of covariances is used here, and why not.

    Without it the same numbers come from CasADi's own operations, more slowly.

    Returns:
        "compiled": whether it is used; "library": its file, or why there is none; "machine": the processor's kind.
    """
    there, text = _loaded()
    return {"compiled": there is not None, "library": text, "machine": platform.machine()}
