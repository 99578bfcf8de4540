"""The laws of attitude seeking: the filter against matrices, guidance between zones, gaps, C code, wrong arguments."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest
from attitude_programs import Case
from compiled import compile_function
from exports import QUICK
from hypothesis import given, settings
from hypothesis import strategies as st

import covocp as co
from covocp import ProblemError
from covocp.blocks import attitude_seeking, so3
from covocp.blocks.attitude_filter import turn_between

ZONES = [((1, 0, 0), (0.3, 1, -0.5), 20.0, "exclusion"), ((0, 1, 0), (-1, 0, 0), 20.0, "inclusion")]
LAWS = {
    "unconstrained": lambda **given: attitude_seeking.unconstrained(**given),
    "projected": lambda **given: attitude_seeking.projected(ZONES, **given),
    "constrained": lambda **given: attitude_seeking.constrained(ZONES, **given),
}
QUIET = {"excitation": 0.0}


def random_attitudes(seed, count, size=0.1):
    """Quaternions of a random walk."""
    generator = np.random.default_rng(seed)
    q = so3.to_quaternion(so3.principal(3, 1.5))
    found = []
    for _ in range(count):
        q = so3.quaternion_step(q, size * generator.standard_normal(3))
        q = q / np.linalg.norm(q)
        found.append(q)
    return np.array(found)


def fed(law, attitudes, powers, every=1, memory=None):
    """The memory after readings, each `every`-th one a guidance step."""
    memory = law.initial() if memory is None else memory
    for k, (q, power) in enumerate(zip(attitudes, powers, strict=True), start=1):
        memory = (law.update if k % every == 0 else law.read)(memory, q, power)
    return memory


def rotation_vector(before, after):
    return so3.log(so3.from_quaternion(after) @ so3.from_quaternion(before).T)


def matrices(attitudes, powers, *, window, spacing, every, noise, drift, motion):
    """The filter of section 4 by matrices, from its words; newest reading last."""
    b, P, last = np.zeros(3), np.eye(3), None
    for k in range(every - 1, len(powers), every):
        moved = 0.0 if last is None else np.linalg.norm(rotation_vector(attitudes[last], attitudes[k]))
        P, last = P + (drift + motion * moved**2) * np.eye(3), k
        past = [k - spacing * j for j in range(1, window + 1) if k >= spacing * j]
        if past:
            H = np.array([rotation_vector(attitudes[i], attitudes[k]) for i in past])
            y = powers[k] - powers[past]
            case = Case(H, noise * (np.eye(len(y)) + 1.0), P, b, y - H @ b, None, None, 1.0, 1.0, 1.0)
            b, P = case.estimate, case.spread(case.gain)
    return b, P


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("spacing", [1, 2])
def test_filter_is_that_of_the_matrices(every, spacing):
    attitudes, powers = random_attitudes(0, 43), np.random.default_rng(1).standard_normal(43)
    law = attitude_seeking.unconstrained(window=4, spacing=spacing)
    found = law.estimate(fed(law, attitudes, powers, every))
    b, P = matrices(attitudes, powers, window=4, spacing=spacing, every=every, noise=0.0025, drift=0.02, motion=16.0)
    np.testing.assert_allclose(found.gradient, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.covariance, P, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.deviation**2, np.diag(P), rtol=1e-9)


def test_gradient_of_a_linear_function_is_found():
    """J = 3 + b'phi without noise, phi from the newest attitude: after some readings b is known."""
    attitudes, b = random_attitudes(2, 12, 0.02), np.array([1.0, -2.0, 0.5])
    law = attitude_seeking.unconstrained(noise=1e-8, prior_covariance=1e4, spacing=1, drift=0.0, motion_drift=0.0)
    memory = law.initial()
    for q in attitudes[:-1]:
        memory = law.read(memory, q, 3.0 + b @ rotation_vector(attitudes[-1], q))
    memory = law.update(memory, attitudes[-1], 3.0)
    np.testing.assert_allclose(law.estimate(memory).gradient, b, atol=1e-6)


def test_covariance_of_the_constrained_law_is_that_of_the_gain():
    """One update from the prior: b and P(K) of theorem 2 with H, r and S written out."""
    attitudes = random_attitudes(3, 9, 0.2)
    powers = np.random.default_rng(4).standard_normal(9)
    given = {"window": 4, "spacing": 2, "drift": 0.0, "motion_drift": 0.0, "prior": [1.0, -2.0, 0.5]}
    law = LAWS["constrained"](**given)
    memory = law.initial()
    for q, power in zip(attitudes[:-1], powers[:-1], strict=True):
        memory = law.read(memory, q, power)
    found = law.estimate(law.update(memory, attitudes[-1], powers[-1]))
    H = np.array([rotation_vector(attitudes[i], attitudes[8]) for i in (6, 4, 2, 0)])
    before, y = np.array([1.0, -2.0, 0.5]), powers[8] - powers[[6, 4, 2, 0]]
    case = Case(H, 0.0025 * (np.eye(4) + 1.0), np.eye(3), before, y - H @ before, None, None, 0.05, 1e5, 0.25)
    e = found.gradient - case.estimate
    assert np.linalg.norm(e) > 0.1
    gain = case.gain + np.outer(e, np.linalg.solve(case.innovation, case.residual)) / case.surprise
    np.testing.assert_allclose(found.covariance, case.spread(gain), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(found.gradient, found.direction, rtol=1e-9)


@pytest.mark.parametrize("name", LAWS)
def test_step_is_along_the_direction_with_the_excitation(name):
    """exp(-d) C with d = kappa b + a_i sin(2 pi t / T_i + phase_i) at the time of the guidance step."""
    law = LAWS[name](kappa=0.03)
    attitudes = random_attitudes(5, 15)
    memory = fed(law, attitudes, np.random.default_rng(6).standard_normal(15), 5)
    found, t = law.estimate(memory), 3 * 0.5
    wave = 0.04 * np.sin(2 * np.pi * t / np.array([8.0, 6.0, 5.0]) + np.array([0.0, 2.1, 4.2]))
    d = rotation_vector(found.attitude, law.step(memory))
    np.testing.assert_allclose(d, 0.03 * found.direction + wave, atol=1e-12)
    np.testing.assert_allclose(found.attitude, attitudes[-1], atol=1e-15)
    np.testing.assert_array_equal(law.step(law.initial(attitudes[0])), attitudes[0])  # nothing was decided


@pytest.mark.parametrize("name", ["projected", "constrained"])
@pytest.mark.parametrize("margin", [0.0, 4.0])
def test_steps_keep_the_linear_zones(name, margin):
    law = LAWS[name](margin=margin, **QUIET)
    attitudes = random_attitudes(7, 40, 0.02)
    zones = attitude_seeking.zones_of(ZONES, margin)
    memory, seen = law.initial(), 0
    for q, power in zip(attitudes, 5.0 * np.random.default_rng(8).standard_normal(40), strict=True):
        memory = law.update(memory, q, power)
        rows = attitude_seeking.zone_rows(so3.from_quaternion(q), zones)
        d = 0.05 * law.estimate(memory).direction
        left = rows.matrix @ d - rows.bounds.ravel()
        if (rows.bounds <= 0).all():  # then no step at all is one that fits
            seen += 1
            assert left.min() >= -1e-9
        if name == "constrained":
            assert np.linalg.norm(d) <= 0.25 * (1 + 1e-9)
    assert seen > 10


def test_step_bounds():
    attitudes, powers = random_attitudes(9, 30), 5.0 * np.random.default_rng(10).standard_normal(30)
    free = attitude_seeking.unconstrained(largest_step=None, **QUIET)
    memory = fed(free, attitudes, powers)
    length = 0.05 * np.linalg.norm(free.estimate(memory).direction)
    short = attitude_seeking.unconstrained(largest_step=0.5 * length, **QUIET)
    long = attitude_seeking.unconstrained(smallest_step=2.0 * length, largest_step=None, **QUIET)
    for law, expected in ((short, 0.5 * length), (long, 2.0 * length)):
        d = 0.05 * law.estimate(fed(law, attitudes, powers)).direction
        assert np.linalg.norm(d) == pytest.approx(expected, rel=1e-9)
        assert np.linalg.norm(np.cross(d, free.estimate(memory).direction)) == pytest.approx(0.0, abs=1e-9)


def test_low_pass():
    """f + (1 - e^(-2 pi f_c T)) (b - f), (10)."""
    attitudes, powers = random_attitudes(11, 6), np.random.default_rng(12).standard_normal(6)
    plain, smooth = attitude_seeking.unconstrained(), attitude_seeking.unconstrained(cutoff=0.08)
    direction, memory, other = np.zeros(3), plain.initial(), smooth.initial()
    for q, power in zip(attitudes, powers, strict=True):
        memory, other = plain.update(memory, q, power), smooth.update(other, q, power)
        direction += (1 - np.exp(-2 * np.pi * 0.08 * 0.5)) * (plain.estimate(memory).direction - direction)
        np.testing.assert_allclose(smooth.estimate(other).direction, direction, rtol=1e-12)


def test_printed_settings():
    """Independent rows of variance 0.001, N = 5: the update by matrices."""
    attitudes, powers = random_attitudes(13, 11), np.random.default_rng(14).standard_normal(11)
    law = attitude_seeking.unconstrained(settings="printed")
    memory = law.initial()
    for q, power in zip(attitudes[:-1], powers[:-1], strict=True):
        memory = law.read(memory, q, power)
    found = law.estimate(law.update(memory, attitudes[-1], powers[-1]))
    H = np.array([rotation_vector(attitudes[i], attitudes[10]) for i in (8, 6, 4, 2, 0)])
    y = powers[10] - powers[[8, 6, 4, 2, 0]]
    case = Case(H, 0.001 * np.eye(5), 1.002 * np.eye(3), np.zeros(3), y, None, None, 0.15, 1.0, 1.0)
    np.testing.assert_allclose(found.gradient, case.estimate, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, case.covariance, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", LAWS)
def test_missing_readings_are_left_out_and_nothing_is_lost(name):
    """Readings with NaN among the others change nothing but the attitude; nor does the sign of a quaternion."""
    law = LAWS[name](spacing=1, window=4)
    attitudes, powers = random_attitudes(15, 8), np.random.default_rng(16).standard_normal(8)
    plain = fed(law, attitudes, powers, 4)
    memory = law.initial()
    for k, (q, power) in enumerate(zip(attitudes, powers, strict=True), start=1):
        memory = law.read(memory, attitudes[0], np.nan)
        memory = law.read(memory, [np.nan] * 4, 1.0)
        memory = (law.update if k % 4 == 0 else law.read)(memory, -q if k % 3 else q, power)
    for part in ("gradient", "covariance", "direction"):
        np.testing.assert_allclose(
            getattr(law.estimate(memory), part), getattr(law.estimate(plain), part), rtol=1e-10, atol=1e-12
        )
    blind = law.update(plain, attitudes[0], np.nan)  # a guidance step without power: a prediction
    moved = np.linalg.norm(rotation_vector(attitudes[-1], attitudes[0]))
    before, after = law.estimate(plain), law.estimate(blind)
    np.testing.assert_allclose(after.gradient, before.gradient, rtol=1e-12)
    np.testing.assert_allclose(after.covariance, before.covariance + (0.02 + 16.0 * moved**2) * np.eye(3), rtol=1e-9)
    np.testing.assert_allclose(after.attitude, attitudes[0], atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.5, 3.0, np.pi - 1e-9, np.pi])
def test_rotation_between_two_quaternions(angle):
    """Exact to half a turn, whichever sign the quaternions have."""
    before = random_attitudes(17, 1)[0]
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    after = so3.quaternion_step(before, angle * axis)
    for sign in (1.0, -1.0):
        vector = ca.evalf(turn_between(ca.SX(ca.DM(before)), ca.SX(ca.DM(sign * after)))).full().ravel()
        np.testing.assert_allclose(so3.exp(vector), so3.exp(angle * axis), atol=1e-14)
        assert np.linalg.norm(vector) == pytest.approx(angle, abs=1e-9)


def test_half_a_turn_in_the_window_is_left_out():
    law = attitude_seeking.unconstrained(spacing=1, window=3)
    attitudes, powers = random_attitudes(18, 4), np.array([1.0, 2.0, 3.0, 4.0])
    memory = law.initial()
    for q, power in zip(attitudes[:-1], powers, strict=False):
        memory = law.read(memory, q, power)
    far = law.read(law.initial(), so3.quaternion_step(attitudes[-1], [0.0, np.pi, 0.0]), 7.0)
    for q, power in zip(attitudes[:2], powers, strict=False):
        far = law.read(far, q, power)
    other = law.initial()
    for q, power in zip(attitudes[:2], powers, strict=False):
        other = law.read(other, q, power)
    found, expected = (law.estimate(law.update(m, attitudes[-1], 4.0)) for m in (far, other))
    np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-12)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-12)


READING = st.tuples(
    st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3),
    st.one_of(st.floats(-1e6, 1e6), st.sampled_from([0.0, np.nan])),
    st.booleans(),
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(readings=st.lists(READING, max_size=12), name=st.sampled_from(sorted(LAWS)))
def test_covariance_is_semidefinite_whatever_comes(readings, name):
    """Repeated attitudes, half turns, gaps, absurd powers: finite, semidefinite, steps that are attitudes."""
    law = SMALL[name]
    memory = law.initial()
    for vector, power, guides in readings:
        q = so3.to_quaternion(so3.exp(np.array(vector)))
        memory = (law.update if guides else law.read)(memory, q, power)
        values = np.linalg.eigvalsh(law.estimate(memory).covariance)
        assert np.isfinite(memory).all()
        assert values[0] >= -1e-12 * values[-1]
        assert np.linalg.norm(law.step(memory)) == pytest.approx(1.0, abs=1e-9)


SMALL = {name: make(window=3, spacing=1) for name, make in LAWS.items()}


def test_solver_and_enumeration_fly_alike():
    enumerated, solved = (attitude_seeking.projected(ZONES, method=method) for method in ("enumeration", "osqp"))
    attitudes, powers = random_attitudes(19, 30), np.random.default_rng(20).standard_normal(30)
    first, second = fed(enumerated, attitudes, powers, 5), fed(solved, attitudes, powers, 5)
    np.testing.assert_allclose(first, second, atol=1e-6)
    np.testing.assert_allclose(enumerated.step(first), solved.step(second), atol=1e-7)
    smooth = [attitude_seeking.projected(ZONES, method=m, cutoff=0.1) for m in ("enumeration", "osqp")]
    np.testing.assert_allclose(*(fed(law, attitudes, powers, 5) for law in smooth), atol=1e-6)


@pytest.mark.parametrize("power", [1e-12, 1e3])
def test_four_zones_are_flown_alike_in_every_unit_of_power(power):
    """The law knows no unit; with tolerances on b a step in mW was of 1e7 deg."""
    many = [*ZONES, ((0, 0, 1), (1, 0, 0), 20.0, "exclusion"), ((0, 0, 1), (0, 1, 0), 15.0, "exclusion")]
    paths = []
    for c in (1.0, power):
        units = {"noise": 0.0025 * c**2, "drift": 0.02 * c**2, "motion_drift": 16 * c**2, "prior_covariance": c**2}
        law = attitude_seeking.projected(many, kappa=0.05 / c, excitation=0.02, **units)
        q = so3.to_quaternion(so3.principal(2, 0.9) @ so3.principal(3, 1.4))
        memory, path = law.initial(q), []
        for _ in range(40):
            memory = law.update(memory, q, c * 4.0 * so3.from_quaternion(q)[2, 2])
            q = law.step(memory)
            path.append(q)
        paths.append(path)
    np.testing.assert_allclose(*paths, atol=1e-6)
    assert so3.from_quaternion(q)[2, 2] > 0.95  # and it arrives


def test_more_than_three_zones_go_to_the_solver():
    many = [*ZONES, ((0, 0, 1), (0, 0, -1), 30.0, "exclusion"), ((0, 0, 1), (0, 1, -1), 10.0, "exclusion")]
    law = attitude_seeking.projected(many, **QUIET)
    assert not law.update.is_a("SXFunction")
    memory = fed(law, random_attitudes(21, 10), np.random.default_rng(22).standard_normal(10), 5)
    found = law.estimate(memory)
    rows = attitude_seeking.zone_rows(so3.from_quaternion(found.attitude), attitude_seeking.zones_of(many))
    assert (rows.matrix @ (0.05 * found.direction) - rows.bounds.ravel()).min() >= -1e-7
    for make, name in ((attitude_seeking.constrained, "'zones'"), (attitude_seeking.projected, "'zones'")):
        with pytest.raises(ProblemError, match=name):
            make(many, **({"method": "enumeration"} if make is attitude_seeking.projected else {}))


def test_the_functions_copy_and_nest():
    law = LAWS["constrained"](window=3)
    memory = fed(law, random_attitudes(23, 12), np.random.default_rng(24).standard_normal(12), 5)
    q = random_attitudes(25, 1)[0]
    other = pickle.loads(pickle.dumps(law))
    np.testing.assert_array_equal(other.step(memory), law.step(memory))
    with pytest.raises(ProblemError, match="'attitude'"):
        other.update(memory, 2.0 * q, 1.0)
    assert law.update.is_a("SXFunction")
    new, desired = law.law()(memory, np.append(q, 2.0), 0.0)
    np.testing.assert_allclose(new.full().ravel(), law.update(memory, q, 2.0), atol=1e-13)
    np.testing.assert_allclose(desired.full().ravel(), law.step(law.update(memory, q, 2.0)), atol=1e-13)
    read = law.reading()(memory, np.append(q, 2.0), 0.0)
    np.testing.assert_array_equal(read.full().ravel(), law.read(memory, q, 2.0))


@pytest.mark.needs_cc
@pytest.mark.parametrize("name", LAWS)
def test_exported_laws_agree_with_python(name, tmp_path):
    law = LAWS[name](window=4)
    package = co.export_c([law.read, law.update, law.step], tmp_path / "law")
    package.build(flags=QUICK)
    assert package.check().ok
    assert "alloc(" not in (tmp_path / "law" / "law.c").read_text(encoding="utf-8")


@pytest.mark.needs_cc
def test_compiled_law_skips_gaps(tmp_path):
    law = LAWS["constrained"](window=4)
    update = compile_function(law.update, tmp_path)
    memory, expected = law.initial(), law.initial()
    for k, q in enumerate(random_attitudes(26, 25)):
        power = np.nan if k % 5 == 2 else np.sin(k)
        memory, expected = np.ravel(update(memory, q, power)), law.update(expected, q, power)
    np.testing.assert_allclose(memory, expected, atol=1e-9)


@pytest.mark.parametrize("make", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize(
    ("changes", "argument"),
    [
        ({"window": 0}, "'window'"),
        ({"spacing": 0}, "'spacing'"),
        ({"kappa": 0.0}, "'kappa'"),
        ({"noise": -1.0}, "'noise'"),
        ({"period": np.inf}, "'period'"),
        ({"drift": -0.1}, "'drift'"),
        ({"motion_drift": np.nan}, "'motion_drift'"),
        ({"prior_covariance": 0.0}, "'prior_covariance'"),
        ({"prior_covariance": [1.0, 2.0]}, "'prior_covariance'"),
        ({"prior": [1.0, 2.0]}, "'prior'"),
        ({"prior": "none"}, "'prior'"),
        ({"cutoff": 0.0}, "'cutoff'"),
        ({"excitation": np.inf}, "'excitation'"),
        ({"excitation_period": [1.0, 0.0, 1.0]}, "'excitation_period'"),
        ({"excitation_phase": [1.0]}, "'excitation_phase'"),
        ({"correlated": "yes"}, "'correlated'"),
        ({"peak_curvature": -1.0}, "'peak_curvature'"),
        ({"settings": "best"}, "'settings'"),
        ({"kapa": 0.1}, "'kapa'"),
    ],
)
def test_wrong_settings_are_named(make, changes, argument):
    with pytest.raises(ProblemError, match=argument):
        make(**changes)


@pytest.mark.parametrize(
    ("zones", "match"),
    [
        (5, "'zones'"),
        ([(1, 2, 3)], "'zones'"),
        ([((0, 0, 0), (0, 0, 1), 20.0, "inclusion")], "body axis"),
        ([((0, 0, 1), (0, 0, 0), 20.0, "inclusion")], "inertial direction"),
        ([((0, 0, 1), (0, np.nan, 1), 20.0, "inclusion")], "inertial direction"),
        ([((0, 0, 1), (0, 0, 1), 0.0, "inclusion")], "half angles"),
        ([((0, 0, 1), (0, 0, 1), 180.0, "inclusion")], "half angles"),
        ([((0, 0, 1), (0, 0, 1), 20.0, "keep out")], "'exclusion'"),
        ([((0, 0, 1), (0, 0, 1), 20.0, "inclusion"), ((0, 0, 1), (1, 0, 0), 20.0, "inclusion")], "contradict"),
        ([((0, 0, 1), (0, 0, 1), 20.0, "inclusion"), ((0, 0, 1), (0, 0, 1), 30.0, "exclusion")], "contradict"),
        ([((0, 0, 1), (0, 0, 1), 20.0, "inclusion"), ((1, 0, 0), (0, 0, -1), 20.0, "inclusion")], "30 deg|contradict"),
    ],
)
def test_wrong_zones_are_named(zones, match):
    for make in (attitude_seeking.projected, attitude_seeking.constrained):
        with pytest.raises(ProblemError, match=match):
            make(zones)


def test_contradicting_zones_are_those_that_no_attitude_is_in():
    """Pairs at random: where random attitudes find one in both, they are accepted; refused ones have none."""
    generator = np.random.default_rng(0)
    attitudes = so3.from_quaternion(unit(generator.standard_normal((20000, 4))))
    kinds, angles, refused = ("inclusion", "exclusion"), (5.0, 20.0, 40.0, 160.0, 175.0), 0
    for _ in range(150):
        pair = [
            (*generator.standard_normal((2, 3)), float(generator.choice(angles)), str(generator.choice(kinds)))
            for _ in range(2)
        ]
        made = [attitude_seeking.zone(*zone) for zone in pair]
        best = np.min([zone.value(attitudes) for zone in made], axis=0).max()
        if best >= 0:
            attitude_seeking.zones_of(pair)
        elif best < -0.02:
            refused += 1
            with pytest.raises(ProblemError, match=r"contradict(?s:.)*(in|ex)clusion of"):
                attitude_seeking.zones_of(pair)
    assert 5 < refused < 145


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_margins_and_step_bounds_that_do_not_fit_are_named():
    for make, changes, name in (
        (LAWS["projected"], {"margin": 20.0}, "'margin'"),
        (LAWS["constrained"], {"margin": -1.0}, "'margin'"),
        (LAWS["constrained"], {"largest_step": None}, "'largest_step'"),
        (LAWS["constrained"], {"largest_step": 4.0}, "'largest_step'"),
        (LAWS["constrained"], {"penalty": 0.0}, "'penalty'"),
        (LAWS["constrained"], {"smallest_step": 0.1}, "'smallest_step'"),
        (LAWS["projected"], {"largest_step": 0.1}, "'largest_step'"),
        (LAWS["projected"], {"method": "newton"}, "'method'"),
        (LAWS["projected"], {"method": "osqp", "curvature": True}, "'curvature'"),
        (LAWS["unconstrained"], {"penalty": 1.0}, "'penalty'"),
        (LAWS["unconstrained"], {"smallest_step": 0.3}, "'smallest_step'"),
    ):
        with pytest.raises(ProblemError, match=name):
            make(**changes)


def test_kappa_is_checked_against_the_curvature():
    attitude_seeking.unconstrained(peak_curvature=9.8)
    with pytest.warns(co.CovocpWarning, match="below 0.102"):
        attitude_seeking.unconstrained(settings="printed", peak_curvature=9.8)


def test_wrong_readings_are_named():
    law = LAWS["projected"](window=2)
    memory, q = law.initial(), random_attitudes(0, 1)[0]
    for arguments, name in (
        ((memory, q[:3], 1.0), "'attitude'"),
        ((memory, 1.01 * q, 1.0), "'attitude'"),
        ((memory, [np.inf, 0, 0, 0], 1.0), "'attitude'"),
        ((memory, q, np.inf), "'power'"),
        ((memory, q, "much"), "'power'"),
        ((memory[:-1], q, 1.0), "'memory'"),
        ((memory + np.nan, q, 1.0), "'memory'"),
    ):
        for function in (law.read, law.update):
            with pytest.raises(ProblemError, match=name):
                function(*arguments)
    with pytest.raises(ProblemError, match="'memory'"):
        law.estimate(memory[:-1])
    with pytest.raises(ProblemError, match="'attitude'"):
        law.initial([1.0, 1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: turn_between([1, 0, 0], [1, 0, 0, 0]), "'before'(?s:.)*4 x 1(?s:.)*3 x 1"),
        (lambda: turn_between([1, 0, 0, 0], ca.SX.sym("q", 3)), "'after'(?s:.)*4 x 1(?s:.)*3 x 1"),
        (lambda: attitude_seeking.zone_rows(np.eye(3), 3), "'zones'(?s:.)*received: 3"),
        (lambda: attitude_seeking.zone_rows(np.eye(3), ZONES), r"'zones'(?s:.)*zones_of\(\)"),
        (lambda: attitude_seeking.zone_rows(np.eye(2), []), "'rotation'(?s:.)*3 x 3(?s:.)*2 x 2"),
        (lambda: attitude_seeking.zone_rows(1.0, []), "'rotation'(?s:.)*3 x 3(?s:.)*a number"),
    ],
)
def test_what_is_no_attitude_and_no_zone_is_named(call, message):
    with pytest.raises(ProblemError, match=message):
        call()


def test_turns_of_lists_of_numbers():
    after = [np.cos(0.15), np.sin(0.15), 0.0, 0.0]
    vector = ca.evalf(ca.MX(turn_between([1, 0, 0, 0], after))).full().ravel()
    np.testing.assert_allclose(vector, [0.3, 0, 0], atol=1e-15)
