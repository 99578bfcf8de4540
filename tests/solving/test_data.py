"""What is done with solutions of problems with data: simulation under others, files, C code."""

import numpy as np
import pytest
from refusals import refused

import covocp as co

TIMES = np.linspace(0.0, 3.0, 121)  # more than are chosen between by comparisons


def gusty(gust=0.0, kind="linear"):
    """A lag in a wind, tracking with feedback; measured better when the wind is calm."""
    ocp = co.Problem(duration=3.0, name="lag in a wind")
    wind = ocp.data("wind", TIMES, np.sin(3 * TIMES) + gust, kind=kind, unit="m/s")
    wanted = ocp.data("wanted", [0.0, 1.2, 2.0, 3.0], [0.0, 1.0, 1.0, 0.0])
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, u - x + wind, noise=0.05)
    ocp.measurement("position", x, noise=0.02 * (1 + wind**2))
    ocp.minimize_expected(running=u**2 + 10 * (x - wanted) ** 2)
    return ocp, x


@pytest.fixture(scope="module")
def solution():
    return co.solve(gusty()[0], intervals=40, progress=False)


def test_both_methods_agree(solution):
    other = co.solve(gusty()[0], "gradient", intervals=40, progress=False)
    assert other.cost == pytest.approx(solution.cost, rel=1e-6)


def test_the_simulation_meets_the_expected_cost(solution):
    runs = co.simulate(solution, 2000, seed=3)
    assert abs(runs.cost - solution.cost) < 4 * runs.cost_error


@pytest.mark.parametrize("kind", ["perturbation", "extended"])
def test_a_truth_with_other_data_moves_the_mean_as_the_closed_loop_says(solution, kind):
    """Mean deviation d of the state and e of its estimate: d' = -d - C e + 0.4, e' = (-1 - C) e + K (d - e)."""
    runs = co.simulate(solution, 2000, seed=4, truth=gusty(0.4)[0], filter=kind)
    t = np.linspace(0.0, 3.0, 3001)
    C = np.interp(t, solution.t, np.ravel(solution.gains["C"]))
    K = np.interp(t, solution.t, np.ravel(solution.gains["K"]))
    d = e = 0.0
    for c, k in zip(C[:-1], K[:-1], strict=True):
        d, e = d + 1e-3 * (-d - c * e + 0.4), e + 1e-3 * ((-1 - c) * e + k * (d - e))
    final = runs.deviations[:, 0]
    assert abs(final.mean() - d) < 4 * final.std() / np.sqrt(final.size) + 2e-3
    assert d > 0.1


def test_a_file_of_a_problem_with_other_data_is_refused(solution, tmp_path):
    solution.save(tmp_path / "wind.npz")
    kept = co.load(tmp_path / "wind.npz", problem=gusty()[0])
    np.testing.assert_array_equal(kept["x"], solution["x"])
    refused(lambda: co.load(tmp_path / "wind.npz", problem=gusty(1e-9)[0]), "the values of the data 'wind'")


@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_c_code_computes_the_same_and_allocates_nothing(kind, tmp_path):
    ocp, _ = gusty(kind=kind)
    package = co.export_c(co.solve(ocp, intervals=40, progress=False), tmp_path / kind)
    package.build()
    check = package.check(samples=200)
    assert check.ok
    assert check.deviation < 1e-12
    sources = "".join(path.read_text() for path in (tmp_path / kind).glob("*.c"))
    assert "spline" in sources or "casadi_nd_boor" in sources  # the data are in it
    assert "malloc" not in sources
