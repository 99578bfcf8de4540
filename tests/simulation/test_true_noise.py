"""What is truly uncertain is a covariance, a density or a variance, in `simulate` as in `evaluate`; zero is one too."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co

INSTANTS = [0.5, 1.5]
CALLS = [co.evaluate, lambda *a, **k: co.simulate(*a, 20, 1, progress=False, **k)]


def loop(noise=None, process=lambda ocp: 0.01, **at):
    ocp = co.Problem(2.0, name="loop")
    x, u = ocp.state("x", initial=0.0, final=3.0, variance=0.1), ocp.control("u")
    R = ocp.parameter("R", 0.1)
    ocp.dynamics(x, u, noise=process(ocp))
    ocp.measurement("m", x, noise=noise(ocp) if noise else R, **at)
    ocp.minimize_expected(running=0.1 * u**2, terminal_weight={x: 3.0})
    return ocp


@pytest.fixture(scope="module", params=[{}, {"at": INSTANTS}], ids=["continuous", "instants"])
def design(request):
    return co.solve(loop(**request.param), intervals=10, progress=False), request.param


@pytest.mark.parametrize("call", CALLS, ids=["evaluate", "simulate"])
def test_negative_noise_flies_nowhere(design, call):
    solution, at = design
    what = f"measurement noise {'variance' if at else 'density'} of m"
    with pytest.raises(co.ProblemError, match=f"{what} is negative at t = {0.5 if at else 0} s"):
        call(solution, truth={"R": -0.05})
    falling = loop(noise=lambda ocp: 1.0 - ocp.time, **at)
    with pytest.raises(co.ProblemError, match=f"{what} is negative at t = {1.5 if at else 1.2} s"):
        call(solution, truth=falling)
    with pytest.raises(co.ProblemError, match=r"process noise density of x is negative at t = 1\.\d s.*in the truth"):
        call(solution, truth=loop(process=lambda ocp: 0.011 - 0.01 * ocp.time, **at))


def test_true_noise_of_readings_counts_where_they_are():
    """(t - 0.6)(t - 1.4) is 0.09 at the instants of the design, and negative between them."""
    solution = co.solve(loop(at=INSTANTS), intervals=10, progress=False)
    varying = loop(noise=lambda ocp: (ocp.time - 0.6) * (ocp.time - 1.4), at=INSTANTS)
    under, plain = (co.evaluate(solution, truth=truth).cost for truth in (varying, {"R": 0.09}))
    assert under == pytest.approx(plain, rel=1e-12)


def test_no_noise_at_all_is_a_truth(design):
    """Without noise of the sensor the error of the estimate is that of the start and of the process alone."""
    solution, _ = design
    runs = co.simulate(solution, 300, 1, truth={"R": 0.0}, progress=False)
    assert runs.verdict.holds, runs.verdict
    assert runs.predicted_error[-1, 0, 0] < solution.loop.E[-1, 0, 0]


def two_phases(noise):
    problems = []
    for name, initial in (("A", {"initial": 0.0, "variance": 0.1}), ("B", {"initial": None})):
        ocp = co.Problem(1.0, name=name)
        x, u = ocp.state("x", **initial), ocp.control("u")
        ocp.dynamics(x, u, noise=0.01)
        ocp.measurement("m", x, noise=0.1)
        ocp.minimize_expected(running=0.1 * u**2, terminal=(x - 1) ** 2)
        problems.append((ocp, x))
    (first, x), (second, y) = problems
    phases = co.Phases([first, second])
    phases.jump(y, x, noise=noise(x))
    return phases


def test_negative_noise_of_a_true_jump_flies_nowhere():
    """x ends near 1; noise of 0.02 - 0.03 x leaves the covariance positive."""
    solution = co.solve(two_phases(lambda x: 0.02), intervals=5, progress=False)
    for call in CALLS:
        with pytest.raises(co.ProblemError, match="noise variance of the jump from 'A' to 'B' of x is negative"):
            call(solution, truth=two_phases(lambda x: 0.02 - 0.03 * x))
    assert np.isfinite(co.evaluate(solution, truth=two_phases(lambda x: 0.0)).cost)
