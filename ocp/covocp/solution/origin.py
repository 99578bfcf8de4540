"""How a solution came about, and the classical design beside one."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any

from covocp.base.dataclass import dataclass

METHOD = "evaluate"


class Origin(StrEnum):
    """How the nominal of a solution was had."""

    OPTIMISED = "optimised"  # chosen for this cost, by a method
    CLASSICAL = "classical"  # from the deterministic cost, filter and feedback around it
    GIVEN = "given"  # evaluated along a control that was given
    OTHER_TRUTH = "other truth"  # evaluated under other statistics than the design's


def origin_of(method: str, stats: Mapping[str, Any]) -> Origin:
    """How a solution of a method with these counts came about."""
    return Origin(stats.get("origin", Origin.GIVEN if method == METHOD else Origin.OPTIMISED))


@dataclass(frozen=True, kw_only=True)
class Classical:
    """The classical design that a combined one is compared with; kept among the counts of a solution.

    Attributes:
        cost: what it costs; None: there is none.
        same: whether the two costs differ by roundoff only.
        missing: why there is none, a sentence.
    """

    cost: float | None = None
    same: bool = False
    missing: str = ""

    @classmethod
    def beside(cls, stats: Mapping[str, Any]) -> Classical:
        """As the counts of a solution have it."""
        cost, same = stats.get("classical_cost"), bool(stats.get("classical_same", False))
        return cls(cost=cost, same=same, missing=stats.get("classical_missing", ""))

    @property
    def counts(self) -> dict[str, Any]:
        """As entries of the counts of a solution; what says nothing is left out."""
        known = {"classical_same": self.same, "classical_missing": self.missing}
        cost = {} if self.cost is None else {"classical_cost": self.cost}
        return {**cost, **{name: value for name, value in known.items() if value}}
