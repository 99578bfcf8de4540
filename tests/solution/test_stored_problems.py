"""A solution from a file is attached to the problem that was solved and to no other; what differs is named."""

import math
import os
import subprocess
import sys
import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.models import mars_entry, unknown_lag
from covocp.solution.fingerprint import differences, fingerprint

INF = float("inf")


def lag(
    *,
    weight=10.0,
    energy=0.5,
    final=1.0,
    lower=-INF,
    variance=5.0,
    lid=None,
    duration=10.0,
    decay=1.0,
    noise=1.0,
    sensor=1.0,
    exponent=1,
    name="m",
):
    p = co.Problem(duration=duration, name="lag")
    x = p.state("x", initial=0.0, final=final, variance=1.0)
    b = p.unknown("b", decay, variance)
    u = p.control("u", lower=lower)
    p.dynamics(x, -b * x**exponent + u, noise=noise)
    p.measurement(name, x, noise=sensor)
    E = p.estimation_covariance()
    p.minimize(running=energy * u**2, terminal=weight * E[b, b])
    if lid is not None:
        p.subject_to(x, upper=lid, name="lid")
    return p


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return co.solve(lag(), intervals=50, progress=False).save(tmp_path_factory.mktemp("lag") / "lag.npz")


@pytest.mark.parametrize(
    ("change", "named", "stored", "given"),
    [
        ({"weight": 0.1}, "the terminal cost", "", ""),
        ({"energy": 5.0}, "the running cost", "", ""),
        ({"final": 2.0}, "the final value of 'x'", "1", "2"),
        ({"final": None}, "the final value of 'x'", "1", "free"),
        ({"lower": 0.0}, "the lower bound of 'u'", "-inf", "0"),
        ({"variance": 4.0}, "the initial value of 'E[b, b]'", "5", "4"),
        ({"lid": 0.5}, "the limits of 'lid'", "not there", "[-inf, 0.5]"),
        ({"duration": 9.0}, "the duration", "10", "9"),
        ({"duration": co.Free(10.0, 5.0, 20.0)}, "the bounds of the duration", "not there", "[5, 20]"),
        ({"decay": 1.1}, "the mean of 'b'", "1", "1.1"),
        ({"noise": 1.001}, "the process noise of 'x'", "1", "1.001"),
        ({"sensor": 0.999}, "the noise of the measurement 'm'", "1", "0.999"),
        ({"exponent": 2}, "the rate of 'x'", "", ""),
        ({"name": "other"}, "the symbols", "measurement m", "measurement other"),
    ],
)
def test_another_problem_is_refused_and_what_differs_is_named(path, change, named, stored, given):
    with pytest.raises(co.ProblemError) as error:
        co.load(path, lag(**change))
    first, expected, received, remedy = str(error.value).splitlines()
    assert first.startswith("The stored solution is of another problem: ")
    assert named in first
    assert named in expected
    assert stored in expected
    assert given in received
    assert "evaluate(problem, nominal=load(path))" in remedy
    assert co.load(path).statement is None  # without a problem it can be read


def test_what_a_file_says_of_its_problem_outlives_another_file(path, tmp_path):
    copy = co.load(path).save(tmp_path / "copy.json")
    assert co.load(copy, lag()).statement is not None
    with pytest.raises(co.ProblemError, match="the terminal cost differs"):
        co.load(copy, lag(weight=0.1))


def test_a_declared_value_may_be_the_one_that_was_solved_for(tmp_path):
    solution = co.solve(unknown_lag.problem(), intervals=20, progress=False, parameters={"weight": 1.0})
    file = solution.save(tmp_path / "solution.npz")
    for declared in (1.0, 10.0):  # the one solved for, and the one of the problem that was solved
        assert co.load(file, unknown_lag.problem(weight=declared))["weight"][0] == 1.0
    with pytest.raises(co.ProblemError, match="the value of 'weight' differs"):
        co.load(file, unknown_lag.problem(weight=5.0))


def test_guesses_and_scales_belong_to_no_problem(tmp_path):
    def problem(**options):
        p = co.Problem(duration=1.0)
        x = p.state("x", initial=0.0, final=1.0, **options)
        u = p.control("u", **options)
        p.dynamics(x, u)
        p.minimize(running=u**2)
        return p

    file = co.solve(problem(), intervals=5, progress=False).save(tmp_path / "solution.json")
    assert co.load(file, problem(guess=0.3, scale=2.0)).statement is not None


# --- expressions ------------------------------------------------------------------------------------------------------


def evaluated(problem, intervals):
    """Some trajectory of a problem; coarse meshes are fine here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        return co.evaluate(problem, intervals=intervals)


def scalar(rate, cost, **options):
    """x' = rate(x, u), running cost cost(x, u), from x = 1 in 1 s."""
    p = co.Problem(duration=1.0)
    x = p.state("x", initial=1.0, **options)
    u = p.control("u")
    p.dynamics(x, rate(x, u))
    p.minimize(running=cost(x, u))
    return p


def compared(one, two):
    """Names of what differs between two problems of the same symbols, along a trajectory of the first."""
    solution = evaluated(one, 50)
    kept = fingerprint(one.statement(), solution.trajectory, solution.parameters)
    return [entry.what for entry in differences(kept, two.statement(), solution.parameters)]


def energy(x, u):
    return u**2 + x**2


@pytest.mark.parametrize(
    ("one", "two"),
    [
        (lambda x, u: u * u + x * x, lambda x, u: x**2 + u**2),
        (lambda x, u: (u + x) ** 2, lambda x, u: u**2 + 2 * u * x + x**2),
        (lambda x, u: u**2 + ca.sin(2 * x), lambda x, u: u**2 + 2 * ca.sin(x) * ca.cos(x)),
        (lambda x, u: u**2 + ca.fmax(0, x - 5), lambda x, u: u**2 + ca.fmax(x - 5, 0)),
    ],
)
def test_the_same_function_may_be_written_otherwise(one, two):
    assert compared(scalar(lambda x, u: u - x, one), scalar(lambda x, u: -x + u, two)) == []


@pytest.mark.parametrize(
    ("one", "two"),
    [
        (lambda x, u: 0, lambda x, u: 1e-6 * x),
        (lambda x, u: 0, lambda x, u: 1e-3 * (x - 1) * u),  # nothing where the solution begins
        (lambda x, u: 0, lambda x, u: ca.fmax(0, x - 1e6)),  # nothing at any point
        (lambda x, u: ca.fmax(0, x - 1e6), lambda x, u: ca.fmax(0, x - 2e6)),
        (lambda x, u: ca.if_else(x > 1e6, x, 0), lambda x, u: ca.if_else(x > 1e6, x**2, 0)),
        (lambda x, u: ca.floor(x / 1e8), lambda x, u: ca.floor(x / 2e8)),
        (lambda x, u: ca.fabs(x + 1e9) - 1e9 - x, lambda x, u: 0 * x),
    ],
)
def test_other_functions_are_told_apart_even_where_nothing_of_them_shows(one, two):
    def rates(part):
        return scalar(lambda x, u: u + part(x, u), energy)

    def costs(part):
        return scalar(lambda x, u: u, lambda x, u: energy(x, u) + part(x, u))

    assert compared(rates(one), rates(two))
    assert compared(costs(one), costs(two))


def test_places_where_functions_switch_are_a_warning_only_where_another_casadi_wrote_the_file(tmp_path):
    def problem(place):
        return scalar(lambda x, u: u, lambda x, u: energy(x, u) + ca.fmax(0, x - place))

    solution = co.solve(problem(1e6), intervals=5, progress=False)
    with pytest.raises(co.ProblemError, match=r"the places where the equations switch .* differ"):
        co.load(solution.save(tmp_path / "here.npz"), problem(2e6))
    kept = fingerprint(solution.statement, solution.trajectory, solution.parameters)
    elsewhere = replace(co.load(tmp_path / "here.npz"), stored_problem=replace(kept, casadi="3.6.0"))
    file = elsewhere.save(tmp_path / "elsewhere.npz")
    with pytest.warns(co.CovocpWarning, match="pieces or tables in them are written otherwise"):
        assert co.load(file, problem(2e6)).statement is not None
    assert co.load(file, problem(1e6)).statement is not None


def test_tables_are_compared_at_the_points_and_by_their_text(tmp_path):
    def problem(values):
        table = ca.interpolant("table", "linear", [[0.0, 1.0, 2.0, 1e7]], values)
        return scalar(lambda x, u: u, lambda x, u: energy(x, u) + table(ca.fabs(x)))

    file = co.solve(problem([0.0, 1.0, 4.0, 9.0]), intervals=5, progress=False).save(tmp_path / "table.npz")
    assert co.load(file, problem([0.0, 1.0, 4.0, 9.0])).statement is not None
    with pytest.raises(co.ProblemError, match="the running cost differs"):
        co.load(file, problem([0.0, 1.01, 4.0, 9.0]))
    with pytest.warns(co.CovocpWarning, match="pieces or tables in them are written otherwise"):
        co.load(file, problem([0.0, 1.0, 4.0, 9.0 + 1e-6]))


def test_the_fingerprint_is_the_same_in_another_process_and_after_other_symbols(path, tmp_path):
    script = tmp_path / "again.py"
    script.write_text(
        "import sys\nimport casadi as ca\nimport covocp as co\n"
        f"sys.path.insert(0, {os.path.dirname(__file__)!r})\n"
        "from test_stored_problems import lag\n"
        "others = [ca.MX.sym(f'u{i}') for i in range(100)]\n"
        "lag(weight=3.0).statement()\n"
        f"co.load({str(path)!r}, lag()).save({str(tmp_path / 'again.npz')!r})\n"
    )
    subprocess.run([sys.executable, "-W", "error", str(script)], check=True, timeout=300)
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    "make", [mars_entry.problem, lambda: lag(lid=3.0), lambda: lag(duration=co.Free(10.0, 5.0, 20.0))]
)
def test_a_problem_equals_itself(make):
    solution = evaluated(make(), 20)
    kept = fingerprint(make().statement(), solution.trajectory, solution.parameters)
    assert differences(kept, make().statement(), solution.parameters) == []


def test_expected_costs_differ_by_their_own_names(tmp_path):
    def problem(q=1.0, r=0.5, s=2.0):
        p = co.Problem(duration=1.0)
        x = p.state("x", initial=1.0, variance=0.1)
        u = p.control("u")
        p.dynamics(x, u - x, noise=0.1)
        p.measurement("m", x, noise=0.1)
        p.minimize_expected(running=q * x**2 + r * u**2, terminal_weight={x: s})
        return p

    solution = evaluated(problem(), 20)
    file = solution.save(tmp_path / "expected.npz")
    assert co.load(file, problem()).statement is not None
    for change, named in (({"q": 2.0}, "the running cost"), ({"s": 3.0}, "the weight of the deviations at the end")):
        with pytest.raises(co.ProblemError, match=named):
            co.load(file, problem(**change))


# --- what a solution violates -----------------------------------------------------------------------------------------


def test_what_a_stored_solution_violates_is_among_its_violations(path, tmp_path):
    unknown = replace(co.load(path), stored_problem=None)  # made by hand: nothing tells what its problem was
    least = float(unknown["u"].min())
    assert 0.1 < least < 0.5
    file = unknown.save(tmp_path / "solution.npz")
    assert co.load(file, lag()).violations == {}
    with pytest.warns(co.CovocpWarning, match=r"violates bounds of u by .* says nothing"):
        loaded = co.load(file, lag(lower=0.5))
    assert loaded.violations["bounds of u"] == pytest.approx(0.5 - least, rel=1e-12)
    for change, named in (
        ({"final": 2.0}, "the final value of 'x'"),
        ({"lid": 0.5}, "the constraints"),
        ({"exponent": 2}, r"the rate of 'E\[x, x\]' at t = 0 s"),
        ({"duration": 9.0}, "the duration"),
    ):
        with pytest.raises(co.ProblemError, match=named):
            co.load(file, lag(**change))


def test_changed_values_of_a_known_problem_are_compared_with_its_limits(tmp_path):
    solution = co.solve(lag(lid=1.5), intervals=50, progress=False)
    assert co.load(solution.save(tmp_path / "right.npz"), lag(lid=1.5)).violations == {}
    loaded = co.load(tmp_path / "right.npz")
    nominal = loaded.trajectory.x.copy()
    nominal[25] = 2.0
    extremal = replace(loaded.extremal, trajectory=replace(loaded.trajectory, x=nominal))
    wrong = replace(loaded, extremal=extremal, rates=loaded.rates * math.nan)
    file = wrong.save(tmp_path / "wrong.npz")
    with pytest.warns(co.CovocpWarning, match="violates lid by 0.5"):
        assert co.load(file, lag(lid=1.5)).violations == pytest.approx({"lid": 0.5})


def test_values_that_are_no_numbers_have_a_fingerprint_too():
    solution = evaluated(lag(), 20)
    nominal = np.full_like(solution.trajectory.x, np.nan)
    broken = replace(solution.trajectory, x=nominal, duration=INF)
    kept = fingerprint(solution.statement, broken, solution.parameters)
    assert np.isfinite(kept.points).all()
    assert differences(kept, lag().statement(), solution.parameters) == []
