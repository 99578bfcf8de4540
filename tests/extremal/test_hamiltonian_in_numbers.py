"""Terms and slopes of H by matrices of numbers: against CasADi's expressions of the same rates."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
import random_problems
from along_problems import PROBLEMS, alike

import covocp as co
from covocp.base.matrices import pack
from covocp.extremal import forms, hamiltonian
from covocp.extremal.hamiltonian import Costates, by_controls_at, terms_of
from covocp.extremal.metric import Root, mass_matrix
from covocp.passage import library
from covocp.passage.columns import derivative_in_columns
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Options
from covocp.transcription.stiffness import resolve_mesh

pytestmark = pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))


def measured_by_controls() -> co.Problem:
    """Controls in the nominal, in F, in the noise and in what is measured, each curved and beside another."""
    ocp = co.Problem(duration=2.0)
    x = ocp.state("x", 2, initial=[1.0, 0.0], variance=0.3)
    u = ocp.control("u", 3)
    rate = ca.vertcat(x[1] * ca.cos(u[0]), -x[0] * u[1] ** 2 + ca.exp(u[0]) * u[2])
    ocp.dynamics(x, rate, noise=ca.vertcat(0.1 + u[1] ** 2 * u[2] ** 2, 0.2 + ca.sin(u[0]) ** 2))
    ocp.measurement("y", x[0] * ca.exp(u[2]), noise=0.1 + u[0] ** 2)
    E = ocp.estimation_covariance()
    ocp.minimize(running=ca.sumsqr(u) + u[0] * u[1] * x[0], terminal=ca.trace(E))
    return ocp


# Random problems whose rates have the form, and of which nothing is paid on the way.
SEEDS = (13, 14, 15, 19, 22, 23, 24, 25)

CASES: dict[str, Any] = {
    **{name: make for name, (make, _) in PROBLEMS.items()},
    "everywhere": measured_by_controls,
    **{f"random {seed}": (lambda seed=seed: random_problems.draw(seed).problem) for seed in SEEDS},
}


def somewhere(statement: Statement, count: int = 40) -> tuple[list[np.ndarray], Costates]:
    """Arguments of the model at random points, with covariances of full rank, and random costates."""
    rng, st = np.random.default_rng(count), statement
    e = np.zeros((count, st.ne))
    for block in st.matrices:
        root = rng.normal(size=(count, block.size, block.size))
        e[:, block.span] = pack(root @ root.transpose(0, 2, 1))
    values = np.tile(st.values[:, None], count)
    x, u = (rng.normal(size=(size, count)) for size in (st.nx, st.nu))
    columns = [x, u, e.T, rng.uniform(0.0, 2.0, (1, count)), np.full((1, count), 2.0), values]
    return columns, Costates(state=rng.normal(size=(count, st.nx)), matrices=rng.normal(size=(count, st.ne)))


@pytest.fixture(params=CASES)
def statement(request: pytest.FixtureRequest) -> Statement:
    found = CASES[request.param]().statement()
    if not forms.has_forms(found):
        pytest.fail("this case does not reach what is tested")
    return found


def by_expressions(monkeypatch: pytest.MonkeyPatch) -> None:
    """By CasADi from here on."""
    for name in ("by_controls_in_numbers", "terms_in_numbers"):
        monkeypatch.setattr(hamiltonian, name, lambda *_: None)


def test_terms_and_slopes_are_those_of_casadi(statement: Statement, monkeypatch: pytest.MonkeyPatch) -> None:
    columns, costates = somewhere(statement)
    assert hamiltonian.by_controls_in_numbers(statement, columns, costates.state, costates.matrices) is not None
    own, terms = by_controls_at(statement, columns, costates), terms_of(statement, columns, costates)
    by_expressions(monkeypatch)
    known = by_controls_at(statement, columns, costates)
    for one, other in zip(own, known, strict=True):
        alike(one, other)
    alike(terms, terms_of(statement, columns, costates))


def test_slopes_by_states_are_those_of_casadi(statement: Statement) -> None:
    columns, _ = somewhere(statement)
    point = [np.asfortranarray(column) for i, column in enumerate(columns) if i != 2]
    found = forms.slopes_by_states(statement, point)
    assert found is not None
    assert statement.nominal is not None
    symbols = statement.nominal.sx_in() if statement.symbolic is ca.SX else statement.nominal.mx_in()
    rate, cost = statement.nominal.call(symbols)
    known = ca.Function("known", symbols, [ca.densify(ca.jacobian(part, symbols[0])) for part in (rate, cost)])
    for k in range(3):
        by_rate, by_cost = (np.asarray(value.full()) for value in known(*(column[:, k] for column in point)))
        alike(found[0][k], by_rate)
        alike(found[1][k], by_cost[0])


@pytest.mark.parametrize("missing", [("forward",), ("forward", "forward")])
def test_what_the_library_has_no_derivatives_of_is_casadis(
    monkeypatch: pytest.MonkeyPatch, missing: tuple[str, ...]
) -> None:
    """Derivatives of too many operations are not made."""
    statement = measured_by_controls().statement()
    columns, costates = somewhere(statement)
    known = by_controls_at(statement, columns, costates)

    def some(owner: Any, function: ca.Function, *kinds: str) -> Any:
        return None if kinds == missing else derivative_in_columns(owner, function, *kinds)

    monkeypatch.setattr(forms, "derivative_in_columns", some)
    assert hamiltonian.by_controls_in_numbers(statement, columns, costates.state, costates.matrices) is None
    for one, other in zip(by_controls_at(statement, columns, costates), known, strict=True):
        alike(one, other)


@pytest.mark.parametrize("controls", [1, 3])
@pytest.mark.parametrize("form", ["linear", "constant"])
def test_a_root_of_the_metric_is_one_of_all_its_parts(form: Any, controls: int) -> None:
    """R' R is the metric, without the controls that are held; R and R' are undone."""
    ocp = co.Problem(duration=3.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u", controls)
    ocp.dynamics(x, ca.sum1(u))
    ocp.minimize(running=ca.sumsqr(u))
    st = ocp.statement()
    mesh = resolve_mesh(st, Options(intervals=12, control=form), st.values)
    rng = np.random.default_rng(controls)
    moving = np.flatnonzero(rng.uniform(size=mesh.control_nodes * controls) < 0.7).tolist()
    metric = ca.diagcat(mass_matrix(mesh, 3.0, controls)[moving, moving], ca.diag(ca.DM([0.5, 2.0])))
    root, size = Root.of(metric), metric.shape[0]
    inverse = root.solved(np.eye(size))
    alike(inverse.T @ metric.full() @ inverse, np.eye(size), 1e-12)
    alike(root.solved(np.eye(size), turned=True), inverse.T, 1e-12)
    assert np.abs(np.tril(inverse, -1)).max() == 0.0


def test_a_metric_that_is_none_has_no_root() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        Root.of(ca.DM([[1.0, 2.0], [2.0, 1.0]]))
