"""One thread of linear algebra while covocp computes: its matrices are too small to share.

OpenBLAS keeps the threads that it started busy for about a tenth of a second after every call. On two cores that
doubles the processor time of a solve, and those of several libraries wait for each other.
"""

from __future__ import annotations

import os
import sys
from functools import lru_cache
from typing import Protocol, cast

import casadi as ca
from threadpoolctl import OpenBLASController, ThreadpoolController, register


class CasadiBlasController(OpenBLASController):  # type: ignore[misc] # has no types
    """The OpenBLAS that comes with CasADi, under a name of its own."""

    filename_prefixes = ("libcasadi-tp-openblas",)


register(CasadiBlasController)
# What the names of libraries of linear algebra contain.
NAMES = ("blas", "blis", "mkl")


class BlasController(ThreadpoolController):  # type: ignore[misc] # has no types
    """The libraries of linear algebra that are loaded.

    The others, a hundred of them, are not looked at: resolving their paths takes 5 ms, a tenth of a first solve.
    """

    def _make_controller_from_path(self, filepath: str) -> None:
        if any(name in os.path.basename(filepath).lower() for name in NAMES):
            super()._make_controller_from_path(filepath)


def one_blas_thread() -> Limits:
    """Linear algebra in one thread from now on; what is returned restores as many as before."""
    return cast(Limits, _controller("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas"))


class Limits(Protocol):
    """Numbers of threads that were changed."""

    def restore_original_limits(self) -> None:
        """As many as before."""


@lru_cache(maxsize=2)
def _controller(_with_scipy: bool) -> BlasController:
    """What sets the threads of the libraries that are loaded; scipy has one of its own."""
    ca.has_linsol("lapacklu")  # loads the library that Ipopt's linear algebra uses as well
    return BlasController()
