"""The series behind the θ-D laws: Riccati solution of A0 + A(x) in powers of A(x), in closed form.

M. Xin, S. N. Balakrishnan, "A new state observer and flight control of highly maneuverable aircraft", ACC 2009. With
S = B R^-1 B' and A_c = A0 - S T_0 the terms are

    T_0 A0 + A0' T_0 - T_0 S T_0 + Q = 0
    T_n A_c + A_c' T_n = epsilon_n G_n,   G_n = -(T_(n-1) A + A' T_(n-1)) + sum_(j=1..n-1) T_j S T_(n-j)

The left side is one constant linear operator on half-vectors, whose inverse is computed once, numerically ("operator"
form). Where A(x) = sum of phi_k(x) A_k, T_n is a polynomial in phi and epsilon whose coefficients are computed once
("polynomial" form). Neither solves a linear system when it runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import half_indices, half_length, pack, pack_symbolic, unpack, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.blocks import values
from covocp.blocks.algebraic import Words, lyapunov, stabilising, weights
from covocp.blocks.factorisation import random_states

Array = NDArray[np.float64]
Monomial = tuple[int, ...]
Polynomial = dict[Monomial, Array]

# Scales of the random states at which entries of A(x) are compared, and the relative error up to which they count as
# linearly dependent: what agrees at all these scales, and then at those of any unit, is the same function.
SCALES = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 0.03, 0.3, 1.0, 3.0, 1e2, 1e4, 1e6)
UNITS = tuple(10.0**k for k in range(-30, 31, 3))
DEPENDENCE_TOLERANCE = 1e-11
# Rounding of a state, and of what is computed from it, relative: at large states it moves what changes fast.
STATE_ROUNDING = 16 * float(np.finfo(float).eps)
# Coefficients of such combinations, of entries of size 1, that are none.
ROUNDOFF = 1e-13
# Operations of functions that are known everywhere from their values anywhere.
ANALYTIC = {
    *(ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_ASSIGN, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV, ca.OP_NEG),
    *(ca.OP_TWICE, ca.OP_SQ, ca.OP_INV, ca.OP_SQRT, ca.OP_POW, ca.OP_CONSTPOW, ca.OP_EXP, ca.OP_EXPM1, ca.OP_LOG),
    *(ca.OP_LOG1P, ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_SINH, ca.OP_COSH),
    *(ca.OP_TANH, ca.OP_ASINH, ca.OP_ACOSH, ca.OP_ATANH, ca.OP_ERF),
}


@dataclass(frozen=True, kw_only=True)
class Start:
    """What does not depend on x, of a regulator with n states and m inputs or of the dual of a filter.

    Attributes:
        riccati: T_0, (n, n).
        closed_loop: A_c = A0 - S T_0, (n, n).
        feedback: R^-1 B', (m, n): the gain is feedback @ T.
        root: n x m matrix U with U U' = S.
        inverse: inverse of vech(T) -> vech(T A_c + A_c' T), (n(n+1)/2, n(n+1)/2).
    """

    riccati: Array
    closed_loop: Array
    feedback: Array
    root: Array
    inverse: Array

    __repr__ = short_repr

    def corrected(self, right: Array) -> Array:
        """The symmetric T with T A_c + A_c' T = right, (n, n)."""
        return unpack(self.inverse @ pack(right), self.riccati.shape[0])


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Regulator or filter.

    Attributes:
        words: what the user calls the matrices.
        dual: they are those of a filter: A0, H and A(x) are transposed.
        printed: A(x) of the filter is not transposed, as printed.
    """

    words: Words
    dual: bool = False
    printed: bool = False


REGULATOR = Kind(
    words=Words(
        names=("A0", "B", "Q", "R"),
        reach=("(A0, B)", "stabilisable", "move part of A(x) to A0, or add an input", "B does not reach"),
        see=("(A0, Q^1/2)", "detectable", "give the mode a weight, or move part of A(x) to A0", "Q gives no weight"),
    )
)
FILTER_WORDS = Words(
    names=("A0", "H", "W", "V"),
    reach=("(A0, H)", "detectable", "move part of A(x) to A0, or add a measurement", "H does not see"),
    see=("(A0, W^1/2)", "stabilisable", "give W an entry for the mode, or move part of A(x) to A0", "W does not reach"),
)
FILTER = Kind(words=FILTER_WORDS, dual=True)
PRINTED_FILTER = Kind(words=FILTER_WORDS, dual=True, printed=True)


def start(A0: Expr, B: Expr, Q: Expr, R: Expr, kind: Kind = REGULATOR) -> Start:
    """T_0, the closed loop and the inverse of the Lyapunov operator.

    Args:
        A0: constant part of the dynamics, (n, n).
        B: input matrix, (n, m).
        Q: weight of the state, (n, n), positive semidefinite.
        R: weight of the input, (m, m), positive definite.
        kind: FILTER: the arguments are A0, H, W, V of a filter, whose dual regulator is meant.

    Returns:
        What the terms are made of.

    Raises:
        ProblemError: shapes, weights, symbols where numbers are needed, or a pair that is not stabilisable or not
            detectable, with its mode.
    """
    first, second, *_ = kind.words.names
    if kind.dual:
        A0 = values.square(first, A0)
        B = values.matrix(second, B, (None, A0.shape[0])).T
        A0 = A0.T
    a, b, q, r, cross = weights(A0, B, Q, R, None, kind.words)
    riccati = stabilising(a, b, q, r, cross, discrete=False, detectable=True, words=kind.words)
    feedback = np.asarray(np.linalg.solve(r, b.T))
    closed_loop = a - b @ feedback @ riccati
    root: Array = np.asarray(np.linalg.solve(np.linalg.cholesky(r), b.T).T)
    return Start(
        riccati=values.symmetrised(riccati),
        closed_loop=closed_loop,
        feedback=feedback,
        root=root,
        inverse=inverse_lyapunov(closed_loop),
    )


def epsilons(t: Expr, k: Array, l: Array) -> tuple[list[Any], list[int | float], list[Any]]:
    """Factors epsilon_n(t) = 1 - k_n exp(-l_n t) of the corrections.

    Args:
        t: SX symbol [s].
        k: one for each correction, (N,).
        l: one for each correction, (N,) [1/s].

    Returns:
        The factors; for `polynomials` their constant values or the indices of their variables; the variables, each
        once.
    """
    factors: list[Any] = []
    indices: list[int | float] = []
    variables: dict[tuple[float, float], Any] = {}
    for pair in zip(k.tolist(), l.tolist(), strict=True):
        if pair[0] == 0.0 or pair[1] == 0.0:
            factors.append(1.0 - pair[0])
            indices.append(1.0 - pair[0])
            continue
        factors.append(variables.setdefault(pair, 1.0 - pair[0] * ca.exp(-pair[1] * t)))
        indices.append(list(variables).index(pair))
    return factors, indices, list(variables.values())


def corrections(begin: Start, A: Expr, epsilon: Sequence[Any]) -> list[Any]:
    """Terms T_0, ..., T_N in the operator form.

    Args:
        begin: of `start`.
        A: A(x), SX, (n, n).
        epsilon: one factor for each of the N corrections, SX or numbers.
    """
    inverse = ca.DM(begin.inverse)
    terms = [ca.SX(ca.DM(begin.riccati))]
    roots: list[Any] = []  # T_j U, j >= 1
    for factor in epsilon:
        solved = factor * (inverse @ pack_symbolic(right_side(terms[-1], roots, A)))
        terms.append(unpack_symbolic(solved, begin.riccati.shape[0]))
        roots.append(terms[-1] @ ca.DM(begin.root))
    return terms


def right_side(last: Expr, roots: Sequence[Any], A: Expr) -> Any:
    """G_n from T_(n-1) and from T_j U, j = 1, ..., n-1."""
    right = -(last @ A + A.T @ last)
    for left, other in zip(roots, reversed(roots), strict=True):
        right = right + left @ other.T
    return right


def separated(x: Expr, A: Expr) -> tuple[list[Any], list[Array]]:
    """A(x) as a sum of scalar functions times constant matrices, one function for each independent entry.

    Whether analytic entries depend on each other linearly is seen from their values at random states; entries with
    branches are taken to be independent.

    Args:
        x: SX symbol, (n, 1).
        A: SX, (n, n).

    Returns:
        Functions phi_k, each an entry of A, and their matrices A_k, (n, n).
    """
    rows, columns = A.sparsity().get_triplet()
    if not rows:
        return [], []
    entries = ca.vertcat(*A.nonzeros())
    inputs: Any = ([x], [entries])
    basis, coefficients = _dependences(ca.Function("entries", *inputs))
    matrices = np.zeros((basis.size, *A.shape))
    matrices[:, rows, columns] = coefficients
    return [entries[int(i)] for i in basis], list(matrices)


def _dependences(entries: Expr) -> tuple[NDArray[np.intp], Array]:
    """Indices of independent entries, and all the entries as combinations of these, (independent, entries)."""
    from scipy.linalg import qr, solve_triangular

    count = entries.size1_out(0)
    apart = np.arange(count), np.eye(count)
    used_operations = {entries.instruction_id(k) for k in range(entries.n_instructions())}
    sampled, fresh = (_values(entries, seed) for seed in (1, 2))
    if not used_operations <= ANALYTIC or min(len(sampled), len(fresh)) < 2 * count:
        return apart
    norms = np.linalg.norm(sampled, axis=0)
    used = np.flatnonzero(norms > 0.0)
    if used.size == 0:
        return used, np.zeros((0, count))
    _, triangle, order = qr(sampled[:, used] / norms[used], mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(triangle))
    rank = int(np.sum(diagonal > DEPENDENCE_TOLERANCE * diagonal[0]))
    scaled = np.hstack([np.eye(rank), solve_triangular(triangle[:rank, :rank], triangle[:rank, rank:])])
    scaled[np.abs(scaled) < ROUNDOFF] = 0.0
    basis = used[order[:rank]]
    coefficients = np.zeros((rank, count))
    coefficients[:, used[order]] = scaled * norms[used[order]] / norms[basis, None]
    alike = _combine(fresh, 0.0, basis, coefficients) and _combine(*_in_any_units(entries), basis, coefficients)
    return (basis, coefficients) if alike else apart


def _combine(values: Array, blurs: Array | float, basis: NDArray[np.intp], coefficients: Array) -> bool:
    """Whether all entries are the combinations of those of the basis, but for rounding."""
    sizes = DEPENDENCE_TOLERANCE * np.abs(values) + blurs
    allowed = sizes[:, basis] @ np.abs(coefficients) + sizes
    return bool((np.abs(values[:, basis] @ coefficients - values) <= allowed).all())


def polynomials(
    begin: Start, matrices: Sequence[Array], factors: Sequence[int | float], variables: int
) -> list[Polynomial]:
    """Terms T_0, ..., T_N as polynomials in phi_k and in the factors epsilon.

    Args:
        begin: of `start`.
        matrices: A_k of phi_k.
        factors: epsilon of each correction: a float is its constant value, a whole number the index of its variable.
        variables: number of different variables epsilon.

    Returns:
        For each term a dictionary from exponents (of phi, then of epsilon) to constant matrices (n, n).
    """
    count = len(matrices) + variables
    units = [tuple(int(i == k) for i in range(count)) for k in range(count)]
    weight = begin.root @ begin.root.T
    terms: list[Polynomial] = [{(0,) * count: begin.riccati}]
    for n, factor in enumerate(factors, start=1):
        right: Polynomial = {}
        for (exponents, T), (k, A) in product(terms[-1].items(), enumerate(matrices)):
            _add(right, _plus(exponents, units[k]), -(T @ A + A.T @ T))
        for j in range(1, n):
            for (one, left), (two, other) in product(terms[j].items(), terms[n - j].items()):
                _add(right, _plus(one, two), left @ weight @ other)
        scale, unit = (1.0, units[len(matrices) + factor]) if isinstance(factor, int) else (factor, (0,) * count)
        term = {_plus(key, unit): scale * begin.corrected(value) for key, value in right.items()}
        terms.append(term or {(0,) * count: np.zeros_like(begin.riccati)})
    return terms


def monomials(functions: int, factors: Sequence[int | float], limit: int) -> int:
    """Number of monomials of all corrections of `polynomials`, or `limit` where there are more.

    The count goes through the exponents only.
    """
    count = functions + 1 + max((f for f in factors if isinstance(f, int)), default=-1)
    units = [tuple(int(i == k) for i in range(count)) for k in range(count)]
    terms: list[set[Monomial]] = [{(0,) * count}]
    for n, factor in enumerate(factors, start=1):
        keys = {_plus(e, units[k]) for e, k in product(terms[-1], range(functions))}
        for j in range(1, n):
            keys |= {_plus(one, two) for one, two in product(terms[j], terms[n - j])}
        unit = units[functions + factor] if isinstance(factor, int) else (0,) * count
        terms.append({_plus(key, unit) for key in keys})
        if sum(map(len, terms[1:])) >= limit:
            return limit
    return sum(map(len, terms[1:]))


def evaluated(polynomial: Polynomial, variables: Sequence[Any], factor: Array | None = None) -> Any:
    """A polynomial with matrix coefficients in expressions; `factor` multiplies each coefficient from the left."""
    total: Any = 0.0
    for exponents, coefficient in polynomial.items():
        monomial = ca.SX(1)
        for variable, exponent in zip(variables, exponents, strict=True):
            for _ in range(exponent):
                monomial = monomial * variable
        total = total + monomial * ca.DM(coefficient if factor is None else factor @ coefficient)
    return total


def added(terms: Sequence[Polynomial]) -> Polynomial:
    """Sum of polynomials; equal monomials are joined."""
    total: Polynomial = {}
    for term in terms:
        for exponents, coefficient in term.items():
            _add(total, exponents, coefficient)
    return total


def _add(polynomial: Polynomial, exponents: Monomial, coefficient: Array) -> None:
    present = polynomial.get(exponents)
    polynomial[exponents] = coefficient if present is None else present + coefficient


def _plus(one: Monomial, two: Monomial) -> Monomial:
    return tuple(a + b for a, b in zip(one, two, strict=True))


def _values(function: Expr, seed: int) -> Array:
    """Values of a function at random states where they are finite, (samples, entries), each row divided by its size."""
    states = random_states(function.size1_in(0), 32 * function.size1_out(0) + 64, seed, SCALES)
    found = np.asarray(function.map(len(states))(states.T).full().T)
    sizes = np.abs(found).max(axis=1)
    known = np.isfinite(sizes) & (sizes > 0.0)
    return np.asarray(found[known] / sizes[known, None])


def _in_any_units(function: Expr) -> tuple[Array, Array]:
    """Values as `_values` has them, at states of all sizes, and what the rounding of the state does to them."""
    state = ca.SX.sym("x", function.size1_in(0))
    values = function(state)
    inputs: Any = ([state], [values, ca.fabs(ca.jacobian(values, state)) @ ca.fabs(state)])
    states = random_states(state.numel(), 32 * values.numel() + 64, 3, UNITS)
    found = ca.Function("values", *inputs).map(len(states))(states.T)
    entries, moved = (np.asarray(part.full().T) for part in found)
    sizes = np.abs(entries).max(axis=1)
    known = np.isfinite(sizes) & (sizes > 0.0) & np.isfinite(moved).all(axis=1)
    return entries[known] / sizes[known, None], STATE_ROUNDING * moved[known] / sizes[known, None]


def inverse_lyapunov(closed_loop: Array) -> Array:
    """Inverse of vech(T) -> vech(T A_c + A_c' T), column by column."""
    size = closed_loop.shape[0]
    columns = np.empty((half_length(size), half_length(size)))
    for index, (row, column) in enumerate(zip(*half_indices(size), strict=True)):
        right = np.zeros((size, size))
        right[row, column] = right[column, row] = 1.0
        columns[:, index] = pack(lyapunov(closed_loop.T, -right))
    return columns
