"""Attitudes in the loop: the expected cost, the actual system, both filters and the compiled controller."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from attitudes import steered, tracked
from exports import quick

import covocp as co
from covocp.blocks import so3
from covocp.estimators import extended_filter, initial_estimate


@lru_cache
def pointing():
    return co.solve(steered()[0], intervals=16, progress=False)


@pytest.mark.parametrize("kind", ["perturbation", "extended"])
def test_simulated_attitudes_scatter_as_predicted(kind):
    sample = co.simulate(pointing(), 1000, 5, filter=kind, step=0.01, store=3, progress=False)
    assert sample.verdict.holds, str(sample)
    error = sample.costs.mean() - pointing().cost
    assert abs(error) < 3.5 * sample.costs.std() / np.sqrt(sample.runs)


def test_the_expected_cost_by_both_of_its_forms():
    loop = pointing().loop
    assert loop.other_cost == pytest.approx(loop.expected_cost, rel=1e-5)
    assert loop.X.shape[1:] == (3, 3)
    assert np.abs(loop.Z).max() < 1e-3 * np.abs(loop.E).max()


def test_the_continuous_extended_filter_has_the_covariance_of_the_plan():
    """Where readings are as expected its covariance is E along the nominal, by integration with scipy."""
    from scipy.integrate import solve_ivp

    ocp, _ = tracked()
    solution = co.evaluate(ocp, nominal={"torque": lambda s: np.array([np.sin(3 * s), 0 * s + 0.5, np.cos(2 * s)]).T})
    rate = extended_filter(ocp)
    x, P = initial_estimate(ocp)
    assert (x.shape, P.shape) == ((10,), (9, 9))

    def slope(t, y):
        u = [np.interp(t, solution.t, column) for column in solution["torque"].T]
        C = so3.from_quaternion(y[3:7] / np.linalg.norm(y[3:7]))
        dx, dP = rate(y[:10], y[10:].reshape(9, 9), u, np.concatenate([y[:3] + y[7:10], C[:, 0]]), t)
        return np.concatenate([dx.full().ravel(), dP.full().ravel()])

    found = solve_ivp(slope, (0.0, 10.0), np.append(x, P), method="LSODA", rtol=1e-7, atol=1e-11, max_step=0.5).y[:, -1]
    true = solution["E"][-1]
    assert found[10:].reshape(9, 9) == pytest.approx(true, abs=1e-5 * np.abs(true).max())
    assert so3.from_quaternion(found[3:7] / np.linalg.norm(found[3:7])) == pytest.approx(
        so3.from_quaternion(solution["attitude"][-1]), abs=1e-5
    )


def test_the_discrete_extended_filter_corrects_by_rotations():
    """One update of a known attitude error, against the linear update of the rotation vector."""
    ocp, _ = steered(spread=0.01)
    _, update = extended_filter(ocp, step=0.1)
    q, P = so3.to_quaternion(so3.exp([0.2, -0.3, 0.5])), np.diag([1e-2, 2e-2, 1e-2])
    true = so3.exp([0.05, -0.02, 0.03]) @ so3.from_quaternion(q)
    reading = np.concatenate([true[:, 0], true[:, 1]])
    after, spread = update(q, P, reading, np.zeros(3), 0.0)
    C = so3.from_quaternion(q)
    M = np.vstack([so3.cross(C[:, 0]), so3.cross(C[:, 1])])
    K = P @ M.T @ np.linalg.inv(M @ P @ M.T + 0.03 * np.eye(6))
    change = K @ (reading - np.concatenate([C[:, 0], C[:, 1]]))
    assert so3.from_quaternion(after.full().ravel()) == pytest.approx(so3.exp(change) @ C, abs=1e-12)
    assert spread.full() == pytest.approx((np.eye(3) - K @ M) @ P, abs=1e-12)


def test_the_compiled_controller_points_as_python_does(tmp_path):
    package = quick(co.export_c(pointing(), tmp_path / "pointing"))
    assert "malloc" not in "".join(path.read_text() for path in (tmp_path / "pointing").glob("*.c"))
    assert package.check(200).ok
    sample = co.simulate(pointing(), 64, 5, law=package.python(), period=0.004, store=3, progress=False, step=0.004)
    predicted = np.sqrt(np.diag(pointing().loop.X[-1]))
    assert np.sqrt(np.mean(sample.deviations**2, axis=0)) == pytest.approx(predicted, rel=0.35)


def test_an_exported_attitude_is_of_unit_length_between_the_nodes(tmp_path):
    laws = quick(co.export_c(pointing(), tmp_path / "unit", feedback=False)).python()
    for time in np.linspace(0.01, 3.99, 23):
        assert np.linalg.norm(laws.sample(time)["attitude"]) == pytest.approx(1.0, abs=1e-14)


def test_certificates_say_why_attitudes_have_none():
    ocp, _ = tracked()
    found = co.certify(co.evaluate(ocp, nominal={"torque": 0.1}), progress=False)
    assert found.verdict == "does not apply"
    assert "attitude" in found.reason
