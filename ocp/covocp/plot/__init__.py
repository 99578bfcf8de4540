"""Figures of solutions: what is shown, as plain numbers, and how it is drawn."""

from covocp.plot.figure import check_plot_options as check_plot_options
from covocp.plot.figure import plot_solutions as plot_solutions
