"""Formation flight for less induced drag: the wake of a leader, what a follower gains in it, and the follower.

`vortex_lattice` has the aerodynamics, `drag_map` the table of them behind a leader, `aircraft` the follower with its
tracker of positions.
"""
