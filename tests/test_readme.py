"""The scripts of the README run as they stand, one after the other as it says."""

import re
from pathlib import Path

README = Path(__file__).resolve().parent.parent / "README.md"
FIRST, EXPRESSIONS, CLOSED_LOOP = re.findall(
    r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
)
COST = "ocp.minimize(running=0.5 * u**2, terminal=10.0 * E[b, b])\n"


def test_the_first_script_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(FIRST, {})
    printed = capsys.readouterr().out
    assert "total     7.0852396" in printed
    assert "global minimum (certified)" in printed
    assert (tmp_path / "first_order_lag.png").exists()


def test_expressions_are_those_of_casadi():
    names = {}
    exec('import covocp as co\nocp = co.Problem(1.0)\nx = ocp.state("x", initial=1.0)\nu = ocp.control("u")', names)
    exec(EXPRESSIONS, names)
    assert set(names["ocp"].rates) == {"x"}


def test_the_closed_loop_differs_in_one_line(capsys):
    statement = FIRST.partition("solution = ")[0]
    assert COST in statement
    runs = CLOSED_LOOP.replace("runs=2000", "runs=50, progress=False")
    assert runs != CLOSED_LOOP
    names = {}
    exec(statement.replace(COST, "") + runs, names)
    assert round(names["combined"].cost, 5) == 2.02715
    assert round(names["classical"].cost, 5) == 2.50407
    assert "at least 17.5 % of the expected cost" in capsys.readouterr().out
