"""Slopes past passages of a tape against CasADi's own and finite differences."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.models import mass_chain, unknown_lag
from covocp.passage import library
from covocp.passage.written import Tape
from covocp.transcription.nlp import NLP
from covocp.transcription.scales import choose_scales, evened
from covocp.transcription.transcribing import transcribe, written_out

pytestmark = [
    pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"])),
    pytest.mark.filterwarnings("ignore::covocp.CovocpWarning"),
]

Array = np.ndarray


def limited() -> co.Problem:
    """A free duration, a variance that is limited along the path, and more at the end."""
    ocp = co.Problem(co.Free(guess=2.0, lower=0.5, upper=8.0))
    x, u = ocp.state("x", 2, initial=[1.0, 0.0]), ocp.control("u", lower=-3.0, upper=3.0, guess=0.5)
    b = ocp.unknown("b", mean=1.0, variance=0.3)
    ocp.dynamics(x, ca.vertcat(x[1], b * u - 0.1 * x[0] ** 3), noise=0.01)
    ocp.measurement("y", x[0], noise=0.05)
    E = ocp.estimation_covariance()
    ocp.subject_to(E[b, b], upper=0.31)
    ocp.subject_to(E[b, b], upper=0.2, at="final")
    ocp.minimize(running=0.1 * u**2 + 1.0 + E[b, b], terminal=E[b, b] + x[0] ** 2)
    return ocp


CASES: dict[str, Callable[[], co.Problem]] = {
    "estimation": unknown_lag.problem,
    "chain": lambda: mass_chain.problem(masses=4),
    "closed loop": unknown_lag.steering,
    "limits": limited,
}


def both(problem: co.Problem) -> tuple[NLP, NLP, Array, Array]:
    """The NLP by CasADi's operations and by a tape, a point that is no solution, parameters."""
    options = {"intervals": 8, "substeps": 2, "covariances": "eliminated"}
    solution = co.solve(problem, **options, max_iterations=3, allow_failure=True, progress=False)
    statement, mesh = problem.statement(), solution.mesh
    assert mesh.eliminated
    scales = evened(choose_scales(statement, mesh, solution.trajectory, statement.values), mesh)
    plain = transcribe(statement, mesh, scales)
    taped = written_out(statement, mesh, scales, Tape("evaluated"))
    w = plain.pack(solution.trajectory)
    w = w * (1 + 0.05 * np.random.default_rng(7).normal(size=w.size))
    return plain, taped, w, np.append(statement.values, 2.5)


def close(found: ca.DM, known: ca.DM, tolerance: float) -> None:
    """Every row of a result within a share of its own size."""
    one, other = np.asarray(ca.densify(found).full()), np.asarray(ca.densify(known).full())
    size = np.abs(other).max(axis=1, keepdims=True) if other.shape[1] > 1 else np.abs(other).max(initial=1e-300)
    assert (np.abs(one - other) <= tolerance * size).all()


@pytest.mark.parametrize("case", CASES)
def test_cost_rows_and_slopes_are_those_of_the_plain_path(case: str) -> None:
    plain, taped, w, p = both(CASES[case]())
    assert taped.gradient is not None
    own = ca.Function("own", [taped.w, taped.p], [taped.f, taped.g, taped.gradient[1], taped.jacobian])
    slopes = [ca.gradient(plain.f, plain.w), ca.jacobian(plain.g, plain.w)]
    known = ca.Function("known", [plain.w, plain.p], [plain.f, plain.g, *slopes])
    for found, expected in zip(own(w, p), known(w, p), strict=True):
        close(found, expected, 1e-11)
    assert (own(w, p)[3].sparsity() + known(w, p)[3].sparsity()) == own(w, p)[3].sparsity()  # nothing is left out


@pytest.mark.parametrize("case", CASES)
def test_slopes_are_finite_differences(case: str) -> None:
    _, taped, w, p = both(CASES[case]())
    assert taped.gradient is not None
    values = ca.Function("values", [taped.w, taped.p], [ca.vertcat(taped.f, taped.g)])
    slopes = ca.Function("slopes", [taped.w, taped.p], [ca.vertcat(taped.gradient[1].T, taped.jacobian)])
    direction = np.random.default_rng(3).normal(size=w.size)
    h = 1e-5
    differences = sum(
        share * (values(w + k * h * direction, p) - values(w - k * h * direction, p))
        for k, share in ((1, 4), (2, -0.5))
    ) / (6 * h)
    along = ca.mtimes(slopes(w, p), direction)
    close(along, differences, 1e-7)


def test_both_forms_have_the_same_arguments_and_results() -> None:
    statement = unknown_lag.problem().statement()
    solution = co.solve(unknown_lag.problem(), intervals=6, max_iterations=3, allow_failure=True, progress=False)
    scales = evened(choose_scales(statement, solution.mesh, solution.trajectory, statement.values), solution.mesh)
    tape = Tape("written")
    parts = [written_out(statement, solution.mesh, scales, own) for own in (Tape("evaluated"), tape)]
    sparsities = [[part.g.sparsity(), part.jacobian.sparsity(), part.gradient[1].sparsity()] for part in parts]
    assert sparsities[0] == sparsities[1]
    code = tape.written()
    assert len(code.bodies) == 2 * len({call.forward.name() for call in tape.calls}) == 2
    assert "written_forward(" in code.introduction
