"""When the certificate applies: conditions that fail are named."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from lag_variants import variant

import covocp as co
from covocp.analysis.conditions import why_not
from covocp.models import mass_chain


def symmetric(ocp: co.Problem, x: Any, u: Any, E: Any, b: Any) -> None:
    ocp.dynamics(ocp.symmetric("Y", 1, initial=1.0), -u)


REFUSED = {
    "no estimation covariance": {"covariance": False, "terminal": lambda x, E, b: x**2},
    "no unknown parameters": {"unknown": False, "terminal": lambda x, E, b: x**2},
    "matrix states beside the estimation covariance: Y": {"extra": symmetric},
    "nothing is measured": {"measured": False},
    "the duration is free": {"duration": co.Free(10.0)},
    "the initial state is free": {"start": None},
    "correlated at the start": {"initial": np.array([[1.0, 0.5], [0.5, 5.0]])},
    "parameters is singular": {"variance": 0.0},
    "the rate of 'x' is not affine": {"rate": lambda x, b, u, t: -b * x - x**3 + u},
    "slope of the rate of 'x' by the parameters": {"rate": lambda x, b, u, t: -x - (b - 1) * x**2 + u},
    "the noise of 'x' depends": {"noise": lambda x, u: 1.0 + u**2},
    "slope of measurement 'position' by the state": {"measure": lambda x, b, u, t: x**2},
    "slope of measurement 'position' by the parameters": {"measure": lambda x, b, u, t: x + (b - 1) * u**2},
    "the noise of measurement 'position' depends": {"density": lambda x, u: 1.0 + x**2},
    "running cost depends on the covariance": {"running": lambda x, u, E, b: 0.5 * u**2 + E[b, b]},
    "running cost has kinks": {"running": lambda x, u, E, b: 0.5 * u**2 - ca.fabs(x)},
    "running cost has kinks or jumps": {"running": lambda x, u, E, b: 0.5 * u**2 + ca.if_else(x > 0, -x, 0.8 * x)},
    "terminal cost has kinks": {"terminal": lambda x, E, b: E[b, b] - ca.floor(x)},
    "the rate of 'x' is not affine in": {"rate": lambda x, b, u, t: -b * x + u + 0.1 * ca.floor(x)},
    "running cost is not quadratic": {"running": lambda x, u, E, b: 0.5 * u**2 + u**4},
    "not strictly convex in the control": {"running": lambda x, u, E, b: 0.5 * x**2},
    "not linear in the covariance": {"terminal": lambda x, E, b: E[b, b] ** 2},
    "terminal cost is not quadratic": {"terminal": lambda x, E, b: E[b, b] + x**4},
    "entries of the covariance other than": {"terminal": lambda x, E, b: E[b, b] + E[x, x]},
    "not positive semidefinite": {"terminal": lambda x, E, b: -E[b, b]},
    "depend on the covariance (among 'accuracy')": {
        "extra": lambda ocp, x, u, E, b: ocp.subject_to(E[b, b], upper=1.0, at="final", name="accuracy")
    },
    "not affine in state and control: 'disc'": {
        "extra": lambda ocp, x, u, E, b: ocp.subject_to(x**2 + u**2, upper=9.0, name="disc")
    },
}


@pytest.mark.parametrize(("reason", "changes"), REFUSED.items(), ids=REFUSED)
def test_conditions_that_fail_are_named(reason: str, changes: dict[str, Any]) -> None:
    statement = variant(**changes).statement()
    assert reason in why_not(statement, statement.values)


@pytest.mark.parametrize(("metres", "share"), [(1.0, 1.0), (1e7, 1e-6), (1e-7, 1e6)])
def test_the_start_is_judged_by_correlations(metres: float, share: float) -> None:
    """The same start in other units of state and parameter."""
    units = np.outer([metres, share], [metres, share])
    for correlation, reason in ((0.0, ""), (0.01, "correlated at the start"), (-0.9, "correlated at the start")):
        initial = np.array([[1.0, correlation], [correlation, 1.0]]) * units
        statement = variant(initial=initial).statement()
        assert (reason in why_not(statement, statement.values)) if reason else not why_not(statement, statement.values)


def test_a_cost_that_is_convex_in_the_control_at_round_times_only_is_refused() -> None:
    ocp = co.Problem(5.0)
    x = ocp.state("x", initial=0.0, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=0.5)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 * (1 + 1.5 * ca.sin(2 * np.pi * 2 * ocp.time)), terminal=E[b, b])
    st = ocp.statement()
    assert "not strictly convex in the control (at t =" in why_not(st, st.values)


def test_kinks_in_time_alone_are_allowed() -> None:
    changes = {"rate": lambda x, b, u, t: -b * x + ca.if_else(t > 5.0, 1.0, 2.0) * u + ca.fabs(t - 3.0)}
    st = variant(**changes).statement()
    assert why_not(st, st.values) == ""


def test_the_unchanged_variant_meets_all_conditions() -> None:
    statement = variant().statement()
    assert why_not(statement, statement.values) == ""


def test_a_nonlinear_chain_does_not_apply() -> None:
    certificate = co.certify(co.solve(mass_chain.problem(masses=1), intervals=80, progress=False))
    assert certificate.verdict == "does not apply"
    assert not certificate.certified
    assert certificate.smallest_eigenvalue is None
    assert str(certificate) == "does not apply: the rate of 'v' is not affine in state and control"
