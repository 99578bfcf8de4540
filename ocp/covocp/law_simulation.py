"""A face for one release: `simulate_law` and its filters are in `covocp.simulation.laws`."""

from covocp.simulation.laws import Filter as Filter
from covocp.simulation.laws import LawSimulation as LawSimulation
from covocp.simulation.laws import extended_filter as extended_filter
from covocp.simulation.laws import gain_filter as gain_filter
from covocp.simulation.laws import simulate_law as simulate_law
