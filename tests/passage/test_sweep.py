"""The compiled passage against longer arithmetic, finite differences, CasADi's own operations and scipy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from derivatives import tangents_of
from longer import in_long_double
from scipy.integrate import solve_ivp
from side_by_side import in_threads

import covocp as co
from covocp.base.linear_solve import LINEAR_SOLVER, linear_solve
from covocp.base.matrices import half_length, pack, pack_symbolic, unpack, unpack_symbolic
from covocp.base.quadrature import gauss_matrix, riccati_step
from covocp.models import mars_entry, mass_chain
from covocp.passage import library, sweep
from covocp.passage.sweep import _sweep, depends, entries_of, from_one, passed_by, values_by
from covocp.transcription import shooting

pytestmark = pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))

SIZES = (1, 2, 3, 4, 5, 7, 8, 12, 20, 40)
STEPS = 6


def systems(
    n: int, seed: int, *, h: float = 0.05, prior: float = 1.0, information: float = 1.0
) -> tuple[np.ndarray, ...]:
    """A covariance, and h H at both points of some steps side by side."""
    rng = np.random.default_rng(seed)

    def one() -> np.ndarray:
        F, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, 2)), rng.normal(size=(2, n))
        return h * np.block([[-F.T, information * C.T @ C], [B @ B.T, F]])

    A = rng.normal(size=(n, n))
    return prior * (A @ A.T + np.eye(n)), *(np.hstack([one() for _ in range(STEPS)]) for _ in range(2))


def node(n: int, *, kicked: bool = False, every: int = 1) -> tuple[list[ca.MX], ca.MX]:
    """Arguments and result of the compiled passage, which gives and takes something every so many steps."""
    arguments = [
        ca.MX.sym("e", half_length(n)),
        ca.MX.sym("h1", 2 * n, 2 * n * STEPS),
        ca.MX.sym("h2", 2 * n, 2 * n * STEPS),
    ]
    if kicked:
        arguments.append(ca.MX.sym("kicks", half_length(n), STEPS // every))
    return arguments, passed_by(arguments[0], entries_of(arguments[1:3], n), *arguments[3:], every=every)


def by_casadi(n: int, arguments: list[ca.MX], every: int = 1) -> ca.MX:
    """The same by CasADi's operations."""
    e, h1, h2 = ca.MX.sym("e", half_length(n)), ca.MX.sym("h1", 2 * n, 2 * n), ca.MX.sym("h2", 2 * n, 2 * n)
    D = gauss_matrix((h1, h2), n, LINEAR_SOLVER)
    after = pack_symbolic(riccati_step(D, unpack_symbolic(e, n), lambda a, b: linear_solve(a, b, LINEAR_SOLVER)))
    inputs = [e, h1, h2]
    if len(arguments) > 3:
        inputs.append(ca.MX.sym("kick", half_length(n)))
        after = after + inputs[-1]
        kicks = ca.MX(half_length(n), STEPS)
        kicks[:, every - 1 :: every] = arguments[3]
        arguments = [*arguments[:3], kicks]
    return ca.Function("step", inputs, [after]).mapaccum("steps", STEPS)(*arguments)[:, every - 1 :: every]


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="no longer numbers than double here")
@pytest.mark.parametrize(
    ("changes", "allowed"),
    [
        ({}, 1e-13),
        ({"prior": 1e6}, 1e-9),
        ({"information": 1e8}, 1e-8),
        ({"h": 1.0}, 1e-11),
        ({"information": 0.0}, 1e-13),
    ],
)
@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_last_covariance_in_longer_arithmetic(n, changes, allowed):
    E, h1, h2 = systems(n, n, **changes)
    arguments, passed = node(n)
    found = unpack(np.asarray(ca.Function("f", arguments, [passed])(pack(E), h1, h2).full()).T, n)
    exact = in_long_double(E, h1, h2, steps=STEPS)
    deviation = np.sqrt(np.diag(exact))
    assert np.abs((found[-1] - exact) / np.outer(deviation, deviation)).max() < allowed
    assert np.linalg.eigvalsh(found).min() > 0


def test_a_long_passage_is_the_differential_equation():
    """Order 4 against scipy."""
    rng = np.random.default_rng(3)
    F, B, C = rng.normal(size=(3, 3)), rng.normal(size=(3, 1)), rng.normal(size=(1, 3))
    E0, Q, W = np.eye(3), B @ B.T, C.T @ C

    def rate(_: float, e: np.ndarray) -> np.ndarray:
        E = e.reshape(3, 3)
        return (F @ E + E @ F.T + Q - E @ W @ E).ravel()

    exact = solve_ivp(rate, (0.0, 1.0), E0.ravel(), rtol=1e-12, atol=1e-14, method="DOP853").y[:, -1].reshape(3, 3)
    errors = []
    for count in (20, 40):
        H = np.tile(np.block([[-F.T, W], [Q, F]]) / count, count)
        passed = passed_by(ca.DM(pack(E0)), entries_of([ca.DM(H), ca.DM(H)], 3))
        errors.append(np.abs(unpack(np.asarray(passed.full()).T, 3)[-1] - exact).max())
    assert errors[1] < 1e-6
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize("asked", ["last entry", "all"])
@pytest.mark.parametrize("n", SIZES)
def test_values_and_slopes_are_those_of_casadi(n, asked, every):
    """One entry at the end has slopes of low rank; with kicks and seeds everywhere they are full."""
    rng = np.random.default_rng(n)
    E, h1, h2 = systems(n, n)
    arguments, passed = node(n, kicked=True, every=every)
    weights = np.zeros((half_length(n), STEPS // every))
    weights[-1, -1] = 1.0
    if asked == "all":
        weights = rng.normal(size=weights.shape)
    given = (pack(E), h1, h2, 1e-3 * rng.normal(size=weights.shape))
    found, known = (
        ca.Function("f", arguments, [result, *(ca.gradient(ca.dot(weights, result), v) for v in arguments)])(*given)
        for result in (passed, by_casadi(n, arguments, every))
    )
    for own, other in zip(found, known, strict=True):
        assert np.abs(np.asarray(own - other)).max() <= 1e-11 * np.abs(np.asarray(other)).max()


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_slopes_against_finite_differences(n):
    """Duality: the slope by E(0) and by h H of any direction."""
    rng = np.random.default_rng(n)
    E, h1, h2 = systems(n, n)
    arguments, passed = node(n)
    weights = rng.normal(size=(half_length(n), STEPS))
    value = ca.dot(weights, passed)
    f = ca.Function("f", arguments, [value, *(ca.gradient(value, v) for v in arguments)])
    given = [pack(E), h1, h2]
    slopes = f(*given)[1:]
    for place in range(3):
        direction = rng.normal(size=given[place].shape)
        step = 1e-5
        ends = []
        for sign in (1, -1, 2, -2):
            moved = list(given)
            moved[place] = given[place] + sign * step * direction
            ends.append(float(f(*moved)[0]))
        difference = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * step)
        slope = float(np.sum(np.asarray(slopes[place].full()).reshape(direction.shape) * direction))
        assert slope == pytest.approx(difference, rel=1e-7, abs=1e-7 * abs(float(f(*given)[0])))


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("kicked", [False, True])
@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_tangents_of_values_and_slopes_are_those_of_casadi(n, kicked, every):
    """Along directions of the form of H, Q and W symmetric."""
    rng = np.random.default_rng(n)
    E, h1, h2 = systems(n, n)
    shape = (half_length(n), STEPS // every)
    weights, moved = rng.normal(size=shape), systems(n, n + 100)[1:]
    directions = [rng.normal(size=shape[0]), *moved, rng.normal(size=shape)][: 4 if kicked else 3]
    given = [pack(E), h1, h2, 1e-3 * rng.normal(size=shape)][: len(directions)]
    arguments, passed = node(n, kicked=kicked, every=every)
    found = []
    for result in (passed, by_casadi(n, arguments, every)):
        value = ca.dot(weights, result) + ca.sumsqr(result) / 2
        values = [value, *(ca.gradient(value, v) for v in arguments)]
        found.append(tangents_of(values, arguments, directions, given))
    for own, other in zip(*found, strict=True):
        assert np.abs(own - other).max() <= 1e-11 * np.abs(other).max()


def first_variance(e):
    return e[0, -1]


def two_entries(e):
    return 2.0 * e[1, -1] - 0.3 * e[-1, -1]


def curved_at_the_end(e):
    return ca.log(2.0 + e[-1, -1] ** 2)


def earlier_too(e):
    return e[0, -1] + 0.7 * e[2, 1]


def curved_earlier(e):
    return e[-1, -1] + e[0, 2] ** 2 + e[1, 0]


@pytest.mark.parametrize(
    "cost", [first_variance, two_entries, curved_at_the_end, earlier_too, curved_earlier], ids=lambda f: f.__name__
)
@pytest.mark.parametrize("kicked", [False, True])
@pytest.mark.parametrize("n", [2, 6, 13])
def test_tangents_of_slopes_by_few_entries_are_those_of_casadi(n, kicked, cost):
    """These have few columns, as long as nothing else is asked on the way back."""
    rng = np.random.default_rng(n)
    E, h1, h2 = systems(n, n)
    shape = (half_length(n), STEPS)
    directions = [rng.normal(size=shape[0]), *systems(n, n + 100)[1:], rng.normal(size=shape)][: 4 if kicked else 3]
    given = [pack(E), h1, h2, 1e-3 * rng.normal(size=shape)][: len(directions)]
    arguments, passed = node(n, kicked=kicked)
    found = []
    for result in (passed, by_casadi(n, arguments)):
        value = cost(result)
        values = [ca.gradient(value, v) for v in arguments]
        found.append(tangents_of(values, arguments, directions, given))
    for own, other in zip(*found, strict=True):
        assert np.abs(own - other).max() <= 1e-11 * np.abs(other).max()


@pytest.mark.parametrize("kicked", [False, True])
@pytest.mark.parametrize("every", [1, 2, STEPS])
def test_values_alone_are_those_that_have_slopes(kicked, every):
    """No steps are kept of them; their sparsity is that of what stands for them."""
    n = 4
    E, h1, h2 = systems(n, 4)
    arguments, passed = node(n, kicked=kicked, every=every)
    alone = values_by(arguments[0], entries_of(arguments[1:3], n), *arguments[3:], every=every)
    seen = depends(arguments[0], entries_of(arguments[1:3], n), *arguments[3:], every=every)
    assert seen.shape == alone.shape == passed.shape == (half_length(n), STEPS // every)
    given = [pack(E), h1, h2, 1e-3 * np.ones(passed.shape)][: len(arguments)]
    one, other = ca.Function("f", arguments, [passed, alone])(*given)
    np.testing.assert_array_equal(one.full(), other.full())
    last = ca.which_depends(seen[:, 0], ca.veccat(*arguments), 1, True)
    assert all(last)
    first = ca.Function("first", arguments, [seen[0, 0]]).jac_sparsity(0, 1).get_col()
    assert max(first) < 4 * n * n * every  # what comes after it changes nothing


def test_tangents_of_several_entries_at_once():
    """Jacobian times directions, several of both: every entry of the last covariance by E(0)."""
    n = 3
    E, h1, h2 = systems(n, 1)
    arguments, passed = node(n)
    unit = ca.DM.eye(half_length(n))
    forward = ca.jtimes(passed[:, -1], arguments[0], unit)
    backward = ca.jtimes(passed[:, -1], arguments[0], unit, True).T
    function = ca.Function("f", arguments, [forward, backward])
    one, other = (np.asarray(v.full()) for v in function(pack(E), h1, h2))
    np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-14)


def test_what_casadi_leaves_out_is_zero():
    """Arguments without memory, as it gives them for what is zero: no seeds, no kicks, H of zeros."""
    n = 3
    E, h1, _ = systems(n, 0)
    rows, columns = ca.Sparsity.dense(2 * n, 2 * n).get_triplet()
    sweep = _sweep(n, (tuple(rows), tuple(columns)), STEPS, True, (), 0, False, 1)
    half, result = half_length(n), np.empty(half_length(n) * STEPS)
    sweep.eval_buffer((pack(E).data, None, None, None), (result.data,))
    assert np.allclose(result.reshape(STEPS, half), pack(E), rtol=1e-15)
    slopes = sweep.get_reverse(1, "slopes", ("",) * 6, ("",) * 4, {})
    found = [np.full(size, np.nan) for size in (half, h1.size, h1.size, half * STEPS)]
    slopes.eval_buffer((pack(E).data, None, None, None, result.data, None), tuple(values.data for values in found))
    assert all(not values.any() for values in found)


def test_several_directions_at_once():
    n = 3
    E, h1, h2 = systems(n, 0)
    arguments, passed = node(n)
    asked = passed[:, -1]
    jacobian = ca.jtimes(asked, arguments[0], ca.DM.eye(half_length(n)), True).T
    found = np.asarray(ca.Function("f", arguments, [jacobian])(pack(E), h1, h2).full())
    known = np.asarray(
        ca.Function("f", arguments, [ca.jacobian(by_casadi(n, arguments)[:, -1], arguments[0])])(pack(E), h1, h2).full()
    )
    np.testing.assert_allclose(found, known, rtol=1e-11, atol=1e-13)


def test_a_step_that_cannot_be_taken_gives_no_numbers():
    """X is singular: E + 1 = 0 with W = 1; CasADi's operations fail there, numbers must not look right."""
    H = ca.DM([[0.0, 1.0], [0.0, 0.0]])
    passed = passed_by(ca.DM([-1.0]), entries_of([ca.repmat(H, 1, STEPS)] * 2, 1))
    assert not np.isfinite(np.asarray(passed.full())).any()


def test_threads_do_not_meet():
    """Four threads on the same node, each with its own numbers."""
    n = 4
    arguments, passed = node(n)
    value = ca.sumsqr(passed)
    given = [(pack(E), h1, h2) for E, h1, h2 in (systems(n, seed) for seed in range(4))]
    functions = [ca.Function("f", arguments, [value, ca.gradient(value, arguments[1])]) for _ in given]
    known = [[np.asarray(v.full()) for v in f(*own)] for f, own in zip(functions, given, strict=True)]
    wrong = []

    def run(k: int) -> None:
        for _ in range(50):
            found = [np.asarray(v.full()) for v in functions[k](*given[k])]
            if any(not np.array_equal(a, b) for a, b in zip(found, known[k], strict=True)):
                wrong.append(k)

    in_threads(run)
    assert not wrong


def solved_with(monkeypatch: pytest.MonkeyPatch, there: bool, problem: co.Problem, **options: object) -> co.Solution:
    """A solution with the library or without it."""
    with monkeypatch.context() as patch:
        if not there:
            patch.setattr(shooting, "functions", lambda: None)
            patch.setattr(library, "_loaded", lambda: (None, "it was not built"))
        return co.solve(problem, progress=False, **options)


@pytest.mark.filterwarnings("ignore:A covariance of 10 rows")
@pytest.mark.parametrize(
    ("problem", "options"),
    [
        (lambda: mass_chain.problem(masses=2), {}),
        (lambda: mass_chain.problem(masses=4), {"control": "constant"}),
        (lambda: mars_entry.problem(), {}),
    ],
    ids=["chain", "chain of constant control", "Mars entry"],
)
def test_a_problem_without_the_library_has_the_same_solution(monkeypatch, problem, options):
    fast, plain = (solved_with(monkeypatch, there, problem(), **options) for there in (True, False))
    assert fast.cost == pytest.approx(plain.cost, rel=1e-9)
    for name in ("state", "matrices"):
        own, other = (getattr(solution.costates, name) for solution in (fast, plain))
        assert np.abs(own - other).max() <= 1e-5 * np.abs(other).max()


def test_a_large_covariance_without_the_library_is_told(monkeypatch):
    with pytest.warns(co.CovocpWarning, match=r"10 rows .* without the compiled passage"):
        solved_with(monkeypatch, False, mass_chain.problem(masses=4), allow_failure=True, max_iterations=0)


def test_what_is_built_is_told():
    info = co.build_info()
    assert info["compiled"] is True
    assert str(info["library"]).endswith((".so", ".pyd"))


def test_a_library_of_another_version_is_not_used(monkeypatch):
    """Its functions would take their arguments for others."""
    known = library.VERSION
    monkeypatch.setattr(library, "VERSION", known + 1)
    there, said = library._loaded.__wrapped__()
    assert there is None
    assert f"built from version {known} of its source, not {known + 1}" in said


@pytest.mark.parametrize("n", [19, 20, 24, 33, 40, 61])
def test_steps_of_sizes_about_those_of_blocks_are_riccatis_solution(n: int) -> None:
    """Sizes whose last block is whole, and those where it is not; against full systems, step by step."""
    E, H1, H2 = systems(n, n, h=0.02)
    points = entries_of([ca.DM(H1), ca.DM(H2)], n)
    first, second = (np.asarray(ca.DM(point).full()) for point in (points.first, points.second))
    found = unpack(from_one(pack(E), (first, second), n, points.pattern, 1).T, n)
    for k in range(STEPS):
        own = slice(2 * n * k, 2 * n * (k + 1))
        D = np.asarray(ca.DM(gauss_matrix((ca.DM(H1[:, own]), ca.DM(H2[:, own])), n, LINEAR_SOLVER)).full())
        Z = D @ np.vstack([np.eye(n), E])
        expected = np.linalg.solve(Z[:n].T, Z[n:].T).T
        np.testing.assert_allclose(found[k], expected, rtol=1e-10, atol=1e-11 * np.abs(expected).max())
        np.testing.assert_array_equal(found[k], found[k].T)
        E = found[k]


def test_rows_are_exchanged_where_a_pivot_is_small() -> None:
    """A transition that turns every pair of states by a right angle has pivots of zero without it."""
    n, angle = 32, 0.5 * np.pi
    F = np.kron(np.eye(n // 2), [[0.0, angle], [-angle, 0.0]])
    H = np.block([[-F.T, np.zeros((n, n))], [np.zeros((n, n)), F]])
    E = np.diag(np.arange(1.0, n + 1.0))
    points = entries_of([ca.DM(H), ca.DM(H)], n)
    entries = [np.asarray(ca.DM(point).full()) for point in (points.first, points.second)]
    found = unpack(from_one(pack(E), entries, n, points.pattern, 1).T, n)[0]
    # of a linear system with constant coefficients the method gives the diagonal Pade approximant of order four
    numerator, denominator = (np.eye(n) + s * F / 2 + F @ F / 12 for s in (1.0, -1.0))
    D = np.linalg.solve(denominator, numerator)
    np.testing.assert_allclose(found, D @ E @ D.T, rtol=1e-12, atol=1e-11)


def test_memory_is_given_back_and_taken_again() -> None:
    """Nothing is kept after it; what follows is the same."""
    E, H1, H2 = systems(12, 3)
    points = entries_of([ca.DM(H1), ca.DM(H2)], 12)
    before = np.asarray(ca.DM(passed_by(ca.DM(pack(E)), points)).full())
    assert sweep._WORKSPACES._held > 0
    sweep.make_room()
    assert sweep._WORKSPACES._held == 0
    assert not sweep._WORKSPACES._kept
    np.testing.assert_array_equal(np.asarray(ca.DM(passed_by(ca.DM(pack(E)), points)).full()), before)


@pytest.mark.parametrize("change", ["none", "signs", "exchanged", "last"])
def test_a_large_passage_that_has_moved_is_run_again(monkeypatch: pytest.MonkeyPatch, change: str) -> None:
    """Its entries are known by a digest: two signs, two entries that change places, little of one at the last step."""
    monkeypatch.setattr(sweep, "MOST_FACTORS", 1)
    n, steps = 9, 24
    rng = np.random.default_rng(7)
    pattern = tuple(zip(*[(i, i) for i in range(2 * n)], *[(i + n, i) for i in range(n)], strict=True))
    order = np.lexsort(pattern)
    pattern = tuple(tuple(np.array(part)[order].tolist()) for part in pattern)
    H = 0.05 * rng.normal(size=(len(pattern[0]), steps))
    node = _sweep(n, pattern, steps, False, (), 0, False, 2)
    first, ends = pack(np.eye(n)), steps // 2
    seed = np.zeros((half_length(n), ends), order="F")
    seed[0, -1] = 1.0
    reverse = node.get_reverse(1, "slopes", ("",) * 5, ("",) * 3, {})

    def slopes(entries: np.ndarray) -> np.ndarray:
        given = np.asfortranarray(entries)
        after, found = np.empty((half_length(n), ends), order="F"), np.empty_like(given)
        node.eval_buffer((first.data, given.T.data, given.T.data), (after.T.data,))
        reverse.eval_buffer(
            (first.data, given.T.data, given.T.data, after.T.data, seed.T.data), (None, found.T.data, None)
        )
        return np.concatenate([after.ravel(), found.ravel()])

    before, moved = slopes(H), H.copy()
    if change == "signs":
        moved[:, [3, 7]] *= -1.0
    elif change == "exchanged":
        moved[:, [3, 4]] = moved[:, [4, 3]]
    elif change == "last":
        moved[0, -1] *= 1.0 + 1e-6
    again = slopes(moved)
    sweep.make_room()  # what follows knows nothing of what was before
    np.testing.assert_array_equal(again, slopes(moved))
    assert np.array_equal(again, before) == (change == "none")
