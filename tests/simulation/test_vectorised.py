"""Functions over many columns against CasADi's own operations; a column does not see its neighbours."""

import casadi as ca
import numpy as np
import pytest

from covocp.passage.library import functions
from covocp.simulation import vectorised
from covocp.simulation.vectorised import LANES, OPERATIONS, padded, vectorise


@pytest.fixture(autouse=True, params=["compiled", "numpy"])
def _way(request, monkeypatch):
    if request.param == "numpy":
        monkeypatch.setattr(vectorised, "functions", lambda: None)
    elif functions() is None:
        pytest.skip("the library was not built")


def columns(function, inputs, shared=()):
    width = padded(max(value.shape[1] for i, value in enumerate(inputs) if i not in shared))
    ready = vectorise(function, width, shared)
    for i, (buffer, value) in enumerate(zip(ready.inputs, inputs, strict=True)):
        if i in shared:
            buffer[:] = value
        else:
            buffer[:, : value.shape[1]] = value
    with np.errstate(all="ignore"):
        ready.evaluate()
    return [output.copy() for output in ready.outputs]


UNARY = {
    name: getattr(ca, name)
    for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "tanh", "sinh", "cosh", "asinh", "atan", "fabs", "sign")
} | {
    "square": lambda v: v**2,
    "inverse": lambda v: 1 / v,
    "twice": lambda v: v + v,
    "power": lambda v: v**2.7,
    "negative": lambda v: -v,
    "floor": ca.floor,
    "ceil": ca.ceil,
    "erf": ca.erf,
    "log1p": ca.log1p,
    "expm1": ca.expm1,
    "asin": lambda v: ca.asin(v / 10),
    "acos": lambda v: ca.acos(v / 10),
    "atanh": lambda v: ca.atanh(v / 10),
    "acosh": lambda v: ca.acosh(1 + v**2),
    "not": ca.logic_not,
}
BINARY = {
    "minimum": ca.fmin,
    "maximum": ca.fmax,
    "atan2": ca.atan2,
    "fmod": ca.fmod,
    "copysign": ca.copysign,
    "hypot": ca.hypot,
    "power": lambda a, b: ca.fabs(a) ** b,
    "less": lambda a, b: a < b,
    "less or equal": lambda a, b: a <= b,
    "equal": lambda a, b: ca.eq(ca.floor(a), ca.floor(b)),
    "not equal": lambda a, b: ca.ne(ca.floor(a), ca.floor(b)),
    "and": lambda a, b: ca.logic_and(a > 0, b > 0),
    "or": lambda a, b: ca.logic_or(a > 0, b > 0),
    "quotient": lambda a, b: a / b,
    "choice": lambda a, b: ca.if_else(a > b, a * b, ca.sqrt(b)),
}


@pytest.mark.parametrize("name", [*UNARY, *(f"two {name}" for name in BINARY)])
def test_every_operation_is_that_of_casadi(name):
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    two = name.startswith("two ")
    value = BINARY[name[4:]](a, b) if two else UNARY[name](a)
    # The results of a chain overwrite each other's memory in CasADi's program.
    function = ca.Function("f", [a, b], [ca.vertcat(value, value * a + b)])
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 1, 100)) * 3
    expected = np.asarray(function(x, y).full())
    (found,) = columns(function, [x, y])
    np.testing.assert_allclose(found[:, :100], expected, rtol=1e-13, atol=1e-14, equal_nan=True)


def test_a_choice_may_overwrite_what_it_chooses_from():
    a = ca.SX.sym("a")
    root = ca.if_else(a > 0, 1 / ca.sqrt(a), 0)
    function = ca.Function("f", [a], [a * root])
    (found,) = columns(function, [np.array([[4.0, -1.0, 0.0, 9.0]])])
    assert found[0, :4].tolist() == [2.0, 0.0, 0.0, 3.0]


def test_a_condition_may_be_any_number():
    a, b, c = ca.SX.sym("a"), ca.SX.sym("b"), ca.SX.sym("c")
    both = ca.vertcat(ca.if_else(a, b, c), ca.if_else(ca.logic_not(a), b, -c), ca.if_else(c, b, 1 / a))
    function = ca.Function("f", [a, b, c], [both])
    values = np.array([[0.0, -0.0, 1.0, -2.5, 1e-310, np.inf], [1.0, np.nan, 3.0, np.inf, 5.0, 6.0]])
    c_values = np.array([[2.0]])
    (found,) = columns(function, [values[:1], values[1:], c_values[0]], shared=(2,))
    expected = np.hstack([np.asarray(function(x, y, 2.0).full()) for x, y in values.T])
    np.testing.assert_array_equal(found[:, : values.shape[1]], expected)


@pytest.mark.parametrize("seed", range(8))
def test_choices_among_choices(seed):
    """Random graphs in which conditions are chosen, negated and used again, and registers are written over."""
    rng = np.random.default_rng(seed)
    symbols = [ca.SX.sym(f"s{k}") for k in range(4)]
    known = list(symbols)
    for _ in range(40):
        a, b, c = (known[k] for k in rng.integers(0, len(known), 3))
        condition = [a < b, ca.logic_not(a < c), ca.logic_and(a > 0, b <= c), a - b][rng.integers(0, 4)]
        known.append(
            [ca.if_else(condition, a, c), condition * b - a, ca.if_else(condition, b * c, -b)][rng.integers(0, 3)]
        )
    function = ca.Function("f", symbols, [ca.vertcat(*known[-20:])])
    values = [rng.normal(size=(1, 70)).round(1) for _ in symbols]
    (found,) = columns(function, values)
    expected = np.asarray(function(*values).full())
    np.testing.assert_allclose(found[:, :70], expected, rtol=1e-13, atol=1e-14)


def test_shared_inputs_are_the_same_for_all_columns():
    x, c = ca.SX.sym("x", 2), ca.SX.sym("c", 3)
    function = ca.Function("f", [x, c], [ca.vertcat(c[0] * x[0] + c[1] * c[2], x[1]), c[2] * c[2] + 0 * x[0]])
    x_values, c_values = np.random.default_rng(1).normal(size=(2, 70)), np.array([2.0, -1.0, 3.0])
    first, second = columns(function, [x_values, c_values], shared=(1,))
    np.testing.assert_allclose(first[0, :70], 2 * x_values[0] - 3, rtol=1e-15)
    assert (first[1, :70] == x_values[1]).all()
    assert (second[0] == 9.0).all()


def scalar_function():
    x = ca.SX.sym("x", 3)
    return ca.Function("f", [x], [ca.vertcat(ca.sin(x[0]) * ca.exp(x[1]), ca.cos(x[2]) / (1 + x[0] ** 2))])


def table_function():
    x = ca.MX.sym("x", 3)
    knots = np.linspace(-10.0, 10.0, 41)
    lookup = ca.interpolant("lookup", "bspline", [knots], np.sin(knots))
    return ca.Function("f", [x], [ca.vertcat(lookup(x[0]), x[1] * x[2])])


@pytest.mark.parametrize("make", [scalar_function, table_function])
def test_a_column_has_the_same_bits_whatever_its_neighbours(make):
    function = make()
    x = np.random.default_rng(2).normal(size=(3, 5 * LANES))
    (whole,) = columns(function, [x])
    for first, last in ((0, 1), (0, 70), (LANES, 2 * LANES), (LANES, 4 * LANES + 3)):
        (part,) = columns(function, [x[:, first:last]])
        assert (part[:, : last - first] == whole[:, first:last]).all()
    np.testing.assert_allclose(whole, np.asarray(function(x).full()), rtol=1e-13)


def test_widths_are_whole_lanes():
    assert [padded(count) for count in (0, 1, LANES, LANES + 1)] == [LANES, LANES, LANES, 2 * LANES]
    assert len(OPERATIONS) > 40
