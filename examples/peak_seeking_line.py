"""Peak seeking along a line
=========================

A plant finds the minimum of a function that it measures with noise, by a Kalman filter of gradient and Hessian.

The example in one dimension of Ryan and Speyer, 500 runs from outside: the law of the paper with corrected signs, the
same with the test that the Hessian is positive and with a limit of the step, and the robust form that is the default.
Then the default with a little excitation, drawn: position, values, estimates with three standard deviations against
the truth, and when the runs arrive.
"""

from covocp.models import peak_seeking_line as line

LEFT = (-5.0, -5.0, -5.0)  # steps of the command before the law takes over
LIMIT = {"largest_step": 5.0}
LAWS = {
    "as printed": {"settings": "printed"},
    "where M > 0": {"settings": "printed", "definite": True},
    "and |step| <= 5": {"settings": "printed", "definite": True, **LIMIT},
    "robust": {"drift": (1e-4, 1e-2), "transport": False, "reuse": False},
    "default": {},
    "default, excited": {"excitation": 0.5},
}

print("from x = 9, where f is convex:  in 1.2 m at 80 s  at 200 s  lost")
for name, settings in LAWS.items():
    runs = line.simulate(9.0, LEFT, **settings)
    print(f"  {name:30s}{runs.inside(80.0):15.2f}{runs.inside(200.0):10.2f}{runs.lost():6.2f}")

print("from x = 20, where it is not:")
for name in ("as printed", "robust", "default"):
    runs = line.simulate(20.0, LEFT, **LAWS[name])
    print(f"  {name:30s}{runs.inside(80.0):15.2f}{runs.inside(200.0):10.2f}{runs.lost():6.2f}")

excited = line.simulate(9.0, LEFT, excitation=0.5)
print(excited)
excited.plot("peak_seeking_line.png")
