"""Names and numbers of the entries of stacked vectors and half-vectors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from covocp.base.matrices import half_indices


def entry_names(blocks: Iterable[Any]) -> tuple[str, ...]:
    """Names of the entries of some stacked vectors; those of a quaternion are told from the rows of its error."""
    return tuple(
        name
        for block in blocks
        for name in (
            [f"{block.name} q{i}" for i in range(block.size)]
            if getattr(block, "tangent", 0)
            else _numbered(block.name, block.size)
        )
    )


def error_names(blocks: Iterable[Any]) -> tuple[str, ...]:
    """Names of the rows of a covariance of some states: the entries of a vector, of others those of the tangent."""
    return tuple(name for block in blocks for name in _numbered(block.name, error_size(block)))


def error_size(block: Any) -> int:
    """Rows of a covariance that a declaration or a block has."""
    return int(getattr(block, "tangent", 0) or block.size)


def _numbered(name: str, size: int) -> list[str]:
    return [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]


def entries_of(matrix: Any) -> list[str]:
    """Names of the entries of the half-vector of a declared matrix or its block; an integral is one number."""
    return [matrix.name] if matrix.role == "integral" else half_names(matrix.name, matrix.labels)


def half_names(name: str, labels: tuple[str, ...]) -> list[str]:
    """Names of the entries of the half-vector of a matrix, such as 'E[x, b]'."""
    return [f"{name}[{labels[i]}, {labels[j]}]" for i, j in zip(*half_indices(len(labels)), strict=True)]
