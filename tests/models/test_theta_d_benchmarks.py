"""Systems with known optimum: their closed forms against the Hamilton-Jacobi equation, and the laws against them."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.blocks import sdre, theta_d
from covocp.models import theta_d_benchmarks
from covocp.simulation.laws import simulate_law

RNG = np.random.default_rng(11)
CLOSED = ("cubic", "arctangent", "rational", "rational_split")
# The equations of section 9 once more, without input.
EQUATIONS = {
    "cubic": lambda x: [x[0] - x[0] ** 3],
    "arctangent": lambda x: [
        x[1],
        -x[0] * (np.pi / 2 + np.arctan(5 * x[0])) - 5 * x[0] ** 2 / (2 * (1 + 25 * x[0] ** 2)) + 4 * x[1],
    ],
    "rational": lambda x: [
        x[1],
        0.5 * (1 + x[0] ** 2 / 2) * x[1] - (x[1] / 2 + x[0] + x[0] * x[1] ** 2 / 2) / (1 + x[0] ** 2 / 2),
    ],
    "van_der_pol": lambda x: [x[1], -x[0] + (1 - x[0] ** 2) * x[1]],
    "two_inputs": lambda x: [x[0] - x[0] ** 3 + x[1], x[0] + x[0] ** 2 * x[1] - x[1]],
}
EQUATIONS["rational_split"] = EQUATIONS["rational"]


def arguments(name):
    system = theta_d_benchmarks.system(name)
    return system.x, system.A0, system.A, system.B, system.Q, system.R


def samples(name, size=2.0, count=8):
    return RNG.uniform(-size, size, (count, len(theta_d_benchmarks.STARTS[name])))


def cost(name, law, duration=25.0):
    system = theta_d_benchmarks.system(name)
    u = ca.SX.sym("u", system.B.shape[1])
    rate = (ca.DM(system.A0) + system.A) @ system.x + ca.DM(system.B) @ u
    running = 0.5 * (ca.bilin(ca.DM(system.Q), system.x, system.x) + ca.sumsqr(u))
    run = simulate_law(
        ca.Function("f", [system.x, u], [rate]),
        law,
        initial=theta_d_benchmarks.STARTS[name],
        duration=duration,
        running=ca.Function("c", [system.x, u], [running]),
        samples=2,
    )
    return run.cost[-1]


def optimal_cost(name):
    grid = np.linspace(0.0, 1.0, 201) ** 2
    return co.solve(theta_d_benchmarks.problem(name, duration=15.0), intervals=200, grid=grid, progress=False).cost


@pytest.mark.parametrize("name", theta_d_benchmarks.SYSTEMS)
def test_factored_systems_are_the_equations(name):
    system = theta_d_benchmarks.system(name)
    factor = ca.Function("F", [system.x], [system.A])
    np.testing.assert_allclose(factor(np.zeros(len(system.A0))).full(), 0.0, atol=1e-15)
    for x in samples(name):
        np.testing.assert_allclose((system.A0 + factor(x).full()) @ x, EQUATIONS[name](x), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_forms_solve_the_hamilton_jacobi_equation(name):
    """V_x f - |B' V_x|^2/2 + x'Q x/2 = 0, u = -B' V_x, V(0) = 0, with V_x by central differences."""
    system = theta_d_benchmarks.system(name)
    size = len(system.A0)
    assert theta_d_benchmarks.exact(name, np.zeros(size)).cost[0] == pytest.approx(0.0, abs=1e-15)
    step = 1e-4
    for x in samples(name):
        shifts = step * np.eye(size)
        value = [theta_d_benchmarks.exact(name, x + factor * shifts).cost for factor in (-2, -1, 1, 2)]
        gradient = (value[0] - 8 * value[1] + 8 * value[2] - value[3]) / (12 * step)
        reached = system.B.T @ gradient
        residual = gradient @ EQUATIONS[name](x) - 0.5 * reached @ reached + 0.5 * x @ system.Q @ x
        assert abs(residual) < 1e-9 * (1.0 + gradient @ gradient)
        np.testing.assert_allclose(theta_d_benchmarks.exact(name, x).control[0], -reached, rtol=1e-8, atol=1e-9)


def test_riccati_law_of_the_cubic_system_is_optimal():
    law = sdre.regulator(*arguments("cubic"))
    for x in samples("cubic"):
        np.testing.assert_allclose(law(x, 0.0), theta_d_benchmarks.exact("cubic", x).control[0], rtol=1e-10)


def test_theta_d_of_the_cubic_system_converges_within_its_radius():
    """a = -x^2 with |a| < sqrt(2); the error falls like (x^2/sqrt(2))^terms."""
    for x in (0.2, 0.5, 0.8):
        terms = int(np.ceil(np.log(1e-12) / np.log(x**2 / np.sqrt(2.0)))) + 2
        law = theta_d.regulator(*arguments("cubic"), terms=terms)
        assert float(law(x, 0.0)) == pytest.approx(theta_d_benchmarks.exact("cubic", x).control[0, 0], abs=1e-10)


def test_outside_its_radius_the_whole_series_has_the_wrong_sign():
    found = float(theta_d.regulator(*arguments("cubic"), terms=3)(2.0, 0.0))
    # -2 (1 + sqrt(2) - 4 (1 + 1/sqrt(2)) + 16 sqrt(2)/8)
    assert found == pytest.approx(3.1716, abs=5e-5)
    assert theta_d_benchmarks.exact("cubic", 2.0).control[0, 0] == pytest.approx(-0.3246, abs=5e-5)


@pytest.mark.parametrize("terms", [1, 2, 3, 5])
@pytest.mark.parametrize(("k", "l"), [(0.0, 0.0), (1.0, 0.01), (0.4, 2.0)])
@pytest.mark.parametrize("form", ["polynomial", "operator"])
def test_every_law_of_the_arctangent_system_is_the_optimum(terms, k, l, form):
    law = theta_d.regulator(*arguments("arctangent"), terms=terms, k=k, l=l, form=form)
    for x in samples("arctangent"):
        for t in (0.0, 0.7, 30.0):
            assert float(law(x, t)) == pytest.approx(-3.0 * x[1], abs=1e-10)


def test_laws_of_the_rational_system():
    """The first split: SDRE is exact and θ-D with k = 0 converges to it. The second: it is not."""
    first, second = sdre.regulator(*arguments("rational")), sdre.regulator(*arguments("rational_split"))
    for x in samples("rational", size=1.0):
        optimal = theta_d_benchmarks.exact("rational", x).control[0]
        np.testing.assert_allclose(first(x, 0.0), optimal, atol=1e-10)
    x = np.array([0.3, -0.4])
    optimal = theta_d_benchmarks.exact("rational", x).control[0, 0]
    errors = [abs(float(theta_d.regulator(*arguments("rational"), terms=n)(x, 0.0)) - optimal) for n in (1, 3, 6, 12)]
    assert np.all(np.diff(errors) < 0.0)
    assert errors[-1] < 1e-10
    assert abs(second(x, 0.0)[0] - optimal) > 1e-3


def test_the_cost_depends_on_the_factorisation():
    optimal = theta_d_benchmarks.exact("rational", theta_d_benchmarks.STARTS["rational"]).cost[0]
    costs = {name: cost(name, sdre.regulator(*arguments(name)), 40.0) for name in ("rational", "rational_split")}
    assert costs["rational"] == pytest.approx(optimal, rel=1e-6)
    assert costs["rational_split"] > 1.001 * optimal
    assert optimal == pytest.approx(optimal_cost("rational"), rel=1e-5)


@pytest.mark.filterwarnings("ignore:.*along these controls alone")  # along its controls alone
def test_two_inputs_as_published():
    """Section 9 d: at (2, -2) the linear regulator beats the state-dependent one; the series diverges there."""
    optimal = optimal_cost("two_inputs")
    assert optimal == pytest.approx(1.7790, abs=5e-5)
    assert cost("two_inputs", theta_d.regulator(*arguments("two_inputs"), terms=1)) == pytest.approx(1.9863, abs=5e-5)
    assert cost("two_inputs", sdre.regulator(*arguments("two_inputs"))) == pytest.approx(3.9961, abs=5e-5)
    assert not theta_d.convergence(*arguments("two_inputs"), [2.0, -2.0], warn=False).converges


def test_laws_of_the_van_der_pol_system_are_near_the_optimum():
    optimal = optimal_cost("van_der_pol")
    linear = cost("van_der_pol", theta_d.regulator(*arguments("van_der_pol"), terms=1))
    three = cost("van_der_pol", theta_d.regulator(*arguments("van_der_pol")))
    riccati = cost("van_der_pol", sdre.regulator(*arguments("van_der_pol")))
    assert optimal < riccati < three < linear < 1.06 * optimal
    assert three < 1.03 * optimal


def test_unknown_systems_are_refused():
    with pytest.raises(co.ProblemError, match="There is no such system"):
        theta_d_benchmarks.system("pendulum")
    with pytest.raises(co.ProblemError, match="no closed form"):
        theta_d_benchmarks.exact("van_der_pol", [1.0, 1.0])
