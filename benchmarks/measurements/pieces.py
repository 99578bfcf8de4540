"""Slopes of programs of single intervals piece by piece, beside CasADi's differentiation of the same cost and rows.

    python benchmarks/measurements/pieces.py [rounds]

Processor time in milliseconds, medians: to make the NLP solver with all its slopes, and to evaluate the Jacobian of the
rows and the Hessian of the Lagrangian once, at the problem's own start on its default mesh.
"""

from __future__ import annotations

import importlib
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from covocp.solving.warm_start import make_guess
from covocp.transcription.mesh import Options
from covocp.transcription.nlp import NLP, QUIET
from covocp.transcription.scales import choose_scales
from covocp.transcription.separable import slopes
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.transcribing import transcribe

MODELS = (
    "bryson_denham",
    "brachistochrone",
    "theta_d_benchmarks",
    "goddard_rocket",
    "free_time_integrator",
    "noisy_integrator",
    "antenna_pointing",
    "agile_aircraft",
    "formation_flight",
)
EVALUATIONS = 20


def transcribed(name: str) -> tuple[NLP, Any, Any]:
    """The program of a model, its start and parameters."""
    statement = importlib.import_module(f"covocp.models.{name}").problem().statement()
    mesh = resolve_mesh(statement, Options(), statement.values)
    guess = make_guess(statement, mesh, statement.values, None).trajectory
    nlp = transcribe(statement, mesh, choose_scales(statement, mesh, guess, statement.values), taken=True)
    return nlp, nlp.pack(guess), np.append(statement.values, 1.0)


def made(nlp: NLP, *, by_pieces: bool) -> ca.Function:
    """The NLP solver."""
    own = slopes(nlp.pieces, nlp.w, nlp.p, nlp.g.shape[0], second=True) if by_pieces else {}
    problem = {"x": nlp.w, "p": nlp.p, "f": nlp.f, "g": nlp.g}
    return ca.nlpsol("nlp", "ipopt", problem, {**QUIET, "no_nlp_grad": True, **own})


def milliseconds(run: Callable[[], Any], count: int) -> float:
    """Of one call."""
    begin = time.process_time()
    for _ in range(count):
        run()
    return 1e3 * (time.process_time() - begin) / count


def main(rounds: int = 5) -> None:
    """Print the table."""
    print("| model | variables | solver made: CasADi, by pieces | Jacobian | Hessian |\n|---|---|---|---|---|")
    for name in MODELS:
        taken: dict[tuple[str, bool], list[float]] = {}
        for _ in range(rounds):
            nlp, w, p = transcribed(name)
            for by_pieces in (False, True):
                found: list[ca.Function] = []
                row = {"made": milliseconds(lambda: found.append(made(nlp, by_pieces=by_pieces)), 1)}  # noqa: B023
                jacobian, hessian = (found[0].get_function(f"nlp_{key}") for key in ("jac_g", "hess_l"))
                weights = np.ones(nlp.g.shape[0])
                row["jacobian"] = milliseconds(lambda: jacobian(w, p), EVALUATIONS)  # noqa: B023
                row["hessian"] = milliseconds(lambda: hessian(w, p, 1.0, weights), EVALUATIONS)  # noqa: B023
                for key, value in row.items():
                    taken.setdefault((key, by_pieces), []).append(value)
        median = {key: statistics.median(values) for key, values in taken.items()}
        columns = [f"{median[key, False]:.2f}, {median[key, True]:.2f}" for key in ("made", "jacobian", "hessian")]
        print(f"| {name} | {w.size} | " + " | ".join(columns) + " |", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
