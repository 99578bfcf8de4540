"""Functions called through their buffers: the numbers of CasADi's own calls."""

import casadi as ca
import numpy as np
import pytest

from covocp.base.buffered import Buffered, swept


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
