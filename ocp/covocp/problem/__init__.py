"""What the user states: the builder, its declarations, and how they become a frozen statement."""

from covocp.problem.builder import Problem as Problem
from covocp.problem.declarations import Free as Free
from covocp.problem.declarations import Gain as Gain
