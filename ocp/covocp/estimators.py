"""A face for one release: the extended filter of a problem is in `covocp.problem.filters`."""

from covocp.problem.filters import extended_filter as extended_filter
from covocp.problem.filters import initial_estimate as initial_estimate
