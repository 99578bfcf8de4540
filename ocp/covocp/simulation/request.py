"""What the user asked a simulation for, checked."""

from __future__ import annotations

from typing import Any

from covocp.base.arguments import MOST, is_whole, positive
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.short_repr import short_repr
from covocp.simulation.schedule import FilterKind
from covocp.simulation.vectorised import padded

FILTERS = ("perturbation", "extended")


@dataclass(frozen=True, kw_only=True)
class Request:
    """What the user asked for; checked on construction. See `simulate`."""

    runs: int
    seed: int
    store: int
    paths: int
    batch: int
    level: float
    filter: FilterKind
    step: float | None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Refuse what means nothing."""
        for name, least in (("runs", 2), ("seed", 0), ("store", 2), ("paths", 0), ("batch", 1)):
            value: Any = getattr(self, name)
            if not is_whole(value, least, None if name == "seed" else MOST):
                most = "" if name == "seed" or not is_whole(value, least, None) else f", at most {MOST:.0e}"
                raise wrong_argument(name, f"a whole number, {least} or more{most}", value)
        if not isinstance(self.filter, str) or self.filter not in FILTERS:
            raise wrong_argument("filter", " or ".join(map(repr, FILTERS)), self.filter)
        if self.step is not None and positive(self.step):
            raise wrong_argument("step", "a number > 0 [s], or None", self.step)
        if positive(self.level) or not self.level < 1.0:
            raise wrong_argument("level", "a number between 0 and 1", self.level)

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """First run of each batch, and the one after its last."""
        count = max(1, -(-self.runs // self.batch))
        width = padded(-(-self.runs // count))  # all about equally large
        return [(first, min(first + width, int(self.runs))) for first in range(0, int(self.runs), width)]


def wrong_argument(name: str, expected: str, received: Given, remedy: str | None = None) -> ProblemError:
    """An argument of `simulate` that means nothing."""
    return ProblemError(
        f"The argument '{name}' of simulate() is wrong.",
        expected=expected,
        received=(received if isinstance(received, str) else repr(received))[:200],
        remedy=remedy or f"correct {name}=",
    )
