"""Names that a function does not know, and those that it needs, are told in the four parts of every error."""

import subprocess
import sys

import pytest
from refusals import refused, simple

import covocp as co
from covocp.base.arguments import checked, truth
from covocp.base.threads import one_at_a_time


@pytest.fixture(scope="module")
def solved():
    ocp = simple(final=1.0)[0]
    solver = co.Solver(ocp, intervals=2, substeps=2)
    return ocp, solver, solver.solve(progress=False)


# The call on (problem, solver, solution), the name that is wrong, and the one that is meant.
MISSPELLED = {
    "Problem": (lambda *_: co.Problem(durations=1.0), "durations", "duration"),
    "state": (lambda ocp, *_: ocp.state("y", intial=0.0), "intial", "initial"),
    "control": (lambda ocp, *_: ocp.control("v", uper=1.0), "uper", "upper"),
    "unknown": (lambda ocp, *_: ocp.unknown("b", 1.0, varaince=1.0), "varaince", "variance"),
    "parameter": (lambda ocp, *_: ocp.parameter("p", values=1.0), "values", "value"),
    "decision": (lambda ocp, *_: ocp.decision("d", gues=1.0), "gues", "guess"),
    "symmetric": (lambda ocp, *_: ocp.symmetric("P", 2, inital=1.0), "inital", "initial"),
    "attitude": (lambda ocp, *_: ocp.attitude("C", initial=None, rates=0.0), "rates", "rate"),
    "dynamics": (lambda ocp, *_: ocp.dynamics("x", 0.0, noize=1.0), "noize", "noise"),
    "measurement": (lambda ocp, *_: ocp.measurement("m", 1.0, noises=1.0), "noises", "noise"),
    "minimize": (lambda ocp, *_: ocp.minimize(runing=1.0), "runing", "running"),
    "minimize_expected": (
        lambda ocp, *_: ocp.minimize_expected(terminal_weights=1.0),
        "terminal_weights",
        "terminal_weight",
    ),
    "subject_to": (lambda ocp, *_: ocp.subject_to(ocp.time, uper=1.0), "uper", "upper"),
    "chance": (lambda ocp, *_: ocp.chance(ocp.time, probabilty=0.9), "probabilty", "probability"),
    "Solver": (lambda ocp, *_: co.Solver(ocp, interval=2), "interval", "intervals"),
    "solve": (lambda ocp, *_: co.solve(ocp, interval=2), "interval", "intervals"),
    "Solver.solve": (lambda _, solver, __: solver.solve(gess=None), "gess", "guess"),
    "simulate": (lambda *a: co.simulate(a[2], runs=8, seed=0, pths=2), "pths", "paths"),
    "evaluate": (lambda ocp, *_: co.evaluate(ocp, nominals=None), "nominals", "nominal"),
    "at": (lambda *a: a[2].at(0.0, sides="after"), "sides", "side"),
    "plot": (lambda *a: a[2].plot(costate=True), "costate", "costates"),
    "Free": (lambda *_: co.Free(1.0, lowr=0.5), "lowr", "lower"),
    "Gain": (lambda *_: co.Gain(structre=None), "structre", "structure"),
    "table": (lambda *_: co.table("t", [0.0, 1.0], [0.0, 1.0], kinds="linear"), "kinds", "kind"),
}


@pytest.mark.parametrize("call", MISSPELLED)
def test_a_misspelled_name_is_told_with_the_one_that_is_meant(call, solved):
    made, wrong, meant = MISSPELLED[call]
    refused(lambda: made(*solved), f"'{wrong}'", f"perhaps '{meant}' is meant", meant)


# The call, what is missing, and words of what it should be.
MISSING = {
    "Problem": (lambda *_: co.Problem(), "duration", "terminal time [s]"),
    "state": (lambda ocp, *_: ocp.state("y"), "initial", "start values, shape () or (shape,)"),
    "unknown": (lambda ocp, *_: ocp.unknown("b", 1.0), "variance", "scalar, vector (diagonal) or matrix"),
    "parameter": (lambda ocp, *_: ocp.parameter("p"), "value", "a number, a vector (n,) or a matrix (n, m)"),
    "chance": (lambda ocp, *_: ocp.chance(ocp.time), "probability", "inside (0, 1)"),
    "Solver": (lambda *_: co.Solver(), "problem", "what to solve"),
    "simulate": (lambda *a: co.simulate(a[2], runs=8), "seed", "a whole number"),
    "Phases": (lambda *_: co.Phases(), "problems", "at least two"),
    "Free": (lambda *_: co.Free(), "guess", "where to start [s]"),
    "movable": (lambda *_: co.movable(), "problem", "become parameters"),
    "save": (lambda *a: a[2].save(), "path", "path="),
}


@pytest.mark.parametrize("call", MISSING)
def test_a_missing_argument_is_told_with_what_it_should_be(call, solved):
    made, missing, words = MISSING[call]
    refused(lambda: made(*solved), f"needs '{missing}'", words, f"add {missing}=")


def test_the_users_own_name_is_told(solved):
    refused(lambda: solved[0].state("altitude"), "Problem.state('altitude')", "received: name")
    refused(lambda: solved[0].state(name="altitude", scales=1.0), "Problem.state('altitude')", "scales=1.0")


def test_only_what_is_said_of_the_argument_itself_is_told(solved):
    assert "joint" not in refused(lambda: solved[0].chance(solved[0].time))


def test_arguments_by_position_are_counted_as_the_user_counts_them(solved):
    refused(lambda: solved[0].state("y", 1, 0.0), "at most 2 by position: name, shape", "3 by position", "initial=")
    refused(lambda: solved[0].state("y", 1, shape=2, initial=0.0), "'shape' twice", "shape=2 by name", "remove one")
    refused(lambda: solved[2].save("a", "b"), "at most 1 by position: path", "2 by position", "remove")


def test_an_option_of_another_call_is_sent_there(solved):
    refused(lambda: co.Solver(solved[0], progress=False), "belongs to the call that solves", "progress=")
    refused(lambda: solved[1].solve(intervals=3), "give it to Solver()")


def test_an_error_inside_the_function_stays_what_it_is():
    def fails(value, *, kept=True):
        raise TypeError("of the user's own function")

    for function in (checked(kept=truth)(fails), one_at_a_time(fails)):
        with pytest.raises(TypeError, match="of the user's own function"):
            function(1.0, kept=False)
        with pytest.raises(co.ProblemError, match="'kept' is meant"):
            function(1.0, kep=False)


def test_no_context_of_python_s_own_is_shown(solved):
    with pytest.raises(co.ProblemError) as caught:
        solved[0].state("y")
    assert caught.value.__cause__ is None
    assert caught.value.__context__ is None


def test_without_docstrings_the_name_is_enough():
    program = "import covocp as co\ntry: co.Problem()\nexcept co.ProblemError as error: print(error)"
    run = subprocess.run([sys.executable, "-OO", "-c", program], capture_output=True, text=True, check=True)
    assert "'duration'" in run.stdout
    assert "expected: duration=" in run.stdout
