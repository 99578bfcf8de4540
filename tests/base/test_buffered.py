"""Functions called through their buffers: the numbers of CasADi's own calls."""

import casadi as ca
import numpy as np
import pytest
from side_by_side import in_threads

from covocp.base import buffered
from covocp.base.buffered import Buffered, Matrices, swept


def test_a_sweep_has_the_numbers_of_casadis_own():
    value, row, matrix, none = ca.SX.sym("v", 2), ca.SX.sym("r", 1), ca.SX.sym("m", 2, 3), ca.SX.sym("n", 0, 1)
    after = ca.sin(value) * row + ca.sum2(matrix)
    function = ca.Function("f", [value, row, matrix, none], [after, ca.vertcat(value[0] * row, matrix[1, 2])])
    generator = np.random.default_rng(1)
    rows, matrices = generator.standard_normal((1, 4)), generator.standard_normal((2, 12))
    columns = (ca.DM(rows), matrices, np.zeros((0, 4)))
    expected = function.mapaccum("sweep", 4)(np.array([0.3, -0.2]), *columns)
    found = swept(function, np.array([0.3, -0.2]), *columns)
    for numbers, reference in zip(found, expected, strict=True):
        np.testing.assert_allclose(numbers, reference.full().T, rtol=1e-15)


class Failing(ca.Callback):
    """x + 1 below two; no value from there on."""

    def __init__(self):
        ca.Callback.__init__(self)
        self.construct("failing", {})

    def eval(self, arguments):
        if arguments[0] > 1.5:
            raise ValueError("no value")
        return [arguments[0] + 1.0]


def test_a_call_that_fails_is_told():
    inside, x, p = Failing(), ca.MX.sym("x"), ca.MX.sym("p")
    function = ca.Function("outer", [x, p], [inside(x) + p])
    assert Buffered(function)(np.array([2.0]), np.array([0.0])) is None
    with pytest.raises(RuntimeError, match="outer failed at column 1"):
        swept(function, np.array([1.0]), np.zeros((1, 3)))


def test_matrices_are_those_of_the_function():
    x, a = ca.MX.sym("x", 2, 3), ca.MX.sym("a")
    function = ca.Function("f", [x, a], [a * x.T, ca.diag(x[0, :].T), ca.sum1(x)])
    value = np.arange(6.0).reshape(2, 3)
    found = Matrices(function).evaluated(value, 3.0)
    for own, expected in zip(found, function(value, 3.0), strict=True):
        np.testing.assert_array_equal(own, expected.full())


def test_matrices_that_cannot_be_had_are_an_error():
    failing = Failing()
    assert Matrices(failing).evaluated(1.0)[0] == 2.0
    with pytest.raises(RuntimeError, match="failing failed"):
        Matrices(failing).evaluated(3.0)


def test_threads_share_matrices():
    """Each gets its own numbers, though the memory is one."""
    x = y = ca.MX.sym("x", 50)
    for _ in range(100):
        y = ca.sin(y) + x
    shared, wrong = Matrices(ca.Function("f", [x], [y])), []

    def run(k):
        number = np.full(50, float(k))
        (expected,) = shared.evaluated(number)
        wrong.extend(1 for _ in range(100) if not np.array_equal(shared.evaluated(number)[0], expected))
        if np.ptp(expected):
            wrong.append(k)

    in_threads(run)
    assert not wrong


def test_of_large_functions_one_has_memory(monkeypatch):
    """That which was called last, until another one is or it is given back; the numbers are those of small ones."""
    x = ca.MX.sym("x", 3)
    functions = [ca.Function(f"f{k}", [x], [k * x + 1.0, ca.sum1(x) ** k]) for k in (1, 2)]
    small = [Buffered(function) for function in functions]
    monkeypatch.setattr(buffered, "MOST_KEPT", 0)
    large = [Buffered(function) for function in functions]
    matrices = Matrices(functions[0])
    for k in (0, 0, 1, 0):
        for point in (np.arange(3.0), np.array([0.5, -2.0, 1e9])):
            for own, other in zip(large[k](point), small[k](point), strict=True):
                np.testing.assert_array_equal(own, other)
        assert [one._kept is not None for one in large] == [k == 0, k == 1]
    matrices.evaluated(np.ones(3))
    assert [one._kept for one in (*large, matrices)] == [None] * 3
    large[1](np.ones(3))
    del large[1]
    buffered.release_large()
    np.testing.assert_array_equal(large[0](np.ones(3))[0], np.full(3, 2.0))
