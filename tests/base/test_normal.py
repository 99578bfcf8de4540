"""The normal law between two limits against scipy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from covocp.base.normal import inside, margin, quantile, two_sided

PROBABILITIES = [0.1, 0.5, 0.9, 0.99, 0.9973, 1 - 1e-6, 1 - 1e-9]


@pytest.mark.parametrize("p", PROBABILITIES)
def test_room_vanishes_where_the_two_tails_are_the_risk(p):
    law, w, middle = two_sided(p), 2.5, 40.0
    y, s = ca.SX.sym("y"), ca.SX.sym("s")
    value = law.room(y, s, middle - w, middle + w)
    room = ca.Function("room", [y, s], [value, ca.gradient(value, ca.vertcat(y, s))])
    assert law.two == pytest.approx(norm.isf((1 - p) / 2), rel=1e-9)
    for h in law.two + np.array([1e-3, 0.03, 0.3, 1.0, 4.0, 100.0]):
        own = w / h
        d = brentq(lambda d, own=own: norm.sf((w - d) / own) + norm.sf((w + d) / own) - (1 - p), 0.0, w + 10 * own)
        for sign in (1.0, -1.0):
            at, slope = room(middle + sign * d, own)
            assert float(at) == pytest.approx(0.0, abs=1e-7 * w)
            assert np.sign(float(slope[0])) == -sign
            assert float(slope[1]) < 0 or p <= 0.5
    assert float(room(middle, 1.001 * w / law.two)[0]) < 0 < float(room(middle, 0.999 * w / law.two)[0])
    assert float(room(middle, 1e3 * w)[0]) < -w


def test_room_has_slopes_where_nothing_scatters_and_is_that_of_the_nominal():
    y, s = ca.SX.sym("y"), ca.SX.sym("s")
    value = two_sided(0.99).room(y, s, -2.0, 2.0)
    both = ca.vertcat(y, s)
    parts = ca.Function("parts", [y, s], [value, ca.gradient(value, both), ca.hessian(value, both)[0]])
    for at, expected in ((0.0, 1.0), (2.0, 0.0), (-2.0, 0.0), (3.0, -1.25)):
        numbers = [v.full() for v in parts(at, 1e-50)]
        assert all(np.isfinite(v).all() for v in numbers)
        assert numbers[0] == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("p", PROBABILITIES)
def test_margin_leaves_just_the_probability(p):
    y, s = np.array([0.0, 0.4, -1.9, 3.0]), np.array([0.5, 1e-3, 1.0, 0.2])
    for lower, upper in ((-2.0, 2.0), (-np.inf, 2.0), (-2.0, np.inf)):
        rooms = margin(y, s, lower, upper, p)
        low, high = lower + rooms, upper - rooms
        assert 1 - norm.cdf((high - y) / s) + norm.cdf((low - y) / s) == pytest.approx(1 - p, rel=1e-6)
    assert quantile(p) == pytest.approx(norm.isf(1 - p), rel=1e-9, abs=1e-12)


def test_probability_between_limits():
    y, s = np.array([0.0, 0.7, 1.0, 2.0]), np.array([0.3, 1.1, 0.0, 0.0])
    expected = [norm.cdf(1 / 0.3) - norm.cdf(-1 / 0.3), norm.cdf(0.3 / 1.1) - norm.cdf(-1.7 / 1.1), 1.0, 0.0]
    assert inside(y, s, -1.0, 1.0) == pytest.approx(expected, rel=1e-12)
