"""Models in phases whose covariance goes on: along their controls it is that of an independent integration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.models import powered_descent, unknown_lag

QUIET: dict[str, Any] = {"progress": False}


def flown(solution: co.Solution, rate: Any, start: Any) -> Any:
    """The end of an integration along a solution's controls, interval by interval: they are straight lines in each."""
    y = np.asarray(start, dtype=float)
    for k, (t0, t1) in enumerate(zip(solution.t[:-1], solution.t[1:], strict=True)):
        u0, u1 = solution.controls[k], solution.controls[k + 1]

        def slope(t: float, y: Any, u0: Any = u0, u1: Any = u1, t0: float = t0, t1: float = t1) -> Any:
            return rate(y, u0 + (t - t0) / (t1 - t0) * (u1 - u0))

        y = solve_ivp(slope, (t0, t1), y, rtol=1e-9, atol=1e-9).y[:, -1]
    return y


def riccati(P: Any, F: Any, Q: Any, M: Any, U: Any) -> Any:
    gain = P @ M.T @ np.linalg.inv(U) if M.size else np.zeros((P.shape[0], 0))
    return F @ P + P @ F.T + Q - gain @ M @ P


def descent_rate(radar: bool) -> Any:
    model = powered_descent

    def rate(y: Any, u: Any) -> Any:
        x, P = y[:4], y[4:].reshape(5, 5)
        F = np.zeros((5, 5))
        F[0, 2] = F[1, 3] = 1.0
        F[2:4, 4] = u
        Q = np.diag([0.0, 0.0, model.THRUST_NOISE, model.THRUST_NOISE, 0.0])
        M = np.eye(5)[1:4] if radar else np.zeros((0, 5))
        U = np.diag([model.ALTIMETER + (model.SHARE * x[1]) ** 2, model.VELOCIMETER, model.VELOCIMETER])
        moved = np.array([x[2], x[3], u[0], u[1] - model.GRAVITY])
        return np.concatenate([moved, riccati(P, F, Q, M, U).ravel()])

    return rate


def test_the_descent_learns_from_its_radar_below_the_altitude() -> None:
    solution = co.solve(powered_descent.phases(), intervals=40, **QUIET)
    inertial, radar = solution
    assert inertial["h"][-1] == pytest.approx(powered_descent.SWITCHED_ON)
    start = np.diag([*powered_descent.VARIANCES.values(), powered_descent.SCALE_VARIANCE])
    y = np.concatenate([list(powered_descent.HIGH_GATE.values()), start.ravel()])
    for phase, rate in ((inertial, descent_rate(False)), (radar, descent_rate(True))):
        y = flown(phase, rate, y)
        x, E = y[:4], y[4:].reshape(5, 5)
        np.testing.assert_allclose(x, [phase[name][-1] for name in "shvw"], atol=2e-4)
        np.testing.assert_allclose([phase.deviation(n)[-1] for n in "shvwk"], np.sqrt(np.diag(E)), rtol=1e-4)
    assert inertial.deviation("h")[-1] > powered_descent.VARIANCES["h"] ** 0.5
    plain = co.solve(powered_descent.phases(weight=0.0), intervals=40, **QUIET)
    assert radar.deviation("h")[-1] == pytest.approx(0.489, abs=1e-3)  # as the page says
    assert plain["radar"].deviation("h")[-1] == pytest.approx(0.516, abs=1e-3)


def test_the_lag_is_learnt_before_it_is_steered() -> None:
    def rate(y: Any, u: Any) -> Any:
        x, P = y[0], y[1:].reshape(2, 2)
        F = np.array([[-1.0, -x], [0.0, 0.0]])
        moved = riccati(P, F, np.diag([1.0, 0.0]), np.array([[1.0, 0.0]]), np.eye(1))
        return np.concatenate([[-x + u[0]], moved.ravel()])

    solution = co.solve(unknown_lag.phases(), intervals=[60, 40], **QUIET)
    assert solution.cost == pytest.approx(3.15455973, abs=2e-5)
    y = np.concatenate([[0.0], np.diag([1.0, 5.0]).ravel()])
    for phase in solution:
        y = flown(phase, rate, y)
        np.testing.assert_allclose(y[0], phase["x"][-1], atol=1e-6)
        np.testing.assert_allclose(y[1:].reshape(2, 2), phase["E"][-1], atol=2e-5)
    assert solution.cost_terms["experiment"] > 0.1  # nothing of its own phase asks for it
