"""What is known of a candidate: costates, curvature, closed loop, values between the nodes, necessary conditions."""

from typing import TYPE_CHECKING

from covocp.base.later import attributes
from covocp.extremal.closed_loop import ClosedLoop as ClosedLoop
from covocp.extremal.extremal import Extremal as Extremal
from covocp.extremal.extremal import Guess as Guess
from covocp.extremal.extremal import Outcome as Outcome
from covocp.extremal.extremal import Prepared as Prepared

if TYPE_CHECKING:
    from covocp.extremal.optimality import Optimality as Optimality
else:
    __getattr__ = attributes(__name__, {"Optimality": "extremal.optimality"})
