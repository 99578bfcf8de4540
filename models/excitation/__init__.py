"""Excitation of a peak seeker: paths around the command, what is known along them, and filters flown along them.

`paths` has them as histories of positions, `flights` the Monte Carlo of the filters; the problem that chooses the best
path is `covocp.models.designed_excitation`.
"""
