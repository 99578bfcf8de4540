"""Operations by name, and slopes by several symbols in one sweep."""

import operator

import casadi as ca
import numpy as np
import pytest

from covocp.base.buffered import Buffered
from covocp.base.expressions import minus, plus, slopes_by, times, trial_values


@pytest.mark.parametrize("symbolic", [ca.SX, ca.MX])
def test_slopes_by_several_symbols_are_the_derivatives_by_each(symbolic):
    """a' S a / 2 b + sin(c) . a: by a: b S a + sin(c), by b: a' S a / 2, by c: cos(c) a, by what is not there: zero."""
    a, b, c, none = symbolic.sym("a", 2), symbolic.sym("b"), symbolic.sym("c", 2, 1), symbolic.sym("d", 2, 3)
    S = np.array([[2.0, 0.5], [0.5, 1.0]])
    value = 0.5 * ca.bilin(ca.DM(S), a, a) * b + ca.dot(ca.sin(c), a)
    slopes = slopes_by(value, (a, none, b, c))
    assert [slope.shape for slope in slopes] == [(2, 1), (2, 3), (1, 1), (2, 1)]
    function = ca.Function("slopes", [a, b, c, none], slopes)
    at, factor, angle = np.array([0.3, -1.2]), 1.7, np.array([0.4, 2.0])
    found = [np.asarray(v.full()) for v in function(at, factor, angle, np.zeros((2, 3)))]
    expected = [factor * S @ at + np.sin(angle), np.zeros((2, 3)), 0.5 * at @ S @ at, np.cos(angle) * at]
    for numbers, reference in zip(found, expected, strict=True):
        np.testing.assert_allclose(numbers.squeeze(), reference, rtol=1e-14)


OPERATIONS = {plus: operator.add, minus: operator.sub, times: operator.mul}


@pytest.mark.parametrize("combined", OPERATIONS, ids=lambda f: OPERATIONS[f].__name__)
@pytest.mark.parametrize("symbolic", [ca.SX, ca.MX])
def test_operations_by_name_are_those_of_the_operators(symbolic, combined):
    """Of expressions of the same shape, of a number and a matrix, sparse ones, arrays, on either side."""
    a, b, c = symbolic.sym("a", 2, 3), symbolic.sym("b", 2, 3), symbolic.sym("c")
    sparse = symbolic.sym("s", ca.Sparsity.triplet(2, 3, [0, 1], [1, 2]))
    others = [
        b,
        c,
        sparse,
        2,
        0.5,
        0.0,
        np.float64(0.3),
        ca.DM([[1.0, 2.0, 3.0], [0.0, -1.0, 4.0]]),
        np.eye(2, 3),
        True,
    ]
    rng = np.random.default_rng(0)
    given = [rng.normal(size=v.nnz()) for v in (a, b, c, sparse)]
    for other in others:
        for pair in ((a, other), (other, a)):
            found, known = combined(*pair), OPERATIONS[combined](*pair)
            assert type(found) is type(known)
            function = ca.Function("both", [a, b, c, sparse], [found, known])
            assert function.sparsity_out(0) == function.sparsity_out(1)
            results = Buffered(function)(*given)
            np.testing.assert_array_equal(*results)
    assert combined(3.0, 4) == OPERATIONS[combined](3.0, 4)
    with pytest.raises(RuntimeError, match="imension"):
        combined(a, symbolic.sym("d", 3, 2))


def test_no_small_multiples_of_trial_values_add_up_to_another():
    """Else matrices and rates that differ could be taken for the same where values of their symbols happen to meet."""
    values = trial_values(40)
    assert ((values >= 0.5) & (values <= 1.5)).all()
    np.testing.assert_array_equal(trial_values(7, 5), values[5:12])
    multiples = np.array([-2, -1, 1, 2])
    sums = (multiples[:, None] * values)[:, None, :, None] + (multiples[:, None] * values)[None, :, None, :]
    i, j = np.triu_indices(values.size, 1)
    pairs = np.sort(np.append(sums[:, :, i, j].ravel(), values))
    assert np.diff(pairs).min() > 1e-9
