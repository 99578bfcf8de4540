"""Digests of what is written to files."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hashlib import _Hash


def sha256(content: bytes = b"") -> _Hash:
    """A SHA-256 digest, of some content to begin with; `update` and `hexdigest` as of hashlib.

    That brings a library of 4 MB, which no solve needs.
    """
    import hashlib

    return hashlib.sha256(content)
