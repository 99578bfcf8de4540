"""C code of problems with conditions at instants: trajectories that jump there, and solvers that meet them."""

from __future__ import annotations

from typing import Any

from exports import quick

import covocp as co


def swift() -> co.Problem:
    """A velocity prescribed on the way: the control jumps."""
    ocp = co.Problem(3.0, name="swift")
    x, v = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.subject_to(v, at=1.2, equals=0.9, name="speed")
    ocp.subject_to(x, at="final", equals=1.0, name="end")
    ocp.minimize(running=u**2)
    return ocp


def test_a_trajectory_jumps_at_the_instant(tmp_path: Any) -> None:
    solution = co.solve(swift(), intervals=10, progress=False)
    package = quick(co.export_c(solution, tmp_path / "swift"))
    assert package.check().ok
    before, after = (float(solution.at(1.2, side)["u"]) for side in ("before", "after"))
    assert abs(after - before) > 0.1


def test_a_solver_meets_it_from_other_starts(tmp_path: Any) -> None:
    package = quick(co.export_c(swift(), tmp_path / "solver", intervals=10))
    assert package.check(samples=5).ok
