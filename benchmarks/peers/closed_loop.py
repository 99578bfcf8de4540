"""How fast is the closed loop? Mars entry, section 6.12, Monte Carlo; against an expert's script and a plain loop.

    python benchmarks/peers/closed_loop.py            all, medians of five; writes docs/benchmarks_closed_loop.md
    python benchmarks/peers/closed_loop.py --quick    one run of each, coarse mesh and few runs; prints only
    python benchmarks/peers/closed_loop.py --only c   one part: a (Mars entry), b (section 6.12), c (Monte Carlo)

Every case runs in a process of its own (case.py), so that first solves are compared and each has its own peak memory.
The exit code is always 0; what misses its target is printed.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmark import Benchmark, Run
from cases import Case
from loop_targets import judge_runs, judge_system
from targets import Figure, figures_table

INTERVALS = {"mars": 183, "lag": 100}
COARSE = {"mars": 61, "lag": 40}
SIZES = {"mars": 5, "lag": 2}
GRADIENT_ITERATIONS = 30
RUNS, LOOP_RUNS, STEP = 3000, 100, 0.25  # s
LABELS = {
    "covocp": "covocp, defaults",
    "covocp, states": "covocp, F3",
    "covocp, gradient": f"covocp, {GRADIENT_ITERATIONS} iterations of the gradient method",
    "f3": "CasADi by hand, F3",
    "covocp, simulate": "covocp, Monte Carlo",
    "loop": "numpy loop over the runs",
}


TEXTS = (
    f"""Mars entry is that of Schmidt, chapter 7, with the recommended data and w = 1e-5, {INTERVALS["mars"]} intervals
    of 5 s, from constant lift; section 6.12 has {INTERVALS["lag"]} intervals and starts from the control of least
    energy. The controls are linear over each interval, two integration steps to each.""",
    """The script by hand is `peers_f3.py`: nominal, error covariance E and cost-to-go S as states of one nonlinear
    program (F3), scaled as an expert scales it; two classical Runge-Kutta steps an interval in one expanded function
    that is mapped over the intervals, a shooting node at every interval, exact Hessian, Ipopt. It keeps Ipopt's
    tolerance of 1e-8; covocp's default is 1e-7 on its scaled problem. covocp's default eliminates both matrices; its
    F3 is `covariances="states"`. Its times contain all that a user waits for: also the closed loop along the solution,
    and the classical design that the solution is compared with.""",
    f"""An iteration of the gradient method is published as one minute on an IBM 360-75. Here it is the mean of the
    first {GRADIENT_ITERATIONS}, without building.""",
    f"""The Monte Carlo flies constant lift: {RUNS} runs by covocp, {LOOP_RUNS} in `peers_monte_carlo.py`, one run after
    another in Python on vectors of numpy, by the same scheme in the same steps of {STEP} s, nominal and gains computed
    beforehand and not timed; nor is covocp's nominal. The linear prediction holds for this design, so that the terminal
    deviations check both.""",
)


def solved(part: str, system: str, intervals: int) -> list[Case]:
    """Parts a and b: one system by all codes."""
    own: dict[str, dict[str, Any]] = {
        "covocp": {},
        "covocp, states": {"options": {"covariances": "states"}},
        "covocp, gradient": {"method": "gradient", "options": {"max_iterations": GRADIENT_ITERATIONS}},
    }
    common = {"system": system, "intervals": intervals}
    size = SIZES[system]
    return [
        *[
            Case(
                part=part,
                code=code,
                size=size,
                options={"function": "loop_codes.covocp_solve", **common, **more},
            )
            for code, more in own.items()
        ],
        Case(part=part, code="f3", size=size, options={"function": "loop_codes.by_hand", **common}),
    ]


def simulated(runs: int, loop_runs: int) -> list[Case]:
    """Part c: the Monte Carlo."""
    common = {"step": STEP, "intervals": INTERVALS["mars"]}
    kinds = (("covocp, simulate", "covocp_simulate", runs), ("loop", "loop_simulate", loop_runs))
    return [
        Case(part="c", code=code, options={"function": f"loop_codes.{function}", "runs": count, **common})
        for code, function, count in kinds
    ]


def parts(quick: bool) -> dict[str, list[Case]]:
    """The cases by part."""
    meshes = COARSE if quick else INTERVALS
    return {
        "a": solved("a", "mars", meshes["mars"]),
        "b": solved("b", "lag", meshes["lag"]),
        "c": simulated(RUNS // 10, LOOP_RUNS // 10) if quick else simulated(RUNS, LOOP_RUNS),
    }


def judge(cases: Sequence[Case]) -> list[Figure]:
    """All figures of the parts that were measured."""
    figures: list[Figure] = []
    for part, system in (("a", "mars"), ("b", "lag")):
        case = next((case for case in cases if case.part == part), None)
        if case is not None:
            fine = case.options["intervals"] == INTERVALS[system]
            figures += judge_system(cases, part, system, SIZES[system], fine)
    if any(case.part == "c" for case in cases):
        figures += judge_runs(cases)
    return figures


def write(folder: Path, run: Run) -> None:
    """Write benchmarks_closed_loop.md."""
    import report

    sections = [
        "# Benchmarks of the closed loop",
        report.conditions(run, "closed_loop.py", ("casadi", "numpy")),
        *(textwrap.fill(" ".join(text.split()), 120) for text in TEXTS),
        "## Targets",
        figures_table(run.figures),
        "## All cases",
        report.cases_table(run.cases, LABELS),
    ]
    (folder / "benchmarks_closed_loop.md").write_text("\n\n".join(sections) + "\n", encoding="utf-8")


if __name__ == "__main__":
    benchmark = Benchmark(
        description=__doc__ or "", quick="a coarse mesh and a tenth of the runs", parts=parts, judge=judge, write=write
    )
    sys.exit(benchmark.main())
