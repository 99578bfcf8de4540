"""The vortex lattice against wing theory: elliptic wings, lifting line, Biot and Savart by quadrature, Munk."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

import covocp as co
from covocp.models.formation import vortex_lattice as vlm

SPAN, AREA, LIFT, CORE = 59.64, 511.0, 0.654, 0.035
PLANFORM = vlm.Trapezoid(span=SPAN, area=AREA, taper=0.30, sweep=np.deg2rad(37.5))
WING = vlm.lattice(PLANFORM)
ALONE = vlm.trimmed(WING, LIFT)
WAKE = vlm.wake(WING, ALONE.circulation, CORE * SPAN)


class Ellipse:
    """A planform of elliptic chord about a straight quarter-chord line."""

    def __init__(self, span, area):
        self.span, self.area = span, area

    def chord(self, y):
        return 4 * self.area / (np.pi * self.span) * np.sqrt(np.maximum(1 - (2 * y / self.span) ** 2, 0.0))

    def quarter_chord(self, y):
        return np.zeros_like(y)


class Disc(Ellipse):
    """The same about a straight line at half the chord: a circle where span and area are those of one."""

    def quarter_chord(self, y):
        return -self.chord(y) / 4


def efficiency(wing, lift=LIFT):
    return lift**2 / (np.pi * wing.span**2 / wing.area) / vlm.trimmed(wing, lift).drag


def glauert(aspect, terms=60):
    """Lift slope of a rectangular wing by the lifting line's series, collocated in the angle."""
    angle = np.arange(1, terms + 1) * np.pi / (2 * terms)
    n = 2 * np.arange(1, terms + 1) - 1
    mu = 2 * np.pi / (4 * aspect)
    system = np.sin(np.outer(angle, n)) * (np.sin(angle)[:, None] + mu * n)
    return np.pi * aspect * np.linalg.solve(system, mu * np.sin(angle))[0]


def by_quadrature(corner_left, corner_right, point):
    """Upwash of a horseshoe of unit circulation by quadrature of the law of Biot and Savart."""
    (xa, ya), (xb, yb), (x, y) = corner_left, corner_right, point

    def of_bound(s):
        dx, dy = x - xa - s * (xb - xa), y - ya - s * (yb - ya)
        return ((xb - xa) * dy - (yb - ya) * dx) / np.hypot(dx, dy) ** 3

    def of_line(at_x, at_y):
        dx, dy = x - at_x, y - at_y
        ends = [0.0, *(max(dx + k * abs(dy), 0.0) for k in (-30, -3, 3, 30)), np.inf]
        return sum(quad(lambda t: dy / np.hypot(dx - t, dy) ** 3, *piece, limit=500)[0] for piece in pairwise(ends))

    bound = quad(of_bound, 0, 1, limit=500)[0]
    return (bound + of_line(xb, yb) - of_line(xa, ya)) / (4 * np.pi)


# Wings alone


def test_slope_efficiency_and_drag_of_the_transport():
    assert pytest.approx(4.016, abs=5e-4) == WING.lift_slope
    assert efficiency(WING) == pytest.approx(0.990, abs=5e-4)
    assert ALONE.drag == pytest.approx(0.01976, abs=5e-6)
    assert ALONE.incidence == pytest.approx(LIFT / WING.lift_slope)
    assert vlm.lift(WING, ALONE.circulation) == pytest.approx(LIFT)
    assert ALONE.rolling_moment == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("aspect", [20.0, 100.0, 400.0])
def test_an_elliptic_wing_has_the_drag_of_lifting_line_theory_and_its_lift_slope(aspect):
    """What is left is the chord over the span, of which the lifting line knows nothing."""
    wing = vlm.lattice(Ellipse(10.0, 100.0 / aspect), spanwise=80)
    drag = vlm.trimmed(wing, 0.5).drag
    assert drag == pytest.approx(0.25 / (np.pi * aspect), rel=0.25 / aspect)
    assert wing.lift_slope == pytest.approx(2 * np.pi * aspect / (aspect + 2), rel=1 / aspect)


def test_an_elliptic_circulation_has_a_uniform_downwash():
    """w_T = -2 C_L/(pi AR) = -gamma_0/b, everywhere; cosine spacing makes it exact but for the sine of an angle."""
    elliptic = np.sqrt(1 - (2 * WING.stations / SPAN) ** 2)
    assert np.allclose(WING.far_field @ elliptic, -1 / SPAN, rtol=0, atol=0.02 / SPAN)
    lift = vlm.lift(WING, elliptic)
    assert vlm.induced_drag(WING, elliptic) == pytest.approx(lift**2 / (np.pi * SPAN**2 / AREA), rel=2e-3)


@pytest.mark.parametrize("aspect", [50.0, 200.0])
def test_a_slender_rectangular_wing_is_a_lifting_line(aspect):
    wing = vlm.lattice(vlm.Trapezoid(span=aspect, area=aspect), spanwise=200)
    assert wing.lift_slope == pytest.approx(glauert(aspect), rel=0.5 / aspect)


def test_a_circular_wing_has_the_lift_of_lifting_surface_theory():
    """P. F. Jordan, Exact solutions for lifting surfaces, AIAA J. 11(8), 1973: 1.790 for 4/pi of aspect ratio."""
    wing = vlm.lattice(Disc(2.0, np.pi), spanwise=80, chordwise=16)
    assert wing.lift_slope == pytest.approx(1.790, rel=2e-3)


@pytest.mark.parametrize(("aspect", "sweep", "taper"), [(12, 0, 0.4), (6, 30, 0.5), (7, 37.5, 0.3)])
def test_lift_slope_is_that_of_helmbold_and_diederich(aspect, sweep, taper):
    """A formula for tapered wings, good to 5 %."""
    tangent = np.tan(np.deg2rad(sweep)) - (1 - taper) / (1 + taper) / aspect
    expected = 2 * np.pi * aspect / (2 + np.sqrt(aspect**2 * (1 + tangent**2) + 4))
    wing = vlm.lattice(vlm.Trapezoid(span=10.0, area=100.0 / aspect, taper=taper, sweep=np.deg2rad(sweep)))
    assert wing.lift_slope == pytest.approx(expected, rel=0.05)


def test_the_influence_of_a_horseshoe_is_that_of_biot_and_savart():
    """Two strips of one panel: the matrix from the response, and the same by quadrature."""
    wing = vlm.lattice(PLANFORM, spanwise=2, chordwise=1)
    corners = [(float(PLANFORM.quarter_chord(y)), y) for y in np.asarray(wing.edges)]
    points = [(float(PLANFORM.quarter_chord(y) + 0.5 * PLANFORM.chord(y)), y) for y in np.asarray(wing.stations)]
    expected = [[by_quadrature(corners[j], corners[j + 1], p) for j in range(2)] for p in points]
    assert np.allclose(-np.linalg.inv(wing.response), expected, rtol=1e-7)


def test_finer_lattices_converge():
    """Errors against a fine one fall at least as the number of panels of a direction grows."""
    sizes = [(20, 2), (40, 4), (80, 8), (160, 16)]
    wings = [vlm.lattice(PLANFORM, spanwise=n, chordwise=m) for n, m in sizes]
    values = np.array([(w.lift_slope, efficiency(w)) for w in wings])
    changes = np.abs(np.diff(values, axis=0))
    assert (changes[1:] < 0.7 * changes[:-1]).all()
    assert (changes[1] < 2e-3 * values[-1]).all()


def test_circulation_is_linear_and_an_even_upwash_is_incidence():
    w = np.random.default_rng(0).normal(size=(5, 40))
    together = vlm.circulation(WING, 0.1, w)
    apart = vlm.circulation(WING, 0.3, 0.0) / 3 + 2 * vlm.circulation(WING, 0.0, w / 2)
    assert np.allclose(together, apart, rtol=0, atol=1e-12)
    assert np.allclose(vlm.circulation(WING, 0.1), vlm.circulation(WING, 0.0, 0.1))


def test_an_even_upwash_tilts_the_lift():
    flight = vlm.trimmed(WING, LIFT, 0.03)
    assert flight.incidence == pytest.approx(ALONE.incidence - 0.03)
    assert np.allclose(flight.circulation, ALONE.circulation)
    assert flight.drag == pytest.approx(ALONE.drag - LIFT * 0.03)


def test_a_linear_upwash_rolls_away_from_where_it_lifts():
    flight = vlm.trimmed(WING, LIFT, 0.01 * WING.stations / SPAN)
    assert flight.rolling_moment < 0
    assert flight.drag < ALONE.drag + 1e-4


# Wakes


def test_a_wake_is_that_of_its_horseshoes():
    """Without core and in its own plane it induces what the Trefftz plane has."""
    lines = vlm.wake(WING, ALONE.circulation, 0.0)
    assert lines.strengths.sum() == pytest.approx(0.0, abs=1e-12)
    assert -lines.lines @ lines.strengths == pytest.approx(-ALONE.circulation @ WING.widths)
    assert np.allclose(vlm.upwash(lines, WING.stations, 0.0), WING.far_field @ ALONE.circulation)


def test_far_downstream_a_horseshoe_is_two_infinite_lines():
    """What is missing upstream and the bound piece leave (distance/downstream)^2."""
    half = vlm.Wake(lines=np.array([-20.0, 20.0]), strengths=np.array([-1.0, 1.0]), core=0.0)
    y, downstream = 33.0, 3000.0
    whole = by_quadrature((0.0, -20.0), (0.0, 20.0), (downstream, y))
    assert whole == pytest.approx(float(vlm.upwash(half, y, 0.0)), rel=(53 / downstream) ** 2)


def test_swirl_is_greatest_at_the_core():
    line = vlm.Wake(lines=np.array([0.0]), strengths=np.array([2.0]), core=1.5)
    y = np.linspace(0.1, 5, 491)
    w = vlm.upwash(line, y, 0.0)
    assert y[np.argmax(w)] == pytest.approx(1.5)
    assert w.max() == pytest.approx(2.0 / (4 * np.pi * 1.5))
    assert np.allclose(w, 2.0 / (2 * np.pi) * y / (y**2 + 1.5**2))


@pytest.mark.parametrize(("y", "height"), [(54.84, 0.0), (70.0, 3.0), (40.0, 8.0), (59.64, -5.0)])
def test_mutual_drag_is_mutual(y, height):
    """Munk: two wings of any circulation disturb one another with the same drag, in whatever order they fly."""
    first = vlm.lattice(PLANFORM, spanwise=160)
    other = vlm.lattice(Ellipse(40.0, 300.0), spanwise=160)
    gammas = [vlm.trimmed(first, 0.6).circulation, vlm.trimmed(other, 0.4, 0.02 * other.stations / 40.0).circulation]

    def drag(leader, gamma, follower, own, side, above):
        lines = vlm.wake(leader, gamma, 2.0)
        w = vlm.upwash(lines, side + follower.stations, above)
        alone = vlm.induced_drag(follower, own)
        return (vlm.induced_drag(follower, own, w) - alone) * follower.area

    behind = drag(first, gammas[0], other, gammas[1], y, height)
    ahead = drag(other, gammas[1], first, gammas[0], -y, -height)
    scale = abs(behind) + 1e-3 * AREA * ALONE.drag
    assert behind == pytest.approx(ahead, abs=2e-3 * scale)


def test_two_vortices_have_the_lift_of_the_wing():
    pair = vlm.rolled_up(WING, ALONE.circulation, CORE * SPAN)
    assert 2 / AREA * pair.strengths @ pair.lines == pytest.approx(LIFT)
    assert np.pi / 4 * SPAN == pytest.approx(pair.lines[1] - pair.lines[0], rel=0.06)  # elliptic: pi/4 of the span


# In formation


def test_a_follower_at_the_best_place():
    flight = vlm.following(WING, WAKE, LIFT, 0.92 * SPAN, 0.0)
    assert flight.drag == pytest.approx(0.00807, rel=0.02)
    assert flight.drag / ALONE.drag - 1 == pytest.approx(-0.59, abs=5e-3)
    assert flight.rolling_moment == pytest.approx(0.0088, rel=0.02)
    assert vlm.following(WING, WAKE, LIFT, SPAN, 0.0).rolling_moment == pytest.approx(0.0089, rel=0.02)


def test_curvature_at_the_best_place_over_a_metre():
    """The published 0.86 and 5.2 counts/m^2 are second differences: within the core the drag is not quadratic in h."""

    def drag(y, h):
        return vlm.following(WING, WAKE, LIFT, y, h).drag / 1e-4

    y = 0.92 * SPAN
    centre = drag(y, 0.0)
    assert drag(y - 1, 0.0) - 2 * centre + drag(y + 1, 0.0) == pytest.approx(0.86, rel=0.02)
    assert drag(y, -1.0) - 2 * centre + drag(y, 1.0) == pytest.approx(5.2, rel=0.02)


@pytest.mark.parametrize(("core", "benefit"), [(0.02, -0.65), (0.035, -0.59), (0.05, -0.54)])
def test_the_benefit_depends_on_the_core(core, benefit):
    lines = vlm.wake(WING, ALONE.circulation, core * SPAN)
    y = np.linspace(0.85, 1.0, 61) * SPAN
    drag = vlm.following(WING, lines, LIFT, y, 0.0).drag
    assert drag.min() / ALONE.drag - 1 == pytest.approx(benefit, abs=0.01 * abs(benefit) + 0.005)


def test_a_rolled_up_wake_helps_more_and_further_in():
    lines = vlm.rolled_up(WING, ALONE.circulation, CORE * SPAN)
    y = np.linspace(0.8, 1.0, 201) * SPAN
    drag = vlm.following(WING, lines, LIFT, y, 0.0).drag
    assert drag.min() / ALONE.drag - 1 == pytest.approx(-0.74, abs=0.01)
    assert y[np.argmin(drag)] / SPAN == pytest.approx(0.88, abs=0.01)


def test_the_map_is_symmetric():
    y, h = np.linspace(20.0, 90.0, 8)[:, None], np.array([0.0, 1.0, 4.0, 15.0])
    right, below, left = (vlm.following(WING, WAKE, LIFT, s * y, t * h) for s, t in ((1, 1), (1, -1), (-1, 1)))
    assert right.drag.shape == right.rolling_moment.shape == (8, 4)
    assert right.circulation.shape == (8, 4, 40)
    assert np.allclose(right.drag, below.drag, rtol=0, atol=1e-15)
    assert np.allclose(right.rolling_moment, below.rolling_moment, rtol=0, atol=1e-15)
    assert np.allclose(right.drag, left.drag, rtol=0, atol=1e-14)
    assert np.allclose(right.rolling_moment, -left.rolling_moment, rtol=0, atol=1e-14)
    assert np.allclose(vlm.lift(WING, right.circulation), LIFT)


def test_a_follower_far_away_flies_alone():
    """The upwash of a pair of vortices falls as the square of the distance."""
    gains = ALONE.drag - vlm.following(WING, WAKE, LIFT, np.array([1e3, 1e4]), 0.0).drag
    assert gains[0] / gains[1] == pytest.approx(100.0, rel=0.02)
    assert gains[1] < 1e-4 * ALONE.drag


def test_the_upwash_comes_from_the_side_of_the_leader():
    """The wing that is nearer to the leader is lifted: a follower on the right rolls to the right."""
    assert vlm.following(WING, WAKE, LIFT, 0.95 * SPAN, 0.0).rolling_moment > 0
    assert vlm.following(WING, WAKE, LIFT, -0.95 * SPAN, 0.0).rolling_moment < 0


# What does not apply


def test_results_are_read_only():
    for array in (WING.response, WING.edges, WING.stations, WING.far_field, WAKE.lines, WAKE.strengths):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


@pytest.mark.parametrize(
    "data",
    [
        {"span": 0.0},
        {"span": np.nan},
        {"area": -1.0},
        {"taper": 0.0},
        {"taper": 1.1},
        {"sweep": 37.5},
        {"sweep": "37"},
    ],
)
def test_an_impossible_planform_is_refused_by_name(data):
    with pytest.raises(co.ProblemError, match=next(iter(data))):
        vlm.Trapezoid(**({"span": 10.0, "area": 10.0} | data))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: vlm.lattice(PLANFORM, spanwise=41), "even number"),
        (lambda: vlm.lattice(PLANFORM, spanwise=0), "spanwise"),
        (lambda: vlm.lattice(PLANFORM, chordwise=1.5), "chordwise"),
        (lambda: vlm.circulation(WING, 0.1, np.zeros(39)), r"\(\.\.\., 40\)"),
        (lambda: vlm.induced_drag(WING, ALONE.circulation, np.zeros(39)), r"\(\.\.\., 40\)"),
        (lambda: vlm.trimmed(WING, np.inf), "lift_coefficient"),
        (lambda: vlm.wake(WING, ALONE.circulation, -1.0), "core"),
        (lambda: vlm.wake(WING, ALONE.circulation[1:], 1.0), r"\(40,\)"),
        (lambda: vlm.rolled_up(WING, np.zeros(40), 1.0), "middle"),
        (lambda: vlm.following(WING, WAKE, LIFT, np.zeros(3), np.zeros(2)), "broadcast"),
    ],
)
def test_what_does_not_fit_is_refused(call, words):
    with pytest.raises(co.ProblemError, match=words):
        call()
