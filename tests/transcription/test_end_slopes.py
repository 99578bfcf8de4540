"""Slopes of final states by the controls, by the compiled library: against CasADi's Jacobian of the same run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from along_problems import PROBLEMS, alike

import covocp as co
from covocp.passage import library
from covocp.transcription import end_slopes, steering
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.steering import Run, final_pull
from covocp.transcription.stiffness import resolve_mesh

pytestmark = pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))

MESHES: dict[str, dict[str, Any]] = {
    "linear": {"intervals": 13},
    "constant": {"intervals": 9, "control": "constant", "substeps": 2},
    "two values at a node": {"intervals": 13, "substeps": 3},
}


def meshed(statement: Any, name: str) -> Mesh:
    mesh = resolve_mesh(statement, Options(**MESHES[name]), statement.values)
    if name == "two values at a node":
        places = np.linspace(0.0, 1.0, 12)
        mesh = replace(mesh, nodes=np.sort(np.append(places, [0.0, places[4]])))
        assert mesh.idle
    return mesh


@pytest.mark.parametrize("form", MESHES)
@pytest.mark.parametrize("name", PROBLEMS)
def test_they_are_those_of_casadi(name: str, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    st = PROBLEMS[name][0]().statement()
    mesh = meshed(st, form)
    rng = np.random.default_rng(len(name))
    start, u = 0.3 * rng.normal(size=st.nx), 0.3 * rng.normal(size=(mesh.control_nodes, st.nu))
    rows = tuple(range(0, st.nx, 2))
    scale, units = rng.uniform(0.5, 2.0, st.nx), rng.uniform(0.5, 2.0, st.nu)
    run = Run(statement=st, mesh=mesh, start=start, duration=1.7, parameters=st.values, scale=scale, units=units)
    target = rng.normal(size=len(rows))
    assert end_slopes.end_slopes(st, mesh, start, u, 1.7, st.values, rows) is not None
    own = final_pull(run, rows, target, u)
    monkeypatch.setattr(steering, "end_slopes", lambda *_: None)
    for one, other in zip(own, final_pull(run, rows, target, u, often=False), strict=True):
        alike(one, other, 1e-11)


def test_implicit_steps_are_casadis() -> None:
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=1.0, final=0.0), ocp.control("u")
    ocp.dynamics(x, -1e4 * x + u)
    ocp.minimize(running=u**2)
    st = ocp.statement()
    mesh = resolve_mesh(st, Options(intervals=10), st.values)
    assert mesh.step == "rodas"
    u = np.ones((mesh.control_nodes, 1))
    assert end_slopes.end_slopes(st, mesh, np.ones(1), u, 1.0, st.values, (0,)) is None
    one = np.ones(1)
    run = Run(statement=st, mesh=mesh, start=one, duration=1.0, parameters=st.values, scale=one, units=one)
    slope = final_pull(run, (0,), np.zeros(1), u)[1]
    assert slope.sum() == pytest.approx(1e-4, rel=1e-3)  # of x = u / 1e4
