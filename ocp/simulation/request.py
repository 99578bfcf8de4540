"""What the user asked a simulation for, checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from covocp.errors import ProblemError, describe
from covocp.simulation.schedule import Filter
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
    filter: Filter
    step: float | None

    def __post_init__(self) -> None:
        """Refuse what means nothing."""
        for name, least in (("runs", 2), ("seed", 0), ("store", 2), ("paths", 0), ("batch", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
                raise wrong_argument(name, f"a whole number, {least} or more", value)
        if self.filter not in FILTERS:
            raise wrong_argument("filter", " or ".join(map(repr, FILTERS)), self.filter)
        for name, value, most in (("step", self.step, np.inf), ("level", self.level, 1.0)):
            number = 0.5 if value is None and name == "step" else value
            if isinstance(number, bool) or not isinstance(number, (int, float, np.number)) or not 0 < number < most:
                raise wrong_argument(
                    name, "a number between 0 and 1" if name == "level" else "a number > 0 [s], or None", value
                )

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """First run of each batch, and the one after its last."""
        count = max(1, -(-self.runs // self.batch))
        width = padded(-(-self.runs // count))  # all about equally large
        return [(first, min(first + width, int(self.runs))) for first in range(0, int(self.runs), width)]


def wrong_argument(name: str, expected: str, received: Any, remedy: str | None = None) -> ProblemError:
    """An argument of `simulate` that means nothing."""
    return ProblemError(
        describe(
            f"The argument '{name}' of simulate() is wrong.",
            expected=expected,
            received=(received if isinstance(received, str) else repr(received))[:200],
            remedy=remedy or f"correct {name}=",
        )
    )
