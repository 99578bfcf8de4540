"""Nodes from local errors: equal shares, jumps found where they are, nodes that must stay."""

from __future__ import annotations

import numpy as np
import pytest

from covocp.transcription.remeshing import demand, divided, jumps_of, remeshed


def test_intervals_of_a_smooth_density_have_equal_errors():
    """Error d(s) h^5 of an interval with d = 1e4 (1 + 50 s)^5: equal shares ask for h ~ 1/(1 + 50 s)."""
    nodes = np.linspace(0.0, 1.0, 41)
    for _ in range(4):
        ends = np.sort(np.append(nodes, 0.5 * (nodes[1:] + nodes[:-1])))
        h, middle = np.diff(ends), 0.5 * (ends[1:] + ends[:-1])
        errors = 16 * 1e4 * (1 + 50 * middle) ** 5 * h**5  # halves of the error of whole intervals
        nodes = remeshed(nodes, ends, errors, 5, 1e-3, [], np.zeros(0))
    h, middle = np.diff(nodes), 0.5 * (nodes[1:] + nodes[:-1])
    each = 1e4 * (1 + 50 * middle) ** 5 * h**5
    assert each.sum() == pytest.approx(1e-3, rel=0.2)
    assert each.max() < 3 * each.min()


@pytest.mark.parametrize("place", [0.5, 0.437, 0.71])
@pytest.mark.parametrize("constant", [False, True])
def test_a_jump_lies_where_a_sudden_one_has_the_same_integral(place, constant):
    """Controls as an optimiser has them: the line 1 + s before, -1 after, and in between what keeps the integral."""
    nodes = np.linspace(0.0, 1.0, 21)
    before = (lambda s: 1.0 + s) if not constant else (lambda s: 1.0 + 0 * s)
    k = int(np.searchsorted(nodes, place)) - 1
    if constant:
        u = np.where(np.arange(20) < k, 1.0, -1.0)
        u[k] = ((place - nodes[k]) - (nodes[k + 1] - place)) * 20
    else:
        u = np.where(np.arange(21) <= k, before(nodes), -1.0)
        h = nodes[1]
        exact = before(0.5 * (nodes[k - 1] + place)) * (place - nodes[k - 1]) - (nodes[k + 2] - place)
        u[k] = (exact / h - 0.5 * (u[k - 1] + u[k + 1]) - 0.5 * (u[k + 1] + u[k + 2])) / 1.0
    found = jumps_of(nodes, u[:, None], constant)
    assert len(found) == 1
    assert found[0].place == pytest.approx(place, abs=2e-3)
    assert found[0].begin <= place <= found[0].end


def test_slopes_and_kinks_are_no_jumps():
    nodes = np.linspace(0.0, 1.0, 31)
    for u in (nodes, np.abs(nodes - 0.5), np.clip(4 * nodes - 2, -1, 1), np.sin(6 * nodes), np.ones(31)):
        assert jumps_of(nodes, u[:, None], False) == []


def test_steep_intervals_are_compared_in_thirds_and_others_in_halves():
    nodes = np.array([0.0, 0.4, 0.5, 1.0])
    u = np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    assert divided(nodes, u, False) == pytest.approx([0.0, 0.2, 0.4, 0.4 + 0.1 / 3, 0.4 + 0.2 / 3, 0.5, 0.75, 1.0])
    twice = np.array([0.0, 0.4, 0.4, 0.5, 1.0])
    assert np.array_equal(
        divided(twice, np.array([1.0, 1.0, 1.0, -1.0, -1.0])[:, None], False), divided(nodes, u, False)
    )


def test_nodes_that_must_stay_stay():
    nodes = np.linspace(0.0, 1.0, 11)
    ends = np.linspace(0.0, 1.0, 21)
    kept = np.array([0.123, 0.7])
    for errors in (np.zeros(20), np.full(20, 1e-3)):
        result = remeshed(nodes, ends, errors, 5, 1e-6, [], kept)
        assert np.isin(kept, result).all()
        assert (np.diff(result) > 0).all()
        assert (result[0], result[-1]) == (0.0, 1.0)


def test_meshes_that_share_what_is_allowed_have_intervals_of_one_error():
    """Two meshes with errors of different size: shares by what each demands give all intervals the same error."""
    sizes = (1e4, 3.0)
    meshes = [np.linspace(0.0, 1.0, 41), np.linspace(0.0, 1.0, 21)]
    for _ in range(5):
        given = []
        for size, nodes in zip(sizes, meshes, strict=True):
            ends = np.sort(np.append(nodes, 0.5 * (nodes[1:] + nodes[:-1])))
            given.append((nodes, ends, 16 * size * np.diff(ends) ** 5, 5))
        demands = [demand(*own, []) for own in given]
        meshes = [
            remeshed(*own, 1e-6 * part / sum(demands), [], np.zeros(0))
            for own, part in zip(given, demands, strict=True)
        ]
    each = [size * np.diff(nodes) ** 5 for size, nodes in zip(sizes, meshes, strict=True)]
    assert sum(own.sum() for own in each) == pytest.approx(1e-6, rel=0.3)
    assert max(own.max() for own in each) < 3 * min(own.min() for own in each)
