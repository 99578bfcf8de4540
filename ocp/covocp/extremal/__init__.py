"""What is known of a candidate: costates, curvature, closed loop, values between the nodes, necessary conditions."""

from covocp.extremal.closed_loop import ClosedLoop as ClosedLoop
from covocp.extremal.extremal import Extremal as Extremal
from covocp.extremal.extremal import Guess as Guess
from covocp.extremal.extremal import Outcome as Outcome
from covocp.extremal.extremal import Prepared as Prepared
from covocp.extremal.optimality import Optimality as Optimality
