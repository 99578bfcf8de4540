"""print(problem): data and equations in the user's names, and formulas that mean what CasADi computes."""

import math
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from notebooks import Page, letters

import covocp as co
from covocp.models import mars_entry, unknown_lag
from covocp.problem.formulas import LONG, MOST_OPERATIONS, formulas


def lines(text):
    """Lines with single blanks."""
    return [" ".join(line.split()) for line in text.splitlines()]


def test_equations_have_the_users_names():
    shown = lines(str(unknown_lag.problem(final=1.0)))
    for line in (
        "first-order lag, unknown time constant: duration 10 s",
        "d x/dt = u - b*x 1",
        "d E/dt = F E + E F' + Q - E M' U^-1 M E",
        "position = x 1",
        "at T weight*E[b, b]",
        "integral of 0.5*u**2",
        "b 1 5",
    ):
        assert line in shown


def test_a_notebook_shows_the_same_words():
    for problem in (unknown_lag.problem(), mars_entry.problem()):
        page = Page(problem._repr_html_())
        assert letters(" ".join(page.words)) == letters(str(problem))
        assert page.images == []


def test_bounds_ends_noise_and_constraints():
    ocp = co.Problem(co.Free(4.0, upper=9.0), name="all of it")
    x = ocp.state("x", 2, initial=[1.0, None], final=[0.0, None], lower=-5.0, variance=[[1, 0.5], [0.5, 1]], unit="m")
    u = ocp.control("u", lower=-1.0, upper=2.0)
    w = ocp.parameter("w", 3.0)
    y = ocp.state("y", initial=2 * w)
    ocp.dynamics(x, ca.vertcat(x[1], u - w * x[0]), noise=[0.0, 0.1])
    ocp.measurement("z", x[0], information=u)
    ocp.subject_to(x[0] - y, lower=-1.0, upper=1.0, name="band")
    ocp.subject_to(x[0] * y, lower=2.0, upper=2.0, at="final", name="meet")
    ocp.subject_to(x, lower=0.0, upper=np.inf, at="initial", name="first")
    shown = lines(str(ocp))
    for line in (
        "all of it: duration free, at least 0.004 s and at most 9 s, guess 4 s",
        "x[0] m 1 0 >= -5 [1, 0.5]",
        "x[1] m free free >= -5 [0.5, 1]",
        "y 2*w free",
        "u -1 .. 2",
        "d x[0]/dt = x[1]",
        "d x[1]/dt = u - w*x[0] 0.1",
        "d y/dt = (not given yet)",
        "z = x[0] u",
        "no cost yet: minimize() or minimize_expected()",
        "band always -1 <= x[0] - y <= 1",
        "meet at T x[0]*y = 2",
        "first[1] at 0 x[1] >= 0",
    ):
        assert line in shown, line


def test_the_weights_of_an_expected_cost():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", 2, initial=0.0, final=[1.0, None], variance=1.0), ocp.control("u")
    w = ocp.parameter("w", 3.0)
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize_expected(running=u**2, terminal_weight={x[0]: 2 * w}, gain=co.Gain(constant=True))
    shown = lines(str(ocp))
    for line in ("integral of u**2", "weight of a miss x 2*w, 0", "gain of the feedback Gain(constant=True)"):
        assert line in shown, line


def test_a_problem_without_anything_is_shown():
    assert "problem without a name: duration 2 s" in str(co.Problem(2.0))


def test_tables_are_called_by_their_names():
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=0.0)
    ocp.dynamics(x, -ca.interpolant("drag", "linear", [[0.0, 1.0, 2.0]], [0.0, 1.0, 4.0])(x))
    assert "d x/dt = -drag(x)" in lines(str(ocp))


def test_lines_are_at_most_100_columns_and_long_expressions_are_split_or_counted():
    ocp = co.Problem(1.0)
    x, y = ocp.state("x", initial=0.0), ocp.state("y", initial=0.0)
    ocp.dynamics(x, sum(ca.sin(k * x) for k in range(1, 31)))
    ocp.dynamics(y, sum(ca.sin((k + 0.5) * y) for k in range(100)))
    text = str(ocp)
    assert max(map(len, text.splitlines())) <= 100
    assert "operations on y)" in text
    assert "@1 = sin(x) + sin(2*x)" in " ".join(text.split())


def value(text, definitions, numbers):
    """What a formula means to a reader."""
    names = {name: getattr(math, name) for name in ("sin", "cos", "exp", "sqrt", "tanh")}
    names |= {"abs": abs, "min": min, "max": max, "if_else_zero": lambda c, v: v if c else 0.0, **numbers}
    for name, meaning in definitions:
        names[name.replace("@", "at_")] = eval(meaning.replace("@", "at_"), {}, dict(names))
    return eval(text.replace("@", "at_"), {}, names)


x, y, z = (ca.MX.sym(name) for name in "xyz")
CASES = [
    x - (y - z), x - (y + z), (x - y) - z, x / (y * z), x / y / z, x / (y / z), x * (y / z), -(x + y), -x * y, x * -y,
    -(x**2), (-x) ** 2, x**y**z, (x**y) ** z, (x * y) ** 2, x**-1.5, x**3, 1 / x, 1 / (x * y), 1 / (1 / x), 2 * (x + y),
    x + (-2) * y, x - (-2) * y, ca.sqrt(x) * ca.fmax(x, -y), ca.if_else(x > y, x, z - y), ca.fabs(x - y) - 3 * (x - 2),
    ca.sin(x + y) * ca.cos(x + y) + (x + y * z) ** 2 * (x + y * z), ca.tanh(-x) / ca.exp(-y), x - ca.fmin(-x, -y),
    ca.if_else(ca.logic_and(x > y, z > y), x, 2 * z), -(-x - y), (x + y) + (z + x), x * (y * z), -x / -y, (x - y) * -z,
]  # fmt: skip


@pytest.mark.parametrize("expression", CASES, ids=str)
def test_formulas_mean_what_casadi_computes(expression):
    found = formulas([expression], [x, y, z], [["x"], ["y"], ["z"]])
    for numbers in ((1.3, 0.7, 2.1), (0.4, 1.9, 0.6)):
        known = float(ca.Function("f", [x, y, z], [expression])(*numbers))
        read = value(found.entries[0][0], found.definitions, dict(zip("xyz", numbers, strict=True)))
        assert read == pytest.approx(known, rel=1e-7)


def test_what_is_shared_has_one_name_in_all_expressions():
    shared = ca.exp(-x / 8000.0) * y**2
    found = formulas([shared * ca.sin(z), shared * ca.cos(z)], [x, y, z], [["x"], ["y"], ["z"]])
    assert [name for name, _ in found.definitions] == ["@1"]
    assert [entry[0] for entry in found.entries] == ["@1*sin(z)", "@1*cos(z)"]


def test_long_chains_are_written_out_in_pieces():
    long = sum(ca.sin(k * x) * y for k in range(1, 35))
    found = formulas([long], [x, y], [["x"], ["y"]])
    assert found.definitions
    assert all(len(text) < 2 * LONG for text in [found.entries[0][0], *(text for _, text in found.definitions)])
    read = value(found.entries[0][0], found.definitions, {"x": 0.3, "y": 1.1})
    assert read == pytest.approx(float(ca.Function("f", [x, y], [long])(0.3, 1.1)), rel=1e-7)
    huge = sum(ca.sin((k + 0.5) * x) for k in range(MOST_OPERATIONS))
    assert formulas([huge], [x], [["x"]]).entries[0][0].endswith("operations on x)")


def test_what_has_no_scalar_form_is_what_casadi_prints():
    class Outside(ca.Callback):
        def __init__(self):
            ca.Callback.__init__(self)
            self.construct("outside", {})

        def eval(self, arguments):
            return [2 * arguments[0]]

    outside = SimpleNamespace(function=Outside())
    found = formulas([outside.function(x) + 1, x + y], [x, y], [["x"], ["y"]])
    assert "outside(x)" in found.entries[0][0]
    assert found.entries[1] == ("x + y",)
