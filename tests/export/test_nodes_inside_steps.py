"""Steps of the exported controller over nodes of the mesh, where the control of the nominal jumps or has a kink."""

from __future__ import annotations

import itertools
import subprocess
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from exports import FOLDER, QUICK, STRICT
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import covocp as co
from covocp.export import CPackage, export_c
from covocp.export.laws.law import span
from covocp.models import unknown_lag

pytestmark = pytest.mark.needs_cc


def _cart(gates: bool) -> co.Problem:
    """A mass of which the place is measured; with gates the control of the best nominal jumps at 1.5 s."""
    ocp = co.Problem(4.0, name="cart")
    x = ocp.state("x", initial=0.0, final=1.0 if gates else None, variance=1e-4)
    v = ocp.state("v", initial=0.0, final=0.0 if gates else None, variance=1e-4)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=1e-5)
    ocp.measurement("m", x, noise=1e-3)
    if gates:
        ocp.subject_to(v, at=1.5, equals=-0.3)
        ocp.subject_to(x, at=2.5, equals=0.6)
    ocp.minimize_expected(running=0.1 * u**2, terminal_weight={x: 1.0, v: 1.0})
    return ocp


@cache
def jumping(kind: str) -> co.Solution:
    """Controls that are constant between the nodes, or linear with one jump."""
    nominal = {"u": np.random.default_rng(2).normal(size=16)}
    if kind == "constant":
        return co.evaluate(_cart(False), nominal=nominal, intervals=16, control="constant")
    found = co.solve(_cart(True), intervals=16, progress=False)
    assert np.abs(np.diff(found["u"])[np.diff(found.t) == 0.0]).max() > 1.0
    return found


@cache
def package() -> CPackage:
    made = export_c(jumping("constant"), FOLDER / "jumping")
    made.build(flags=STRICT)
    return made


def _flown(step: Any, h: float) -> None:
    """Without measurements the estimate is the deviation of the mass, which the held control moves."""
    step.init()
    held, truth = float(step.state["control"]), np.zeros(2)
    for k in range(1, round(4.0 / h) + 1):
        truth = np.array([truth[0] + h * truth[1] + held * h**2 / 2, truth[1] + held * h])
        held = float(step.step(np.nan, k * h)[0]) + 0.05
        step._values[span(step.law.outputs, "control")] = held  # another one was applied
        deviation = truth - step.state["nominal_state"]
        np.testing.assert_allclose(step.estimate, deviation, rtol=0, atol=1e-12, err_msg=f"{k * h}")
    assert np.abs(deviation).max() > 0.01


@pytest.mark.parametrize("h", [0.1, 0.4, 1.0, 4.0])
def test_jumps_of_the_nominal_are_seen_wherever_they_lie(h: float) -> None:
    """Steps within an interval, over one node and over many; C as well."""
    for step in (package().python().step, package().reference().step):
        _flown(step, h)


@pytest.mark.parametrize("h", [0.08, 0.4])
def test_a_jump_of_linear_controls_at_a_gate_is_seen(h: float) -> None:
    _flown(export_c(jumping("gate"), FOLDER / f"gate_{h}").reference()["step"], h)


def test_c_is_python_also_where_a_step_is_under_way() -> None:
    assert package().check(300).deviation <= 1e-12


def test_a_step_of_any_length_has_the_order_of_the_mesh() -> None:
    """The lag, nonlinear in its unknown constant: one step over all of 10 s; kinks of the nominal at the nodes."""
    errors = []
    for intervals in (20, 40, 80):
        nominal = {"u": lambda s: 0.3 + 0.4 * np.sin(5.0 * s)}
        problem = unknown_lag.steering(parameter_variance=0.05)
        solution = co.evaluate(problem, nominal=nominal, intervals=intervals, substeps=8)
        step = export_c(solution, FOLDER / f"one_step_{intervals}", largest_spread=np.inf).reference()["step"]
        step.step(0.6, 1.0)
        y, held = step.estimate.copy(), float(step.state["control"])
        assert abs(y[0]) > 0.05

        def rate(t: float, y: np.ndarray, solution: co.Solution = solution, held: float = held) -> np.ndarray:
            now = solution.at(t)
            return np.array([-y[0] - float(now["x"]) * y[1] + held - float(now["u"]), 0.0])

        begins = solution.t[solution.t >= 1.0]
        for begin, end in itertools.pairwise(begins):
            y = solve_ivp(rate, (begin, end), y, rtol=1e-11, atol=1e-13).y[:, -1]
        step.step(np.nan, 10.0)
        errors.append(np.abs(step.estimate - y).max())
    assert errors[0] < 1e-3
    assert (np.log2(np.array(errors[:-1]) / errors[1:]) > 3.8).all()


def test_the_gain_follows_slopes_that_jump_with_the_control() -> None:
    """x' = -u x + w, x measured: covariance of x and its integral by exponentials, piece by piece."""
    ocp, Q, U = co.Problem(2.0, name="leaking"), 0.1, 0.3
    x, u = ocp.state("x", initial=1.0, variance=0.2), ocp.control("u")
    ocp.dynamics(x, -u * x, noise=Q)
    ocp.measurement("m", x, noise=U)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 1.0})
    controls = np.array([0.2, 2.0, -1.0, 1.0])
    solution = co.evaluate(ocp, nominal={"u": controls}, intervals=4, control="constant", substeps=20)
    step = export_c(solution, FOLDER / "leaking", largest_spread=np.inf).reference()["step"]
    step.step(1.1, 0.3)
    step.step(0.7, 1.4)
    P = np.diag([0.2, 0.0])
    for h, rate in zip((0.3, 0.2, 0.5, 0.4), controls[[0, 0, 1, 2]], strict=True):
        F = np.array([[-rate, 0.0], [1.0, 0.0]])
        loan = expm(h * np.block([[-F, np.diag([Q, U])], [np.zeros((2, 2)), F.T]]))
        P = loan[2:, 2:].T @ P @ loan[2:, 2:] + loan[2:, 2:].T @ loan[:2, 2:]
        if h == 0.3:  # the first step ends
            own = P[0, 0] - P[0, 1] ** 2 / P[1, 1]
            P = np.diag([own if step.state["overdue"] else float(np.squeeze(solution.at(0.3)["E"])), 0.0])
    assert float(step.state["filter_gain"]) == pytest.approx(1.1 * P[0, 1] / P[1, 1], rel=2e-3)  # order 4, h u = 1


def test_an_estimate_that_is_lost_on_the_way_leaves_the_nominal_control_of_the_end() -> None:
    solution = jumping("constant")
    for step in (package().python().step, package().reference().step):
        step.init()
        step.step(0.01, 0.1)
        step._values[span(step.law.outputs, "estimate")] = 1e301
        control = step.step(0.01, 3.05)
        assert step.status == "ESTIMATE_LOST"
        assert float(control[0]) == pytest.approx(float(solution.at(3.05)["u"]), abs=1e-14)
        assert step.state["time"] == 3.05


@pytest.mark.parametrize(("first", "last", "precision"), [(10.0, 0.3, "single"), (1e5, 1e-3, "double")])
def test_a_short_phase_after_a_long_one_comes_to_its_end(
    first: float, last: float, precision: Literal["single", "double"], tmp_path: Path
) -> None:
    """By the clock of the whole flight a node of the short one is rounded: it came again, and the step never ended."""

    def phase(duration: float, name: str) -> co.Problem:
        ocp = co.Problem(duration, name=name)
        begins = (None, None) if name == "two" else (1.0, 0.1)
        x, u = ocp.state("x", initial=begins[0], variance=begins[1]), ocp.control("u")
        ocp.dynamics(x, (u - x) / first, noise=1e-3 / first)
        ocp.measurement("m", x, noise=0.05 * first)
        ocp.minimize_expected(running=u**2 / first, terminal_weight={x: 1.0} if name == "two" else None)
        return ocp

    phases, nominal = co.Phases([phase(first, "one"), phase(last, "two")]), {"u": lambda s: 0.3 - 0.2 * s}
    solution = co.evaluate(phases, nominal=[nominal, nominal], intervals=[20, 20])
    made = export_c(solution, tmp_path / "pair", precision=precision)
    made.build(flags=QUICK)
    (tmp_path / "fly.c").write_text(
        '#include <math.h>\n#include "pair.h"\nint main(void)\n{\n    pair_controller c;\n    pair_real u;\n'
        f"    int bad = 0;\n    pair_init(&c);\n    for (int k = 0; k <= 41; ++k) {{\n"
        f"        pair_step(&c, (pair_real)NAN, (pair_real)({first} + {last} * k / 41.0), &u);\n"
        "        bad += !isfinite(u);\n    }\n    return bad;\n}\n"
    )
    sources = [str(path) for path in made.directory.glob("*.c") if path.name != "main.c"]
    command = [
        "cc",
        "-O0",
        f"-I{made.directory}",
        str(tmp_path / "fly.c"),
        *sources,
        "-lm",
        "-o",
        str(tmp_path / "fly"),
    ]
    subprocess.run(command, check=True)
    assert subprocess.run([tmp_path / "fly"], timeout=20).returncode == 0
