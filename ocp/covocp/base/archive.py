"""Trees of plain data as the bytes of a file and back: compressed arrays (.npz) or text (.json), sealed by checksums.

Both formats end with the SHA-256 of everything before it, so that one flipped bit anywhere is noticed. A .npz file is a
ZIP archive, to which other programs may add entries: those are never read, and a second checksum, over the content of
the entries that belong to the tree, tells whether the tree is what was written.

What is read is bounded by the size of the file, whatever the file says of itself: an entry is only unpacked where the
tree refers to it, and all of them together may be `UNPACKED` times as large as the file.

In both a tree is JSON text, every bit kept and nothing executed. What JSON does not know is written as an object with
one key that begins with "$": {"$float": "nan"}, {"$tuple": [...]}, {"$map": [[key, value], ...]}, and arrays as
{"$array": {"dtype", "shape", "values"}} or, where the arrays are kept beside the text, as {"$array": name}. Keys that
begin with "$" are therefore written as "$map".
"""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from covocp.base.digests import sha256
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
    if isinstance(value, (list, tuple)):
        entries = [encode(v, f"{name}.{i}", arrays) for i, v in enumerate(value)]
        return entries if isinstance(value, list) else {"$tuple": entries}
    if isinstance(value, Mapping):
        if all(isinstance(k, str) and not k.startswith("$") for k in value):
            return {k: encode(v, f"{name}.{k}", arrays) for k, v in value.items()}
        return {"$map": [[encode(k, f"{name}.key"), encode(v, f"{name}.{k}", arrays)] for k, v in value.items()]}
    if isinstance(value, np.ndarray) and value.dtype.kind in KINDS and value.dtype.itemsize <= LARGEST_ITEM:
        return {"$array": _written_out(value) if arrays is None else _put_aside(value, name, arrays)}
    raise ExportError(
        f"'{name}' cannot be written to a file.",
        expected="numbers, words, arrays of numbers, and lists and dictionaries of them",
        received=f"{type(value).__name__}: {str(value)[:60]}",
        remedy=f"replace it by numbers or words: dataclasses.replace(solution, {name.split('.')[0]}=...)",
    )


def decode(tree: Any, arrays: Mapping[str, Any] | _Entries | None = None) -> Any:
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


DOCUMENT = "document"
NPY = ".npy"
# Bytes of an archive that are unpacked at most: a number for each byte of the file, and as much for any file.
UNPACKED, ALWAYS = 64, 2**26
# The same for its text, of which every byte becomes a Python object in the worst case.
TEXT_UNPACKED, TEXT_ALWAYS = 4, 2**22
CHUNK = 2**20
DIGEST = 64  # letters of a SHA-256
JSON_SEAL, JSON_END = b', "checksum": "sha256:', b'"}'
NPZ_SEAL = re.compile(rb"covocp content ([0-9a-f]{64}) file [0-9a-f]{64}")


def packed(tree: Mapping[str, Any], suffix: str) -> bytes:
    """The bytes of a file.

    Args:
        tree: what `encode` can write, by name.
        suffix: ".npz" or ".json".

    Raises:
        ExportError: a value of a type that cannot be written (says which).
    """
    arrays: dict[str, Any] | None = None if suffix == ".json" else {}
    text = json.dumps({name: encode(value, name, arrays) for name, value in tree.items()}, allow_nan=False)
    if arrays is None:
        return sealed_text(text)
    entries = {DOCUMENT: np.frombuffer(text.encode(), dtype=np.uint8), **arrays}
    return sealed_arrays(entries)


def sealed_text(text: str) -> bytes:
    """A JSON object with its checksum as the last entry."""
    return _signed(text.rstrip()[:-1].encode() + JSON_SEAL) + JSON_END


def sealed_arrays(entries: Mapping[str, Any]) -> bytes:
    """A .npz file of these entries with the checksums as its comment."""
    written = {name: _npy(array) for name, array in entries.items()}
    buffer = _zipped(written, zipfile.ZIP_DEFLATED)
    if sum(map(len, written.values())) > UNPACKED * len(buffer.getvalue()) + ALWAYS:  # it would not be read again
        buffer = _zipped(written, zipfile.ZIP_STORED)
    content = sha256()
    for name, data in written.items():
        content.update(_heading(name, data))
        content.update(data)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = f"covocp content {content.hexdigest()} file {'0' * DIGEST}".encode()
    return _signed(buffer.getvalue()[:-DIGEST])


def _signed(body: bytes) -> bytes:
    """Bytes, and the checksum of them."""
    return body + sha256(body).hexdigest().encode()


def _heading(name: str, data: bytes) -> bytes:
    """What the checksum of the content has of an entry before its bytes."""
    return f"{len(name.encode())} {name} {len(data)} ".encode()


def _zipped(written: Mapping[str, bytes], compression: int) -> io.BytesIO:
    """An archive without the time of day: the same solution makes the same file."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in written.items():
            archive.writestr(zipfile.ZipInfo(name + NPY), data, compression)
    return buffer


def unpacked(data: bytes) -> tuple[Any, bool]:
    """What `packed` made the bytes of, and whether the checksums fit.

    Args:
        data: of a file, whatever it is.

    Raises:
        DamagedFileError: neither a .npz nor a .json file, one that contradicts itself, or one that unpacks to more than
            such a file can hold.
        ValueError, TypeError, ...: of the readers of both formats.
    """
    if data[:2] != b"PK":
        tree = decode(json.loads(data.decode("utf-8")))
        if isinstance(tree, dict):
            tree.pop("checksum", None)
        return tree, _text_is_sealed(data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if DOCUMENT + NPY not in archive.namelist():
            raise DamagedFileError(f"it has no entry '{DOCUMENT}'")
        entries = _Entries(archive, len(data))
        tree = decode(json.loads(entries[DOCUMENT].tobytes().decode("utf-8")), entries)
        return tree, entries.sealed(data)


def _text_is_sealed(data: bytes) -> bool:
    body, seal, _ = data.rpartition(JSON_SEAL)
    return data == _signed(body + seal) + JSON_END


class _Entries:
    """The arrays of an archive, unpacked when they are asked for, as often as the size of the file allows."""

    def __init__(self, archive: zipfile.ZipFile, size: int) -> None:
        self._archive, self._size = archive, size
        self._left = UNPACKED * size + ALWAYS
        self._read: set[str] = set()
        self._content = sha256()

    def __getitem__(self, name: str) -> Any:
        info = self._archive.getinfo(name + NPY)
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise DamagedFileError(f"the entry '{name[:60]}' is compressed in another way than save does it")
        most = TEXT_UNPACKED * self._size + TEXT_ALWAYS if name == DOCUMENT else self._left
        if info.file_size > min(self._left, most):
            raise DamagedFileError(
                f"the entry '{name[:60]}' unpacks to {info.file_size} bytes, more than a file of {self._size} bytes can"
                " hold"
            )
        self._left -= info.file_size
        with self._archive.open(info) as stream:  # in pieces: one read would unpack more than the entry says it holds
            data = b"".join(iter(lambda: stream.read(CHUNK), b""))
        self._read.add(name)
        self._content.update(_heading(name, data))
        self._content.update(data)
        return _array(data)

    def sealed(self, data: bytes) -> bool:
        """Whether the file is as it was written, or has nothing new but entries that do not belong to the tree."""
        found = NPZ_SEAL.fullmatch(self._archive.comment)
        if found is None or found.group(1) != self._content.hexdigest().encode():
            return False
        return len(self._archive.infolist()) > len(self._read) or data == _signed(data[:-DIGEST])


def _npy(array: Given) -> bytes:
    """An array in numpy's own format."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=False)
    return stream.getvalue()


def _array(data: bytes) -> Any:
    """The inverse of `_npy`; what its header promises is compared with what there is before anything is made."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):  # larger headers are those of records
        raise DamagedFileError(f"an array in version {version} of its format")
    shape, columns, dtype = np.lib.format.read_array_header_1_0(stream)
    rest = data[stream.tell() :]
    plain = dtype.kind in KINDS and dtype.itemsize <= LARGEST_ITEM and dtype.subdtype is None
    if not plain or any(n < 0 for n in shape) or math.prod(shape) * dtype.itemsize != len(rest):
        raise DamagedFileError("an array that is not what its header says, or none of numbers")
    return np.ndarray(shape, dtype, buffer=rest, order="F" if columns else "C")
