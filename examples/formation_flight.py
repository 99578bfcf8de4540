"""Formation flight by peak seeking
================================

An aircraft behind another one finds where its induced drag is least, without knowing the wake (Ryan and Speyer).

Forty flights from 6 m left and 5 m above the best place, measured with noise larger than what the excitation of 0.7 m
changes. The figure is one of them: the map with the path, drag, distances, tracking errors, surfaces, attitude, and
the estimates against differences of the map. Below, what the choices that the paper prints, or leaves open, do to it.
"""

import numpy as np

from covocp.models import formation_flight

flights = formation_flight.simulate()
print(flights)
flights.plot("formation_flight.png")

CHOICES = {
    "gain 10 of the command filter, as printed": {"settings": "printed"},
    "the same with robust steps": {"command_gain": 10.0},
    "plain Newton steps without a limit": {"settings": "printed", "command_gain": 1.0, "transport": True},
    "excitation at 3 rad/s": {"turn": 2 * np.pi / 3},
    "no excitation": {"radius": 0.0},
}
print("\n20 flights each                              lost   benefit missed at 420 s   tracking error")
for name, choice in CHOICES.items():
    runs = formation_flight.simulate(runs=20, **choice)
    kept = ~runs.lost
    missed = f"{np.median(runs.gap_at(420.0)[kept]):.3f}" if kept.any() else "-"
    error = f"{np.abs(runs.tracking_error[kept]).max():.2f} m" if kept.any() else "-"
    print(f"  {name:42s}{runs.lost.mean():5.2f}{missed:>22s}{error:>21s}")
