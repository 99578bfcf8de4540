"""A control interval, its parts, and the same passed backward."""

import casadi as ca
import numpy as np
import pytest

from covocp.models import unknown_lag
from covocp.statement.interval import SIDE, Interval, one_sided

WHOLE = Interval(start=1.0, end=3.0, s=0.2, ds=0.5, duration=10.0, parameters=7.0, reading=1.0)


def test_control_and_time_inside():
    assert WHOLE.control(0.25) == 1.5
    assert WHOLE.time(0.5) == pytest.approx(4.5)
    assert WHOLE.h == 5.0


def test_times_at_the_ends_are_limits_from_inside():
    """A rate that jumps at a node is seen from the interval's own side."""
    assert 2.0 < WHOLE.time(0.0) < 2.0 + 1e-8
    assert 7.0 - 1e-8 < WHOLE.time(1.0) < 7.0
    assert one_sided(0.3) == 0.3
    assert (one_sided(0.0), one_sided(1.0)) == (SIDE, 1.0 - SIDE)


def test_a_part_is_an_interval_of_its_own():
    part = WHOLE.part(0.25, 0.75)
    assert (part.start, part.end) == (1.5, 2.5)
    assert (part.s, part.ds) == pytest.approx((0.325, 0.25))
    assert part.control(0.5) == WHOLE.control(0.5)
    assert part.time(0.5) == pytest.approx(WHOLE.time(0.5))
    assert (part.duration, part.parameters) == (10.0, 7.0)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_the_controls_at_the_ends_are_those_at_the_ends(kind):
    """Not the one at the start and what is between, which is one by rounding; and the whole of it is itself."""
    interval = Interval(*(kind.sym(name) for name in Interval._fields))
    assert interval.control(0.0) is interval.start
    assert interval.control(1.0) is interval.end
    assert interval.part(0.0, 1.0) is interval
    last = interval.part(0.5, 1.0)
    assert last.end is interval.end
    assert ca.is_equal(last.s, interval.s + 0.5 * interval.ds, 4)


def test_turned_round_twice_it_is_itself():
    back = WHOLE.turned()
    assert back.control(0.25) == WHOLE.control(0.75)
    assert back.time(0.25) == pytest.approx(WHOLE.time(0.75))
    assert back.turned() == pytest.approx(WHOLE)


def test_substeps_are_the_parts_side_by_side():
    columns = Interval(*(ca.DM(np.array([[a, a + 1.0]])) for a in WHOLE))
    fine = columns.substeps(4)
    for k in range(2):
        for j in range(4):
            expected = columns.columns(k).part(j / 4, (j + 1) / 4)
            found = fine.columns(4 * k + j)
            assert [float(v) for v in found] == pytest.approx([float(v) for v in expected], rel=1e-14)
    assert columns.substeps(1) is columns


def test_the_arguments_of_the_model_have_its_order():
    statement = unknown_lag.problem().statement()
    x, e = ca.SX.sym("x", statement.nx), ca.SX.sym("e", statement.ne)
    sizes = [argument.shape[0] for argument in Interval.symbols(statement).at(0.5, x, e)]
    assert sizes == [statement.rates.size1_in(k) for k in range(6)]
