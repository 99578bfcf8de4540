"""Slopes and Hessians along known nodes, by numbers in the compiled library: against CasADi's of the same steps."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from along_problems import PROBLEMS, alike

import covocp as co
from covocp.extremal import costates, lagrangian
from covocp.extremal.active_constraints import held_by
from covocp.extremal.adjoint_steps import explicit_pairs
from covocp.extremal.along_nodes import _along_nodes, along_nodes
from covocp.extremal.costates import discrete_costates, integrated_costates
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import refined
from covocp.extremal.forms import has_forms
from covocp.models import mass_chain
from covocp.passage import library
from covocp.passage.columns import derivative_in_columns

pytestmark = pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))


@pytest.fixture(params=PROBLEMS)
def extremal(request: pytest.FixtureRequest) -> Extremal:
    """Nodes that no run joins, with multipliers of everything."""
    make, options = PROBLEMS[request.param]
    options = {"intervals": 34, "max_iterations": 0, "allow_failure": True, "progress": False} | options
    found = co.solve(make(), **options).extremal
    rng = np.random.default_rng(len(request.param))
    t, m = found.trajectory, found.multipliers

    def near(values: np.ndarray) -> np.ndarray:
        return np.asarray(values + 0.05 * np.abs(values).max(initial=0.1) * rng.normal(size=values.shape))

    weights = {own.name: 0.3 * rng.normal(size=np.shape(getattr(m, own.name))) for own in fields(m)}
    return replace(found, trajectory=replace(t, x=near(t.x), u=near(t.u)), multipliers=replace(m, **weights))


def without(monkeypatch: pytest.MonkeyPatch) -> None:
    """By CasADi from here on."""
    for module in (costates, lagrangian):
        monkeypatch.setattr(module, "along_nodes", lambda *_: None)
    discrete_costates.cache_clear()


def test_costates_and_slopes_are_those_of_casadi(extremal: Extremal, monkeypatch: pytest.MonkeyPatch) -> None:
    fine = refined(extremal)
    assert along_nodes(fine.statement, fine.mesh, fine.trajectory, fine.parameters) is not None
    own, by_controls, by_duration = discrete_costates(extremal)
    without(monkeypatch)
    other, known, duration = discrete_costates(extremal)
    alike(own.state, other.state)
    alike(own.matrices, other.matrices)
    alike(by_controls, known)
    assert by_duration == pytest.approx(duration, rel=1e-9)


def test_slopes_of_intervals_are_those_of_casadi(extremal: Extremal, monkeypatch: pytest.MonkeyPatch) -> None:
    own = lagrangian.slopes_of_intervals(extremal)
    without(monkeypatch)
    for one, other in zip(own, lagrangian.slopes_of_intervals(extremal), strict=True):
        alike(one, other)


def test_products_are_those_of_casadi(extremal: Extremal, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Hessian of the Lagrangian times directions of all nodes and controls, one after the other."""
    fine = refined(extremal)
    fine = replace(fine, multipliers=replace(fine.multipliers, matrices=np.zeros_like(fine.multipliers.matrices)))
    held = held_by(fine, extremal.mesh.points)
    fine = held.bare(fine)
    given = discrete_costates(fine)[0]
    assert lagrangian._hessian(fine, given, held.entries) is not None
    product = lagrangian.product_along(fine, given, held.entries)[0]
    without(monkeypatch)
    known = lagrangian.product_along(fine, given, held.entries)[0]
    rng = np.random.default_rng(0)
    size = lagrangian.node_size(fine.statement) * (fine.mesh.intervals + 1) + fine.trajectory.u.size
    for direction in (*rng.normal(size=(3, size)), np.zeros(size), np.eye(1, size)[0]):
        alike(product(direction), known(direction))


def test_integrated_costates_are_those_of_the_slopes_of_h(monkeypatch: pytest.MonkeyPatch, extremal: Extremal) -> None:
    """Both of order four in the length of the steps, with the same impulses and restarts."""
    assert has_forms(extremal.statement)
    needed, first = explicit_pairs(extremal)
    with np.errstate(over="ignore", invalid="ignore"):  # before the first node that explicit steps reach
        own = [integrated_costates(extremal, times * needed) for times in (2, 4, 8)]
    monkeypatch.setattr(costates, "has_forms", lambda _: False)
    known = integrated_costates(extremal, 24 * needed)
    for place in ("state", "matrices"):
        exact = getattr(known, place)[first:]
        size = np.abs(exact).max(initial=1e-300)
        errors = [np.abs(getattr(one, place)[first:] - exact).max(initial=0.0) / size for one in own]
        assert errors[2] <= 1e-5
        assert all(fine <= max(before / 10.0, 1e-9) for before, fine in pairwise(errors))


@pytest.mark.parametrize("missing", [("forward",), ("reverse",), ("reverse", "forward")])
def test_what_the_library_has_no_derivatives_of_is_casadis(
    monkeypatch: pytest.MonkeyPatch, missing: tuple[str, ...]
) -> None:
    """Derivatives of too many operations are not made."""
    solution = co.solve(mass_chain.problem(masses=1), intervals=60, progress=False)
    known = solution.optimality
    made = derivative_in_columns

    def some(owner: Any, function: ca.Function, *kinds: str) -> Any:
        return None if kinds == missing else made(owner, function, *kinds)

    monkeypatch.setattr("covocp.extremal.along_nodes.derivative_in_columns", some)
    _along_nodes.cache_clear()
    discrete_costates.cache_clear()
    again = co.solve(mass_chain.problem(masses=1), intervals=60, progress=False).optimality
    assert again.curvature == pytest.approx(known.curvature, rel=1e-6)
    assert again.costate_difference == pytest.approx(known.costate_difference, rel=1e-6)
