"""Noise densities and bounds of matrices that are broken on the way are never passed off as solutions."""

import casadi as ca
import numpy as np
import pytest

import covocp as co


def moving(measurement, process=lambda ocp: 0.1, **at):
    ocp = co.Problem(4.0)
    x = ocp.state("x", initial=0, final=1, variance=1)
    b = ocp.unknown("b", 1, 1)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=process(ocp))
    ocp.measurement("m", x, noise=measurement(ocp), **at)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=5 * E[b, b])
    return ocp


@pytest.mark.parametrize(
    ("measurement", "process", "words"),
    [
        (lambda ocp: 1 - 0.41 * ocp.time, lambda ocp: 0.1, ("measurement noise density of m", "t = 2.6 s")),
        (lambda ocp: (ocp.time - 2) ** 2, lambda ocp: 0.1, ("measurement noise density of m", "t = 2 s")),
        (lambda ocp: 1.0, lambda ocp: 0.3 - 0.12 * ocp.time, ("process noise density of x is negative", "t = 2.6 s")),
    ],
)
def test_density_that_no_noise_has_is_no_solution(measurement, process, words):
    """The first node at which a density that falls linearly (or touches zero) is impossible."""
    with pytest.raises(co.SolveError) as caught:
        co.solve(moving(measurement, process), intervals=20, progress=False)
    assert [word for word in words if word not in str(caught.value)] == []
    assert not caught.value.solution.converged


@pytest.mark.parametrize("phased", [False, True], ids=["alone", "phases"])
def test_density_that_no_noise_has_is_named_where_a_run_fails(phased):
    """It falls with the state, from 0.5 to -0.5: Riccati equations with it lead nowhere."""
    ocp = co.Problem(3.0, "falling")
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=0.04), ocp.control("u")
    ocp.dynamics(x, u, noise=0.05)
    ocp.measurement("sight", x, noise=0.5 - x)
    ocp.minimize_expected(running=0.1 * u**2, terminal_weight={x: 1.0})
    after = co.Problem(1.0, "after")
    y, w = after.state("x", initial=None, final=1.0), after.control("u")
    after.dynamics(y, w, noise=0.05)
    after.measurement("other", y, noise=0.1)
    after.minimize_expected(running=0.1 * w**2, terminal_weight={y: 1.0})
    with pytest.raises(co.SolveError, match="measurement noise density of sight is not positive at t = "):
        co.solve(co.Phases([ocp, after]) if phased else ocp, intervals=8, progress=False)


FALLING = [
    ({"measurement": lambda ocp: 1 - 0.41 * ocp.time}, "measurement noise density of m is not positive at t = 2.44 s"),
    (
        {"measurement": lambda ocp: 1.0, "process": lambda ocp: 0.3 - 0.12 * ocp.time},
        "process noise density of x is negative at t = 2.52",
    ),
    (
        {"measurement": lambda ocp: 1 - 0.41 * ocp.time, "at": [0.0, 1.0, 3.0, 4.0]},
        "measurement noise variance of m is not positive at t = 3 s",
    ),
]


@pytest.mark.parametrize(("stated", "words"), FALLING)
def test_noise_that_none_can_be_is_evaluated_nowhere(stated, words):
    with pytest.raises(co.ProblemError, match=words):
        co.evaluate(moving(**stated), nominal={"u": 1.0})


@pytest.mark.parametrize("options", [{}, {"method": "gradient"}, {"covariances": "states"}])
def test_variance_of_a_reading_counts_where_it_is_read(options):
    """(t - 1)(t - 3) is 1.25 at 0.5 and 3.5 s, and -1 at 2 s."""
    falling, plain = (lambda ocp: (ocp.time - 1) * (ocp.time - 3)), (lambda ocp: 1.25)
    own = {"intervals": 20, "progress": False, **options}
    costs = [co.solve(moving(noise, at=[0.5, 3.5]), **own).cost for noise in (falling, plain)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)
    with pytest.raises(co.SolveError, match="measurement noise variance of m is not positive at t = 2 s"):
        co.solve(moving(falling, at=[0.5, 2.0]), **own)


@pytest.mark.parametrize("at", [{}, {"at": [1.0, 3.0]}])
@pytest.mark.parametrize(("value", "word"), [(-0.5, "negative"), (0.0, "zero")])
def test_noise_that_parameters_make_none_is_refused_before_a_solver_starts(at, value, word):
    ocp = moving(lambda ocp: ocp.parameter("R", 0.5), **at)
    for call in (co.solve, co.evaluate):
        with pytest.raises(co.ProblemError, match=f"noise .* of 'm' is {word}"):
            call(ocp, parameters={"R": value}, **({"progress": False} if call is co.solve else {}))


@pytest.mark.parametrize("at", [{}, {"at": [1.0, 3.0]}])
def test_noise_that_parameters_make_none_is_refused_from_a_warm_start(at):
    ocp = moving(lambda ocp: ocp.parameter("R", 0.5), **at)
    solution = co.solve(ocp, intervals=10, progress=False)
    with pytest.raises(co.ProblemError, match=r"measurement noise .* of 'm' is negative"):
        co.solve(ocp, intervals=10, progress=False, parameters={"R": -0.5}, guess=solution)


def test_noise_is_judged_in_units_of_its_own():
    """-1e-9 rad^2/s beside 1e6 m^2/s is no rounding."""
    ocp = co.Problem(2.0)
    r = ocp.state("r", initial=0.0, variance=1e6)
    angle = ocp.state("angle", initial=0.0, variance=1e-8)
    u = ocp.control("u")
    ocp.dynamics(r, u, noise=1e6)
    ocp.dynamics(angle, u, noise=1e-9 * (1.5 - ocp.time))
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=1e8 * E[angle, angle])
    with pytest.raises(co.ProblemError, match=r"process noise density of angle is negative at t = 1\.52 s"):
        co.evaluate(ocp, nominal={"u": 1.0})


def jumping(noise, end):
    first = co.Problem(1.0, name="A")
    x = first.state("x", initial=0.0, final=end, variance=0.2)
    u = first.control("u", lower=0, upper=3)
    first.dynamics(x, u, noise=0.05)
    first.estimation_covariance()
    first.minimize(running=u**2)
    second = co.Problem(1.0, name="B")
    y = second.state("x", initial=None)
    w = second.control("w")
    second.dynamics(y, w, noise=0.05)
    second.measurement("q", y, noise=0.1)
    E = second.estimation_covariance()
    second.minimize(running=w**2, terminal=E[y, y])
    phases = co.Phases([first, second])
    phases.jump(y, x, noise=noise(x))
    return phases


def test_noise_of_a_jump_that_none_can_be():
    """E is 0.25 before the jump, x is 1: noise of -0.01 leaves a covariance, but is none."""
    noise = "noise variance of the jump from 'A' to 'B' of x is negative at t = 1 s"
    phases = jumping(lambda x: 0.19 - 0.2 * x, 1.0)
    with pytest.raises(co.SolveError, match=noise) as caught:
        co.solve(phases, intervals=10, progress=False)
    assert caught.value.solution["B"]["E"][0, 0, 0] == pytest.approx(0.24, abs=1e-6)
    with pytest.raises(co.ProblemError, match=noise):
        co.evaluate(phases, nominal=[{"u": 1.0}, {"w": 0.0}], intervals=10)
    with pytest.raises(co.ProblemError, match=noise):  # -0.41: what no phase can start with
        co.solve(jumping(lambda x: 0.19 - 0.2 * x, 3.0), intervals=10, progress=False)
    allowed = co.evaluate(jumping(lambda x: 0.1 - 0.2 * x, 0.25), nominal=[{"u": 0.25}, {"w": 0.0}], intervals=10)
    assert allowed["B"]["E"][0, 0, 0] == pytest.approx(0.25 + 0.05, rel=1e-9)


def test_noise_of_a_phase_that_none_can_be():
    phases = jumping(lambda x: 0.0 * x, 1.0)
    second = phases.problems[1]
    y = second.states[0].symbol
    second.measurement("late", y, noise=1.5 - y, at=[0.25, 0.75])
    where = "measurement noise variance of late is not positive at t = 0.25 s"
    with pytest.raises(co.ProblemError, match=f"phase 'B': .*{where}"):
        co.evaluate(phases, nominal=[{"u": 1.0}, {"w": 3.0}], intervals=10)
    second.subject_to(y, lower=4.0, upper=4.0, at="final")
    with pytest.raises(co.SolveError, match=f"phase 'B' .*{where}"):
        co.solve(phases, intervals=10, progress=False)


def test_density_that_varies_is_allowed():
    assert co.solve(moving(lambda ocp: 1 + ocp.time), progress=False).converged


@pytest.mark.parametrize("options", [{}, {"covariances": "states"}, {"method": "gradient"}])
def test_lower_bound_of_a_matrix_is_kept(options):
    """Without the bound u = 0 is optimal, and the entry falls to 0.24."""
    ocp = co.Problem(3.0)
    x = ocp.state("x", initial=0, final=0)
    P = ocp.symmetric("P", 1, initial=1.0, lower=0.5)
    u = ocp.control("u", lower=-2, upper=2)
    ocp.dynamics(x, u)
    ocp.dynamics(P, -P + 0.2 * (x + 1) ** 2)
    ocp.minimize(running=u**2)
    solution = co.solve(ocp, intervals=40, progress=False, **options)
    assert solution["P"].min() == pytest.approx(0.5, abs=1e-5)
    assert solution.cost > 1.0


def test_lower_bound_of_a_matrix_cannot_be_eliminated():
    ocp = co.Problem(1.0)
    P = ocp.symmetric("P", 1, initial=1.0, lower=0.5)
    x = ocp.state("x", initial=1)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.dynamics(P, -P)
    ocp.minimize(running=u**2)
    with pytest.raises(co.ProblemError, match="lower bound"):
        co.solve(ocp, covariances="eliminated", progress=False)


def test_mesh_error_of_both_methods_agrees():
    """A coupled problem and a free initial matrix: where the gradient method has no segments of its own."""
    ocp = co.Problem(3.0)
    x = ocp.state("x", 2, initial=[1, 0], final=0.0)
    P = ocp.symmetric("P", 2, initial=np.eye(2))
    u = ocp.control("u", 2)
    ocp.dynamics(x, -P @ x + u)
    ocp.dynamics(P, -P @ P + ca.diag(u * u) * 0.1)
    ocp.minimize(running=ca.dot(u, u) + ca.trace(P))
    errors = [
        co.solve(ocp, method, intervals=40, substeps=1, progress=False).mesh_error for method in ("ipopt", "gradient")
    ]
    assert errors[0] == pytest.approx(errors[1], rel=0.1)
    assert errors[0] < 1e-5


def test_duration_at_its_bound_is_transversal():
    """The integral of u^2 plus T is least at T = 1, outside the bounds: T = 1.5 is optimal."""
    ocp = co.Problem(co.Free(2, 1.5, 5))
    x = ocp.state("x", initial=0, final=1)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=ocp.duration)
    solution = co.solve(ocp, intervals=40, progress=False)
    assert solution.duration == pytest.approx(1.5, abs=1e-6)
    assert solution.optimality.transversality == 0.0


def test_comparison_at_other_parameters():
    ocp = co.Problem(1.0)
    weight = ocp.parameter("weight", 1.0)
    x = ocp.state("x", initial=0, final=1)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=weight * u**2)
    rows = co.compare(ocp, intervals=20, parameters={"weight": 3.0}, progress=False).solutions
    assert [solution.cost for solution in rows.values()] == pytest.approx([3.0, 3.0], rel=1e-6)


@pytest.mark.parametrize("factor", [0.0, 0.9])
def test_correlated_noise_of_a_sensor_that_fades_is_a_noise(factor):
    """[[a e^(8t), c], [c, a]], |c| < a: definite at all times, and singular at the first ones beside the last ones."""
    ocp = co.Problem(5.0)
    x, u = ocp.state("x", 2, initial=0.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, -x + u, noise=0.1)
    beside = 0.1 * factor
    noise = ca.vertcat(ca.horzcat(0.1 * ca.exp(8.0 * ocp.time), beside), ca.horzcat(beside, 0.1))
    ocp.measurement("m", x, noise=noise)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x[0], x[0]])
    solution = co.solve(ocp, intervals=40, progress=False)
    assert solution.converged
    assert abs(solution.controls).max() < 1e-6
