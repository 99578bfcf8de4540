"""Decisions in exported code: a solver chooses them anew with each plan, a controller flies what was chosen."""

import numpy as np
import pytest
from exports import quick

import covocp as co
from covocp.export import export_c

pytestmark = pytest.mark.filterwarnings("ignore::covocp.CovocpWarning")  # the meshes are coarse


def start(level):
    """A start and a first variance that are bought, a sensor too, and a budget of energy; where it begins is given."""
    ocp = co.Problem(2.0, "plan")
    level = ocp.parameter("level", level)
    d = ocp.decision("d", guess=0.5, lower=0.1, upper=3.0, unit="m")
    r = ocp.decision("r", guess=0.5, lower=0.05, upper=5.0, unit="m^2 s")
    x, y = ocp.state("x", initial=d, variance=d), ocp.state("y", initial=0.3)
    u = ocp.control("u")
    ocp.dynamics(x, u - 0.2 * x)
    ocp.dynamics(y, x)
    ocp.measurement("m", x, noise=r)
    E = ocp.estimation_covariance()
    energy = ocp.integral(u**2, name="energy")
    ocp.minimize(running=0.1 / r + 0.05 * u**2, terminal=E[x, x] + (d - level) ** 2 + (y - 2.0) ** 2)
    ocp.subject_to(energy, upper=0.1)
    return ocp


@pytest.fixture(scope="module")
def planner(tmp_path_factory):
    """The solver of the problem, exported."""
    return export_c(start(0.6), tmp_path_factory.mktemp("planner") / "planner", intervals=10, segments=2)


@pytest.mark.parametrize("level", [0.6, 1.2])
def test_a_plan_chooses_as_solve_does(planner, level):
    """One number for each decision, that of the problem with the same parameter."""
    plan = planner.reference()(level=level)
    solution = co.solve(start(level), intervals=10, segments=2, progress=False, tolerance=1e-9)
    assert plan["cost"] == pytest.approx(solution.cost, rel=1e-7)
    for name in ("d", "r"):
        assert np.shape(plan[name]) in ((), (1,))
        assert float(np.squeeze(plan[name])) == pytest.approx(float(solution[name]), rel=1e-4)
    np.testing.assert_allclose(plan["x"], solution["x"], atol=1e-4)
    names = [port.name for port in planner.laws[0].inputs]
    assert "initial_y" in names
    assert not {"initial_x", "initial_E", "initial_energy", "initial_d"} & set(names)


@pytest.mark.needs_cc
def test_a_controller_flies_what_was_chosen(tmp_path):
    """The compiled controller of a loop is that of the problem with the number in place of the decision."""

    def loop(r=None):
        ocp = co.Problem(1.0, "loop")
        x, u = ocp.state("x", initial=1.0, final=0.0, variance=0.5), ocp.control("u")
        chosen = ocp.decision("r", guess=0.3, lower=0.02, upper=5.0) if r is None else ocp.parameter("r", r)
        ocp.dynamics(x, -0.3 * x + u, noise=0.1)
        ocp.measurement("m", x, noise=chosen)
        ocp.minimize_expected(running=0.5 * u**2 + 0.02 / chosen, terminal_weight={x: 4.0})
        return ocp

    solution = co.solve(loop(), intervals=10, progress=False)
    package = quick(export_c(solution, tmp_path / "chosen"))
    plain = export_c(co.evaluate(loop(float(solution["r"])), nominal=solution), tmp_path / "plain")
    controllers = [package.python(), plain.reference()]
    for laws in controllers:
        laws.step.init()
    random = np.random.default_rng(0)
    for t in np.linspace(0.0, 0.9, 10):
        m = float(np.interp(t, solution.t, solution["x"]) + 0.1 * random.standard_normal())
        one, two = (laws.step.step(m, t) for laws in controllers)
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-12)
