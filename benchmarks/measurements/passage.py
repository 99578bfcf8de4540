"""The compiled passage of covariances against CasADi's own operations: a sweep, its slopes, and whole solves.

    python benchmarks/measurements/passage.py [rounds]

Both in one process and in turn, medians of processor seconds; every solve with a solver of its own.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from unittest import mock

import casadi as ca
import numpy as np

import covocp as co
from covocp.extremal import costates, hamiltonian_in_numbers, lagrangian
from covocp.models import mars_entry, mass_chain, unknown_lag
from covocp.passage import library
from covocp.passage.sweep import passed_by
from covocp.transcription import shooting
from covocp.transcription.mesh import Options
from covocp.transcription.scales import choose_scales
from covocp.transcription.starts import own_start
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.transcribing import transcribe

SIZES = (4, 8, 12, 20, 30)


def median_of(run: Callable[[], object], rounds: int) -> float:
    """Processor seconds of a call."""
    times = []
    for _ in range(rounds):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return statistics.median(times)


def evaluations(size: int, rounds: int) -> list[float]:
    """Seconds of f and of f with its gradient, compiled and plain."""
    statement = mass_chain.problem(masses=(size - 2) // 2).statement()
    mesh = resolve_mesh(statement, Options(intervals=50), statement.values)
    trajectory = own_start(statement, mesh, statement.values).trajectory
    result = []
    for passage in (passed_by, None):
        nlp = transcribe(statement, mesh, choose_scales(statement, mesh, trajectory, statement.values), passage)
        w, p = nlp.pack(trajectory), np.append(statement.values, 1.0)
        value = ca.Function("f", [nlp.w, nlp.p], [nlp.f])
        both = ca.Function("g", [nlp.w, nlp.p], list(nlp.gradient or (nlp.f, ca.gradient(nlp.f, nlp.w))))
        for function in (value, both):
            points = iter(np.outer(1 + 1e-9 * np.arange(10 * rounds), w))  # the last point is remembered
            result.append(median_of(lambda f=function, at=points, q=p: f(next(at), q), rounds))
    return result


def solves(problem: Callable[[], co.Problem], rounds: int, **options: int) -> list[float]:
    """Seconds of a first solve, of one more from the problem's own guess, and of one from the plan; both ways."""
    result = []
    for there in (True, False):
        times: list[list[float]] = []
        for _ in range(rounds):
            without = (lambda: None) if not there else library.functions
            with mock.patch.object(shooting, "functions", without):
                begin = time.process_time()
                solver = co.Solver(problem(), **options)
                plan = solver.solve(progress=False)
                first = time.process_time() - begin
                again = median_of(lambda s=solver: s.solve(progress=False), 1)
                warm = median_of(lambda s=solver, q=plan: s.solve(guess=q, progress=False, assess=False), 5)
            times.append([first, again, warm])
        result.append([statistics.median(column) for column in zip(*times, strict=True)])
    return [number for pair in zip(*result, strict=True) for number in pair]


def conditions(problem: Callable[[], co.Problem], rounds: int, **options: int) -> list[float]:
    """Seconds of a first solve, and of its `optimality` by numbers and by CasADi's expressions."""
    times = []
    for _ in range(rounds):
        first = median_of(lambda: co.solve(problem(), progress=False, **options), 1)
        found = [first]
        for by_numbers in (True, False):
            solution = co.solve(problem(), progress=False, **options)
            with ExitStack() as patches:
                for module in () if by_numbers else (costates, lagrangian):
                    patches.enter_context(mock.patch.object(module, "along_nodes", return_value=None))
                for module in () if by_numbers else (costates, hamiltonian_in_numbers):
                    patches.enter_context(mock.patch.object(module, "has_forms", return_value=False))
                found.append(median_of(lambda own=solution: own.optimality, 1))
        times.append(found)
    return [statistics.median(column) for column in zip(*times, strict=True)]


def main(rounds: int = 5) -> None:
    """Print all tables."""
    print(co.build_info())
    print("\nmilliseconds of an evaluation, chain of masses, 50 intervals (compiled, CasADi)")
    print("rows     f                 f and its gradient   gradient over f, compiled")
    for size in SIZES:
        value, both, plain_value, plain_both = (1e3 * t for t in evaluations(size, rounds))
        print(f"{size:4d} {value:8.2f} {plain_value:8.2f}   {both:8.2f} {plain_both:8.2f}   {both / value:8.2f}")
    print("\nmilliseconds of a solve (compiled, CasADi)")
    print("problem          first solve         again               from the plan, not assessed   of these a second")
    cases: list[tuple[str, Callable[[], co.Problem], dict[str, int]]] = [
        (f"chain, {size} rows", lambda n=size: mass_chain.problem(masses=(n - 2) // 2), {"intervals": 50})
        for size in SIZES
    ]
    cases += [("lag", unknown_lag.problem, {}), ("Mars entry", mars_entry.problem, {})]
    for name, problem, options in cases:
        t = [1e3 * value for value in solves(problem, rounds, **options)]
        rates = f"{1e3 / t[4]:8.0f} {1e3 / t[5]:8.0f}"
        print(f"{name:16s} {t[0]:8.1f} {t[1]:8.1f}   {t[2]:8.1f} {t[3]:8.1f}   {t[4]:8.1f} {t[5]:8.1f}   {rates}")
    print("\nmilliseconds of optimality (by numbers, by CasADi's expressions), and its share of a first solve")
    for name, problem, options in cases:
        first, own, plain = (1e3 * value for value in conditions(problem, rounds, **options))
        print(f"{name:16s} {own:8.1f} {plain:8.1f}   {own / first:8.2f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
