"""What phases refuse: names, sizes, units, values and symbols that do not fit, and what they cannot do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

import covocp as co


def part(name: str = "second", **given: Any) -> co.Problem:
    """A small phase; by default one that follows another, with a covariance."""
    options = {"initial": None, "variance": None, "size": 1, "unit": "", "x": "x", "covariance": True, "cost": True}
    options |= {"parameter": None, "unknown": None, "start": None, "decision": False} | given
    ocp = co.Problem(1.0, name=name)
    size = options["size"]
    x = ocp.state(options["x"], size, initial=options["initial"], variance=options["variance"], unit=options["unit"])
    u = ocp.control("u", size)
    if options["parameter"] is not None:
        ocp.parameter("k", options["parameter"])
    if options["unknown"] is not None:
        ocp.unknown("b", mean=options["unknown"], variance=1.0)
    if options["decision"]:
        ocp.decision("d", guess=1.0)
    ocp.dynamics(x, u, noise=0.1)
    if options["covariance"]:
        ocp.estimation_covariance(options["start"])
    if options["cost"]:
        ocp.minimize(running=ca.sumsqr(u), terminal=ca.sumsqr(x - 1.0))
    return ocp


def first(**given: Any) -> co.Problem:
    return part("first", **{"initial": 0.0, "variance": 0.5, **given})


def attitude() -> co.Problem:
    ocp = part("turning")
    ocp.attitude("C", initial=np.eye(3), rate=ca.MX.zeros(3))
    return ocp


def closed(name: str = "closed", *, noise: float = 0.1, final: float | None = None, **given: Any) -> co.Problem:
    ocp = co.Problem(1.0, name=name)
    x, u = ocp.state("x", initial=0.0 if name == "open" else None, final=final), ocp.control("u")
    ocp.dynamics(x, u, noise=noise)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=u**2, **given)
    return ocp


def ending(final: float | None) -> list[co.Problem]:
    """A state with a final value that the later phase does not have."""
    one, two = closed("open"), closed()
    y = one.state("y", initial=0.0, final=final)
    one.dynamics(y, one.controls[0].symbol)
    return [one, two]


WRONG: dict[str, tuple[Callable[[], list[co.Problem]], str]] = {
    "initial": (lambda: [first(), part(initial=1.0)], "goes on from 'first' to 'second' and has an initial value too"),
    "variance": (lambda: [first(), part(variance=1.0)], "goes on from 'first' to 'second' and has a variance too"),
    "size": (lambda: [first(), part(size=2)], "The sizes of 'x' in the phases 'first' and 'second' do not fit"),
    "unit": (lambda: [first(unit="m"), part(unit="ft")], "The units of 'x' in the phases 'first' and 'second'"),
    "kind": (lambda: [first(), part(x="k"), part("third", parameter=1.0, x="y")], "have 'k' as different things"),
    "parameter": (lambda: [first(parameter=1.0), part(parameter=2.0)], "The value of the parameter 'k'"),
    "unknown": (lambda: [first(unknown=1.0), part(unknown=2.0)], "The mean of the unknown 'b'"),
    "gap": (lambda: [first(unknown=1.0), part(), part("third", unknown=1.0)], "is missing between them"),
    "covariance": (lambda: [first(covariance=False), part()], "has an estimation covariance, and 'first' before it"),
    "its start": (lambda: [first(), part(start=np.eye(1))], "has an initial value, and goes on"),
    "names": (lambda: [first(), part("first")], "Two phases have the name 'first'"),
    "no cost": (lambda: [first(cost=False), part(cost=False)], "No phase has a cost"),
    "no rate": (lambda: [first(), co.Problem(1.0, name="empty")], "In the phase 'empty': The problem has no state"),
    "unused": (lambda: [first(decision=True), part(decision=True)], "Nothing depends on the decision 'd'"),
    "attitude": (lambda: [first(), attitude()], "The phase 'turning' has the attitude 'C'"),
    "mixed": (lambda: [first(), closed()], "The phase 'first' has no expected cost, and others have one"),
    "gain": (lambda: [closed("open"), closed(gain=co.Gain(structure=[[1, 1]]))], "structure of the gain does not fit"),
    "certain": (lambda: [closed("open", noise=0.0), closed(noise=0.0)], "nothing in the system is uncertain"),
    "missed": (lambda: [closed("open"), closed(final=1.0)], "In the phase 'closed': The final value of 'x' is presc"),
    "missed before": (lambda: ending(1.0), "In the phase 'open': The final value of 'y' is prescribed"),
}


@pytest.mark.parametrize("case", WRONG)
def test_phases_that_do_not_fit_are_refused(case: str) -> None:
    make, words = WRONG[case]
    with pytest.raises(co.ProblemError, match=words):
        co.solve(co.Phases(make()), intervals=2, progress=False)


def test_phases_are_two_different_problems_or_more() -> None:
    one = first()
    for given, words in (([one], "two problems or more"), (one, "two problems or more"), ([one, one], "given twice")):
        with pytest.raises(co.ProblemError, match=words):
            co.Phases(given)  # type: ignore[arg-type]


def test_jumps_that_do_not_fit_are_refused() -> None:
    one, two = first(), part()
    x, y, u = one.states[0].symbol, two.states[0].symbol, one.controls[0].symbol
    phases = co.Phases([one, two])
    for wrong, words in (
        ((x, 1.0), "'x' cannot jump there"),
        (("x", x), "not a state of these phases"),
        ((u, x), "not a state of these phases"),
        ((y, ca.vertcat(x, x)), "wrong size"),
        ((y, x, -1.0), "is negative"),
    ):
        with pytest.raises(co.ProblemError, match=words):
            phases.jump(*wrong)
    phases.jump(y, 2.0 * x)
    with pytest.raises(co.ProblemError, match="stated twice"):
        phases.jump(y, x)
    for expression, words in ((u, "contains 'u'"), (y, "contains 'x'"), (one.time * x, "contains 'time'")):
        other = co.Phases([one, two])
        other.jump(y, expression)
        with pytest.raises(co.ProblemError, match=words):
            other.chain()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "gradient", "variant": "chord"}, "'variant' of the gradient method does not apply to phases"),
        ({"method": "gradient", "weight": [1.0]}, "'weight' of the gradient method does not apply to phases"),
        ({"method": "gradient", "covariances": "states"}, "The gradient method takes no 'covariances'"),
        ({"nominal": "deterministic"}, "Phases are not solved that way"),
        ({"guess": "everywhere"}, "The guess is an unknown word"),
        ({"starts": 3}, "The options of multistart are given, but not multistart"),
        ({"guess": "multistart", "seed": -1}, "The option 'seed' is not a whole number"),
        ({"guess": [None]}, "does not fit the phases"),
        ({"guess": {"third": None}}, "There is no phase 'third'"),
        ({"intervals": [2]}, "'intervals' has a value that does not apply"),
        ({"parameters": {"z": 1.0}}, "There is no parameter 'z'"),
        ({"refine": 2.0}, "'refine' must be a relative error"),
        ({"colour": 1}, "has no option 'colour'"),
    ],
)
def test_options_that_mean_nothing_to_phases_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(co.ProblemError, match=words):
        co.solve(co.Phases([first(), part()]), **{"intervals": 2, "progress": False, **options})


def test_what_takes_one_problem_says_so() -> None:
    phases = co.Phases([first(), part()])
    solution = co.solve(phases, intervals=2, progress=False)
    for function in (co.Solver, co.worth, co.certify):
        for given in (phases, solution):
            with pytest.raises(co.ProblemError, match="phase"):
                function(given)
    with pytest.raises(co.ProblemError, match="phase"):
        co.compare(solution)
    with pytest.raises(co.ExportError, match="phase"):
        co.export_c(phases, "nowhere")
    with pytest.raises(co.ProblemError, match="one of several phases"):
        co.certify(solution["first"])
    with pytest.raises(co.ProblemError, match="There is no phase 'third'"):
        solution["third"]


def test_a_phase_that_changes_is_read_again() -> None:
    one, two = first(), part()
    phases = co.Phases([one, two])
    before = phases.chain()
    assert phases.chain() is before
    two.subject_to(two.states[0].symbol, upper=0.5, at="final")
    assert phases.chain() is not before
    assert phases.chain().statements[1].end.size == 1
