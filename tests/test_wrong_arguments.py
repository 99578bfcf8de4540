"""Whatever is given to whatever argument: an error of covocp's own, or a result; never one of numpy's or CasADi's."""

import warnings

import pytest
from wrong_values import CASES, RARE, SLOW, VALUES

import covocp as co
from covocp.simulation import step_choice


def foreign_errors(cases, names, of_each=None):
    """What is raised that is no error of covocp's own; with so many of the names for each argument, in turn."""
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        warnings.simplefilter("ignore", RuntimeWarning)  # numpy says that 1e300 overflows, which is true
        for k, (function, argument, call) in enumerate(cases):
            chosen = names if of_each is None else [names[(k * of_each + i) % len(names)] for i in range(of_each)]
            for name in chosen:
                try:
                    call(VALUES[name]())
                except co.CovocpError:
                    pass
                except Exception as error:
                    found.append(f"{function}, {argument}={name}: {type(error).__name__}: {error}"[:200])
    return found


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some take a word for the name of a file
    monkeypatch.setattr(step_choice, "MOST_STEPS", 5_000)  # as many are made of the fastest plants among the values


@pytest.mark.parametrize("group", CASES)
def test_a_wrong_argument_is_refused_by_covocp(group):
    assert foreign_errors(CASES[group](), [name for name in VALUES if name not in RARE]) == []


@pytest.mark.slow
@pytest.mark.parametrize("group", CASES)
def test_a_rare_wrong_argument_is_refused_by_covocp(group):
    assert foreign_errors(CASES[group](), RARE, of_each=4) == []


@pytest.mark.slow
@pytest.mark.parametrize("group", SLOW)
def test_a_wrong_statement_that_is_solved_is_refused_by_covocp(group):
    assert foreign_errors(SLOW[group](), [name for name in VALUES if name not in RARE]) == []
