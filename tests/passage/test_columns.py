"""Functions of scalars on many columns in compiled code: the same numbers and derivatives as CasADi's map."""

from __future__ import annotations

import ctypes
import gc
import weakref
from typing import Any

import casadi as ca
import numpy as np
import pytest
from side_by_side import in_threads

import covocp as co
from covocp.base.buffered import Buffered
from covocp.models import mass_chain
from covocp.passage import columns, library, operations
from covocp.passage.columns import FEWEST, in_columns, in_turn, numbers_in_turn
from covocp.transcription.covariance_steps import KEPT, gauss_entries, gauss_points

pytestmark = pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))

UNARY = (
    ca.exp, ca.log, ca.sqrt, ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan, ca.floor, ca.ceil, ca.fabs, ca.sign,
    ca.erf, ca.sinh, ca.cosh, ca.tanh, ca.asinh, ca.acosh, ca.atanh, ca.log1p, ca.expm1, ca.logic_not,
    lambda a: a * a, lambda a: 2 * a, lambda a: -a, lambda a: 1 / a, lambda a: a**3, lambda a: a**2.5,
)  # fmt: skip
BINARY = (
    ca.plus, ca.minus, ca.times, ca.rdivide, ca.power, ca.lt, ca.le, ca.eq, ca.ne, ca.logic_and, ca.logic_or, ca.fmod,
    ca.copysign, ca.fmin, ca.fmax, ca.atan2, ca.hypot, lambda a, b: ca.if_else(a > 0, b, 3.0),
)  # fmt: skip
# As many columns as are worked on together, one more or less, and none of it.
COUNTS = (FEWEST, 63, 64, 65, 100)


class Owner:
    """What nodes live as long as."""


def everything() -> ca.Function:
    """Every operation of CasADi's scalars, with an output that is sparse and an argument of which little is used."""
    a, b, c = ca.SX.sym("a", 2), ca.SX.sym("b"), ca.SX.sym("c", 2, 2)
    values = ca.vertcat(*(f(a[0]) for f in UNARY), *(f(a[1], b) for f in BINARY), c[1, 0], 0.1)
    sparse = ca.SX(3, 2)
    sparse[2, 1], sparse[0, 0] = a[0] * b, ca.sin(b)
    return ca.Function("everything", [a, b, c], [values, sparse])


def smooth() -> ca.Function:
    """A function with slopes of second order."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
    return ca.Function("smooth", [x, p], [ca.vertcat(ca.sin(x[0]) * p[0], ca.exp(x[1] * x[2])), x[2] ** 3 * p[1]])


def numbers(function: ca.Function, seed: int) -> list[np.ndarray]:
    """Arguments among them that are zero, negative, infinite and undefined."""
    rng = np.random.default_rng(seed)
    given = [rng.normal(size=function.nnz_in(i)) * 3 for i in range(function.n_in())]
    for values in given:
        values[:: max(len(values) // 7, 1)] = rng.choice([0.0, -0.0, np.inf, -np.inf, np.nan, 1.0], 1)[0]
    return given


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("function", [everything(), smooth()], ids=lambda f: f.name())
def test_numbers_are_those_of_the_map(function: ca.Function, count: int):
    """Bit by bit, undefined ones too."""
    owner, plain = Owner(), function.map(count)
    node = in_columns(owner, function, count)
    assert node.class_name() == "CallbackInternal"
    assert [node.sparsity_in(i) for i in range(node.n_in())] == [plain.sparsity_in(i) for i in range(plain.n_in())]
    assert [node.sparsity_out(i) for i in range(node.n_out())] == [plain.sparsity_out(i) for i in range(plain.n_out())]
    for seed in range(4):
        given = numbers(plain, seed)
        with np.errstate(all="ignore"):
            own, expected = Buffered(node)(*given), Buffered(plain)(*given)
        assert own is not None
        assert expected is not None
        for one, other in zip(own, expected, strict=True):
            np.testing.assert_array_equal(one, other)


def test_every_kind_of_operation_is_met():
    """The function of all operations has each that the library knows, but the one that CasADi leaves out."""
    function = everything()
    met = {function.instruction_id(k) for k in range(function.n_instructions())}
    assert set(operations.NUMBERS) - met == {ca.OP_ASSIGN}
    assert met <= set(operations.NUMBERS)


def test_a_value_that_is_assigned_is_the_same():
    """The operation that CasADi's functions of scalars leave out, listed by hand."""
    kinds = [operations.KINDS.index(name) for name in ("INPUT", "ASSIGN", "OUTPUT")]
    rows = np.array([[kinds[0], 0, 0, 1], [kinds[1], 1, 0, 0], [kinds[2], 0, 0, 0]], np.intc)
    constants, heights, given = np.zeros(3), np.array([1, 1], np.intc), np.arange(40.0)
    result = np.full(40, np.nan)
    places = (ctypes.c_void_p * 2)(given.ctypes.data, result.ctypes.data)
    told = (3, rows.ctypes.data, constants.ctypes.data, 2, 1, heights.ctypes.data, places, 1, 40)
    assert library.needed()["columns"](*told) == 0
    np.testing.assert_array_equal(result, given)


@pytest.mark.parametrize("masses", [1, 5])
def test_what_is_read_at_once_is_what_casadi_tells_one_by_one(masses: int):
    """All operations and constants; no text of another kind is read as such."""
    own = gauss_points(mass_chain.problem(masses).statement(), 0, "gauss")
    for function in (everything(), smooth(), own, own.reverse(1), own.forward(1)):
        rows, constants = operations.asked_one_by_one(function)
        read = operations.read_at_once(function)
        assert read is not None
        np.testing.assert_array_equal(read[0], rows)
        np.testing.assert_array_equal(read[1], constants)


def test_a_text_that_is_not_understood_is_not_believed(monkeypatch: pytest.MonkeyPatch):
    """Where CasADi kept functions otherwise, or a number is off, operations are asked for one by one."""
    function = gauss_points(mass_chain.problem(5).statement(), 0, "gauss")
    expected = operations.asked_one_by_one(function)
    exchanged = operations._TABLE.copy()
    exchanged[[ca.OP_MUL, ca.OP_ADD]] = exchanged[[ca.OP_ADD, ca.OP_MUL]]
    shorter = operations._TABLE.copy()
    shorter[ca.OP_MUL] = operations.UNKNOWN
    for table in (exchanged, shorter):
        monkeypatch.setattr(operations, "_TABLE", table)
        assert operations.read_at_once(function) is None
    for one, other in zip(operations.asked_one_by_one(function), expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("change", ["letters", "half", "none"])
def test_a_text_of_another_kind_is_none(monkeypatch: pytest.MonkeyPatch, change: str):
    """Other letters, the half of it, nothing at all."""
    function = gauss_points(mass_chain.problem(5).statement(), 0, "gauss")
    whole = library.needed()["operations"]

    def changed(text: bytes, length: int, *others: Any) -> int:
        other = {"letters": text.replace(b"c", b"z"), "half": text[: length // 2], "none": b""}[change]
        return whole(other, len(other), *others)

    assert operations.read_at_once(function) is not None
    monkeypatch.setattr(operations, "functions", lambda: {"operations": changed})
    assert operations.read_at_once(function) is None
    assert operations.program(function) is not None


def test_a_function_of_which_a_copy_is_in_its_text_is_told_from_it():
    """CasADi writes what a derivative is one of beside it, which begins like it."""
    own = smooth()
    for function in (own.reverse(1), own.forward(1), own.reverse(1).forward(1)):
        rows, constants = operations.asked_one_by_one(function)
        read = operations.read_at_once(function)
        assert read is not None
        np.testing.assert_array_equal(read[0], rows)
        np.testing.assert_array_equal(read[1], constants)


def slopes_of(function: ca.Function, arguments: int, count: int) -> ca.Function:
    """(arguments, weights, direction) -> slopes of weighted results, tangent, tangent of the slopes."""
    x, weights = ca.MX.sym("x", arguments, count), ca.MX.sym("weights", 1, count)
    direction = ca.MX.sym("direction", arguments, count)
    value = function(*(x[i, :] for i in range(arguments)))
    slope = ca.jtimes(value, x, weights, True)
    found = [slope, ca.jtimes(value, x, direction), ca.jtimes(slope, x, direction)]
    return ca.Function("slopes", [x, weights, direction], [ca.densify(v) for v in found])


@pytest.mark.parametrize("operation", [*UNARY, *BINARY])
def test_the_rule_of_each_operation_is_casadis(operation: Any):
    """Where both operands are alike, zero, outside of where it is defined too; of first and second order."""
    rows = 2 if operation in BINARY else 1
    symbols = [ca.SX.sym(name) for name in "ab"[:rows]]
    function = ca.Function("rule", symbols, [operation(*symbols)])
    some = [-2.5, -1.0, -0.7, -0.3, 0.0, 0.2, 0.5, 0.9, 1.0, 1.3, 2.0, 3.7]
    points = np.array(np.meshgrid(*[some] * 2)).reshape(2, -1)[:rows]
    count, owner = points.shape[1], Owner()
    weights, direction = np.linspace(0.5, 1.5, count), np.linspace(-1.0, 1.2, points.size).reshape(points.shape)
    own, plain = (slopes_of(f, rows, count) for f in (in_columns(owner, function, count), function.map(count)))
    for one, other in zip(own(points, weights, direction), plain(points, weights, direction), strict=True):
        np.testing.assert_allclose(one.full(), other.full(), rtol=1e-12, atol=1e-14)


def test_a_derivative_of_many_arguments_has_few_operations():
    """What is not asked for, and what does not move, is left out; registers are used again."""
    function, _ = gauss_entries(mass_chain.problem(5).statement(), 0, "gauss")
    told = columns.OnColumns.of(function, operations.program(function))
    moving = tuple(function.is_diff_in(i) for i in range(function.n_in()))
    for kind in ("reverse", "forward"):
        found, expected = told.derived(kind, moving), getattr(function, kind)(1)
        assert found is told.derived(kind, moving)
        assert len(found._listed[0]) <= 1.2 * expected.n_instructions()
        assert found._registers <= 0.2 * len(found._listed[0])
        assert [shape.shape for shape in found.outputs] == [expected.size_out(i) for i in range(expected.n_out())]
    assert not told.derived("reverse", (False,) * len(moving)).outputs[0].nnz()


def test_a_derivative_that_is_too_long_is_casadis(monkeypatch: pytest.MonkeyPatch):
    """Room for no more operations than the function has; and arguments that are sparse."""
    function, count = smooth(), 64
    monkeypatch.setattr(columns, "MOST_TIMES", 0)
    owners = [Owner(), Owner()]
    kept = columns._KEPT.setdefault(owners[0], columns._Kept())
    assert kept.told(function).derived("reverse", (True, True)) is None
    x, p, s = ca.MX.sym("x", 3, count), ca.MX.sym("p", 2, count), ca.MX.sym("s", 2, count)
    found = [
        ca.Function("f", [x, p, s], [ca.jtimes(f(x, p)[0], x, s, True)])
        for f in (in_columns(owners[0], function, count), function.map(count))
    ]
    rng = np.random.default_rng(2)
    given = [rng.normal(size=shape) for shape in ((3, count), (2, count), (2, count))]
    np.testing.assert_allclose(found[0](*given).full(), found[1](*given).full(), rtol=1e-13)


@pytest.mark.parametrize("which", ["gradient", "tangent", "product", "jacobian"])
def test_derivatives_are_those_of_the_map(which: str):
    """Of first and second order, along one direction and along several."""
    owner, function, count = Owner(), smooth(), 64
    made = []
    for mapped in (in_columns(owner, function, count), function.map(count)):
        x, p, v = ca.MX.sym("x", 3 * count), ca.MX.sym("p", 2, count), ca.MX.sym("v", 3 * count)
        first, second = mapped(ca.reshape(x, 3, count), p)
        values = ca.vertcat(ca.vec(first), ca.vec(second))
        number = ca.sumsqr(first) + ca.dot(second, ca.cos(second))
        result = {
            "gradient": lambda x=x, number=number: ca.gradient(number, x),
            "tangent": lambda x=x, v=v, values=values: ca.jtimes(values, x, v),
            "product": lambda x=x, v=v, p=p, number=number: ca.jtimes(ca.gradient(number, p), x, v),
            "jacobian": lambda x=x, values=values: ca.jacobian(values, x),
        }[which]()
        made.append(ca.Function("f", [x, p, v], [result]))
    rng = np.random.default_rng(5)
    given = [rng.normal(size=made[0].size_in(i)) for i in range(made[0].n_in())]
    own, expected = (np.asarray(f(*given)) for f in made)
    np.testing.assert_allclose(own, expected, rtol=1e-14, atol=1e-14)
    if which == "jacobian":
        assert made[0].sparsity_out(0) == made[1].sparsity_out(0)


def advancing() -> ca.Function:
    """A step of a value, with a matrix, a result without entries, and an argument without rows."""
    x, u, none, m = ca.SX.sym("x", 3), ca.SX.sym("u", 2), ca.SX.sym("none", 0), ca.SX.sym("m", 2, 2)
    rate = ca.vertcat(ca.sin(x[1]), u[0] * x[2], ca.exp(u[1]) - x[0]) + (m @ u)[1]
    after = x + 0.1 * rate
    return ca.Function("advancing", [x, u, none, m], [after, ca.horzcat(x, after), ca.SX(1, 1), x[0] * x[1]])


# Steps and sequences: as few and as many as are worked on by themselves, some at a time and most at a time.
SEQUENCES = ((1, 1), (7, 1), (50, 1), (5, 2), (3, 16), (3, 17), (4, 33), (1, 40))


@pytest.mark.parametrize(("steps", "sequences"), SEQUENCES)
def test_sequences_are_those_of_casadi(steps: int, sequences: int):
    """Bit by bit, as a node and of numbers alone."""
    owner, function = Owner(), advancing()
    plain = function.mapaccum(steps) if steps > 1 else function
    plain = plain.map(sequences) if sequences > 1 else plain
    node = in_turn(owner, function, steps, sequences)
    assert node.class_name() == "CallbackInternal"
    assert [node.sparsity_in(i) for i in range(node.n_in())] == [plain.sparsity_in(i) for i in range(plain.n_in())]
    assert [node.sparsity_out(i) for i in range(node.n_out())] == [plain.sparsity_out(i) for i in range(plain.n_out())]
    given = [np.random.default_rng(3).normal(size=plain.size_in(i)) for i in range(plain.n_in())]
    expected = [value.full() for value in plain.call([ca.DM(value) for value in given])]
    numbers = numbers_in_turn(owner, function, given[0], given[1:], steps)
    assert numbers is not None
    for own, alone, other in zip(node.call([ca.DM(v) for v in given]), numbers, expected, strict=True):
        np.testing.assert_array_equal(own.full(), other)
        np.testing.assert_array_equal(alone, other)


@pytest.mark.parametrize("which", ["gradient", "tangent", "jacobian"])
@pytest.mark.parametrize("sequences", [1, 3])
def test_derivatives_of_sequences_are_those_of_casadi(which: str, sequences: int):
    """With the sparsity that steps have: later controls change no earlier value."""
    owner, function, steps = Owner(), advancing(), 6
    plain = function.mapaccum(steps)
    made = []
    for turned in (in_turn(owner, function, steps, sequences), plain.map(sequences) if sequences > 1 else plain):
        given = [ca.MX.sym(f"a{i}", *turned.size_in(i)) for i in range(turned.n_in())]
        after, _, _, products = turned.call(given)
        number = ca.sumsqr(after) + ca.sum2(ca.cos(products))
        result = {
            "gradient": lambda u=given[1], number=number: ca.gradient(number, u),
            "tangent": lambda u=given[1], after=after: ca.jtimes(after, u, ca.sin(u)),
            "jacobian": lambda u=given[1], after=after: ca.jacobian(ca.vec(after), ca.vec(u)),
        }[which]()
        made.append(ca.Function("f", given, [result]))
    rng = np.random.default_rng(5)
    values = [ca.DM(rng.normal(size=made[0].size_in(i))) for i in range(made[0].n_in())]
    own, expected = (function.call(values)[0] for function in made)
    np.testing.assert_allclose(own.full(), expected.full(), rtol=1e-13, atol=1e-14)
    assert made[0].sparsity_out(0) == made[1].sparsity_out(0)


def test_what_is_no_step_of_a_dense_value_stays_casadis():
    """Another height, entries that are left out, and functions that are not of scalars."""
    owner, x = Owner(), ca.SX.sym("x", 2)
    whole, part = ca.Function("whole", [x], [ca.sin(x)]), ca.Function("part", [x], [ca.vertcat(x[0], ca.SX(1, 1))])
    m = ca.MX.sym("m", 2)
    other = ca.Function("other", [m], [ca.norm_fro(m) * m])
    assert in_turn(owner, whole, 5, 1).class_name() == "CallbackInternal"
    for function in (part, other):
        assert in_turn(owner, function, 5, 1).class_name() != "CallbackInternal"
        assert numbers_in_turn(owner, function, np.ones((2, 1)), [], 5) is None


def test_few_columns_and_other_functions_stay_maps():
    """Where it does not pay, and where CasADi calls something that is no operation of scalars."""
    owner, x = Owner(), ca.MX.sym("x", 2)
    other = ca.Function("other", [x], [ca.norm_fro(x) * x])
    assert in_columns(owner, smooth(), FEWEST - 1).class_name() == "Map"
    assert in_columns(owner, other, 100).class_name() == "Map"


def test_nodes_end_with_their_owner():
    """Nothing stays of problems that are gone; the same is given again as long as they are there."""
    owner, function = Owner(), smooth()
    node = in_columns(owner, function, 64)
    assert in_columns(owner, function, 64) is node
    gone = weakref.ref(node)
    del node, owner
    gc.collect()
    assert gone() is None


def test_threads_do_not_meet():
    """Four threads on the same node, each with its own numbers."""
    owner, function = Owner(), smooth()
    node, plain = in_columns(owner, function, 100), function.map(100)
    wrong: list[int] = []

    def run(k: int) -> None:
        own, other = Buffered(node), Buffered(plain)
        for seed in range(20):
            given = numbers(plain, 100 * k + seed)
            for one, expected in zip(own(*given) or (), other(*given) or (), strict=True):
                if not np.array_equal(one, expected, equal_nan=True):
                    wrong.append(k)

    in_threads(run)
    assert not wrong


def test_many_problems_leave_nothing_behind():
    """Problems that were solved and are gone keep no nodes, but the last ones, of which functions are kept."""

    def solved(noise: float) -> None:
        ocp = co.Problem(duration=1.0)
        x = ocp.state("x", initial=0.0, variance=1.0)
        u = ocp.control("u", guess=0.1)
        ocp.dynamics(x, -x + u, noise=0.1)
        ocp.measurement("y", x, noise=noise + x**2)
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2, terminal=E[x, x])
        co.Solver(ocp, intervals=60, max_iterations=2).solve(progress=False, allow_failure=True, assess=False)

    before = len(columns._KEPT)  # other tests may keep theirs
    for k in range(3 * KEPT):
        solved(0.1 + 0.01 * k)
    gc.collect()
    assert len(columns._KEPT) - before < 2 * KEPT
