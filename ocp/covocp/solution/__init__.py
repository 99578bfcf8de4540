"""What comes out: the solution, its printout, its files, and what must be said of it."""

from covocp.solution.sample import Sample as Sample
from covocp.solution.solution import Solution as Solution
