"""Set before numpy and casadi are loaded, here and in the processes that tests start."""

import gc
import os
from collections.abc import Iterator

import pytest

# Two workers with threads of their own wait for each other's: the matrices are too small to share.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect thousands of tests, which all stay, without looking for garbage among them again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()
