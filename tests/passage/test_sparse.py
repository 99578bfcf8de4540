"""Steps whose system is eliminated by its nonzeros: the same numbers as with exchanges of rows, at any step."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from longer import in_long_double, passed_in_long_double
from scipy.integrate import solve_ivp

from covocp.base.matrices import half_length, pack, unpack
from covocp.passage import library, ordering, sweep
from covocp.passage.shape import shape
from covocp.passage.sweep import Course, _Sweep, entries_of, passed_by

pytestmark = pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))

STEPS = 5
ROWS, COUNT, EVERY = 10, 20, 2  # of the steps of which slopes of few entries are taken: in an interval two
KEPT: list[_Sweep] = []
# Largest share of an order of elimination, whether there are kicks.
WAYS = ((1e9, False), (0.0, False))


def kept(*given: object) -> _Sweep:
    """A new sweep; CasADi's expressions do not keep it."""
    KEPT.append(_Sweep(*given))  # type: ignore[arg-type]
    return KEPT[-1]


def chain(n: int, *, stiffness: float = 2.0, damping: float = 0.3, units: float = 1.0) -> tuple[np.ndarray, ...]:
    """F, Q and W of n/2 masses in a row, the last one measured; positions in other units than speeds."""
    m = n // 2
    D = np.eye(m) - np.eye(m, k=-1)
    F = np.block([[np.zeros((m, m)), np.eye(m)], [-stiffness * D.T @ D, -damping * D.T @ D]])
    Q, W = np.zeros((n, n)), np.zeros((n, n))
    Q[m:, m:] = 0.01 * np.eye(m)
    W[m - 1, m - 1] = 100.0
    S = np.diag([units] * m + [1.0] * m)
    T = np.linalg.inv(S)
    return S @ F @ T, S @ Q @ S, T @ W @ T


def points(n: int, h: float, seed: int = 0, **changes: float) -> tuple[np.ndarray, np.ndarray]:
    """h H at both points of some steps that differ by one percent, side by side."""
    F, Q, W = chain(n, **changes)
    rng = np.random.default_rng(seed)

    def one() -> np.ndarray:
        moved = [M * (1 + 0.01 * rng.normal(size=M.shape)) for M in (F, Q, W)]
        moved[1:] = [(M + M.T) / 2 for M in moved[1:]]
        return h * np.block([[-moved[0].T, moved[2]], [moved[1], moved[0]]])

    first, second = (np.hstack([one() for _ in range(STEPS)]) for _ in range(2))
    return first, second


def prior(n: int, size: float = 1.0, units: float = 1.0) -> np.ndarray:
    """A full covariance."""
    A = np.random.default_rng(n).normal(size=(n, n))
    S = np.diag([units] * (n // 2) + [1.0] * (n // 2))
    return size * S @ (A @ A.T / n + np.eye(n)) @ S


def passages(
    monkeypatch: pytest.MonkeyPatch, pattern: ca.Sparsity, ways: tuple[tuple[float, bool], ...] = WAYS
) -> list[ca.Function]:
    """The passage and its slopes and their tangents: by nonzeros, and with exchanges of rows; or by other ways.

    With kicks, which are zero here, all of dE is taken along.
    """
    n = pattern.shape[0] // 2
    functions = []
    for share, kicked in ways:
        monkeypatch.setattr(ordering, "LARGEST_SHARE", share)
        monkeypatch.setattr(ordering, "SMALLEST", 1)
        monkeypatch.setattr("covocp.passage.sweep._sweep", kept)
        monkeypatch.setattr("covocp.passage.sweep.shape", shape.__wrapped__)  # it is remembered by the pattern alone
        wide = ca.repmat(pattern, 1, STEPS)
        arguments = [ca.MX.sym("e", half_length(n)), ca.MX.sym("h1", wide), ca.MX.sym("h2", wide)]
        seeds, along = ca.MX.sym("s", half_length(n), STEPS), [ca.MX.sym("d", a.sparsity()) for a in arguments]
        kicks = ca.DM.zeros(half_length(n), STEPS) if kicked else None
        after = passed_by(arguments[0], entries_of(arguments[1:], n), kicks)
        slopes = [ca.jtimes(after, a, seeds, True) for a in arguments]
        moved: list[ca.MX] = [
            sum((ca.jtimes(slope, a, d) for a, d in zip(arguments, along, strict=True)), ca.MX(0)) for slope in slopes
        ]
        functions.append(ca.Function("passage", [*arguments, seeds, *along], [after, *slopes, *moved]))
    return functions


def arguments(n: int, h: float, size: float = 1.0, units: float = 1.0) -> tuple[ca.Sparsity, list[object], np.ndarray]:
    """Pattern of a step, what the passages take, and E."""
    h1, h2 = points(n, h, units=units)
    pattern = ca.sparsify(ca.DM(np.abs(h1[:, : 2 * n]))).sparsity()
    wide, E, rng = ca.repmat(pattern, 1, STEPS), prior(n, size, units), np.random.default_rng(7)
    along = [0.1 * ca.DM(wide, rng.normal(size=wide.nnz())) * ca.project(ca.DM(k), wide) for k in (h1, h2)]
    seeds = rng.normal(size=(half_length(n), STEPS))
    return pattern, [pack(E), *(ca.project(ca.DM(k), wide) for k in (h1, h2)), seeds, pack(0.01 * E), *along], E


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="no longer numbers than double here")
@pytest.mark.parametrize(
    ("h", "size", "units", "allowed"),
    [
        (0.3, 1.0, 1.0, 1e-13),
        (2.5, 1.0, 1.0, 1e-12),
        (5.0, 1.0, 1.0, 1e-11),
        (0.3, 1.0, 1e3, 1e-13),
        (0.3, 1e4, 1.0, 1e-10),
        (0.3, 1e4, 1e-4, 1e-9),
    ],
)
@pytest.mark.parametrize("n", [6, 10, 30])
def test_last_covariance_in_longer_arithmetic(monkeypatch, n, h, size, units, allowed):
    """In any units: exchanges of rows are not invariant, and lose five digits with positions in millimetres."""
    pattern, given, E = arguments(n, h, size, units)
    by_nonzeros, _ = passages(monkeypatch, pattern)
    found = unpack(np.asarray(by_nonzeros(*given)[0].full())[:, -1], n)
    exact = in_long_double(E, *(np.asarray(ca.DM(k).full()) for k in given[1:3]), steps=STEPS)
    deviation = np.sqrt(np.diag(exact))
    assert np.abs((found - exact) / np.outer(deviation, deviation)).max() < allowed


@pytest.mark.parametrize("h", [0.02, 0.3, 2.5])
@pytest.mark.parametrize("n", [2, 6, 10, 30])
def test_slopes_and_their_tangents_are_those_with_exchanges_of_rows(monkeypatch, n, h):
    pattern, given, _ = arguments(n, h)
    by_nonzeros, exchanged = passages(monkeypatch, pattern)
    for one, other in zip(by_nonzeros(*given), exchanged(*given), strict=True):
        a, b = np.asarray(ca.DM(one).full()), np.asarray(ca.DM(other).full())
        assert np.abs(a - b).max() <= 1e-11 * np.abs(b).max()


def few_seeds(n: int, rows: int, column: int) -> np.ndarray:
    """Weights of all entries of some rows and columns of one of the covariances."""
    rng, weights = np.random.default_rng(rows), np.zeros((n, n))
    chosen = rng.choice(n, rows, replace=False)
    weights[np.ix_(chosen, chosen)] = rng.normal(size=(rows, rows))
    seeds = np.zeros((half_length(n), STEPS))
    seeds[:, column] = pack(weights + weights.T)
    return seeds


@pytest.mark.parametrize("h", [0.02, 0.3, 2.5])
@pytest.mark.parametrize(("n", "rows"), [(6, 1), (6, 2), (10, 2), (10, 3), (30, 1), (30, 2), (30, 7)])
def test_tangents_of_slopes_by_few_entries_take_few_columns(monkeypatch, n, rows, h):
    """In turn by other seeds, points and directions, of which each knows what the one before it left."""
    pattern, given, _ = arguments(n, h)
    wide = ca.repmat(pattern, 1, STEPS)
    given[5:] = [ca.project(ca.DM(0.1 * k), wide) for k in points(n, h, seed=1, damping=0.7)]  # of the form of H
    *found, known = passages(monkeypatch, pattern, (*WAYS, (0.0, True)))
    turns = [
        [*given[:3], few_seeds(n, own, column), share * given[4], *given[5:]]
        for own, column, share in ((rows, STEPS - 1, 1.0), (rows, STEPS - 1, -2.0), (1, 1, 1.0), (rows, 0, 0.5))
    ]
    turns.append([1.1 * given[0], *turns[0][1:]])
    turns.append([*turns[0][:4], 0.0 * given[4], *given[5:]])
    for turn in (*turns, turns[0]):
        expected = [np.asarray(ca.DM(values).full()) for values in known(*turn)]
        for function in found:
            for values, other in zip(function(*turn), expected, strict=True):
                own = np.asarray(ca.DM(values).full())
                assert np.abs(own - other).max() <= 1e-11 * np.abs(other).max()


def test_steps_behind_the_only_seed_have_no_slopes_and_no_tangents_of_them():
    """Whatever lies where they are written; without a node, by the passage that optimality takes."""
    n, column = 30, 1
    pattern, given, _ = arguments(n, 0.3)
    entries = [np.asarray(ca.DM(k).nonzeros()).reshape(STEPS, -1).T for k in (*given[1:3], *given[5:])]
    course = Course(given[0], entries[:2], n, tuple(map(tuple, pattern.get_triplet())), 1)
    seeds = np.asfortranarray(few_seeds(n, 2, column))
    by_first, slopes, passed = course.slopes(seeds)
    moved = [np.full(entries[0].shape, np.nan, order="F") for _ in range(2)]
    course.tangents(seeds, [np.asfortranarray(own) for own in entries[2:]], moved)
    for found in (*slopes, *moved):
        assert np.isfinite(found).all()
        assert found[:, : column + 1].any(axis=0).all()
        assert not found[:, column + 1 :].any()
    np.testing.assert_array_equal(passed[:, column], seeds[:, column])
    assert not passed[:, column + 1 :].any()
    assert by_first.any()


@pytest.mark.parametrize("share", [0.98, 1.0 - 1e-9, 1.0])
def test_a_pivot_that_vanishes_is_exchanged(monkeypatch, share):
    """1 - (h w)^2/12 is zero for an oscillator at h w = sqrt(12), where no order of elimination helps."""
    n, h = 2, share * np.sqrt(12.0)
    F = np.array([[0.0, 1.0], [-1.0, 0.0]])
    pattern = ca.Sparsity.triplet(4, 4, [0, 1, 2, 3], [1, 0, 3, 2])
    by_nonzeros, _ = passages(monkeypatch, pattern)
    H = np.hstack([h * np.block([[-F.T, np.zeros((2, 2))], [np.zeros((2, 2)), F]])] * STEPS)
    wide, E = ca.repmat(pattern, 1, STEPS), prior(2)
    moves, zero = ca.project(ca.DM(H), wide), ca.DM(wide, 0.0)
    found = np.asarray(by_nonzeros(pack(E), moves, moves, np.zeros((3, STEPS)), pack(0 * E), zero, zero)[0].full())
    # two stages: the transition of a constant F is (I - z/2 + z^2/12)^-1 (I + z/2 + z^2/12), a rotation here
    z = h * F
    D = np.linalg.solve(np.eye(2) - z / 2 + z @ z / 12, np.eye(2) + z / 2 + z @ z / 12)
    exact = E
    for k in range(STEPS):
        exact = D @ exact @ D.T
        assert np.allclose(unpack(found[:, k], n), exact, rtol=1e-12, atol=1e-12)


def oscillators(count: int) -> tuple[np.ndarray, np.ndarray]:
    """h H at both points of oscillators of which one is measured; each third step has pivots that nearly vanish."""
    n, m = 10, 5
    F = np.block([[np.zeros((m, m)), np.eye(m)], [-np.eye(m), np.zeros((m, m))]])
    Q, W = np.zeros((n, n)), np.zeros((n, n))
    Q[m:, m:], W[0, 0] = 0.01 * np.eye(m), 0.1
    H = np.block([[-F.T, W], [Q, F]])
    lengths = [0.9999 * np.sqrt(12.0) if k % 3 == 1 else 0.2 + 0.01 * k for k in range(count)]
    return np.hstack([h * H for h in lengths]), np.hstack([1.01 * h * H for h in lengths])


def few_entries(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """h H at both points of the steps of which slopes of few entries are taken."""
    if kind == "poor pivots":
        return oscillators(COUNT)
    F, Q, W = chain(ROWS, damping=30.0 if kind == "strongly damped" else 0.3)
    H = 0.2 * np.block([[-F.T, W * (1e5 if kind == "much measured" else 1.0)], [Q, F]])
    return np.tile(H, COUNT), np.tile(1.01 * H, COUNT)


@cache
def by_stages(kind: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each point: a direction of the form of H, and how the covariances of all intervals move along it.

    By differences of steps in longer arithmetic; lower halves, one column an interval.
    """
    points, slopes = few_entries(kind), []
    for k in range(2):
        rng = np.random.default_rng(k)
        F, Q, W = (rng.normal(size=(COUNT, ROWS, ROWS)) for _ in range(3))
        Q, W = Q + Q.transpose(0, 2, 1), W + W.transpose(0, 2, 1)
        direction = np.hstack(np.block([[-F.transpose(0, 2, 1), W], [Q, F]])) * (points[k] != 0)
        step, moved = np.longdouble(1e-8), []
        for sign in (1, -1):
            given = [p.astype(np.longdouble) for p in points]
            given[k] = given[k] + sign * step * direction
            passed = passed_in_long_double(prior(ROWS), *given, steps=COUNT)[EVERY - 1 :: EVERY]
            moved.append(np.array([np.concatenate([E[j:, j] for j in range(ROWS)]) for E in passed]).T)
        slopes.append((direction, (moved[0] - moved[1]) / (2 * step)))
    return slopes


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="no longer numbers than double here")
@pytest.mark.parametrize("kind", ["chain", "poor pivots", "much measured", "strongly damped"])
@pytest.mark.parametrize("rows", [1, 2, 3])
@pytest.mark.parametrize("most", [10**6, 0])
def test_slopes_of_few_entries_without_stages(monkeypatch, kind, rows, most):
    """Of factors alone, or of what is wanted; then all stages are asked for, and are there from then on."""
    monkeypatch.setattr(ordering, "LARGEST_SHARE", 1e9)
    monkeypatch.setattr(sweep, "MOST_FACTORS", most)
    n, count, every, both = ROWS, COUNT, EVERY, few_entries(kind)
    pattern = ca.sparsify(ca.DM(np.abs(both[0][:, : 2 * n]))).sparsity()
    wide = ca.repmat(pattern, 1, count)
    a = [ca.MX.sym("e", half_length(n)), ca.MX.sym("h1", wide), ca.MX.sym("h2", wide)]
    own = ca.MX.sym("s", half_length(n), count // every)
    made = kept(n, tuple(map(tuple, pattern.get_triplet())), count, False, (), 0, False, every)
    monkeypatch.setattr(sweep, "_sweep", lambda *given: made)
    after = passed_by(a[0], entries_of(a[1:], n), every=every)
    function = ca.Function("f", [*a, own], [after, *(ca.jtimes(after, x, own, True) for x in a)])
    E = prior(n)
    given = [pack(E), *(ca.project(ca.DM(k), wide) for k in both)]
    C = np.zeros((n, n))
    C[-rows:, -rows:] = np.arange(1.0, rows * rows + 1).reshape(rows, rows)
    C = C + C.T
    few, all_ = np.zeros((half_length(n), count // every)), np.random.default_rng(3).normal(size=(55, count // every))
    few[:, -3] = pack(C)  # what comes after has no slopes
    for seeds in (few, all_, few):
        _, _, *slopes = function(*given, seeds)
        for own_slope, (direction, moved) in zip(slopes, by_stages(kind), strict=True):
            along = np.asarray(own_slope.full()) * direction
            assert abs(np.sum(along) - (seeds * moved).sum()) <= 1e-8 * np.sum(np.abs(along))


@pytest.mark.parametrize("reads", [(), (5, 6, 23)])
@pytest.mark.parametrize("kicked", [False, True])
@pytest.mark.parametrize("every", [1, 3])
def test_slopes_where_nothing_is_kept_are_those_where_all_is(monkeypatch, reads, kicked, every):
    """With readings among the steps and with what is added between them; some steps measure much."""
    monkeypatch.setattr(ordering, "LARGEST_SHARE", 1e9)
    n, count = 10, 30
    moves, half, rng = count - len(reads), half_length(n), np.random.default_rng(5)
    F, Q, W = chain(n)
    H = [0.2 * np.block([[-F.T, W * (1e5 if k == 12 else 1.0)], [Q, F]]) for k in range(moves)]
    pattern = ca.sparsify(ca.DM(np.abs(H[0]))).sparsity()
    entries = pattern.nnz()
    points = [
        np.hstack([np.asarray(ca.DM(ca.project(ca.DM(share * h), pattern)).nonzeros())[:, None] for h in H])
        for share in (1.0, 1.01)
    ]
    given = [pack(prior(n)), *points]
    given += [np.vstack([rng.normal(size=(n, len(reads))), np.ones((1, len(reads)))])] if reads else []
    given += [np.vstack([pack(0.01 * prior(n))] * (count // every)).T] if kicked else []
    C = np.zeros((n, n))
    C[-2:, -2:] = [[1.0, 0.5], [0.5, 2.0]]
    seeds = np.zeros((half, count // every))
    seeds[:, -2] = pack(C)
    found = []
    for most in (10**6, 0):
        monkeypatch.setattr(sweep, "MOST_FACTORS", most)
        made = kept(n, tuple(map(tuple, pattern.get_triplet())), count, kicked, reads, len(reads[:1]), False, every)
        symbols = [ca.MX.sym(f"a{k}", *np.reshape(a, (len(a), -1)).shape) for k, a in enumerate(given)]
        own = ca.MX.sym("s", *seeds.shape)
        after = made(*symbols)
        slopes = ca.Function("f", [*symbols, own], [after, *(ca.jtimes(after, x, own, True) for x in symbols)])
        found.append([np.asarray(values.full()) for values in slopes(*given, seeds)])
    assert found[0][1 + 1].shape == (entries, moves)
    assert np.array_equal(found[0][0], found[1][0])
    for one, other in zip(*found, strict=True):
        assert np.abs(one - other).max() <= 1e-12 * np.abs(one).max()


def test_a_large_chain_is_the_differential_equation():
    """Order 4 against scipy, with the order of elimination that is chosen by default."""
    n = 24
    F, Q, W = chain(n)
    E = prior(n)
    assert ordering.ordering(n, *ca.sparsify(ca.DM(np.block([[-F.T, W], [Q, F]]))).sparsity().get_triplet()) is not None

    def rate(t: float, e: np.ndarray) -> np.ndarray:
        V = e.reshape(n, n)
        return np.asarray(F @ V + V @ F.T + Q - V @ W @ V).ravel()

    exact = solve_ivp(rate, (0, 1.0), E.ravel(), rtol=1e-12, atol=1e-13, method="DOP853").y[:, -1].reshape(n, n)
    errors = []
    for count in (10, 20, 40):
        H = ca.sparsify(ca.DM(np.block([[-F.T, W], [Q, F]]) / count))
        passed = passed_by(ca.DM(pack(E)), entries_of([ca.repmat(H, 1, count)] * 2, n))
        last = unpack(np.asarray(ca.DM(passed).full())[:, -1], n)
        errors.append(np.abs(last - exact).max())
    assert errors[2] < 1e-5 * np.abs(exact).max()
    assert np.log2(errors[0] / errors[1]) > 3.7
    assert np.log2(errors[1] / errors[2]) > 3.7


def test_full_systems_and_small_ones_are_not_ordered():
    assert ordering.ordering(12, *ca.Sparsity.dense(24, 24).get_triplet()) is None
    assert ordering.ordering(2, *ca.Sparsity.diag(4).get_triplet()) is None
    assert ordering.ordering(20, *ca.Sparsity.diag(40).get_triplet()) is not None
