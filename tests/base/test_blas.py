"""Threads of linear algebra are one while covocp computes, and as many as before afterwards."""

from __future__ import annotations

from operator import itemgetter

import casadi as ca
import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_info, threadpool_limits

import covocp as co
from covocp.base.blas import BlasController
from covocp.base.threads import TURN


def counts() -> dict[str, int]:
    """Threads of each library that is loaded."""
    return {one["filepath"]: one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_every_library_of_linear_algebra_is_found_among_all_that_are_loaded():
    ca.has_linsol("lapacklu")
    every = [one for one in ThreadpoolController().info() if one["user_api"] == "blas"]
    assert any("casadi" in one["filepath"] for one in every)
    key = itemgetter("filepath")
    assert sorted(BlasController().info(), key=key) == sorted(every, key=key)


def test_linear_algebra_has_one_thread_for_as_long_as_a_call_lasts():
    seen = []
    with threadpool_limits(limits=2, user_api="blas"):
        before = counts()

        def guess(s):
            seen.append(counts())
            return np.ones_like(s)

        ocp = co.Problem(1.0)
        x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u", guess=guess)
        ocp.dynamics(x, u)
        ocp.minimize(running=u**2)
        assert co.solve(ocp, intervals=10).cost == pytest.approx(1.0)
        assert before.items() <= counts().items()
    assert len(before) >= 1
    assert seen
    assert set(seen[0].values()) == {1}


def test_they_are_restored_after_an_error_and_while_other_threads_have_their_turn():
    with threadpool_limits(limits=2, user_api="blas"):
        before = counts()
        with pytest.raises(co.ProblemError):
            co.solve(co.Problem(1.0))
        assert counts() == before
        with TURN:
            with TURN:
                assert set(counts().values()) == {1}
            assert set(counts().values()) == {1}
            with TURN.handed_over():
                assert counts() == before
            assert set(counts().values()) == {1}
        assert counts() == before
