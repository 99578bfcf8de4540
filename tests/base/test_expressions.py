"""Slopes by several symbols in one sweep."""

import casadi as ca
import numpy as np
import pytest

from covocp.base.expressions import slopes_by


@pytest.mark.parametrize("symbolic", [ca.SX, ca.MX])
def test_slopes_by_several_symbols_are_the_derivatives_by_each(symbolic):
    """a' S a / 2 b + sin(c) . a: by a: b S a + sin(c), by b: a' S a / 2, by c: cos(c) a, by what is not there: zero."""
    a, b, c, none = symbolic.sym("a", 2), symbolic.sym("b"), symbolic.sym("c", 2, 1), symbolic.sym("d", 2, 3)
    S = np.array([[2.0, 0.5], [0.5, 1.0]])
    value = 0.5 * ca.bilin(ca.DM(S), a, a) * b + ca.dot(ca.sin(c), a)
    slopes = slopes_by(value, (a, none, b, c))
    assert [slope.shape for slope in slopes] == [(2, 1), (2, 3), (1, 1), (2, 1)]
    function = ca.Function("slopes", [a, b, c, none], slopes)
    at, times, angle = np.array([0.3, -1.2]), 1.7, np.array([0.4, 2.0])
    found = [np.asarray(v.full()) for v in function(at, times, angle, np.zeros((2, 3)))]
    expected = [times * S @ at + np.sin(angle), np.zeros((2, 3)), 0.5 * at @ S @ at, np.cos(angle) * at]
    for numbers, reference in zip(found, expected, strict=True):
        np.testing.assert_allclose(numbers.squeeze(), reference, rtol=1e-14)
