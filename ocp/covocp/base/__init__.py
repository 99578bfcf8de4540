"""What everything stands on: errors, checks of arguments, symmetric matrices, files, progress, locks."""

from covocp.base.errors import CovocpError as CovocpError
from covocp.base.errors import CovocpWarning as CovocpWarning
from covocp.base.errors import ExportError as ExportError
from covocp.base.errors import Interrupted as Interrupted
from covocp.base.errors import ProblemError as ProblemError
from covocp.base.errors import SolveError as SolveError
from covocp.base.matrices import Array as Array
