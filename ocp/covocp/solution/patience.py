"""How long what is looked at after a run may take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Nobody minds so many seconds; and so many times what the solution itself took.
SHORT, SHARE = 10.0, 1.0


def longest(stats: Mapping[str, Any]) -> float:
    """Seconds that a residual of a solution may take, from what is told of its runs."""
    return max(SHORT, SHARE * sum(float(value) for name, value in stats.items() if name.endswith("seconds")))
