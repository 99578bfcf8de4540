"""Names that are not known: the answer suggests the one that was meant, and says what can be given."""

import casadi as ca
import pytest
from refusals import lag, refused, simple

import covocp as co
from covocp.base.errors import kind_and_name, spelling


def damped():
    """An integrator with a known friction and a cost of what its feedback does."""
    ocp = co.Problem(duration=1.0, name="damped")
    friction = ocp.parameter("friction", 0.5)
    x, u = ocp.state("position", initial=0.0, final=1.0, variance=0.01), ocp.control("u")
    ocp.dynamics(x, u - friction * x, noise=0.01)
    ocp.measurement("range", x, noise=0.1)
    return ocp, x, u


@pytest.fixture(scope="module")
def solved():
    ocp, x, u = damped()
    ocp.minimize_expected(running=u**2, terminal_weight={x: 1.0})
    return ocp, co.solve(ocp, intervals=20, progress=False)


def test_a_name_is_near_another_where_few_letters_differ():
    known = ("friction", "Mass", "position")
    for slip, meant in (("fricton", "friction"), ("MASS", "Mass"), ("postion", "position"), ("Friction", "friction")):
        assert f"'{meant}'" in spelling(slip, known, "no")
    for other in ("portion of it", "b", "", "action"):
        assert spelling(other, known, "no") == "no"


def test_parameters(solved):
    ocp, solution = solved
    meant = "perhaps 'friction' is meant"
    refused(lambda: co.solve(ocp, parameters={"fricton": 0.7}), "no parameter 'fricton'", meant)
    refused(lambda: co.simulate(solution, 50, seed=1, truth={"fricton": 0.7}), "fricton", meant)
    refused(lambda: co.solve(ocp, parameters={"position": 0.2}), "'position' is a state", "Problem.parameter")
    refused(lambda: co.solve(ocp, parameters={"viscosity": 0.2}), "one of friction", "give one of these")
    refused(lambda: co.solve(simple()[0], parameters={"a": 0.2}), "declared by Problem.parameter")


def test_a_solution_in_place_of_a_problem_is_named_on_one_line(solved):
    message = refused(lambda: co.solve(solved[1]), "received: Solution: 'damped'\n")
    assert len(message.splitlines()) == 4
    assert kind_and_name([1, "a\nb"]) == "list: [1, 'a\\nb']"
    assert kind_and_name(co.Problem(1.0)) == "Problem: Problem('')"


def test_options(solved):
    ocp, solution = solved
    refused(lambda: solution.plot(gain=True), "plot() has no option 'gain'", "perhaps 'gains' is meant")
    refused(lambda: solution.plot(colour="red"), "received: colour='red'", "correct or remove it")
    refused(lambda: co.solve(ocp, interval=5), "perhaps 'intervals' is meant")
    refused(lambda: co.solve(ocp, metod="ipopt"), "perhaps 'method' is meant")
    refused(lambda: co.solve(ocp, "Ipopt"), "perhaps 'ipopt' is meant")
    refused(lambda: co.evaluate(ocp, substep=2), "perhaps 'substeps' is meant")
    comparison = co.compare(simple()[0], ["ipopt"], intervals=5, progress=False)
    refused(lambda: comparison.plot(gain=True), "perhaps 'gains' is meant")
    refused(lambda: co.compare(ocp, ["ipopt"], substep=2), "perhaps 'substeps' is meant")


def test_symbols(solved):
    refused(lambda: solved[1]["postion"], "perhaps 'position' is meant")
    ocp, x, u = damped()
    refused(lambda: ocp.minimize_expected(u**2, terminal_weight={"postion": 1}), "perhaps 'position' is meant")
    refused(lambda: ocp.minimize_expected(u**2, terminal_weight={"speed": 1}), "check the spelling")
    refused(lambda: co.solve(lag()[0], guess={"U": 1.0}), "perhaps 'u' is meant")
    refused(lambda: co.solve(lag()[0], substeps="ato"), "'auto' or 1, 2, 3, ...")
    refused(lambda: co.solve(lag()[0], segments=0), "'auto' or 1, 2, 3, ...")


def test_limits_that_vary():
    """In subject_to() and chance() the remedy is another expression; bounds of a state are said to be a condition."""
    ocp = co.Problem(1.0)
    x, limit = ocp.state("x", 2, initial=0.0), ocp.parameter("limit", 1.0)
    refused(lambda: ocp.subject_to(x[0], upper=limit), "limit upper=", "subject_to(x[0] - limit, upper=0)")
    refused(lambda: ocp.subject_to(x[0], lower=-limit), "subject_to(x[0] - (-limit), lower=0)")
    refused(lambda: ocp.subject_to(x, upper=[limit, 2.0]), "subject_to(x - limit, upper=0)")
    refused(lambda: ocp.subject_to(x[0], equals=limit), "subject_to(x[0] - limit, equals=0)")
    refused(lambda: ocp.chance(x[1], upper=limit, probability=0.9), "chance(x[1] - limit, upper=0)")
    refused(
        lambda: ocp.subject_to(ca.sin(x[0]) ** 2 + ca.exp(x[0]) * ca.cos(x[1]) ** 4, upper=limit),
        "(expression - limit, upper=0)",
    )
    refused(lambda: ocp.control("u", upper=limit), "a bound that varies is a subject_to()")
    ocp.subject_to(x[0] - limit, upper=0)


def test_a_symbol_of_another_problem(solved, tmp_path):
    """It has a name that is known, and is told apart from a name that is not."""
    ocp, solution = solved
    other, x, u = damped()
    other.minimize(running=u**2)
    of_another = "'position' is not in this solution: it is a symbol of another problem"
    as_word = "as a string: 'position'"
    loaded = co.load(solution.save(tmp_path / "solved.npz"))
    refused(lambda: loaded.multiplier(ocp.statement().symbols["position"]), "only names are known here", as_word)
    refused(lambda: solution[x], of_another, as_word, "received: position\n")
    refused(lambda: solution[2 * x + ocp.statement().symbols["u"]], of_another, as_word)
    refused(lambda: solution.multiplier(x), of_another, as_word)
    refused(lambda: solution.deviation(x), of_another, as_word)
    refused(lambda: solution.deviation(u), "'u' is not in this solution", "a symbol or name of position\n")
    friction = other.statement().symbols["friction"]
    refused(lambda: co.solve(ocp, parameters={friction: 0.7}), "it is a symbol of another problem", "'friction'")
    third, _, force = damped()
    refused(lambda: third.minimize_expected(force**2, terminal_weight={x: 1.0}), "it is a symbol of another problem")


def test_constraints_are_among_what_has_a_multiplier():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", 2, initial=0.0), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(u, x[0]))
    ocp.subject_to(u, upper=3.0, name="thrust")
    ocp.subject_to(x, upper=9.0, at="final", name="end")
    ocp.minimize(running=(u - 1) ** 2)
    solution = co.solve(ocp, intervals=5, progress=False)
    refused(lambda: solution.multiplier("thrst"), "or a constraint by its name: thrust, end", "'thrust' is meant")
    refused(lambda: solution.multiplier("x[2]"), "'x' has no entry 2")
    refused(lambda: solution.multiplier(u), "a symbol or name of x, or a constraint by its name: thrust, end")
    assert solution.multiplier("thrust").shape == (6,)


def test_instants_that_are_given_twice():
    ocp = co.Problem(4.0)
    x = ocp.state("x", initial=0.0)
    refused(lambda: ocp.measurement("m", x, noise=1.0, at=[0.5, 1.0, 1.0]), "each once", "received: 1 twice")
    refused(lambda: ocp.measurement("m", x, noise=1.0, at=[2.0, 1.5]), "received: 1.5 after 2\n")


def test_a_sample_shows_its_values(solved):
    solution = solved[1]
    text = repr(solution.at(0.5))
    assert text.startswith("Sample(t = 0.5, position = ")
    assert f"u = {float(solution.at(0.5)['u']):.6g}, " in text
    assert "E = [[" in text
    assert "friction = 0.5" in text
    assert "\n" not in repr(solution.at([0.0, 0.5, 1.0]))
