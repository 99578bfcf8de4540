"""An error says four things, keeps them, and survives the way to another process."""

import pickle

import pytest

import covocp as co

PARTS = {"expected": "a number", "received": "'x'", "remedy": "correct gain="}


@pytest.mark.parametrize("kind", [co.CovocpError, co.ProblemError, co.ExportError, co.SolveError])
def test_the_message_has_a_line_for_each_part(kind):
    error = kind("The gain is wrong.", **PARTS)
    lines = str(error).splitlines()
    assert lines == ["The gain is wrong.", "  expected: a number", "  received: 'x'", "  remedy:   correct gain="]
    assert (error.problem, error.expected, error.received, error.remedy) == ("The gain is wrong.", *PARTS.values())


def test_parts_that_are_not_given_leave_no_line():
    assert str(co.ProblemError("It is wrong.", remedy="mend it")) == "It is wrong.\n  remedy:   mend it"
    assert str(co.ProblemError("It is wrong.")) == "It is wrong."


def test_an_error_that_was_sent_to_another_process_is_the_same():
    error = co.SolveError("It was not solved.", **PARTS, violations={"x": 0.3})
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is co.SolveError
    assert str(again) == str(error)
    assert vars(again) == vars(error)
