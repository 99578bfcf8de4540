"""Nested dictionaries with numbers, words and arrays as JSON text and back, every bit kept and nothing executed.

What JSON does not know is written as an object with one key that begins with "$": {"$float": "nan"},
{"$tuple": [...]}, {"$map": [[key, value], ...]}, and arrays as {"$array": {"dtype", "shape", "values"}} or, where the
arrays are kept beside the text, as {"$array": name}. Keys that begin with "$" are therefore written as "$map".
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from covocp.base.errors import ExportError
from covocp.base.expressions import Given

KINDS = "biuf"  # of arrays: truth values, whole numbers, floating-point numbers
LARGEST_ITEM = 8  # bytes: what Python's own numbers hold exactly
PLAIN_DTYPE = re.compile(rf"[<>|=]?[{KINDS}][1248]")


class DamagedFileError(Exception):
    """What was read is not what was written; the reader of the file turns this into a `ProblemError`."""


def encode(value: Given, name: str, arrays: dict[str, Any] | None = None) -> Any:
    """A value as what `json.dumps(..., allow_nan=False)` writes.

    Args:
        value: None, truth values, numbers, words, arrays, and lists, tuples and mappings of them.
        name: of the value, for errors and for the names of arrays.
        arrays: where arrays are put, by name; None: they are written out.

    Returns:
        The tree.

    Raises:
        ExportError: a value of another type (says which).
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"$float": _word(np.array([value]))}
    if isinstance(value, list):
        return [encode(v, f"{name}.{i}", arrays) for i, v in enumerate(value)]
    if isinstance(value, tuple):
        return {"$tuple": [encode(v, f"{name}.{i}", arrays) for i, v in enumerate(value)]}
    if isinstance(value, Mapping):
        if all(isinstance(k, str) and not k.startswith("$") for k in value):
            return {k: encode(v, f"{name}.{k}", arrays) for k, v in value.items()}
        pairs = [[encode(k, f"{name}.key"), encode(v, f"{name}.{k}", arrays)] for k, v in value.items()]
        return {"$map": pairs}
    if isinstance(value, np.ndarray) and value.dtype.kind in KINDS and value.dtype.itemsize <= LARGEST_ITEM:
        return {"$array": _written_out(value) if arrays is None else _put_aside(value, name, arrays)}
    raise ExportError(
        f"'{name}' cannot be written to a file.",
        expected="numbers, words, arrays of numbers, and lists and dictionaries of them",
        received=f"{type(value).__name__}: {str(value)[:60]}",
        remedy=f"replace it by numbers or words: dataclasses.replace(solution, {name.split('.')[0]}=...)",
    )


def decode(tree: Any, arrays: Mapping[str, Any] | None = None) -> Any:
    """The value that `encode` made the tree of; arrays are read-only.

    Args:
        tree: what `json.loads` returns.
        arrays: those kept beside the text, by name.

    Raises:
        DamagedFileError: the tree was not made by `encode`.
    """
    if isinstance(tree, list):
        return [decode(v, arrays) for v in tree]
    if not isinstance(tree, dict):
        return tree
    if not any(k.startswith("$") for k in tree):
        return {k: decode(v, arrays) for k, v in tree.items()}
    if len(tree) != 1:
        raise DamagedFileError(f"an object with the keys {', '.join(tree)}")
    ((tag, content),) = tree.items()
    try:
        if tag == "$float":
            return float(_number(content, np.dtype("f8"))[0])
        if tag == "$tuple":
            return tuple(decode(v, arrays) for v in content)
        if tag == "$map":
            return {decode(k): decode(v, arrays) for k, v in content}
        if tag == "$array":
            array = _read_in(content) if arrays is None else np.array(arrays[content])
            if array.dtype.kind in KINDS:
                array.setflags(write=False)
                return array
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        raise DamagedFileError(f"'{tag}' with {str(content)[:60]}") from error
    raise DamagedFileError(f"an object with the key {tag}")


def _put_aside(array: Given, name: str, arrays: dict[str, Any]) -> str:
    """Keep an array beside the text under a plain name that is not taken yet."""
    plain = re.sub(r"[^A-Za-z0-9_.-]", "_", name)
    while plain in arrays:
        plain += "_"
    arrays[plain] = array
    return plain


def _written_out(array: Given) -> dict[str, Any]:
    """An array as JSON: numbers in their shortest exact form, words where they are not finite."""
    flat = array.ravel()
    values = flat.tolist()
    for i in np.flatnonzero(~np.isfinite(flat)):
        values[i] = _word(flat[i : i + 1])
    return {"dtype": array.dtype.str, "shape": list(array.shape), "values": values}


def _read_in(content: Mapping[str, Any]) -> Any:
    """The inverse of `_written_out`."""
    if not PLAIN_DTYPE.fullmatch(str(content["dtype"])):  # before numpy makes room for anything larger
        raise ValueError(content["dtype"])
    dtype = np.dtype(str(content["dtype"]))
    values = content["values"]
    numbers = np.array([0 if isinstance(v, str) else v for v in values], dtype=dtype)
    for i, value in enumerate(values):
        if isinstance(value, str):
            numbers[i : i + 1] = _number(value, dtype)
    return numbers.reshape([int(n) for n in content["shape"]])


def _word(entry: Given) -> str:
    """inf, -inf, nan, or nan with its bytes where it is not the usual one; `entry` has shape (1,)."""
    if np.isinf(entry[0]):
        return "inf" if entry[0] > 0 else "-inf"
    usual = entry.tobytes() == np.array([np.nan], dtype=entry.dtype).tobytes()
    return "nan" if usual else f"nan:{entry.tobytes().hex()}"


def _number(word: str, dtype: Given) -> Any:
    """The inverse of `_word`."""
    if word.startswith("nan:"):
        return np.frombuffer(bytes.fromhex(word[4:]), dtype=dtype, count=1)
    return np.array([float(word)], dtype=dtype)
