"""Limits of the control of an exported controller: they hold from the start on, and the package says what they are."""

import re
import subprocess
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, mars, quick

import covocp as co
from covocp.cli.commands import main
from covocp.export import export_c


@lru_cache
def cart(bounded=True):
    """A cart whose planned force is 0.726 N at the start and -0.726 N at the end, within bounds of 1 N."""
    ocp = co.Problem(duration=1.0, name="cart")
    x = ocp.state("x", initial=0.0, variance=0.1)
    bounds = {"lower": -1.0, "upper": 1.0} if bounded else {}
    force, trim = ocp.control("force", unit="N", **bounds), ocp.control("trim", 2)
    ocp.dynamics(x, -x + force + ca.sum1(trim), noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=0.5 * (force**2 + ca.sumsqr(trim)), terminal_weight={x: 2.0})
    return co.evaluate(ocp, nominal={"force": np.linspace(0.726, -0.726, 11), "trim": [0.0, 0.1]}, intervals=10)


def texts(made):
    """Header and README, each in one line."""
    files = (made.directory / f"{made.name}.h", made.directory / "README.md")
    return [" ".join(path.read_text(encoding="utf-8").replace("\n *", " ").split()) for path in files]


@pytest.mark.needs_cc
@pytest.mark.parametrize("period", [None, 0.1])
def test_the_first_control_is_within_the_limits(period):
    limits = {"force": (-0.5, 0.5), "trim": ([-1.0, -np.inf], [np.inf, 0.05])}
    with pytest.warns(co.CovocpWarning, match=r"'force' is 0.726 \[N\] at 0 s, its limits -0.5 to 0.5; 'trim\[1\]'"):
        made = export_c(cart(), FOLDER / f"first_{period is None}", limits=limits, period=period)
    for laws in (quick(made).python(), made.reference()):
        np.testing.assert_allclose(laws.step.state["control"], [0.5, 0.0, 0.05], rtol=1e-15)
        np.testing.assert_allclose(laws.step.state["nominal_control"], [0.726, 0.0, 0.1], rtol=1e-9)
        np.testing.assert_allclose(laws.step.step(np.nan, 0.0), [0.5, 0.0, 0.05], rtol=1e-15)
        assert laws.step.step(np.nan, 5.0)[0] == -0.5  # the nominal of the end
    assert made.check(samples=100).ok


def test_a_nominal_control_within_the_limits_or_on_them_is_no_warning(tmp_path):
    export_c(cart(), tmp_path / "within", limits="bounds")
    export_c(cart(), tmp_path / "on_them", limits={"force": (-0.726 * (1 - 1e-8), 0.726)})


@pytest.mark.needs_cc
def test_limits_are_written_with_their_numbers_and_units(tmp_path):
    limits = {"force": (-0.75, 0.8), "trim": ([-1.0, -np.inf], [np.inf, np.inf])}
    made = export_c(cart(), tmp_path / "pk", limits=limits)
    header, readme = texts(made)
    said = "Limits of the control, held from init on: force from -0.75 to 0.8 [N]; trim[0] at least -1; "
    said += "trim[1] not limited."
    assert said in header
    assert said in readme
    defined = dict(re.findall(r"#define (PK_LIMIT\w+) (\S+)", (made.directory / "pk.h").read_text()))
    assert defined == {
        "PK_LIMIT_FORCE_LOWER": "(-0.75)",
        "PK_LIMIT_FORCE_UPPER": "0.8",
        "PK_LIMIT_TRIM_0_LOWER": "(-1.0)",
    }
    assert "not limited to the bounds" not in str(made)
    main = tmp_path / "main.c"
    main.write_text('#include "pk.h"\nint main(void) { return 2-PK_LIMIT_FORCE_LOWER == 2.75 ? 0 : 1; }\n')
    command = ["cc", "-std=c99", "-Wall", "-Werror", f"-I{made.directory}", main, "-o", tmp_path / "main"]
    subprocess.run(command, check=True)
    assert subprocess.run([tmp_path / "main"]).returncode == 0


def test_bounds_that_are_not_kept_are_said_everywhere(tmp_path):
    made = export_c(cart(), tmp_path / "pk")
    said = 'not limited, not even to the bounds of the problem (force from -1 to 1 [N]): limits="bounds" at the export'
    for text in texts(made):
        assert said in text
        assert "limited." not in text
    assert 'step: the control is not limited to the bounds of the problem (force from -1 to 1 [N]): limits="b' in str(
        made
    )
    assert "PK_LIMIT" not in (made.directory / "pk.h").read_text()


def test_a_control_without_bounds_is_not_limited(tmp_path):
    made = export_c(cart(bounded=False), tmp_path / "pk", period=0.1)
    for text in texts(made):
        assert "The control is not limited." in text
    assert "limited" not in str(made)


def test_controls_that_differ_in_capitals_have_limits_of_their_own(tmp_path):
    ocp = co.Problem(duration=1.0, name="capitals")
    x, u, U = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u"), ocp.control("U")
    ocp.dynamics(x, u + U, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=u**2 + U**2, terminal_weight={x: 1.0})
    solution = co.evaluate(ocp, nominal={"u": 0.0, "U": 0.0}, intervals=10)
    made = export_c(solution, tmp_path / "pk", limits={"u": (-1, 1), "U": (-2, 2)})
    text = (made.directory / "pk.h").read_text()
    assert "PK_LIMIT_U_UPPER 1.0\n" in text
    assert "PK_LIMIT_U_2_UPPER 2.0\n" in text


@pytest.mark.parametrize("limits", ["bounds", {"lift_to_drag": (0.3, 0.6)}])
def test_limits_of_a_control_without_a_unit(tmp_path, limits):
    low, high = (0, 1) if limits == "bounds" else (0.3, 0.6)
    made = export_c(mars(), tmp_path / "pk", limits=limits)
    assert all(f"lift_to_drag from {low} to {high}." in text for text in texts(made))


BOUNDED = """
import covocp as co

def problem():
    ocp = co.Problem(duration=1.0, name="bounded")
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u", lower=-2.0, upper=2.0, unit="N")
    ocp.dynamics(x, u, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=0.5 * (u - 0.3) ** 2, terminal_weight={x: 2.0})
    return ocp
"""


@pytest.mark.needs_cc
@pytest.mark.parametrize("limits", [[], ["--limits", "bounds"]])
def test_the_command_limits_the_control_to_the_bounds(capsys, tmp_path, limits):
    (tmp_path / "own.py").write_text(BOUNDED)
    arguments = ["export", f"{tmp_path}/own.py:problem", str(tmp_path / "pk"), "--intervals", "20", "--samples", "50"]
    assert main([*arguments, *limits]) == 0
    missed = "not limited to the bounds of the problem (u from -2 to 2 [N])" in capsys.readouterr().out
    defined = "#define PK_LIMIT_U_UPPER 2.0 /* [N] */" in (tmp_path / "pk" / "pk.h").read_text()
    assert (missed, defined) == ((False, True) if limits else (True, False))
