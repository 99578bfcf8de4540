"""Monte Carlo simulation of the actual system with its noises, its filter and its feedback.

`runs` is the way in; a `plan` of numbers and functions goes to the workers, who take `batches` of runs through
`run_step`; `monte_carlo` is the result, `verdict` what it says of the linear `prediction`.
"""

from __future__ import annotations

from covocp.simulation.monte_carlo import MonteCarlo as MonteCarlo
from covocp.simulation.phase_sample import PhasesMonteCarlo as PhasesMonteCarlo
from covocp.simulation.runs import simulate as simulate
