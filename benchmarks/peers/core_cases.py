"""The cases of core.py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from cases import Case

SIZES = {4: 1, 8: 3, 12: 5, 20: 9, 30: 14}  # size n of the covariance: masses
LARGEST_STATED = 12  # largest n at which the covariance as states is solved to the end
ONE_ITERATION = 20  # n at which the covariance as states is given one iteration
CHAIN_INTERVALS, OSCILLATOR_INTERVALS = 50, 100


def case(part: str, code: str, size: int, **options: Any) -> Case:
    """A case of a code with options of its function."""
    own = {"covocp": "covocp_solve", "statement": "covocp_statement"}
    function = f"core_codes.{own.get(code, 'peer')}"
    return Case(part=part, code=code, size=size, options={"function": function, "code": code, **options})


def oscillator_cases() -> list[Case]:
    """Part a: damped oscillator, unknown damping and stiffness."""
    codes = ("covocp", "packed", "naive", "eliminated")
    return [case("a", code, 4, system="oscillator", intervals=OSCILLATOR_INTERVALS) for code in codes]


def chain_cases(sizes: Sequence[int]) -> list[Case]:
    """Part b: chain of masses."""
    cases = []
    for n in sizes:
        options: dict[str, Any] = {"system": "chain", "masses": SIZES[n], "intervals": CHAIN_INTERVALS}
        codes = ["covocp", "eliminated", *(["packed", "rockit"] if n <= LARGEST_STATED else [])]
        cases += [case("b", code, n, **options) for code in codes]
        if n == LARGEST_STATED:
            cases.append(replace(case("b", "rockit", n, **options, wrapped=True), code="rockit, one function"))
        if n == ONE_ITERATION:
            cases.append(replace(case("b", "packed", n, **options, max_iter=1), code="packed, one iteration"))
    return cases


def building_cases(largest: int) -> list[Case]:
    """Part c: from the model to its frozen statement, and the import."""
    return [
        case("c", "statement", 4, system="oscillator"),
        case("c", "statement", largest, system="chain", masses=SIZES[largest]),
        Case(part="c", code="import covocp"),
        Case(part="c", code="import casadi, numpy"),
    ]
