"""Tables against scipy: values and derivatives, in both forms, in problems, and what is refused."""

from __future__ import annotations

import subprocess
from itertools import product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, NdBSpline, RegularGridInterpolator, make_interp_spline

import covocp as co
from covocp.blocks.tables import table

RNG = np.random.default_rng(5)


def knots(count: int) -> Any:
    """Uneven knots in [-1, 2]."""
    inside = np.linspace(-1.0, 2.0, count)[1:-1] + 0.8 / count * RNG.uniform(-1, 1, count - 2)
    return np.concatenate([[-1.0], inside, [2.0]])


def derivatives(kind: Any, made: Any, points: Any) -> Any:
    """Value, gradient and Hessian of a table of several variables at points, one row each."""
    x = kind.sym("x", points.shape[1])
    value = made(*(x[i] for i in range(points.shape[1])))
    hessian, gradient = ca.hessian(value, x)
    function = ca.Function("f", [x], [ca.vertcat(value, gradient, ca.vec(ca.densify(hessian)))])
    return np.array([np.asarray(function(row).full()).ravel() for row in points])


def spline_derivatives(grid: Any, values: Any, points: Any) -> Any:
    """The same by scipy's tensor B-splines through the values."""
    coefficients, basis = values, []
    for i, axis in enumerate(grid):
        spline = make_interp_spline(axis, np.moveaxis(coefficients, i, 0), k=3)
        coefficients = np.moveaxis(spline.c, 0, i)
        basis.append(spline.t)
    spline = NdBSpline(tuple(basis), coefficients, 3)
    unit = np.eye(len(grid), dtype=int)
    columns = [spline(points)]
    columns += [spline(points, nu=row) for row in unit]
    columns += [spline(points, nu=a + b) for a, b in product(unit, unit)]
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("count", [4, 9, 300])
def test_spline_of_one_variable_is_that_of_scipy(kind: Any, count: int) -> None:
    axis = knots(count)
    values = np.sin(3 * axis) + 0.1 * axis
    points = np.concatenate([RNG.uniform(-1.2, 2.2, 60), axis[[0, -1]]])
    truth = CubicSpline(axis, values)
    found = derivatives(kind, table("cl", axis, values, kind="cubic"), points[:, None])
    for order in range(3):
        expected = truth(points, order)
        assert np.allclose(found[:, order], expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("shape", [(5, 6), (12, 9), (4, 5, 6)])
def test_tensor_splines_are_those_of_scipy(kind: Any, shape: tuple[int, ...]) -> None:
    grid = tuple(knots(count) for count in shape)
    values = RNG.normal(size=shape)
    points = RNG.uniform(-1, 2, (20, len(shape)))
    found = derivatives(kind, table("map", grid, values, kind="cubic"), points)
    expected = spline_derivatives(grid, values, points)
    assert np.allclose(found, expected, rtol=1e-10, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("shape", [(2,), (200,), (3, 4), (12, 9), (3, 2, 4)])
def test_linear_tables_are_those_of_scipy_and_go_on_outside(kind: Any, shape: tuple[int, ...]) -> None:
    grid = tuple(np.array([-1.0, 2.0]) if count == 2 else knots(count) for count in shape)
    values = RNG.normal(size=shape)
    points = RNG.uniform(-1.3, 2.3, (40, len(shape)))
    truth = RegularGridInterpolator(grid, values, bounds_error=False, fill_value=None)
    made = table("map", grid, values)
    found = derivatives(kind, made, points)
    scale = np.abs(truth(points)).max()
    assert np.allclose(found[:, 0], truth(points), rtol=1e-12, atol=1e-12 * scale)
    assert made(*points[0]) == pytest.approx(float(truth(points[:1])[0]), abs=1e-12 * scale)
    assert np.all(found[:, 1 + len(shape) :: len(shape) + 1] == 0)  # second derivatives by one variable


def test_small_tables_are_written_out_and_large_ones_are_looked_up() -> None:
    x = ca.MX.sym("x")
    small, large = (table("t", np.arange(n), np.arange(n) ** 2.0, kind="cubic")(x) for n in (60, 10_000))
    written, looked_up = (ca.Function("f", [x], [ca.hessian(value, x)[0]]).expand() for value in (small, large))
    calls = [sum(f.instruction_id(k) == ca.OP_CALL for k in range(f.n_instructions())) for f in (written, looked_up)]
    assert calls[0] == 0
    assert calls[1] > 0
    assert looked_up.n_instructions() < 100
    assert float(written(43.3)) == pytest.approx(2.0, abs=1e-6)
    assert float(looked_up(4321.3)) == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize("count", [20, 200])
@pytest.mark.parametrize("method", ["ipopt", "gradient"])
def test_covariance_with_a_table_is_that_of_scipy(count: int, method: str) -> None:
    """Scalar Riccati equation whose drift is a table of the time; the spline has 20 or 200 knots on [0, 2]."""
    axis = np.linspace(0.0, 2.0, count)
    values = np.cos(2 * axis)
    drift = table("drift", axis, values, kind="cubic")
    ocp = co.Problem(duration=2.0)
    x = ocp.state("x", initial=1.0, variance=0.5)
    u = ocp.control("u", guess=0.0)
    ocp.dynamics(x, drift(ocp.time) * x + u, noise=0.3)
    ocp.measurement("m", x, noise=0.4)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x, x] + x**2)
    solution = co.solve(ocp, method=method, progress=False)
    truth = CubicSpline(axis, values)

    def rate(t: float, y: Any) -> Any:
        return [2 * float(truth(t)) * y[0] + 0.3 - y[0] ** 2 / 0.4]

    def backward(t: float, y: Any) -> Any:
        return [2 * float(truth(2.0 - t)) * y[0] - y[0] ** 2]

    exact: dict[str, Any] = {"rtol": 1e-11, "atol": 1e-12}
    variance = solve_ivp(rate, (0, 2), [0.5], **exact).y[0, -1]
    steering = solve_ivp(backward, (0, 2), [1.0], **exact).y[0, -1]
    # piecewise linear controls on 100 intervals cost a little more than the best one
    assert solution.cost == pytest.approx(variance + steering, rel=1e-5)


@pytest.mark.parametrize("count", [20, 5000])
def test_compiled_tables_are_those_of_python(count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    axis = knots(count)
    x = ca.MX.sym("x")
    value = table("t", axis, np.sin(3 * axis), kind="cubic")(x)
    hessian, gradient = ca.hessian(value, x)
    function = ca.Function("f", [x], [value, gradient, hessian])
    monkeypatch.chdir(tmp_path)
    source = function.generate("f.c")
    assert "malloc" not in Path(source).read_text(encoding="utf-8")
    subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", "f.so", source, "-lm"], check=True)
    compiled = ca.external("f", "./f.so")
    for point in [*np.linspace(-1.1, 2.1, 31), *axis[:5]]:
        for ours, theirs in zip(function(point), compiled(point), strict=True):
            assert float(theirs) == pytest.approx(float(ours), rel=1e-13, abs=1e-13)


def test_expected_cost_is_the_same_in_both_forms() -> None:
    """A spline and the same one with knots added are one function: the first is written out, the second looked up."""
    coarse = np.linspace(0.0, 4.0, 20)
    spline = CubicSpline(coarse, 0.3 * np.sin(2 * coarse))
    costs = []
    for axis in (coarse, np.linspace(0.0, 4.0, 19 * 6 + 1)):
        wind = table("wind", axis, spline(axis), kind="cubic")
        ocp = co.Problem(duration=4.0)
        p = ocp.state("p", initial=0.0, final=1.0, variance=1.0)
        v = ocp.state("v", initial=0.0, final=0.0, variance=0.1)
        u = ocp.control("u")
        ocp.dynamics(p, v)
        ocp.dynamics(v, u - 0.5 * (v - wind(ocp.time)), noise=0.01)
        ocp.measurement("position", p, noise=0.1)
        ocp.minimize_expected(running=u**2, terminal_weight={p: 1.0, v: 1.0})
        assert ocp.statement().symbolic is ca.SX
        costs.append(co.solve(ocp, progress=False).cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-8)


GOOD: dict[str, Any] = {"name": "lift", "grid": [0.0, 1.0, 2.0, 3.0], "values": [1.0, 2.0, 0.0, 1.0], "kind": "cubic"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"grid": [0.0, 2.0, 1.0, 3.0]}, "do not rise"),
        ({"grid": [0.0, 1.0, 1.0, 3.0]}, "do not rise"),
        ({"grid": [0.0, 1.0, np.nan, 3.0]}, "lift"),
        ({"grid": [0.0, 1.0, 2.0], "values": [1.0, 2.0, 3.0]}, "too few knots"),
        ({"grid": ()}, "one to three variables"),
        ({"grid": [np.arange(3.0), np.arange(4.0)], "values": np.zeros((3, 4))}, "a tuple of such, not a list"),
        ({"grid": [np.arange(4.0), np.arange(4.0)], "values": np.zeros((4, 4))}, "a tuple of such, not a list"),
        ({"grid": [[0.0, 1.0, 2.0, 3.0]]}, "a tuple of such, not a list"),
        ({"values": [1.0, 2.0, np.nan, 3.0]}, "lift"),
        ({"values": [1.0, 2.0, 3.0]}, "another shape"),
        ({"values": np.ones((4, 2))}, "another shape"),
        ({"kind": "quadratic"}, "unknown kind"),
        ({"kind": None}, "unknown kind"),
        ({"name": ""}, "needs a name"),
    ],
)
def test_wrong_tables_are_refused_by_name(change: Any, words: str) -> None:
    with pytest.raises(co.ProblemError, match=words):
        table(**(GOOD | change))


def test_wrong_arguments_of_tables_are_refused() -> None:
    made = table(**GOOD)
    with pytest.raises(co.ProblemError, match="number of variables"):
        made(1.0, 2.0)
    with pytest.raises(co.ProblemError, match="scalars"):
        made(ca.MX.sym("x", 2))
    plane = table("plane", ([0.0, 1.0], [0.0, 1.0]), np.eye(2))
    with pytest.raises(co.ProblemError, match="two kinds"):
        plane(ca.MX.sym("x"), ca.SX.sym("x"))
