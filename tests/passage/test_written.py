"""The passage as exported code has it, against the one that keeps what it needs, and the memory that it is given."""

from __future__ import annotations

import numpy as np
import pytest

from covocp.base.matrices import half_length, pack
from covocp.passage import library
from covocp.passage.shape import shape

pytestmark = pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))

STEPS, GUARD = 5, 64


def points(n: int, information: float, *, sparse: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A covariance, h H of all steps at both points; two entries are measured."""
    rng = np.random.default_rng(n)

    def one() -> np.ndarray:
        F, B, C = 0.3 * rng.normal(size=(n, n)), rng.normal(size=(n, 2)), np.zeros((2, n))
        C[:, :2] = rng.normal(size=(2, min(2, n)))
        Q = np.diag(rng.uniform(0.1, 1.0, n)) if sparse else B @ B.T
        F = np.triu(np.tril(F, 1), -1) if sparse else F
        return 0.05 * np.block([[-F.T, information * C.T @ C], [Q, F]])

    A = rng.normal(size=(n, n))
    H = np.array([one() for _ in range(STEPS)])
    return A @ A.T + np.eye(n), H, 1.01 * H


@pytest.mark.parametrize("n", [1, 2, 3, 7, 8, 9, 16, 31])
@pytest.mark.parametrize(("information", "sparse"), [(1.0, False), (1.0, True), (1e4, False), (1e4, True)])
def test_both_give_the_same_and_nothing_is_written_behind_the_results(n: int, information: float, sparse: bool) -> None:
    """Also where the whole transition is made (an information of 1e4), and for slopes of all entries and of two."""
    there = library.needed()
    E, *both = points(n, information, sparse=sparse)
    columns, rows = np.nonzero((np.abs(both[0]) + np.abs(both[1])).sum(0).T)
    first, (h1, h2) = pack(E), (np.ascontiguousarray(H[:, rows, columns]) for H in both)
    own = shape(n, (tuple(rows.tolist()), tuple(columns.tolist())), STEPS, (), 0)
    chosen = np.full(2 * n + GUARD, -7, dtype=np.intc)
    results = [np.full(int(there["exported_length"](own.ctypes.data, of)) + GUARD, -7.0) for of in (0, 1)]
    at = [array.ctypes.data for array in (own, chosen, first, h1, h2, *results)]
    there["exported_forward"](*at[:6])
    memory = there["passage_new"](at[0], own.size, 0, 10**6)
    after = np.empty((STEPS, half_length(n)))
    there["passage_forward"](memory, *at[2:5], None, None, after.ctypes.data)
    size = np.abs(after).max(axis=1, keepdims=True)
    np.testing.assert_allclose(results[0][: after.size].reshape(after.shape) / size, after / size, atol=1e-11)

    def slopes(values: np.ndarray, seed: np.ndarray) -> list[np.ndarray]:
        """By the library for this processor, from a first half-vector."""
        known = [np.empty(array.size) for array in (first, h1, h2)]
        places = [array.ctypes.data for array in known]
        there["passage_reverse"](
            memory, values.ctypes.data, *at[3:5], None, None, seed.ctypes.data, *places, None, None
        )
        return known

    moved = [first * (1 + 1e-15 * np.random.default_rng(k).normal(size=first.size)) for k in range(4)]
    for seed in (np.random.default_rng(5).normal(size=after.size), np.r_[np.zeros(after.size - 1), 2.0]):
        there["exported_slopes"](*at[:2], *at[3:6], seed.ctypes.data, at[6])
        known, beside = slopes(first, seed), [slopes(values, seed) for values in moved]
        found = np.split(results[1], np.cumsum([array.size for array in known]))[:3]
        for i, (one, other) in enumerate(zip(found, known, strict=True)):
            # Both round differently: by no more than a few times what rounding of the first half-vector changes.
            own_change = max(float(np.abs(each[i] - other).max()) for each in beside)
            np.testing.assert_allclose(one, other, atol=4.0 * own_change + 1e-11 * np.abs(other).max(), rtol=0.0)
    there["passage_free"](memory)
    assert all((result[-GUARD:] == -7.0).all() for result in results)
    assert (chosen[2 * n + 1 :] == -7).all()
