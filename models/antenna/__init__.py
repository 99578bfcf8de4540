"""Pointing of an antenna by attitude seeking: the patch antenna, the spacecraft with its wheels, what is flown.

`patch` has the power that the antenna receives, `spacecraft` the body with its attitude control, `pointing_runs` and
`pointing_figure` the results.
"""
