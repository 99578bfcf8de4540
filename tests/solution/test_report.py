"""print(solution): what happened comes first, and every number is the solution's."""

from dataclasses import fields, replace

import numpy as np
import pytest
from problems import constrained_gain, solve
from read_again import printed

import covocp as co
from covocp.base.pages import Table
from covocp.extremal.optimality import Optimality
from covocp.models import free_time_integrator, mars_entry, mass_chain, unknown_lag
from covocp.solution.report import summary
from covocp.solution.residual_section import RESIDUALS


@pytest.fixture(scope="module")
def lag():
    return co.solve(unknown_lag.problem(final=1.0), intervals=60, progress=False)


def numbers_after(text, beginning):
    """Numbers on the line that begins so."""
    line = next(line for line in text.splitlines() if line.startswith(beginning))
    return [float(word) for word in line[len(beginning) :].split() if word not in ("-", "semidefinite", "minimum")]


def test_first_line_says_what_happened(lag):
    first = str(lag).splitlines()[0]
    assert first == "first-order lag, unknown time constant: solved (ipopt)"


def test_terms_of_the_cost_and_their_sum(lag):
    text = str(lag)
    for name, value in {**lag.cost_terms, "total": lag.cost}.items():
        assert numbers_after(text, name) == [pytest.approx(value, rel=1e-7)]


def test_terminal_values_of_states_and_unknowns(lag):
    text = str(lag)
    expected = [lag["x"][-1], 1.0, lag.multipliers.final[0], lag.deviation("x")[-1]]
    assert numbers_after(text, "x  ") == pytest.approx(expected, rel=1e-7)
    b = lag.deviation("b")
    assert numbers_after(text, "b  ") == pytest.approx([1.0, b[0], b[-1]], rel=1e-7)


def test_terminal_covariance_is_its_lower_triangle(lag):
    text = str(lag)
    block = text[text.index("covariance E at T") :].split("\n\n")[0]
    E = lag["E"][-1]
    assert numbers_after(block, "x") == pytest.approx([E[0, 0]], rel=1e-5)
    assert numbers_after(block, "b") == pytest.approx([E[1, 0], E[1, 1]], rel=1e-5)


def test_every_residual_has_words_and_its_value(lag):
    assert {f.name for f in fields(Optimality)} == set(RESIDUALS)
    text = str(lag)
    for name, value in lag.optimality.as_dict().items():
        if value is None:
            assert RESIDUALS[name] not in text
        else:
            assert numbers_after(text, RESIDUALS[name]) == [pytest.approx(value, rel=1e-2)]


def test_large_residuals_say_what_they_mean(lag):
    assert "worry" not in str(lag)
    for name, value, words in (
        ("costate_difference", 0.5, "worry if the mesh error is large"),
        ("cross_covariance", 0.026, "worry if the expected costs differ"),
        ("stationarity", 1e-2, "not yet stationary"),
        ("curvature", 0.0, "flat: sign or gain below the error"),
    ):
        text = str(replace(lag, stored_optimality=replace(lag.optimality, **{name: value})))
        assert words in " ".join(text.split())
        assert max(len(line) for line in text.splitlines()) <= 100


def test_a_saddle_and_an_indefinite_covariance_are_called_so(lag):
    saddle = replace(lag, stored_optimality=replace(lag.optimality, curvature=-1.0))
    assert "NOT A MINIMUM" in summary(saddle)
    assert "NOT A MINIMUM" not in summary(lag)
    e = lag.trajectory.e.copy()
    e[5] = [1.0, 2.0, 1.0]
    extremal = replace(lag.extremal, trajectory=replace(lag.trajectory, e=e))
    indefinite = replace(lag, extremal=extremal, stored_optimality=lag.optimality)
    assert "INDEFINITE" in summary(indefinite)
    assert "INDEFINITE" not in summary(lag)


def test_free_duration_has_its_condition_and_value():
    solution = co.solve(free_time_integrator.problem(), intervals=30, progress=False)
    text = str(solution)
    assert RESIDUALS["transversality"] in text
    assert f"state at T = {solution.duration:.8g} s" in text


def test_what_did_not_converge_says_so_first(lag):
    failed = replace(lag, converged=False, message="stopped early", violations={"limit": 0.125, "other": 2.0})
    lines = summary(failed).splitlines()
    assert lines[0] == "NOT CONVERGED: first-order lag, unknown time constant: stopped early (ipopt)"
    assert [line.split() for line in lines[2:5]] == [
        ["violated", "constraint", "by"],
        ["other", "2"],
        ["limit", "0.125"],
    ]


def test_a_loaded_solution_prints_what_it_knows(lag, tmp_path):
    path = lag.save(tmp_path / "solution.npz")
    assert str(co.load(path, unknown_lag.problem(final=1.0))) == str(lag)
    known = printed(co.load(path), alone=True)
    assert numbers_after(known, "total") == numbers_after(str(lag), "total")
    assert known == str(lag)
    x = numbers_after(known, "x  ")
    assert x == pytest.approx([lag["x"][-1], 1.0, lag.multipliers.final[0], lag.deviation("x")[-1]], rel=1e-7)
    without = replace(co.load(path), stored_optimality=None)
    assert "necessary conditions: not evaluated" in str(without)


def test_nothing_is_wider_than_a_hundred_columns(lag):
    solution = co.solve(mass_chain.problem(3), intervals=30, substeps=4, progress=False)
    long = replace(solution, name="a name " * 30, message="a message " * 30, violations={"v" * 150: 1.0})
    long = replace(long, stored_optimality=lag.optimality)
    text = summary(long)
    assert max(len(line) for line in text.splitlines()) <= 100
    assert numbers_after(text, "y[2]") == pytest.approx(
        [solution["y"][-1, 2], 1.0, solution.multipliers.final[2], solution.deviation("y")[-1, 2]], rel=1e-7
    )
    assert "diagonal" in text


def test_mesh_and_effort(lag):
    text = str(lag)
    assert "60 intervals, controls piecewise linear" in text
    assert f"{lag.stats['iterations']} iterations" in text
    seconds = sum(lag.stats[f"{name}_seconds"] for name in ("build", "solve", "other"))
    assert f"{seconds:.3g} s" in text
    constant = co.solve(unknown_lag.problem(), intervals=30, control="constant", progress=False)
    assert "controls piecewise constant" in str(replace(constant, stored_optimality=lag.optimality))


def test_tables_keep_words_that_look_like_markup():
    table = Table(columns=["[bold]a", "b"], rows=[["x[0]", "1"], ["[red]", "2"]])
    assert table.text().splitlines() == [
        "[bold]a  b",
        "x[0]     1",
        "[red]    2",
    ]


def test_values_that_are_not_numbers_are_dashes(lag):
    text = summary(replace(lag, stored_optimality=replace(lag.optimality, control_error=np.nan)))
    line = next(line for line in text.splitlines() if line.startswith(RESIDUALS["control_error"]))
    assert line.split()[-1] == "-"


# --- closed loops -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def steered():
    return co.solve(unknown_lag.steering(), intervals=60, progress=False)


def block_of(text, beginning):
    """The table that begins so."""
    return text[text.index(beginning) :].split("\n\n")[0]


def words_after(text, beginning):
    line = next(line for line in text.splitlines() if line.startswith(beginning))
    return line[len(beginning) :].split()


def test_a_closed_loop_in_root_mean_squares(steered):
    text, loop = str(steered), steered.loop
    row = words_after(block_of(text, "closed loop, root mean squares"), "x ")
    X, E = loop.X[-1, 0, 0], loop.E[-1, 0, 0]
    assert [float(word) for word in row[:-1]] == pytest.approx([1.0, X**0.5, E**0.5, 100 * E / X], rel=5e-3)
    assert [float(word) for word in row[1:3]] == pytest.approx([X**0.5, E**0.5], rel=1e-7)
    assert numbers_after(text, "b  ") == pytest.approx([1.0, 5**0.5, loop.E[-1, 1, 1] ** 0.5], rel=1e-7)
    assert "standard deviation" not in text
    assert "covariance E at T" not in text
    assert "matrix S" not in text


def test_the_feedback_and_its_gain(steered):
    text, loop = str(steered), steered.loop
    spread = np.sqrt(np.einsum("ki,kij,kj->k", loop.gain[:, 0], loop.Xhat, loop.gain[:, 0]))
    k = spread.argmax()
    expected = [spread[k], steered.t[k], spread[-1]]
    assert numbers_after(block_of(text, "feedback, root mean squares"), "u ") == pytest.approx(expected, rel=1e-5)
    gain = loop.gain[:, 0, 1]
    k = np.abs(gain).argmax()
    expected = [gain[0], gain[30], gain[-1], gain[k], steered.t[k]]
    assert numbers_after(block_of(text, "gain C"), "u, b") == pytest.approx(expected, rel=1e-3)


def test_the_deviations_are_split_and_the_classical_design_is_beside_them(steered):
    steered = replace(steered, stats={**steered.stats, "classical_cost": 2.5})
    text, cost = str(steered), steered.loop.cost
    words = words_after(text, "deviations: ")
    expected = [cost["deviations at the end"], cost["deviations on the way"]]
    assert [float(words[0]), float(words[4])] == pytest.approx(expected, rel=1e-5)
    words = words_after(text, "classical design: ")
    assert words[0] == "2.5,"
    assert float(words[3]) == pytest.approx(100 * (1 - steered.cost / 2.5), rel=1e-2)


def test_what_was_not_optimised_has_no_multipliers_and_no_gain_over_the_classical_design(steered):
    steered = replace(steered, stats={**steered.stats, "classical_cost": 2.5})
    true = co.evaluate(steered, truth=unknown_lag.steering(process_noise=2.0, measurement_noise=0.5))
    for solution in (true, co.solve(unknown_lag.steering(), nominal="deterministic", progress=False)):
        text = str(solution)
        assert "classical design:" not in text
        assert words_after(block_of(text, "state at T"), "x ")[-1] == "-"
    row = words_after(block_of(str(true), "closed loop, root"), "x ")
    assert row[1] == f"{true.loop.X[-1, 0, 0] ** 0.5:.8g}"


def test_a_gain_below_the_error_of_the_mesh_says_so(steered):
    for share, hint in ((0.5e-3, True), (2e-3, False), (1e-9, False)):
        classical = steered.cost / (1 - share)
        text = str(replace(steered, stats={**steered.stats, "classical_cost": classical}, mesh_error=1.2e-3))
        assert f"of which {100 * share:.3g} % are gained" in text
        assert ("less than the error of the mesh, 0.12 %" in text) is hint
        assert max(len(line) for line in text.splitlines()) <= 100


def test_the_room_to_the_bounds_is_counted_in_root_mean_squares():
    flight = co.evaluate(mars_entry.problem(upper=0.6), nominal=mars_entry.reference(), intervals=60)
    text, loop = str(flight), flight.loop
    spread = np.sqrt(np.einsum("ki,kij,kj->k", loop.gain[:, 0], loop.Xhat, loop.gain[:, 0]))
    row = numbers_after(block_of(text, "feedback, root mean squares"), "lift_to_drag")
    assert row[-1] == pytest.approx(0.1 / spread.max(), rel=1e-2)
    assert max(len(line) for line in text.splitlines()) <= 100


def test_a_constant_gain_is_one_number():
    solution = solve(constrained_gain(True), intervals=20)
    text = str(solution)
    assert numbers_after(block_of(text, "gain C, constant"), "u, x") == pytest.approx(
        [solution.gains["C"][0, 0, 0]], rel=1e-4
    )
    assert len(block_of(text, "state at T").splitlines()) == 2


def test_a_loaded_closed_loop_prints_what_it_knows(steered, tmp_path):
    path = steered.save(tmp_path / "solution.npz")
    assert printed(co.load(path), alone=True) == str(steered)
    assert str(co.load(path, unknown_lag.steering())) == str(steered)


def test_what_path_constraints_do_between_the_nodes():
    """A straight line from (0, 0) to (1, 1) passes the obstacle in its middle between two nodes."""
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", 2, initial=0, final=1), ocp.control("u", 2)
    ocp.dynamics(x, u)
    ocp.minimize(running=u.T @ u)
    middle = x - 0.5
    ocp.subject_to(0.01 - middle.T @ middle, name="obstacle")
    with pytest.warns(co.CovocpWarning, match="the limit of 'obstacle' is passed by 0.01"):
        solution = co.solve(ocp, intervals=5, progress=False)
    assert "between them that of 'obstacle' is passed by up to 0.01" in " ".join(str(solution).split())
    assert "between them" not in str(co.solve(unknown_lag.problem(), intervals=50, progress=False))


def gyroscope(**prescribed):
    """An attitude and a bias that are known to micro-radians: multipliers of the positive bounds of their variances."""
    ocp = co.Problem(10.0, name="gyroscope")
    angle, bias = (ocp.state(name, initial=0.0, variance=1e-8) for name in ("angle", "bias"))
    u = ocp.control("u")
    ocp.dynamics(angle, u + bias, noise=1e-12)
    ocp.dynamics(bias, -bias / 100, noise=1e-14)
    ocp.measurement("star", angle, noise=1e-10 * (1 + 1e3 * u**2), every=1.0)
    E = ocp.estimation_covariance()
    P, w = ocp.symmetric("P", 1, initial=1.0, **prescribed), ocp.control("w")
    ocp.dynamics(P, w)
    ocp.subject_to(E[angle, angle] / 1e-8, upper=2.0, name="limit")
    ocp.subject_to(angle, lower=0.1, upper=0.1, at="final")
    ocp.minimize(running=u**2 + w**2 + 1e6 * E[angle, angle])
    return co.solve(ocp, intervals=10, covariances="states", progress=False)


@pytest.mark.filterwarnings("ignore::covocp.CovocpWarning")
def test_only_what_was_fixed_is_called_fixed():
    """Of the integral of w^2 over 10 s from 1 to 2 the multiplier is -0.2."""
    free = gyroscope()
    assert np.abs(free.multiplier("E")).max() > 1e-6 * free.cost
    assert "fixed at T" not in str(free)
    fixed = str(gyroscope(final=2.0)).split("fixed at T")[1].split("necessary")[0]
    assert fixed.split() == ["multiplier", "P[0,", "0]", "-0.2"]
