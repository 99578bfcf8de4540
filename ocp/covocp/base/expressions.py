"""Names for what CasADi's type stubs cannot say, and what expressions are recognised by."""

from __future__ import annotations

from typing import Any, TypeAlias

# SX, MX or DM, and where a function is evaluated with numbers an array: the stubs know no type that all of them share,
# and no operators between them.
Expr: TypeAlias = Any
# What a user gave: of any type until it is checked, and then refused or read.
Given: TypeAlias = Any

# Functions of tables begin so: what reads an expression finds them by it, and their limits in the last argument.
TABLE = "covocp_table_"


def symbol_of(key: Given) -> Any:
    """The symbol of what stands for a state that is no vector, such as an attitude; anything else as it is."""
    return getattr(key, "quaternion", key)
