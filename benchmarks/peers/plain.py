"""Plain problems of known optimum to a relative error of 1e-6: covocp's refined meshes against other tools and by hand.

    python benchmarks/peers/plain.py           every tool on every problem, medians of five runs in random order
    python benchmarks/peers/plain.py --quick   one run of each

Each case runs in a process of its own; times are those of the processor for a first solve, building included, imports
left out: on an idle machine what a user waits, all run on one thread. covocp and maptor refine their meshes to the
accuracy that is asked for. The other tools have equal meshes. Who uses them does not know the optimum, and so solves on
one after the other until the cost settles: "until it settles". "To 1e-6" is the coarsest mesh that is exact enough,
found in another process by the optimum itself, and nothing else is timed: what a user cannot have, and the hardest to
compare with. rockit, whose mesh is changed by building anew, has 100 intervals. "By hand" and the scripts of
casadi.Opti, whose steps are mapped or in a loop, have 100 as well: on these the error is that of covocp's 100
intervals, and the last line compares their times. What is not installed is left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import statistics
from collections.abc import Sequence

from cases import Case, measure
from plain_problems import PLAIN

REFINE, INTERVALS, REPEATS = 1e-6, 100, 5
OWN = "covocp, refined"
PLAIN_MESH = "covocp, 100 intervals"
OTHERS = ("rockit", "maptor", "yapss")
# Codes that have covocp's steps on its equal mesh.
ALIKE = ("Opti", "Opti, loop", "by hand")
CODES = (
    OWN,
    PLAIN_MESH,
    *ALIKE,
    "by hand, to 1e-6",
    "by hand, until it settles",
    "rockit",
    "maptor, refined",
    "yapss, to 1e-6",
    "yapss, until it settles",
)


def cases() -> list[Case]:
    """Every tool that is there, on every problem."""
    own = {
        OWN: {"function": "plain_codes.covocp_solve", "refine": REFINE},
        PLAIN_MESH: {"function": "plain_codes.covocp_solve"},
        "Opti": {"function": "plain_codes.opti", "intervals": INTERVALS, "mapped": True},
        "Opti, loop": {"function": "plain_codes.opti", "intervals": INTERVALS, "mapped": False},
        "by hand": {"function": "plain_codes.hand", "intervals": INTERVALS},
        "by hand, to 1e-6": {"function": "plain_codes.hand_to_accuracy", "refine": REFINE},
        "by hand, until it settles": {"function": "plain_codes.hand_until_settled", "refine": REFINE},
        "rockit": {"function": "plain_codes.rockit", "intervals": INTERVALS},
        "maptor, refined": {"function": "plain_codes.maptor", "refine": REFINE},
        "yapss, to 1e-6": {"function": "plain_codes.yapss_to_accuracy", "refine": REFINE},
        "yapss, until it settles": {"function": "plain_codes.yapss_until_settled", "refine": REFINE},
    }
    tools = {code: code.partition(",")[0] for code in CODES}
    there = [code for code in CODES if tools[code] not in OTHERS or importlib.util.find_spec(tools[code])]
    return [Case(part=name, code=code, options={**own[code], "problem": name}) for name in PLAIN for code in there]


def table(measured: Sequence[Case]) -> str:
    """Error, intervals and seconds of each, a row for each problem."""
    codes = list(dict.fromkeys(case.code for case in measured))
    lines = ["| problem | " + " | ".join(codes) + " |", "|---" * (1 + len(codes)) + "|"]
    for name in PLAIN:
        row = []
        for code in codes:
            case = next(entry for entry in measured if (entry.part, entry.code) == (name, code))
            off, seconds = case.median("off"), case.median()
            row.append("failed" if off is None or seconds is None else f"{off:.0e}, {seconds:.2f} s")
        lines.append(f"| {name} | " + " | ".join(row) + " |")
    reached = []
    for code in codes:
        own = [(case.median("off"), case.median()) for case in measured if case.code == code]
        count = sum((off if off is not None else math.inf) <= REFINE for off, _ in own)
        fast = sum((off or 0.0) <= REFINE and (s or math.inf) <= 1.0 for off, s in own if off is not None)
        reached.append(f"**{count} of {len(own)}**, {fast} within 1 s")
    lines.append("| error at most 1e-6 | " + " | ".join(reached) + " |")
    ahead = [f"{sum(_ahead(measured, name, code) for name in PLAIN)} of {len(PLAIN)}" for code in codes[1:]]
    lines.append(f"| {OWN}, is faster, or alone reaches 1e-6 | - | " + " | ".join(ahead) + " |")
    medians = [statistics.median([_ratio(measured, name, code) for name in PLAIN]) for code in codes[1:]]
    times = " | ".join("alone" if math.isinf(ratio) else f"{ratio:.1f} times" for ratio in medians)
    lines.append(f"| {OWN}, is faster, median | - | {times} |")
    slower = " | ".join(f"{_longer(measured, code):.2f} times" if code in ALIKE else "-" for code in codes[1:])
    lines.append(f"| {PLAIN_MESH} take as long, median | - | {slower} |")
    return "\n".join(lines)


def _longer(measured: Sequence[Case], code: str) -> float:
    """How many times as long covocp takes as another code on the same mesh; median of the problems that both solve."""
    seconds = {(case.part, case.code): case.median() for case in measured}
    pairs = [(seconds[name, PLAIN_MESH], seconds[name, code]) for name in PLAIN]
    return statistics.median([own / other for own, other in pairs if own is not None and other is not None])


def _ratio(measured: Sequence[Case], name: str, code: str) -> float:
    """How many times as long another code takes as the refined meshes of covocp; inf where these alone reach 1e-6."""
    own, other = (next(case for case in measured if (case.part, case.code) == (name, c)) for c in (OWN, code))
    mine, theirs, off = own.median(), other.median(), other.median("off")
    if not _ahead(measured, name, OWN):  # does not reach it itself
        return 0.0
    return math.inf if off is None or theirs is None or mine is None or off > REFINE else theirs / mine


def _ahead(measured: Sequence[Case], name: str, code: str) -> bool:
    """Whether the refined meshes of covocp reach the error that is asked for and another code not, or later."""
    own, other = (next(case for case in measured if (case.part, case.code) == (name, c)) for c in (OWN, code))
    off, others = (math.inf if (e := case.median("off")) is None else e for case in (own, other))
    mine, theirs = (math.inf if (s := case.median()) is None else s for case in (own, other))
    return off <= REFINE and (others > REFINE or mine <= theirs)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one run of each")
    options = parser.parse_args()
    every = cases()
    measure(every, 1 if options.quick else REPEATS)
    print(table(every))


if __name__ == "__main__":
    main()
