"""What methods read: the frozen statement of a problem, and which of its names a symbol stands for."""

from covocp.statement.statement import Block as Block
from covocp.statement.statement import Conditions as Conditions
from covocp.statement.statement import Loop as Loop
from covocp.statement.statement import Statement as Statement
