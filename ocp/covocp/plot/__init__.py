"""Figures of solutions: what is shown, as plain numbers, and how it is drawn."""

from covocp.plot.figure import plot_solutions as plot_solutions
