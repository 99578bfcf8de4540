"""Phases with a decision whose slope vanishes by symmetry: it is left, or told."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import covocp as co
from covocp.extremal.phase_curvature import curvature_between_links
from covocp.transcription import first_guess


def in_two(guess, terminal, *, last=False):
    """A way of 1 in two phases of 1 s, for int u^2 = 1/2; one phase has a decision besides, with a cost of its own."""
    phases = []
    for k in range(2):
        ocp = co.Problem(1.0, name=f"phase {k}")
        x, u = ocp.state("x", initial=None if k else 0.0, final=1.0 if k else None), ocp.control("u")
        ocp.dynamics(x, u)
        cost = 0.0
        if k == int(last):
            cost = terminal(ocp.decision("r", guess=guess, lower=-2.0, upper=2.0))
        ocp.minimize(running=u**2, terminal=cost)
        phases.append(ocp)
    return co.Phases(phases, name="way")


def valleys(r):
    """-2.4 at the bounds, a maximum at 0."""
    return 0.1 * r**4 - r**2


@pytest.mark.parametrize("method", ["ipopt", "auto", "gradient"])
@pytest.mark.parametrize("guess", [0.0, 0.5, -1.0])
@pytest.mark.parametrize("last", [False, True])
def test_a_decision_leaves_its_symmetric_guess(guess, method, last):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = co.solve(in_two(guess, valleys, last=last), method=method, progress=False)
    assert solution.cost == pytest.approx(0.5 - 2.4, abs=1e-6)


@pytest.mark.parametrize("last", [False, True])
def test_a_maximum_that_slopes_do_not_show_is_told(last, monkeypatch):
    monkeypatch.setattr(first_guess, "BESIDE", 0.0)
    with pytest.warns(co.CovocpWarning, match=f"phase {int(last)}' is no minimum"):
        solution = co.solve(in_two(0.0, valleys, last=last), method="gradient", progress=False)
    assert solution.cost == pytest.approx(0.5, abs=1e-6)
    found = curvature_between_links([phase.extremal for phase in solution.phases], solution.links, int(last))
    assert found.verdict == "saddle"
    along_x = found.start[:1], found.direction
    assert np.max([np.abs(part).max() for part in along_x]) < 1e-6 * np.abs(found.start[1])


@pytest.mark.parametrize("method", ["ipopt", "gradient"])
@pytest.mark.parametrize("best", [0.0, 1.0])
@pytest.mark.parametrize("last", [False, True])
def test_a_minimum_that_the_guess_met_is_none_to_be_told(best, method, last):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = co.solve(in_two(best, lambda r: (r - best) ** 2, last=last), method=method, progress=False)
    assert solution.cost == pytest.approx(0.5, abs=1e-6)


def test_what_passes_to_a_later_phase_is_held():
    """x may not move at the end of the first phase alone: its own concave cost there is none of a free end."""
    phases = in_two(0.5, lambda r: (r - 0.5) ** 2)
    solution = co.solve(phases, method="ipopt", progress=False)
    for i in (0, 1):
        found = curvature_between_links([phase.extremal for phase in solution.phases], solution.links, i)
        z = found.start[0]
        assert found.verdict == "minimum"
        assert z == pytest.approx(0.0, abs=1e-9)
