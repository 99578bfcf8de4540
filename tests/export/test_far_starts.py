"""Starts that the mesh or the bounds of an exported solver do not fit: the status says so."""

from __future__ import annotations

import numpy as np
import pytest
from exports import QUICK
from limited_speed import cost_along, limited_speed
from problems import unassessed

import covocp as co

pytestmark = pytest.mark.needs_cc


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    package = co.export_c(limited_speed(), tmp_path_factory.mktemp("far") / "p", name="limited", intervals=20)
    package.build(flags=QUICK)
    return package


@pytest.mark.parametrize("prior", [0.01, 0.1, 0.5, 2.0, 10.0, 1e3, 1e6])
def test_a_prior_that_the_mesh_does_not_bear_is_told(package, prior):
    """OK means a cost that is right to about 1 %: it had been said of 33334 in place of 1.387."""
    plan = package.python().solve(initial_E=prior * np.eye(2))
    error = abs(plan["cost"] / cost_along(plan["time"].ravel(), plan["u"].ravel(), prior * np.eye(2)) - 1)
    assert plan["status"] == ("COARSE" if error > 0.01 else "OK")
    assert (error < 0.005) == (prior < 1.0)
    assert plan["infeasibility"] < 1e-6
    assert plan["stationarity"] < 1e-5


SPEEDS = [((0.01, 0.1), "OK"), ((0.0, 0.01), "OK"), ((0.0, 1.0), "OK"), ((0.0, 10.0), "OK"), ((0.1, 10.0), "OK")]
SPEEDS += [((position, speed), "COARSE") for position in (0.0, 1e-6, 0.01) for speed in (1e3, 1e6)]
SPEEDS += [((1e3, 0.0), "COARSE")]


@pytest.mark.parametrize(("variances", "status"), SPEEDS)
def test_an_unknown_speed_is_an_unknown_position_within_the_first_step(package, variances, status):
    """The cost had been 7 % too low, and OK: where the position is known nothing seems to be learnt at the start."""
    prior = np.diag(variances)
    plan = package.python().solve(initial_E=prior)
    error = abs(plan["cost"] / cost_along(plan["time"].ravel(), plan["u"].ravel(), prior) - 1)
    assert plan["status"] == status
    assert (error < 0.01) == (status == "OK")


def test_an_error_that_dies_out_at_once_is_borne(tmp_path):
    """A wind that changes within 5 ms, on intervals of 0.2 s."""
    ocp = co.Problem(4.0, "wind")
    v = ocp.state("v", initial=0.0, final=1.0, variance=0.01)
    w = ocp.state("w", initial=0.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(v, u + w)
    ocp.dynamics(w, -200.0 * w, noise=0.01)
    ocp.measurement("m", v, noise=0.01)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.1 * u**2 + E[v, v])
    declared = co.export_c(ocp, tmp_path / "p", name="wind", intervals=20).reference().solve()
    assert declared["status"] == "OK"
    assert declared["cost"] == pytest.approx(unassessed(ocp, intervals=200).cost, rel=0.01)


def test_the_package_says_what_it_means(package):
    assert package.check(samples=30).ok
    readme = (package.directory / "README.md").read_text(encoding="utf-8")
    assert "LIMITED_COARSE" in readme
    assert "too coarse for so much uncertainty at the start" in readme


def test_a_cost_that_does_not_see_the_way_bears_any_prior(tmp_path):
    planner = co.export_c(limited_speed(running=False), tmp_path / "p", name="final", intervals=20).reference()
    assert planner.solve(initial_E=1e6 * np.eye(2))["status"] == "OK"


@pytest.mark.parametrize(("speed", "status"), [(1.0, "OK"), (1.0 + 1e-9, "OK"), (1.2, "NOT_CONVERGED")])
def test_a_start_outside_of_its_bounds_violates_them(package, speed, status):
    plan = package.python().solve(initial_v=speed)
    assert plan["status"] == status
    assert (plan["infeasibility"] > 1e-6) == (speed > 1.1)
    assert plan["v"][0] == pytest.approx(speed)
