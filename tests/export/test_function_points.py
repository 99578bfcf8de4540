"""Functions that have no value at some points, or no inputs: what C is compared with."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from exports import STRICT

import covocp as co
from covocp.export import export_c

pytestmark = pytest.mark.needs_cc
A, B = ca.MX.sym("A", 3, 3), ca.MX.sym("b", 3)
EYE = np.eye(3)


def solve() -> ca.Function:
    """A^-1 b, which CasADi refuses where A has no inverse."""
    return ca.Function("solve", [A, B], [ca.solve(A, B, "qr")], ["A", "b"], ["x"])


@pytest.mark.parametrize("ranges", [None, {"A": (EYE, 2.0 * EYE)}, {"A": (-1.0, 1.0)}, {"A": (1.0, 1.5)}])
@pytest.mark.parametrize("precision", ["double", "single"])
def test_points_without_a_value_are_left_out(tmp_path: Path, ranges: dict | None, precision: str) -> None:
    """Singular are matrices of equal numbers, as at the ends of ranges; as many points as asked for remain."""
    made = export_c(solve(), tmp_path / "solve", ranges=ranges, precision=precision, tolerance=1e-2)
    made.build(flags=STRICT)
    for samples in (1, 3, 50):
        check = made.check(samples)
        assert check.ok
        assert check.laws["solve"].points == samples
    matrix = np.array([[2.0, 1.0, 0.0], [0.5, -3.0, 1.0], [0.0, 1.0, 4.0]])
    for laws in (made.python(), made.reference()):
        np.testing.assert_allclose(matrix @ laws(matrix, [1.0, 2.0, 3.0]), [1.0, 2.0, 3.0], rtol=1e-5)
        assert laws.status == "OK"
        assert np.isnan(laws(np.zeros((3, 3)), [1.0, 2.0, 3.0])).all()
        assert laws.status == "RESULT_NOT_FINITE"


def test_a_function_without_a_value_at_most_points_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(co.ExportError, match=r"(?s)'solve' cannot be evaluated.*40 of 84 points.*ranges="):
        export_c(solve(), tmp_path / "singular", ranges={"A": (1.0, 1.0)})
    assert not (tmp_path / "singular").exists()


def test_functions_without_inputs_are_constants(tmp_path: Path) -> None:
    x = ca.SX.sym("x", 2)
    functions = [
        ca.Function("none", [], [ca.SX([3.0, -1.0])], [], ["c"]),
        ca.Function("empty", [ca.SX(0, 0)], [ca.SX(5.0)], ["e"], ["c"]),
        ca.Function("other", [x], [2 * x], ["x"], ["y"]),
    ]
    made = export_c(functions, tmp_path / "constants")
    made.build(flags=STRICT)
    assert made.check(20).ok
    assert "int constants_empty(constants_real *c);" in (made.directory / "constants.h").read_text()
    for laws in (made.python(), made.reference()):
        np.testing.assert_array_equal(laws["none"](), [3.0, -1.0])
        assert laws["empty"]() == 5.0
        np.testing.assert_array_equal(laws["other"]([1.0, 2.0]), [2.0, 4.0])
    assert set(made.time(seconds=0.01)) == {"none", "empty", "other"}
