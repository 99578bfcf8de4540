"""Quadratic functions to be estimated."""

from __future__ import annotations

import numpy as np


def random_quadratic(seed, inputs):
    """M, b of f(x) = c + b'x + x'M x / 2, and f."""
    generator = np.random.default_rng(seed)
    root = generator.standard_normal((inputs, inputs))
    M, b = root + root.T, generator.standard_normal(inputs)
    return M, b, lambda x: 7.0 + b @ x + 0.5 * x @ M @ x


def packed(M, b):
    """Zeta as section 1.2 of the specification orders it, written out."""
    size = len(b)
    pairs = [M[i, j] for i in range(size) for j in range(i + 1, size)]
    return np.array([*np.diag(M), *pairs, *b])
