"""A start of a problem whose guess may change is made once in a solve, and anew in the next one."""

from __future__ import annotations

from typing import Any

import numpy as np

import covocp as co
from covocp.transcription.starts import own_start, starts_kept


def guessed() -> tuple[co.Problem, list[float]]:
    """An integrator whose guess of the control is a function, and the values that it gives."""
    sizes = [0.5]

    def guess(t: Any) -> np.ndarray:
        return sizes[0] * np.ones_like(np.asarray(t, dtype=float))

    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u", guess=guess)
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=(x - 1.0) ** 2)
    return ocp, sizes


def test_within_a_solve_a_start_is_the_same_and_later_the_guess_is_asked_again():
    ocp, sizes = guessed()
    solver = co.Solver(ocp, intervals=10)
    given = solver.statement, solver.solve(progress=False).mesh, np.zeros(0)
    with starts_kept():
        first = own_start(*given)
        sizes[0] = 2.0
        assert own_start(*given) is first
        with starts_kept():  # a solve in this one
            assert own_start(*given).trajectory.u.max() == 2.0
        assert own_start(*given) is first
    assert own_start(*given).trajectory.u.max() == 2.0
    assert first.trajectory.u.max() == 0.5
    assert own_start(*given) is not own_start(*given)
