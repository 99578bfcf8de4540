"""What can be proved of a solution, and what a combined design can gain."""

from covocp.analysis.certificate import Certificate as Certificate
from covocp.analysis.certificate import certify as certify
from covocp.analysis.combined_gain import Worth as Worth
from covocp.analysis.combined_gain import worth as worth
